"""The paper's claims and, in section "ours", some of ours, and a verdict on each by its rule.

To add a claim, add its record to `CLAIMS`, at the end of this file. A claim rests on one or more findings, each of
which holds, fails or stays open (`study.analysis.rules`): if all hold, the claim is reproduced; if one fails, it is not
reproduced; else it is inconclusive, or it cannot be tested at this size where the open findings have too little power.
A claim about little data is not tested at this scale when an encoder has not learned (`study.analysis.learned`). A
claim about driving is not tested where the policies have not driven.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, get_args

from study.analysis import driving, predictions
from study.analysis.learned import unlearned
from study.analysis.rules import (
    ABOVE,
    DRIVES_BETTER,
    GOOD_STEERING,
    MORE_SPREAD,
    REACH,
    REACHES,
    SAME_ORDER,
    SAME_STEERING,
    Evidence,
    Finding,
    Pair,
    Rule,
    State,
)
from study.config.grid import Grid
from study.results.sweep_record import SweepRecord
from study.statistics import effects, learning_curves
from study.statistics.effects import label, results_at
from study.statistics.learning_curves import ACCURACY, DRIVING, KEYFRAME, STEERING, Point

Outcome = Literal[
    "reproduced",
    "not reproduced",
    "inconclusive",
    "cannot be tested at this size",
    "not tested at this scale",
    "not tested",
]
OUTCOMES: tuple[Outcome, ...] = get_args(Outcome)
OURS = "ours"  # the section of a claim that is not the paper's


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

    @property
    def deciding(self) -> tuple[Finding, ...]:
        """Return the findings that the verdict rests on, without those that are reported beside them."""
        return tuple(finding for finding in self.findings if not finding.beside)


@dataclass(frozen=True)
class Claim:
    """A claim of the paper, or one of ours.

    `section` of the paper, or OURS; `needs`: the head sets without which a sweep cannot test it; `pairs`: which cells
    of a grid it compares, none where the sweep lacks the data fractions; `rule` decides on each pair; `learned`:
    whether it is about what encoders have learned from less data, so that each of them must have learned; `metric`: the
    scores without which a cell cannot be judged.
    """

    name: str
    section: str
    text: str
    needs: tuple[str, ...]
    rule: Rule
    pairs: Callable[[Grid], list[Pair]]
    learned: bool = False
    metric: str = ACCURACY


def judge(record: SweepRecord) -> list[Verdict]:
    """Return a verdict on each of `CLAIMS`, also on those that the sweep cannot test."""
    table, base = record.table(), ("rec", max(record.grid.fractions))
    panels = {metric: learning_curves.panel(table, metric) for metric in (ACCURACY, STEERING, KEYFRAME)}
    by_drive: dict[str, effects.Drives] = {
        metric: effects.drive_scores(record, metric, panel) for metric, panel in panels.items()
    }
    panels[DRIVING], by_drive[DRIVING] = driving.panel(record)
    return weigh(
        Evidence(
            record.grid,
            panels,
            steering_floor(record, base) if results_at(record, base) else math.nan,
            by_drive,
            unlearned(record, panels[ACCURACY]),
        )
    )


def weigh(evidence: Evidence) -> list[Verdict]:
    """Return a verdict on each of `CLAIMS` from curves and scores by drive alone."""
    return [verdict(claim, evidence) for claim in CLAIMS.values()]


def verdict(claim: Claim, evidence: Evidence) -> Verdict:
    """Return the verdict on one claim."""
    record = claim.name, claim.section, claim.text, claim.rule.words(evidence.rules)
    untestable, missing = _why_not(claim, evidence)
    if untestable:
        return Verdict(*record, "not tested", untestable, missing=missing)
    pairs = claim.pairs(evidence.grid)
    doubts = [evidence.doubts[point] for point in _points(pairs) if point in evidence.doubts] * claim.learned
    if doubts:
        return Verdict(*record, "not tested at this scale", f"Has every encoder learned? {'; '.join(doubts)}.")
    findings = tuple(claim.rule.find(evidence, pairs))
    deciding = [finding for finding in findings if not finding.beside]
    states = {finding.state for finding in deciding}
    state: State = "fails" if "fails" in states else "open" if "open" in states else "holds"
    outcome, one, several = _OUTCOME[state]
    concerned = [finding for finding in deciding if finding.state == state]
    if len(concerned) == 1:
        reason = f"{concerned[0].what}: {one}."
    else:
        names = ", ".join(finding.what for finding in concerned)
        reason = f"{f'All {len(deciding)} findings' if len(concerned) == len(deciding) else names} {several}."
    power = min(finding.power for finding in concerned)
    if state == "open" and power < evidence.rules.least_power:
        outcome = "cannot be tested at this size"
        reason += (
            f" {claim.rule.alternative(evidence.rules)} would be found with a power of {100 * power:.0f} % at most."
        )
    return Verdict(*record, outcome, reason, findings)


_OUTCOME: dict[State, tuple[Outcome, str, str]] = {  # with the reason in words, for one finding and for several
    "holds": ("reproduced", "meets the rule", "meet the rule"),
    "fails": ("not reproduced", "contradicts the claim", "contradict the claim"),
    "open": ("inconclusive", "leaves it open", "leave it open"),
}


def _points(pairs: list[Pair]) -> list[Point]:
    return list(dict.fromkeys(point for pair in pairs for point in pair))


def _why_not(claim: Claim, evidence: Evidence) -> tuple[str, tuple[str, ...]]:
    """Return why a claim cannot be tested, and the cells that are not finished; empty when it can."""
    grid = evidence.grid
    absent = [heads for heads in claim.needs if heads not in grid.heads]
    if absent:
        return f"This sweep has no {' and no '.join(absent)}.", ()
    pairs = claim.pairs(grid)
    if not pairs:
        return f"This sweep lacks the data fractions; it has {', '.join(f'{100 * x:g} %' for x in grid.fractions)}.", ()
    missing = tuple(label(point, grid) for point in _points(pairs) if point not in evidence.panels[ACCURACY])
    if missing:
        return f"Not finished: {', '.join(missing)}.", missing
    if not evidence.panels.get(claim.metric):
        return "Its policies have not driven (--drive true; imported drives have no town).", ()
    missing = tuple(label(point, grid) for point in _points(pairs) if point not in evidence.panels[claim.metric])
    return (f"Not driven: {', '.join(missing)} (--drive true)." if missing else ""), missing


def steering_floor(record: SweepRecord, point: Point) -> float:
    """Return the steering loss of the best constant command on the test labels."""
    return predictions.steering_floor(results_at(record, point)[0].predictions["steering_label"].astype("float64"))


# --- the claims -----------------------------------------------------------------------------------------------------

PAPER_SETS = ("rec", "rec+pred", "rec+plan", "full")  # the paper's own: a further head set takes no claim away


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
            "H0",
            "abstract, V-A",
            "Auxiliary heads improve acceleration: full is better than rec.",
            ("rec", "full"),
            ABOVE,
            at_top(("full", "rec")),
        ),
        Claim(
            "H1",
            "V-A",
            "Steering is good for all head sets.",
            PAPER_SETS,
            GOOD_STEERING,
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
            learned=True,
        ),
        Claim(
            "D2",
            "V-B",
            "full beats rec at every data fraction.",
            ("rec", "full"),
            ABOVE,
            by_fraction(lambda grid, _: [(("full", fraction), ("rec", fraction)) for fraction in grid.fractions]),
            learned=True,
        ),
        Claim(
            "D3",
            "V-B",
            "full with the smallest fraction beats rec with all the data.",
            ("rec", "full"),
            ABOVE,
            by_fraction(lambda grid, base: [(("full", min(grid.fractions)), base)]),
            learned=True,
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
            learned=True,
        ),
        Claim(
            "C1",
            OURS,
            "full drives better than rec.",
            ("rec", "full"),
            DRIVES_BETTER,
            at_top(("full", "rec")),
            metric=DRIVING,
        ),
        Claim(
            "C2",
            OURS,
            "Adding plan helps driving more than adding pred.",
            ("rec+pred", "rec+plan"),
            DRIVES_BETTER,
            at_top(("rec+plan", "rec+pred")),
            metric=DRIVING,
        ),
        Claim(
            "C3",
            OURS,
            "The order of head sets by accuracy is their order by driving score.",
            PAPER_SETS,
            SAME_ORDER,
            at_top(*itertools.combinations(PAPER_SETS, 2)),
            metric=DRIVING,
        ),
    )
}
