"""Scores of predictions: confusion, floors, probes."""

from __future__ import annotations

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy import optimize, special
from sklearn import metrics
from sklearn.decomposition import PCA
from sklearn.dummy import DummyRegressor
from sklearn.linear_model import Ridge
from sklearn.model_selection import cross_val_predict
from sklearn.preprocessing import StandardScaler

from study.config.paper import ACCELERATIONS
from study.randomness import rng
from study.statistics.learning_curves import Array

TINY = np.finfo(np.float64).tiny

Classes = NDArray[np.int64]


def steering_floor(labels: Array) -> float:
    """Return the steering loss (smooth L1, Sec. III-B.3) of the best constant command: what a policy must beat."""
    return float(optimize.minimize_scalar(lambda constant: special.huber(1, labels - constant).mean()).fun)


def confusion(predicted: NDArray[np.uint8], label: NDArray[np.uint8]) -> Array:
    """Return the share of each true class (row) that is given each class (column), for each seed: [S, 3, 3]."""
    true, given, classes = _side_by_side(predicted, label)
    seeds, count = range(len(predicted)), len(ACCELERATIONS)
    table = metrics.confusion_matrix(true, given, labels=classes, normalize="true")
    return np.asarray(table.reshape(len(seeds), count, len(seeds), count)[seeds, :, seeds])


def macro_f1(predicted: NDArray[np.uint8], label: NDArray[np.uint8]) -> Array:
    """Return the mean over classes of the harmonic mean of precision and recall, for each seed: [S]."""
    true, given, classes = _side_by_side(predicted, label)
    scores = metrics.f1_score(true, given, labels=classes, average=None, zero_division=0.0)
    return np.asarray(scores.reshape(len(predicted), -1).mean(axis=1))


def _side_by_side(predicted: NDArray[np.uint8], label: NDArray[np.uint8]) -> tuple[Classes, Classes, Classes]:
    """Return true and given classes with classes of its own for each seed: scikit-learn is called once for all."""
    own = len(ACCELERATIONS) * np.arange(len(predicted))[:, None]
    return (label + own).ravel(), (predicted + own).ravel(), np.arange(len(ACCELERATIONS) * len(predicted))


def episode_accuracy(predicted: NDArray[np.uint8], label: NDArray[np.uint8], episode: NDArray[np.int32]) -> pd.Series:
    """Return the accuracy in each test episode, mean over seeds: frames of one drive are no independent samples."""
    return pd.Series((predicted == label).mean(axis=0)).groupby(episode).mean()


def probe(z: NDArray[np.float32], targets: Array, drive: NDArray[np.int32], folds: int = 5) -> Array:
    """Return the share of each target's variance that ridge regression on latents explains in drives not seen (R2).

    z [N, 64]; targets [N, T], where rows with a NaN are left out; whole drives are held out in turn. NaN where fewer
    than `folds` drives have targets, or where a target does not vary.
    """
    known = np.isfinite(targets).all(axis=1)
    y, group = targets[known].astype(np.float64), drive[known]
    names = np.unique(group)
    if len(names) < folds:
        return np.full(targets.shape[1], np.nan)
    x = StandardScaler().fit_transform(z[known].astype(np.float64))
    tests = [np.isin(group, held) for held in np.array_split(rng(0, "probe").permutation(names), folds)]
    splits = [(np.flatnonzero(~test), np.flatnonzero(test)) for test in tests]
    guess, mean = (cross_val_predict(model, x, y, cv=splits).reshape(y.shape) for model in (Ridge(), DummyRegressor()))
    explained = 1 - ((y - guess) ** 2).sum(axis=0) / np.maximum(((y - mean) ** 2).sum(axis=0), TINY)
    return np.where(np.ptp(y, axis=0) > 0, explained, np.nan)


def principal(z: NDArray[np.float32]) -> tuple[Array, Array]:
    """Return the first two principal components of z-scored latents [N, 2], and their shares of the variance [2]."""
    components = PCA(2, svd_solver="full")
    places = components.fit_transform(StandardScaler().fit_transform(z.astype(np.float64)))
    return np.asarray(places), np.asarray(components.explained_variance_ratio_)
