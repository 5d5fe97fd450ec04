"""Paired and unpaired comparisons of encoders."""

from __future__ import annotations

import math
from collections.abc import Sequence

import pandas as pd
from scipy import optimize, special
from scipy import stats as scipy_stats

from study.statistics.drives import DriveScores
from study.statistics.intervals import LEVEL, Crossed, Estimate, Sample, crossed, satterthwaite
from study.statistics.learning_curves import Array

PAIRED, WELCH = "t, paired by seed", "Welch's t, two samples"


def paired(first: pd.Series, second: pd.Series) -> pd.Series:
    """Return the differences of the seeds that both have; seed k starts from the same random numbers in both."""
    return (first - second).dropna()


def difference(first: Sample, second: Sample) -> Crossed:
    """Return the mean of two cells' scores, first minus second, over the seeds that both have and over test drives.

    The cells of a study are tested on the same drives, so differences are taken drive by drive.
    """
    return crossed(paired_sample(first, second))


def paired_sample(first: Sample, second: Sample) -> Sample:
    """Return the differences of two cells' scores by seed and by drive."""
    drives = _minus(first.drives, second.drives)
    return Sample(paired(first.values, second.values), drives)


def _minus(first: DriveScores | None, second: DriveScores | None) -> DriveScores | None:
    return first.minus(second) if first and second else None


def apart(first: Array, second: Array, drives: Sequence[tuple[float, int]] = (), *, by_seed: bool = False) -> Estimate:
    """Return the difference of two sweeps' means, first minus second; n of the smaller.

    `by_seed`: both have the same seeds, in the same order, and are paired. `drives`: the standard error that test
    drives add to each side, and their number; the sweeps' drives count as two samples, which is cautious where they are
    one.
    """
    value, n = float(first.mean() - second.mean()), min(len(first), len(second))
    if n < 2:
        return Estimate(value, math.nan, math.nan, n, "no interval from one value")
    samples = [first - second] if by_seed else [first, second]
    parts = [(float(part.var(ddof=1)) / len(part), len(part) - 1.0) for part in samples]
    kind = PAIRED if by_seed else WELCH
    if known := [(error**2, count - 1.0) for error, count in drives if count > 1]:
        parts, kind = [*parts, *known], f"{kind}, and over test drives"
    variance, freedom = satterthwaite(parts)
    half = float(special.stdtrit(freedom, (1 + LEVEL) / 2)) * math.sqrt(variance)
    return Estimate(value, value - half, value + half, n, kind)


def improvement(first: Array, second: Array) -> float:
    """Return the probability that a run of the first beats a run of the second; ties count half."""
    test = scipy_stats.mannwhitneyu(first, second, method="asymptotic")
    return float(test.statistic) / (len(first) * len(second))


def detectable(mean: Crossed) -> float:
    """Return the smallest true mean that a t test at 5 % finds with 80 % power at this variance; NaN without one."""
    if math.isnan(mean.variance) or mean.freedom < 2:
        return math.nan
    # The square of t is F, whose noncentral form holds both tails; statsmodels' `solve_power` fails for many n.
    bound = special.fdtri(1, mean.freedom, 0.95)
    effect = optimize.brentq(lambda size: special.ncfdtr(1, mean.freedom, size, bound) - 0.2, 0.0, 400.0)
    return math.sqrt(effect) * mean.error


def equivalence(mean: Crossed, margin: float) -> float:
    """Return the p of two one-sided t tests: small when the mean lies within plus or minus the margin."""
    if math.isnan(mean.variance):
        return 1.0
    if not mean.variance:
        return 0.0 if abs(mean.value) < margin else 1.0
    return float(special.stdtr(mean.freedom, -(margin - abs(mean.value)) / mean.error))
