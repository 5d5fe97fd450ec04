"""What the networks see: stored bytes as floats, and the targets of the heads."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from study.config.paper import IMAGE

Bytes = NDArray[np.uint8]
Indices = NDArray[np.int64]
MASKS = ("pred", "plan")  # order of the store's masks
Split = Literal["train", "test"]


def to_float(images: Tensor) -> Tensor:
    """Images [B, 64, 64, 3] uint8 as [B, 3, 64, 64] float32 in [0, 1], channels last in memory."""
    return images.permute(0, 3, 1, 2).float().div_(255)


def unpack(masks: Tensor, heads: Sequence[str]) -> dict[str, Tensor]:
    """Packed masks [B, 2, 512] uint8 as one [B, 1, 64, 64] float32 of 0 and 1 for each head; first bit highest."""
    shifts = torch.arange(7, -1, -1, dtype=torch.uint8, device=masks.device)
    unpacked = {}
    for head in heads:
        bits = (masks[:, MASKS.index(head), :, None] >> shifts) & 1
        unpacked[head] = bits.view(-1, 1, IMAGE, IMAGE).float()
    return unpacked
