"""Intervals of rates: so many of so many drives."""

from __future__ import annotations

from statsmodels.stats.proportion import proportion_confint

from study.statistics.intervals import LEVEL, Estimate


def wilson_interval(count: float, n: int, level: float = LEVEL) -> Estimate:
    """Return the share `count` / `n` with Wilson's score interval (1927), for independent drives; NaN where n is 0.

    `count` is a mean of counts where several policies drive the same drives: n stays the number of drives.
    """
    if not n:
        return Estimate(float("nan"), float("nan"), float("nan"), 0, "no drives", level)
    low, high = proportion_confint(count, n, alpha=1 - level, method="wilson")
    return Estimate(count / n, float(low), float(high), n, "Wilson, over drives", level)
