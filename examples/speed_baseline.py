"""A baseline: policies that are given the ego's true speed, and nothing else. See docs/extend/baseline.md."""

from __future__ import annotations

import numpy as np

from study.baselines.inputs import BaselineInputs, Z
from study.config.baselines import Baseline
from study.config.paper import LATENT
from study.driving.observations import Encode, Observations


def speed_alone(inputs: BaselineInputs) -> Z:
    """Return z [N, 64]: the speed [m/s], and zeros."""
    labels = inputs.store.policy.labels
    z = np.zeros((len(labels), LATENT), np.float32)
    z[:, 0] = labels["speed"]
    return z


def speed_at_the_wheel(inputs: BaselineInputs) -> Encode:
    """Return the function that gives drivers the same, of what they see."""
    del inputs

    def give(seen: Observations) -> Z:
        z = np.zeros((len(seen.speeds), LATENT), np.float32)
        z[:, 0] = seen.speeds[:, 0]
        return z

    return give


BASELINES = (
    Baseline(
        "speed",
        "speed alone",
        "the ego's true speed, and nothing else",
        "examples.speed_baseline:speed_alone",
        "#7A5195",
        driving="examples.speed_baseline:speed_at_the_wheel",
        sees=False,
    ),
)
