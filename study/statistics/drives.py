"""Scores by test drive: what the drives that a study happens to test on add to the spread of its numbers.

Frames of one drive are no independent samples, so the sample is that of drives. Curves by drive are not stored; scores
by drive are those of the predictions after the last epoch.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy import special

from study.products import Arrays
from study.results.cell_result import CellResult
from study.statistics.learning_curves import ACCURACY, KEYFRAME, STEERING, Array


@dataclass(frozen=True)
class DriveScores:
    """Scores of policies on each test drive.

    `scores`: mean over a drive's frames, index (encoder_seed, policy_seed), one column for each drive; `frames`: how
    many each drive has, its weight in the score on all frames [drives]; `word`: what such drives are called.
    """

    scores: pd.DataFrame
    frames: Array
    word: str = "test drives"

    @property
    def weights(self) -> Array:
        """Return the share of the frames that each drive has."""
        return np.asarray(self.frames / self.frames.sum())

    def same_drives(self, other: DriveScores) -> bool:
        """Return whether both are of the same frames of the same drives."""
        return self.scores.columns.equals(other.scores.columns) and np.array_equal(self.frames, other.frames)

    def minus(self, other: DriveScores) -> DriveScores | None:
        """Return the differences of the seeds that both have; None where the drives are others."""
        if not self.same_drives(other):
            return None
        return replace(self, scores=(self.scores - other.scores).dropna())


Frames = tuple[Array, NDArray[np.bool_] | None]  # a score of each policy on each frame [S, N], and which frames count


def _accuracy(predictions: Arrays) -> Frames:
    return (predictions["acceleration"] == predictions["acceleration_label"]).astype(np.float64), None


def _keyframes(predictions: Arrays) -> Frames:
    return _accuracy(predictions)[0], predictions["keyframe"].astype(bool)


def _steering(predictions: Arrays) -> Frames:
    errors = predictions["steering"].astype(np.float64) - predictions["steering_label"]
    return np.asarray(special.huber(1, errors)), None  # smooth L1, Sec. III-B.3


BY_FRAME: dict[str, tuple[tuple[str, ...], Callable[[Arrays], Frames]]] = {  # with the arrays that each needs
    ACCURACY: (("acceleration", "acceleration_label"), _accuracy),
    KEYFRAME: (("acceleration", "acceleration_label", "keyframe"), _keyframes),
    STEERING: (("steering", "steering_label"), _steering),
}


def by_drive(results: Sequence[CellResult], metric: str) -> DriveScores | None:
    """Return a metric's scores by drive of one cell's results, one for each encoder.

    None for a metric that is no mean over frames, for results that lack the arrays, and where the encoders were tested
    on different drives.
    """
    needed, score = BY_FRAME.get(metric, ((), None))
    if score is None or any(not {*needed, "episode"} <= set(result.predictions) for result in results):
        return None
    parts = [_of_result(result, *score(result.predictions)) for result in results]
    if not parts or not all(part.same_drives(parts[0]) for part in parts) or not parts[0].frames.size:
        return None
    return DriveScores(pd.concat([part.scores for part in parts]).sort_index(), parts[0].frames)


def _of_result(result: CellResult, scores: Array, counted: NDArray[np.bool_] | None) -> DriveScores:
    episode = result.predictions["episode"]
    if counted is not None:
        scores, episode = scores[:, counted], episode[counted]
    names, place = np.unique(episode, return_inverse=True)
    frames = np.bincount(place, minlength=len(names)).astype(np.float64)
    means = [np.bincount(place, weights=row, minlength=len(names)) / frames for row in scores]
    index = pd.MultiIndex.from_product(
        [[result.cell.encoder_seed], range(len(scores))], names=["encoder_seed", "policy_seed"]
    )
    return DriveScores(pd.DataFrame(np.reshape(means, (len(scores), len(names))), index, names), frames)


def shared(parts: Iterable[DriveScores | None]) -> bool:
    """Return whether all are there, and of the same drives."""
    known = list(parts)
    first = known[0] if known else None
    return first is not None and all(part is not None and part.same_drives(first) for part in known)
