"""Two sweeps side by side: what they differ in, their scores with differences, orders of head sets, verdicts.

Either may come from another commit, simulator, profile or store.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from functools import partial

import numpy as np

from study.analysis.claims import Verdict
from study.analysis.metrics import Metric
from study.config.baselines import BASELINES
from study.config.grid import Cell
from study.document.blocks import Block, Inline, bold, code, italic, lines, plain, table
from study.report.driving import EXPERT
from study.report.model import Report, Score, Spread
from study.report.rounding import NOTHING, UNITS, between, epochs, fixed, interval, percent, show
from study.report.text import counts, render, title
from study.statistics import comparisons
from study.statistics.effects import MINUS, ordered
from study.statistics.intervals import Estimate
from study.statistics.learning_curves import ACCURACY, DRIVING, Point

CHANGES = {True: " with uncommitted changes", False: "", None: ", whether changed is unknown"}
Rows = list[list[object]]
Sides = tuple[Report, Report]


def compare(first: Report, second: Report, names: tuple[str, str], picture: str = "") -> list[Block]:
    """Return the document of two reports; `names` say where each comes from, `picture` is the file of their figure."""
    sides, cells = (first, second), labels(first, second)
    both = [point for point in cells if all(point in side.by_point for side in sides)]
    differing, same = _differing(sides)
    bars: list[Spread | Estimate] = [row.accuracy for side in sides for row in side.scores]
    bars += [gain for side in sides for point in cells if (gain := side.above_reference(point))]
    return render(
        "comparison.md.jinja",
        {"two_sweeps": picture} if picture else {},
        first=first,
        second=second,
        names=names,
        minus=MINUS,
        keys=(side_key("first", first, names[0]), side_key("second", second, names[1])),
        bars=bars,
        accuracies=[(cells[point], *(_mean(side, point) for side in sides)) for point in cells],
        differing=table(("", "first", "second"), differing, left=3),
        same=same,
        both=both,
        changes=[change for metric in _shared_metrics(sides) for change in _changes(sides, metric.name, both)],
        allowance=max((row.allowance for side in sides for row in side.accuracy_contrasts), default=0.0),
        shared=[f"{cells[point]} ({words})" for point in both if (words := _shared(sides, point))],
        scores=[_scores(sides, metric, cells, both) for metric in _shared_metrics(sides)],
        alone=[
            [cells[point] for point in cells if point in one.by_point and point not in other.by_point]
            for one, other in (sides, sides[::-1])
        ],
        wheel=_driving(sides),
        orders=table(("fraction", "first", "second", "order"), _orders(sides), left=4),
        convergence=_convergence(sides, cells),
        changed=_changed(sides),
        verdicts=table(("Claim", "first", "second"), _verdicts(sides), left=3),
    )


def labels(first: Report, second: Report) -> dict[Point, str]:
    """Return the points that either has scores of, most data first, baselines last, with names to tell them apart."""
    points = {*first.by_point, *second.by_point}
    heads = ordered(sorted(name for name, _ in points if name not in BASELINES))
    cells = sorted(
        (point for point in points if point[0] in heads), key=lambda point: (-point[1], heads.index(point[0]))
    )
    several = len({fraction for _, fraction in cells}) > 1
    named = {(name, part): f"{name} at {100 * part:g} %" if several else name for name, part in cells}
    beside = {(name, 1.0): record.word for name, record in BASELINES.items() if (name, 1.0) in points}
    return named | beside


def side_key(word: str, report: Report, name: str, most: int = 60) -> str:
    """Return which sweep it is, with n; of a long name the end."""
    shown = name if len(name) <= most else f"\N{HORIZONTAL ELLIPSIS}{name[1 - most :]}"
    units = "policies on one encoder" if report.sweep.design == "A" else "encoders"
    return f"{word}, {shown} (n = {counts(row.accuracy.n for row in report.scores) or 0} {units})"


def ends_text(first: Report, second: Report) -> str:
    """Return the floor of accuracy in words, of both sweeps where they differ."""
    floors = [side.floor[ACCURACY] for side in (first, second)]
    shown = dict.fromkeys(f"{100 * value:.1f}" for value in floors if not math.isnan(value))
    return "; ".join(["(a): axis cut", *[f"majority class at {' and '.join(shown)} %"] * bool(shown)])


def _mean(side: Report, point: Point) -> str:
    return f"{percent(side.by_point[point].accuracy.mean)} %" if point in side.by_point else "none"


# --- what differs ---------------------------------------------------------------------------------------------------


def _differing(sides: Sides) -> tuple[Rows, list[str]]:
    """Return what differs in sweep, data, provenance, rules and settings, and the groups in which nothing does."""
    facts = [dict(_facts(report)) for report in sides]
    names = list(dict.fromkeys([*facts[0], *facts[1]]))
    other = [name for name in names if facts[0].get(name) != facts[1].get(name)]
    rows: Rows = [[name, *(code(side[name]) if name in side else NOTHING for side in facts)] for name in other]
    differing = {name.partition(" ")[0] for name in other}
    return rows, [group for group in dict.fromkeys(name.partition(" ")[0] for name in names) if group not in differing]


def _facts(report: Report) -> Iterator[tuple[str, str]]:
    """Yield name and value of everything that two sweeps may differ in; a name's first word is its group."""
    origin, sweep = report.provenance, report.sweep.model_dump(exclude={"title", "heads", "fractions", "failed"})
    for name, value in sweep.items():
        yield f"sweep {name}", ", ".join(value) if isinstance(value, tuple) else str(value)
    yield "sweep cells", ", ".join(row.cell for row in report.scores)
    yield "commit", f"{origin.commit or 'unknown'}{CHANGES[origin.dirty]}"
    yield "data key", str(report.data.key)
    for name, content in report.data.sets.items():
        for count in ("frames", "drives", "test_drives"):
            yield f"data {name} {count}", str(content.get(count))
    for name, floor in report.floor.items():
        yield f"floor {name}", fixed(floor, 6)
    for name, version in {"lock": origin.lock, "python": origin.python, **origin.packages}.items():
        yield f"versions {name}", str(version)
    yield "machine platform", str(origin.platform)
    yield "machine cpu", str(origin.cpu)
    yield "machine of the cells", " and ".join(origin.computed_on) or "the same"
    for name, rule in report.rules.items():
        for part, number in rule.items() if isinstance(rule, dict) else [("", rule)]:
            yield f"rules {name} {part}".strip(), f"{number:g}" if isinstance(number, float) else str(number or "none")
    for setting in report.settings:
        yield f"settings {setting.group}.{setting.name}", setting.value


# --- scores ---------------------------------------------------------------------------------------------------------


def _shared_metrics(sides: Sides) -> list[Metric]:
    """Return the metrics that both have, as the second describes them."""
    return [metric for metric in sides[1].metrics if metric.name in {other.name for other in sides[0].metrics}]


def _spreads(sides: Sides, name: str, point: Point) -> list[Spread | None]:
    return [side.by_point[point].metrics.get(name) for side in sides]


def _driving(sides: Sides) -> dict[str, object]:
    """Return the tables of driving scores in the study's town, of the cells that drove in both; empty without any."""
    first, second = (side.driving.town if side.driving else None for side in sides)
    if not first or not second or not sides[1].driving:
        return {}
    others = {row.point: row for row in second.rows}
    pairs = [(row, others[row.point]) for row in first.rows if row.point in others]
    rows = [
        table(
            (title(metric), "first (n)", "second (n)", "difference", "95 %"),
            [
                [one.cell, *_beside(metric, *(row.metrics.get(metric.name) for row in (one, other)))]
                for one, other in pairs
            ],
        )
        for metric in sides[1].driving.scores
    ]
    changes = [
        difference(one.metrics[DRIVING], other.metrics[DRIVING]) for one, other in pairs if one.point[0] != EXPERT
    ]
    drives = [{row.drives for row in place.rows} for place in (first, second)]
    return {"tables": rows, "changes": changes, "drives": drives} if pairs else {}


def _changes(sides: Sides, name: str, both: list[Point]) -> list[Estimate]:
    pairs = [_spreads(sides, name, point) for point in both]
    return [difference(one, other) for one, other in pairs if one and other]


def _scores(sides: Sides, metric: Metric, cells: dict[Point, str], both: list[Point]) -> Inline:
    """Return a metric's table; that of accuracy has shares of the possible gain where both have its ends."""
    header: list[str] = [title(metric), "first (n)", "second (n)", "difference", "95 %"]
    rows: Rows = [[cells[point], *_beside(metric, *_spreads(sides, metric.name, point))] for point in both]
    with_shares = metric.name == ACCURACY and all(side.ceiling and side.trivial for side in sides)
    if metric.guess:
        floors = [show(metric, side.floor.get(metric.name)) for side in sides]
        rows.append([italic(f"floor ({metric.guess})"), *floors, NOTHING, NOTHING])
    if with_shares:
        header += ["share of gain, first [%]", "share of gain, second [%]"]
        shares = [*([side.by_point[point].share for side in sides] for point in both), [math.nan, math.nan]]
        rows = [[*row, *(percent(share, 0) for share in pair)] for row, pair in zip(rows, shares, strict=True)]
    return table(header, rows)


def _beside(metric: Metric, first: Spread | None, second: Spread | None) -> list[str]:
    """Return two scores with n, and their difference with its interval."""
    cells = [f"{show(metric, side.mean)} ({side.n})" if side else NOTHING for side in (first, second)]
    if not first or not second:
        return [*cells, NOTHING, NOTHING]
    change, signed = difference(first, second), partial(show, metric, sign=True)
    return [*cells, signed(change.value), interval(change, signed)]


def difference(first: Spread, second: Spread) -> Estimate:
    """Return second minus first, with a 95 % interval over their sampling units and test drives.

    Paired by seed where both have the same seeds: seed k starts from the same initial weights whatever the data, which
    binds steering losses together (r = 0.8 between cells of the laptop profile) and accuracies not (r = 0.0). Pairs are
    right either way and cost little where nothing is shared. Otherwise two separate samples (Welch's t).
    """
    same = [first.units, first.drives, first.more] == [second.units, second.drives, second.more]
    drives = [] if same else [(side.more, side.drives) for side in (first, second)]  # of one result, nothing differs
    paired = set(first.units) == set(second.units) and len({"policy" in side.kind for side in (first, second)}) == 1
    before, after = (np.array([side.units[seed] for seed in sorted(side.units)]) for side in (first, second))
    return comparisons.apart(after, before, drives, by_seed=paired)


def _shared(sides: Sides, point: Point) -> str:
    """Return whether a cell has the same keys in both, and whether it is one result or two runs."""
    first, second = (side.by_point[point] for side in sides)
    keys = [_keys(side, point) for side in sides]
    if not keys[0] or keys[0] != keys[1]:
        return ""
    return "the same result" if first.metrics == second.metrics else "same settings, run twice"


def _keys(report: Report, point: Point) -> list[str]:
    seeds = range(BASELINES[point[0]].seeds if point[0] in BASELINES else report.sweep.encoder_seeds)
    cells = [Cell(heads=point[0], fraction=point[1], encoder_seed=seed).label for seed in seeds]
    return [report.provenance.keys[label] for label in cells if label in report.provenance.keys]


# --- orders, convergence, verdicts ----------------------------------------------------------------------------------


def _orders(sides: Sides) -> Rows:
    rows: Rows = []
    for fraction in sorted({fraction for side in sides for _, fraction in side.by_point}, reverse=True):
        chains, orders = [], []
        for report in sides:
            scores = [row for row in report.scores if row.fraction == fraction]
            scores.sort(key=lambda row: -row.accuracy.mean)
            signs = [_sign(report, higher, lower) for higher, lower in itertools.pairwise(scores)]
            orders.append([row.heads for row in scores])
            chain = itertools.zip_longest(map(plain, orders[-1]), signs, fillvalue="")
            chains.append(Inline(" ".join(f"{name} {sign}" for name, sign in chain).strip()) or NOTHING)
        one, other = ([name for name in order if all(name in side for side in orders)] for order in orders)
        verdict = NOTHING if len(one) < 2 else "the same" if one == other else bold("another")
        rows.append([f"{100 * fraction:g} %", *chains, verdict])
    return rows


def _sign(report: Report, higher: Score, lower: Score) -> str:
    for contrast in report.accuracy_contrasts:
        if {contrast.first, contrast.second} == {higher.point, lower.point}:
            low, high = contrast.simultaneous
            return ">" if (low > 0 if contrast.first == higher.point else high < 0) else "~"
    return "~"


def _convergence(sides: Sides, cells: dict[Point, str]) -> Inline:
    first, second = ({(row.heads, row.fraction): row for row in side.convergence} for side in sides)
    rows: Rows = []
    for point in (point for point in first if point in second):
        both = (first[point], second[point])
        curves = (f"{epochs(row.mean_curve.value)} ({interval(row.mean_curve, epochs)})" for row in both)
        shares, areas = (percent(row.share, 0) for row in both), (percent(row.area, 2) for row in both)
        rows.append([cells[point], *curves, *shares, *areas])
    header = [f"{name}, {side}" for name in ("epochs", "share", "area") for side in ("first", "second")]
    return table(["Cell", *header], rows) if rows else Inline()


def _claims(sides: Sides) -> dict[str, list[Verdict | None]]:
    verdicts = [{row.claim: row for row in side.claims} for side in sides]
    return {name: [side.get(name) for side in verdicts] for name in dict.fromkeys([*verdicts[0], *verdicts[1]])}


def _changed(sides: Sides) -> list[str]:
    return [name for name, (one, other) in _claims(sides).items() if one and other and one.outcome != other.outcome]


def _verdicts(sides: Sides) -> Rows:
    changed = _changed(sides)
    return [[bold(name) if name in changed else name, *map(_verdict, pair)] for name, pair in _claims(sides).items()]


def _verdict(claim: Verdict | None) -> str:
    if claim is None:
        return NOTHING
    findings = []
    for finding in claim.findings:
        unit, estimate = UNITS[finding.unit], finding.estimate
        value, ends = unit.phrase.format(unit.show(estimate.value)), between(estimate.low, estimate.high, unit.show)
        findings.append(f"{finding.what}: {value} ({ends}, n = {estimate.n}), {finding.state}")
    return lines([bold(claim.outcome), *(findings or [claim.reason])])
