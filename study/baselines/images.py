"""Baselines that see the image, and learn nothing from driving."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sklearn.decomposition import PCA

from study.baselines.inputs import BaselineInputs, Z
from study.config.paper import LATENT
from study.encoder.latents import encode
from study.encoder.networks import untrained_encoder
from study.errors import BadInputError
from study.randomness import rng

FITTED = 5_000  # images that components are fitted on: 250 MB
BLOCK = 2_000  # images that are projected at once
TRAIL_ROWS = slice(16, 64)  # of the image, where the trail and a little way ahead lie

Images = NDArray[np.uint8]
Floats = NDArray[np.float32]


def untrained(inputs: BaselineInputs) -> Z:
    """Return the latents of an encoder with its initial weights, those that `rec` with this seed starts from."""
    weights = {name: value.numpy() for name, value in untrained_encoder(inputs.seed).state_dict().items()}
    images = inputs.store.policy.images
    return encode(weights, images, np.arange(len(images)), device=inputs.device)


def image_components(inputs: BaselineInputs) -> Z:
    """Return the first 64 principal components of the image."""
    return _components(inputs, lambda images: images.reshape(len(images), -1).astype(np.float32))


def trail_components(inputs: BaselineInputs) -> Z:
    """Return the first 64 principal components of the ego's own trail alone.

    Raises BadInputError for frames without a trail.
    """
    if not inputs.settings.birdview.history or not trail(inputs.store.policy.images[:BLOCK]).std(axis=0).any():
        raise BadInputError(
            "baseline trail-pca: these frames show no trail of the ego; set --birdview.history to 1 or more, or leave "
            "the baseline out of --baselines"
        )
    return _components(inputs, trail)


def trail(images: Images) -> Floats:
    """Return how much bluer than anything else each pixel is [B, 48 * 64], of images [B, 64, 64, 3]."""
    red, green, blue = (images[:, TRAIL_ROWS, :, channel].astype(np.float32) for channel in range(3))
    excess: Floats = np.maximum(blue - np.maximum(red, green), 0).reshape(len(images), -1)
    return excess


def _components(inputs: BaselineInputs, view: Callable[[Images], Floats]) -> Z:
    """Return principal components of the policy set, fitted on training images of the encoder set."""
    generator = rng(inputs.seed, "principal components")
    frames = inputs.store.encoder
    rows = np.sort(generator.permutation(frames.indices("train"))[:FITTED])
    fitted = view(frames.images[rows])
    count = min(LATENT, *fitted.shape)
    components = PCA(count, svd_solver="randomized", random_state=int(generator.integers(2**31))).fit(fitted)
    images: Any = inputs.store.policy.images
    z = np.zeros((len(images), LATENT), np.float32)
    for start in range(0, len(images), BLOCK):
        part = slice(start, start + BLOCK)
        z[part, :count] = components.transform(view(images[part]))
    return z
