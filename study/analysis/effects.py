"""The planned contrasts between head sets."""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
import pandas as pd
from statsmodels.stats.multitest import multipletests

from study.analysis import comparisons, intervals, learning_curves, predictions
from study.analysis.intervals import Estimate
from study.analysis.learning_curves import ACCURACY, Panel, Point
from study.config.grid import Grid
from study.config.heads import HEAD_SETS
from study.config.settings import FromJson, Number
from study.results.cell_result import CellResult
from study.results.sweep_record import SweepRecord

Unit = Literal["points", "loss", "epochs", "ratio"]
Interval = Annotated[Estimate, FromJson]  # the same value, that pydantic can read back from a report.json

MINUS = "\N{MINUS SIGN}"


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
    episodes: Interval | None


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
    if len(fractions) > 1 and grid.baseline in heads:
        top = (grid.baseline, fractions[0])
        contrasts += [((name, fractions[-1]), top) for name in heads if name != grid.baseline]
    return contrasts


def paired_contrasts(record: SweepRecord, metric: str, curves: Panel) -> list[Contrast]:
    """Return every planned contrast whose two cells are finished."""
    plan = planned(record.grid)
    level = 1 - record.grid.rules.alpha / max(len(plan), 1)
    scores = {point: learning_curves.final(frame) for point, frame in curves.items()}
    differences = {
        (first, second): values
        for first, second in plan
        if first in scores and second in scores and len(values := comparisons.paired(scores[first], scores[second]))
    }
    p_values = [comparisons.sign_flip(learning_curves.by_encoder(values)) for values in differences.values()]
    # A contrast that is planned and not there yet counts in the family as one that shows nothing.
    family = [*p_values, *[1.0] * (len(plan) - len(p_values))]
    adjusted = multipletests(family, method="holm")[1].tolist() if family else []
    return [
        Contrast(
            difference_label(first, second, record.grid),
            metric,
            first,
            second,
            intervals.mean_interval(values),
            intervals.t_limits(learning_curves.by_encoder(values), level),
            p,
            p_holm,
            comparisons.improvement(scores[first].to_numpy(), scores[second].to_numpy()),
            comparisons.detectable(learning_curves.by_encoder(values)),
            _episodes(record, first, second) if metric == ACCURACY else None,
        )
        for ((first, second), values), p, p_holm in zip(differences.items(), p_values, adjusted, strict=False)
    ]


def results_at(record: SweepRecord, point: Point) -> list[CellResult]:
    """Return the finished results of a head set and fraction, one for each encoder seed."""
    return [
        record.results[key]
        for key, cell in record.planned.items()
        if key in record.results and (cell.heads, cell.fraction) == point
    ]


def _episodes(record: SweepRecord, first: Point, second: Point) -> Estimate:
    """Return the difference in accuracy after the last epoch, with its interval over test drives of the same weight."""

    def accuracy(point: Point) -> pd.Series:
        names = ("acceleration", "acceleration_label", "episode")
        guesses = [[result.predictions[name] for name in names] for result in results_at(record, point)]
        return pd.concat([predictions.episode_accuracy(*guess) for guess in guesses], axis=1).mean(axis=1)

    return intervals.t_interval(
        comparisons.paired(accuracy(first), accuracy(second)).to_numpy(np.float64), "t, over test drives"
    )
