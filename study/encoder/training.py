"""Train one encoder: Lightning's Trainer over batches that are slices of one uint8 array.

A killed training resumes from its checkpoint and, on a CPU, ends with the bytes of one that was never killed.
"""

from __future__ import annotations

import hashlib
import itertools
import math
import signal
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import lightning
import numpy as np
import pandas as pd
import torch

from study.compute.device import check_device, choose_precision, keep_memory
from study.compute.trainer import trainer
from study.config.heads import HEAD_SETS, HEADS
from study.config.paper import CHANNELS, IMAGE, KERNEL, STRIDE
from study.config.settings import EncoderSettings, FramesSettings
from study.data.frames import Frames
from study.encoder.autoencoder import MultiHeadAutoencoder
from study.encoder.batches import TrainingData, TrainingPlan, plan_training, resident
from study.encoder.checkpoint import DamagedCheckpointError, TrainingState, read_checkpoint, write_checkpoint
from study.encoder.inputs import Split
from study.encoder.latents import choose_samples, paint_samples
from study.errors import BadInputError, TrainingDivergedError
from study.products import Arrays
from study.stages import size_text

Log = Callable[[int, dict[str, float]], None]
Progress = Callable[[int, int], None]
CHECKPOINT_SECONDS = 60.0  # between two checkpoints of 23 MB: what a kill costs at most
PROGRESS_SECONDS = 0.25
FUSED_IMAGES = 10_000_000  # compiling takes about a minute: it must be worth it
SPARE_BYTES = 1 << 30  # of a GPU's memory, for the libraries' work space and for gaps


def step_bytes(heads: str, batch: int, precision: str) -> int:
    """Return an upper bound of the memory that a training step takes on a GPU beside the data [bytes].

    For each image: every layer's output before and after its BatchNorm and one gradient, in the type of training, and
    five times each head's pixels in float32 (target, logits, their gradient and what leads there).
    """
    sides = list(itertools.accumulate(CHANNELS, lambda side, _: (side - KERNEL) // STRIDE + 1, initial=IMAGE))[1:]
    layers = sum(channels * side**2 for channels, side in zip(CHANNELS, sides, strict=True))
    head_set = HEAD_SETS[heads].heads
    image = 3 * (2 if precision == "bf16" else 4) * layers * (1 + len(head_set))
    image += 5 * 4 * (3 + sum(HEADS[head].channels for head in head_set)) * IMAGE**2
    return batch * image + SPARE_BYTES


def check_memory(device: torch.device, heads: str, batch: int, precision: str) -> int:
    """Return the bytes of a GPU that are free for the data. Raises BadInputError when a training step cannot fit."""
    free, _ = torch.cuda.mem_get_info(device)
    need = step_bytes(heads, batch, precision)
    if need > free:
        raise BadInputError(
            f"{device} has {size_text(free)} of free memory, and batch {batch} with heads {heads} needs about "
            f"{size_text(need)}; "
            "lower --encoder.batch, or end what else runs there"
        )
    return free - need


@dataclass(frozen=True)
class TrainedEncoder:
    """A trained encoder and what its training left behind.

    `weights`: the encoder's by name, float32. `curves`: columns split, epoch, metric, value; metrics loss, loss_rec,
    loss_pred, loss_plan, loss_kl as far as they apply. `samples`: see `CellResult.samples`. `frames`: distinct training
    frames. `seconds` in training, over all processes that took part. `precision`: "fp32" or "bf16".
    """

    weights: Arrays
    curves: pd.DataFrame
    samples: Arrays
    frames: int
    seconds: float
    precision: str


def train_encoder(
    frames: Frames,
    heads: str,
    fraction: float,
    encoder_seed: int,
    settings: EncoderSettings,
    frames_settings: FramesSettings,
    *,
    device: str,
    checkpoint: Path | None,
    log: Log,
    progress: Progress | None = None,
) -> TrainedEncoder:
    """Train an encoder with a head set on a fraction of the training frames (Sec. IV-B, V-B).

    `log(epoch, losses)` is called after each epoch, counted from 1, with losses such as "test/loss_rec"; after a resume
    first for the epochs that were done before. `progress(done, total)` counts steps, a few times a second.
    `checkpoint` is the file that a killed training resumes from; it stays when the training is done. A damaged one is
    reported and not used.
    Raises BadInputError for a head set, device, batch or checkpoint that cannot be used, and TrainingDivergedError,
    naming epoch and step, for a loss that is not finite.
    """
    target = check_device(device)
    precision = choose_precision(settings.precision, target)
    plan = plan_training(frames, fraction, encoder_seed, settings, frames_settings)
    module = MultiHeadAutoencoder(heads, settings, encoder_seed)
    room = check_memory(target, heads, settings.batch, precision) if target.type == "cuda" else 0
    training = {
        "heads": heads,
        "fraction": fraction,
        "encoder_seed": encoder_seed,
        "frames": _fingerprint(frames, plan),
        "precision": precision,
        "device": target.type,
        "frames_an_epoch": plan.frames_an_epoch,
        # As in the encoder's key, a setting that makes no difference here must not refuse a checkpoint.
        "weights": {head: settings.head_weights.get(head, 1.0) for head in HEAD_SETS[heads].heads},
        **settings.model_dump(mode="json", exclude={"precision", "budget", "head_weights"}),
    }
    monitor = _Monitor(module, plan, training, checkpoint, log, progress)
    monitor.resume()
    if monitor.state.epoch < plan.epochs:
        _fit(module, monitor, frames, plan, target, precision, room)
    encoder = {name: value.numpy(force=True).copy() for name, value in module.encoder.state_dict().items()}
    return TrainedEncoder(
        weights=encoder,
        curves=pd.DataFrame(monitor.state.rows, columns=["split", "epoch", "metric", "value"]),
        samples=paint_samples(module, frames, choose_samples(frames)),
        frames=len(plan.subset),
        seconds=monitor.state.seconds,
        precision=precision,
    )


def _fit(
    module: MultiHeadAutoencoder,
    monitor: _Monitor,
    frames: Frames,
    plan: TrainingPlan,
    target: torch.device,
    precision: str,
    room: int,
) -> None:
    """Train for the epochs that are left; `room` is a GPU's memory that the training itself takes [bytes]."""
    epochs = plan.epochs - monitor.state.epoch
    if target.type == "cpu":
        keep_memory()
    elif target.type == "cuda":
        module.to(memory_format=torch.channels_last)
        if epochs * plan.frames_an_epoch >= FUSED_IMAGES:
            module.fuse()
    with trainer(
        target,
        epochs,
        f"batch {plan.batch}",
        "lower --encoder.batch",
        precision="bf16-mixed" if precision == "bf16" else "32-true",
        callbacks=[monitor],
        num_sanity_val_steps=0,
        benchmark=target.type == "cuda",  # sizes of batches hardly change: let cuDNN try which kernel is fastest
        reload_dataloaders_every_n_epochs=1,
    ) as lightning_trainer:
        lightning_trainer.fit(
            module, datamodule=TrainingData(resident(frames, target, room), plan, monitor.state, target)
        )
    monitor.save()


class _Monitor(lightning.Callback):
    """Counts steps, logs each epoch, keeps the checkpoint, and stops the training at a loss that is not finite."""

    def __init__(
        self,
        module: MultiHeadAutoencoder,
        plan: TrainingPlan,
        training: dict[str, Any],
        checkpoint: Path | None,
        log: Log,
        progress: Progress | None,
    ) -> None:
        self.module, self.plan, self.training, self.checkpoint = module, plan, training, checkpoint
        self.report, self.progress = log, progress  # `log` is taken by Lightning
        self.state = TrainingState()
        self.optimizer: torch.optim.Optimizer | None = None
        self.optimizer_state: dict[str, Any] | None = None
        self.resumed = 0  # step of this epoch that this process started from
        self.started = self.saved = self.shown = time.monotonic()
        self.sigterm = signal.getsignal(signal.SIGTERM)

    def resume(self) -> None:
        """Resume from the checkpoint, where there is one."""
        if self.checkpoint is None or not self.checkpoint.exists():
            return
        try:
            content = read_checkpoint(self.checkpoint, self.training)
        except DamagedCheckpointError as error:
            print(f"damaged checkpoint: {error}; the encoder is trained from the start", file=sys.stderr)
            return
        self.module.load_state_dict(content["network"])
        self.module.sums["train"] = content["sums"]
        self.module.noise_state = content["noise"]
        self.optimizer_state = content["optimizer"]
        rows = [(str(split), int(epoch), str(metric), float(value)) for split, epoch, metric, value in content["rows"]]
        self.state = TrainingState(content["epoch"], content["step"], content["seconds"], rows)
        self.resumed = self.state.step
        for epoch, lines in itertools.groupby(rows, key=lambda row: row[1]):
            self.report(epoch, {f"{split}/{metric}": value for split, _, metric, value in lines})

    def save(self) -> None:
        """Write the checkpoint. Raises TrainingDivergedError when a loss was not finite."""
        now = time.monotonic()
        self.state.seconds += now - self.started
        self.started = self.saved = now
        sums = self.module.sums["train"].cpu()
        if not sums.isfinite().all():
            raise self._diverged("train")
        if self.checkpoint is None:
            return
        assert self.optimizer is not None
        content = {
            "training": self.training,
            "epoch": self.state.epoch,
            "step": self.state.step,
            "seconds": self.state.seconds,
            "rows": [list(row) for row in self.state.rows],
            "network": self.module.state_dict(),
            "sums": sums,
            "optimizer": self.optimizer.state_dict(),
            "noise": None if self.module.noise is None else self.module.noise.get_state(),
        }
        write_checkpoint(self.checkpoint, content)

    def on_train_start(self, trainer: lightning.Trainer, *_: object) -> None:
        self.started = self.saved = time.monotonic()
        (self.optimizer,) = trainer.optimizers
        if self.optimizer_state is not None:
            self.optimizer.load_state_dict(self.optimizer_state)
        if threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGTERM, self.sigterm)  # Lightning would wait for the epoch's end, and exit with 0

    def on_train_batch_end(self, *_: object) -> None:
        self.state.step += 1
        now = time.monotonic()
        steps = self.plan.steps
        done, total = self.state.epoch * steps + self.state.step, self.plan.epochs * steps
        if self.progress is not None and (now - self.shown >= PROGRESS_SECONDS or done == total):
            self.progress(done, total)
            self.shown = now
        if now - self.saved >= CHECKPOINT_SECONDS and self.state.step < steps:
            self.save()

    def on_train_epoch_end(self, *_: object) -> None:
        losses = self.module.means()
        for name, value in losses.items():
            if not math.isfinite(value):
                raise self._diverged("train" if name.startswith("train") else "test")
        self.module.reset_means()
        self.state.epoch, self.state.step, self.resumed = self.state.epoch + 1, 0, 0
        for name, value in losses.items():
            split, metric = name.split("/")
            self.state.rows.append((split, self.state.epoch, metric, value))
        self.report(self.state.epoch, losses)
        if time.monotonic() - self.saved >= CHECKPOINT_SECONDS and self.state.epoch < self.plan.epochs:
            self.save()

    def _diverged(self, split: Split) -> TrainingDivergedError:
        step = self.resumed + self.module.not_finite(split) + 1
        where = f"step {step}" if split == "train" else "its test split"
        return TrainingDivergedError(
            f"the loss is not a finite number in epoch {self.state.epoch + 1}, {where}; lower --encoder.lr"
        )


def _fingerprint(frames: Frames, plan: TrainingPlan) -> str:
    digest = hashlib.sha256()
    for array in (plan.subset, plan.test, frames.images[plan.subset[:8]], frames.masks[plan.subset[:8]]):
        digest.update(np.ascontiguousarray(array).data)
    return digest.hexdigest()[:16]
