"""Baselines that see no image: the last command, and the true state."""

from __future__ import annotations

import numpy as np

from study.baselines.inputs import BaselineInputs, Z
from study.config.paper import LATENT
from study.data import true_state as state


def last_command(inputs: BaselineInputs) -> Z:
    """Return the expert's command of one step ago: steering, and the class of acceleration as 0 and 1."""
    labels = inputs.store.policy.labels
    z = np.zeros((len(labels), LATENT), np.float32)
    z[:, 0] = labels["last_steering"]
    z[np.arange(len(z)), 1 + labels["last_acceleration"].to_numpy()] = 1
    return z


def true_state(inputs: BaselineInputs) -> Z:
    """Return what the expert decides its acceleration by. Raises BadInputError when the drives are gone."""
    sources = inputs.store.manifest["sources"]["policy"]
    return state.true_state(inputs.store.policy.labels, sources, inputs.drives)
