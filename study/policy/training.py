"""Train the policies of a cell."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
import torch
from numpy.typing import NDArray
from torch import Tensor

from study.compute.device import keep_memory
from study.compute.trainer import trainer
from study.config.paper import ACCELERATIONS
from study.config.settings import PolicySettings
from study.errors import BadInputError, TrainingDivergedError
from study.policy.ensemble import PolicyData, PolicyEnsemble
from study.policy.latents import Arrays, normalisation, normalise
from study.policy.metrics import METRICS, SPLITS, Labels
from study.randomness import rng
from study.results.cell_result import CURVE_COLUMNS

Log = Callable[[int, dict[str, float]], None]
Progress = Callable[[int, int], None]
Labelled = tuple[NDArray[np.float32], pd.DataFrame]  # latents [N, Z] and their labels


@dataclass(frozen=True)
class TrainedPolicies:
    """S trained policies and their curves; N test frames.

    `weights`: "<network>_<layer>_weight" [S, in, out] and "..._bias" [S, out] float32 for networks "steering" and
    "acceleration", layers 0 to 2; "z_mean", "z_std" [Z]; "z_l2" [1] uint8: 1 where z is scaled to unit length.
    `curves`: one row per measured point, columns CURVE_COLUMNS, of the policies without dropout after each epoch.
    `acceleration` [S, N] uint8 class and `steering` [S, N] float32: on the test frames after the last epoch.
    """

    weights: Arrays
    curves: pd.DataFrame
    acceleration: NDArray[np.uint8]
    steering: NDArray[np.float32]
    seconds: float


def train_policies(
    z_train: NDArray[np.float32],
    z_test: NDArray[np.float32],
    labels_train: pd.DataFrame,
    labels_test: pd.DataFrame,
    seeds: Sequence[int],
    settings: PolicySettings,
    *,
    device: str = "cpu",
    log: Log | None = None,
    progress: Progress | None = None,
) -> TrainedPolicies:
    """Train one policy per seed on latents and labels with the columns of `Labels`.

    Latents are [N, Z] float32 with the Z of `settings.width`. Train metrics are taken on a random part of the train
    split, the same for all seeds and epochs, that is no larger than the test split.
    `log(epoch, means over the seeds)` with names such as "test/acceleration_accuracy".
    Raises BadInputError for data that cannot be learnt from, TrainingDivergedError for a loss that is not finite.
    """
    started = time.perf_counter()
    _check(z_train, z_test, labels_train, labels_test, seeds, settings)
    scaling = normalisation(z_train, settings.normalise)
    data = _policy_data(scaling, (z_train, labels_train), (z_test, labels_test), torch.device(device))
    points = _Points(seeds, settings, log, progress)
    if device == "cpu":
        keep_memory()
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        ensemble = PolicyEnsemble(seeds, settings, data, points.add)
        with trainer(
            torch.device(device),
            settings.epochs,
            f"{len(seeds)} policies at batch {settings.batch}",
            "lower --policy.batch or --policy_seeds, or end what else runs there",
        ) as lightning_trainer:
            lightning_trainer.fit(ensemble, train_dataloaders=range(math.ceil(len(data.x) / settings.batch)))
        steering, logits = ensemble.outputs(data.views["test"][0])
    finally:
        torch.set_num_threads(threads)
    return TrainedPolicies(
        weights=ensemble.weights() | scaling,
        curves=pd.concat(points.epochs, ignore_index=True)[list(CURVE_COLUMNS)],
        acceleration=logits.argmax(2).to(torch.uint8).cpu().numpy(),
        steering=steering.cpu().numpy(),
        seconds=time.perf_counter() - started,
    )


def join_policies(shares: Sequence[TrainedPolicies]) -> TrainedPolicies:
    """Return policies that were trained in shares on the same data as if they had been trained at once.

    `seconds` is the sum over the shares.
    """
    curves = pd.concat([share.curves for share in shares], ignore_index=True)
    split, metric = (
        pd.Index(order).get_indexer(pd.Index(curves[name])) for name, order in (("split", SPLITS), ("metric", METRICS))
    )
    order = np.lexsort((metric, split, curves["epoch"]))  # stable: seeds stay in order
    return TrainedPolicies(
        weights={
            name: value if name.startswith("z_") else np.concatenate([share.weights[name] for share in shares])
            for name, value in shares[0].weights.items()
        },
        curves=curves.iloc[order].reset_index(drop=True),
        acceleration=np.concatenate([share.acceleration for share in shares]),
        steering=np.concatenate([share.steering for share in shares]),
        seconds=sum(share.seconds for share in shares),
    )


def _check(
    z_train: NDArray[Any],
    z_test: NDArray[Any],
    labels_train: pd.DataFrame,
    labels_test: pd.DataFrame,
    seeds: Sequence[int],
    settings: PolicySettings,
) -> None:
    if not seeds or len(set(seeds)) != len(seeds):
        raise BadInputError(f"policy seeds {list(seeds)}: at least one is needed, and each once")
    for split, z, labels in (("train", z_train, labels_train), ("test", z_test, labels_test)):
        if z.ndim != 2 or z.shape[1] != settings.width or not len(z) or z.dtype != np.float32:
            raise BadInputError(
                f"{split} latents are {z.dtype} {list(z.shape)}; float32 [frames, {settings.width}] is needed"
            )
        if not np.isfinite(z).all():
            raise BadInputError(f"{split} latents hold values that are not finite; train the encoder again")
        values = labels[["steering", "acceleration"]].to_numpy(np.float64)
        if len(values) != len(z) or not np.isfinite(values).all():
            raise BadInputError(
                f"{split} labels must be {len(z)} finite steerings and accelerations, as many as latents"
            )
        if not np.isin(values[:, 1], range(len(ACCELERATIONS))).all():
            raise BadInputError(f"{split} labels 'acceleration' must be classes 0 to {len(ACCELERATIONS) - 1}")
    if settings.batch > len(z_train):
        raise BadInputError(
            f"policy.batch is {settings.batch}, more than the {len(z_train)} policy train frames; "
            f"set --policy.batch to at most that"
        )


def _policy_data(scaling: Arrays, train: Labelled, test: Labelled, device: torch.device) -> PolicyData:
    def on_device(z: NDArray[np.float32], labels: pd.DataFrame) -> tuple[Tensor, Labels]:
        columns = {"steering": np.float32, "acceleration": np.int64, "keyframe": np.float32, "weight": np.float32}
        values = Labels(*(torch.tensor(labels[name].to_numpy(kind)).to(device) for name, kind in columns.items()))
        return torch.from_numpy(normalise(scaling, z)).to(device), values

    (x_train, y_train), view = on_device(*train), on_device(*test)
    drawn = rng(0, "policy train metrics").permutation(len(x_train))[: len(view[0])]
    part = torch.from_numpy(np.sort(drawn)).to(device)
    return PolicyData(
        x_train, y_train, {"train": (x_train[part], Labels(*(values[part] for values in y_train))), "test": view}
    )


class _Points:
    """The points of the tidy table, epoch by epoch; whoever listens is told of each."""

    def __init__(
        self, seeds: Sequence[int], settings: PolicySettings, log: Log | None, progress: Progress | None
    ) -> None:
        self.seeds, self.settings, self.log, self.progress = seeds, settings, log, progress
        self.epochs: list[pd.DataFrame] = []

    def add(self, epoch: int, values: Arrays) -> None:
        """Add an epoch: metrics [METRICS, seeds] by split. Raises TrainingDivergedError where one is not finite."""
        broken = ~np.isfinite(np.stack(list(values.values()))).all(axis=(0, 1))
        if broken.any():
            raise TrainingDivergedError(
                f"policies: the loss of seed {self.seeds[int(broken.argmax())]} is not finite after epoch {epoch}; "
                f"try a lower policy.lr than {self.settings.lr:g}"
            )
        index = pd.MultiIndex.from_product([values, METRICS, self.seeds], names=["split", "metric", "policy_seed"])
        numbers = np.concatenate([metrics.reshape(-1) for metrics in values.values()])
        rows = pd.DataFrame({"value": numbers.astype(np.float64)}, index=index).reset_index()
        self.epochs.append(rows.assign(stage="policy", epoch=epoch))
        if self.log:
            means = {
                f"{split}/{metric}": mean
                for split, metrics in values.items()
                for metric, mean in zip(METRICS, metrics.mean(axis=1).tolist(), strict=True)
            }
            self.log(epoch, means)
        if self.progress:
            self.progress(epoch, self.settings.epochs)
