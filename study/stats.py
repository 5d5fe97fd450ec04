"""Estimates from the tidy table: scores, curves, intervals, paired comparisons, convergence.

Every estimate carries n and the kind of its interval. Seeds come in two levels: encoder seeds, and the policy seeds on
each encoder. Design A is one encoder for each cell (the paper's, Sec. V-A): its intervals are over policies and say
nothing about other encoders. Design B is several encoders: there the encoder is the sampling unit.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy import optimize
from scipy import stats as scipy_stats

from study.config import ACCELERATIONS

Array = NDArray[np.float64]
Point = tuple[str, float]  # head set and data fraction
Panel = dict[Point, pd.DataFrame]  # index (encoder_seed, policy_seed), one column for each epoch

ACCURACY, STEERING = "acceleration_accuracy", "steering_loss"
LAST = 5  # epochs whose mean is a final score (Sec. V-B)
LEVEL = 0.95
DRAWS = 10_000  # bootstrap resamples
BCA = "BCa bootstrap at the expanded level, over policy seeds"
EXACT = 20  # pairs up to which every flip of signs is counted


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


def generator(purpose: str) -> np.random.Generator:
    """Random numbers of one purpose: the same table gives the same intervals."""
    return np.random.default_rng(list(purpose.encode()))


# --- from the tidy table --------------------------------------------------------------------------------------------


def panel(table: pd.DataFrame, metric: str, split: str = "test", stage: str = "policy") -> Panel:
    """Curves of a metric: for each (head set, fraction), in the table's order, a frame of seeds by epochs."""
    part = table[(table["metric"] == metric) & (table["split"] == split) & (table["stage"] == stage)]
    found: Panel = {}
    for (heads, fraction), rows in part.groupby(["heads", "fraction"], sort=False):
        seeds = rows.set_index(["encoder_seed", "policy_seed", "epoch"])["value"]
        wide = seeds.unstack("epoch")  # noqa: PD010 - pivot_table would take means of single values, for ten times as long
        found[str(heads), float(str(fraction))] = wide.astype(np.float64).sort_index().sort_index(axis=1)
    return found


def final_scores(table: pd.DataFrame, last: int = LAST) -> pd.DataFrame:
    """Mean of the last epochs on the test split, for each cell, policy seed and metric (Sec. V-B).

    Columns heads, fraction, encoder_seed, policy_seed, metric, value; in the order of the table.
    """
    keys = ["heads", "fraction", "encoder_seed", "policy_seed", "metric"]
    part = table[(table["split"] == "test") & (table["stage"] == "policy")]
    late = part[part["epoch"] > part.groupby(keys, sort=False)["epoch"].transform("max") - last]
    return late.groupby(keys, sort=False)["value"].mean().reset_index()


def final(curves: pd.DataFrame, last: int = LAST) -> pd.Series:
    """Final score of each seed of a panel's frame."""
    return curves.iloc[:, -last:].mean(axis=1)


def encoders(values: pd.Series | pd.DataFrame) -> int:
    """How many encoder seeds a score or a panel's frame is over."""
    return len(values.index.get_level_values("encoder_seed").unique())


def by_seed(values: pd.Series) -> pd.Series:
    """The sampling units by seed: with one encoder its policies' values, with several the mean of each encoder."""
    if encoders(values) == 1:
        return values.droplevel("encoder_seed")
    return values.groupby(level="encoder_seed").mean()


def by_encoder(values: pd.Series) -> Array:
    """The sampling units' values."""
    return by_seed(values).to_numpy(np.float64)


def design(curves: Iterable[pd.DataFrame]) -> str:
    """`A` when some cell has one encoder only, `B` when all have several."""
    counts = [encoders(frame) for frame in curves]
    return "B" if counts and min(counts) > 1 else "A"


def curve_bands(table: pd.DataFrame, metric: str, split: str = "test", stage: str = "policy") -> pd.DataFrame:
    """By epoch: mean and sd over all seeds, and the interval of the mean (t, over the sampling units).

    Columns heads, fraction, epoch, mean, sd, low, high, n (seeds), units (that the interval is over).
    """
    parts = []
    for (heads, fraction), wide in panel(table, metric, split, stage).items():
        values = wide.to_numpy()
        units = np.stack([by_encoder(wide[epoch]) for epoch in wide.columns], axis=1)
        low, high = t_limits(units)
        parts.append(
            pd.DataFrame(
                {
                    "heads": heads,
                    "fraction": fraction,
                    "epoch": wide.columns.to_numpy(),
                    "mean": values.mean(axis=0),
                    "sd": _sd(values),
                    "low": low,
                    "high": high,
                    "n": len(values),
                    "units": len(units),
                }
            )
        )
    columns = ["heads", "fraction", "epoch", "mean", "sd", "low", "high", "n", "units"]
    return pd.concat(parts, ignore_index=True) if parts else pd.DataFrame(columns=columns)


def _sd(values: Array) -> Array:
    nothing: Array = np.full(values.shape[1:], np.nan)
    return nothing if len(values) < 2 else np.asarray(values.std(axis=0, ddof=1))


# --- intervals ------------------------------------------------------------------------------------------------------


def t_limits(values: Array, level: float = LEVEL) -> tuple[Array, Array]:
    """Student's interval of the mean along the first axis; NaN for fewer than two values."""
    n, mean = len(values), values.mean(axis=0)
    if n < 2:
        return np.full_like(mean, np.nan), np.full_like(mean, np.nan)
    half = scipy_stats.t.ppf((1 + level) / 2, n - 1) * _sd(values) / math.sqrt(n)
    return mean - half, mean + half


def bca_limits(point: float, draws: Array, jackknife: Array, level: float = LEVEL) -> tuple[float, float]:
    """Bias-corrected and accelerated interval (Efron 1987) from bootstrap draws and jackknife values of a statistic."""
    draws = draws[np.isfinite(draws)]
    if not len(draws) or not math.isfinite(point):
        return math.nan, math.nan
    if np.ptp(draws) == 0:
        return float(draws[0]), float(draws[0])
    below = (np.mean(draws < point) + np.mean(draws <= point)) / 2
    z0 = scipy_stats.norm.ppf(np.clip(below, 1 / len(draws), 1 - 1 / len(draws)))
    away = jackknife.mean() - jackknife
    spread = float((away**2).sum())
    acceleration = float((away**3).sum()) / (6 * spread**1.5) if spread > 0 else 0.0
    z = z0 + scipy_stats.norm.ppf([(1 - level) / 2, (1 + level) / 2])
    low, high = np.quantile(draws, scipy_stats.norm.cdf(z0 + z / (1 - acceleration * z)))
    return float(low), float(high)


def expanded(n: int, level: float = LEVEL) -> float:
    """The level at which a bootstrap of n values is read so that it covers as often as `level` says (Hesterberg 2015).

    A resample's spread is too small by sqrt((n - 1) / n), and its tails are the normal's instead of Student's. At most
    what the number of resamples can tell.
    """
    tail = scipy_stats.norm.cdf(math.sqrt(n / (n - 1)) * scipy_stats.t.ppf((1 - level) / 2, n - 1))
    return 1 - 2 * max(float(tail), 1 / DRAWS)


def bootstrap(
    values: Array,
    statistic: Callable[[Array], Array] = lambda sample: sample.mean(axis=-1),
    level: float = LEVEL,
    purpose: str = "bootstrap",
) -> Estimate:
    """BCa interval of a statistic of independent values [n]; the statistic reduces the last axis.

    Read at the expanded level: of 15 values from a normal, t5 and skewed (lognormal, 0.5) distribution it covers the
    mean 95, 93 and 93 times in a hundred, without it 92, 90 and 90; of 5 values 92, 90 and 89, where Student's t does
    95, 95 and 91.
    """
    n = len(values)
    point = float(statistic(values))
    if n < 2:
        return Estimate(point, math.nan, math.nan, n, "no interval from one value", level)
    draws = statistic(values[generator(purpose).integers(n, size=(DRAWS, n))])
    left_out = statistic(np.stack([np.delete(values, index) for index in range(n)]))
    low, high = bca_limits(point, draws, left_out, expanded(n, level))
    return Estimate(point, low, high, n, BCA, level)


def interquartile_mean(values: Array) -> Array:
    """Mean of the middle half along the last axis (Agarwal et al. 2021)."""
    return np.asarray(scipy_stats.trim_mean(values, 0.25, axis=-1))


def mean_interval(values: pd.Series, level: float = LEVEL) -> Estimate:
    """Interval of the mean of a score over seeds: BCa over policies in design A, t over encoders in design B.

    With a handful of encoders a bootstrap's intervals are too short; Student's keep their level.
    """
    units = by_encoder(values)
    if encoders(values) == 1:
        return bootstrap(units, level=level)
    low, high = t_limits(units, level)
    return Estimate(float(units.mean()), float(low), float(high), len(units), "t, over encoder seeds", level)


def hierarchical(values: pd.Series, level: float = LEVEL) -> Estimate:
    """Percentile interval of the mean when encoders, and then the policies on each, are drawn anew.

    With 5 encoders of 3 policies it covers the mean 81 times in a hundred where all the spread is between encoders, 91
    where both levels spread alike, and 97 where none is (15 encoders of one policy: 93). Student's t over the encoders'
    means covers 95 in each of these, so verdicts use that.
    """
    rows = [group.to_numpy(np.float64) for _, group in values.groupby(level="encoder_seed")]
    rng = generator("hierarchical")
    means = np.empty((DRAWS, len(rows)))
    chosen = rng.integers(len(rows), size=means.shape)
    for index, row in enumerate(rows):
        where = chosen == index
        means[where] = row[rng.integers(len(row), size=(int(where.sum()), len(row)))].mean(axis=1)
    low, high = np.quantile(means.mean(axis=1), [(1 - level) / 2, (1 + level) / 2])
    kind = "hierarchical bootstrap, over encoder and policy seeds"
    return Estimate(float(values.mean()), float(low), float(high), len(rows), kind, level)


def variance_components(curves: pd.DataFrame, last: int = LAST) -> dict[str, float]:
    """Standard deviations due to encoder seed, policy seed and epoch (the last ones), by nested analysis of variance.

    The encoder's is NaN in design A. Components that come out negative are 0.
    """
    late = curves.iloc[:, -last:]
    count = encoders(late)
    policies, epochs = len(late) / count, late.shape[1]
    epoch = float(late.var(axis=1, ddof=1).mean())
    per_policy = late.mean(axis=1)
    inside = float(per_policy.groupby(level="encoder_seed").var(ddof=1).mean())
    policy = inside - epoch / epochs
    between = float(per_policy.groupby(level="encoder_seed").mean().var(ddof=1)) if count > 1 else math.nan
    encoder = between - (inside / policies if math.isfinite(inside) else 0.0)
    return {
        name: math.nan if math.isnan(value) else math.sqrt(max(value, 0.0))
        for name, value in (("encoder", encoder), ("policy", policy), ("epoch", epoch))
    }


# --- paired comparisons ---------------------------------------------------------------------------------------------


def paired(first: pd.Series, second: pd.Series) -> pd.Series:
    """Differences of the seeds that both have; seed k starts from the same random numbers in both."""
    return (first - second).dropna()


def unpaired(first: Array, second: Array, level: float = LEVEL) -> Estimate:
    """Difference of two means of independent values, first minus second, with Welch's interval."""
    value, n = float(first.mean() - second.mean()), min(len(first), len(second))
    if n < 2:
        return Estimate(value, math.nan, math.nan, n, "no interval from one value", level)
    found = scipy_stats.ttest_ind(first, second, equal_var=False).confidence_interval(level)
    return Estimate(value, float(found.low), float(found.high), n, "Welch's t, over policy or encoder seeds", level)


def sign_flip(differences: Array) -> float:
    """Two-sided p of the mean under all flips of signs: exact up to 20 pairs, beyond that from random flips.

    The smallest p that n pairs allow is 2 / 2^n.
    """
    n = len(differences)
    size = np.abs(differences).sum()
    if n == 0 or size == 0:
        return 1.0
    observed = abs(differences.sum()) - 1e-12 * size
    if n <= EXACT:
        sums = np.zeros(1)
        for value in differences:
            sums = np.concatenate([sums + value, sums - value])
        return float(np.mean(np.abs(sums) >= observed))
    signs = generator("sign flip").choice([-1.0, 1.0], size=(DRAWS, n))
    return float((1 + np.sum(np.abs(signs @ differences) >= observed)) / (1 + DRAWS))


def paired_t(differences: Sequence[float]) -> Estimate:
    """Mean of paired differences with Student's interval."""
    values = np.asarray(differences, np.float64)
    low, high = t_limits(values)
    return Estimate(float(values.mean()), float(low), float(high), len(values), "t, paired by seed")


def welch(first: Sequence[float], second: Sequence[float], level: float = LEVEL) -> Estimate:
    """Difference of the means of two separate samples, first minus second, with Welch's interval; n of the smaller."""
    value, n, kind = float(np.mean(first) - np.mean(second)), min(len(first), len(second)), "Welch's t, two samples"
    if n < 2:
        return Estimate(value, math.nan, math.nan, n, "no interval from one value", level)
    found = scipy_stats.ttest_ind(first, second, equal_var=False).confidence_interval(level)
    return Estimate(value, float(found.low), float(found.high), n, kind, level)


def holm(p_values: Sequence[float]) -> list[float]:
    """The p values adjusted for their number (Holm 1979)."""
    order = np.argsort(p_values)
    factors = np.arange(len(order), 0, -1)
    adjusted = np.minimum(1.0, np.maximum.accumulate(np.asarray(p_values)[order] * factors))
    back = np.empty(len(order))
    back[order] = adjusted
    return [float(value) for value in back]


def improvement(first: Array, second: Array) -> float:
    """Probability that a run of the first beats a run of the second; ties count half."""
    above = first[:, None] - second[None, :]
    return float((above > 0).mean() + (above == 0).mean() / 2)


def detectable(differences: Array, power: float = 0.8, alpha: float = 0.05) -> float:
    """Smallest mean difference that a paired t test on as many pairs finds with this power; NaN below three pairs."""
    n = len(differences)
    if n < 3:
        return math.nan
    bound = scipy_stats.t.ppf(1 - alpha / 2, n - 1)

    def miss(effect: float) -> float:
        shift = effect * math.sqrt(n)
        above = scipy_stats.nct.sf(bound, n - 1, shift)
        # The far tail underflows to NaN in some versions; it is nothing then.
        return float(above + np.nan_to_num(scipy_stats.nct.cdf(-bound, n - 1, shift)) - power)

    return float(optimize.brentq(miss, 0.0, 100 / math.sqrt(n)) * differences.std(ddof=1))


def equivalence(differences: Array, margin: float) -> float:
    """The p of two one-sided t tests: small when the mean difference lies within plus or minus the margin."""
    n = len(differences)
    if n < 2:
        return 1.0
    error = differences.std(ddof=1) / math.sqrt(n)
    if error == 0:
        return 0.0 if abs(differences.mean()) < margin else 1.0
    return float(scipy_stats.t.cdf((abs(differences.mean()) - margin) / error, n - 1))


# --- convergence ----------------------------------------------------------------------------------------------------


def first_reach(curve: Array, target: float) -> Array:
    """Epoch, from 1, at which a curve first reaches a target from below, along the last axis; infinite when never."""
    reached = curve >= np.asarray(target)[..., None]
    return np.where(reached.any(axis=-1), reached.argmax(axis=-1) + 1.0, np.inf)


def epochs_to_reach(curves: pd.DataFrame, baseline: pd.DataFrame, last: int = LAST) -> Estimate:
    """First epoch at which the mean curve reaches the baseline's final score (Sec. V-A), infinite when never.

    The interval is a percentile one over resampled seeds (encoders, then policies), the same in both where both have
    them; the baseline's final score is drawn anew with them.
    """
    units = len(by_encoder(curves.iloc[:, -1]))
    value = float(first_reach(curves.mean().to_numpy(), float(final(baseline, last).mean())))
    if len(curves) < 2:
        return Estimate(value, math.nan, math.nan, len(curves), "no interval from one seed")
    rng = generator("epochs to reach")
    shared = curves.index.equals(baseline.index)
    weights = _resampled(curves, rng)
    others = weights if shared else _resampled(baseline, rng)
    reached = first_reach(weights @ curves.to_numpy(), others @ final(baseline, last).to_numpy())
    low, high = np.quantile(reached, [(1 - LEVEL) / 2, (1 + LEVEL) / 2], method="closest_observation")
    return Estimate(value, float(low), float(high), units, "percentile bootstrap of the mean curve, over seeds")


def _resampled(curves: pd.DataFrame, rng: np.random.Generator) -> Array:
    """Weights [draws, seeds] of a mean over resampled encoders and policies."""
    encoder = pd.factorize(curves.index.get_level_values("encoder_seed"))[0]
    count, draws = int(encoder.max()) + 1, DRAWS // 5
    weights = np.zeros((draws, len(curves)))
    times = rng.multinomial(count, np.full(count, 1 / count), size=draws) if count > 1 else np.ones((draws, 1))
    for index in range(count):
        members = np.flatnonzero(encoder == index)
        share = rng.multinomial(len(members), np.full(len(members), 1 / len(members)), size=draws) / len(members)
        weights[:, members] = share * times[:, [index]] / count
    return weights


@dataclass(frozen=True)
class Reach:
    """Per-seed convergence: epochs at which each seed's trailing mean reaches the target and stays, infinite if never.

    `median` is Kaplan-Meier's (infinite when fewer than half reach the target), `share` of the seeds that reached it.
    """

    epochs: Array
    median: float
    share: float
    area: float


def reach_by_seed(curves: pd.DataFrame, target: float, window: int = LAST) -> Reach:
    """When each seed has reached a target for good. `area` is the mean score over all epochs, over seeds."""
    values = curves.to_numpy()
    padded = np.cumsum(np.pad(values, ((0, 0), (1, 0))), axis=1)
    trailing = np.full_like(values, -np.inf)
    trailing[:, window - 1 :] = (padded[:, window:] - padded[:, :-window]) / window
    stays = np.logical_and.accumulate(trailing[:, ::-1] >= target, axis=1)[:, ::-1]
    epochs = np.where(stays.any(axis=1), stays.argmax(axis=1) + 1.0, np.inf)
    censored = scipy_stats.CensoredData.right_censored(np.minimum(epochs, values.shape[1]), np.isinf(epochs))
    survival = scipy_stats.ecdf(censored).sf
    half = survival.quantiles[survival.probabilities <= 0.5]
    reached = np.isfinite(epochs)
    median = float(half[0]) if len(half) and reached.mean() >= 0.5 else math.inf
    return Reach(epochs, median, float(reached.mean()), float(values.mean()))


def transient(baseline: pd.DataFrame, share: float = 0.95) -> int:
    """Last epoch of the transient: the first at which the mean curve has made this share of its rise."""
    mean = baseline.mean().to_numpy()
    goal = mean[0] + share * (float(final(baseline).mean()) - mean[0])
    epoch = float(first_reach(mean, goal))
    return int(min(max(epoch, 2), len(mean)))


def spread_ratio(first: pd.DataFrame, second: pd.DataFrame, epochs: int, level: float = LEVEL) -> Estimate:
    """Ratio of the variances over policy seeds of one encoder, each a mean over the first epochs.

    With one encoder Student's interval of the jackknife's pseudo-values of the log ratio (Miller 1968), policies left
    out together in both; with several the geometric mean over encoders of each one's ratio, and a t interval over them.
    With 15 policies that spread like the laptop profile's it covers 97 times in a hundred at 95 %, 98.4 at 98.3 %.
    """
    if not first.index.equals(second.index):
        both = first.index.intersection(second.index)
        first, second = first.loc[both], second.loc[both]
    a, b = (_by_policy(frame.iloc[:, :epochs]) for frame in (first, second))
    count, seeds = a.shape[:2]
    if seeds < (2 if count > 1 else 3):
        return Estimate(math.nan, math.nan, math.nan, seeds, "no interval from so few policies on an encoder", level)
    ratios = _log_ratio(a, b, np.ones((1, seeds)))[:, 0]
    whole = float(ratios.mean())
    if count > 1:
        low, high = (float(end) for end in t_limits(ratios, level))
        return Estimate(math.exp(whole), math.exp(low), math.exp(high), count, "t, over encoder seeds", level)
    left_out = _log_ratio(a, b, 1.0 - np.eye(seeds))[0]
    low, high = (float(end) for end in t_limits(seeds * whole - (seeds - 1) * left_out, level))
    return Estimate(math.exp(whole), math.exp(low), math.exp(high), seeds, "jackknife t, over policy seeds", level)


def _by_policy(frame: pd.DataFrame) -> Array:
    """[encoders, policies, epochs]; the policies that every encoder has."""
    groups = [group.droplevel("encoder_seed") for _, group in frame.groupby(level="encoder_seed")]
    common = groups[0].index
    for group in groups[1:]:
        common = common.intersection(group.index)
    return np.stack([group.loc[common].to_numpy(np.float64) for group in groups])


def _log_ratio(first: Array, second: Array, counts: Array) -> Array:
    """Log ratio of variances for each encoder and each row of counts of its policies: [encoders, draws]."""

    def variance(values: Array) -> Array:
        share = counts / counts.sum(axis=1, keepdims=True)
        centred = values - values.mean(axis=1, keepdims=True)
        return np.asarray((share @ centred**2 - (share @ centred) ** 2).mean(axis=2))

    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(np.log(variance(first)) - np.log(variance(second)))


# --- from predictions -----------------------------------------------------------------------------------------------


def smooth_l1(error: Array) -> Array:
    """The steering loss (Sec. III-B.3): quadratic below 1, linear above."""
    size = np.abs(error)
    return np.where(size < 1, 0.5 * size**2, size - 0.5)


def steering_floor(labels: Array) -> float:
    """Steering loss of the best constant command: what a policy must beat."""
    centre = float(optimize.minimize_scalar(lambda constant: smooth_l1(labels - constant).mean()).x)
    return float(smooth_l1(labels - centre).mean())


def confusion(predicted: NDArray[np.uint8], label: NDArray[np.uint8]) -> Array:
    """Share of each true class (row) that is given each class (column), for each seed: [S, 3, 3]."""
    classes = len(ACCELERATIONS)
    counts = np.stack([np.bincount(label * classes + row, minlength=classes**2) for row in predicted.astype(int)])
    table = counts.reshape(-1, classes, classes).astype(np.float64)
    shares: Array = table / np.maximum(table.sum(axis=2, keepdims=True), 1)
    return shares


def macro_f1(predicted: NDArray[np.uint8], label: NDArray[np.uint8]) -> Array:
    """Mean over classes of the harmonic mean of precision and recall, for each seed: [S]."""
    scores = []
    for row in predicted:
        hits = [float(((row == c) & (label == c)).sum()) for c in range(len(ACCELERATIONS))]
        sizes = [float((row == c).sum() + (label == c).sum()) for c in range(len(ACCELERATIONS))]
        scores.append([2 * hit / size if size else 0.0 for hit, size in zip(hits, sizes, strict=True)])
    means: Array = np.asarray(scores).mean(axis=1)
    return means


def episode_accuracy(predicted: NDArray[np.uint8], label: NDArray[np.uint8], episode: NDArray[np.int32]) -> pd.Series:
    """Accuracy in each test episode, mean over seeds: frames of one drive are no independent samples."""
    return pd.Series((predicted == label).mean(axis=0)).groupby(episode).mean()


def pairs(points: Sequence[Point]) -> list[tuple[Point, Point]]:
    """All pairs, the later against the earlier."""
    return [(second, first) for first, second in itertools.combinations(points, 2)]


# --- from latents ---------------------------------------------------------------------------------------------------


def probe(z: NDArray[np.float32], target: Array, drive: NDArray[np.int32], folds: int = 5, ridge: float = 1.0) -> float:
    """Share of a target's variance that a linear model of the latents explains on drives it has not seen (R2).

    z [N, 64]; target [N], NaN where there is none; whole drives are held out in turn. NaN where fewer than `folds`
    drives have the target, or it does not vary.
    """
    known = np.isfinite(target)
    x, y, group = z[known].astype(np.float64), target[known], drive[known]
    names = np.unique(group)
    if len(names) < folds or np.ptp(y) == 0:
        return math.nan
    x = (x - x.mean(axis=0)) / np.maximum(x.std(axis=0), 1e-9)
    error = total = 0.0
    for held in np.array_split(generator("probe").permutation(names), folds):
        test = np.isin(group, held)
        mean = y[~test].mean()
        inside = np.column_stack([x[~test], np.ones((~test).sum())])
        penalty = ridge * np.diag([*np.ones(x.shape[1]), 0.0])
        weights = np.linalg.solve(inside.T @ inside + penalty, inside.T @ y[~test])
        guess = np.column_stack([x[test], np.ones(test.sum())]) @ weights
        error += float(((y[test] - guess) ** 2).sum())
        total += float(((y[test] - mean) ** 2).sum())
    return 1 - error / total


def principal(z: NDArray[np.float32]) -> tuple[Array, Array]:
    """First two principal components of z-scored latents [N, 2], and their shares of the variance [2]."""
    scaled = (z - z.mean(axis=0)) / np.maximum(z.std(axis=0), 1e-9)
    _, values, axes = np.linalg.svd(scaled.astype(np.float64), full_matrices=False)
    axes = axes[:2]
    # A component's sign is arbitrary: let its largest weight be positive.
    axes = axes * np.sign(axes[np.arange(2), np.abs(axes).argmax(axis=1)])[:, None]
    return np.asarray(scaled @ axes.T), np.asarray((values**2 / (values**2).sum())[:2])
