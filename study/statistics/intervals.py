"""Estimates from the tidy table: scores, curves, intervals, paired comparisons, convergence.

Every estimate carries n and the kind of its interval; textbook statistics are those of SciPy, statsmodels and
scikit-learn. Seeds come in two levels: encoder seeds, and the policy seeds on each encoder. Design A is one encoder for
each cell (the paper's, Sec. V-A): its intervals are over policies and say nothing about other encoders. Design B is
several encoders: there the encoder is the sampling unit.

Test drives are a sample, too, and crossed with the units: every unit is tested on every drive. `crossed` gives the mean
of units and drives both drawn anew. With d[u, j] the score of unit u on drive j, weighted by the drive's frames,

    V_units = var_u(d[u, .]) / U          the drives as they are
    V_drives = HC2 variance of d[., j]    the units as they are
    V_within = the same of the residuals  counted in both of the above
    V = max(V_units + V_drives - V_within, V_units, V_drives)

are the moment estimates of a two-way random-effects model. Resampling both ways (Owen 2007, "The pigeonhole bootstrap")
would count V_within twice, and of five units its tails are the normal's. HC2 (MacKinnon & White 1985) is exact for
drives of equal weight and allows for drives that differ in length. The ends are Student's, with Satterthwaite's degrees
of freedom, and p values are of the same t, so both always agree. benchmarks/power.py has the error rates.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from scipy import special
from scipy import stats as scipy_stats
from statsmodels.stats.weightstats import DescrStatsW

from study.statistics import drives as test_drives
from study.statistics.drives import DriveScores
from study.statistics.learning_curves import LAST, Array, by_encoder, encoders, panel

LEVEL = 0.95


@dataclass(frozen=True)
class Estimate:
    """A number, its interval at `level`, the number of independent units it is over, and the kind of interval.

    `low` and `high` are NaN where one unit gives no interval.
    """

    value: float
    low: float
    high: float
    n: int
    kind: str
    level: float = LEVEL


def curve_bands(table: pd.DataFrame, metric: str, split: str = "test", stage: str = "policy") -> pd.DataFrame:
    """Return, by epoch, mean and sd over all seeds and Student's interval of the mean over the sampling units.

    Columns heads, fraction, epoch, mean, sd, low, high, n (seeds), units (that the interval is over).
    """
    columns = ["heads", "fraction", "epoch", "mean", "sd", "low", "high", "n", "units"]
    parts = []
    for point, wide in panel(table, metric, split, stage).items():
        units = by_encoder(wide)
        spread = wide.to_numpy().mean(axis=0), wide.std().to_numpy(), *t_limits(units)
        values = *point, wide.columns.to_numpy(), *spread, len(wide), len(units)
        parts.append(pd.DataFrame(dict(zip(columns, values, strict=True))))
    return pd.concat(parts, ignore_index=True) if parts else pd.DataFrame(columns=columns)


def t_limits(values: Array, level: float = LEVEL) -> tuple[Any, Any]:
    """Return the ends of Student's interval of the mean along the first axis; NaN for fewer than two values."""
    if len(values) < 2:
        nothing = np.full(values.shape[1:], np.nan)[()]
        return nothing, nothing
    low, high = DescrStatsW(values).tconfint_mean(1 - level)
    return low, high


def t_interval(values: Array, kind: str, level: float = LEVEL) -> Estimate:
    """Return the mean of independent values with Student's interval."""
    low, high = t_limits(values, level)
    return Estimate(float(values.mean()), float(low), float(high), len(values), kind, level)


@dataclass(frozen=True)
class Sample:
    """Final scores by seed, or differences of them, with the same by drive where known; counted with a sign."""

    values: pd.Series
    drives: DriveScores | None = None
    sign: float = 1.0


@dataclass(frozen=True)
class Crossed:
    """A mean over sampling units and test drives, both a sample.

    `variance` of the mean with `freedom` degrees; `of_units`, `of_drives`: the parts that only new units and only new
    drives would make (NaN for drives that are not known); `units`, `drives`: how many (of the smallest sample).
    """

    value: float
    variance: float
    freedom: float
    of_units: float
    of_drives: float
    units: int
    drives: int
    over: str

    @property
    def error(self) -> float:
        """Return the standard error."""
        return math.sqrt(self.variance)

    @property
    def more(self) -> float:
        """Return the standard error that drives add to that of the units."""
        return math.sqrt(max(self.variance - self.of_units, 0.0)) if self.variance > 0 else 0.0

    def quantile(self, level: float) -> float:
        """Return the two-sided quantile of Student's t at a level."""
        return float(special.stdtrit(self.freedom, (1 + level) / 2))

    def limits(self, level: float = LEVEL, beyond: float = 0.0) -> tuple[float, float]:
        """Return the ends of the interval, each `beyond` further out."""
        half = (self.quantile(level) * self.error if self.variance else 0.0) + beyond
        return self.value - half, self.value + half

    def p(self, beyond: float = 0.0) -> float:
        """Return the two-sided p of no difference by more than `beyond`: below 1 - level where `limits` exclude 0."""
        size = abs(self.value) - beyond
        if math.isnan(self.variance) or size <= 0:
            return 1.0
        return 2 * float(special.stdtr(self.freedom, -size / self.error)) if self.variance else 0.0

    def power(self, effect: float, level: float = LEVEL) -> float:
        """Return the probability that the lower end is above 0 when the true mean is `effect`, with this variance."""
        if math.isnan(self.variance):
            return 0.0
        if not self.variance:
            return float(effect > 0)
        return 1 - float(special.nctdtr(self.freedom, effect / self.error, self.quantile(level)))

    def estimate(self, level: float = LEVEL) -> Estimate:
        """Return value and interval with their kind in words."""
        if math.isnan(self.variance):
            return Estimate(self.value, math.nan, math.nan, self.units, "no interval from one value", level)
        return Estimate(self.value, *self.limits(level), self.units, f"t, over {self.over}", level)


def crossed(*samples: Sample) -> Crossed:
    """Return the signed sum of the samples' means, with the variance of units and drives drawn anew.

    Units of different samples are independent. Drives are the same where the samples' are, else independent.
    """
    units = [by_encoder(sample.values) for sample in samples]
    value = sum(sample.sign * float(part.mean()) for sample, part in zip(samples, units, strict=True))
    fewest = min(len(part) for part in units)
    names = " or ".join(
        dict.fromkeys("policy seeds" if encoders(sample.values) == 1 else "encoder seeds" for sample in samples)
    )
    if fewest < 2:
        return Crossed(value, math.nan, math.nan, math.nan, math.nan, fewest, 0, names)
    of_units = [(float(part.var(ddof=1)) / len(part), len(part) - 1.0) for part in units]
    known = [sample.drives for sample in samples if sample.drives is not None and len(sample.drives.frames) > 1]
    if len(known) < len(samples):
        variance, freedom = satterthwaite(of_units)
        return Crossed(value, variance, freedom, variance, math.nan, fewest, 0, f"{names}; test drives as they are")
    tables = [by_encoder(part.scores) for part in known]
    weights = [part.weights for part in known]
    if test_drives.shared(known):
        means = sum(sample.sign * table.mean(axis=0) for sample, table in zip(samples, tables, strict=True))
        of_drives = [_hc2(np.asarray(means), weights[0])]
    else:
        of_drives = [_hc2(table.mean(axis=0), weight) for table, weight in zip(tables, weights, strict=True)]
    within = [_within(table, weight) for table, weight in zip(tables, weights, strict=True)]
    rows, columns = satterthwaite(of_units), satterthwaite(of_drives)
    total = satterthwaite([*of_units, *of_drives, *((-variance, freedom) for variance, freedom in within)])
    variance, freedom = max(total, rows, columns, key=lambda part: part[0])
    drives = min(len(part.frames) for part in known)
    over = f"{names} and {drives} {known[0].word}, crossed"
    return Crossed(value, variance, freedom, rows[0], columns[0], fewest, drives, over)


def _hc2(means: Array, weights: Array) -> tuple[float, float]:
    """Return the variance of a weighted mean of independent drives, and its degrees of freedom."""
    deviations = means - weights @ means
    variance = float((weights**2 * deviations**2 / (1 - weights)).sum())
    return variance, float((weights**2).sum() ** 2 / (weights**4).sum() - 1)


def _within(table: Array, weights: Array) -> tuple[float, float]:
    """Return the variance of a mean of [units, drives] that is in both the units' and the drives' variance."""
    units = len(table)
    residuals = table - table.mean(axis=0) - (table @ weights)[:, None] + weights @ table.mean(axis=0)
    variance = float((weights**2 * (residuals**2).sum(axis=0) / (1 - weights)).sum()) / (units * (units - 1))
    return variance, (units - 1) * float((weights**2).sum() ** 2 / (weights**4).sum() - 1)


def satterthwaite(parts: Sequence[tuple[float, float]]) -> tuple[float, float]:
    """Return a signed sum of variances and its degrees of freedom (1946)."""
    variance, squares = sum(part for part, _ in parts), sum(part**2 / freedom for part, freedom in parts)
    return variance, variance**2 / squares if squares else float(min(freedom for _, freedom in parts))


def interquartile_mean(values: Array) -> Array:
    """Return the mean of the middle half along the last axis (Agarwal et al. 2021)."""
    return np.asarray(scipy_stats.trim_mean(values, 0.25, axis=-1))


def mean_interval(values: pd.Series, drives: DriveScores | None = None, level: float = LEVEL) -> Estimate:
    """Return the mean of a score over seeds with its interval over sampling units and, where known, test drives."""
    return crossed(Sample(values, drives)).estimate(level)


def variance_components(curves: pd.DataFrame, last: int = LAST) -> dict[str, float]:
    """Return the standard deviations due to encoder seed, policy seed and epoch, by nested analysis of variance.

    They are over the last epochs. The encoder's is NaN in design A; components that come out negative are 0.
    """
    late = curves.iloc[:, -last:]
    by_policy = late.mean(axis=1).groupby(level="encoder_seed")
    epoch, policy, encoder = late.var(axis=1).mean(), by_policy.var().mean(), by_policy.mean().var()
    encoder -= np.nan_to_num(policy) * encoders(late) / len(late)
    policy -= epoch / late.shape[1]
    variances = {"encoder": encoder, "policy": policy, "epoch": epoch}
    return {name: float(np.sqrt(np.maximum(variance, 0.0))) for name, variance in variances.items()}
