"""The paper's claims, and the rule by which each is reproduced, not reproduced or inconclusive.

The rules' numbers come from the sweep file (`study.config.grid.Rules`), so they are fixed before the run. A claim rests
on one or more findings, each of which holds, fails or stays open: all hold, the claim is reproduced; one fails, it is
not reproduced; else it is inconclusive. The intervals that decide are simultaneous ones, at 1 - alpha over the number
of a claim's contrasts. In design A, one encoder for each cell, an allowance for other encoders is added to their ends.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from study.analysis import comparisons, convergence, intervals, learning_curves, predictions
from study.analysis.effects import Interval, Unit, difference_label, label, results_at
from study.analysis.intervals import Estimate
from study.analysis.learning_curves import ACCURACY, STEERING, Panel, Point
from study.config.grid import Grid, Rules
from study.config.heads import HEAD_SETS
from study.config.settings import Number
from study.results.sweep_record import SweepRecord

State = Literal["holds", "fails", "open"]
Outcome = Literal["reproduced", "not reproduced", "inconclusive", "not tested"]
OUTCOMES: tuple[Outcome, ...] = ("reproduced", "not reproduced", "inconclusive", "not tested")
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
class Evidence:
    """Curves of accuracy and steering loss by head set and fraction, which the rules look at.

    `floor` is the steering loss of the best constant command.
    """

    grid: Grid
    accuracy: Panel
    steering: Panel
    floor: float

    @property
    def rules(self) -> Rules:
        """Return the sweep file's rules."""
        return self.grid.rules

    @property
    def top(self) -> float:
        """Return the largest fraction."""
        return max(self.grid.fractions)

    @property
    def heads(self) -> list[str]:
        """Return the head sets in the order of the study."""
        return [name for name in HEAD_SETS if name in self.grid.heads]

    @property
    def rec(self) -> Point:
        """Return the cell that the text's claims compare with."""
        return ("rec", self.top)

    def allowance(self, *points: Point) -> float:
        """Return what is added to an interval's ends: 0 where its cells have several encoders each."""
        return self.rules.encoder_allowance if self.one_encoder(*points) else 0.0

    def one_encoder(self, *points: Point) -> bool:
        """Return whether some of these cells have one encoder only."""
        return learning_curves.design([self.accuracy[point] for point in points]) == "A"


@dataclass(frozen=True)
class Claim:
    """A claim of the text: the cells that it is about, the rule in words, and the findings that decide.

    `heads`: the head sets without which a sweep cannot test it.
    """

    text: str
    points: Callable[[Evidence], list[Point]]
    rule: Callable[[Rules], str]
    find: Callable[[Evidence, list[Point]], list[Finding]]
    heads: tuple[str, ...] = ("rec", "full")


def judge(record: SweepRecord) -> list[Verdict]:
    """Return a verdict on each claim of PAPER.md section 3, in its order, also on those that the sweep cannot test."""
    table, base = record.table(), ("rec", max(record.grid.fractions))
    floor = steering_floor(record, base) if results_at(record, base) else math.nan
    return weigh(
        Evidence(record.grid, learning_curves.panel(table, ACCURACY), learning_curves.panel(table, STEERING), floor)
    )


def weigh(evidence: Evidence) -> list[Verdict]:
    """Return a verdict on each claim from the curves alone."""
    return [_verdict(name, claim, evidence) for name, claim in CLAIMS.items()]


def _verdict(name: str, claim: Claim, evidence: Evidence) -> Verdict:
    rule = claim.rule(evidence.rules)
    untestable, missing = _why_not(name, claim, evidence)
    if untestable:
        return Verdict(name, claim.text, rule, "not tested", untestable, missing=missing)
    findings = tuple(claim.find(evidence, claim.points(evidence)))
    states = {finding.state for finding in findings}
    state: State = "fails" if "fails" in states else "open" if "open" in states else "holds"
    outcome, one, several = _OUTCOME[state]
    concerned = [finding.what for finding in findings if finding.state == state]
    if len(concerned) == 1:
        reason = f"{concerned[0]}: {one}."
    else:
        whose = f"All {len(findings)} findings" if len(concerned) == len(findings) else ", ".join(concerned)
        reason = f"{whose} {several}."
    return Verdict(name, claim.text, rule, outcome, reason, findings)


_OUTCOME: dict[State, tuple[Outcome, str, str]] = {  # with the reason in words, for one finding and for several
    "holds": ("reproduced", "meets the rule", "meet the rule"),
    "fails": ("not reproduced", "contradicts the claim", "contradict the claim"),
    "open": ("inconclusive", "leaves it open", "leave it open"),
}


def _why_not(name: str, claim: Claim, evidence: Evidence) -> tuple[str, tuple[str, ...]]:
    """Return why a claim cannot be tested, and the cells that are not finished; empty when it can."""
    grid = evidence.grid
    absent = [heads for heads in HEAD_SETS if heads in claim.heads and heads not in grid.heads]
    if absent:
        return f"This sweep has no {' and no '.join(absent)}.", ()
    if name.startswith("D") and len(grid.fractions) < 2:
        return "This sweep has one data fraction.", ()
    if name == "D4" and not set(REACH) & set(grid.fractions):
        return "This sweep has none of the fractions that the text names.", ()
    missing = tuple(label(point, grid) for point in claim.points(evidence) if point not in evidence.accuracy)
    return (f"Not finished: {', '.join(missing)}." if missing else ""), missing


def _state(holds: bool, fails: bool) -> State:
    return "holds" if holds else "fails" if fails else "open"


def _above(evidence: Evidence, pairs: Sequence[tuple[Point, Point]]) -> list[Finding]:
    """Return findings that the first's accuracy is above the second's."""
    rules, findings = evidence.rules, []
    for first, second in pairs:
        what, difference, units, (low, high) = _difference(evidence, evidence.accuracy, first, second, len(pairs))
        more = evidence.allowance(first, second)
        low, high = low - more, high + more
        state = _state(low > 0, high < rules.accuracy_margin)
        findings.append(
            Finding(what, "points", difference, (low, high), "above 0", state, comparisons.sign_flip(units))
        )
    return findings


def _same_steering(evidence: Evidence, points: Sequence[Point]) -> list[Finding]:
    """Return findings that steering losses differ from the baseline's by less than the margin (two one-sided tests)."""
    rules, margin = evidence.rules, evidence.rules.steering_margin * evidence.floor
    others, findings = [point for point in points if point != evidence.rec], []
    for point in others:
        what, difference, units, ends = _difference(evidence, evidence.steering, point, evidence.rec, len(others))
        p = comparisons.equivalence(units, margin)
        state = _state(p <= rules.alpha, ends[0] > margin or ends[1] < -margin)
        findings.append(Finding(what, "loss", difference, ends, f"within ±{1000 * margin:.2f}", state, p))
    return findings


def _difference(
    evidence: Evidence, curves: Panel, first: Point, second: Point, family: int
) -> tuple[str, Estimate, learning_curves.Array, tuple[float, float]]:
    """Return a paired difference in final scores: name, interval, sampling units, and the ends for a whole family."""
    values = comparisons.paired(learning_curves.final(curves[first]), learning_curves.final(curves[second]))
    units = learning_curves.by_encoder(values)
    what = difference_label(first, second, evidence.grid)
    return what, intervals.mean_interval(values), units, intervals.t_limits(units, 1 - evidence.rules.alpha / family)


def steering_floor(record: SweepRecord, point: Point) -> float:
    """Return the steering loss of the best constant command on the test labels."""
    labels = results_at(record, point)[0].predictions["steering_label"]
    return predictions.steering_floor(labels.astype(np.float64))


def _reach(evidence: Evidence, shares: Mapping[Point, float]) -> list[Finding]:
    """Return findings that mean curves reach the baseline's final accuracy by the epochs that the text names."""
    base = evidence.accuracy[evidence.rec]
    mean, goal = base.mean().to_numpy(), float(learning_curves.final(base).mean())
    own = convergence.epochs_to_reach(base, base)
    findings = []
    for point, share in shares.items():
        curves = evidence.accuracy[point]
        bound = (share + evidence.rules.reach_slack) * curves.shape[1]
        epoch, more = convergence.epochs_to_reach(curves, base), evidence.allowance(point, evidence.rec)
        in_time = epoch.high <= bound
        # The baseline itself, even were its encoder better by the allowance, must be slower: else speed shows nothing.
        distinct = in_time and own.low > epoch.high and goal - mean[int(epoch.high) - 1] > more
        behind = float(curves.mean().iloc[: max(int(bound), 1)].max()) + more < goal
        what = f"{label(point, evidence.grid)} reaches {label(evidence.rec, evidence.grid)}'s final"
        state = _state(bool(distinct), epoch.low > bound and behind)
        findings.append(Finding(what, "epochs", epoch, (epoch.low, epoch.high), f"at most {bound:g}", state))
    return findings


def _most_spread(evidence: Evidence, points: Sequence[Point]) -> list[Finding]:
    """Return findings that the baseline's policies vary more than each other's, over the epochs of its transient."""
    rules, base = evidence.rules, evidence.accuracy[evidence.rec]
    epochs = convergence.transient(base)
    others, findings = [point for point in points if point != evidence.rec], []
    for point in others:
        curves = evidence.accuracy[point]
        decides = convergence.spread_ratio(base, curves, epochs, 1 - rules.alpha / len(others))
        factor = rules.spread_factor if evidence.one_encoder(point, evidence.rec) else 1.0
        low, high = decides.low / factor, decides.high * factor
        what = f"variance of {evidence.rec[0]} over {point[0]}, epochs 1 to {epochs}"
        ratio = convergence.spread_ratio(base, curves, epochs)
        findings.append(Finding(what, "ratio", ratio, (low, high), "above 1", _state(low > 1, high < 1)))
    return findings


def _above_rule(rules: Rules) -> str:
    return (
        "Each difference's simultaneous interval lies above 0. It fails where the interval excludes a gain of "
        f"{rules.accuracy_margin * 100:.1f} points. With one encoder for each cell the interval is widened by "
        f"{rules.encoder_allowance * 100:.1f} points on either side."
    )


def _steering_rule(rules: Rules) -> str:
    return (
        f"Equivalence: two one-sided t tests at {rules.alpha:g} against a margin of "
        f"{rules.steering_margin * 100:g} % of the best constant command's loss. It fails where a "
        "simultaneous interval lies outside the margin."
    )


def _reach_rule(rules: Rules) -> str:
    return (
        f"The upper end of the epoch's interval is at most the text's epoch and {rules.reach_slack * 100:g} % of all "
        "epochs, and below the interval of the epoch at which rec itself reaches its final. With one encoder for each "
        f"cell, rec must then still be {rules.encoder_allowance * 100:.1f} points "
        "below its final, so that a copy of rec with a luckier encoder would not pass."
    )


def _spread_rule(rules: Rules) -> str:
    return (
        "The ratio of the variances over policies, mean over the epochs in which rec makes 95 % of its rise, has a "
        "simultaneous interval above 1. With one encoder for each cell the interval is widened by a factor of "
        f"{rules.spread_factor:g} on either side."
    )


def _at_top(evidence: Evidence) -> list[Point]:
    return [(heads, evidence.top) for heads in evidence.heads]


def _ladder(evidence: Evidence, points: Sequence[Point]) -> list[Finding]:
    return _above(evidence, [(second, first) for first, second in itertools.pairwise(points)])


def _in_pairs(evidence: Evidence, points: Sequence[Point]) -> list[Finding]:
    return _above(evidence, list(zip(points[::2], points[1::2], strict=True)))


CLAIMS = {
    "H1": Claim(
        "Steering is good for all head sets: no meaningful difference in loss.",
        _at_top,
        _steering_rule,
        _same_steering,
        tuple(HEAD_SETS),
    ),
    "H2": Claim(
        "Acceleration accuracy rises with the heads: full is best, then rec+plan, rec+pred, rec.",
        _at_top,
        _above_rule,
        _ladder,
        tuple(HEAD_SETS),
    ),
    "H3": Claim(
        "Adding plan helps acceleration more than adding pred.",
        lambda evidence: [("rec+plan", evidence.top), ("rec+pred", evidence.top)],
        _above_rule,
        _in_pairs,
        ("rec+pred", "rec+plan"),
    ),
    "H4": Claim(
        "full reaches rec's final accuracy in about 20 of 100 epochs.",
        lambda evidence: [("full", evidence.top), evidence.rec],
        _reach_rule,
        lambda evidence, points: _reach(evidence, {points[0]: REACH[1.0]}),
    ),
    "H5": Claim(
        "rec has the largest variance while still converging.", _at_top, _spread_rule, _most_spread, tuple(HEAD_SETS)
    ),
    "D1": Claim(
        "Steering loss hardly changes with data size or head set.",
        lambda evidence: [(heads, share) for share in evidence.grid.fractions for heads in evidence.heads],
        _steering_rule,
        _same_steering,
    ),
    "D2": Claim(
        "full beats rec at every data fraction.",
        lambda evidence: [(heads, share) for share in evidence.grid.fractions for heads in ("full", "rec")],
        _above_rule,
        _in_pairs,
    ),
    "D3": Claim(
        "full with the smallest fraction beats rec with all the data.",
        lambda evidence: [("full", min(evidence.grid.fractions)), evidence.rec],
        _above_rule,
        _in_pairs,
    ),
    "D4": Claim(
        "full reaches rec-at-100 %'s final accuracy in 20 of 100 epochs at 100 %, 40 at 25 %, 60 at 6.25 %.",
        lambda evidence: [*(("full", share) for share in REACH if share in evidence.grid.fractions), evidence.rec],
        _reach_rule,
        lambda evidence, points: _reach(evidence, {point: REACH[point[1]] for point in points[:-1]}),
    ),
}
