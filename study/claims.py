"""The paper's claims, and the rule by which each is reproduced, not reproduced or inconclusive.

The rules' numbers come from the sweep file (`study.config.Rules`), so they are fixed before the run. A claim rests on
one or more findings, each of which holds, fails or stays open: all hold, the claim is reproduced; one fails, it is not
reproduced; else it is inconclusive. The intervals that decide are simultaneous ones, at 1 - alpha over the number of a
claim's contrasts. In design A, one encoder for each cell, an allowance for other encoders is added to their ends.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
import pandas as pd

from study import stats
from study.config import HEAD_SETS, FromJson, Grid, Number, Rules
from study.result import CellResult, SweepRecord
from study.stats import ACCURACY, STEERING, Estimate, Panel, Point

State = Literal["holds", "fails", "open"]
Outcome = Literal["reproduced", "not reproduced", "inconclusive", "not tested"]
OUTCOMES: tuple[Outcome, ...] = ("reproduced", "not reproduced", "inconclusive", "not tested")
Unit = Literal["points", "loss", "epochs", "ratio"]
Interval = Annotated[Estimate, FromJson]  # the same value, that pydantic can read back from a report.json

MINUS = "\N{MINUS SIGN}"
CLAIMS = {
    "H1": "Steering is good for all head sets: no meaningful difference in loss.",
    "H2": "Acceleration accuracy rises with the heads: full is best, then rec+plan, rec+pred, rec.",
    "H3": "Adding plan helps acceleration more than adding pred.",
    "H4": "full reaches rec's final accuracy in about 20 of 100 epochs.",
    "H5": "rec has the largest variance while still converging.",
    "D1": "Steering loss hardly changes with data size or head set.",
    "D2": "full beats rec at every data fraction.",
    "D3": "full with the smallest fraction beats rec with all the data.",
    "D4": "full reaches rec-at-100 %'s final accuracy in 20 of 100 epochs at 100 %, 40 at 25 %, 60 at 6.25 %.",
}
Needs = Callable[["Evidence"], list[Point]]
NEEDED = {"H1": tuple(HEAD_SETS), "H2": tuple(HEAD_SETS), "H3": ("rec+pred", "rec+plan"), "H5": tuple(HEAD_SETS)}
REACH = {1.0: 0.2, 0.25: 0.4, 0.0625: 0.6}  # fraction -> share of the epochs that the text names (Sec. V-A, V-B)


@dataclass(frozen=True)
class Finding:
    """One number that a claim rests on: what it is, its 95 % interval, the bounds that decide, and what follows."""

    what: str
    unit: Unit
    estimate: Interval
    decides: tuple[Number, Number]
    needs: str
    state: State
    p: Number = math.nan


@dataclass(frozen=True)
class Verdict:
    """A claim's verdict with its findings. `missing`: the cells without which it is not tested."""

    claim: str
    text: str
    rule: str
    outcome: Outcome
    reason: str
    findings: tuple[Finding, ...] = ()
    missing: tuple[str, ...] = ()


@dataclass(frozen=True)
class Contrast:
    """Paired difference of two cells' final scores, first minus second, over the seeds that both have.

    `p`: exact sign flips; `p_holm`: adjusted for the planned contrasts of the metric; `improvement`: probability that
    a run of the first scores above a run of the second; `detectable`: smallest difference found with 80 % power;
    `simultaneous`: t interval for all planned contrasts of the metric together; `episodes`: interval over test drives.
    """

    name: str
    metric: str
    first: Point
    second: Point
    difference: Interval
    simultaneous: tuple[Number, Number]
    p: Number
    p_holm: Number
    improvement: Number
    detectable: Number
    hierarchical: Interval | None
    episodes: Interval | None


def label(point: Point, grid: Grid) -> str:
    """A cell's name for people; the fraction only where the sweep has several."""
    heads, fraction = point
    return heads if len(grid.fractions) == 1 else f"{heads} at {fraction * 100:g} %"


def difference_label(first: Point, second: Point, grid: Grid) -> str:
    """Return the name for people of a difference, first minus second."""
    return f"{label(first, grid)} {MINUS} {label(second, grid)}"


# --- comparisons ----------------------------------------------------------------------------------------------------


def planned(grid: Grid) -> list[tuple[Point, Point]]:
    """The contrasts of the study: head sets against each other at each fraction, and little data against much."""
    heads = [name for name in HEAD_SETS if name in grid.heads]
    fractions = sorted(grid.fractions, reverse=True)
    contrasts = [
        ((second, fraction), (first, fraction))
        for fraction in fractions
        for first, second in itertools.combinations(heads, 2)
    ]
    if len(fractions) > 1 and grid.baseline in heads:
        top = (grid.baseline, fractions[0])
        contrasts += [((name, fractions[-1]), top) for name in heads if name != grid.baseline]
    return contrasts


def compare(record: SweepRecord, metric: str, curves: Panel) -> list[Contrast]:
    """Every planned contrast whose two cells are finished."""
    plan = planned(record.grid)
    there = [(first, second) for first, second in plan if first in curves and second in curves]
    scores = {point: stats.final(frame) for point, frame in curves.items()}
    differences = [stats.paired(scores[first], scores[second]) for first, second in there]
    there = [pair for pair, values in zip(there, differences, strict=True) if len(values)]
    differences = [values for values in differences if len(values)]
    units = [stats.by_encoder(values) for values in differences]
    p_values = [stats.sign_flip(values) for values in units]
    # A contrast that is planned and not there yet counts in the family as one that shows nothing.
    adjusted = stats.holm([*p_values, *[1.0] * (len(plan) - len(there))])
    level = 1 - record.grid.rules.alpha / max(len(plan), 1)
    return [
        Contrast(
            difference_label(first, second, record.grid),
            metric,
            first,
            second,
            stats.mean_interval(values),
            _t(unit, level),
            p,
            p_holm,
            stats.improvement(scores[first].to_numpy(), scores[second].to_numpy()),
            stats.detectable(unit),
            stats.hierarchical(values) if stats.encoders(values) > 1 else None,
            _episodes(record, first, second) if metric == ACCURACY else None,
        )
        for (first, second), values, unit, p, p_holm in zip(
            there, differences, units, p_values, adjusted[: len(there)], strict=True
        )
    ]


def _t(values: stats.Array, level: float) -> tuple[float, float]:
    low, high = stats.t_limits(values, level)
    return float(low), float(high)


def results_at(record: SweepRecord, point: Point) -> list[CellResult]:
    """The finished results of a head set and fraction, one for each encoder seed."""
    return [
        record.results[key]
        for key, cell in record.planned.items()
        if key in record.results and (cell.heads, cell.fraction) == point
    ]


def _episodes(record: SweepRecord, first: Point, second: Point) -> Estimate:
    """Interval of the difference in accuracy after the last epoch over test drives, all of the same weight."""

    def accuracy(point: Point) -> list[pd.Series]:
        return [
            stats.episode_accuracy(
                result.predictions["acceleration"],
                result.predictions["acceleration_label"],
                result.predictions["episode"],
            )
            for result in results_at(record, point)
        ]

    above, below = (pd.concat(accuracy(point), axis=1).mean(axis=1) for point in (first, second))
    units = (above - below).dropna().to_numpy(np.float64)
    low, high = stats.t_limits(units)
    return Estimate(float(units.mean()), float(low), float(high), len(units), "t, over test drives")


# --- verdicts -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Evidence:
    """What the rules look at: curves of accuracy and steering loss by head set and fraction.

    `floor` is the steering loss of the best constant command.
    """

    grid: Grid
    accuracy: Panel
    steering: Panel
    floor: float

    @property
    def rules(self) -> Rules:
        """The sweep file's rules."""
        return self.grid.rules

    @property
    def top(self) -> float:
        """The largest fraction."""
        return max(self.grid.fractions)

    @property
    def heads(self) -> list[str]:
        """Head sets in the order of the study."""
        return [name for name in HEAD_SETS if name in self.grid.heads]

    @property
    def rec(self) -> Point:
        """What the text's claims compare with."""
        return ("rec", self.top)

    def allowance(self, *points: Point) -> float:
        """Added to an interval's ends when its cells have one encoder each."""
        return self.rules.encoder_allowance if self.one_encoder(*points) else 0.0

    def one_encoder(self, *points: Point) -> bool:
        """Whether some of these cells have one encoder only."""
        return stats.design([self.accuracy[point] for point in points]) == "A"


def judge(record: SweepRecord) -> list[Verdict]:
    """A verdict on each claim of PAPER.md section 3, in its order; those that the sweep cannot test say so."""
    table, base = record.table(), ("rec", max(record.grid.fractions))
    floor = steering_floor(record, base) if results_at(record, base) else math.nan
    return weigh(Evidence(record.grid, stats.panel(table, ACCURACY), stats.panel(table, STEERING), floor))


def weigh(evidence: Evidence) -> list[Verdict]:
    """A verdict on each claim from the curves alone."""
    return [_verdict(claim, evidence) for claim in CLAIMS]


def _verdict(claim: str, evidence: Evidence) -> Verdict:
    needs, rule, find = _RULES[claim]
    text, about = CLAIMS[claim], rule(evidence)
    untestable, missing = _why_not(claim, needs, evidence)
    if untestable:
        return Verdict(claim, text, about, "not tested", untestable, missing=missing)
    points = needs(evidence)
    findings = tuple(find(evidence, points))
    states = [finding.state for finding in findings]
    if all(state == "holds" for state in states):
        return Verdict(claim, text, about, "reproduced", _reason(findings, "holds"), findings)
    if "fails" in states:
        return Verdict(claim, text, about, "not reproduced", _reason(findings, "fails"), findings)
    return Verdict(claim, text, about, "inconclusive", _reason(findings, "open"), findings)


def _why_not(claim: str, needs: Needs, evidence: Evidence) -> tuple[str, tuple[str, ...]]:
    """Why a claim cannot be tested, and the cells that are not finished; empty when it can."""
    grid = evidence.grid
    absent = [name for name in HEAD_SETS if name in NEEDED.get(claim, ("rec", "full")) and name not in grid.heads]
    if absent:
        return f"This sweep has no {' and no '.join(absent)}.", ()
    if claim.startswith("D") and len(grid.fractions) < 2:
        return "This sweep has one data fraction.", ()
    if claim == "D4" and not set(REACH) & set(grid.fractions):
        return "This sweep has none of the fractions that the text names.", ()
    missing = tuple(label(point, grid) for point in needs(evidence) if point not in evidence.accuracy)
    return (f"Not finished: {', '.join(missing)}." if missing else ""), missing


def _reason(findings: Sequence[Finding], state: State) -> str:
    concerned = [finding.what for finding in findings if finding.state == state]
    if len(concerned) == len(findings) and len(findings) > 1:
        named = f"All {len(findings)} findings"
    else:
        named = ", ".join(concerned)
    verb = {"holds": "meets the rule", "fails": "contradicts the claim", "open": "leaves it open"}[state]
    if len(concerned) > 1:
        verb = verb.replace("meets", "meet").replace("contradicts", "contradict").replace("leaves", "leave")
    return f"{named}: {verb}." if len(concerned) == 1 else f"{named} {verb}."


def _state(holds: bool, fails: bool) -> State:
    return "holds" if holds else "fails" if fails else "open"


# --- the rules ------------------------------------------------------------------------------------------------------


def _above(evidence: Evidence, pairs: Iterable[tuple[Point, Point]]) -> list[Finding]:
    """The first's accuracy is above the second's."""
    listed, rules = list(pairs), evidence.rules
    findings = []
    for first, second in listed:
        values = stats.paired(stats.final(evidence.accuracy[first]), stats.final(evidence.accuracy[second]))
        units, more = stats.by_encoder(values), evidence.allowance(first, second)
        low, high = _t(units, 1 - rules.alpha / len(listed))
        low, high = low - more, high + more
        findings.append(
            Finding(
                difference_label(first, second, evidence.grid),
                "points",
                stats.mean_interval(values),
                (low, high),
                "above 0",
                _state(low > 0, high < rules.accuracy_margin),
                stats.sign_flip(units),
            )
        )
    return findings


def _same_steering(evidence: Evidence, points: Sequence[Point]) -> list[Finding]:
    """Steering losses differ from the baseline's by less than the margin (two one-sided tests)."""
    rules, base = evidence.rules, evidence.rec
    margin = rules.steering_margin * evidence.floor
    others = [point for point in points if point != base]
    findings = []
    for point in others:
        values = stats.paired(stats.final(evidence.steering[point]), stats.final(evidence.steering[base]))
        units = stats.by_encoder(values)
        p = stats.equivalence(units, margin)
        low, high = _t(units, 1 - rules.alpha / len(others))
        findings.append(
            Finding(
                difference_label(point, base, evidence.grid),
                "loss",
                stats.mean_interval(values),
                (low, high),
                f"within ±{1000 * margin:.2f}",
                _state(p <= rules.alpha, low > margin or high < -margin),
                p,
            )
        )
    return findings


def steering_floor(record: SweepRecord, point: Point) -> float:
    """Steering loss of the best constant command on the test labels."""
    labels = results_at(record, point)[0].predictions["steering_label"]
    return stats.steering_floor(labels.astype(np.float64))


def _reach(evidence: Evidence, shares: Mapping[Point, float]) -> list[Finding]:
    """The mean curve reaches the baseline's final accuracy by the epoch that the text names, and some slack."""
    base = evidence.accuracy[evidence.rec]
    mean, goal = base.mean().to_numpy(), float(stats.final(base).mean())
    own = stats.epochs_to_reach(base, base)
    findings = []
    for point, share in shares.items():
        curves = evidence.accuracy[point]
        bound = (share + evidence.rules.reach_slack) * curves.shape[1]
        found, more = stats.epochs_to_reach(curves, base), evidence.allowance(point, evidence.rec)
        in_time = found.high <= bound
        # The baseline itself, even were its encoder better by the allowance, must be slower: else speed shows nothing.
        distinct = in_time and own.low > found.high and goal - mean[int(found.high) - 1] > more
        behind = float(curves.mean().iloc[: max(int(bound), 1)].max()) + more < goal
        findings.append(
            Finding(
                f"{label(point, evidence.grid)} reaches {label(evidence.rec, evidence.grid)}'s final",
                "epochs",
                found,
                (found.low, found.high),
                f"at most {bound:g}",
                _state(bool(distinct), found.low > bound and behind),
            )
        )
    return findings


def _most_spread(evidence: Evidence, points: Sequence[Point]) -> list[Finding]:
    """The baseline's variance between policies is above each other's, over the epochs of its transient."""
    rules, base = evidence.rules, evidence.accuracy[evidence.rec]
    epochs = stats.transient(base)
    others = [point for point in points if point != evidence.rec]
    findings = []
    for point in others:
        curves = evidence.accuracy[point]
        decides = stats.spread_ratio(base, curves, epochs, 1 - rules.alpha / len(others))
        factor = rules.spread_factor if evidence.one_encoder(point, evidence.rec) else 1.0
        findings.append(
            Finding(
                f"variance of {evidence.rec[0]} over {point[0]}, epochs 1 to {epochs}",
                "ratio",
                stats.spread_ratio(base, curves, epochs),
                (decides.low / factor, decides.high * factor),
                "above 1",
                _state(decides.low / factor > 1, decides.high * factor < 1),
            )
        )
    return findings


def _all(evidence: Evidence) -> list[Point]:
    return [(heads, fraction) for fraction in evidence.grid.fractions for heads in evidence.heads]


def _at_top(evidence: Evidence) -> list[Point]:
    return [(heads, evidence.top) for heads in evidence.heads]


def _two_heads(evidence: Evidence) -> list[Point]:
    return [("rec+plan", evidence.top), ("rec+pred", evidence.top)]


def _full_and_rec(evidence: Evidence) -> list[Point]:
    return [(heads, fraction) for fraction in evidence.grid.fractions for heads in ("full", evidence.rec[0])]


def _extremes(evidence: Evidence) -> list[Point]:
    return [("full", min(evidence.grid.fractions)), evidence.rec]


def _named_fractions(evidence: Evidence) -> list[Point]:
    return [("full", fraction) for fraction in REACH if fraction in evidence.grid.fractions]


def _above_rule(evidence: Evidence) -> str:
    rules = evidence.rules
    return (
        "Each difference's simultaneous interval lies above 0. It fails where the interval excludes a gain of "
        f"{rules.accuracy_margin * 100:.1f} points. With one encoder for each cell the interval is widened by "
        f"{rules.encoder_allowance * 100:.1f} points on either side."
    )


def _steering_rule(evidence: Evidence) -> str:
    return (
        f"Equivalence: two one-sided t tests at {evidence.rules.alpha:g} against a margin of "
        f"{evidence.rules.steering_margin * 100:g} % of the best constant command's loss. It fails where a "
        "simultaneous interval lies outside the margin."
    )


def _reach_rule(evidence: Evidence) -> str:
    rules = evidence.rules
    return (
        f"The upper end of the epoch's interval is at most the text's epoch and {rules.reach_slack * 100:g} % of all "
        "epochs, and below the interval of the epoch at which rec itself reaches its final. With one encoder for each "
        f"cell, rec must then still be {rules.encoder_allowance * 100:.1f} points "
        "below its final, so that a copy of rec with a luckier encoder would not pass."
    )


def _spread_rule(evidence: Evidence) -> str:
    return (
        "The ratio of the variances over policies, mean over the epochs in which rec makes 95 % of its rise, has a "
        "simultaneous interval above 1. With one encoder for each cell the interval is widened by a factor of "
        f"{evidence.rules.spread_factor:g} on either side."
    )


def _ladder(evidence: Evidence, points: Sequence[Point]) -> list[Finding]:
    return _above(evidence, [(second, first) for first, second in itertools.pairwise(points)])


def _first_above_second(evidence: Evidence, points: Sequence[Point]) -> list[Finding]:
    return _above(evidence, [(points[0], points[1])])


def _by_fraction(evidence: Evidence, _: Sequence[Point]) -> list[Finding]:
    return _above(evidence, [(("full", fraction), (evidence.rec[0], fraction)) for fraction in evidence.grid.fractions])


_RULES: dict[str, tuple[Needs, Callable[[Evidence], str], Callable[[Evidence, Sequence[Point]], list[Finding]]]] = {
    "H1": (_at_top, _steering_rule, _same_steering),
    "H2": (_at_top, _above_rule, _ladder),
    "H3": (_two_heads, _above_rule, _first_above_second),
    "H4": (
        lambda evidence: [("full", evidence.top), evidence.rec],
        _reach_rule,
        lambda evidence, points: _reach(evidence, {points[0]: REACH[1.0]}),
    ),
    "H5": (_at_top, _spread_rule, _most_spread),
    "D1": (_all, _steering_rule, _same_steering),
    "D2": (_full_and_rec, _above_rule, _by_fraction),
    "D3": (_extremes, _above_rule, _first_above_second),
    "D4": (
        lambda evidence: [*_named_fractions(evidence), evidence.rec],
        _reach_rule,
        lambda evidence, points: _reach(evidence, {point: REACH[point[1]] for point in points[:-1]}),
    ),
}
