"""Baselines at the wheel: the same numbers that their policies were trained on, of what is seen while driving.

Each function is given the `BaselineInputs` of its cell, and returns the function from what is seen to what its policies
are given. The record of a baseline names it (`study.config.baselines`).
"""

from __future__ import annotations

from study.baselines.commands import command_numbers, true_state_scale
from study.baselines.images import image_projection, trail_projection, untrained_weights
from study.baselines.inputs import BaselineInputs
from study.baselines.supervised import supervised_weights
from study.data.true_state import scaled_state
from study.driving.actors import image_encoder
from study.driving.observations import Encode


def untrained(inputs: BaselineInputs) -> Encode:
    """See `study.baselines.images.untrained`."""
    return image_encoder(untrained_weights(inputs))


def image_components(inputs: BaselineInputs) -> Encode:
    """See `study.baselines.images.image_components`."""
    project = image_projection(inputs)
    return lambda seen: project(seen.image)


def trail_components(inputs: BaselineInputs) -> Encode:
    """See `study.baselines.images.trail_components`."""
    project = trail_projection(inputs)
    return lambda seen: project(seen.image)


def last_command(inputs: BaselineInputs) -> Encode:
    """See `study.baselines.commands.last_command`; at the wheel it is the policy's own, as it was applied."""
    del inputs
    return lambda seen: command_numbers(seen.steering, seen.level)


def supervised(inputs: BaselineInputs) -> Encode:
    """See `study.baselines.supervised`."""
    return image_encoder(supervised_weights(inputs))


def true_state(inputs: BaselineInputs) -> Encode:
    """See `study.baselines.commands.true_state`."""
    scale = true_state_scale(inputs)
    return lambda seen: scaled_state(seen.state(), scale)
