"""A baseline: policies that are given the ego's true speed, and nothing else. See docs/extend/baseline.md."""

from __future__ import annotations

import numpy as np

from study.baselines.inputs import BaselineInputs, Z
from study.config.baselines import Baseline
from study.config.paper import LATENT


def speed_alone(inputs: BaselineInputs) -> Z:
    """Return z [N, 64]: the speed [m/s], and zeros."""
    labels = inputs.store.policy.labels
    z = np.zeros((len(labels), LATENT), np.float32)
    z[:, 0] = labels["speed"]
    return z


BASELINES = (
    Baseline(
        "speed",
        "speed alone",
        "the ego's true speed, and nothing else",
        "examples.speed_baseline:speed_alone",
        "#7A5195",
    ),
)
