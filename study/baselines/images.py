"""Baselines that see the image, and learn nothing from driving."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sklearn.decomposition import PCA

from study.baselines.inputs import BaselineInputs, Z, learned
from study.config.paper import LATENT
from study.encoder.latents import encode
from study.encoder.networks import untrained_encoder
from study.errors import BadInputError
from study.products import Arrays
from study.randomness import rng

FITTED = 5_000  # images that components are fitted on: 250 MB
BLOCK = 2_000  # images that are projected at once
TRAIL_ROWS = slice(16, 64)  # of the image, where the trail and a little way ahead lie

Images = NDArray[np.uint8]
Floats = NDArray[np.float32]
Projection = Callable[[Images], Z]  # from [B, 64, 64, 3] to [B, 64]


def untrained(inputs: BaselineInputs) -> Z:
    """Return the latents of an encoder with its initial weights, those that `rec` with this seed starts from."""
    images = inputs.store.policy.images
    return encode(untrained_weights(inputs), images, np.arange(len(images)), device=inputs.device)


def untrained_weights(inputs: BaselineInputs) -> Arrays:
    """Return the initial weights."""
    return {name: value.numpy() for name, value in untrained_encoder(inputs.seed).state_dict().items()}


def image_components(inputs: BaselineInputs) -> Z:
    """Return the first 64 principal components of the image."""
    return _of_all(inputs, image_projection(inputs))


def image_projection(inputs: BaselineInputs) -> Projection:
    """Return the function from images to the first 64 principal components of the image."""
    return _projection(inputs, lambda images: images.reshape(len(images), -1).astype(np.float32))


def trail_components(inputs: BaselineInputs) -> Z:
    """Return the first 64 principal components of the ego's own trail alone.

    Raises BadInputError for frames without a trail.
    """
    if not inputs.settings.birdview.history or not trail(inputs.store.policy.images[:BLOCK]).std(axis=0).any():
        raise BadInputError(
            "baseline trail-pca: these frames show no trail of the ego; set --birdview.history to 1 or more, or leave "
            "the baseline out of --baselines"
        )
    return _of_all(inputs, trail_projection(inputs))


def trail_projection(inputs: BaselineInputs) -> Projection:
    """Return the function from images to the first 64 principal components of the ego's own trail."""
    return _projection(inputs, trail)


def trail(images: Images) -> Floats:
    """Return how much bluer than anything else each pixel is [B, 48 * 64], of images [B, 64, 64, 3]."""
    red, green, blue = (images[:, TRAIL_ROWS, :, channel].astype(np.float32) for channel in range(3))
    excess: Floats = np.maximum(blue - np.maximum(red, green), 0).reshape(len(images), -1)
    return excess


def _projection(inputs: BaselineInputs, view: Callable[[Images], Floats]) -> Projection:
    weights = learned(inputs, lambda: _principal_components(inputs, view))
    count = len(weights["components"])
    components = PCA(count)
    components.components_, components.mean_ = weights["components"], weights["mean"]

    def project(images: Images) -> Z:
        z = np.zeros((len(images), LATENT), np.float32)
        z[:, :count] = components.transform(view(images))
        return z

    return project


def _principal_components(inputs: BaselineInputs, view: Callable[[Images], Floats]) -> Arrays:
    """Return principal components of training images of the encoder set, and their mean."""
    generator = rng(inputs.seed, "principal components")
    frames = inputs.store.encoder
    rows = np.sort(generator.permutation(frames.indices("train"))[:FITTED])
    fitted = view(frames.images[rows])
    count = min(LATENT, *fitted.shape)
    found = PCA(count, svd_solver="randomized", random_state=int(generator.integers(2**31))).fit(fitted)
    return {"components": found.components_, "mean": found.mean_}


def _of_all(inputs: BaselineInputs, project: Projection) -> Z:
    images: Any = inputs.store.policy.images
    blocks = range(0, len(images), BLOCK)
    return np.concatenate([project(images[start : start + BLOCK]) for start in blocks])
