"""Who is at fault in a collision, by nuPlan's rule (metric no_ego_at_fault_collisions of nuplan-devkit)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from study.birdview.targets import corners
from study.driving.surface import beyond_lanes
from study.episode.schema import Lane
from study.sim.dynamics import DT
from study.sim.geometry import LENGTH, WIDTH

Floats = NDArray[np.float64]

STOPPED = 0.05  # [m/s]
BEHIND = np.deg2rad(150)  # an agent farther from the ego's heading than this is behind it


def collision_kind(ego: Floats, other: Floats, size: tuple[float, float] = (LENGTH, WIDTH)) -> str:
    """Return "stopped ego", "stopped other", "rear", "front" or "lateral", from poses x, y, heading and speed.

    `size` is the other's length and width [m].

    In the front, the other's box meets the ego's front bumper, now or within a step: highway-env's collisions are
    those of the next step, too.
    """
    if abs(ego[3]) <= STOPPED:
        return "stopped ego"
    if abs(other[3]) <= STOPPED:
        return "stopped other"
    towards = other[:2] - ego[:2]
    ahead = towards @ [np.cos(ego[2]), np.sin(ego[2])] / max(float(np.hypot(*towards)), 1e-9)
    if np.arccos(np.clip(ahead, -1, 1)) > BEHIND:
        return "rear"
    return (
        "front" if any(_meets_bumper(_moved(ego, time), _moved(other, time), size) for time in (0, DT)) else "lateral"
    )


def at_fault(ego: Floats, other: Floats, lanes: Sequence[Lane], size: tuple[float, float] = (LENGTH, WIDTH)) -> bool:
    """Return whether the ego is at fault; `size` is the other's length and width [m].

    It is when it hits with its front or hits what stands, and when it is hit from the side while it is not within one
    lane; never while it stands, and not when it is hit from behind.
    """
    kind = collision_kind(ego, other, size)
    if kind == "lateral":
        return not (beyond_lanes(corners(ego, LENGTH, WIDTH), lanes) <= 0).all(axis=0).any()
    return kind in {"front", "stopped other"}


def _moved(pose: Floats, time: float) -> Floats:
    way = pose[3] * time
    moved: Floats = pose + np.array([way * np.cos(pose[2]), way * np.sin(pose[2]), 0, 0])
    return moved


def _meets_bumper(ego: Floats, other: Floats, size: tuple[float, float]) -> bool:
    """Return whether a point of the ego's front bumper, at most 0.1 m from the next, lies in the other's box."""
    left, right = corners(ego, LENGTH, WIDTH)[:2]
    points: Any = left + np.linspace(0, 1, 21)[:, None] * (right - left) - other[:2]
    c, s = np.cos(other[2]), np.sin(other[2])
    along, aside = np.abs(points @ [c, s]), np.abs(points @ [-s, c])
    return bool(((along <= size[0] / 2) & (aside <= size[1] / 2)).any())
