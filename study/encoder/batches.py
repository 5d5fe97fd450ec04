"""Batches of packed frames, drawn in one fixed order and prefetched."""

from __future__ import annotations

import math
import warnings
from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import lightning
import numpy as np
import torch
from torch import Tensor

from study.config.settings import EncoderSettings, FramesSettings
from study.data.frames import Frames, epoch_order
from study.encoder.checkpoint import TrainingState
from study.encoder.inputs import Bytes, Indices
from study.errors import BadInputError

PREFETCHED = 3  # batches on their way to a GPU that has no room for all data

Arrays = tuple[Bytes | Tensor, Bytes | Tensor]  # images and masks: memory-mapped, or tensors on the device


@dataclass(frozen=True)
class Batches:
    """Slices of the frame arrays on `device`: one tuple (images, masks) for each part of the order."""

    arrays: Arrays
    parts: Sequence[Indices]
    device: torch.device

    def __len__(self) -> int:
        return len(self.parts)

    def __iter__(self) -> Iterator[tuple[Tensor, Tensor]]:
        images, masks = self.arrays
        if isinstance(images, Tensor) and isinstance(masks, Tensor):
            order = torch.from_numpy(np.concatenate(self.parts)).to(self.device)
            for rows in torch.split(order, [len(part) for part in self.parts]):
                yield images[rows], masks[rows]
        elif self.device.type == "cpu":
            for part in self.parts:
                yield torch.from_numpy(images[part]), torch.from_numpy(masks[part])
        else:
            yield from prefetched(self.arrays, self.parts, self.device)


def prefetched(arrays: Arrays, parts: Sequence[Indices], device: torch.device) -> Iterator[tuple[Tensor, Tensor]]:
    """Yield images and masks of each part on a device: while one batch is computed, a thread copies the next ones.

    The copies run from pinned memory on a stream of their own, so only the device itself waits for them.
    """
    gpu = device.type == "cuda"
    stream = torch.cuda.Stream(device) if gpu else None  # type: ignore[no-untyped-call]
    images, masks = map(_as_tensor, arrays)

    def copy(source: Tensor, rows: Tensor) -> Tensor:
        gathered = torch.empty((len(rows), *source.shape[1:]), dtype=source.dtype, pin_memory=gpu)
        torch.index_select(source, 0, rows, out=gathered)
        with torch.cuda.stream(stream):
            return gathered.to(device, non_blocking=gpu)  # memory that is not pinned may be gone too early

    def fetch(part: Indices) -> tuple[tuple[Tensor, Tensor], torch.cuda.Event | None]:
        rows = torch.from_numpy(part)
        return (copy(images, rows), copy(masks, rows)), stream.record_event() if stream else None

    with ThreadPoolExecutor(1) as pool:
        ahead = deque(pool.submit(fetch, part) for part in parts[:PREFETCHED])
        for part in [*parts[PREFETCHED:], *[None] * len(ahead)]:
            batch, copied = ahead.popleft().result()
            if part is not None:
                ahead.append(pool.submit(fetch, part))
            if copied is not None:
                current = torch.cuda.current_stream(device)
                current.wait_event(copied)
                for tensor in batch:
                    tensor.record_stream(current)  # the next copy must not take its memory before it has been used
            yield batch


def _as_tensor(array: Bytes | Tensor) -> Tensor:
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="The given NumPy array is not writable")
        return torch.as_tensor(array)


@dataclass(frozen=True)
class TrainingPlan:
    """Which frames train when. An epoch is one pass over the subset.

    With the budget `steps` an epoch has as many frames as the complete training split: passes over the subset follow
    one another and are cut at that number, so that steps and points of the curve are those of fraction 1.
    Batches are as even as can be, at most `batch` frames: a last one of a few would upset BatchNorm's statistics.
    """

    subset: Indices
    test: Indices
    frames_an_epoch: int
    batch: int
    epochs: int
    seed: int

    @property
    def steps(self) -> int:
        """Return the optimiser steps of an epoch."""
        return math.ceil(self.frames_an_epoch / self.batch)

    def parts(self, epoch: int) -> list[Indices]:
        """Return the rows of each batch of an epoch, counted from 0."""
        passes = math.ceil(self.frames_an_epoch / len(self.subset))
        orders = [epoch_order(self.subset, self.seed, epoch * passes + number) for number in range(passes)]
        return np.array_split(np.concatenate(orders)[: self.frames_an_epoch], self.steps)


def plan_training(
    frames: Frames, fraction: float, encoder_seed: int, settings: EncoderSettings, frames_settings: FramesSettings
) -> TrainingPlan:
    """Return which frames train when. Raises BadInputError when the batch is larger than the data."""
    subset = frames.subset(fraction, frames_settings.unit, frames_settings.seed)
    if settings.batch > len(subset):
        raise BadInputError(
            f"batch {settings.batch} is larger than the {len(subset)} training frames at fraction {fraction:g}; "
            "lower --encoder.batch or raise --frames.encoder"
        )
    frames_an_epoch = len(frames.indices("train")) if settings.budget == "steps" else len(subset)
    return TrainingPlan(subset, frames.indices("test"), frames_an_epoch, settings.batch, settings.epochs, encoder_seed)


class TrainingData(lightning.LightningDataModule):
    """The batches of the epoch that a training is in, from its step on."""

    def __init__(self, arrays: Arrays, plan: TrainingPlan, state: TrainingState, device: torch.device) -> None:
        super().__init__()
        self.arrays, self.plan, self.state, self.device = arrays, plan, state, device

    def train_dataloader(self) -> Batches:
        """Return the batches of an epoch that are left."""
        return Batches(self.arrays, self.plan.parts(self.state.epoch)[self.state.step :], self.device)

    def val_dataloader(self) -> Batches:
        """Return the test split, in batches as large as those of training."""
        test = self.plan.test
        return Batches(self.arrays, np.array_split(test, math.ceil(len(test) / self.plan.batch)), self.device)


def resident(frames: Frames, device: torch.device, room: int) -> Arrays:
    """Return images and masks on a GPU where they fit into `room` bytes of it, else memory-mapped as they are."""
    if device.type == "cpu" or frames.images.nbytes + frames.masks.nbytes > room:
        return frames.images, frames.masks
    return _as_tensor(frames.images).to(device), _as_tensor(frames.masks).to(device)
