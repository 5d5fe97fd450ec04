"""What the networks see: stored bytes as floats, and the targets of the heads."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from study.config.heads import mask_heads
from study.config.paper import IMAGE

Bytes = NDArray[np.uint8]
Indices = NDArray[np.int64]
Split = Literal["train", "test"]


def to_float(images: Tensor) -> Tensor:
    """Return images [B, 64, 64, 3] uint8 as [B, 3, 64, 64] float32 in [0, 1], channels last in memory."""
    return images.permute(0, 3, 1, 2).float().div_(255)


def mask_places(heads: Iterable[str]) -> dict[str, int]:
    """Return, for each of these heads that learns a mask, the place of the mask in a frame store."""
    return {head: place for place, head in enumerate(mask_heads()) if head in heads}


def unpack(masks: Tensor, places: Mapping[str, int]) -> dict[str, Tensor]:
    """Return packed masks [B, K, 512] uint8 as one [B, 1, 64, 64] float32 of 0 and 1 for each head.

    `places` are those of `mask_places`. The first bit of a byte is its highest.
    """
    shifts = torch.arange(7, -1, -1, dtype=torch.uint8, device=masks.device)
    bits = {head: (masks[:, place, :, None] >> shifts) & 1 for head, place in places.items()}
    return {head: each.view(-1, 1, IMAGE, IMAGE).float() for head, each in bits.items()}
