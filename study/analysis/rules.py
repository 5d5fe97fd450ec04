"""The rules of the paper's claims: from curves and scores by test drive to findings that hold, fail or stay open.

The rules' numbers come from the sweep file (`study.config.grid.Rules`), so they are fixed before the run. Intervals are
over sampling units and test drives (`study.statistics.intervals.crossed`). A claim is reproduced only when all its
findings hold, so each may be read at 1 - alpha: this keeps the claim's error at alpha (intersection-union test, Berger
1982). It is not reproduced when any fails, so the ends against it are simultaneous, at 1 - alpha over the number of
findings. Where a cell has one encoder only (design A), an allowance for other encoders is added to the ends.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

from scipy import special

from study.config.grid import Grid, Rules
from study.config.settings import Number
from study.statistics import comparisons, convergence, effects, intervals, learning_curves
from study.statistics.effects import Drives, Interval, Unit, difference_label, label
from study.statistics.intervals import Crossed, Estimate, Sample
from study.statistics.learning_curves import ACCURACY, DRIVING, KEYFRAME, STEERING, Panel, Point

State = Literal["holds", "fails", "open"]
Pair = tuple[Point, Point]
REACH = {1.0: 0.2, 0.25: 0.4, 0.0625: 0.6}  # fraction -> share of the epochs that the text names (Sec. V-A, V-B)


@dataclass(frozen=True)
class Finding:
    """One number that a claim rests on: what it is, its 95 % interval, the bounds that decide, and what follows.

    `power`: the probability that it holds if the rule's alternative is true, at this variance; `beside`: reported as
    evidence, without a part in the verdict.
    """

    what: str
    unit: Unit
    estimate: Interval
    decides: tuple[Number, Number]
    needs: str
    state: State
    p: Number = math.nan
    power: Number = math.nan
    beside: bool = False


@dataclass(frozen=True)
class Evidence:
    """What the rules look at.

    `panels`: curves by metric, head set and fraction; `floor`: the steering loss of the best constant command;
    `drives`: final scores by test drive, by metric, head set and fraction, where known; `doubts`: in words, why the
    encoders of a cell may not have learned.
    """

    grid: Grid
    panels: Mapping[str, Panel]
    floor: float
    drives: Mapping[str, Drives] = field(default_factory=dict)
    doubts: Mapping[Point, str] = field(default_factory=dict)

    @property
    def rules(self) -> Rules:
        """Return the sweep file's rules."""
        return self.grid.rules

    def cell(self, metric: str, point: Point) -> Sample:
        """Return a cell's final scores by seed and by drive."""
        return Sample(learning_curves.final(self.panels[metric][point]), self.drives.get(metric, {}).get(point))

    def difference(self, metric: str, pair: Pair) -> Crossed:
        """Return the mean difference of two cells' final scores, first minus second."""
        return comparisons.difference(*(self.cell(metric, point) for point in pair))

    def one_encoder(self, point: Point) -> bool:
        """Return whether a cell has one encoder only."""
        return learning_curves.encoders(self.panels[ACCURACY][point]) == 1

    def allowance(self, pair: Pair, metric: str = ACCURACY) -> float:
        """Return what a difference may owe to other encoders: 0 where both cells have several."""
        return effects.allowance(self.rules, self.panels[metric], pair, metric)

    def steering_allowance(self, points: Sequence[Point]) -> float:
        """Return what a steering loss, or a difference of two, may owe to other encoders."""
        losses = [self.cell(STEERING, point).values.mean() for point in points if self.one_encoder(point)]
        return self.rules.steering_allowance * math.sqrt(sum(float(loss) ** 2 for loss in losses) / 2)


@dataclass(frozen=True)
class Rule:
    """A way to decide, with the numbers of a sweep file.

    `words` of the rule; `alternative`: the truth for which a finding's power is stated; `find`: a claim's findings on
    its pairs of cells.
    """

    words: Callable[[Rules], str]
    alternative: Callable[[Rules], str]
    find: Callable[[Evidence, Sequence[Pair]], list[Finding]]


def _state(*, holds: bool, fails: bool) -> State:
    return "holds" if holds else "fails" if fails else "open"


def _find_above(evidence: Evidence, pairs: Sequence[Pair]) -> list[Finding]:
    """Return findings that the first's accuracy is above the second's; beside them the same on keyframes."""
    known = all(point in evidence.panels.get(KEYFRAME, {}) for pair in pairs for point in pair)
    metrics = [ACCURACY] + [KEYFRAME] * known
    return [_above(evidence, metric, pair, len(pairs)) for metric in metrics for pair in pairs]


def _find_better_driving(evidence: Evidence, pairs: Sequence[Pair]) -> list[Finding]:
    """Return findings that the first's driving score is above the second's."""
    return [_above(evidence, DRIVING, pair, len(pairs)) for pair in pairs]


def _find_same_order(evidence: Evidence, pairs: Sequence[Pair]) -> list[Finding]:
    """Return findings that of each pair the cell of higher accuracy has the higher driving score, too."""
    by_accuracy = [pair if evidence.difference(ACCURACY, pair).value >= 0 else pair[::-1] for pair in pairs]
    return _find_better_driving(evidence, by_accuracy)


def _above(evidence: Evidence, metric: str, pair: Pair, findings: int) -> Finding:
    rules, mean = evidence.rules, evidence.difference(metric, pair)
    unit: Unit = "score" if metric == DRIVING else "points"
    margin, effect = (
        (rules.driving_margin, rules.driving_effect) if metric == DRIVING else (rules.accuracy_margin, rules.effect)
    )
    allowance = evidence.allowance(pair, DRIVING if metric == DRIVING else ACCURACY)
    low, high = mean.limits(1 - rules.alpha, allowance)[0], mean.limits(1 - rules.alpha / findings, allowance)[1]
    return Finding(
        difference_label(*pair, evidence.grid) + ", keyframes" * (metric == KEYFRAME),
        unit,
        mean.estimate(),
        (low, high),
        "above 0",
        _state(holds=low > 0, fails=high < margin),
        mean.p(allowance),
        mean.power(effect - allowance, 1 - rules.alpha),
        beside=metric == KEYFRAME,
    )


def _find_good_steering(evidence: Evidence, pairs: Sequence[Pair]) -> list[Finding]:
    """Return findings that each cell's loss is below the bound; beside them whether it equals the reference's."""
    rules, points = evidence.rules, list(dict.fromkeys(point for pair in pairs for point in pair))
    bound, findings = rules.steering_good * evidence.floor, []
    for point in sorted(points, key=effects.points(evidence.grid).index):
        mean, allowance = intervals.crossed(evidence.cell(STEERING, point)), evidence.steering_allowance([point])
        high, low = mean.limits(1 - rules.alpha, allowance)[1], mean.limits(1 - rules.alpha / len(points), allowance)[0]
        state, power = _state(holds=high < bound, fails=low > bound), mean.power(bound / 2 - allowance, 1 - rules.alpha)
        needs, what = f"below {1000 * bound:.2f}", f"loss of {label(point, evidence.grid)}"
        findings.append(Finding(what, "loss", mean.estimate(), (low, high), needs, state, power=power))
    return [*findings, *_same_steering(evidence, pairs, beside=True)]


def _find_same_steering(evidence: Evidence, pairs: Sequence[Pair]) -> list[Finding]:
    """Return findings that steering losses differ by less than the margin (two one-sided tests)."""
    return _same_steering(evidence, pairs, beside=False)


def _same_steering(evidence: Evidence, pairs: Sequence[Pair], *, beside: bool) -> list[Finding]:
    rules, findings = evidence.rules, []
    for pair in pairs:
        mean, allowance = evidence.difference(STEERING, pair), evidence.steering_allowance(pair)
        margin = rules.steering_margin * float(evidence.cell(STEERING, pair[1]).values.mean())
        decides = mean.limits(1 - rules.alpha / len(pairs), allowance)
        p = comparisons.equivalence(mean, margin - allowance)
        state = _state(holds=p <= rules.alpha, fails=decides[0] > margin or decides[1] < -margin)
        what, needs = difference_label(*pair, evidence.grid), f"within ±{1000 * margin:.2f}"
        power = max(2 * mean.power(margin - allowance, 1 - 2 * rules.alpha) - 1, 0.0)
        findings.append(Finding(what, "loss", mean.estimate(), decides, needs, state, p, power, beside))
    return findings


def _find_reach(evidence: Evidence, pairs: Sequence[Pair]) -> list[Finding]:
    """Return findings that the first's mean curve reaches the second's final accuracy by the epoch of the text."""
    rules, findings = evidence.rules, []
    for pair in pairs:
        (point, reference), (curves, base) = pair, (evidence.panels[ACCURACY][point] for point in pair)
        mean, goal = base.mean().to_numpy(), float(learning_curves.final(base).mean())
        bound = (REACH.get(point[1], REACH[1.0]) + rules.reach_slack) * curves.shape[1]
        difference, allowance = evidence.difference(ACCURACY, pair), evidence.allowance(pair)
        epoch = convergence.epochs_to_reach(curves, base, difference)
        # The reference itself, even were its encoder better by the allowance, must be slower: else speed shows nothing.
        slower = convergence.epochs_to_reach(base, base).low > epoch.high
        distinct = epoch.high <= bound and slower and goal - mean[int(epoch.high) - 1] > allowance
        behind = float(curves.mean().iloc[: max(int(bound), 1)].max()) + allowance < goal
        what = f"{label(point, evidence.grid)} reaches {label(reference, evidence.grid)}'s final"
        state = _state(holds=bool(distinct), fails=epoch.low > bound and behind)
        early = goal - mean[max(int(bound), 1) - 1] > allowance  # else no curve could show it
        power, ends = difference.power(rules.effect, 1 - rules.alpha) * early, (epoch.low, epoch.high)
        findings.append(Finding(what, "epochs", epoch, ends, f"at most {bound:g}", state, power=power))
    return findings


def _find_more_spread(evidence: Evidence, pairs: Sequence[Pair]) -> list[Finding]:
    """Return findings that the first's policies vary more than the second's, over the epochs of its transient."""
    rules, findings = evidence.rules, []
    for pair in pairs:
        first, second = (evidence.panels[ACCURACY][point] for point in pair)
        epochs = convergence.transient(first)
        ratio = convergence.spread_ratio(first, second, epochs)
        factor = rules.spread_factor if any(map(evidence.one_encoder, pair)) else 1.0
        low = _at_level(ratio, 1 - rules.alpha)[0] / factor
        high = _at_level(ratio, 1 - rules.alpha / len(pairs))[1] * factor
        what = f"variance of {pair[0][0]} over {pair[1][0]}, epochs 1 to {epochs}"
        state, power = _state(holds=low > 1, fails=high < 1), _ratio_power(ratio, rules.spread_ratio / factor, rules)
        findings.append(Finding(what, "ratio", ratio, (low, high), "above 1", state, power=power))
    return findings


def _ratio_error(ratio: Estimate) -> float:
    """Return the standard error of the log of a ratio, from its interval."""
    return math.log(ratio.high / ratio.low) / 2 / float(special.stdtrit(ratio.n - 1, (1 + ratio.level) / 2))


def _at_level(ratio: Estimate, level: float) -> tuple[float, float]:
    """Return the interval of a ratio at another level."""
    if not 0 < ratio.low < ratio.high < math.inf:
        return ratio.low, ratio.high
    factor = math.exp(float(special.stdtrit(ratio.n - 1, (1 + level) / 2)) * _ratio_error(ratio))
    middle = math.sqrt(ratio.low * ratio.high)
    return middle / factor, middle * factor


def _ratio_power(ratio: Estimate, truth: float, rules: Rules) -> float:
    """Return the probability that the lower end is above 1 when the true ratio is this one."""
    if not 0 < ratio.low < ratio.high < math.inf:
        return 0.0
    bound = float(special.stdtrit(ratio.n - 1, 1 - rules.alpha / 2))
    return 1 - float(special.nctdtr(ratio.n - 1, math.log(truth) / _ratio_error(ratio), bound))


def _widened(rules: Rules) -> str:
    words = ", ".join(f"{100 * share:.1f} ({name})" for name, share in rules.encoder_allowance.items())
    return (
        "With one encoder for each cell the interval is widened on either side by what their seeds alone may make of "
        f"two encoders, in points: {words}; of two head sets, the root mean square."
    )


ABOVE = Rule(
    lambda rules: (
        f"The lower end of each difference's interval, at {100 * (1 - rules.alpha):g} %, lies above 0. It fails where "
        f"the simultaneous interval excludes a gain of {rules.accuracy_margin * 100:.1f} points. {_widened(rules)} The "
        "same differences on keyframes are evidence beside it."
    ),
    lambda rules: f"A true difference of {100 * rules.effect:g} {'point' if rules.effect == 0.01 else 'points'}",
    _find_above,
)
GOOD_STEERING = Rule(
    lambda rules: (
        f"The upper end of each head set's loss lies below {rules.steering_good * 100:g} % of the best constant "
        "command's loss. It fails where the lower end of a simultaneous interval lies above. With one encoder for each "
        f"cell ends are widened for others, by up to {rules.steering_allowance * 100:g} % of the loss. Equivalence to "
        f"rec, within {rules.steering_margin * 100:g} % of rec's own loss, is a finding beside it."
    ),
    lambda _: "A true loss of half the bound",
    _find_good_steering,
)
SAME_STEERING = Rule(
    lambda rules: (
        f"Equivalence: two one-sided t tests at {rules.alpha:g} against a margin of {rules.steering_margin * 100:g} % "
        "of rec's own loss with all the data. It fails where a simultaneous interval lies outside the margin. With one "
        "encoder for each cell intervals are widened for others, by up to "
        f"{rules.steering_allowance * 100:g} % of the loss."
    ),
    lambda _: "The absence of any difference",
    _find_same_steering,
)
REACHES = Rule(
    lambda rules: (
        f"The upper end of the epoch's interval is at most the text's epoch and {rules.reach_slack * 100:g} % of all "
        "epochs, and below the interval of the epoch at which rec itself reaches its final. With one encoder for each "
        "cell, rec must then still be below its final by what other encoders may make of the difference, so that a "
        "copy of rec with a luckier encoder would not pass."
    ),
    lambda rules: f"A curve that is {100 * rules.effect:g} points above rec's final by that epoch",
    _find_reach,
)
MORE_SPREAD = Rule(
    lambda rules: (
        "The ratio of the variances over policies, mean over the epochs in which rec makes 95 % of its rise, has an "
        "interval above 1. It fails where the simultaneous interval lies below. With one encoder for each cell the "
        f"interval is widened by a factor of {rules.spread_factor:g} on either side."
    ),
    lambda rules: f"A true ratio of {rules.spread_ratio:g}",
    _find_more_spread,
)


def _better_driving(rules: Rules) -> str:
    return (
        f"The lower end of each difference's interval in driving score, at {100 * (1 - rules.alpha):g} %, lies above "
        f"0. It fails where the simultaneous interval excludes a gain of {rules.driving_margin:g} points of 100. "
        f"With one encoder for each cell the interval is widened by {rules.driving_allowance:g} points on either side "
        "for other encoders."
    )


DRIVES_BETTER = Rule(
    _better_driving,
    lambda rules: f"A true difference of {rules.driving_effect:g} points of driving score",
    _find_better_driving,
)
SAME_ORDER = Rule(
    lambda rules: (
        "Each pair of head sets is put in the order of its mean accuracy, however small the difference. "
        f"{_better_driving(rules)}"
    ),
    DRIVES_BETTER.alternative,
    _find_same_order,
)
