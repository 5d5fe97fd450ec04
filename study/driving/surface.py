"""Where boxes of vehicles lie on the lanes of a map."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from study.episode.schema import Lane

Floats = NDArray[np.float64]

CHUNK = 256  # points whose distances are computed together


def off_road(points: Floats, lanes: Sequence[Lane], most: float) -> NDArray[np.bool_]:
    """Return whether points [P, 2] lie more than `most` [m] beyond the edge of every lane.

    Points that follow each other lie near each other: only lanes around those of a chunk are looked at.
    """
    low, high = (np.array([getattr(lane.centre, end)(axis=0) for lane in lanes]) for end in ("min", "max"))
    reach = np.array([lane.width / 2 for lane in lanes])[:, None] + most + 1
    off = np.ones(len(points), bool)
    for begin in range(0, len(points), CHUNK):
        part = points[begin : begin + CHUNK]
        near = ((low - reach <= part.max(axis=0)) & (high + reach >= part.min(axis=0))).all(axis=1)
        close = [lanes[number] for number in np.flatnonzero(near).tolist()]
        if close:
            off[begin : begin + CHUNK] = (beyond_lanes(part, close) > most).all(axis=1)
    return off


def beyond_lanes(points: Floats, lanes: Sequence[Lane]) -> Floats:
    """Return how far points [P, 2] lie beyond the edge of each lane [P, lanes] m; not above 0 on the lane."""
    starts = np.concatenate([lane.centre[:-1] for lane in lanes])
    ways = np.concatenate([np.diff(lane.centre, axis=0) for lane in lanes])
    first = np.cumsum([0] + [len(lane.centre) - 1 for lane in lanes[:-1]])
    squares = np.maximum((ways * ways).sum(axis=1), 1e-12)
    half = np.array([lane.width / 2 for lane in lanes])
    beyond = np.empty((len(points), len(lanes)))
    for begin in range(0, len(points), CHUNK):
        away = points[begin : begin + CHUNK, None] - starts
        share = ((away * ways).sum(axis=2) / squares).clip(0, 1)
        away -= share[..., None] * ways
        distance = np.sqrt((away * away).sum(axis=2))
        beyond[begin : begin + CHUNK] = np.minimum.reduceat(distance, first, axis=1) - half
    return beyond
