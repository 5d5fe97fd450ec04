"""The paper's claims, and the rule by which each is reproduced, not reproduced or inconclusive.

To add a claim, add its record to `CLAIMS`, at the end of this file. The rules' numbers come from the sweep file
(`study.config.grid.Rules`), so they are fixed before the run. A claim rests on one or more findings, each of which
holds, fails or stays open: if all hold, the claim is reproduced; if one fails, it is not reproduced; else it is
inconclusive. The intervals that decide are simultaneous, at 1 - alpha over the number of a claim's pairs. In design A,
one encoder for each cell, an allowance for other encoders is added to their ends.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import pandas as pd

from study.analysis import comparisons, convergence, intervals, learning_curves, predictions
from study.analysis.effects import Interval, Unit, difference_label, label, results_at
from study.analysis.learning_curves import ACCURACY, STEERING, Panel, Point
from study.config.grid import Grid, Rules
from study.config.settings import Number
from study.results.sweep_record import SweepRecord

State = Literal["holds", "fails", "open"]
Outcome = Literal["reproduced", "not reproduced", "inconclusive", "not tested"]
OUTCOMES: tuple[Outcome, ...] = ("reproduced", "not reproduced", "inconclusive", "not tested")
Pair = tuple[Point, Point]


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
    section: str
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

    def one_encoder(self, pair: Pair) -> bool:
        """Return whether one of these cells has one encoder only."""
        return learning_curves.design([self.accuracy[point] for point in pair]) == "A"

    def allowance(self, pair: Pair) -> float:
        """Return what is added to an interval's ends: 0 where both cells have several encoders."""
        return self.rules.encoder_allowance if self.one_encoder(pair) else 0.0


@dataclass(frozen=True)
class Rule:
    """A way to decide: its words, with the numbers of a sweep file, and a claim's finding on each pair of cells."""

    words: Callable[[Rules], str]
    find: Callable[[Evidence, Sequence[Pair]], list[Finding]]


@dataclass(frozen=True)
class Claim:
    """A claim of the paper.

    `section` of the paper; `needs`: the head sets without which a sweep cannot test it; `pairs`: which cells of a grid
    it compares, none where the sweep lacks the data fractions; `rule` decides on each pair.
    """

    name: str
    section: str
    text: str
    needs: tuple[str, ...]
    rule: Rule
    pairs: Callable[[Grid], list[Pair]]


def judge(record: SweepRecord) -> list[Verdict]:
    """Return a verdict on each of `CLAIMS`, also on those that the sweep cannot test."""
    table, base = record.table(), ("rec", max(record.grid.fractions))
    floor = steering_floor(record, base) if results_at(record, base) else math.nan
    return weigh(
        Evidence(record.grid, learning_curves.panel(table, ACCURACY), learning_curves.panel(table, STEERING), floor)
    )


def weigh(evidence: Evidence) -> list[Verdict]:
    """Return a verdict on each of `CLAIMS` from the curves alone."""
    return [_verdict(claim, evidence) for claim in CLAIMS.values()]


def _verdict(claim: Claim, evidence: Evidence) -> Verdict:
    record = claim.name, claim.section, claim.text, claim.rule.words(evidence.rules)
    untestable, missing = _why_not(claim, evidence)
    if untestable:
        return Verdict(*record, "not tested", untestable, missing=missing)
    findings = tuple(claim.rule.find(evidence, claim.pairs(evidence.grid)))
    states = {finding.state for finding in findings}
    state: State = "fails" if "fails" in states else "open" if "open" in states else "holds"
    outcome, one, several = _OUTCOME[state]
    concerned = [finding.what for finding in findings if finding.state == state]
    if len(concerned) == 1:
        reason = f"{concerned[0]}: {one}."
    else:
        subject = f"All {len(findings)} findings" if len(concerned) == len(findings) else ", ".join(concerned)
        reason = f"{subject} {several}."
    return Verdict(*record, outcome, reason, findings)


_OUTCOME: dict[State, tuple[Outcome, str, str]] = {  # with the reason in words, for one finding and for several
    "holds": ("reproduced", "meets the rule", "meet the rule"),
    "fails": ("not reproduced", "contradicts the claim", "contradict the claim"),
    "open": ("inconclusive", "leaves it open", "leave it open"),
}


def _why_not(claim: Claim, evidence: Evidence) -> tuple[str, tuple[str, ...]]:
    """Return why a claim cannot be tested, and the cells that are not finished; empty when it can."""
    grid = evidence.grid
    absent = [heads for heads in claim.needs if heads not in grid.heads]
    if absent:
        return f"This sweep has no {' and no '.join(absent)}.", ()
    pairs = claim.pairs(grid)
    if not pairs:
        return f"This sweep lacks the data fractions; it has {', '.join(f'{100 * x:g} %' for x in grid.fractions)}.", ()
    points = dict.fromkeys(point for pair in pairs for point in pair)
    missing = tuple(label(point, grid) for point in points if point not in evidence.accuracy)
    return (f"Not finished: {', '.join(missing)}." if missing else ""), missing


def _state(*, holds: bool, fails: bool) -> State:
    return "holds" if holds else "fails" if fails else "open"


def steering_floor(record: SweepRecord, point: Point) -> float:
    """Return the steering loss of the best constant command on the test labels."""
    return predictions.steering_floor(results_at(record, point)[0].predictions["steering_label"].astype("float64"))


# --- rules ----------------------------------------------------------------------------------------------------------


def _find_above(evidence: Evidence, pairs: Sequence[Pair]) -> list[Finding]:
    """Return findings that the first's accuracy is above the second's."""
    findings = []
    for pair in pairs:
        values = _differences(evidence.accuracy, pair)
        units, allowance = learning_curves.by_encoder(values), evidence.allowance(pair)
        low, high = intervals.t_limits(units, 1 - evidence.rules.alpha / len(pairs))
        decides = low - allowance, high + allowance
        state = _state(holds=decides[0] > 0, fails=decides[1] < evidence.rules.accuracy_margin)
        what, p = difference_label(*pair, evidence.grid), comparisons.sign_flip(units)
        findings.append(Finding(what, "points", intervals.mean_interval(values), decides, "above 0", state, p))
    return findings


def _find_same_steering(evidence: Evidence, pairs: Sequence[Pair]) -> list[Finding]:
    """Return findings that steering losses differ by less than the margin (two one-sided tests)."""
    rules, margin = evidence.rules, evidence.rules.steering_margin * evidence.floor
    findings = []
    for pair in pairs:
        values = _differences(evidence.steering, pair)
        units = learning_curves.by_encoder(values)
        p, decides = comparisons.equivalence(units, margin), intervals.t_limits(units, 1 - rules.alpha / len(pairs))
        state = _state(holds=p <= rules.alpha, fails=decides[0] > margin or decides[1] < -margin)
        what, needs = difference_label(*pair, evidence.grid), f"within ±{1000 * margin:.2f}"
        findings.append(Finding(what, "loss", intervals.mean_interval(values), decides, needs, state, p))
    return findings


def _differences(curves: Panel, pair: Pair) -> pd.Series:
    """Return differences in final scores, paired by seed."""
    return comparisons.paired(*(learning_curves.final(curves[point]) for point in pair))


def _find_reach(evidence: Evidence, pairs: Sequence[Pair]) -> list[Finding]:
    """Return findings that the first's mean curve reaches the second's final accuracy by the epoch of the text."""
    findings = []
    for pair in pairs:
        (point, reference), (curves, base) = pair, (evidence.accuracy[point] for point in pair)
        mean, goal = base.mean().to_numpy(), float(learning_curves.final(base).mean())
        bound = (REACH.get(point[1], REACH[1.0]) + evidence.rules.reach_slack) * curves.shape[1]
        epoch, allowance = convergence.epochs_to_reach(curves, base), evidence.allowance(pair)
        # The baseline itself, even were its encoder better by the allowance, must be slower: else speed shows nothing.
        slower = convergence.epochs_to_reach(base, base).low > epoch.high
        distinct = epoch.high <= bound and slower and goal - mean[int(epoch.high) - 1] > allowance
        behind = float(curves.mean().iloc[: max(int(bound), 1)].max()) + allowance < goal
        what = f"{label(point, evidence.grid)} reaches {label(reference, evidence.grid)}'s final"
        state = _state(holds=bool(distinct), fails=epoch.low > bound and behind)
        findings.append(Finding(what, "epochs", epoch, (epoch.low, epoch.high), f"at most {bound:g}", state))
    return findings


def _find_more_spread(evidence: Evidence, pairs: Sequence[Pair]) -> list[Finding]:
    """Return findings that the first's policies vary more than the second's, over the epochs of its transient."""
    rules, findings = evidence.rules, []
    for pair in pairs:
        first, second = (evidence.accuracy[point] for point in pair)
        epochs = convergence.transient(first)
        simultaneous = convergence.spread_ratio(first, second, epochs, 1 - rules.alpha / len(pairs))
        factor = rules.spread_factor if evidence.one_encoder(pair) else 1.0
        low, high = simultaneous.low / factor, simultaneous.high * factor
        what = f"variance of {pair[0][0]} over {pair[1][0]}, epochs 1 to {epochs}"
        ratio, state = convergence.spread_ratio(first, second, epochs), _state(holds=low > 1, fails=high < 1)
        findings.append(Finding(what, "ratio", ratio, (low, high), "above 1", state))
    return findings


ABOVE = Rule(
    lambda rules: (
        "Each difference's simultaneous interval lies above 0. It fails where the interval excludes a gain of "
        f"{rules.accuracy_margin * 100:.1f} points. With one encoder for each cell the interval is widened by "
        f"{rules.encoder_allowance * 100:.1f} points on either side."
    ),
    _find_above,
)
SAME_STEERING = Rule(
    lambda rules: (
        f"Equivalence: two one-sided t tests at {rules.alpha:g} against a margin of "
        f"{rules.steering_margin * 100:g} % of the best constant command's loss. It fails where a "
        "simultaneous interval lies outside the margin."
    ),
    _find_same_steering,
)
REACHES = Rule(
    lambda rules: (
        f"The upper end of the epoch's interval is at most the text's epoch and {rules.reach_slack * 100:g} % of all "
        "epochs, and below the interval of the epoch at which rec itself reaches its final. With one encoder for each "
        f"cell, rec must then still be {rules.encoder_allowance * 100:.1f} points "
        "below its final, so that a copy of rec with a luckier encoder would not pass."
    ),
    _find_reach,
)
MORE_SPREAD = Rule(
    lambda rules: (
        "The ratio of the variances over policies, mean over the epochs in which rec makes 95 % of its rise, has a "
        "simultaneous interval above 1. With one encoder for each cell the interval is widened by a factor of "
        f"{rules.spread_factor:g} on either side."
    ),
    _find_more_spread,
)

# --- the claims -----------------------------------------------------------------------------------------------------

PAPER_SETS = ("rec", "rec+pred", "rec+plan", "full")  # the paper's own: a further head set takes no claim away
REACH = {1.0: 0.2, 0.25: 0.4, 0.0625: 0.6}  # fraction -> share of the epochs that the text names (Sec. V-A, V-B)


def at_top(*names: tuple[str, str]) -> Callable[[Grid], list[Pair]]:
    """Return pairs of head sets, each with the largest fraction of the data."""
    return lambda grid: [((first, max(grid.fractions)), (second, max(grid.fractions))) for first, second in names]


def by_fraction(pairs: Callable[[Grid, Point], list[Pair]]) -> Callable[[Grid], list[Pair]]:
    """Return pairs of a grid with several fractions, given `rec` with the largest; none of a grid with one."""
    return lambda grid: pairs(grid, ("rec", max(grid.fractions))) if len(grid.fractions) > 1 else []


CLAIMS: dict[str, Claim] = {
    claim.name: claim
    for claim in (
        Claim(
            "H1",
            "V-A",
            "Steering is good for all head sets: no meaningful difference in loss.",
            PAPER_SETS,
            SAME_STEERING,
            at_top(("rec+pred", "rec"), ("rec+plan", "rec"), ("full", "rec")),
        ),
        Claim(
            "H2",
            "V-A",
            "Acceleration accuracy rises with the heads: full is best, then rec+plan, rec+pred, rec.",
            PAPER_SETS,
            ABOVE,
            at_top(("rec+pred", "rec"), ("rec+plan", "rec+pred"), ("full", "rec+plan")),
        ),
        Claim(
            "H3",
            "V-A",
            "Adding plan helps acceleration more than adding pred.",
            ("rec+pred", "rec+plan"),
            ABOVE,
            at_top(("rec+plan", "rec+pred")),
        ),
        Claim(
            "H4",
            "V-A",
            "full reaches rec's final accuracy in about 20 of 100 epochs.",
            ("rec", "full"),
            REACHES,
            at_top(("full", "rec")),
        ),
        Claim(
            "H5",
            "V-A",
            "rec has the largest variance while still converging.",
            PAPER_SETS,
            MORE_SPREAD,
            at_top(("rec", "rec+pred"), ("rec", "rec+plan"), ("rec", "full")),
        ),
        Claim(
            "D1",
            "V-B",
            "Steering loss hardly changes with data size or head set.",
            ("rec", "full"),
            SAME_STEERING,
            by_fraction(
                lambda grid, base: [
                    ((heads, fraction), base)
                    for fraction in grid.fractions
                    for heads in PAPER_SETS
                    if heads in grid.heads and (heads, fraction) != base
                ]
            ),
        ),
        Claim(
            "D2",
            "V-B",
            "full beats rec at every data fraction.",
            ("rec", "full"),
            ABOVE,
            by_fraction(lambda grid, _: [(("full", fraction), ("rec", fraction)) for fraction in grid.fractions]),
        ),
        Claim(
            "D3",
            "V-B",
            "full with the smallest fraction beats rec with all the data.",
            ("rec", "full"),
            ABOVE,
            by_fraction(lambda grid, base: [(("full", min(grid.fractions)), base)]),
        ),
        Claim(
            "D4",
            "V-B",
            "full reaches rec-at-100 %'s final accuracy in 20 of 100 epochs at 100 %, 40 at 25 %, 60 at 6.25 %.",
            ("rec", "full"),
            REACHES,
            by_fraction(
                lambda grid, base: [(("full", fraction), base) for fraction in REACH if fraction in grid.fractions]
            ),
        ),
    )
}
