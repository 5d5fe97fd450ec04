"""Estimates from the tidy table: scores, curves, intervals, paired comparisons, convergence.

Every estimate carries n and the kind of its interval; textbook statistics are those of SciPy, statsmodels and
scikit-learn. Seeds come in two levels: encoder seeds, and the policy seeds on
each encoder. Design A is one encoder for each cell (the paper's, Sec. V-A): its intervals are over policies and say
nothing about other encoders. Design B is several encoders: there the encoder is the sampling unit.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy import optimize, special
from scipy import stats as scipy_stats
from sklearn import metrics
from sklearn.decomposition import PCA
from sklearn.dummy import DummyRegressor
from sklearn.linear_model import Ridge
from sklearn.model_selection import cross_val_predict
from sklearn.preprocessing import StandardScaler
from statsmodels.stats.weightstats import DescrStatsW

from study.config import ACCELERATIONS

Array = NDArray[np.float64]
Point = tuple[str, float]  # head set and data fraction
Panel = dict[Point, pd.DataFrame]  # index (encoder_seed, policy_seed), one column for each epoch

ACCURACY, STEERING = "acceleration_accuracy", "steering_loss"
LAST = 5  # epochs whose mean is a final score (Sec. V-B)
LEVEL = 0.95
DRAWS = 10_000  # bootstrap resamples
WELCH = "Welch's t, two samples"
BCA = "BCa bootstrap at the expanded level, over policy seeds"
CLASSES = range(len(ACCELERATIONS))
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
    """Return the random numbers of one purpose: the same table gives the same intervals."""
    return np.random.default_rng(list(purpose.encode()))


# --- from the tidy table --------------------------------------------------------------------------------------------


def panel(table: pd.DataFrame, metric: str, split: str = "test", stage: str = "policy") -> Panel:
    """Return a metric's curves: for each (head set, fraction), in the table's order, a frame of seeds by epochs."""
    part = table[(table["metric"] == metric) & (table["split"] == split) & (table["stage"] == stage)]
    curves: Panel = {}
    for (heads, fraction), rows in part.groupby(["heads", "fraction"], sort=False):
        seeds = rows.set_index(["encoder_seed", "policy_seed", "epoch"])["value"]
        wide = seeds.unstack("epoch")  # noqa: PD010 - pivot_table would take means of single values, for ten times as long
        curves[str(heads), float(str(fraction))] = wide.astype(np.float64).sort_index().sort_index(axis=1)
    return curves


def final(curves: pd.DataFrame, last: int = LAST) -> pd.Series:
    """Return the final score of each seed of a panel's frame: the mean of the last epochs (Sec. V-B)."""
    return curves.iloc[:, -last:].mean(axis=1)


def encoders(values: pd.Series | pd.DataFrame) -> int:
    """Return the number of encoder seeds of a score or a panel's frame."""
    return len(values.index.get_level_values("encoder_seed").unique())


def by_seed(values: pd.Series | pd.DataFrame) -> pd.Series | pd.DataFrame:
    """Return the sampling units: the policies where there is one encoder, else the mean of each encoder's policies."""
    if encoders(values) == 1:
        return values.droplevel("encoder_seed")
    return values.groupby(level="encoder_seed").mean()


def by_encoder(values: pd.Series | pd.DataFrame) -> Array:
    """Return the values of the sampling units, without their seeds."""
    return by_seed(values).to_numpy(np.float64)


def design(curves: Iterable[pd.DataFrame]) -> str:
    """Return `A` when some cell has one encoder only, `B` when all have several."""
    return "B" if min((encoders(frame) for frame in curves), default=1) > 1 else "A"


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


# --- intervals ------------------------------------------------------------------------------------------------------


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


def expanded(n: int, level: float = LEVEL) -> float:
    """Return the level at which a bootstrap of n values must be read to cover as often as `level` says.

    A resample's spread is too small by sqrt((n - 1) / n), and its tails are the normal's instead of Student's
    (Hesterberg 2015). The result is at most what the number of resamples can tell.
    """
    tail = scipy_stats.norm.cdf(math.sqrt(n / (n - 1)) * scipy_stats.t.ppf((1 - level) / 2, n - 1))
    return 1 - 2 * max(float(tail), 1 / DRAWS)


def bootstrap(values: Array, level: float = LEVEL) -> Estimate:
    """Return the mean of independent values with the BCa interval (Efron 1987), read at the expanded level.

    Of 15 values from a normal, t5 and skewed (lognormal, 0.5) distribution it covers the mean 95, 93 and 93 times in a
    hundred, without the expansion 92, 90 and 90; of 5 values 92, 90 and 89, where Student's t does 95, 95 and 91.
    """
    n, mean = len(values), float(values.mean())
    if n < 2:
        return Estimate(mean, math.nan, math.nan, n, "no interval from one value", level)
    if np.ptp(values) == 0:
        return Estimate(mean, mean, mean, n, BCA, level)
    low, high = scipy_stats.bootstrap(
        (values,), np.mean, n_resamples=DRAWS, confidence_level=expanded(n, level), rng=generator("bootstrap")
    ).confidence_interval
    return Estimate(mean, float(low), float(high), n, BCA, level)


def interquartile_mean(values: Array) -> Array:
    """Return the mean of the middle half along the last axis (Agarwal et al. 2021)."""
    return np.asarray(scipy_stats.trim_mean(values, 0.25, axis=-1))


def mean_interval(values: pd.Series, level: float = LEVEL) -> Estimate:
    """Return the mean of a score over seeds: with BCa over policies in design A, with t over encoders in design B.

    With a handful of encoders a bootstrap's intervals are too short; Student's keep their level.
    """
    units = by_encoder(values)
    return bootstrap(units, level) if encoders(values) == 1 else t_interval(units, "t, over encoder seeds", level)


def hierarchical(values: pd.Series, level: float = LEVEL) -> Estimate:
    """Return the mean with its percentile interval when encoders, and then the policies on each, are drawn anew.

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


# --- paired comparisons ---------------------------------------------------------------------------------------------


def paired(first: pd.Series, second: pd.Series) -> pd.Series:
    """Return the differences of the seeds that both have; seed k starts from the same random numbers in both."""
    return (first - second).dropna()


def sign_flip(differences: Array) -> float:
    """Return the two-sided p of the mean under all flips of signs: exact up to 20 pairs, beyond that by random flips.

    The smallest p that n pairs allow is 2 / 2^n. SciPy's `permutation_test` takes 0.2 s where this takes 1 ms.
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
    """Return the mean of paired differences with Student's interval."""
    return t_interval(np.asarray(differences, np.float64), "t, paired by seed")


def welch(first: Sequence[float] | Array, second: Sequence[float] | Array, kind: str = WELCH) -> Estimate:
    """Return the difference of two samples' means, first minus second, with Welch's interval; n of the smaller."""
    value, n = float(np.mean(first) - np.mean(second)), min(len(first), len(second))
    if n < 2:
        return Estimate(value, math.nan, math.nan, n, "no interval from one value")
    low, high = scipy_stats.ttest_ind(first, second, equal_var=False).confidence_interval(LEVEL)
    return Estimate(value, float(low), float(high), n, kind)


def improvement(first: Array, second: Array) -> float:
    """Return the probability that a run of the first beats a run of the second; ties count half."""
    found = scipy_stats.mannwhitneyu(first, second, method="asymptotic")
    return float(found.statistic) / (len(first) * len(second))


def detectable(differences: Array) -> float:
    """Return the smallest mean that a paired t test at 5 % finds with 80 % power on as many pairs; NaN below three."""
    n = len(differences)
    if n < 3:
        return math.nan
    # The square of t is F, whose noncentral form holds both tails; statsmodels' `solve_power` fails for many n.
    bound = special.fdtri(1, n - 1, 0.95)
    effect = optimize.brentq(lambda size: special.ncfdtr(1, n - 1, size, bound) - 0.2, 0.0, 400.0)
    return float(math.sqrt(effect / n) * differences.std(ddof=1))


def equivalence(differences: Array, margin: float) -> float:
    """Return the p of two one-sided t tests: small when the mean lies within plus or minus the margin."""
    if len(differences) < 2:
        return 1.0
    if np.ptp(differences) == 0:
        return 0.0 if abs(differences.mean()) < margin else 1.0
    return float(DescrStatsW(differences).ttost_mean(-margin, margin)[0])


# --- convergence ----------------------------------------------------------------------------------------------------


def first_reach(curve: Array, target: float) -> Array:
    """Return the epoch, from 1, at which a curve first reaches a target along the last axis; infinite when never."""
    reached = curve >= np.asarray(target)[..., None]
    return np.where(reached.any(axis=-1), reached.argmax(axis=-1) + 1.0, np.inf)


def epochs_to_reach(curves: pd.DataFrame, baseline: pd.DataFrame, last: int = LAST) -> Estimate:
    """Return the first epoch at which the mean curve reaches the baseline's final score (Sec. V-A), or infinity.

    The interval is a percentile one over resampled seeds (encoders, then policies), the same in both where both have
    them; the baseline's final score is drawn anew with them.
    """
    value = float(first_reach(curves.mean().to_numpy(), float(final(baseline, last).mean())))
    if len(curves) < 2:
        return Estimate(value, math.nan, math.nan, len(curves), "no interval from one seed")
    rng = generator("epochs to reach")
    shared = curves.index.equals(baseline.index)
    weights = _resampled(curves, rng)
    others = weights if shared else _resampled(baseline, rng)
    reached = first_reach(weights @ curves.to_numpy(), others @ final(baseline, last).to_numpy())
    low, high = np.quantile(reached, [(1 - LEVEL) / 2, (1 + LEVEL) / 2], method="closest_observation")
    kind = "percentile bootstrap of the mean curve, over seeds"
    return Estimate(value, float(low), float(high), len(by_seed(curves)), kind)


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
    """Return when each seed has reached a target for good; `area` is the mean score over all epochs and seeds."""
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
    """Return the last epoch of the transient: the first at which the mean curve has made this share of its rise."""
    mean = baseline.mean().to_numpy()
    goal = mean[0] + share * (float(final(baseline).mean()) - mean[0])
    epoch = float(first_reach(mean, goal))
    return int(min(max(epoch, 2), len(mean)))


def spread_ratio(first: pd.DataFrame, second: pd.DataFrame, epochs: int, level: float = LEVEL) -> Estimate:
    """Return the ratio of the variances over policy seeds of one encoder, each a mean over the first epochs.

    With one encoder Student's interval of the jackknife's pseudo-values of the log ratio (Miller 1968), policies left
    out together in both; with several the geometric mean over encoders of each one's ratio, and a t interval over them.
    With 15 policies that spread like the laptop profile's it covers 97 times in a hundred at 95 %, 98.4 at 98.3 %.
    """
    a, b = (_by_policy(frame.iloc[:, :epochs]) for frame in first.align(second, join="inner", axis=0))
    count, seeds = a.shape[:2]
    if seeds < (2 if count > 1 else 3):
        return Estimate(math.nan, math.nan, math.nan, seeds, "no interval from so few policies on an encoder", level)
    logs, kind = _log_ratios(a, b), "t, over encoder seeds"
    mean = float(logs.mean())
    if count == 1:
        left_out = [_log_ratios(np.delete(a, seed, axis=1), np.delete(b, seed, axis=1)) for seed in range(seeds)]
        logs, kind = seeds * mean - (seeds - 1) * np.concatenate(left_out), "jackknife t, over policy seeds"
    low, high = t_limits(logs, level)
    return Estimate(math.exp(mean), math.exp(low), math.exp(high), len(logs), kind, level)


def _by_policy(frame: pd.DataFrame) -> Array:
    """Return [encoders, policies, epochs] of the policies that every encoder has."""
    count = encoders(frame)
    shared = frame.groupby(level="policy_seed").filter(lambda rows: len(rows) == count)
    return shared.to_numpy(np.float64).reshape(count, -1, frame.shape[1])


def _log_ratios(first: Array, second: Array) -> Array:
    """Return, for each encoder, the log ratio of the variances over policies, which are means over epochs."""
    with np.errstate(divide="ignore", invalid="ignore"):
        a, b = (np.log(values.var(axis=1).mean(axis=1)) for values in (first, second))
        return np.asarray(a - b)


# --- from predictions -----------------------------------------------------------------------------------------------


def steering_floor(labels: Array) -> float:
    """Return the steering loss (smooth L1, Sec. III-B.3) of the best constant command: what a policy must beat."""
    return float(optimize.minimize_scalar(lambda constant: special.huber(1, labels - constant).mean()).fun)


def confusion(predicted: NDArray[np.uint8], label: NDArray[np.uint8]) -> Array:
    """Return the share of each true class (row) that is given each class (column), for each seed: [S, 3, 3]."""
    tables = [metrics.confusion_matrix(label, row, labels=CLASSES, normalize="true") for row in predicted]
    return np.stack(tables)


def macro_f1(predicted: NDArray[np.uint8], label: NDArray[np.uint8]) -> Array:
    """Return the mean over classes of the harmonic mean of precision and recall, for each seed: [S]."""
    return np.array(
        [metrics.f1_score(label, row, labels=CLASSES, average="macro", zero_division=0.0) for row in predicted]
    )


def episode_accuracy(predicted: NDArray[np.uint8], label: NDArray[np.uint8], episode: NDArray[np.int32]) -> pd.Series:
    """Return the accuracy in each test episode, mean over seeds: frames of one drive are no independent samples."""
    return pd.Series((predicted == label).mean(axis=0)).groupby(episode).mean()


# --- from latents ---------------------------------------------------------------------------------------------------


def probe(z: NDArray[np.float32], target: Array, drive: NDArray[np.int32], folds: int = 5) -> float:
    """Return the share of a target's variance that ridge regression on latents explains in drives not seen (R2).

    z [N, 64]; target [N], NaN where there is none; whole drives are held out in turn. NaN where fewer than `folds`
    drives have the target, or it does not vary.
    """
    known = np.isfinite(target)
    y, group = target[known], drive[known]
    names = np.unique(group)
    if len(names) < folds or np.ptp(y) == 0:
        return math.nan
    x = StandardScaler().fit_transform(z[known].astype(np.float64))
    tests = [np.isin(group, held) for held in np.array_split(generator("probe").permutation(names), folds)]
    splits = [(np.flatnonzero(~test), np.flatnonzero(test)) for test in tests]
    guess, mean = (cross_val_predict(model, x, y, cv=splits) for model in (Ridge(), DummyRegressor()))
    return float(1 - ((y - guess) ** 2).sum() / ((y - mean) ** 2).sum())


def principal(z: NDArray[np.float32]) -> tuple[Array, Array]:
    """Return the first two principal components of z-scored latents [N, 2], and their shares of the variance [2]."""
    components = PCA(2, svd_solver="full")
    places = components.fit_transform(StandardScaler().fit_transform(z.astype(np.float64)))
    return np.asarray(places), np.asarray(components.explained_variance_ratio_)
