"""Routes of vehicles as polylines over lanes, and the lights on them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from study.episode.rows import Rows
from study.episode.schema import PEDESTRIAN, Agent
from study.intake.adapt import progress_along

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


NEAR = 4.0  # a vehicle is on a lane whose centre is nearer than this [m]
TURNED = np.pi / 3  # and whose direction differs by less than this [rad]
SWITCH = 15.0  # cost of going to a lane that does not follow, in squared metres
PICKED = 0.5  # way between moments at which lanes are looked for [s]


class LaneMap:
    """Centre lines of lanes, to find on which of them vehicles drive; `onward` lists the lanes that follow each."""

    def __init__(self, centres: Sequence[Points], onward: Sequence[Sequence[int]]) -> None:
        self.centres, self.onward = centres, [set(lanes) for lanes in onward]
        lines = [_dense(line) for line in centres]
        self._points = np.concatenate([*lines, np.empty((0, 2))])
        directions = [np.arctan2(*np.gradient(line, axis=0).T[::-1]) for line in lines]
        self._direction = np.concatenate([*directions, np.empty(0)])
        self._lane = np.repeat(np.arange(len(lines)), [len(line) for line in lines])

    def visits(self, places: Points, headings: NDArray[np.float64]) -> list[int]:
        """Return the lanes that a vehicle drove on one after the other; of lanes side by side, the last."""
        best: dict[int, tuple[float, list[int]]] = {}
        for place, heading in zip(places, headings, strict=True):
            here = self._candidates(place, heading)
            if not here:
                continue
            following: dict[int, tuple[float, list[int]]] = {}
            for lane, cost in here.items():
                options = [(total + self._step(way[-1], lane), way) for total, way in best.values()]
                total, way = min(options, key=lambda option: option[0], default=(0.0, []))
                following[lane] = total + cost, way if way[-1:] == [lane] else [*way, lane]
            best = following
        way = min(best.values(), key=lambda option: option[0], default=(0.0, []))[1]
        later = [*way[1:], None][: len(way)]
        pairs = zip(way, later, strict=True)
        return [lane for lane, after in pairs if after is None or after in self.onward[lane]]

    def _step(self, lane: int, to: int) -> float:
        return 0.0 if to == lane or to in self.onward[lane] else SWITCH

    def _candidates(self, place: Points, heading: float) -> dict[int, float]:
        """Return the squared distance to each lane that the vehicle may be on."""
        box = np.flatnonzero((np.abs(self._points - place) < NEAR).all(axis=1))
        turned = np.abs(np.mod(self._direction[box] - heading + np.pi, 2 * np.pi) - np.pi)
        box = box[turned < TURNED]
        squares = ((self._points[box] - place) ** 2).sum(axis=1)
        lanes: dict[int, float] = {}
        for lane, square in zip(self._lane[box].tolist(), squares.tolist(), strict=True):
            lanes[lane] = min(square, lanes.get(lane, np.inf))
        return lanes


def _dense(line: Points) -> Points:
    """Return points of a polyline about a metre apart."""
    along = np.concatenate([[0.0], np.hypot(*np.diff(line, axis=0).T).cumsum()])
    at = np.linspace(0, along[-1], max(2, int(along[-1]) + 1))
    return np.stack([np.interp(at, along, line[:, axis]) for axis in (0, 1)], axis=1)


def find_routes(
    rows: Rows, agents: Sequence[Agent], rate: float, lanes: LaneMap, lights: Mapping[int, Sequence[int]]
) -> list[Points]:
    """Add progress and lights to rows, and return each agent's way over the lanes that it took; pedestrians have none.

    `lights` are the lights at the end of lanes; of several, the first governs.
    """
    routes: list[Points] = []
    stops: list[list[tuple[float, int]]] = []
    order = np.lexsort((rows["step"], rows["agent"]))
    edges = np.searchsorted(rows["agent"][order], np.arange(len(agents) + 1))
    for number, agent in enumerate(agents):
        at = order[edges[number] : edges[number + 1]][:: max(1, round(PICKED * rate))]
        at = at[: 0 if agent.kind == PEDESTRIAN else None]
        visits = lanes.visits(np.stack([rows["x"][at], rows["y"][at]], axis=1), rows["heading"][at])
        route, ends = chain([lanes.centres[lane] for lane in visits])
        routes.append(route)
        stops.append([(end, lights[lane][0]) for lane, end in zip(visits, ends, strict=True) if lights.get(lane)])
    add_progress(rows, len(agents), routes, stops)
    return routes
