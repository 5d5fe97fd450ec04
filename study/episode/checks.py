"""Check that an Episode is what its format promises."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from study.config.paper import ACCELERATIONS
from study.episode.schema import BORDERS, LABELS, OPTIONAL_FLOATS, Episode
from study.errors import BadInputError

REACH = 10_000.0  # [m] within which float32 keeps the millimetre


def check_episode(episode: Episode, source: str) -> None:
    """Raise BadInputError, naming field, step and agent, when an Episode holds impossible values."""

    def refuse(what: str) -> None:
        raise BadInputError(f"{source}: {what}")

    if not (math.isfinite(episode.rate_hz) and episode.rate_hz > 0):
        refuse(f"rate_hz is {episode.rate_hz}; it must be above 0")
    if episode.labels not in LABELS:
        refuse(f"labels is '{episode.labels}'; choose from {', '.join(LABELS)}")
    for name, items in (("agent", episode.agents), ("lane", episode.lanes), ("light", episode.lights)):
        ids = [item.id for item in items]
        if len(set(ids)) != len(ids):
            refuse(f"two {name}s share an id")
    for agent in episode.agents:
        if not (0 < agent.length < 100 and 0 < agent.width < 20):
            refuse(f"agent {agent.id} is {agent.length} m long and {agent.width} m wide")
    _check_map(episode, refuse)
    _check_states(episode, refuse)
    for agent, route in zip(episode.agents, episode.routes, strict=True):
        if not np.isfinite(route).all():
            refuse(f"routes.parquet: the route of agent {agent.id} is not finite")


def _check_map(episode: Episode, refuse: Any) -> None:
    for lane in episode.lanes:
        if len(lane.centre) < 2 or not np.isfinite(lane.centre).all():
            refuse(f"lane {lane.id}: the centre line needs two or more finite points")
        if not 0 < lane.width < 100:
            refuse(f"lane {lane.id}: the width is {lane.width} m")
        for border in (lane.left, lane.right):
            if border not in BORDERS:
                refuse(f"lane {lane.id}: border '{border}'; choose from {', '.join(BORDERS)}")
    lane_ids = {lane.id for lane in episode.lanes}
    for light in episode.lights:
        if light.lane is not None and light.lane not in lane_ids:
            refuse(f"light {light.id} governs lane {light.lane}, which the map does not have")
        if not np.isfinite(light.stop_line).all():
            refuse(f"light {light.id}: the stop line is not finite")


def _check_states(episode: Episode, refuse: Any) -> None:
    present = episode.present

    def where(bad: NDArray[np.bool_], name: str, rule: str) -> None:
        if bad.any():
            step, column = np.argwhere(bad)[0]
            row = int(present.reshape(-1)[: step * present.shape[1] + column].sum())
            value = getattr(episode, name)[step, column]
            agent = episode.agents[column].id
            refuse(f"states.parquet, row {row}, field '{name}' (step {step}, agent {agent}): {value} {rule}")

    for name in ("x", "y", "heading", "speed"):
        where(present & ~np.isfinite(getattr(episode, name)), name, "is not a finite number")
    for name in OPTIONAL_FLOATS:
        where(present & np.isinf(getattr(episode, name)), name, "is infinite")
    for name in ("x", "y"):
        where(present & (np.abs(getattr(episode, name)) > REACH), name, f"is farther than {REACH:g} m from the origin")
    where(present & (np.abs(episode.speed) > 120), "speed", "is above 120 m/s; is the unit m/s?")
    known = present & ~np.isnan(episode.acceleration)
    where(known & ~np.isin(episode.acceleration, ACCELERATIONS), "acceleration", f"is not one of {ACCELERATIONS}")
    if present.any():
        _check_units(episode, where)


def _check_units(episode: Episode, where: Any) -> None:
    """Compare speed with displacement: a drive in km/h or in feet must not pass for one in m/s and metres."""
    both = episode.present[1:] & episode.present[:-1]
    with np.errstate(invalid="ignore"):
        moved = np.hypot(np.diff(episode.x, axis=0), np.diff(episode.y, axis=0)) * episode.rate_hz
        speed = (np.abs(episode.speed[1:]) + np.abs(episode.speed[:-1])) / 2
    moved, speed = np.where(both, moved, 0), np.where(both, speed, 0)
    if speed.sum() + moved.sum() < both.sum() * 0.2:  # hardly anything moves: there is nothing to compare
        return
    ratio = speed.sum() / max(float(moved.sum()), 1e-9)
    if not 2 / 3 < ratio < 1.5:
        bad = np.zeros_like(episode.present)
        bad[1:] = both & (np.abs(speed - moved) == np.abs(speed - moved).max())
        where(bad, "speed", f"does not fit the positions: speeds are {ratio:.2f} times the distance moved per second")
