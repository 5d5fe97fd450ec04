"""Standardise latents before policies see them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

Arrays = dict[str, NDArray[Any]]


def normalisation(z_train: NDArray[np.float32], how: str) -> Arrays:
    """Return the numbers that `normalise` needs, from the policy train split only (docs/paper.md)."""
    mean, std = np.zeros(z_train.shape[1], np.float32), np.ones(z_train.shape[1], np.float32)
    if how == "zscore":
        mean, std = z_train.mean(0, dtype=np.float64), z_train.std(0, dtype=np.float64)
        std = np.where(std > 0, std, 1.0)  # a dead latent number stays 0
    return {
        "z_mean": mean.astype(np.float32),
        "z_std": std.astype(np.float32),
        "z_l2": np.array([how == "l2"], np.uint8),
    }


def normalise(weights: Mapping[str, NDArray[Any]], z: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return what policies are given [N, Z] as they see it."""
    scaled: NDArray[np.float32] = (z - weights["z_mean"]) / weights["z_std"]
    if weights["z_l2"][0]:
        scaled /= np.maximum(np.linalg.norm(scaled, axis=1, keepdims=True), np.finfo(np.float32).tiny)
    return scaled
