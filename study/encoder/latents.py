"""Encode frames with a trained encoder, and paint sample reconstructions."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd
import torch
from numpy.typing import NDArray

from study.compute.device import check_device
from study.config.paper import LATENT
from study.data.frames import Frames
from study.encoder.autoencoder import MultiHeadAutoencoder
from study.encoder.inputs import Bytes, Indices, mask_places, to_float, unpack
from study.encoder.networks import encoder_of
from study.products import Arrays

SAMPLES = 16


def choose_samples(frames: Frames) -> Indices:
    """Return the rows of up to 16 test frames to show, the same for every encoder: the fullest of each drive.

    A frame's content is the sum of its ranks among the test frames by the set pixels of each mask.
    """
    test = frames.indices("test")
    pixels = np.bitwise_count(frames.masks[test]).sum(axis=2, dtype=np.int64)
    content = pd.DataFrame(pixels).rank().sum(axis=1)
    table = pd.DataFrame({"row": test, "drive": frames.labels["episode"].to_numpy()[test], "content": content})
    table = table.sort_values(["content", "row"], ascending=[False, True])
    table["turn"] = table.groupby("drive").cumcount()
    chosen = table.sort_values("turn", kind="stable")["row"].head(SAMPLES)
    return np.sort(chosen.to_numpy(np.int64))


def paint_samples(module: MultiHeadAutoencoder, frames: Frames, rows: Indices) -> Arrays:
    """Return inputs, outputs and targets of some frames, uint8, as `CellResult.samples` documents."""
    images, masks = torch.from_numpy(frames.images[rows]), torch.from_numpy(frames.masks[rows])
    module.eval()
    with torch.inference_mode():
        outputs = {head: logits.sigmoid() for head, logits in module(to_float(images)).items()}
    samples = {"input": images.numpy()}
    for head, output in outputs.items():
        painted = output.mul(255).round().to(torch.uint8).permute(0, 2, 3, 1)
        samples[f"{head}_output"] = painted.squeeze(-1).contiguous().numpy()
    for head, target in unpack(masks, mask_places(outputs)).items():
        samples[f"{head}_target"] = target.mul(255).to(torch.uint8).squeeze(1).numpy()
    return samples


def encode(
    weights: Mapping[str, NDArray[Any]], images: Bytes, indices: Indices, *, device: str = "cpu", batch: int = 256
) -> NDArray[np.float32]:
    """Return latents z [N, 64] float32 of some rows of `images` [.., 64, 64, 3] uint8; the mean when variational.

    Always computed in float32, so that z depends on the precision of training only through the weights.
    Raises BadInputError when the weights are not an Encoder's, or the device is not there.
    """
    target = check_device(device)
    encoder = encoder_of(weights).to(target)
    z = np.empty((len(indices), LATENT), np.float32)
    with torch.inference_mode():
        for start in range(0, len(indices), batch):
            part = torch.from_numpy(images[indices[start : start + batch]]).to(target)
            z[start : start + batch] = encoder(to_float(part)).float().numpy(force=True)
    return z
