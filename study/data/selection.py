"""Selection: which recorded moments become frames, in which split (Sec. IV-A, V; docs/paper.md).

Each drive gives candidates: moments of one vehicle at least `spacing` apart. From the candidates of all drives the
frames are drawn without replacement: uniformly for the encoder set, and raked for the policy set, so that steering
bins, acceleration classes and standing vehicles have the shares that the settings name.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from study.birdview.limits import Limits
from study.birdview.renderer import Moments, valid_moments
from study.config.paper import ACCELERATIONS, STEERING_CROP
from study.config.settings import BirdviewSettings, FramesSettings
from study.data.true_state import state_of
from study.episode.files import read_episode
from study.episode.schema import RATE_HZ, Episode
from study.errors import BadInputError
from study.intake.imported import take_groups
from study.randomness import rng

SETS = ("encoder", "policy")
STEERING_EDGES = (-0.15, -0.05, -0.01, 0.01, 0.05, 0.15)  # of the bins that the policy set is raked to
STANDING = 0.1  # [m/s], below it a vehicle stands
KEYFRAME_STEPS = 5  # 0.5 s: the moments at which copying the last command fails (Wen et al. 2021)

LABELS: dict[str, type[np.generic]] = {
    "episode": np.int32,  # position in the set's list of drives
    "agent": np.int32,  # the vehicle's id in its Episode
    "step": np.int32,
    "train": np.bool_,
    "steering": np.float32,
    "acceleration": np.int8,  # class, an index into ACCELERATIONS
    "speed": np.float32,  # [m/s]
    "light": np.uint8,  # of the governing light in range: 0 none or green, 1 yellow, 2 red
    "light_distance": np.float32,  # [m], NaN where there is none
    "lead_gap": np.float32,  # [m], NaN where the way is free
    "standing": np.bool_,
    "limit": np.float32,  # speed limit of the nearest lane [m/s], NaN where unknown
    "last_steering": np.float32,  # command of one step ago
    "last_acceleration": np.int8,
    "keyframe": np.bool_,  # whether the class of acceleration has changed within KEYFRAME_STEPS
    "weight": np.float32,  # candidate moments that the frame stands for, mean 1: undoes the raking
}

Indices = NDArray[np.int64]
Columns = dict[str, NDArray[Any]]


def candidates(path: Path, number: int, name: str, frames: FramesSettings, birdview: BirdviewSettings) -> Columns:
    """Return the label columns of one drive's candidate moments.

    Every k-th moment of each vehicle is taken, k the spacing, from a random one on; for the encoder set a standing
    moment is kept with probability `standing_weight`.
    """
    episode = read_episode(path)
    generator = rng(frames.seed, f"candidates {name} {number}")
    every = max(1, int(np.ceil(frames.spacing * RATE_HZ - 1e-9)))
    phase = generator.integers(every, size=len(episode.agents))
    moments = valid_moments(episode, birdview)
    moments = moments[(moments[:, 0] - phase[moments[:, 1]]) % every == 0]
    if name == "encoder":
        moving = episode.speed[tuple(moments.T)] >= STANDING
        moments = moments[moving | (generator.random(len(moments)) < frames.standing_weight)]
    at = tuple(moments.T)
    ids = np.array([agent.id for agent in episode.agents], int)
    columns = {
        "episode": np.full(len(moments), number),
        "agent": ids[moments[:, 1]],
        "step": moments[:, 0],
        "train": np.ones(len(moments), bool),
        "steering": episode.steering[at],
        "acceleration": np.searchsorted(ACCELERATIONS, episode.acceleration[at]),
        **state_of(episode, moments, birdview, Limits(episode.lanes)),
        "standing": episode.speed[at] < STANDING,
        **_commands_before(episode, moments),
        "weight": np.ones(len(moments)),
    }
    return {name: columns[name].astype(kind, copy=False) for name, kind in LABELS.items()}


def _commands_before(episode: Episode, moments: Moments) -> Columns:
    """Return the last command before each moment, and whether the class has changed; an unknown one has not."""
    steps, agents = moments.T
    now = episode.acceleration[steps, agents]
    changed = np.zeros(len(moments), bool)
    for back in range(1, KEYFRAME_STEPS + 1):
        before = episode.acceleration[np.maximum(steps - back, 0), agents]
        changed |= np.isfinite(before) & (before != now)
    steering, acceleration = (
        np.nan_to_num(values[np.maximum(steps - 1, 0), agents]) for values in (episode.steering, episode.acceleration)
    )
    classes = np.searchsorted(ACCELERATIONS, acceleration)
    return {"last_steering": steering, "last_acceleration": classes, "keyframe": changed}


def choose(
    columns: Columns, name: str, wanted: int, recordings: Sequence[str], settings: FramesSettings
) -> tuple[Indices, Columns, list[int]]:
    """Return the rows of the chosen candidates, sorted, their columns "train" and "weight", and the test drives.

    `recordings`: what each drive was cut from. Drives of one recording train or test, never both. Raises BadInputError
    when the drives give too few frames, or are all of one recording.
    """
    generator = rng(settings.seed, f"frames {name}")
    test = round(wanted * settings.test_share)
    balance = settings.balance if name == "policy" else "none"
    if settings.split == "frame":
        pool = np.arange(len(columns["step"]))
        rows, weight = _sample(columns, pool, wanted, balance, name, "", settings, generator)
        train = np.ones(wanted, bool)
        train[generator.permutation(wanted)[:test]] = False
        return rows, {"train": train, "weight": weight}, []
    test_drives = _test_drives(recordings, name, settings.test_share, generator)
    in_test = np.isin(columns["episode"], test_drives)
    parts = [
        _sample(columns, np.flatnonzero(pool), number, balance, name, f" {split}", settings, generator)
        for pool, number, split in ((~in_test, wanted - test, "training"), (in_test, test, "test"))
    ]
    rows, weight = (np.concatenate(part) for part in zip(*parts, strict=True))
    order = np.argsort(rows, kind="stable")
    return rows[order], {"train": ~in_test[rows[order]], "weight": weight[order]}, test_drives.tolist()


def _test_drives(recordings: Sequence[str], name: str, share: float, generator: np.random.Generator) -> Indices:
    """Return the drives of random recordings, about this share of all drives, sorted."""
    names = list(dict.fromkeys(recordings))
    if len(names) < 2:
        raise BadInputError(
            f"the {name} set has drives of {len(names)} recording; it needs one to train and one to test: import more, "
            "or choose --frames.split frame"
        )
    sizes = [recordings.count(each) for each in names]
    order = generator.permutation(len(names)).tolist()
    taken = {names[group] for group in take_groups(sizes, order, round(len(recordings) * share), 1)}
    return np.array([number for number, each in enumerate(recordings) if each in taken], np.int64)


def _sample(
    columns: Columns,
    pool: Indices,
    wanted: int,
    balance: str,
    name: str,
    split: str,
    settings: FramesSettings,
    generator: np.random.Generator,
) -> tuple[Indices, NDArray[np.float32]]:
    """Draw `wanted` rows of the pool without replacement, sorted; raked to the targets unless `balance` is none.

    Returns the rows and their weights, mean 1: weighted, they are distributed as the pool is.
    """
    if wanted > len(pool):
        raise BadInputError(
            f"the {name} set needs {wanted}{split} frames and its drives give {len(pool)}: lower "
            f"--frames.{name} or --frames.spacing, or raise --recording.{name}_episodes or --recording.duration "
            "(import more drives, if they are yours)"
        )
    if balance == "none":
        return np.sort(generator.permutation(pool)[:wanted]), np.ones(wanted, np.float32)
    cell, shape, margins = _cells(columns, pool, balance, settings)
    available = np.bincount(cell, minlength=int(np.prod(shape))).reshape(shape)
    counts = rake(available, margins, wanted, settings.weight_cap).reshape(-1)
    order = np.lexsort((generator.random(len(pool)), cell))
    first = np.searchsorted(cell[order], np.arange(len(counts)))
    rank = np.arange(len(pool)) - first[cell[order]]
    chosen = np.sort(order[rank < counts[cell[order]]])
    weight = (available.reshape(-1) / np.maximum(counts, 1))[cell[chosen]]
    return pool[chosen], (weight / weight.mean()).astype(np.float32)


def _cells(
    columns: Columns, pool: Indices, balance: str, settings: FramesSettings
) -> tuple[NDArray[np.intp], tuple[int, ...], dict[int, NDArray[np.float64]]]:
    """Return the cell of each row in (steering bin, class, standing), the cells' shape, and target shares by axis."""
    shape = (len(STEERING_EDGES) + 1, len(ACCELERATIONS), 2)
    bins = np.digitize(columns["steering"][pool], STEERING_EDGES)
    cell = np.ravel_multi_index((bins, columns["acceleration"][pool], columns["standing"][pool].astype(int)), shape)
    middle = len(STEERING_EDGES) // 2
    steering = np.full(shape[0], (1 - settings.near_zero) / (shape[0] - 1))
    steering[middle] = settings.near_zero
    margins = {0: steering}
    if balance == "all":
        margins |= {1: np.full(3, 1 / 3), 2: np.array([1 - settings.standing, settings.standing])}
    return cell, shape, margins


def rake(
    available: NDArray[np.integer[Any]], margins: dict[int, NDArray[np.float64]], wanted: int, cap: float
) -> NDArray[np.int64]:
    """Return how many of each cell's `available` to take, so that `wanted` come nearest to the target margins.

    This is iterative proportional fitting in which no cell gives more than it has, or more than `cap` times its
    proportional share. `margins`: axis -> shares along it. Raises BadInputError when the cap leaves too few.
    """
    proportional = available * (wanted / max(int(available.sum()), 1))
    most = np.minimum(available, np.ceil(cap * proportional))
    if most.sum() < wanted:
        raise BadInputError(
            f"--frames.weight_cap {cap:g} lets {most.sum():.0f} of {wanted} frames be chosen; it must be 1 or more"
        )
    counts = np.minimum(proportional, most)
    for _ in range(500):
        for axis, shares in margins.items():
            others = tuple(other for other in range(counts.ndim) if other != axis)
            have = counts.sum(axis=others, keepdims=True)
            target = wanted * np.expand_dims(shares, others)
            counts = np.minimum(counts * (target / np.maximum(have, 1e-12)), most)
    # Where the targets cannot be met, the rest comes from whatever is left, in proportion.
    left = most - counts
    if left.sum() > 0:
        counts += left * (max(wanted - counts.sum(), 0) / left.sum())
    rounded: NDArray[np.int64] = np.floor(counts + 1e-9).astype(np.int64)
    missing = wanted - int(rounded.sum())
    rest = np.where(rounded < most, counts - rounded, -1.0).reshape(-1)
    rounded.reshape(-1)[np.argsort(-rest, kind="stable")[:missing]] += 1
    return rounded


def histograms(columns: Columns, rows: NDArray[np.bool_]) -> dict[str, Any]:
    """Return histograms of a set's labels, and the accuracy of always saying the commonest class."""
    steering, standing = columns["steering"][rows], columns["standing"][rows]
    classes = np.bincount(columns["acceleration"][rows], minlength=len(ACCELERATIONS))
    number = max(int(rows.sum()), 1)
    return {
        "frames": int(rows.sum()),
        "drives": len(np.unique(columns["episode"][rows])),
        "steering_edges": list(STEERING_EDGES),
        "steering": np.bincount(np.digitize(steering, STEERING_EDGES), minlength=len(STEERING_EDGES) + 1).tolist(),
        "acceleration": classes.tolist(),
        "standing": int(standing.sum()),
        "light": np.bincount(columns["light"][rows], minlength=3).tolist(),
        "majority_accuracy": float(classes.max() / number),
        "steering_beyond_crop": float((np.abs(steering) > STEERING_CROP).sum() / number),
    }
