"""A town drawn from a seed: a grid of streets with signalised junctions, as pieces of lane with their right of way.

Coordinates are highway-env's: x east, y *south* [m], so headings grow clockwise and positive lateral is to the right.
Right-hand traffic. A piece is a straight or an arc, so each is exactly one highway-env lane. Streets end at the stop
line of their junction; movements (one or two pieces) lead from there to the streets behind it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from typing import Literal

import numpy as np
from highway_env.road.lane import AbstractLane, CircularLane, LineType, StraightLane
from highway_env.road.road import LaneIndex
from numpy.typing import NDArray

from study.config import BadInputError, TownSettings

LANE_WIDTH = 3.5  # [m]
CORNER = 7.0  # radius of the kerb where two streets of a junction meet [m]
BEND = (14.0, 20.0)  # from the corner of a bend to where its arc starts [m]
SHORTEST_STREET = 16.0  # between two stop lines [m]: two waiting vehicles
FASTEST = 50.0  # highest speed limit [km/h]
LENGTH, WIDTH = 5.0, 2.0  # of every vehicle [m], highway-env's
DISCS = np.array([-LENGTH / 3, 0.0, LENGTH / 3])  # along a vehicle: three discs of COVER radius cover it [m]
COVER = math.hypot(LENGTH / 6, WIDTH / 2)  # [m]
SLACK = 0.3  # vehicles do not follow their lines exactly [m]

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Pose = tuple[Floats, Floats, Floats, Floats]  # of all vehicles: x, y [m], heading [rad], speed [m/s]
Turn = Literal["left", "straight", "right"]


@dataclass(frozen=True)
class Piece:
    """A stretch of constant curvature [1/m], positive to the right: pose of its start [m, rad] and length [m]."""

    x: float
    y: float
    heading: float
    curvature: float
    length: float

    def at(self, s: Floats) -> tuple[Floats, Floats, Floats]:
        """Points and headings at the distances `s` [m] from the start."""
        heading = self.heading + self.curvature * s
        if self.curvature == 0:
            return self.x + s * math.cos(self.heading), self.y + s * math.sin(self.heading), heading
        x = self.x + (np.sin(heading) - math.sin(self.heading)) / self.curvature
        y = self.y - (np.cos(heading) - math.cos(self.heading)) / self.curvature
        return x, y, heading

    def end(self) -> tuple[float, float, float]:
        """Pose at the end."""
        x, y, heading = self.at(np.array([self.length]))
        return float(x[0]), float(y[0]), float(heading[0])

    def moved(self, dx: float, dy: float) -> Piece:
        """The same piece elsewhere."""
        return Piece(self.x + dx, self.y + dy, self.heading, self.curvature, self.length)


@dataclass(frozen=True)
class Strip:
    """A piece as a part of the map: which street or movement it belongs to, and what borders it has."""

    piece: Piece
    index: LaneIndex
    left: str  # borders in study.episode's words
    right: str
    junction: bool
    limit: float  # [m/s]


@dataclass(frozen=True)
class Movement:
    """A way through a junction, from a street's lane (`entry`) over `strips` to another street's lane (`exit`)."""

    node: int
    arm: int  # where it comes from: 0 east, 1 south, 2 west, 3 north of the node
    turn: Turn
    entry: int
    exit: int
    strips: tuple[int, ...]
    length: float


@dataclass(frozen=True)
class Signal:
    """A traffic light over one lane (`entry`, a strip), green in `phase` of its junction `node`."""

    node: int
    entry: int
    phase: int
    stop_line: Floats  # [2, 2]


@dataclass(frozen=True)
class Town:
    """A drawn town. M movements; positions in `strips` and `movements` are their names everywhere in the simulator.

    `enter`, `leave`: [M, M] m, where along movement a the front bumper gets, and the rear bumper is out of, the way of
    vehicles on movement b; NaN if they never meet.
    `opposing`: [M, M] bool, whether b comes from the arm across. `signal_of`: strip -> its signal, -1 where none.
    `phases`: node -> number of phases of its lights, 0 where there are none. `junctions`: nodes of three or more arms.
    """

    strips: tuple[Strip, ...]
    movements: tuple[Movement, ...]
    ways: dict[int, tuple[int, ...]]  # street strip -> movements at its end
    signals: tuple[Signal, ...]
    signal_of: NDArray[np.int64]
    phases: tuple[int, ...]
    junctions: tuple[int, ...]
    enter: Floats
    leave: Floats
    opposing: NDArray[np.bool_]


# --- geometry -------------------------------------------------------------------------------------------------------


def highway_lane(strip: Strip) -> AbstractLane:
    """highway-env's lane of a strip."""
    piece = strip.piece
    # highway-env draws its other kind of unbroken line straight from start to end
    unbroken = LineType.CONTINUOUS if piece.curvature else LineType.CONTINUOUS_LINE
    lines = {"none": LineType.NONE, "dashed": LineType.STRIPED}
    options = {
        "width": LANE_WIDTH,
        "line_types": [lines.get(border, unbroken) for border in (strip.left, strip.right)],
        "speed_limit": strip.limit,
    }
    if piece.curvature == 0:
        x, y, _ = piece.end()
        return StraightLane([piece.x, piece.y], [x, y], **options)
    radius, sign = 1 / abs(piece.curvature), math.copysign(1, piece.curvature)
    centre = [piece.x - sign * radius * math.sin(piece.heading), piece.y + sign * radius * math.cos(piece.heading)]
    start = piece.heading - sign * math.pi / 2
    return CircularLane(centre, radius, start, start + piece.curvature * piece.length, clockwise=sign > 0, **options)


def _direction(arm: int) -> tuple[float, float, float]:
    """Unit vector and heading from a node into an arm; exact, so that streets lie exactly along the axes."""
    return ((1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0))[arm] + ((0.0, 0.5, 1.0, -0.5)[arm] * math.pi,)


def _pose(arm: int, lane: int, reach: float, *, inbound: bool) -> tuple[float, float, float]:
    """Where a lane of an arm meets a junction at the origin; lane 0 is next to the middle of the street."""
    x, y, heading = _direction((arm + 2) % 4 if inbound else arm)
    along = -reach if inbound else reach
    side = (lane + 0.5) * LANE_WIDTH
    return along * x - side * y, along * y + side * x, heading


def _connect(start: tuple[float, float, float], end: tuple[float, float, float], turn: Turn) -> list[Piece]:
    """Pieces between two poses: straight, an S of two arcs, or a quarter turn with a straight before or after it."""
    x, y, heading = start
    c, s = math.cos(heading), math.sin(heading)
    ahead = (end[0] - x) * c + (end[1] - y) * s
    aside = -(end[0] - x) * s + (end[1] - y) * c  # to the right
    if turn == "straight" and abs(aside) < 1e-9:
        return [Piece(x, y, heading, 0.0, ahead)]
    if turn == "straight":
        angle = 2 * math.atan2(abs(aside), ahead)
        radius = ahead / (2 * math.sin(angle))
        curvature = math.copysign(1 / radius, aside)
        first = Piece(x, y, heading, curvature, radius * angle)
        return [first, Piece(*first.end(), -curvature, radius * angle)]
    sign = 1 if turn == "right" else -1
    radius = min(ahead, abs(aside))
    pieces = []
    if ahead - radius > 1e-9:
        pieces.append(Piece(x, y, heading, 0.0, ahead - radius))
        x, y, heading = pieces[-1].end()
    pieces.append(Piece(x, y, heading, sign / radius, radius * math.pi / 2))
    if abs(aside) - radius > 1e-9:
        pieces.append(Piece(*pieces[-1].end(), 0.0, abs(aside) - radius))
    return pieces


# --- junctions ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Way:
    arm: int
    lane: int
    to_arm: int
    to_lane: int
    turn: Turn
    pieces: tuple[Piece, ...]


@dataclass(frozen=True)
class _Junction:
    ways: tuple[_Way, ...]
    enter: Floats
    leave: Floats


def _lane_turns(lanes: int, turns: list[Turn], straight_lanes: int) -> list[list[Turn]]:
    """Which turns each lane of an approach offers, lane 0 next to the middle; two lanes never merge in a junction."""
    if lanes == 1:
        return [turns]
    if len(turns) == 2:  # at a T each lane has a use of its own
        return [turns[:1], turns[1:]]
    return [["left", "straight"] if straight_lanes == 2 else ["left"], ["straight", "right"]]


@cache
def _junction(arms: tuple[int, int, int, int], reach: float) -> _Junction:
    """All ways through a junction at the origin whose arms have so many lanes each way (0: no such arm)."""
    ways = []
    for arm, lanes in enumerate(arms):
        if not lanes:
            continue
        exits: list[tuple[Turn, int]] = [("left", (arm + 1) % 4), ("straight", (arm + 2) % 4), ("right", (arm + 3) % 4)]
        exits = [(turn, to) for turn, to in exits if arms[to]]
        bend = sum(n > 0 for n in arms) == 2
        offered = (
            [[exits[0][0]]] * lanes if bend else _lane_turns(lanes, [turn for turn, _ in exits], arms[(arm + 2) % 4])
        )
        for lane in range(lanes):
            for turn, to in exits:
                if turn not in offered[lane]:
                    continue
                for to_lane in _exit_lanes(turn, lane, lanes, arms[to], ways=1 if bend else len(exits)):
                    pieces = _connect(
                        _pose(arm, lane, reach, inbound=True), _pose(to, to_lane, reach, inbound=False), turn
                    )
                    ways.append(_Way(arm, lane, to, to_lane, turn, tuple(pieces)))
    return _Junction(tuple(ways), *_conflicts(ways))


def _exit_lanes(turn: Turn, lane: int, lanes: int, to_lanes: int, *, ways: int) -> list[int]:
    """Lanes that a turn of a lane leads to: any that no other vehicle of the same green may need.

    More than one, because nobody changes lanes on a street.
    """
    if ways == 1 or (ways == 3 and turn == "straight" and lanes == to_lanes):
        return [lane]
    if ways == 3 and turn == "left":  # or left turns from across would meet
        return [0]
    return list(range(to_lanes))


def _conflicts(ways: list[_Way]) -> tuple[Floats, Floats]:
    """Where ways from different arms are in each other's way, as in `Town`."""
    enter = np.full((len(ways), len(ways)), np.nan)
    leave = enter.copy()
    bodies = [_bodies(way.pieces) for way in ways]
    for a, (discs_a, s_a) in enumerate(bodies):
        for b, (discs_b, s_b) in enumerate(bodies[:a]):
            if ways[a].arm == ways[b].arm:
                continue
            dx = discs_a[:, :, 0].reshape(-1, 1) - discs_b[:, :, 0].reshape(1, -1)
            dy = discs_a[:, :, 1].reshape(-1, 1) - discs_b[:, :, 1].reshape(1, -1)
            near = dx * dx + dy * dy < (2 * COVER + SLACK) ** 2
            meet = near.reshape(len(s_a), len(DISCS), len(s_b), len(DISCS)).max(axis=(1, 3))
            for one, other, s, own in ((a, b, s_a, meet.max(axis=1)), (b, a, s_b, meet.max(axis=0))):
                if own.any():
                    enter[one, other], leave[one, other] = s[own][0] + LENGTH / 2, s[own][-1] - LENGTH / 2
    return enter, leave


def _bodies(pieces: tuple[Piece, ...]) -> tuple[Floats, Floats]:
    """Where the discs of a vehicle on its way are, [P, 3, 2] m, and how far along its centre is then, [P] m."""
    discs, distances, done = [], [], 0.0
    for piece in pieces:
        s = np.linspace(0, piece.length, math.ceil(piece.length) + 1)
        x, y, heading = piece.at(s)
        heading = heading - math.asin(piece.curvature * LENGTH / 2)  # a vehicle's middle slips outwards
        axis = np.stack([np.cos(heading), np.sin(heading)], axis=1)
        discs.append(np.stack([x, y], axis=1)[:, None] + DISCS[:, None] * axis[:, None])
        distances.append(s + done)
        done += piece.length
    return np.concatenate(discs), np.concatenate(distances)


# --- the grid -------------------------------------------------------------------------------------------------------


def _grid(rows: int, columns: int) -> list[tuple[int, int]]:
    """Streets of the full grid as pairs of nodes; node = row * columns + column."""
    across = [(r * columns + c, r * columns + c + 1) for r in range(rows) for c in range(columns - 1)]
    down = [(r * columns + c, (r + 1) * columns + c) for r in range(rows - 1) for c in range(columns)]
    return across + down


def _degrees(streets: list[tuple[int, int]], nodes: int) -> list[int]:
    return [int(n) for n in np.bincount(np.array(streets).reshape(-1), minlength=nodes)]


def _robust(streets: list[tuple[int, int]], nodes: int) -> bool:
    """Whether every street lies on a round trip, so that nobody ever has to turn back: connected without bridges."""
    neighbours: dict[int, list[int]] = {node: [] for node in range(nodes)}
    for a, b in streets:
        neighbours[a].append(b)
        neighbours[b].append(a)
    for left_out in [None, *streets]:
        seen, todo = {0}, [0]
        while todo:
            node = todo.pop()
            for other in neighbours[node]:
                if other not in seen and left_out not in ((node, other), (other, node)):
                    seen.add(other)
                    todo.append(other)
        if len(seen) < nodes:
            return False
    return True


def _drop_streets(settings: TownSettings, rng: np.random.Generator) -> list[tuple[int, int]]:
    """The grid without the dropped streets, with 16 junctions (3 or more arms) left wherever the grid allows it."""
    streets = _grid(settings.rows, settings.columns)
    nodes = settings.rows * settings.columns
    full = sum(degree >= 3 for degree in _degrees(streets, nodes))
    needed = min(16, full - settings.dropped_edges)
    for _ in range(20):
        left = list(streets)
        for pick in rng.permutation(len(streets)):
            if len(left) == len(streets) - settings.dropped_edges:
                return left
            fewer = [street for street in left if street != streets[pick]]
            degrees = _degrees(fewer, nodes)
            if min(degrees) >= 2 and sum(d >= 3 for d in degrees) >= needed and _robust(fewer, nodes):
                left = fewer
        if len(left) == len(streets) - settings.dropped_edges:
            return left
    raise BadInputError(
        f"town: cannot leave {settings.dropped_edges} streets out of a {settings.rows} x {settings.columns} grid "
        "and still reach everything without turning back; drop fewer (dropped_edges) or take a larger grid"
    )


def _arm(a: int, b: int, columns: int) -> int:
    """Side of node `a` on which node `b` lies."""
    return {1: 0, columns: 1, -1: 2, -columns: 3}[b - a]


def _lane_counts(
    streets: list[tuple[int, int]], degrees: list[int], share: float, rng: np.random.Generator
) -> dict[tuple[int, int], int]:
    """Lanes each way of every street; a bend has as many on both sides, as nobody changes lanes."""
    group = list(range(len(streets)))
    for node, degree in enumerate(degrees):
        if degree == 2:
            first, second = (k for k, street in enumerate(streets) if node in street)
            old, new = group[second], group[first]
            group = [new if g == old else g for g in group]
    two = rng.random(len(streets)) < share
    return {street: 2 if two[group[k]] else 1 for k, street in enumerate(streets)}


def draw_town(settings: TownSettings, rng: np.random.Generator) -> Town:
    """Draw a town. Raises BadInputError when the settings cannot be met."""
    rows, columns = settings.rows, settings.columns
    shortest = settings.block[0] - 2 * max(BEND[1], 2 * LANE_WIDTH + CORNER)
    if shortest < SHORTEST_STREET:
        raise BadInputError(
            f"town: a block of {settings.block[0]:g} m leaves {shortest:g} m of street between its junctions; "
            f"at least {SHORTEST_STREET:g} m are needed: set block to "
            f"{settings.block[0] + SHORTEST_STREET - shortest:g} or more"
        )
    fastest = max((settings.speed_limit, *settings.road_limits))
    if fastest > FASTEST:
        raise BadInputError(
            f"town: a limit of {fastest:g} km/h is too fast for its bends and for how far the autopilot looks; "
            f"take at most {FASTEST:g} (speed_limit, road_limits)"
        )
    xs = np.concatenate([[0.0], np.cumsum(rng.uniform(*settings.block, columns - 1).round(1))])
    ys = np.concatenate([[0.0], np.cumsum(rng.uniform(*settings.block, rows - 1).round(1))])
    streets = _drop_streets(settings, rng)
    limits = np.full(len(streets), settings.speed_limit)
    if settings.road_limits:
        limits = rng.choice(np.array(settings.road_limits), len(streets))
    for _ in range(100):
        town = _lay_out(settings, streets, limits, (xs, ys), rng)
        if _all_reachable(town):
            return town
    raise BadInputError(
        f"town: no way was found to give {settings.two_lane_share:.0%} of the streets two lanes (two_lane_share) so "
        "that every lane leads to every other; take another share, a larger grid or another seed"
    )


def _lay_out(
    settings: TownSettings,
    streets: list[tuple[int, int]],
    limits: Floats,
    axes: tuple[Floats, Floats],
    rng: np.random.Generator,
) -> Town:
    """A town on these streets, with lanes and bends drawn."""
    xs, ys = axes
    nodes, columns = len(xs) * len(ys), len(xs)
    degrees = _degrees(streets, nodes)
    lanes = _lane_counts(streets, degrees, settings.two_lane_share, rng)
    bends = rng.uniform(*BEND, nodes).round(1)
    draft = _Draft(columns, xs, ys)
    for street, limit in zip(streets, limits, strict=True):
        for a, b in (street, street[::-1]):
            draft.arms[a][_arm(a, b, columns)] = lanes[street]
            draft.limits[a][_arm(a, b, columns)] = float(limit) / 3.6
    for node in range(nodes):
        arms = draft.arms[node]
        corner = degrees[node] == 2 and arms[0] != arms[2]
        draft.reach[node] = bends[node] if corner else max(arms) * LANE_WIDTH + CORNER
    for street in streets:
        draft.add_street(*street, lanes[street])
    for node in range(nodes):
        draft.add_junction(node)
    return draft.finish(degrees)


def _all_reachable(town: Town) -> bool:
    """Whether every lane leads to every other: nobody changes lanes, so a ring of turning lanes could be a trap."""
    ahead = {entry: {town.movements[way].exit for way in ways} for entry, ways in town.ways.items()}
    behind: dict[int, set[int]] = {entry: set() for entry in ahead}
    for entry, exits in ahead.items():
        for exit_ in exits:
            behind[exit_].add(entry)
    for links in (ahead, behind):
        start = next(iter(links))
        seen, todo = {start}, [start]
        while todo:
            new = links[todo.pop()] - seen
            seen |= new
            todo += new
        if len(seen) < len(links):
            return False
    return True


class _Draft:
    """A town while it is built."""

    def __init__(self, columns: int, xs: Floats, ys: Floats) -> None:
        nodes = len(xs) * len(ys)
        self.columns, self.xs, self.ys = columns, xs, ys
        self.arms = [[0, 0, 0, 0] for _ in range(nodes)]
        self.limits = [[0.0] * 4 for _ in range(nodes)]
        self.reach = [0.0] * nodes
        self.strips: list[Strip] = []
        self.inbound: dict[tuple[int, int, int], int] = {}  # node, arm, lane -> strip
        self.outbound: dict[tuple[int, int, int], int] = {}
        self.movements: list[Movement] = []
        self.blocks: list[tuple[int, _Junction]] = []  # first movement of a junction, its template
        self.signals: list[Signal] = []
        self.phases: list[int] = []

    def centre(self, node: int) -> tuple[float, float]:
        return float(self.xs[node % self.columns]), float(self.ys[node // self.columns])

    def add_street(self, a: int, b: int, lanes: int) -> None:
        for start, end in ((a, b), (b, a)):
            arm, back = _arm(start, end, self.columns), _arm(end, start, self.columns)
            (x0, y0), (x1, y1) = self.centre(start), self.centre(end)
            length = abs(x1 - x0) + abs(y1 - y0) - self.reach[start] - self.reach[end]
            for lane in range(lanes):
                x, y, heading = _pose(arm, lane, self.reach[start], inbound=False)
                self.outbound[start, arm, lane] = self.inbound[end, back, lane] = len(self.strips)
                self.strips.append(
                    Strip(
                        Piece(x0 + x, y0 + y, heading, 0.0, length),
                        (f"{start}>{end}", f"{end}<{start}", lane),
                        "solid" if lane == 0 else "dashed",
                        "curb" if lane == lanes - 1 else "dashed",
                        junction=False,
                        limit=self.limits[start][arm],
                    )
                )

    def add_junction(self, node: int) -> None:
        arms = self.arms[node]
        first, second, third, fourth = arms
        plan = _junction((first, second, third, fourth), self.reach[node])
        self.blocks.append((len(self.movements), plan))
        x, y = self.centre(node)
        taken: dict[tuple[str, str], int] = {}
        bend = sum(lanes > 0 for lanes in arms) == 2
        for way in plan.ways:
            entry, exit_ = self.inbound[node, way.arm, way.lane], self.outbound[node, way.to_arm, way.to_lane]
            left, right = _borders(way, arms, bend=bend)
            names = [self.strips[entry].index[1]]
            names += [f"{node}.{len(self.movements)}.{k}" for k in range(1, len(way.pieces))]
            names.append(self.strips[exit_].index[0])
            own = []
            for piece, ends in zip(way.pieces, pairwise(names), strict=True):
                index = (*ends, taken.get(ends, 0))
                taken[ends] = index[2] + 1
                own.append(len(self.strips))
                self.strips.append(
                    Strip(piece.moved(x, y), index, left, right, junction=not bend, limit=self.limits[node][way.to_arm])
                )
            length = sum(piece.length for piece in way.pieces)
            self.movements.append(Movement(node, way.arm, way.turn, entry, exit_, tuple(own), length))
        self.phases.append(0 if bend else 2)
        if not bend:
            self._add_signals(node, arms)

    def _add_signals(self, node: int, arms: list[int]) -> None:
        """One light over each lane; arms across from each other are green together."""
        for arm, lanes in enumerate(arms):
            for lane in range(lanes):
                entry = self.inbound[node, arm, lane]
                x, y, heading = self.strips[entry].piece.end()
                half = np.array([-math.sin(heading), math.cos(heading)]) * LANE_WIDTH / 2
                line = np.array([[x, y], [x, y]]) + np.array([-half, half])
                self.signals.append(Signal(node, entry, arm % 2, line))

    def finish(self, degrees: list[int]) -> Town:
        ways: dict[int, list[int]] = {}
        for number, movement in enumerate(self.movements):
            ways.setdefault(movement.entry, []).append(number)
        count = len(self.movements)
        enter, leave = np.full((count, count), np.nan), np.full((count, count), np.nan)
        opposing = np.zeros((count, count), bool)
        for first, plan in self.blocks:
            block = slice(first, first + len(plan.ways))
            enter[block, block], leave[block, block] = plan.enter, plan.leave
            arms = np.array([way.arm for way in plan.ways])
            opposing[block, block] = (arms[:, None] + 2) % 4 == arms[None]
        signal_of = np.full(len(self.strips), -1)
        for number, signal in enumerate(self.signals):
            signal_of[signal.entry] = number
        return Town(
            strips=tuple(self.strips),
            movements=tuple(self.movements),
            ways={entry: tuple(numbers) for entry, numbers in ways.items()},
            signals=tuple(self.signals),
            signal_of=signal_of,
            phases=tuple(self.phases),
            junctions=tuple(node for node, degree in enumerate(degrees) if degree >= 3),
            enter=enter,
            leave=leave,
            opposing=opposing,
        )


def _borders(way: _Way, arms: list[int], *, bend: bool) -> tuple[str, str]:
    """Borders of a way: the kerb on its right where nothing leaves there; lines only through bends."""
    outer = way.lane == arms[way.arm] - 1 and way.to_lane == arms[way.to_arm] - 1
    kerb = outer and (way.turn == "right" or bend or (way.turn == "straight" and not arms[(way.arm + 3) % 4]))
    if not bend:
        return "none", "curb" if kerb else "none"
    return "solid" if way.lane == 0 else "dashed", "curb" if kerb else "dashed"
