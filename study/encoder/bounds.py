"""What part of a head's loss can be reduced: the entropy of its targets, and the loss of a constant picture.

Cross-entropy against grey targets cannot fall below their entropy: rec's loss of 0.218 on a set whose entropy is 0.198
has 0.020 left to reduce. A head whose test loss is above that of the mean picture has learned nothing of its input.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from study.config.heads import HEAD_SETS, HEADS, IMAGE_TARGET
from study.data.frames import Frames
from study.encoder.inputs import Bytes, Indices, mask_places

Array = NDArray[np.float64]
BLOCK = 512  # frames at once: 6 MB of images
LEVELS = 256  # of a stored number; a mask has the first and the last


def loss_bounds(frames: Frames, heads: str) -> dict[str, dict[str, float]]:
    """Return entropy and constant of each head of a set, as means over the numbers of the test split.

    `entropy`: loss of the targets as their own prediction, 0 for masks. `constant`: loss of one picture for all frames,
    the mean of the targets of the complete train split, to which half a white and half a black frame are added: a pixel
    that is always black there would else cost infinitely much where it is not.
    """
    return {head: _bounds(frames, head) for head in HEAD_SETS[heads].heads}


def _bounds(frames: Frames, head: str) -> dict[str, float]:
    train, test = frames.indices("train"), frames.indices("test")
    total, _ = _moments(frames, head, train)
    constant = (total + 0.5) / (len(train) + 1)
    mean, square = (moment / len(test) for moment in _moments(frames, head, test))
    if HEADS[head].loss == "squared-error":
        return {"entropy": 0.0, "constant": float((square - 2 * constant * mean + constant**2).mean())}
    levels = _histogram(frames, head, test)
    grey = np.arange(LEVELS) / (LEVELS - 1)
    return {
        "entropy": float(levels @ _cross_entropy(grey, grey) / levels.sum()),
        "constant": float(_cross_entropy(mean, constant).mean()),
    }


def _cross_entropy(target: Array, prediction: Array) -> Array:
    """Return the binary cross-entropy, number by number; 0 log 0 is 0."""
    with np.errstate(divide="ignore", invalid="ignore"):
        ones, zeros = target * np.log(prediction), (1 - target) * np.log1p(-prediction)
    return -np.where(target > 0, ones, 0.0) - np.where(target < 1, zeros, 0.0)


def _moments(frames: Frames, head: str, rows: Indices) -> tuple[Array, Array]:
    """Return the sums over these frames of a head's targets in [0, 1], and of their squares, pixel by pixel."""
    total = square = np.float64(0)
    for block in _blocks(frames, head, rows):
        total = total + block.sum(0, dtype=np.uint32) / (LEVELS - 1)
        if HEADS[head].loss == "squared-error":
            square = square + np.square(block, dtype=np.uint32).sum(0) / (LEVELS - 1) ** 2
    return np.asarray(total, np.float64), np.asarray(square, np.float64)


def _histogram(frames: Frames, head: str, rows: Indices) -> Array:
    """Return how many of the targets' numbers have each of the 256 levels."""
    counts = np.zeros(LEVELS, np.int64)
    for block in _blocks(frames, head, rows):
        counts += np.bincount(block.reshape(-1), minlength=LEVELS)
    return counts.astype(np.float64)


def _blocks(frames: Frames, head: str, rows: Indices) -> Iterator[Bytes]:
    """Yield a head's targets [B, ..] uint8, from 0 to 255, a block of frames at a time."""
    for start in range(0, len(rows), BLOCK):
        part = rows[start : start + BLOCK]
        if HEADS[head].target == IMAGE_TARGET:
            yield frames.images[part]
        else:
            yield np.unpackbits(frames.masks[part, mask_places([head])[head]], axis=-1) * np.uint8(LEVELS - 1)
