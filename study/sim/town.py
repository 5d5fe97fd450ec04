"""A town drawn from a seed: a grid of streets with signalised junctions, as pieces of lane with their right of way.

Coordinates are highway-env's: x east, y *south* [m], so headings grow clockwise and positive lateral is to the right.
Drawn for right-hand traffic; a town of left-hand traffic is its mirror image. A piece is a straight or an arc, so each
is exactly one highway-env lane. Streets end at the stop line of their junction; movements (one or two pieces) lead from
there to the streets behind it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import pairwise

import networkx as nx
import numpy as np
from highway_env.road.lane import AbstractLane, CircularLane, LineType, StraightLane
from numpy.typing import NDArray

from study.config.settings import TownSettings
from study.errors import BadInputError
from study.sim.geometry import CORNER, LANE_WIDTH, Floats, Piece, Turn, pose_at
from study.sim.junction import Junction, Movement, Strip, draw_junction, junction_borders

BEND = (14.0, 20.0)  # from the corner of a bend to where its arc starts [m]
SHORTEST_STREET = 16.0  # between two stop lines [m]: two waiting vehicles
FASTEST = 50.0  # highest speed limit [km/h]


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

    `enter`, `leave`: [M, M] m, where along movement a the front bumper enters, and the rear bumper leaves, the space of
    vehicles on movement b; NaN if they never meet.
    `opposing`: [M, M] bool, whether b comes from the arm across. `yielding`: the turn that lets those pass.
    `signal_of`: strip -> its signal, -1 where none. `phases`: node -> number of phases of its lights, 0 where there are
    none.
    """

    strips: tuple[Strip, ...]
    movements: tuple[Movement, ...]
    ways: dict[int, tuple[int, ...]]  # street strip -> movements at its end
    signals: tuple[Signal, ...]
    signal_of: NDArray[np.int64]
    phases: tuple[int, ...]
    enter: Floats
    leave: Floats
    opposing: NDArray[np.bool_]
    yielding: Turn = "left"


def highway_lane(strip: Strip) -> AbstractLane:
    """Return highway-env's lane of a strip."""
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


def _drop_streets(settings: TownSettings, rng: np.random.Generator) -> list[tuple[int, int]]:
    """Return the grid's streets without the dropped ones; 16 junctions of 3 or more arms remain where it allows them.

    A street is a pair of nodes; node = row * columns + column. Every street stays on a round trip, so that no vehicle
    ever has to turn back.
    """
    rows, columns = settings.rows, settings.columns
    across = [(r * columns + c, r * columns + c + 1) for r in range(rows) for c in range(columns - 1)]
    down = [(r * columns + c, (r + 1) * columns + c) for r in range(rows - 1) for c in range(columns)]
    streets = across + down
    needed = min(16, _junctions(nx.Graph(streets)) - settings.dropped_edges)
    for _ in range(20):
        graph, dropped = nx.Graph(streets), 0
        for pick in rng.permutation(len(streets)):
            if dropped == settings.dropped_edges:
                break
            graph.remove_edge(*streets[pick])
            if _junctions(graph) >= needed and nx.is_k_edge_connected(graph, 2):
                dropped += 1
            else:
                graph.add_edge(*streets[pick])
        if dropped == settings.dropped_edges:
            return [street for street in streets if graph.has_edge(*street)]
    raise BadInputError(
        f"town: cannot leave {settings.dropped_edges} streets out of a {settings.rows} x {settings.columns} grid "
        "and still reach everything without turning back; drop fewer (dropped_edges) or take a larger grid"
    )


def _junctions(graph: nx.Graph) -> int:
    return sum(degree >= 3 for _, degree in graph.degree)


def _arm(a: int, b: int, columns: int) -> int:
    """Return the side of node `a` on which node `b` lies."""
    return {1: 0, columns: 1, -1: 2, -columns: 3}[b - a]


def _lane_counts(
    streets: list[tuple[int, int]], degrees: list[int], share: float, rng: np.random.Generator
) -> dict[tuple[int, int], int]:
    """Return the lanes each way of every street; both sides of a bend have as many, as no vehicle changes lanes."""
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
            return town if settings.traffic == "right" else _mirrored(town)
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
    """Return a town on these streets, with lanes and bends drawn."""
    xs, ys = axes
    nodes, columns = len(xs) * len(ys), len(xs)
    degrees = np.bincount(np.ravel(streets), minlength=nodes).tolist()
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
    return draft.finish()


def _mirrored(town: Town) -> Town:
    """Return the town of the other side's traffic: its reflection in the x axis, where every left is a right."""
    turns: dict[Turn, Turn] = {"left": "right", "straight": "straight", "right": "left"}
    return replace(
        town,
        strips=tuple(
            replace(strip, piece=strip.piece.mirrored(), left=strip.right, right=strip.left) for strip in town.strips
        ),
        movements=tuple(replace(way, arm=-way.arm % 4, turn=turns[way.turn]) for way in town.movements),
        signals=tuple(replace(signal, stop_line=signal.stop_line * [1, -1]) for signal in town.signals),
        yielding=turns[town.yielding],
    )


def _all_reachable(town: Town) -> bool:
    """Return whether every lane leads to every other: a ring of turning lanes would be a trap."""
    links = [(entry, town.movements[way].exit) for entry, ways in town.ways.items() for way in ways]
    return bool(nx.is_strongly_connected(nx.DiGraph(links)))


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
        self.blocks: list[tuple[int, Junction]] = []  # first movement of a junction, its template
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
                x, y, heading = pose_at(arm, lane, self.reach[start], inbound=False)
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
        plan = draw_junction((first, second, third, fourth), self.reach[node])
        self.blocks.append((len(self.movements), plan))
        x, y = self.centre(node)
        taken: dict[tuple[str, str], int] = {}
        bend = sum(lanes > 0 for lanes in arms) == 2
        for way in plan.ways:
            entry, exit_ = self.inbound[node, way.arm, way.lane], self.outbound[node, way.to_arm, way.to_lane]
            left, right = junction_borders(way, arms, bend=bend)
            names = [self.strips[entry].index[1]]
            names += [f"{node}.{len(self.movements)}.{k}" for k in range(1, len(way.pieces))]
            names.append(self.strips[exit_].index[0])
            strips = []
            for piece, ends in zip(way.pieces, pairwise(names), strict=True):
                index = (*ends, taken.get(ends, 0))
                taken[ends] = index[2] + 1
                strips.append(len(self.strips))
                self.strips.append(
                    Strip(piece.moved(x, y), index, left, right, junction=not bend, limit=self.limits[node][way.to_arm])
                )
            length = sum(piece.length for piece in way.pieces)
            self.movements.append(Movement(node, way.arm, way.turn, entry, exit_, tuple(strips), length))
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

    def finish(self) -> Town:
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
            enter=enter,
            leave=leave,
            opposing=opposing,
        )
