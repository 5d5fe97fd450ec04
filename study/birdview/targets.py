"""Targets of the heads: one function for each mask, from a moment of an Episode to the polygons that are set in it.

A target returns convex polygons in the picture; the `Renderer` fills them and sets the mask where they cover at least
half of a pixel. The target of a head is named in its record in `study.config.heads`.
"""

from __future__ import annotations

import functools
import importlib
from collections.abc import Callable, Sequence
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from study.config.settings import BirdviewSettings
from study.episode.schema import VEHICLE, Agent, Episode
from study.errors import BadInputError

FRACTION_BITS = 8  # of the coordinates given to cv2

Floats = NDArray[np.float64]
Polygon = NDArray[np.int32]


class Moment(NamedTuple):
    """A moment of an Episode as targets see it.

    `agent` is the index of the ego. `others` and `ego` are the boxes of the other agents and of the ego at the next
    `settings.future` poses, in the present ego frame.
    """

    episode: Episode
    step: int
    agent: int
    settings: BirdviewSettings
    affine: Floats  # [2, 3], world [m] -> pixels
    others: Sequence[Polygon]
    ego: Sequence[Polygon]

    def polygon(self, points: Floats) -> Polygon:
        """Return a polygon in the picture from its corners [P, 2] in the world [m]."""
        return fixed_point(points, self.affine)


Target: TypeAlias = Callable[[Moment], Sequence[Polygon]]


def pred(moment: Moment) -> Sequence[Polygon]:
    """Return where the other vehicles, cyclists and pedestrians will be (Sec. III-B)."""
    return moment.others


def plan(moment: Moment) -> Sequence[Polygon]:
    """Return where the ego will be (Sec. III-B)."""
    return moment.ego


@functools.cache
def find_target(name: str) -> Target:
    """Return the function of this module with that name, or the one named "module:function".

    Raises BadInputError when there is none.
    """
    module, _, function = name.rpartition(":")
    try:
        target: Target = getattr(importlib.import_module(module or __name__), function)
    except (ImportError, AttributeError) as error:
        raise BadInputError(
            f"target '{name}' cannot be used: {error}; name a function of study.birdview.targets, or 'module:function'"
        ) from error
    return target


def fixed_point(points: Floats, affine: Floats) -> Polygon:
    """Return world points [..., 2] [m] as the fixed-point pixel coordinates of cv2."""
    fixed: Polygon = np.rint((points @ affine[:, :2].T + affine[:, 2]) * (1 << FRACTION_BITS)).astype(np.int32)
    return fixed


def painted_sizes(agents: Sequence[Agent], least: float) -> Floats:
    """Return length and width [A, 2] m as painted: of cyclists and pedestrians at least `least`, or they vanish."""
    sizes = [(agent.length, agent.width) for agent in agents]
    least_of = [[0.0 if agent.kind == VEHICLE else least] for agent in agents]
    painted: Floats = np.maximum(np.array(sizes).reshape(-1, 2), np.array(least_of).reshape(-1, 1))
    return painted


def corners(pose: Floats, length: float | Floats, width: float | Floats) -> Floats:
    """Return the corners [..., 4, 2] m of boxes with poses [..., 3 or more]: x, y, heading; the front's come first.

    `length` and `width` [m] are of all boxes, or of each [...].
    """
    x, y, heading = (pose[..., k, None] for k in range(3))
    along = np.array([1, 1, -1, -1]) * np.asarray(length)[..., None] / 2
    aside = np.array([1, -1, -1, 1]) * np.asarray(width)[..., None] / 2
    c, s = np.cos(heading), np.sin(heading)
    return np.stack([x + along * c - aside * s, y + along * s + aside * c], axis=-1)
