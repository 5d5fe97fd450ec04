"""Routes of vehicles as polylines over lanes, and the lights on them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from study.episode.adapt import progress_along
from study.episode.rows import Rows

CHANGE = 20.0  # a change of lane on a route is a straight line of about this length [m]
JOINED = 0.5  # ends of lines nearer than this are one point [m]

Points = NDArray[np.float64]


def length(line: Points) -> float:
    """Return the length of a polyline [m]."""
    return float(np.hypot(*np.diff(line, axis=0).T).sum())


def cut_front(line: Points, metres: float) -> Points:
    """Return a polyline without its first metres; at least its last half stays."""
    along = np.concatenate([[0.0], np.hypot(*np.diff(line, axis=0).T).cumsum()])
    start = min(metres, along[-1] / 2)
    first = np.array([[np.interp(start, along, line[:, axis]) for axis in (0, 1)]])
    return np.concatenate([first, line[along > start]])


def chain(lines: Sequence[Points]) -> tuple[Points, list[float]]:
    """Return polylines in driving order as one, and the arclength at which each of them ends [m].

    Where a line does not start at the end of the one before, the lane is changed: its first metres are left out.
    """
    points = np.empty((0, 2))
    ends: list[float] = []
    total = 0.0
    for line in lines:
        if len(points):
            joined = np.hypot(*(line[0] - points[-1])) < JOINED
            line = line[1:] if joined else cut_front(line, CHANGE)  # noqa: PLW2901
            total += length(np.concatenate([points[-1:], line]))
        else:
            total = length(line)
        points = np.concatenate([points, line])
        ends.append(total)
    return points, ends


def add_progress(
    rows: Rows, agents: int, routes: Sequence[Points], stops: Sequence[Sequence[tuple[float, int]]]
) -> None:
    """Add the columns route_s, light and light_distance to rows that are sorted by step.

    `stops` are, for each agent, the arclength of each stop line on its route [m] and the index of the light, in order.
    """
    count = len(rows["step"])
    progress, distance = np.full(count, np.nan), np.full(count, np.nan)
    light = np.full(count, -1, np.int32)
    order = np.argsort(rows["agent"], kind="stable")
    edges = np.searchsorted(rows["agent"][order], np.arange(agents + 1))
    for agent in range(agents):
        at = order[edges[agent] : edges[agent + 1]]
        route = routes[agent]
        if len(route) < 2 or not len(at):
            continue
        along = progress_along(route, np.stack([rows["x"][at], rows["y"][at]], axis=1))
        progress[at] = along
        if not stops[agent]:
            continue
        lines = np.array([s for s, _ in stops[agent]])
        lights = np.array([light for _, light in stops[agent]])
        following = np.searchsorted(lines, along)  # NaN comes after all
        ahead = np.isfinite(along) & (following < len(lines))
        light[at[ahead]] = lights[following[ahead]]
        distance[at[ahead]] = lines[following[ahead]] - along[ahead]
    rows |= {"route_s": progress, "light": light, "light_distance": distance}
