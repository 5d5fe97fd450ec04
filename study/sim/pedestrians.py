"""Pedestrians of the town: along the kerbs, and over crossings while the light of the crossed arm is red.

A crossing leads over each arm of a signalised junction, between its stop line and the junction. A pedestrian sets off
when the red lasts long enough, and when no vehicle is on the crossing or too near to stop. Vehicles stop before a
crossing until everyone on it has passed their lane. So no vehicle of the autopilot meets a pedestrian, and nobody
waits longer than it takes to cross.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from study.sim.autopilot import Fleet
from study.sim.dynamics import DT, LOOK, stopping_distance
from study.sim.geometry import LANE_WIDTH, LENGTH, WIDTH, Floats, Ints, Pose, true_pairs
from study.sim.lights import LightPlan
from study.sim.town import Town

BEHIND_LINE, BREADTH = 1.75, 1.5  # of a crossing: from the stop line to its middle, and along the street [m]
KERB = 1.2  # from the kerb to where pedestrians walk and wait [m]
ASIDE = 0.5  # each pedestrian keeps up to this far beside the middle of its ways [m]
SIZE = 0.5  # side of a pedestrian's box [m]
PACE = (1.3, 1.7)  # slowest and fastest [m/s]
PASSED = WIDTH / 2 + SIZE  # beyond the middle of a lane, a pedestrian is out of the way of its vehicles [m]
ROOM = 0.5  # that a vehicle has left, at least, when it stops for a pedestrian who sets off [m]
CREEP = 0.5  # a slower vehicle within a junction waits there [m/s]
APART = 8.0  # beyond the stop line, turns from one lane are so far apart that one may stop there [m]
SPARE = 0.5  # of the red, when a pedestrian has crossed [s]


@dataclass(frozen=True)
class Walks:
    """The ways of pedestrians. W ways, each from one corner to another; C crossings.

    `start`, `along`: [W, 2] m and [W, 2], first point and unit vector. `length`: [W] m. `goal`: [W], the corner where
    it ends. `crossing`: [W], -1 along kerbs. `onward`: the ways that start at each corner. `signal`: [C], a light of
    the crossed arm. `of_move`: [2, M], the crossings before and behind a movement. `point`: [2, M, 2] m, where the
    middle of its lane meets them.
    """

    start: Floats
    along: Floats
    length: Floats
    goal: Ints
    crossing: Ints
    onward: tuple[tuple[int, ...], ...]
    signal: Ints
    of_move: Ints
    point: Floats


def lay_walks(town: Town) -> Walks:
    """Return the ways of a town."""
    points: dict[tuple[int, int], list[Floats]] = {}  # node, arm (quarter turns from east) -> where its lanes meet it
    across: dict[tuple[int, int], int] = {}  # the same -> node at the street's other end
    meets: dict[tuple[int, bool], tuple[tuple[int, int], Floats]] = {}  # street strip, inbound -> arm, point
    for number in town.ways:
        piece = town.strips[number].piece
        first, last = (int(node) for node in town.strips[number].index[0].split(">"))
        ahead = np.array([math.cos(piece.heading), math.sin(piece.heading)])
        arm = round(piece.heading / (math.pi / 2)) % 4
        for node, other, side, inbound in ((first, last, arm, False), (last, first, (arm + 2) % 4, True)):
            if town.phases[node]:
                x, y, _ = piece.end() if inbound else (piece.x, piece.y, 0.0)
                place = np.array([x, y]) + (1 if inbound else -1) * BEHIND_LINE * ahead
                points.setdefault((node, side), []).append(place)
                across[node, side], meets[number, inbound] = other, ((node, side), place)
    arms = {key: number for number, key in enumerate(points)}
    corners = np.concatenate([_corners(side, np.array(places)) for (_, side), places in points.items()])
    pairs = [(2 * number, 2 * number + 1, number) for number in range(len(arms))]
    for (node, side), number in arms.items():
        beside = arms.get((node, (side + 1) % 4))  # its left corner is the right one here
        if beside is not None:
            pairs.append((2 * number + 1, 2 * beside, -1))
        facing = arms.get((across[node, side], (side + 2) % 4))
        if facing is not None:
            pairs.append((2 * number + 1, 2 * facing, -1))
    both = np.array([*pairs, *((b, a, crossing) for a, b, crossing in pairs)], np.int64)
    way = corners[both[:, 1]] - corners[both[:, 0]]
    length = np.hypot(*way.T)
    lights = {arms[meets[signal.entry, True][0]]: number for number, signal in enumerate(town.signals)}
    ends = [[meets.get((move.entry, True)), meets.get((move.exit, False))] for move in town.movements]
    nowhere = ((-1, -1), np.full(2, np.nan))
    return Walks(
        start=corners[both[:, 0]],
        along=way / length[:, None],
        length=length,
        goal=both[:, 1],
        crossing=both[:, 2],
        onward=tuple(tuple(np.flatnonzero(both[:, 0] == corner).tolist()) for corner in range(len(corners))),
        signal=np.array([lights[number] for number in range(len(arms))], np.int64),
        of_move=np.array([[arms.get((end or nowhere)[0], -1) for end in pair] for pair in ends], np.int64).T,
        point=np.array([[(end or nowhere)[1] for end in pair] for pair in ends]).transpose(1, 0, 2),
    )


def _corners(arm: int, places: Floats) -> Floats:
    """Return a crossing's left and right end, seen from the junction, [2, 2] m; its lanes lie at `places` [N, 2] m."""
    out = np.array([(1, 0), (0, 1), (-1, 0), (0, -1)][arm], np.float64)
    right = np.array([-out[1], out[0]])
    aside = places @ right
    beyond = LANE_WIDTH / 2 + KERB
    ends: Floats = (places[0] @ out) * out + np.array([[aside.min() - beyond], [aside.max() + beyond]]) * right
    return ends


class Pedestrians:
    """All pedestrians of a drive. Arrays have one entry for each; draws come from `rng` alone."""

    def __init__(self, town: Town, count: int, lights: LightPlan, rng: np.random.Generator) -> None:
        self.walks, self.lights, self.rng = lay_walks(town), lights, rng
        self.entry = np.array([move.entry for move in town.movements], np.int64)
        self.aside = rng.uniform(-ASIDE, ASIDE, (count, 2))
        self.pace = rng.uniform(*PACE, count)
        self.way = np.zeros(count, np.int64)
        self.waiting = np.zeros(count, bool)
        self.progress = np.zeros(count)
        self.red = float((lights.cycle - lights.green - lights.yellow).min()) - SPARE
        for number in range(count):
            corners = rng.permutation(len(self.walks.onward)).tolist()
            self._take(number, next(corner for corner in corners if self._options(number, corner)))
            if not self.waiting[number]:
                self.progress[number] = rng.random() * self.walks.length[self.way[number]]

    def __len__(self) -> int:
        """Return how many there are."""
        return len(self.way)

    def _options(self, number: int, corner: int) -> list[int]:
        """Return the ways from a corner, without crossings for which the pedestrian is too slow."""
        walks = self.walks
        time = walks.length / self.pace[number]
        return [way for way in walks.onward[corner] if walks.crossing[way] < 0 or time[way] < self.red]

    def _take(self, number: int, corner: int, back: int = -1) -> None:
        """Draw the next way from a corner, which leads `back` to a corner only where no other does."""
        options = self._options(number, corner)
        onward = [way for way in options if self.walks.goal[way] != back] or options
        self.way[number] = onward[int(self.rng.integers(len(onward)))]
        self.waiting[number] = self.walks.crossing[self.way[number]] >= 0
        self.progress[number] = 0.0

    def places(self) -> Floats:
        """Return the middles of all pedestrians, [P, 2] m."""
        walks = self.walks
        places: Floats = walks.start[self.way] + self.progress[:, None] * walks.along[self.way] + self.aside
        return places

    def pose(self) -> Pose:
        """Return x, y [m], heading [rad] and speed [m/s] of all, in highway-env's coordinates."""
        x, y = self.places().T
        along = self.walks.along[self.way]
        return x, y, np.arctan2(along[:, 1], along[:, 0]), np.where(self.waiting, 0.0, self.pace)

    def walk(self) -> None:
        """Move everyone on by a step."""
        self.progress += np.where(self.waiting, 0.0, self.pace * DT)
        for number in (self.progress >= self.walks.length[self.way]).nonzero()[0].tolist():
            way = self.way[number]
            came = int(self.walks.goal[(way + len(self.walks.goal) // 2) % len(self.walks.goal)])  # the way back's goal
            self._take(number, int(self.walks.goal[way]), came)

    def set_off(self, time: float, fleet: Fleet, speed: Floats, force: Floats) -> None:
        """Let those who wait step onto their crossing at `time` [s], where they may (see above)."""
        waiting = self.waiting.nonzero()[0]
        crossing, near, front = self._crossings(fleet)
        way = stopping_distance(speed, force, fleet.dynamics.lag) + DT * speed + ROOM
        way[(front > 0) & (speed > CREEP)] = LOOK  # it may have cut in before oncoming vehicles
        busy = crossing[(near < way) & (near > -BREADTH - LENGTH)]
        mine = self.walks.crossing[self.way[waiting]]
        red = self.lights.until_green(time)[self.walks.signal[mine]]
        lasts = self.walks.length[self.way[waiting]] / self.pace[waiting] + SPARE <= red
        self.waiting[waiting[lasts & ~np.isin(mine, busy)]] = False

    def gaps(self, fleet: Fleet) -> Floats:
        """Return the way from each vehicle's bumper to a crossing with someone who has yet to pass its lane [m].

        It is inf where there is none within LOOK. A vehicle that enters the junction from the same lane, on whatever
        turn, ends the way, too, since it may stop for someone.
        """
        crossing, near, front = self._crossings(fleet)
        on = ((self.walks.crossing[self.way] >= 0) & ~self.waiting).nonzero()[0]
        to_lane = self.walks.point[:, fleet.move][:, :, None] - self.places()[on]
        to_pass = (to_lane * self.walks.along[self.way[on]]).sum(axis=-1) > -PASSED
        someone = (crossing[..., None] == self.walks.crossing[self.way[on]]) & to_pass
        stops = someone.any(axis=-1) & (near >= 0) & (near <= LOOK)
        room = fleet.first_crossing[fleet.move] - front  # before the way of oncoming vehicles, which must stay free
        near[1] = np.where(room >= 0, np.minimum(near[1], room), near[1])
        gaps = np.where(stops, near, np.inf).min(axis=0)
        rear, entry = front - LENGTH, np.where(fleet.move >= 0, self.entry[fleet.move], -1)
        ahead = rear - front[:, None]
        follows = (entry[:, None] == entry) & (front > 0) & (rear < APART) & (ahead >= 0) & (ahead <= LOOK)
        free: Floats = np.minimum(gaps, np.where(follows, ahead, np.inf).min(axis=1))
        return free

    def _crossings(self, fleet: Fleet) -> tuple[Ints, Floats, Floats]:
        """Return the crossings before and behind each vehicle's next or present movement, and the way to them, [2, N].

        The way leads from the front bumper to the crossing's near edge [m]. The third value is how far the bumper is
        beyond the stop line, [N] m.
        """
        front = fleet.s + LENGTH / 2 - fleet.move_start
        lines = np.stack([np.full(len(front), BEHIND_LINE), fleet.move_length[fleet.move] - BEHIND_LINE])
        return np.where(fleet.move >= 0, self.walks.of_move[:, fleet.move], -1), lines - BREADTH / 2 - front, front

    def hits(self, pose: Pose) -> list[tuple[int, int]]:
        """Return the pairs of a vehicle and a pedestrian that touch, a pedestrian taken for a disc."""
        x, y, heading, _ = pose
        dx, dy = self.places().T[..., None] - np.stack([x, y])[:, None]
        c, s = np.cos(heading), np.sin(heading)
        along = np.maximum(np.abs(dx * c + dy * s) - LENGTH / 2, 0)
        aside = np.maximum(np.abs(dy * c - dx * s) - WIDTH / 2, 0)
        touching: NDArray[np.bool_] = np.hypot(along, aside).T < SIZE / 2
        return list(zip(*(side.tolist() for side in true_pairs(touching)), strict=True))
