"""Two sweeps side by side: what they differ in, their scores with differences, orders of head sets, verdicts.

Whatever made them: two commits, two simulators, two profiles, two stores.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

from study.analysis import comparisons
from study.analysis.claims import Verdict
from study.analysis.effects import MINUS
from study.analysis.intervals import Estimate
from study.analysis.learning_curves import Point
from study.config.grid import Cell
from study.config.heads import HEAD_SETS
from study.report.document import (
    Block,
    Heading,
    Inline,
    Paragraph,
    Picture,
    Row,
    bold,
    code,
    italic,
    lines,
    plain,
    table,
)
from study.report.model import Report, Score, Spread
from study.report.rounding import LOSS, NOTHING, UNITS, between, epochs, fixed, interval, kinds, percent

SHARE_WORDS = (
    "Ceiling: policies that are given the true state in the place of a latent. Share of gain: a score's part of the "
    "way from the commonest class to there (acceleration only, since the state holds no route)."
)


class Measure(NamedTuple):
    """A score: its name in a report, how tables print it, and the guess that makes its floor."""

    name: str
    title: str
    digits: int
    factor: float
    guess: str

    def show(self, value: float, *, sign: bool = False) -> str:
        """Return a value as tables print it."""
        return fixed(value, self.digits, self.factor, sign=sign)


MEASURES = (
    Measure("accuracy", "accuracy [%]", 2, 100.0, "commonest class"),
    Measure("steering", f"steering [{LOSS}]", 3, 1e3, "best constant command"),
)


def compare(first: Report, second: Report, names: tuple[str, str], picture: Picture | None = None) -> list[Block]:
    """Return the document of two reports; `names` say where each comes from, `picture` is shown with the scores."""
    sources = f"First: {code(names[0])}. Second: {code(names[1])}. Differences are second {MINUS} first."
    return [
        Heading(1, f"{plain(first.sweep.title)}: two sweeps side by side"),
        Paragraph(sources),
        Heading(2, "What differs"),
        *_differing(first, second),
        Heading(2, "Final scores"),
        *([picture] if picture else []),
        *_scores(first, second),
        Heading(2, "Order of head sets by accuracy"),
        *_orders(first, second),
        *_convergence(first, second),
        Heading(2, "Verdicts"),
        *_verdicts(first, second),
    ]


def _differing(first: Report, second: Report) -> Iterator[Block]:
    """Yield what differs in sweep, data, provenance, rules and settings; what does not is named in a line."""
    sides = [dict(_facts(report)) for report in (first, second)]
    names = list(dict.fromkeys([*sides[0], *sides[1]]))
    other = [name for name in names if sides[0].get(name) != sides[1].get(name)]
    rows = [(name, *(code(side[name]) if name in side else NOTHING for side in sides)) for name in other]
    yield from table(("", "first", "second"), rows, left=3)
    groups = {name: name.partition(" ")[0] for name in names}
    same = [group for group in dict.fromkeys(groups.values()) if all(groups[name] != group for name in other)]
    if same:
        yield Paragraph(f"Nothing differs in: {', '.join(same)}.")


def _facts(report: Report) -> Iterator[tuple[str, str]]:
    """Yield name and value of everything that two sweeps may differ in; a name's first word is its group."""
    own, sweep = report.provenance, report.sweep
    shown = ("name", "simulator", "profile", "design", "encoder_seeds", "policy_seeds", "policy_epochs", "baseline")
    for name in shown:
        yield f"sweep {name}", str(getattr(sweep, name))
    yield "sweep cells", ", ".join(row.cell for row in report.scores)
    yield "sweep finished", f"{sweep.finished} of {sweep.planned}"
    yield "commit", f"{own.commit or 'unknown'}{' with uncommitted changes' * bool(own.dirty)}"
    yield "data key", str(report.data.key)
    for name, content in report.data.sets.items():
        for count in ("frames", "drives", "test_drives"):
            yield f"data {name} {count}", str(content.get(count))
    for name, value in report.floor.items():
        yield f"floor {name}", fixed(value, 6)
    yield "versions lock", str(own.lock)
    yield "versions python", str(own.python)
    for name, version in own.packages.items():
        yield f"versions {name}", version
    yield "machine platform", str(own.platform)
    yield "machine cpu", str(own.cpu)
    for name, value in report.rules.items():
        yield f"rules {name}", f"{value:g}"
    for setting in report.settings:
        yield f"settings {setting.group}.{setting.name}", setting.value


# --- scores ---------------------------------------------------------------------------------------------------------


def labels(first: Report, second: Report) -> dict[Point, str]:
    """Return the head sets and fractions that either has scores of, most data first, with names to tell them apart."""
    order = {heads: place for place, heads in enumerate(HEAD_SETS)}
    cells = sorted(
        {*first.points, *second.points}, key=lambda point: (-point[1], order.get(point[0], len(order)), point[0])
    )
    several = len({fraction for _, fraction in cells}) > 1
    return {(heads, part): f"{heads} at {100 * part:g} %" if several else heads for heads, part in cells}


def _scores(first: Report, second: Report) -> Iterator[Block]:
    names, sides = labels(first, second), (first, second)
    scores = [{(row.heads, row.fraction): row for row in report.scores} for report in sides]
    both = {point: (scores[0][point], scores[1][point]) for point in names if all(point in side for side in scores)}
    if not both:
        yield Paragraph("No head set and fraction is finished in both.")
    pairs: dict[str, list[tuple[str, Spread | None, Spread | None]]] = {
        "accuracy": [(names[point], one.accuracy, other.accuracy) for point, (one, other) in both.items()],
        "steering": [(names[point], one.steering, other.steering) for point, (one, other) in both.items()],
    }
    if first.ceiling or second.ceiling:
        pairs["accuracy"].append((italic("ceiling (true state)"), first.ceiling, second.ceiling))
    changes = [difference(one, other) for own in pairs.values() for _, one, other in own if one and other]
    shares = first.ceiling and second.ceiling
    if changes:
        yield Paragraph(" ".join([_about(first, second, changes), *([SHARE_WORDS] if shares else [])]))
    same = [f"{plain(names[point])} ({words})" for point, own in both.items() if (words := _shared(sides, *own))]
    if same:
        yield Paragraph(f"Cells of the same key in both: {', '.join(same)}.")
    for measure in MEASURES:
        header = [measure.title, "first (n)", "second (n)", "difference", "95 %"]
        rows = [[name, *_beside(measure, one, other)] for name, one, other in pairs[measure.name]]
        floors = [measure.show(report.floor.get(measure.name, math.nan)) for report in sides]
        rows.append([italic(f"floor ({measure.guess})"), *floors, NOTHING, NOTHING])
        if shares and measure.name == "accuracy":
            header += ["share of gain, first [%]", "share of gain, second [%]"]
            gains = [*((one.share, other.share) for one, other in both.values()), (1.0, 1.0), (0.0, 0.0)]
            rows = [[*row, *(percent(share, 0) for share in gain)] for row, gain in zip(rows, gains, strict=True)]
        yield from table(header, rows)
    for name, one, other in (("first", first, second), ("second", second, first)):
        alone = [plain(names[point]) for point in names if point in one.points and point not in other.points]
        if alone:
            yield Paragraph(f"Only in the {name}: {', '.join(alone)}.")


def _beside(measure: Measure, first: Spread | None, second: Spread | None) -> list[str]:
    """Return two scores with n, and their difference with its interval."""
    cells = [f"{measure.show(side.mean)} ({side.n})" if side else NOTHING for side in (first, second)]
    if not first or not second:
        return [*cells, NOTHING, NOTHING]
    change = difference(first, second)
    low, high = (measure.show(end, sign=True) for end in (change.low, change.high))
    return [*cells, measure.show(change.value, sign=True), low if low == NOTHING else f"{low} to {high}"]


def difference(first: Spread, second: Spread) -> Estimate:
    """Return second minus first, with a 95 % interval over their sampling units.

    Paired by seed where both have the same seeds: seed k starts from the same initial weights whatever the data, which
    binds steering losses together (r = 0.8 between cells of the laptop profile) and accuracies not (r = 0.0). Pairs are
    right either way and cost little where nothing is shared. Otherwise two separate samples (Welch's t).
    """
    if first.kind == second.kind and set(first.units) == set(second.units):
        return comparisons.paired_t([second.units[seed] - value for seed, value in first.units.items()])
    return comparisons.welch(list(second.units.values()), list(first.units.values()))


def _about(first: Report, second: Report, changes: Sequence[Estimate]) -> str:
    """Return what the intervals are over."""
    text = (
        "Mean of the last five epochs on test drives; n are policies on one encoder, or encoders where there are "
        f"several. Interval: {kinds(changes)}."
    )
    if "A" in (first.sweep.design, second.sweep.design):
        allowance = max(report.rules.get("encoder_allowance", 0.0) for report in (first, second))
        text += (
            " With one encoder a cell it says nothing about other encoders, which by the sweep files' rules may differ "
            f"by {percent(allowance)} points through their seeds alone."
        )
    return text


def _shared(sides: tuple[Report, Report], first: Score, second: Score) -> str:
    """Return whether a cell has the same keys in both, and whether it is one result or two runs."""
    mine, theirs = (_keys(report, first) for report in sides)
    if not mine or mine != theirs:
        return ""
    equal = first.accuracy == second.accuracy and first.steering == second.steering
    return "the same result" if equal else "same settings, run twice"


def _keys(report: Report, score: Score) -> list[str]:
    seeds = range(report.sweep.encoder_seeds)
    cells = [Cell(heads=score.heads, fraction=score.fraction, encoder_seed=seed).label for seed in seeds]
    return [report.provenance.keys[label] for label in cells if label in report.provenance.keys]


# --- orders, convergence, verdicts ----------------------------------------------------------------------------------


def _orders(first: Report, second: Report) -> Iterator[Block]:
    fractions = sorted({fraction for report in (first, second) for _, fraction in report.points}, reverse=True)
    rows: list[Row] = []
    for fraction in fractions:
        chains, orders = [], []
        for report in (first, second):
            at = sorted((row for row in report.scores if row.fraction == fraction), key=lambda row: -row.accuracy.mean)
            signs = [_sign(report, (up.heads, fraction), (down.heads, fraction)) for up, down in itertools.pairwise(at)]
            orders.append([row.heads for row in at])
            chain = itertools.zip_longest(map(plain, orders[-1]), signs, fillvalue="")
            chains.append(Inline(" ".join(f"{name} {sign}" for name, sign in chain).strip()) or NOTHING)
        one, other = ([name for name in order if all(name in side for side in orders)] for order in orders)
        verdict = NOTHING if len(one) < 2 else "the same" if one == other else bold("another")
        rows.append((f"{100 * fraction:g} %", *chains, verdict))
    if rows:
        yield Paragraph(
            "`>`: above the next by the simultaneous interval of their paired difference; `~`: not so. Order: of the "
            "head sets that both have."
        )
    yield from table(("fraction", "first", "second", "order"), rows, left=4)


def _sign(report: Report, up: Point, down: Point) -> str:
    for contrast in report.accuracy_contrasts:
        if {contrast.first, contrast.second} == {up, down}:
            low, high = contrast.simultaneous
            return ">" if (low > 0 if contrast.first == up else high < 0) else "~"
    return "~"


def _convergence(first: Report, second: Report) -> Iterator[Block]:
    names = labels(first, second)
    others = {(row.heads, row.fraction): row for row in second.convergence}
    rows: list[Row] = []
    for one in first.convergence:
        point = (one.heads, one.fraction)
        if point in others:
            both = (one, others[point])
            curves = (f"{epochs(row.mean_curve.value)} ({interval(row.mean_curve, epochs)})" for row in both)
            shares, areas = (percent(row.share, 0) for row in both), (percent(row.area, 2) for row in both)
            rows.append((names[point], *curves, *shares, *areas))
    if rows:
        yield Heading(2, "Convergence")
        yield Paragraph(
            "Epochs until the mean curve reaches the baseline's final accuracy of its own sweep (95 %), share of the "
            "seeds that do [%], mean accuracy over all epochs [%]."
        )
    header = (f"{name}, {side}" for name in ("epochs", "share", "area") for side in ("first", "second"))
    yield from table(("Cell", *header), rows)


def _verdicts(first: Report, second: Report) -> Iterator[Block]:
    sides = [{claim.claim: claim for claim in report.claims} for report in (first, second)]
    both = {name: [side.get(name) for side in sides] for name in dict.fromkeys([*sides[0], *sides[1]])}
    changed = [name for name, (one, other) in both.items() if one and other and one.outcome != other.outcome]
    if both:
        yield Paragraph(f"Verdicts that changed: {', '.join(map(plain, changed)) or 'none'}.")
    rows = [(bold(name) if name in changed else name, *map(_verdict, own)) for name, own in both.items()]
    yield from table(("Claim", "first", "second"), rows, left=3)


def _verdict(claim: Verdict | None) -> str:
    if claim is None:
        return NOTHING
    findings = []
    for finding in claim.findings:
        unit, own = UNITS[finding.unit], finding.estimate
        value, ends = unit.phrase.format(unit.show(own.value)), between(own.low, own.high, unit.show)
        findings.append(f"{finding.what}: {value} ({ends}, n = {own.n}), {finding.state}")
    return lines([bold(claim.outcome), *(findings or [claim.reason])])
