"""The part of a report that is about driving: its numbers, its tables and its figures."""

from __future__ import annotations

import math
from dataclasses import asdict
from functools import partial

import pandas as pd

from study.analysis import driving
from study.analysis.driving import ENDS, PER_KM, RATES, SCORES
from study.analysis.metrics import Metric
from study.config.baselines import BASELINES
from study.document.blocks import Inline, italic, plain, table
from study.figures import driving as figures
from study.figures.style import Drawing
from study.report.model import Driving, DrivingPlace, DrivingScore, Spread
from study.report.rounding import fixed, interval, show
from study.report.spread import spread, spread_of
from study.results.sweep_record import SweepRecord
from study.statistics import effects, intervals
from study.statistics.drives import DriveScores
from study.statistics.intervals import Sample
from study.statistics.learning_curves import DRIVING, Point

EXPERT = "expert"


def summarise_driving(record: SweepRecord) -> Driving | None:
    """Return what a sweep's policies did at the wheel; None where none has driven in the study's town."""
    places = tuple(place for name in driving.PLACES if (place := _place(record, name)).rows)
    if not places or places[0].place != driving.TOWN:
        return None
    curves, drives = driving.panel(record)
    both = driving.accuracy_and_driving(record)
    cells = both.groupby(["heads", "fraction"])[["accuracy", "score"]].mean().reset_index()
    groups = {"policies": both, "cells": cells, "head sets": cells[~cells["heads"].isin(BASELINES)]}
    return Driving(
        scores=tuple(SCORES.values()),
        rates=tuple(RATES.values()),
        per_km=tuple(PER_KM.values()),
        ends=ENDS,
        places=places,
        contrasts=tuple(effects.paired_contrasts(record, DRIVING, curves, drives)),
        correlations={name: driving.rank_correlation(rows["accuracy"], rows["score"]) for name, rows in groups.items()},
        counted={name: len(rows) for name, rows in groups.items()},
    )


def _place(record: SweepRecord, place: str) -> DrivingPlace:
    by_cell, expert = driving.by_cell(driving.drives_at(record, place)), driving.expert_drives(record, place)
    cells = [
        _score(point, effects.label(point, record.grid), by_cell[point])
        for point in effects.points(record.grid)
        if point in by_cell
    ]
    beside = [
        _score((name, 1.0), BASELINES[name].word, by_cell[name, 1.0]) for name in BASELINES if (name, 1.0) in by_cell
    ]
    return DrivingPlace(
        place=place,
        where=driving.PLACES[place],
        cells=tuple(cells),
        baselines=tuple(beside),
        expert=None if expert.empty else _score((EXPERT, 1.0), EXPERT, expert),
    )


def _score(point: Point, cell: str, rows: pd.DataFrame) -> DrivingScore:
    means = {name: driving.scores_by_drive(rows, name) for name in SCORES}
    return DrivingScore(
        cell=cell,
        heads=point[0],
        fraction=point[1],
        policies=len(means[DRIVING].scores),
        drives=means[DRIVING].scores.shape[1],
        metrics={name: _over_drives(part) if point[0] == EXPERT else _spread(part) for name, part in means.items()},
        rates=driving.rates(rows),
        per_km=driving.per_km(rows),
        ended=driving.ends(rows),
    )


def _spread(scores: DriveScores) -> Spread:
    return spread(Sample(scores.scores.mean(axis=1), scores))


def _over_drives(scores: DriveScores) -> Spread:
    """Return the expert's score: there is one expert, so its units are the drives."""
    values = scores.scores.iloc[0]
    return spread_of(values, intervals.t_interval(values.to_numpy(), "t, over held-out drives"), values)


# --- tables ---------------------------------------------------------------------------------------------------------


def score_table(part: Driving, place: DrivingPlace) -> Inline:
    """Return the means over drives in one place; the driving score has its interval."""
    first, *others = part.scores
    header = ["Cell", *_score_header(first), *map(_title, others)]
    rows = [
        [_name(row, place), *_score_cells(first, row), *(show(metric, _mean(row, metric)) for metric in others)]
        for row in place.rows
    ]
    return table(header, rows)


def short_table(part: Driving, place: DrivingPlace) -> Inline:
    """Return driving score, route completion, success and collisions at fault in one place."""
    (first, route, *_), (success, fault, *_) = part.scores, part.rates
    header = ["Cell", *_score_header(first), *map(_title, (route, success, fault))]
    rows = [
        [
            _name(row, place),
            *_score_cells(first, row),
            show(route, _mean(row, route)),
            *(_rate_cell(metric, row) for metric in (success, fault)),
        ]
        for row in place.rows
    ]
    return table(header, rows)


def rate_table(part: Driving, place: DrivingPlace) -> Inline:
    """Return shares of drives with their intervals, in one place."""
    rows = [[_name(row, place), *(_rate_cell(metric, row) for metric in part.rates)] for row in place.rows]
    return table(["Cell", *map(_title, part.rates)], rows)


def per_km_table(part: Driving, place: DrivingPlace) -> Inline:
    """Return what happens over the way of all drives, in one place."""
    rows = [
        [_name(row, place), *(show(metric, row.per_km.get(metric.name)) for metric in part.per_km)]
        for row in place.rows
    ]
    return table(["Cell", *map(_title, part.per_km)], rows)


def _mean(row: DrivingScore, metric: Metric) -> float:
    return row.metrics[metric.name].mean


def _score_header(metric: Metric) -> list[str]:
    return ["policies", _title(metric), "sd", "interval"]


def _score_cells(metric: Metric, row: DrivingScore) -> list[object]:
    own = row.metrics[metric.name]
    return [row.policies, show(metric, own.mean), show(metric, own.sd), interval(own, partial(show, metric))]


def _rate_cell(metric: Metric, row: DrivingScore) -> str:
    rate = row.rates[metric.name]
    return f"{show(metric, rate.value)} ({interval(rate, partial(show, metric))})"


def _name(row: DrivingScore, place: DrivingPlace) -> object:
    """Return the name of a table's row; baselines are told from head sets by italics."""
    return italic(row.cell) if row in place.baselines else row.cell


def _title(metric: Metric) -> Inline:
    return Inline(f"{plain(metric.title)} [{plain(metric.unit)}]" if metric.unit else plain(metric.title))


def about(part: Driving) -> dict[str, str]:
    """Return what the columns of both tables mean, for their captions."""
    return {
        "scores": " ".join(metric.about for metric in part.scores if metric.about),
        "rates": " ".join(metric.about for metric in part.rates),
        "per_km": " ".join(filter(None, (metric.about for metric in part.per_km))),
    }


def driving_words(part: Driving) -> dict[str, str]:
    """Return driving scores in a sentence: of head sets, and of what stands beside them."""
    scores = {row.cell: f"{row.cell} {fixed(row.metrics[DRIVING].mean, 1)}" for row in part.town.rows}
    return {
        "cells": "; ".join(scores[row.cell] for row in part.town.cells),
        "beside": "; ".join(scores[row.cell] for row in part.town.rows if row not in part.town.cells),
    }


# --- figures --------------------------------------------------------------------------------------------------------


def draw_driving(record: SweepRecord, part: Driving) -> dict[str, Drawing]:
    """Return the figures of driving, by name."""
    rows = part.town.rows
    spreads = [row.metrics[DRIVING] for row in rows]
    scores = [(row.cell, row.heads, each.mean, each.low, each.high) for row, each in zip(rows, spreads, strict=True)]
    drawn = {
        "driving_score": figures.scores(scores),
        "driving_ends": figures.ends([(row.cell, row.ended) for row in rows], part.ends),
    }
    both = driving.accuracy_and_driving(record)
    if len(both):
        drawn["accuracy_driving"] = figures.accuracy_and_driving(both)
    if contrasts := [row for row in part.contrasts if math.isfinite(row.difference.low)]:
        drawn["driving_differences"] = figures.differences(
            [
                {"name": row.name, "allowance": row.allowance, **asdict(row.difference)}
                | dict(zip(("low_all", "high_all"), row.simultaneous, strict=True))
                for row in contrasts
            ]
        )
    return drawn
