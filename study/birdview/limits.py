"""The speed limit that holds where a vehicle is."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from sklearn.neighbors import KDTree

from study.birdview.renderer import Moments
from study.episode.schema import Episode, Lane

SPACING = 2.0  # between points of a lane's centre line [m]
TURNED = 10.0  # a lane in the opposite direction counts as twice this much farther away [m]

Floats = NDArray[np.float64]


class Limits:
    """The speed limits of a map."""

    def __init__(self, lanes: Sequence[Lane]) -> None:
        self._limits = np.array([np.nan if lane.speed_limit is None else lane.speed_limit for lane in lanes])
        self._tree: KDTree | None = None
        if len(np.unique(self._limits)) > 1:
            lines = [_line(lane) for lane in lanes]
            self._owner = np.repeat(np.arange(len(lines)), [len(line) for line in lines])
            self._tree = KDTree(np.concatenate(lines))

    def of(self, episode: Episode, moments: Moments) -> NDArray[np.float32]:
        """Return the limit [M] [m/s] of the lane nearest to each vehicle in place and direction, NaN if unknown."""
        if self._tree is None:
            return np.full(len(moments), self._limits[0] if len(self._limits) else np.nan, np.float32)
        at = tuple(moments.T)
        heading = episode.heading[at].astype(np.float64)
        seen = np.stack([episode.x[at], episode.y[at], TURNED * np.cos(heading), TURNED * np.sin(heading)], axis=1)
        nearest = self._tree.query(seen, return_distance=False)[:, 0]
        here: NDArray[np.float32] = self._limits[self._owner[nearest]].astype(np.float32)
        return here


def _line(lane: Lane) -> Floats:
    """Return points of a lane's centre line and its direction there [P, 4] [m]."""
    centre = np.asarray(lane.centre, np.float64)
    steps = np.diff(centre, axis=0)
    lengths = np.hypot(*steps.T)
    along = np.concatenate([[0.0], np.cumsum(lengths)])
    s = np.linspace(0, along[-1], max(2, int(np.ceil(along[-1] / SPACING)) + 1))
    part = np.clip(np.searchsorted(along, s, side="right") - 1, 0, len(steps) - 1)
    direction = steps[part] / np.maximum(lengths[part], 1e-9)[:, None]
    places = np.stack([np.interp(s, along, centre[:, axis]) for axis in (0, 1)], axis=1)
    return np.concatenate([places, TURNED * direction], axis=1)
