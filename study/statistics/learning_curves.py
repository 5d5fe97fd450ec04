"""Learning curves as tables of seeds and epochs, and what is read from them."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import pandas as pd
from numpy.typing import NDArray

Array = NDArray[np.float64]
Point = tuple[str, float]  # head set and data fraction
Panel = dict[Point, pd.DataFrame]  # index (encoder_seed, policy_seed), one column for each epoch

ACCURACY, STEERING, KEYFRAME = "acceleration_accuracy", "steering_loss", "keyframe_accuracy"
DRIVING = "driving_score"  # at the wheel, 0 to 100
LAST = 5  # epochs whose mean is a final score (Sec. V-B)


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
    """Return the values of the sampling units, without their seeds; as `by_seed`, ten times as fast."""
    names, place = np.unique(values.index.get_level_values("encoder_seed").to_numpy(), return_inverse=True)
    scores = values.to_numpy(np.float64)
    return scores if len(names) == 1 else np.stack([scores[place == unit].mean(axis=0) for unit in range(len(names))])


def design(curves: Iterable[pd.DataFrame]) -> str:
    """Return `A` when some cell has one encoder only, `B` when all have several."""
    return "B" if min((encoders(frame) for frame in curves), default=1) > 1 else "A"
