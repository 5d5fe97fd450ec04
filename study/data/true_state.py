"""The true state in place of a latent: a ceiling for what policies can learn from an encoder.

It holds what the expert decides its acceleration by and the image shows (Sec. III-A, IV-C): how far the speed is below
the limit, the speed now and over the past second, the governing light and the distance to its stop line, the gap to the
vehicle ahead. The route is not in it, so it is a ceiling for acceleration only.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from study.config.paper import LATENT
from study.data.past_speeds import past_speeds

PAST = 10  # steps at 10 Hz: the past second
FAR = 40.0  # [m] the image's side; what is farther away, or absent, counts as this far
# A small network learns thresholds slowly from one number, so each is spread over this many ramps.
RAMPS = {"light_distance": 12, "lead_gap": 12}
HEADROOM = (-0.5, 11.5, 24)  # speed below the limit [m/s]: from, to, ramps

Array = NDArray[np.float64]


def true_state(labels: pd.DataFrame, sources: Sequence[Mapping[str, str]], drives: Path) -> NDArray[np.float32]:
    """Return the state [N, 64] of frames with these labels, z-scored over the training frames, padded with 0.

    `sources` lists the set's drives, name and digest, as a frame store's manifest does; they lie in `drives`.
    Raises BadInputError when a drive is missing or has changed.
    """
    train = labels["train"].to_numpy()
    values_of = {name: labels[name].to_numpy(np.float64) for name in RAMPS}
    light = labels["light"].to_numpy()
    parts = [np.stack([light == state for state in range(3)], axis=1)]
    for name, count in RAMPS.items():
        parts.append(np.isnan(values_of[name])[:, None])
        parts.append(_ramps(np.nan_to_num(values_of[name], nan=FAR), FAR, count))
    speed, limit = (labels[name].to_numpy(np.float64) for name in ("speed", "limit"))
    known = np.where(np.isnan(limit), speed[train].max(), limit)
    low, high, count = HEADROOM
    parts += [_ramps(known - speed - low, high - low, count), speed[:, None]]
    parts.append(speed[:, None] - past_speeds(labels, sources, drives, range(1, PAST + 1)))
    values = np.concatenate(parts, axis=1).astype(np.float64)
    spread = values[train].std(axis=0)
    scaled = (values - values[train].mean(axis=0)) / np.where(spread > 0, spread, 1.0)
    return np.pad(scaled, ((0, 0), (0, LATENT - scaled.shape[1]))).astype(np.float32)


def _ramps(values: Array, high: float, count: int) -> Array:
    """Return [N, count]: the part of each of `count` equal stretches from 0 to `high` that a value covers."""
    return np.clip(values[:, None] * (count / max(high, 1e-9)) - np.arange(count), 0, 1)
