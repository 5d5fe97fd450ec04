"""Junctions of the town: turns, conflicts and borders."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache

import numpy as np
from highway_env.road.road import LaneIndex

from study.sim.geometry import LENGTH, WIDTH, Floats, Piece, Turn, connect_poses, pose_at

DISCS = np.array([-LENGTH / 3, 0.0, LENGTH / 3])  # along a vehicle: three discs of COVER radius cover it [m]
COVER = math.hypot(LENGTH / 6, WIDTH / 2)  # [m]
SLACK = 0.3  # vehicles do not follow their lines exactly [m]


@dataclass(frozen=True)
class Strip:
    """A piece as a part of the map: the street or movement it belongs to, its borders and speed limit."""

    piece: Piece
    index: LaneIndex
    left: str  # borders, one of study.episode.schema.BORDERS
    right: str
    junction: bool
    limit: float  # [m/s]


@dataclass(frozen=True)
class Movement:
    """A way through a junction, from a street's lane (`entry`) over `strips` to another street's lane (`exit`)."""

    node: int
    arm: int  # side it comes from: 0 east, 1 south, 2 west, 3 north of the node
    turn: Turn
    entry: int
    exit: int
    strips: tuple[int, ...]
    length: float


@dataclass(frozen=True)
class _Way:
    arm: int
    lane: int
    to_arm: int
    to_lane: int
    turn: Turn
    pieces: tuple[Piece, ...]


@dataclass(frozen=True)
class Junction:
    """The ways across a junction, and the poses where its arms begin and end."""

    ways: tuple[_Way, ...]
    enter: Floats
    leave: Floats


def _lane_turns(lanes: int, turns: list[Turn], straight_lanes: int) -> list[list[Turn]]:
    """Return the turns that each lane of an approach offers, lane 0 next to the middle; two lanes never merge."""
    if lanes == 1:
        return [turns]
    if len(turns) == 2:  # at a T junction each lane has its own turn
        return [turns[:1], turns[1:]]
    return [["left", "straight"] if straight_lanes == 2 else ["left"], ["straight", "right"]]


@cache
def draw_junction(arms: tuple[int, int, int, int], reach: float) -> Junction:
    """Return a junction at the origin whose arms have these numbers of lanes each way (0: no such arm)."""
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
                    pieces = connect_poses(
                        pose_at(arm, lane, reach, inbound=True), pose_at(to, to_lane, reach, inbound=False), turn
                    )
                    ways.append(_Way(arm, lane, to, to_lane, turn, tuple(pieces)))
    return Junction(tuple(ways), *_conflicts(ways))


def _exit_lanes(turn: Turn, lane: int, lanes: int, to_lanes: int, *, ways: int) -> list[int]:
    """Return the lanes that a turn of a lane leads to: all that no other vehicle of the same green may need.

    There is more than one, because no vehicle changes lanes on a street.
    """
    if ways == 1 or (ways == 3 and turn == "straight" and lanes == to_lanes):
        return [lane]
    if ways == 3 and turn == "left":  # else left turns from across would meet
        return [0]
    return list(range(to_lanes))


def _conflicts(ways: list[_Way]) -> tuple[Floats, Floats]:
    """Return where ways from different arms obstruct each other: `enter` and `leave` of `Town`."""
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
            for one, other, s, meets in ((a, b, s_a, meet.max(axis=1)), (b, a, s_b, meet.max(axis=0))):
                if meets.any():
                    enter[one, other], leave[one, other] = s[meets][0] + LENGTH / 2, s[meets][-1] - LENGTH / 2
    return enter, leave


def _bodies(pieces: tuple[Piece, ...]) -> tuple[Floats, Floats]:
    """Return the discs of a vehicle along its way, [P, 3, 2] m, and how far along its centre is then, [P] m."""
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


def junction_borders(way: _Way, arms: list[int], *, bend: bool) -> tuple[str, str]:
    """Return the borders of a way: the kerb on its right where no other way leaves there; lines only in bends."""
    outer = way.lane == arms[way.arm] - 1 and way.to_lane == arms[way.to_arm] - 1
    kerb = outer and (way.turn == "right" or bend or (way.turn == "straight" and not arms[(way.arm + 3) % 4]))
    if not bend:
        return "none", "curb" if kerb else "none"
    return "solid" if way.lane == 0 else "dashed", "curb" if kerb else "dashed"
