"""Baselines that see no image: the last command, and the true state."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from study.baselines.inputs import BaselineInputs, Z, learned
from study.config.paper import LATENT
from study.data.true_state import Columns, scaled_state, state_scale, stored_state
from study.products import Arrays


def last_command(inputs: BaselineInputs) -> Z:
    """Return the expert's command of one step ago: steering, and the class of acceleration as 0 and 1."""
    labels = inputs.store.policy.labels
    return command_numbers(labels["last_steering"].to_numpy(), labels["last_acceleration"].to_numpy())


def command_numbers(steering: NDArray[np.floating[Any]], level: NDArray[np.integer[Any]]) -> Z:
    """Return what policies are given of commands: labels of steering [N] and classes of acceleration [N]."""
    z = np.zeros((len(steering), LATENT), np.float32)
    z[:, 0] = steering
    z[np.arange(len(z)), 1 + level] = 1
    return z


def true_state(inputs: BaselineInputs) -> Z:
    """Return what the expert decides its acceleration by. Raises BadInputError when the drives are gone."""
    columns = _stored(inputs)
    return scaled_state(columns, learned(inputs, lambda: _scale(inputs, columns)))


def true_state_scale(inputs: BaselineInputs) -> Arrays:
    """Return what the state of a drive is scaled by."""
    return learned(inputs, lambda: _scale(inputs, _stored(inputs)))


def _stored(inputs: BaselineInputs) -> Columns:
    return stored_state(inputs.store.policy.labels, inputs.store.manifest["sources"]["policy"], inputs.drives)


def _scale(inputs: BaselineInputs, columns: Columns) -> Arrays:
    return state_scale(columns, inputs.store.policy.labels["train"].to_numpy())
