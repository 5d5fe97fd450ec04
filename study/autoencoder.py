"""Encoders trained with one, two or three decoder heads (Sec. III-B, IV-B), and the latents of a trained one.

The main path is `train_encoder`: Lightning's Trainer over batches that are slices of one uint8 array. Images lie in the
store as [N, 64, 64, 3], which is channels-last memory already; masks stay packed bits until they are on the device.
A killed training goes on from its checkpoint and, on a CPU, ends with the bytes of one that was never killed.
"""

from __future__ import annotations

import contextlib
import ctypes
import hashlib
import io
import itertools
import math
import os
import pickle
import signal
import sys
import tempfile
import threading
import time
import warnings
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import lightning
import numpy as np
import pandas as pd
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from study.config import (
    CHANNELS,
    CORE,
    HEAD_SETS,
    HEADS,
    IMAGE,
    KERNEL,
    LATENT,
    STRIDE,
    BadInputError,
    EncoderSettings,
    FramesSettings,
    TrainingDivergedError,
    one_of,
)
from study.fitting import trainer
from study.frames import Frames, epoch_order
from study.products import Arrays
from study.stages import size

Bytes = NDArray[np.uint8]
Indices = NDArray[np.int64]
Split = Literal["train", "test"]
Log = Callable[[int, dict[str, float]], None]
Progress = Callable[[int, int], None]

MASKS = ("pred", "plan")  # order of the store's masks
SAMPLES = 16
CHECKPOINT_SECONDS = 60.0  # between two checkpoints of 23 MB: what a kill costs at most
DIGEST = hashlib.sha256().digest_size  # bytes, before what torch writes
ZIP = b"PK"  # how a checkpoint from before there were digests begins
PROGRESS_SECONDS = 0.25
PREFETCHED = 3  # batches on their way to a GPU that has no room for all data
FUSED_STEPS = 10_000  # compiling takes about a minute: it must be worth it
SPARE_BYTES = 1 << 30  # of a GPU's memory, for the libraries' work space and for gaps
_CORE_NUMBERS = CHANNELS[-1] * CORE * CORE
_PIXELS = HEADS["rec"] * IMAGE * IMAGE


# --- networks -------------------------------------------------------------------------------------------------------


class _Convolution(nn.Conv2d):
    """A convolution before a BatchNorm, which takes its bias away again: the bias has no gradient to wait for."""

    def forward(self, input: Tensor) -> Tensor:  # noqa: A002 - torch's name
        assert self.bias is not None
        return functional.conv2d(input, self.weight, self.bias.detach(), self.stride)


class _SubPixel(torch.autograd.Function):
    """A transposed convolution, kernel 4 and stride 2, as a 2x2 convolution to four times the channels.

    Each input pixel's four outputs are computed side by side and then interleaved: on a CPU about twice as fast as
    oneDNN's own, which is slow with few output channels and with output padding. Backward, oneDNN's own is fast.
    """

    @staticmethod
    def forward(ctx: Any, images: Tensor, weight: Tensor, bias: Tensor, extra: int) -> Tensor:
        """Images [B, C, H, W], weight [C, D, 4, 4], bias [D]; [B, D, 2 H + 2 + extra, ..] channels last."""
        ctx.save_for_backward(images, weight)
        ctx.extra = extra
        channels = weight.shape[1]
        corners = weight.reshape(*weight.shape[:2], 2, 2, 2, 2).flip(2, 4)  # the kernel's halves, then odd and even
        kernels = corners.permute(3, 5, 1, 0, 2, 4).flatten(0, 2)
        blocks = functional.conv2d(images, kernels, bias.repeat(4), padding=1).permute(0, 2, 3, 1)
        rows, columns = blocks.shape[1:3]
        output = blocks.new_empty(len(images), 2 * rows + extra, 2 * columns + extra, channels)
        output[:, 2 * rows :] = bias  # out of every kernel's reach
        output[:, :, 2 * columns :] = bias
        inside = output[:, : 2 * rows, : 2 * columns].view(-1, rows, 2, columns, 2, channels)
        inside.copy_(blocks.reshape(-1, rows, columns, 2, 2, channels).permute(0, 1, 3, 2, 4, 5))
        return output.permute(0, 3, 1, 2)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        """Gradients of images and weight."""
        images, weight = ctx.saved_tensors
        two, none, one, extra, transposed = [STRIDE] * 2, [0, 0], [1, 1], [ctx.extra] * 2, True
        of_images, of_weight, _ = torch.ops.aten.convolution_backward(
            gradients[0], images, weight, None, two, none, one, transposed, extra, 1, [True, True, False]
        )
        return of_images, of_weight, None, None


def _transposed(layer: nn.ConvTranspose2d, images: Tensor, bias: Tensor) -> Tensor:
    """A layer's output with another bias in its place, which gets no gradient."""
    extra = layer.output_padding[0]
    if images.device.type == "cpu":
        # Autocast does not look into the function: the layer computes in the type that it is given.
        output: Tensor = _SubPixel.apply(  # type: ignore[no-untyped-call]
            images, layer.weight.to(images.dtype), bias.to(images.dtype), extra
        )
        return output
    return functional.conv_transpose2d(images, layer.weight, bias, STRIDE, output_padding=extra)


class _TransposedConvolution(nn.ConvTranspose2d):
    """The same, transposed. Here the bias' gradient, zero but for rounding, took half of the backward time on a CPU."""

    def forward(self, input: Tensor, output_size: list[int] | None = None) -> Tensor:  # noqa: A002, ARG002
        assert self.bias is not None
        return _transposed(self, input, self.bias.detach())


class Encoder(nn.Module):
    """Images to z: three convolutions and a fully connected layer (Sec. IV-B).

    Input [B, 3, 64, 64] float in [0, 1], output z [B, 64]. With `variational`, one more layer gives log variances.
    """

    def __init__(self, variational: bool = False) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        for before, after in itertools.pairwise((HEADS["rec"], *CHANNELS)):
            layers += [_Convolution(before, after, KERNEL, STRIDE), nn.BatchNorm2d(after), nn.ReLU(inplace=True)]
        self.convolutions = nn.Sequential(*layers)
        self.mean = nn.Linear(_CORE_NUMBERS, LATENT)
        self.log_variance = nn.Linear(_CORE_NUMBERS, LATENT) if variational else None

    def features(self, images: Tensor) -> Tensor:
        """What the fully connected layers see: [B, 4608], pixel by pixel, as channels-last memory has it."""
        features: Tensor = self.convolutions(images)
        return features.permute(0, 2, 3, 1).flatten(1)

    def forward(self, images: Tensor) -> Tensor:
        """The latent; its mean when variational."""
        z: Tensor = self.mean(self.features(images))
        return z


class Decoder(nn.Module):
    """z [B, 64] to the logits [B, channels, 64, 64] of one head, in float32: the encoder backwards (Sec. IV-B)."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.fully_connected = nn.Sequential(
            nn.Linear(LATENT, _CORE_NUMBERS), nn.BatchNorm1d(_CORE_NUMBERS), nn.ReLU(inplace=True)
        )
        layers: list[nn.Module] = []
        # 6 -> 14 -> 31 -> 64 without padding: the middle layer needs one row and column more (PAPER.md 2.2)
        for (before, after), extra in zip(itertools.pairwise(CHANNELS[::-1]), (0, 1), strict=True):
            layers += [
                _TransposedConvolution(before, after, KERNEL, STRIDE, output_padding=extra),
                nn.BatchNorm2d(after),
                nn.ReLU(inplace=True),
            ]
        self.convolutions = nn.Sequential(*layers)
        self.output = nn.ConvTranspose2d(CHANNELS[0], channels, KERNEL, STRIDE)

    def forward(self, z: Tensor) -> Tensor:
        """Logits; a sigmoid makes them the paper's output."""
        core = self.fully_connected(z).view(-1, CORE, CORE, CHANNELS[-1]).permute(0, 3, 1, 2)
        # The bias is added in float32, where its gradient is exact, and faster than inside the convolution.
        assert self.output.bias is not None
        logits = _transposed(self.output, self.convolutions(core), torch.zeros_like(self.output.bias))
        return logits.float() + self.output.bias.view(-1, 1, 1)


def initialise(network: nn.Module, generator: torch.Generator) -> None:
    """Draw every layer's weights and biases as torch does by default, U(-1/sqrt(fan in), 1/sqrt(fan in))."""
    with torch.no_grad():
        for layer in network.modules():
            if isinstance(layer, nn.Linear | nn.Conv2d | nn.ConvTranspose2d):
                bound = 1 / math.sqrt(layer.weight[0].numel())
                layer.weight.uniform_(-bound, bound, generator=generator)
                if layer.bias is not None:
                    layer.bias.uniform_(-bound, bound, generator=generator)


def _generator(seed: int, purpose: str, device: torch.device | str = "cpu") -> torch.Generator:
    digest = hashlib.sha256(f"{seed}/{purpose}".encode()).digest()
    return torch.Generator(device).manual_seed(int.from_bytes(digest[:7], "big"))


class MultiHeadAutoencoder(lightning.LightningModule):
    """An encoder and the decoder heads of a head set, with the loss that trains them (Sec. III-B).

    The loss is the weighted sum over heads of the binary cross-entropy on logits, mean over a head's pixels. With
    `beta` > 0 comes beta times the Kullback-Leibler divergence of z from N(0, 1), divided by the image's 12,288
    numbers, so that beta = 1 is the evidence lower bound of `rec`. Losses are averaged over each epoch and split in
    `means`, on the device: Lightning's own logging would wait for the device at every step.
    Raises BadInputError for an unknown head set.
    """

    def __init__(self, heads: str, settings: EncoderSettings, encoder_seed: int) -> None:
        super().__init__()
        if heads not in HEAD_SETS:
            raise one_of("head set", heads, HEAD_SETS)
        self.settings, self.beta = settings, settings.beta
        self.head_weights = {head: settings.head_weights.get(head, 1.0) for head in HEAD_SETS[heads]}
        self.automatic_optimization = False  # gradients come head by head, see `losses`
        self.encoder = Encoder(variational=settings.beta > 0)
        self.decoders = nn.ModuleDict({head: Decoder(HEADS[head]) for head in HEAD_SETS[heads]})
        initialise(self.encoder, _generator(encoder_seed, "encoder"))
        for head, decoder in self.decoders.items():
            initialise(decoder, _generator(encoder_seed, f"decoder {head}"))
        self.metrics = ("loss", *(f"loss_{head}" for head in self.decoders), *(["loss_kl"] if settings.beta else []))
        self.noise_seed = encoder_seed
        self.noise: torch.Generator | None = None
        self.noise_state: Tensor | None = None  # to start from, when a training goes on
        self._fused: _Fused | None = None
        self.reset_means()

    def forward(self, images: Tensor) -> dict[str, Tensor]:
        """Logits of each head for images [B, 3, 64, 64] float in [0, 1]."""
        z = self.encoder(images)
        return {head: decoder(z) for head, decoder in self.decoders.items()}

    def losses(self, images: Tensor, masks: Tensor, noise: Tensor | None = None, *, by_head: bool = False) -> Tensor:
        """The losses named in `metrics`, of images [B, 64, 64, 3] uint8 and masks [B, 2, 512] uint8.

        `noise` [B, 64] float32 moves z within its variance, when variational. The losses carry gradients. With
        `by_head` they carry none: those of the total loss are added to the parameters' on the way, one head after the
        other, so that memory for the activations of one head suffices.
        """
        pixels = to_float(images)
        targets = {"rec": pixels} | unpack(masks, [head for head in self.decoders if head in MASKS])
        features = self.encoder.features(pixels)
        z = self.encoder.mean(features)
        ends: list[tuple[Tensor, Tensor | None]] = []  # of the encoder's graph, with the gradient that comes in there
        divergence = []
        if self.encoder.log_variance is not None:
            mean, log_variance = z.float(), self.encoder.log_variance(features).float()
            kl = (mean.square() + log_variance.exp() - 1 - log_variance).sum(1).mean() / (2 * _PIXELS)
            divergence.append(kl.detach() if by_head else kl)
            ends.append((self.beta * kl, None))
            if noise is not None:  # on the test split the mean stands for z, as for the policies
                z = mean + torch.exp(log_variance / 2) * noise
        given = z.detach().requires_grad_() if by_head else z
        parts = []
        weights = [self.head_weights[head] for head in self.decoders]
        for weight, (head, decoder) in zip(weights, self.decoders.items(), strict=True):
            loss = functional.binary_cross_entropy_with_logits(decoder(given), targets[head])
            if by_head:
                torch.autograd.backward(weight * loss)
            parts.append(loss.detach() if by_head else loss)
        if by_head:
            outputs, incoming = zip(*ends, (z, given.grad), strict=True)
            torch.autograd.backward(outputs, incoming)
        weights += [self.beta] * len(divergence)
        parts += divergence
        return torch.stack([sum(w * part for w, part in zip(weights, parts, strict=True)), *parts])  # type: ignore[list-item]

    def _noise(self, count: int) -> Tensor | None:
        if not self.beta:
            return None
        if self.noise is None:
            self.noise = _generator(self.noise_seed, "noise", self.device)
            if self.noise_state is not None:
                self.noise.set_state(self.noise_state)
        return torch.randn((count, LATENT), generator=self.noise, device=self.device)

    def training_step(self, batch: tuple[Tensor, Tensor]) -> None:
        """One step of the optimiser."""
        optimizer = self.optimizers(use_pl_optimizer=False)
        assert isinstance(optimizer, torch.optim.Optimizer)
        optimizer.zero_grad()
        self._note("train", self.gradients(*batch, self._noise(len(batch[0]))), len(batch[0]))
        optimizer.step()

    def validation_step(self, batch: tuple[Tensor, Tensor]) -> None:
        """Losses of a batch of the test split."""
        losses = self._fused(*batch, None) if self._fused else None
        self._note("test", self.losses(*batch) if losses is None else losses, len(batch[0]))

    def gradients(self, images: Tensor, masks: Tensor, noise: Tensor | None) -> Tensor:
        """The losses of a batch, as `losses` has them; adds the gradients of their total to the parameters'."""
        losses = self._fused(images, masks, noise) if self._fused else None
        return self.losses(images, masks, noise, by_head=True) if losses is None else losses

    def fuse(self) -> None:
        """From now on take losses and gradients by torch.compile, where that works."""
        self._fused = _Fused(self)

    def configure_optimizers(self) -> torch.optim.Optimizer:
        """Adam (Sec. IV-B)."""
        return torch.optim.Adam(self.parameters(), lr=self.settings.lr, fused=True)

    def _note(self, split: Split, losses: Tensor, count: int) -> None:
        weighted = torch.cat([losses, losses.new_ones(1)]).double() * count
        self.sums[split] = self.sums[split].to(losses.device, non_blocking=True) + weighted
        self.totals[split].append(losses[0])

    def reset_means(self) -> None:
        """Forget the losses seen."""
        self.sums = {name: torch.zeros(len(self.metrics) + 1, dtype=torch.float64) for name in ("train", "test")}
        self.totals: dict[str, list[Tensor]] = {"train": [], "test": []}

    def means(self) -> dict[str, float]:
        """Mean of each loss over the frames seen since the last reset, e.g. "train/loss_rec"; waits for the device."""
        found: dict[str, float] = {}
        rows = torch.stack([sums.to(self.device) for sums in self.sums.values()]).tolist()
        for split, (*values, count) in zip(self.sums, rows, strict=True):
            found |= {f"{split}/{name}": value / count for name, value in zip(self.metrics, values, strict=True)}
        return found

    def not_finite(self, split: Split) -> int:
        """Position since the last reset of the first batch whose loss was not a finite number; there is one."""
        return int(torch.stack(self.totals[split]).isfinite().int().argmin())


class _Fused:
    """An autoencoder's losses and their gradients by torch.compile: one graph for each size of batch and each split.

    A call gives the losses, and in training adds the gradients; or None where it cannot compile, which it says once.
    """

    def __init__(self, module: MultiHeadAutoencoder) -> None:
        torch.compiler.reset()  # graphs of an encoder trained before would count against the limit
        self.module = module
        self.function: Callable[..., Tensor] | None = torch.compile(module.losses, dynamic=False, fullgraph=True)
        self.compiled: set[tuple[int, bool]] = set()  # sizes, each in training or not

    def __call__(self, *batch: Tensor | None) -> Tensor | None:
        kind = len(batch[0]), self.module.training  # type: ignore[arg-type]
        if self.function is None or kind in self.compiled:
            return self._compute(*batch)
        before = [buffer.clone() for buffer in self.module.buffers()]
        try:
            losses = self._compute(*batch)
        except torch.OutOfMemoryError:
            raise
        except Exception as error:  # noqa: BLE001 - of any kind; what else may be wrong shows without it
            warnings.warn(
                f"torch.compile failed ({type(error).__name__}: {str(error).strip().splitlines()[0]}); the encoder "
                "trains without it, more slowly (TORCH_COMPILE_DISABLE=1 leaves it out)",
                RuntimeWarning,
                stacklevel=2,
            )
            self.function = None
            self.module.zero_grad()
            for buffer, value in zip(self.module.buffers(), before, strict=True):
                buffer.copy_(value)
            return None
        self.compiled.add(kind)
        return losses

    def _compute(self, *batch: Tensor | None) -> Tensor | None:
        if self.function is None:
            return None
        losses = self.function(*batch)
        if self.module.training:
            torch.autograd.backward(losses[0])
        return losses.detach()


def to_float(images: Tensor) -> Tensor:
    """Images [B, 64, 64, 3] uint8 as [B, 3, 64, 64] float32 in [0, 1], channels last in memory."""
    return images.permute(0, 3, 1, 2).float().div_(255)


def unpack(masks: Tensor, heads: Sequence[str]) -> dict[str, Tensor]:
    """Packed masks [B, 2, 512] uint8 as one [B, 1, 64, 64] float32 of 0 and 1 for each head; first bit highest."""
    shifts = torch.arange(7, -1, -1, dtype=torch.uint8, device=masks.device)
    unpacked = {}
    for head in heads:
        bits = (masks[:, MASKS.index(head), :, None] >> shifts) & 1
        unpacked[head] = bits.view(-1, 1, IMAGE, IMAGE).float()
    return unpacked


# --- batches --------------------------------------------------------------------------------------------------------


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
class _Plan:
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
) -> _Plan:
    """Which frames train when. Raises BadInputError when the batch is larger than the data."""
    subset = frames.subset(fraction, frames_settings.unit, frames_settings.seed)
    if settings.batch > len(subset):
        raise BadInputError(
            f"batch {settings.batch} is larger than the {len(subset)} training frames at fraction {fraction:g}; "
            "lower --encoder.batch or raise --frames.encoder"
        )
    whole = len(frames.indices("train")) if settings.budget == "steps" else len(subset)
    return _Plan(subset, frames.indices("test"), whole, settings.batch, settings.epochs, encoder_seed)


# --- devices --------------------------------------------------------------------------------------------------------


def check_device(name: str) -> torch.device:
    """The torch device of that name. Raises BadInputError when this machine lacks it."""
    try:
        device = torch.device(name)
    except RuntimeError as error:
        raise one_of("device", name, ("cpu", "cuda", "cuda:0", "...")) from error
    if device.type == "cpu":
        return torch.device("cpu")
    count = torch.cuda.device_count()
    if device.type != "cuda" or (device.index or 0) >= count:
        names = ["cpu", *(f"cuda:{index}" for index in range(count))]
        raise BadInputError(f"device '{name}' is not on this machine; choose from {', '.join(names)}")
    return torch.device("cuda", device.index or 0)


def choose_precision(setting: Literal["auto", "fp32", "bf16"], device: torch.device) -> Literal["fp32", "bf16"]:
    """The precision of the networks in training; "auto" is bf16 where the hardware multiplies bf16 matrices itself."""
    if setting != "auto":
        return setting
    if device.type == "cuda":
        native = torch.cuda.get_device_capability(device) >= (8, 0)
    else:
        native = "amx_bf16" in _cpu_flags() or "avx512_bf16" in _cpu_flags()
    return "bf16" if native else "fp32"


def step_bytes(heads: str, batch: int, precision: str) -> int:
    """Memory that a training step takes on a GPU beside the data; from above [bytes].

    For each image: every layer's output before and after its BatchNorm and one gradient, in the type of training, and
    five times each head's pixels in float32 (target, logits, their gradient and what leads there).
    """
    sides = list(itertools.accumulate(CHANNELS, lambda side, _: (side - KERNEL) // STRIDE + 1, initial=IMAGE))[1:]
    layers = sum(channels * side**2 for channels, side in zip(CHANNELS, sides, strict=True))
    colours = sum(HEADS[head] for head in HEAD_SETS[heads])
    image = 3 * (2 if precision == "bf16" else 4) * layers * (1 + len(HEAD_SETS[heads]))
    image += 5 * 4 * (HEADS["rec"] + colours) * IMAGE**2
    return batch * image + SPARE_BYTES


def check_memory(device: torch.device, heads: str, batch: int, precision: str) -> int:
    """Bytes of a device's memory that are free for the data. Raises BadInputError when a training step cannot fit."""
    free, _ = torch.cuda.mem_get_info(device)
    need = step_bytes(heads, batch, precision)
    if need > free:
        raise BadInputError(
            f"{device} has {size(free)} of free memory, and batch {batch} with heads {heads} needs about {size(need)}; "
            "lower --encoder.batch, or end what else runs there"
        )
    return free - need


def _cpu_flags() -> set[str]:
    with contextlib.suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text(encoding="ascii", errors="ignore").splitlines():
            if line.startswith("flags"):
                return set(line.split())
    return set()


# --- checkpoints ----------------------------------------------------------------------------------------------------


@dataclass
class _State:
    """How far a training has come: whole epochs, steps of the next, seconds spent, and the curves so far."""

    epoch: int = 0
    step: int = 0
    seconds: float = 0.0
    rows: list[tuple[str, int, str, float]] = field(default_factory=list)


class _DamagedError(Exception):
    """A checkpoint that was changed or cut off on disk."""


def _write_checkpoint(path: Path, content: dict[str, Any]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    # In memory first: torch makes errors of its own of a full disk's, and keeps no digest of what it writes.
    stream = io.BytesIO()
    torch.save(content, stream)
    with tempfile.NamedTemporaryFile(dir=path.parent, prefix=f".{path.name}.", delete=False) as draft:
        try:
            draft.write(hashlib.sha256(stream.getbuffer()).digest())
            draft.write(stream.getbuffer())
            draft.flush()
            os.fsync(draft.fileno())
            Path(draft.name).replace(path)
        except BaseException:
            Path(draft.name).unlink(missing_ok=True)
            raise


def _read_checkpoint(path: Path, training: dict[str, Any]) -> dict[str, Any]:
    """What `_write_checkpoint` wrote. Raises _DamagedError, and BadInputError when it is of another training."""
    raw = path.read_bytes()
    if not raw.startswith(ZIP):
        digest, raw = raw[:DIGEST], raw[DIGEST:]
        if hashlib.sha256(raw).digest() != digest:
            raise _DamagedError(f"{path} does not match its digest")
    try:
        content: dict[str, Any] = torch.load(io.BytesIO(raw), map_location="cpu", weights_only=True)
        other = content["training"]
    except (OSError, RuntimeError, EOFError, KeyError, TypeError, ValueError, pickle.UnpicklingError) as error:
        raise _DamagedError(f"{path} is no checkpoint of an encoder ({error})") from error
    for name in sorted(training | other):
        if training.get(name) != other.get(name):
            raise BadInputError(
                f"checkpoint {path} is of another configuration: {name} is {other.get(name)!r} there and "
                f"{training.get(name)!r} here; delete it to train anew, or name another file"
            )
    return content


# --- training -------------------------------------------------------------------------------------------------------


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
    first for the epochs that were done before. `progress(steps done, steps in all)` comes a few times a second.
    `checkpoint` is the file that a killed training goes on from; it stays when the training is done. One that was
    damaged on disk is told and not used.
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
        "weights": {head: settings.head_weights.get(head, 1.0) for head in HEAD_SETS[heads]},
        **settings.model_dump(mode="json", exclude={"precision", "budget", "head_weights"}),
    }
    course = _Course(module, plan, training, checkpoint, log, progress)
    course.resume()
    if course.state.epoch < plan.epochs:
        _fit(module, _Data(frames, plan, course.state, target, room), course, target, precision)
        course.save()
    encoder = {name: value.numpy(force=True).copy() for name, value in module.encoder.state_dict().items()}
    return TrainedEncoder(
        weights=encoder,
        curves=pd.DataFrame(course.state.rows, columns=["split", "epoch", "metric", "value"]),
        samples=paint_samples(module, frames, choose_samples(frames)),
        frames=len(plan.subset),
        seconds=course.state.seconds,
        precision=precision,
    )


class _Data(lightning.LightningDataModule):
    """The batches of the epoch that a training is in, from its step on."""

    def __init__(self, frames: Frames, plan: _Plan, state: _State, device: torch.device, room: int) -> None:
        super().__init__()
        self.plan, self.state, self.device = plan, state, device
        self.images, self.masks = resident(frames, device, room)

    def train_dataloader(self) -> _Batches:
        return self._batches(self.plan.parts(self.state.epoch)[self.state.step :])

    def val_dataloader(self) -> _Batches:
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


class _Course(lightning.Callback):
    """Follows a training: counts, logs each epoch, keeps the checkpoint, and stops at a loss that is not finite."""

    def __init__(
        self,
        module: MultiHeadAutoencoder,
        plan: _Plan,
        training: dict[str, Any],
        checkpoint: Path | None,
        log: Log,
        progress: Progress | None,
    ) -> None:
        self.module, self.plan, self.training, self.checkpoint = module, plan, training, checkpoint
        self.report, self.progress = log, progress  # `log` is taken by Lightning
        self.state = _State()
        self.optimizer: torch.optim.Optimizer | None = None
        self.optimizer_state: dict[str, Any] | None = None
        self.resumed = 0  # step of this epoch that this process started from
        self.started = self.saved = self.shown = time.monotonic()
        self.sigterm = signal.getsignal(signal.SIGTERM)

    def resume(self) -> None:
        """Take up the checkpoint, when there is one."""
        if self.checkpoint is None or not self.checkpoint.exists():
            return
        try:
            content = _read_checkpoint(self.checkpoint, self.training)
        except _DamagedError as error:
            print(f"damaged checkpoint: {error}; the encoder is trained anew", file=sys.stderr)
            return
        self.module.load_state_dict(content["network"])
        self.module.sums["train"] = content["sums"]
        self.module.noise_state = content["noise"]
        self.optimizer_state = content["optimizer"]
        rows = [(str(split), int(epoch), str(metric), float(value)) for split, epoch, metric, value in content["rows"]]
        self.state = _State(content["epoch"], content["step"], content["seconds"], rows)
        self.resumed = self.state.step
        for epoch, lines in itertools.groupby(rows, key=lambda row: row[1]):
            self.report(epoch, {f"{split}/{metric}": value for split, _, metric, value in lines})

    def save(self) -> None:
        """Write the checkpoint, unless a loss was not finite: then there is nothing worth going on from."""
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
        _write_checkpoint(self.checkpoint, content)

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


def _fit(module: MultiHeadAutoencoder, data: _Data, course: _Course, device: torch.device, precision: str) -> None:
    if device.type == "cpu":
        _keep_memory()
    else:
        module.to(memory_format=torch.channels_last)
        if (data.plan.epochs - data.state.epoch) * data.plan.steps >= FUSED_STEPS:
            module.fuse()
    with trainer(
        device,
        data.plan.epochs - data.state.epoch,
        f"batch {data.plan.batch}",
        "lower --encoder.batch",
        precision="bf16-mixed" if precision == "bf16" else "32-true",
        callbacks=[course],
        num_sanity_val_steps=0,
        benchmark=device.type == "cuda",  # sizes of batches hardly change: let cuDNN try which kernel is fastest
        reload_dataloaders_every_n_epochs=1,
    ) as lightning_trainer:
        lightning_trainer.fit(module, datamodule=data)


def _keep_memory() -> None:
    """Let glibc keep freed blocks, for giving each one back costs a third of the speed at batch 2048 (page faults).

    Blocks above 150 MB still go back: kept, they would leave gaps, and the paper's batch would need 5 GB instead of 4.
    """
    with contextlib.suppress(OSError, AttributeError):
        libc = ctypes.CDLL(None)
        mmap_threshold, trim_threshold = -3, -1  # names in malloc.h
        libc.mallopt(mmap_threshold, 150_000_000)
        libc.mallopt(trim_threshold, 2**31 - 1)


def _fingerprint(frames: Frames, plan: _Plan) -> str:
    digest = hashlib.sha256()
    for array in (plan.subset, plan.test, frames.images[plan.subset[:8]], frames.masks[plan.subset[:8]]):
        digest.update(np.ascontiguousarray(array).data)
    return digest.hexdigest()[:16]


# --- what is kept of a trained encoder ------------------------------------------------------------------------------


def choose_samples(frames: Frames) -> Indices:
    """Rows of up to 16 test frames to show, the same for every encoder: those with most to see, drive by drive.

    A frame's content is the mean of two ranks among the test frames: set pixels in its pred and in its plan mask.
    """
    test = frames.indices("test")
    pixels = np.bitwise_count(frames.masks[test]).sum(axis=2, dtype=np.int64)
    content = pd.DataFrame(pixels).rank().sum(axis=1)
    table = pd.DataFrame({"row": test, "drive": frames.labels["episode"].to_numpy()[test], "content": content})
    table = table.sort_values(["content", "row"], ascending=[False, True])
    table["turn"] = table.groupby("drive").cumcount()
    chosen = table.sort_values("turn", kind="stable")["row"].head(SAMPLES)
    return np.sort(chosen.to_numpy(np.int64))


def paint_samples(module: MultiHeadAutoencoder, frames: Frames, rows: Indices) -> Arrays:
    """Inputs, each head's outputs and targets of some frames, uint8, as `CellResult.samples` documents."""
    images, masks = torch.from_numpy(frames.images[rows]), torch.from_numpy(frames.masks[rows])
    module.eval()
    with torch.inference_mode():
        outputs = {head: logits.sigmoid() for head, logits in module(to_float(images)).items()}
    samples = {"input": images.numpy()}
    for head, output in outputs.items():
        painted = output.mul(255).round().to(torch.uint8).permute(0, 2, 3, 1)
        samples[f"{head}_output"] = painted.squeeze(-1).contiguous().numpy()
    for head, target in unpack(masks, [head for head in outputs if head in MASKS]).items():
        samples[f"{head}_target"] = target.mul(255).to(torch.uint8).squeeze(1).numpy()
    return samples


def encoder_of(weights: Mapping[str, NDArray[Any]]) -> Encoder:
    """The trained network of those weights. Raises BadInputError when they are not an Encoder's."""
    encoder = Encoder(variational="log_variance.weight" in weights)
    try:
        encoder.load_state_dict({name: torch.from_numpy(np.array(value)) for name, value in weights.items()})
    except (RuntimeError, TypeError) as error:
        raise BadInputError(f"these are not the weights of an encoder: {error}") from error
    return encoder.eval()


def encode(
    weights: Mapping[str, NDArray[Any]], images: Bytes, indices: Indices, *, device: str = "cpu", batch: int = 256
) -> NDArray[np.float32]:
    """Latents z [N, 64] float32 of some rows of `images` [.., 64, 64, 3] uint8; the mean when variational.

    Always computed in float32, so that z depends on the precision of training only through the weights.
    Raises BadInputError when the weights are not an Encoder's, or the device is not there.
    """
    target = check_device(device)
    encoder = encoder_of(weights).to(target)
    z = np.empty((len(indices), LATENT), np.float32)
    with torch.inference_mode():
        for start in range(0, len(indices), batch):
            part = torch.from_numpy(images[indices[start : start + batch]]).to(target)
            z[start : start + batch] = encoder(to_float(part)).float().numpy(force=True)
    return z
