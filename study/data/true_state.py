"""The true state in place of a latent: a ceiling for what policies can learn from an encoder.

It holds what the expert decides its acceleration by and the image shows (Sec. III-A, IV-C): how far the speed is below
the limit, the speed now and over the past second, the governing light and the distance to its stop line, the gap to the
vehicle ahead. The route is not in it, so it is a ceiling for acceleration only.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from study.birdview.limits import Limits
from study.birdview.renderer import Moments, governing_light
from study.config.paper import LATENT
from study.config.settings import BirdviewSettings
from study.data.past_speeds import past_speeds, speeds_before
from study.episode.schema import Episode

PAST = 10  # steps at 10 Hz: the past second
PAST_STEPS = range(1, PAST + 1)
FAR = 40.0  # [m] the image's side; what is farther away, or absent, counts as this far
# A small network learns thresholds slowly from one number, so each is spread over this many ramps.
RAMPS = {"light_distance": 12, "lead_gap": 12}
HEADROOM = (-0.5, 11.5, 24)  # speed below the limit [m/s]: from, to, ramps

STATE = ("speed", "light", "light_distance", "lead_gap", "limit")  # of the labels of frames, see LABELS

Array = NDArray[np.float64]
Columns = dict[str, NDArray[Any]]  # STATE [N], and "past" [N, PAST]: the speeds of the past second [m/s]


def state_of(episode: Episode, moments: Moments, settings: BirdviewSettings, limits: Limits) -> Columns:
    """Return STATE of moments [M, 2] of one Episode, as the labels of frames have it; `limits` are those of its map."""
    at = tuple(moments.T)
    return {
        "speed": episode.speed[at],
        "light": governing_light(episode, settings, moments),
        "light_distance": episode.light_distance[at],
        "lead_gap": episode.lead_gap[at],
        "limit": limits.of(episode, moments),
    }


def live_state(episode: Episode, moments: Moments, settings: BirdviewSettings, limits: Limits) -> Columns:
    """Return the columns of moments of a drive that goes on."""
    return state_of(episode, moments, settings, limits) | {"past": speeds_before(episode, moments, PAST_STEPS)}


def stored_state(labels: pd.DataFrame, sources: Sequence[Mapping[str, str]], drives: Path) -> Columns:
    """Return the columns of frames with these labels.

    `sources` lists the set's drives, name and digest, as a frame store's manifest does; they lie in `drives`.
    Raises BadInputError when a drive is missing or has changed.
    """
    past = past_speeds(labels, sources, drives, PAST_STEPS)
    return {name: labels[name].to_numpy() for name in STATE} | {"past": past}


def state_scale(columns: Columns, train: NDArray[np.bool_]) -> Columns:
    """Return what `scaled_state` needs of the training frames: their fastest speed, means and spreads."""
    fastest = columns["speed"][train].max().astype(np.float64)
    values = _values(columns, fastest)[train]
    spread = values.std(axis=0)
    return {"fastest": fastest[None], "mean": values.mean(axis=0), "spread": np.where(spread > 0, spread, 1.0)}


def scaled_state(columns: Columns, scale: Mapping[str, NDArray[Any]]) -> NDArray[np.float32]:
    """Return the state [N, 64], z-scored over the training frames, padded with 0."""
    scaled = (_values(columns, scale["fastest"][0]) - scale["mean"]) / scale["spread"]
    return np.pad(scaled, ((0, 0), (0, LATENT - scaled.shape[1]))).astype(np.float32)


def _values(columns: Columns, fastest: np.float64) -> Array:
    """Return the numbers of the state [N, D]; where no limit is known, it is the `fastest` speed."""
    parts = [np.stack([columns["light"] == state for state in range(3)], axis=1)]
    for name, count in RAMPS.items():
        values = columns[name].astype(np.float64)
        parts.append(np.isnan(values)[:, None])
        parts.append(_ramps(np.nan_to_num(values, nan=FAR), FAR, count))
    speed, limit = (columns[name].astype(np.float64) for name in ("speed", "limit"))
    known = np.where(np.isnan(limit), fastest, limit)
    low, high, count = HEADROOM
    parts += [_ramps(known - speed - low, high - low, count), speed[:, None], speed[:, None] - columns["past"]]
    return np.concatenate(parts, axis=1).astype(np.float64)


def _ramps(values: Array, high: float, count: int) -> Array:
    """Return [N, count]: the part of each of `count` equal stretches from 0 to `high` that a value covers."""
    return np.clip(values[:, None] * (count / max(high, 1e-9)) - np.arange(count), 0, 1)
