"""Find motion that no vehicle makes: each agent is judged by its own rows, step by step.

Pedestrians may turn on the spot, step aside and walk hand in hand: their headings and nearness are not judged.

Positions are believed first: a jump splits an agent's rows, and what cannot be reached from its longest stretch is
wrong. Speeds are held against the distance moved in a second, headings against its direction. Where most of an agent's
rows disagree, its unit or convention is another one, and all its rows are wrong; otherwise those rows are.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from study.config.settings import DynamicsSettings
from study.episode.findings import Findings
from study.episode.rows import Rows, make_unknown
from study.episode.schema import PEDESTRIAN, Agent

JUMP = 2.0, 0.5  # farther than its speed carries it by this much [m] and this share of that, an agent has jumped
SPEED = 2.0, 0.25  # the same for a second's distance, either way
STEP = 5.0, 25.0  # largest change of speed between two steps [m/s], and per second more [m/s2]
SPIN = 1.5  # largest turn between two steps [rad]
ASKEW, ACROSS = 0.4, 1.0  # between heading and motion: too much for a quarter of the moments, and for any [rad]
MOVED = 1.5  # shortest way that shows a direction [m]
APART = 0.3  # centres of two vehicles are never as near [m]
BEND = 0.05  # turn from which the unit of steering shows [rad/s]
FEW_BENDS = 30  # of an agent, from which its unit is told
FOLLOWS = 0.9  # least correlation of steering with the path's bends, from which its unit is told
GAIN = 0.2, 2.0  # of an agent's steering over what its path needs: outside, its unit is another one
# The axles of cars are half to two thirds of their length apart, and all of it in simulators that know no more. As
# radians, taken for shares of 1.22 rad, the same angles seem 1.22 times as large.
SHARES, RADIANS = ((0.5, 0.69), (0.9, 1.1)), ((0.69, 0.82), (1.1, 1.35))
TURNING = 0.02, 0.05  # curvature [1/m] of a turn that shows the sign of steering, and least wheel angle [rad]
FEW = 10  # moments from which a convention is told

Bools = NDArray[np.bool_]
Floats = NDArray[np.float64]


def wrap(angle: NDArray[Any]) -> NDArray[Any]:
    """Return the angle, wrapped into half a turn either way."""
    wrapped: NDArray[Any] = np.mod(angle + np.pi, 2 * np.pi) - np.pi
    return wrapped


def _walks(rows: Rows, agents: Sequence[Agent]) -> Bools:
    """Return which rows are of pedestrians."""
    return np.array([agent.kind == PEDESTRIAN for agent in agents], bool)[rows["agent"]]


def _within(values: Floats, spans: Sequence[tuple[float, float]]) -> Bools:
    """Return which values lie in one of the spans."""
    inside: Bools = np.logical_or.reduce([(low <= values) & (values < high) for low, high in spans])
    return inside


def motion_faults(rows: Rows, rate: float, agents: Sequence[Agent], findings: Findings) -> Bools:
    """Return which rows belong to impossible motion; `findings` get them, agent by agent.

    Steering that points the other way, or is in another unit, is made unknown in `rows`, which stay.
    """
    order = np.lexsort((rows["step"], rows["agent"]))
    names = ("step", "agent", "number", "x", "y", "heading", "speed", "steering")
    tracks = _Tracks({name: rows[name][order] for name in names if name in rows}, rate, agents, findings)
    tracks.find_jumps()
    tracks.find_speeds()
    tracks.find_headings()
    tracks.find_steering()
    tracks.find_steering_unit(np.array([agent.length for agent in agents])[rows["agent"][order]])
    bad = np.zeros(len(order), bool)
    bad[order] = tracks.bad
    if tracks.contrary.any():
        contrary = np.zeros(len(order), bool)
        contrary[order] = tracks.contrary
        make_unknown(rows, "steering", contrary, findings)
    return bad | _find_twins(rows, bad, rate, agents, findings)


class _Tracks:
    """Rows sorted by agent, then step, and which of them have been found to be wrong."""

    def __init__(self, rows: Rows, rate: float, agents: Sequence[Agent], findings: Findings) -> None:
        self.rows, self.rate, self.findings = rows, rate, findings
        self.agents = len(agents)
        self.walks = _walks(rows, agents)
        self.ids = np.array([agent.id for agent in agents], np.int64)[rows["agent"]]
        self.bad = np.zeros(len(self.ids), bool)
        self.contrary = self.bad.copy()  # rows whose steering points the other way, or is in another unit
        self.stretch = np.zeros(len(self.ids), np.int64)  # number of the unbroken stretch that a row belongs to
        step, agent = rows["step"], rows["agent"]
        self.joined = (np.diff(agent) == 0) & (np.diff(step) == 1)  # row k + 1 is the step after row k

    def add(self, wrong: Bools, name: str, rule: str, **values: Floats) -> Bools:
        """Add findings about rows that are not yet known to be wrong, and return which those are."""
        wrong = wrong & ~self.bad
        if wrong.any():
            text = f", field '{name}' (step {{step}}, agent {{agent}}): {{value:.4g}} {rule}"
            self.findings.add_rows(
                wrong,
                self.rows["number"],
                self.ids,
                text,
                {"step": self.rows["step"], "value": self.rows[name], **values},
            )
        return wrong

    def later(self, wrong: Bools) -> Bools:
        """Return the rows [N] that end a wrong step, from steps [N - 1] between neighbouring rows."""
        good = self.joined & ~self.bad[:-1] & ~self.bad[1:]
        return np.concatenate([[False], wrong & good])[: len(self.ids)]

    def share(self, wrong: Bools, judged: Bools) -> tuple[Bools, Floats]:
        """Return, for each row, whether its agent has enough judged rows, and the share of them that is wrong."""
        agent = self.rows["agent"]
        judgements = np.bincount(agent, weights=judged, minlength=self.agents)
        faults = np.bincount(agent, weights=wrong & judged, minlength=self.agents)
        return (judgements >= FEW)[agent], (faults / np.maximum(judgements, 1))[agent]

    def window(self, steps: int) -> NDArray[np.int64]:
        """Return the rows k that have the row `steps` later in the same unbroken stretch."""
        last = len(self.ids) - steps
        if last <= 0:
            return np.empty(0, np.int64)
        whole = self.stretch[:last] == self.stretch[steps:]
        return np.flatnonzero(whole & ~self.bad[:last] & ~self.bad[steps:])

    def find_jumps(self) -> None:
        rows = self.rows
        if not len(self.ids):
            return
        moved = np.hypot(np.diff(rows["x"]), np.diff(rows["y"])).astype(np.float64)
        carried = (np.abs(rows["speed"][1:]) + np.abs(rows["speed"][:-1])).astype(np.float64) / (2 * self.rate)
        jumps = self.joined & (moved - carried > JUMP[0] + JUMP[1] * carried)
        chain = np.concatenate([[0], np.cumsum(~self.joined)])
        self.stretch = np.concatenate([[0], np.cumsum(~self.joined | jumps)])
        if not jumps.any():
            return
        fits = self._fitting(chain, jumps)
        jump = np.zeros(len(self.ids))
        jump[1:][jumps] = moved[jumps]
        before = np.concatenate([jump[1:], [0]])  # a stretch may come before the jump
        self.bad |= self.add(
            ~fits[self.stretch],
            "x",
            "lies beyond a jump of {jump:.3g} m between two steps (or more); no vehicle moves so: leave out rows of "
            "missing states, give another vehicle another id",
            jump=np.maximum.reduceat(np.maximum(jump, before), np.flatnonzero(np.diff(self.stretch, prepend=-1)))[
                self.stretch
            ],
        )

    def _fitting(self, chain: NDArray[np.int64], jumps: Bools) -> Bools:
        """Return which stretches are the longest of their chain, or where its vehicle can have got to from there."""
        x, y, speed, step = (self.rows[name] for name in ("x", "y", "speed", "step"))
        starts = np.flatnonzero(np.diff(self.stretch, prepend=-1))
        ends = np.append(starts[1:], len(chain)) - 1
        fits = np.ones(len(starts), bool)

        def reached(one: int, other: int) -> bool:
            moved = np.hypot(float(x[other]) - x[one], float(y[other]) - y[one])
            carried = abs(step[other] - step[one]) * max(abs(speed[one]), abs(speed[other])) / self.rate
            return bool(moved <= JUMP[0] + (1 + JUMP[1]) * carried)

        for broken in np.unique(chain[1:][jumps]):
            first, last = np.searchsorted(chain[starts], [broken, broken + 1])
            longest = first + int((ends - starts)[first:last].argmax())
            fits[first:last] = False
            fits[longest] = True
            at = ends[longest]
            for later in range(longest + 1, last):
                if reached(at, starts[later]):
                    fits[later], at = True, ends[later]
            at = starts[longest]
            for earlier in range(longest - 1, first - 1, -1):
                if reached(at, ends[earlier]):
                    fits[earlier], at = True, starts[earlier]
        return fits

    def find_speeds(self) -> None:
        rows, span = self.rows, max(1, round(self.rate))
        speed = np.abs(rows["speed"]).astype(np.float64)
        total = np.concatenate([[0], np.cumsum((speed[1:] + speed[:-1]) / (2 * self.rate))]) if len(speed) else speed
        start = self.window(span)
        moved = np.hypot(rows["x"][start + span] - rows["x"][start], rows["y"][start + span] - rows["y"][start])
        carried = total[start + span] - total[start]
        off = np.abs(moved - carried) > SPEED[0] + SPEED[1] * carried
        judged, wrong = np.zeros(len(speed), bool), np.zeros(len(speed), bool)
        middle = start + span // 2
        judged[middle[np.maximum(moved, carried) > SPEED[0]]] = True
        wrong[middle[off]] = True
        distance = np.bincount(rows["agent"][middle], weights=moved, minlength=self.agents)
        ratio = np.bincount(rows["agent"][middle], weights=carried, minlength=self.agents) / np.maximum(distance, 1e-9)
        rule = (
            "does not fit the positions: speeds are {ratio:.2f} times the distance moved per second; is the unit m/s?"
        )
        enough, share = self.share(wrong, judged)
        all_ratios = ratio[rows["agent"]]
        self.bad |= self.add(enough & (share > 0.5), "speed", rule, ratio=all_ratios)
        own = np.ones(len(speed))
        own[middle] = carried / np.maximum(moved, 1e-9)
        self.bad |= self.add(wrong, "speed", rule, ratio=own)
        change = np.abs(np.diff(rows["speed"])) > STEP[0] + STEP[1] / self.rate
        self.bad |= self.add(self.later(change), "speed", "has changed within a step as no vehicle's does")

    def find_headings(self) -> None:
        rows, half = self.rows, max(1, round(self.rate / 4))
        start = self.window(2 * half)
        middle = start + half
        dx, dy = (rows[name][start + 2 * half].astype(np.float64) - rows[name][start] for name in "xy")
        shows = (np.hypot(dx, dy) > MOVED) & ~self.walks[middle]
        middle, motion = middle[shows], np.arctan2(dy, dx)[shows]
        motion = np.where(rows["speed"][middle] < 0, motion + np.pi, motion)
        off, way = np.zeros(len(self.ids)), np.zeros(len(self.ids))
        off[middle] = np.abs(wrap(motion - rows["heading"][middle]))
        way[middle] = motion
        judged = np.zeros(len(off), bool)
        judged[middle] = True
        rule = (
            "does not fit the motion, which goes to {way:.3g}; headings are radians, anticlockwise from the x axis "
            "(reversing is a negative speed)"
        )
        enough, share = self.share(off > ASKEW, judged)
        first = self._first_of_agent(off > ASKEW, way)
        self.bad |= self.add(enough & (share > 0.25), "heading", rule, way=first)
        self.bad |= self.add(off > ACROSS, "heading", rule, way=way)
        spin = np.abs(wrap(np.diff(rows["heading"].astype(np.float64)))) > SPIN
        spin &= ~self.walks[1:]
        self.bad |= self.add(self.later(spin), "heading", "has turned within a step as no vehicle does")

    def _turns(self) -> tuple[NDArray[np.int64], Floats]:
        """Return the rows with a quarter of a second of their agent on both sides, and how fast it turns [rad/s]."""
        heading, half = self.rows["heading"].astype(np.float64), max(1, round(self.rate / 4))
        start = self.window(2 * half)
        return start + half, wrap(heading[start + 2 * half] - heading[start]) * self.rate / (2 * half)

    def find_steering(self) -> None:
        """Compare the sign of steering with that of turns: left is positive."""
        rows = self.rows
        if "steering" not in rows:
            return
        middle, turned = self._turns()
        speed = np.maximum(np.abs(rows["speed"][middle].astype(np.float64)), 0.1)
        wheel = rows["steering"][middle].astype(np.float64) * DynamicsSettings().steering_unit
        shows = (rows["speed"][middle] > 2) & (np.abs(turned / speed) > TURNING[0]) & (np.abs(wheel) > TURNING[1])
        judged, wrong = np.zeros((2, len(rows["heading"])), bool)
        judged[middle[shows]] = True
        wrong[middle[shows & (turned * wheel < 0)]] = True
        enough, share = self.share(wrong, judged)
        rule = "points away from the turns that this agent makes (at {share:.0%} of them); left is positive"
        known = np.isfinite(rows["steering"])
        self.contrary = self.add(enough & (share > 0.9) & known, "steering", rule, share=share)

    def find_steering_unit(self, length: Floats) -> None:
        """Hold steering against the wheel angle that its path needs, for axles the agent's `length` apart [m]."""
        rows = self.rows
        if "steering" not in rows:
            return
        middle, turned = self._turns()
        speed = rows["speed"][middle].astype(np.float64)
        value = rows["steering"][middle].astype(np.float64)
        slip = np.arcsin(np.clip(turned * length[middle] / (2 * np.maximum(speed, 1)), -0.9, 0.9))
        needs = np.arctan(2 * np.tan(slip))  # as in `study.intake.adapt`
        shows = (speed > 2) & (np.abs(turned) > BEND) & np.isfinite(value) & ~self.contrary[middle]
        middle, value, needs = middle[shows], value[shows] * DynamicsSettings().steering_unit, needs[shows]
        ratio, agent = value / needs, rows["agent"][middle]
        gains = np.full(self.agents, np.nan)
        for number in np.flatnonzero(np.bincount(agent, minlength=self.agents) >= FEW_BENDS):
            own = agent == number
            if np.std(value[own]) > 0 and np.corrcoef(value[own], needs[own])[0, 1] > FOLLOWS:
                gains[number] = np.median(ratio[own])
        gain = gains[rows["agent"]]
        rule = (
            "is in another unit: this agent's values are {gain:.3g} times the wheel angles that its path needs; 1 is "
            "1.22 rad of the front wheels (a degree is 0.0143)"
        )
        known = np.isfinite(rows["steering"])
        self.contrary |= self.add(((gain < GAIN[0]) | (gain > GAIN[1])) & known, "steering", rule, gain=gain)
        radians = _within(gains, RADIANS)
        judged = radians | _within(gains, SHARES)
        if judged.any() and radians.sum() > judged.sum() / 2:
            share = _within(ratio[judged[agent]], RADIANS).mean()
            self.findings.warn(
                "states.parquet",
                f", field 'steering': {share:.0%} of the values in bends, and {radians.sum()} of {judged.sum()} "
                "agents, look like wheel angles in radians; 1 is 1.22 rad: divide by 1.22, if they are",
            )

    def _first_of_agent(self, wrong: Bools, values: Floats) -> Floats:
        """Return, for each row, the value at the first wrong row of its agent."""
        firsts = np.zeros(self.agents)
        at = np.flatnonzero(wrong)[::-1]
        firsts[self.rows["agent"][at]] = values[at]
        return firsts[self.rows["agent"]]


def _find_twins(rows: Rows, known: Bools, rate: float, agents: Sequence[Agent], findings: Findings) -> Bools:
    """Return rows of agents that stand where another one stands, for half a second or more; the lower id stays."""
    good = np.flatnonzero(~known & ~_walks(rows, agents))
    good = good[np.lexsort((rows["x"][good], rows["step"][good]))]
    step, agent, x, y = (rows[name][good] for name in ("step", "agent", "x", "y"))
    pairs: list[NDArray[np.int64]] = []
    for apart in range(1, len(agents)):
        near = (step[apart:] == step[:-apart]) & (x[apart:] - x[:-apart] < APART)
        if not near.any():
            break
        here = np.flatnonzero(near & (np.abs(y[apart:] - y[:-apart]) < APART))
        pairs.append(np.stack([here, here + apart], axis=1))
    wrong = np.zeros(len(known), bool)
    if not pairs or not (both := np.concatenate(pairs)).size:
        return wrong
    ids = np.array([item.id for item in agents], np.int64)
    one, other = agent[both[:, 0]], agent[both[:, 1]]
    swap = ids[one] > ids[other]
    kept, twin = np.where(swap, other, one), np.where(swap, one, other)
    twin_row = good[np.where(swap, both[:, 0], both[:, 1])]
    _, which, counts = np.unique(kept * len(agents) + twin, return_inverse=True, return_counts=True)
    often = (counts >= max(3, rate / 2))[which]
    twin_of = np.zeros(len(known), np.int64)
    twin_of[twin_row[often]] = ids[kept[often]]
    wrong[twin_row[often]] = True
    text = ", field 'x' (step {step}, agent {agent}): stands where agent {twin} stands; list each vehicle once"
    findings.add_rows(wrong, rows["number"], ids[rows["agent"]], text, {"step": rows["step"], "twin": twin_of})
    return wrong
