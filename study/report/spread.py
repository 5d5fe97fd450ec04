"""Scores over policies, encoders or drives, as a report has them."""

from __future__ import annotations

import math

import pandas as pd

from study.report.model import Spread
from study.statistics import intervals, learning_curves
from study.statistics.intervals import Estimate, Sample


def spread(sample: Sample) -> Spread:
    """Return scores over policies or encoders and, where they are known by drive, over drives."""
    mean, scores = intervals.crossed(sample), pd.Series(sample.values)
    units = pd.Series(learning_curves.by_seed(scores))
    return spread_of(scores, mean.estimate(), units, mean.drives, mean.more)


def spread_of(scores: pd.Series, mean: Estimate, units: pd.Series, drives: int = 0, more: float = 0.0) -> Spread:
    """Return scores with their mean; `units` are those that its interval is over, by number (see `Spread`)."""
    return Spread(
        mean=mean.value,
        sd=float(scores.std(ddof=1)) if len(scores) > 1 else math.nan,
        iqm=float(intervals.interquartile_mean(scores.to_numpy())),
        low=mean.low,
        high=mean.high,
        n=mean.n,
        kind=mean.kind,
        units={int(str(unit)): float(value) for unit, value in units.items()},
        drives=drives,
        more=more,
    )
