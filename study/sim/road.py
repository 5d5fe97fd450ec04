"""highway-env's network, road and vehicle, computed for all vehicles at once; without `fast`, the stock ones are used.

Spatial look-ups only find candidates: highway-env's own lane distance and polygons decide. Motion is highway-env's
formula, operation by operation. So a drive is bit-equal with and without `fast` (tests/test_sim_env.py).
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

import numpy as np
from highway_env.road.lane import AbstractLane
from highway_env.road.road import LaneIndex, Road, RoadNetwork
from highway_env.vehicle.kinematics import Vehicle
from numpy.typing import NDArray

from study.sim.geometry import Floats, Ints, Piece, Pose, true_pairs
from study.sim.town import Town, highway_lane

CELL = 4.0  # side of a cell of the grid over the town [m]
KNOWN = 9.0  # lanes this near to a cell's centre are listed with it [m]
NEAR = 20.0  # vehicles whose centres are this far apart cannot touch within a step [m]
TIE = 1e-9  # scores nearer than this are settled by highway-env's own arithmetic


class TownNetwork(RoadNetwork):
    """highway-env's network of a town, with a grid of the lanes near each cell."""

    def __init__(self, town: Town, *, fast: bool = True) -> None:
        super().__init__()
        self.fast = fast
        for strip in town.strips:
            start, end, _ = strip.index
            self.add_lane(start, end, highway_lane(strip))
        indices = [(a, b, k) for a, ends in self.graph.items() for b, lanes in ends.items() for k in range(len(lanes))]
        self.indices: list[LaneIndex] = indices  # in the order in which highway-env searches
        self.lanes: list[AbstractLane] = [self.get_lane(index) for index in indices]
        strips = {strip.index: strip.piece for strip in town.strips}
        pieces = [strips[index] for index in indices]
        self.start = np.array([(piece.x, piece.y) for piece in pieces])
        self.curvature = np.array([piece.curvature for piece in pieces])
        self.heading = np.array([piece.heading for piece in pieces])
        self.length = np.array([piece.length for piece in pieces])
        self.direction = np.stack([np.cos(self.heading), np.sin(self.heading)], axis=1)
        if fast:
            self._build_grid(pieces)

    def _build_grid(self, pieces: list[Piece]) -> None:
        """List for every cell the lanes within KNOWN of its centre, nearest first (padded with -1)."""
        lines = []  # of each lane, points at most 1 m apart
        for piece in pieces:
            x, y, _ = piece.at(np.linspace(0, piece.length, math.ceil(piece.length) + 1))
            lines.append(np.stack([x, y], axis=1))
        points = np.concatenate(lines)
        self.low = points.min(axis=0) - KNOWN
        self.cells = np.ceil((points.max(axis=0) + KNOWN - self.low) / CELL).astype(np.int64)
        columns: list[tuple[Ints, Ints, Floats]] = []
        for number, line in enumerate(lines):
            begin = ((line.min(axis=0) - KNOWN - self.low) / CELL).astype(np.int64).clip(0)
            end = np.minimum(((line.max(axis=0) + KNOWN - self.low) / CELL).astype(np.int64) + 1, self.cells)
            cx, cy = np.meshgrid(np.arange(begin[0], end[0]), np.arange(begin[1], end[1]), indexing="ij")
            centres = np.stack([cx.reshape(-1), cy.reshape(-1)], axis=1) * CELL + CELL / 2 + self.low
            dx, dy = centres[:, :1] - line[None, :, 0], centres[:, 1:] - line[None, :, 1]
            distance = np.sqrt((dx * dx + dy * dy).min(axis=1)) - 0.51  # never more than the true distance
            close = distance < KNOWN
            cell = (cx.reshape(-1) * self.cells[1] + cy.reshape(-1))[close]
            columns.append((cell, np.full(len(cell), number), distance[close]))
        cell, lane, distance = (np.concatenate(parts) for parts in zip(*columns, strict=True))
        order = np.lexsort((distance, cell))
        cell, lane, distance = cell[order], lane[order], distance[order]
        count = np.bincount(cell, minlength=int(self.cells.prod()))
        rank = np.arange(len(cell)) - np.repeat(np.cumsum(count) - count, count)
        self.near_lanes = np.full((len(count), int(count.max())), -1)
        self.near_distance = np.full(self.near_lanes.shape, np.inf)
        self.near_lanes[cell, rank], self.near_distance[cell, rank] = lane, distance

    def get_closest_lane_index(self, position: NDArray[Any], heading: float | None = None) -> LaneIndex:
        """Return the closest lane as highway-env does; with `fast`, search only the lanes near the position."""
        if not self.fast or heading is None:
            index: LaneIndex = super().get_closest_lane_index(position, heading)
            return index
        return self.indices[int(self.closest_lanes(np.asarray(position)[None], np.array([heading]))[0])]

    def closest_lanes(self, positions: Floats, headings: Floats) -> Ints:
        """Return the closest lanes of many poses, [N, 2] m and [N] rad, as positions in `indices`."""
        place = np.floor((positions - self.low) / CELL).astype(np.int64)
        outside = ((place < 0) | (place >= self.cells)).any(axis=1)
        cell = np.where(outside, 0, place[:, 0] * self.cells[1] + place[:, 1])
        lanes, distances = self.near_lanes[cell], self.near_distance[cell]
        few = min(3, lanes.shape[1])
        rows = np.repeat(np.arange(len(positions)), few)
        first = np.full((len(positions), few), np.inf)
        some = lanes[:, :few]
        first[some >= 0] = self._scores(positions, headings, rows[(some >= 0).reshape(-1)], some[some >= 0])
        bound = first.min(axis=1)  # a lane's score is never below its distance, so farther lanes cannot win
        slack = CELL / math.sqrt(2)
        rows, ranks = np.nonzero((distances <= bound[:, None] + slack + TIE) & (lanes >= 0))
        candidates = lanes[rows, ranks]
        scores = self._scores(positions, headings, rows, candidates)
        best = np.full(len(positions), np.inf)
        np.minimum.at(best, rows, scores)
        close = scores <= best[rows] + TIE
        rows, candidates = rows[close], candidates[close]
        winner = np.full(len(positions), len(self.indices))
        np.minimum.at(winner, rows, candidates)
        outside |= ~(bound + slack + TIE < KNOWN)
        tied = np.bincount(rows, minlength=len(positions)) > 1
        for row in np.flatnonzero(tied & ~outside):
            options = np.sort(candidates[rows == row])
            exact = [self.lanes[k].distance_with_heading(positions[row], headings[row]) for k in options]
            winner[row] = options[int(np.argmin(exact))]
        for row in np.flatnonzero(outside):
            index = super().get_closest_lane_index(positions[row], headings[row])
            winner[row] = self.indices.index(index)
        return winner

    def _scores(self, positions: Floats, headings: Floats, rows: Ints, lanes: Ints) -> Floats:
        """Return highway-env's `distance_with_heading` of pairs of a pose (`rows`) and a lane, up to rounding."""
        delta = positions[rows] - self.start[lanes]
        c, s = self.direction[lanes, 0], self.direction[lanes, 1]
        along, aside = delta[:, 0] * c + delta[:, 1] * s, delta[:, 1] * c - delta[:, 0] * s
        curvature = self.curvature[lanes]
        bent = np.flatnonzero(curvature)
        if len(bent):
            k = curvature[bent]
            # from the centre of the arc, in the frame of its start
            u, w = k * along[bent], 1 - k * aside[bent]
            aside[bent] = (1 - np.hypot(u, w)) / k
            along[bent] = np.arctan2(u, w) / k
        over = np.maximum(along - self.length[lanes], 0) + np.maximum(-along, 0)
        angle = headings[rows] - self.heading[lanes] - curvature * along
        turned = np.abs(np.mod(angle + np.pi, 2 * np.pi) - np.pi)
        scores: Floats = np.abs(aside) + over + turned
        return scores


class TownVehicle(Vehicle):
    """A vehicle that is looked up on the map only when something asks for its lane: the autopilot never does."""

    def on_state_update(self) -> None:
        """Forget the lane of the pose before; without `fast`, look up the new one as highway-env does."""
        self._lane_index = None
        if not self.road.network.fast:
            super().on_state_update()

    @property
    def lane_index(self) -> LaneIndex:
        """Return the closest lane."""
        if self._lane_index is None:
            self._lane_index = self.road.network.get_closest_lane_index(self.position, self.heading)
        return self._lane_index

    @lane_index.setter
    def lane_index(self, index: LaneIndex) -> None:
        self._lane_index = index

    @property
    def lane(self) -> AbstractLane:
        """Return highway-env's lane of `lane_index`."""
        return self.road.network.get_lane(self.lane_index)

    @lane.setter
    def lane(self, lane: AbstractLane) -> None:
        """Leave the lane to its index."""


class TownRoad(Road):
    """highway-env's road, whose searches over all pairs of vehicles are done with arrays."""

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self.struck: list[int] = []  # vehicles that have crashed, or will in the next step

    @property
    def fast(self) -> bool:
        """Return whether the spatial look-ups are used."""
        return bool(self.network.fast)

    def pose(self) -> Pose:
        """Return x, y [m], heading [rad] and speed [m/s] of all vehicles."""
        positions = np.concatenate([vehicle.position for vehicle in self.vehicles])
        heading = np.array([vehicle.heading for vehicle in self.vehicles], np.float64)
        speed = np.array([vehicle.speed for vehicle in self.vehicles], np.float64)
        return positions[::2].copy(), positions[1::2].copy(), heading, speed

    def pairs_within(self, distance: float, pose: Pose) -> tuple[Ints, Ints]:
        """Return all (i, j), i != j, sorted, of vehicles that are nearer to each other than `distance` [m]."""
        if self.fast:
            x, y, _, _ = pose
            dx, dy = x[:, None] - x[None], y[:, None] - y[None]
            near = dx * dx + dy * dy < distance * distance
            np.fill_diagonal(near, val=False)
            return true_pairs(near)
        number = {id(vehicle): k for k, vehicle in enumerate(self.vehicles)}
        pairs = [
            (k, number[id(other)])
            for k, vehicle in enumerate(self.vehicles)
            for other in self.close_vehicles_to(vehicle, distance, sort=False)
        ]
        both = np.array(pairs, np.int64).reshape(-1, 2)
        return both[:, 0], both[:, 1]

    def step(self, dt: float) -> None:
        """Move every vehicle by `dt` [s] and handle collisions."""
        if not self.fast:
            super().step(dt)
            return
        self.moved = self._move(dt)
        touching = self._touching(self.moved, self.near_pairs(), dt)
        for i, j in zip(*touching, strict=True):
            self.vehicles[i].handle_collisions(self.vehicles[j], dt)
        self.struck = self.find_struck(np.unique(np.concatenate([self.struck, *touching])).astype(np.int64).tolist())

    def find_struck(self, slots: Iterable[int]) -> list[int]:
        """Return which of these vehicles have crashed, or will overlap another after one more step."""
        return [k for k in slots if self.vehicles[k].crashed or self.vehicles[k].impact is not None]

    def near_pairs(self) -> tuple[Ints, Ints]:
        """Return at least the pairs, sorted, that may touch within this step."""
        return self.pairs_within(NEAR, self.moved)

    def controls(self) -> tuple[Pose, Floats, Floats]:
        """Return the pose of all vehicles, and the acceleration [m/s2] and the wheel angle [rad] that act on them."""
        push, steering = (
            np.array([vehicle.action[name] for vehicle in self.vehicles], np.float64)
            for name in ("acceleration", "steering")
        )
        return self.pose(), push, steering

    def _move(self, dt: float) -> Pose:
        """Do `Vehicle.step` for all vehicles, and return their new pose."""
        (x, y, heading, speed), push, steering = self.controls()
        odd = {*self.find_struck(self.struck), *(np.abs(speed) > TownVehicle.MAX_SPEED).nonzero()[0].tolist()}
        for k in odd:
            self.vehicles[k].act({"acceleration": float(push[k]), "steering": float(steering[k])})
            self.vehicles[k].step(dt)
        beta = np.arctan(1 / 2 * np.tan(steering))
        course = heading + beta
        x, y = x + speed * np.cos(course) * dt, y + speed * np.sin(course) * dt
        heading = heading + speed * np.sin(beta) / (TownVehicle.LENGTH / 2) * dt
        speed = speed + push * dt
        rows = zip(self.vehicles, np.stack([x, y], axis=1), heading.tolist(), speed.tolist(), strict=True)
        for k, (vehicle, position, angle, velocity) in enumerate(rows):
            if k not in odd:
                vehicle.position, vehicle.heading, vehicle.speed = position, angle, velocity
                vehicle._lane_index = None  # noqa: SLF001 - its own kind; a call of `on_state_update` would cost more
        return self.pose() if odd else (x, y, heading, speed)

    def _touching(self, pose: Pose, pairs: tuple[Ints, Ints], dt: float) -> tuple[Ints, Ints]:
        """Return which pairs i < j may touch within `dt`: no axis of the two moving boxes separates them."""
        x, y, heading, speed = pose
        i, j = pairs
        dx, dy = x[j] - x[i], y[j] - y[i]
        reach = TownVehicle.LENGTH + TownVehicle.WIDTH + np.abs(speed) * dt  # more than highway-env's two diagonals
        met = ((dx * dx + dy * dy < (reach * reach)[i]) & (i < j)).nonzero()[0]
        i, j, dx, dy = i[met], j[met], dx[met], dy[met]
        c, s = np.cos(heading), np.sin(heading)
        half_length, half_width = TownVehicle.LENGTH / 2, TownVehicle.WIDTH / 2
        apart = np.zeros(len(i), bool)
        vx, vy = (speed[i] * c[i] - speed[j] * c[j]) * dt, (speed[i] * s[i] - speed[j] * s[j]) * dt
        parallel, across = np.abs(c[i] * c[j] + s[i] * s[j]), np.abs(c[i] * s[j] - s[i] * c[j])
        for k in (i, j):
            for ax, ay, half, other_half in (
                (c[k], s[k], half_length, parallel * half_length + across * half_width),
                (-s[k], c[k], half_width, parallel * half_width + across * half_length),
            ):
                between = np.abs(dx * ax + dy * ay) - half - other_half
                apart |= between > np.abs(vx * ax + vy * ay) + 1e-6
        return i[~apart], j[~apart]
