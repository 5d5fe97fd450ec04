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
FUSED_STEPS = 10_000  # compiling takes about a minute: it must be worth it


@dataclass(frozen=True)
class _Batches:
    """Slices of the frame arrays on `device`, one tuple (images, masks) for each part of the order.

    The arrays are tensors there, or memory-mapped. From these, batches for a GPU are gathered and copied ahead.
    """

    images: Bytes | Tensor
    masks: Bytes | Tensor
    parts: Sequence[Indices]
    device: torch.device

    def __len__(self) -> int:
        return len(self.parts)

    def __iter__(self) -> Iterator[tuple[Tensor, Tensor]]:
        if isinstance(self.images, Tensor) and isinstance(self.masks, Tensor):
            order = torch.from_numpy(np.concatenate(self.parts)).to(self.device)
            for rows in torch.split(order, [len(part) for part in self.parts]):
                yield self.images[rows], self.masks[rows]
        elif self.device.type == "cpu":
            for part in self.parts:
                yield torch.from_numpy(self.images[part]), torch.from_numpy(self.masks[part])
        else:
            yield from prefetched(self.images, self.masks, self.parts, self.device)


def prefetched(
    images: Bytes | Tensor, masks: Bytes | Tensor, parts: Sequence[Indices], device: torch.device
) -> Iterator[tuple[Tensor, Tensor]]:
    """Images and masks of each part on a device: while one batch is computed, a thread gathers and copies the next.

    The copies run from pinned memory on a stream of their own, so nobody waits for them but the device itself.
    """
    gpu = device.type == "cuda"
    side = torch.cuda.Stream(device) if gpu else None  # type: ignore[no-untyped-call]
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="The given NumPy array is not writable")
        sources = torch.as_tensor(images), torch.as_tensor(masks)

    def copy(source: Tensor, rows: Tensor) -> Tensor:
        gathered = torch.empty((len(rows), *source.shape[1:]), dtype=source.dtype, pin_memory=gpu)
        torch.index_select(source, 0, rows, out=gathered)
        with torch.cuda.stream(side):
            return gathered.to(device, non_blocking=True)

    def fetch(part: Indices) -> tuple[tuple[Tensor, Tensor], torch.cuda.Event | None]:
        rows = torch.from_numpy(part)
        batch = copy(sources[0], rows), copy(sources[1], rows)
        return batch, side.record_event() if side else None

    with ThreadPoolExecutor(1) as pool:
        ahead = deque(pool.submit(fetch, part) for part in parts[:PREFETCHED])
        for part in [*parts[PREFETCHED:], *[None] * len(ahead)]:
            batch, copied = ahead.popleft().result()
            if part is not None:
                ahead.append(pool.submit(fetch, part))
            if copied is not None:
                now = torch.cuda.current_stream(device)
                now.wait_event(copied)
                for tensor in batch:
                    tensor.record_stream(now)  # its memory is not given to the next copy before it has been used
            yield batch


@dataclass(frozen=True)
class TrainingPlan:
    """Which frames train when. An epoch is one pass over the subset.

    With the budget `steps` it is instead as many frames as one pass over the whole training split: the passes over
    the subset follow one another and are cut at that number, so steps and points of the curve are those of fraction 1.
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
        """Optimiser steps an epoch."""
        return math.ceil(self.frames_an_epoch / self.batch)

    def parts(self, epoch: int) -> list[Indices]:
        """Rows of each batch of an epoch, counted from 0."""
        passes = math.ceil(self.frames_an_epoch / len(self.subset))
        orders = [epoch_order(self.subset, self.seed, epoch * passes + number) for number in range(passes)]
        return np.array_split(np.concatenate(orders)[: self.frames_an_epoch], self.steps)


def plan_training(
    frames: Frames, fraction: float, encoder_seed: int, settings: EncoderSettings, frames_settings: FramesSettings
) -> TrainingPlan:
    """Which frames train when. Raises BadInputError when the batch is larger than the data."""
    subset = frames.subset(fraction, frames_settings.unit, frames_settings.seed)
    if settings.batch > len(subset):
        raise BadInputError(
            f"batch {settings.batch} is larger than the {len(subset)} training frames at fraction {fraction:g}; "
            "lower --encoder.batch or raise --frames.encoder"
        )
    whole = len(frames.indices("train")) if settings.budget == "steps" else len(subset)
    return TrainingPlan(subset, frames.indices("test"), whole, settings.batch, settings.epochs, encoder_seed)


class TrainingData(lightning.LightningDataModule):
    """The batches of the epoch that a training is in, from its step on."""

    def __init__(
        self, frames: Frames, plan: TrainingPlan, state: TrainingState, device: torch.device, room: int
    ) -> None:
        super().__init__()
        self.plan, self.state, self.device = plan, state, device
        self.images, self.masks = resident(frames, device, room)

    def train_dataloader(self) -> _Batches:
        """Return the batches of an epoch that are left."""
        return self._batches(self.plan.parts(self.state.epoch)[self.state.step :])

    def val_dataloader(self) -> _Batches:
        """Return the test split, in batches as large as those of training."""
        test = self.plan.test
        return self._batches(np.array_split(test, math.ceil(len(test) / self.plan.batch)))

    def _batches(self, parts: Sequence[Indices]) -> _Batches:
        return _Batches(self.images, self.masks, parts, self.device)


def resident(frames: Frames, device: torch.device, room: int) -> tuple[Bytes | Tensor, Bytes | Tensor]:
    """Images and masks on a GPU where they fit into `room` bytes of it, else as they are: memory-mapped."""
    if device.type == "cpu" or frames.images.nbytes + frames.masks.nbytes > room:
        return frames.images, frames.masks
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="The given NumPy array is not writable")
        return torch.from_numpy(frames.images).to(device), torch.from_numpy(frames.masks).to(device)
