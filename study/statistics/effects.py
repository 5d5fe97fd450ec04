"""The planned contrasts between head sets."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Annotated, Literal

from statsmodels.stats.multitest import multipletests

from study.config.grid import Grid, Rules
from study.config.heads import HEAD_SETS
from study.config.settings import FromJson, Number
from study.results.cell_result import CellResult
from study.results.sweep_record import SweepRecord
from study.statistics import comparisons, intervals, learning_curves
from study.statistics.drives import DriveScores, by_drive
from study.statistics.intervals import Estimate, Sample
from study.statistics.learning_curves import ACCURACY, DRIVING, Panel, Point

Unit = Literal["points", "loss", "epochs", "ratio", "score"]
Interval = Annotated[Estimate, FromJson]  # the same value, that pydantic can read back from a report.json

MINUS = "\N{MINUS SIGN}"


@dataclass(frozen=True)
class Contrast:
    """Paired difference of two cells' final scores, first minus second, over the seeds that both have.

    `p`: of the interval's own t; `p_holm`: adjusted for the planned contrasts of the metric; `improvement`: probability
    that a run of the first scores above a run of the second; `detectable`: smallest difference found with 80 % power;
    `simultaneous`: interval for all planned contrasts of the metric together; `allowance`: what the contrast may owe to
    other encoders where a cell has one; `of_units`, `of_drives`: standard errors that other units and other drives
    alone would give; `drives`: how many.
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
    allowance: Number = 0.0
    of_units: Number = math.nan
    of_drives: Number = math.nan
    drives: int = 0


def ordered(heads: Iterable[str]) -> list[str]:
    """Return head sets in the order of every table: those of `HEAD_SETS`, then others as they come."""
    names = list(dict.fromkeys(heads))
    return sorted(names, key=[*HEAD_SETS, *names].index)


def points(grid: Grid) -> list[Point]:
    """Return head sets and fractions of a grid: most data first, head sets in their order."""
    return [(name, fraction) for fraction in sorted(grid.fractions, reverse=True) for name in ordered(grid.heads)]


def label(point: Point, grid: Grid) -> str:
    """Return a cell's name for people, with the fraction only where the sweep has several."""
    heads, fraction = point
    return heads if len(grid.fractions) == 1 else f"{heads} at {fraction * 100:g} %"


def difference_label(first: Point, second: Point, grid: Grid) -> str:
    """Return the name for people of a difference, first minus second."""
    return f"{label(first, grid)} {MINUS} {label(second, grid)}"


def planned(grid: Grid) -> list[tuple[Point, Point]]:
    """Return the study's contrasts: head sets against each other at each fraction, and little data against much."""
    heads = ordered(grid.heads)
    fractions = sorted(grid.fractions, reverse=True)
    contrasts = [
        ((second, fraction), (first, fraction))
        for fraction in fractions
        for first, second in itertools.combinations(heads, 2)
    ]
    if len(fractions) > 1 and grid.reference in heads:
        top = (grid.reference, fractions[0])
        contrasts += [((name, fractions[-1]), top) for name in heads if name != grid.reference]
    return contrasts


Drives = Mapping[Point, DriveScores | None]


def samples(curves: Panel, drives: Drives) -> dict[Point, Sample]:
    """Return the final scores of each cell by seed, with those by drive where known."""
    return {point: Sample(learning_curves.final(frame), drives.get(point)) for point, frame in curves.items()}


def drive_scores(record: SweepRecord, metric: str, points: Iterable[Point]) -> dict[Point, DriveScores | None]:
    """Return a metric's scores by test drive of each cell."""
    return {point: by_drive(results_at(record, point), metric) for point in points}


def paired_contrasts(record: SweepRecord, metric: str, curves: Panel, drives: Drives | None = None) -> list[Contrast]:
    """Return every planned contrast whose two cells are finished; `drives`: scores by drive, if not of predictions."""
    plan = planned(record.grid)
    level = 1 - record.grid.rules.alpha / max(len(plan), 1)
    cells = samples(curves, drive_scores(record, metric, curves) if drives is None else drives)
    differences = {
        (first, second): sample
        for first, second in plan
        if first in cells
        and second in cells
        and len((sample := comparisons.paired_sample(cells[first], cells[second])).values)
    }
    means = [intervals.crossed(sample) for sample in differences.values()]
    p_values = [mean.p() for mean in means]
    # A contrast that is planned and not there yet counts in the family as one that shows nothing.
    family = [*p_values, *[1.0] * (len(plan) - len(p_values))]
    adjusted = multipletests(family, method="holm")[1].tolist() if family else []
    return [
        Contrast(
            difference_label(first, second, record.grid),
            metric,
            first,
            second,
            mean.estimate(),
            mean.limits(level),
            p,
            p_holm,
            comparisons.improvement(cells[first].values.to_numpy(), cells[second].values.to_numpy()),
            comparisons.detectable(mean),
            allowance(record.grid.rules, curves, (first, second), metric),
            math.sqrt(mean.of_units),
            math.sqrt(mean.of_drives),
            mean.drives,
        )
        for (first, second), mean, p, p_holm in zip(differences, means, p_values, adjusted, strict=False)
    ]


def allowance(rules: Rules, curves: Panel, points: Iterable[Point], metric: str = ACCURACY) -> float:
    """Return what a contrast of some cells may owe to encoders' seeds: of those cells that have one encoder only.

    0 for a metric that the rules have no allowance for.
    """
    alone = [point[0] for point in points if learning_curves.encoders(curves[point]) == 1]
    if metric == DRIVING:
        return rules.driving_allowance * math.sqrt(len(alone) / 2)
    return rules.allowance(alone) if metric == ACCURACY else 0.0


def results_at(record: SweepRecord, point: Point) -> list[CellResult]:
    """Return the finished results of a head set and fraction, one for each encoder seed."""
    return [
        record.results[key]
        for key, cell in record.planned.items()
        if key in record.results and (cell.heads, cell.fraction) == point
    ]
