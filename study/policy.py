"""Policies on a frozen latent (Sec. III-B.3, IV-C): all seeds at once, as one stack of tensors.

Two small networks with no weight in common learn from z: one gives the steering, one the logits of the three
accelerations. The seeds never touch each other: the loss is their sum and Adam works number by number, so each seed
becomes what it would have become alone, whichever seeds are trained beside it and wherever: shares of the seeds can be
trained by different processes, and `join_policies` puts them together. A unit of work is one network on a group of
seeds. On a CPU a group is one seed, whose step fits into one core's cache, computed on one thread: threads inside an
operation would wait for each other forty times a step. On a GPU all seeds are one group.

Suffixes: S seeds, G seeds of a group, B rows of a batch, N frames, H hidden units, O outputs, Z = 64 latent numbers.
"""

from __future__ import annotations

import functools
import itertools
import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, NamedTuple

import lightning
import numpy as np
import pandas as pd
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from study.config import (
    ACCELERATION_HIDDEN,
    ACCELERATIONS,
    DROPOUT,
    LATENT,
    STEERING_HIDDEN,
    BadInputError,
    PolicySettings,
    TrainingDivergedError,
)
from study.fitting import trainer
from study.result import CURVE_COLUMNS

Log = Callable[[int, dict[str, float]], None]
Progress = Callable[[int, int], None]
Arrays = dict[str, NDArray[Any]]
AfterEpoch = Callable[[int, Arrays], None]
Labelled = tuple[NDArray[np.float32], pd.DataFrame]  # latents [N, 64] and their labels

WIDTHS = {
    "steering": (LATENT, *STEERING_HIDDEN, 1),
    "acceleration": (LATENT, *ACCELERATION_HIDDEN, len(ACCELERATIONS)),
}
METRICS = ("steering_loss", "acceleration_accuracy", "balanced_accuracy", "cross_entropy")
SPLITS = ("train", "test")
_ORDER = {"split": SPLITS, "metric": METRICS}  # of the rows of an epoch's curves

_INIT, _EPOCH, _SUBSET = range(3)  # purposes of random numbers
_WORD = 32  # random bits in an int32
_TWO = 30  # the one bit that makes an int32 the float32 2.0
_VECTOR = 16  # float32 in the widest register
_DROPPED = -1e30  # takes a unit below zero, where the ReLU ends it
_KEPT = 1 / (1 - DROPOUT)
_ROWS = 2048  # evaluated at once: their hidden units fit into a core's cache

assert DROPOUT == 0.5, "masks are made of random bits"


@dataclass(frozen=True)
class TrainedPolicies:
    """S trained policies and how they came about; N test frames.

    `weights`: "<network>_<layer>_weight" [S, in, out] and "..._bias" [S, out] float32 for networks "steering" and
    "acceleration", layers 0 to 2; "z_mean", "z_std" [64]; "z_l2" [1] uint8: 1 where z is scaled to unit length.
    `curves`: one row per measured point, columns CURVE_COLUMNS, of the policies without dropout after each epoch.
    `acceleration` [S, N] uint8 class and `steering` [S, N] float32: on the test frames after the last epoch.
    """

    weights: Arrays
    curves: pd.DataFrame
    acceleration: NDArray[np.uint8]
    steering: NDArray[np.float32]
    seconds: float


# --- the latent -----------------------------------------------------------------------------------------------------


def normalisation(z_train: NDArray[np.float32], how: str) -> Arrays:
    """What `normalise` needs to know, from the policy train split only (PAPER.md 2.5)."""
    mean, std = np.zeros(LATENT, np.float32), np.ones(LATENT, np.float32)
    if how == "zscore":
        mean, std = z_train.mean(0, dtype=np.float64), z_train.std(0, dtype=np.float64)
        std = np.where(std > 0, std, 1.0)  # a dead latent number stays 0
    return {
        "z_mean": mean.astype(np.float32),
        "z_std": std.astype(np.float32),
        "z_l2": np.array([how == "l2"], np.uint8),
    }


def normalise(weights: Mapping[str, NDArray[Any]], z: NDArray[np.float32]) -> NDArray[np.float32]:
    """The latent [N, 64] as the policies see it."""
    scaled: NDArray[np.float32] = (z - weights["z_mean"]) / weights["z_std"]
    if weights["z_l2"][0]:
        scaled /= np.maximum(np.linalg.norm(scaled, axis=1, keepdims=True), np.finfo(np.float32).tiny)
    return scaled


# --- random numbers -------------------------------------------------------------------------------------------------


class Draws(NamedTuple):
    """All chance of one epoch: `order` [S, N] int64 and, for each hidden layer, bits [S, N * H / 32] int32."""

    order: Tensor
    bits: dict[str, tuple[Tensor, Tensor]]


def draw_epoch(seeds: Sequence[int], epoch: int, frames: int, device: torch.device | str = "cpu") -> Draws:
    """The order of the data and the dropout bits of each seed, a function of (seed, epoch) only.

    Made on the CPU whatever the device, so that a seed means the same everywhere; a GPU then copies both arrays while
    it computes.
    """
    words = {name: tuple(width // _WORD for width in widths[1:-1]) for name, widths in WIDTHS.items()}
    ends = np.cumsum([0, *(frames * each for layers in words.values() for each in layers)]).tolist()
    pinned = torch.device(device).type == "cuda"
    order = torch.empty((len(seeds), frames), dtype=torch.int64, pin_memory=pinned)
    bits = torch.empty((len(seeds), ends[-1]), dtype=torch.int32, pin_memory=pinned)
    orders, random_words = order.numpy(), bits.numpy()
    for row, seed in enumerate(seeds):
        rng = np.random.Generator(np.random.SFC64([seed, _EPOCH, epoch]))
        orders[row] = rng.permutation(frames)
        random_words[row] = rng.bit_generator.random_raw(math.ceil(ends[-1] / 2)).view(np.int32)[: ends[-1]]
    there = bits.to(device, non_blocking=True)
    parts = iter([there[:, a:b] for a, b in itertools.pairwise(ends)])
    return Draws(order.to(device, non_blocking=True), {name: (next(parts), next(parts)) for name in WIDTHS})


def initial_weights(seed: int) -> Iterator[tuple[str, Tensor]]:
    """One policy's weights by name, as torch's Linear draws them: uniform within 1 / sqrt(inputs)."""
    rng = np.random.default_rng([seed, _INIT])
    for name, widths in WIDTHS.items():
        for slot in slots(name):
            bound = widths[slot.layer] ** -0.5
            yield slot.key, torch.from_numpy(rng.uniform(-bound, bound, slot.shape).astype(np.float32))


# --- the networks ---------------------------------------------------------------------------------------------------


class Slot(NamedTuple):
    """Where one weight or bias lies in the row of numbers that is one network of one seed."""

    key: str
    layer: int
    start: int
    shape: tuple[int, ...]

    def cut(self, rows: Tensor) -> Tensor:
        """This weight [G, in, out] or bias [G, out] of rows [G, numbers], without a copy."""
        return rows[:, self.start : self.start + math.prod(self.shape)].view(-1, *self.shape)


def slots(name: str) -> list[Slot]:
    """Weights and biases of a network in their order, layer by layer."""
    found, start = [], 0
    for layer, (inputs, outputs) in enumerate(itertools.pairwise(WIDTHS[name])):
        for part, shape in (("weight", (inputs, outputs)), ("bias", (outputs,))):
            found.append(Slot(f"{name}_{layer}_{part}", layer, start, shape))
            start += math.prod(shape)
    return found


def stack(seeds: Sequence[int], name: str) -> Tensor:
    """Initial weights of all seeds, [S, numbers]: a row for each, padded to whole vectors of the processor.

    Adam would round the numbers of a last, half-filled vector differently, and a seed's result would depend on where it
    stands in the stack.
    """
    places = slots(name)
    used = places[-1].start + math.prod(places[-1].shape)
    rows = torch.zeros(len(seeds), math.ceil(used / _VECTOR) * _VECTOR)
    for row, seed in enumerate(seeds):
        start = dict(initial_weights(seed))
        for slot in places:
            slot.cut(rows[row : row + 1]).copy_(start[slot.key][None])
    return rows


class Layer(NamedTuple):
    """One fully connected layer of G seeds: weight [G, in, out], bias [G, 1, out], and where their gradients go."""

    weight: Tensor
    bias: Tensor
    weight_gradient: Tensor
    bias_gradient: Tensor


class Scratch:
    """Memory that every pass uses again: fresh pages from the system cost as much as the products do."""

    def __init__(self) -> None:
        self._kept: dict[tuple[str, torch.dtype], Tensor] = {}

    def take(self, use: str, shape: tuple[int, ...], like: Tensor) -> Tensor:
        """A tensor of that shape, with anything in it; the last one for the same use is lost."""
        size, key = math.prod(shape), (use, like.dtype)
        kept = self._kept.get(key)
        if kept is None or kept.numel() < size:
            kept = self._kept[key] = torch.empty(size, dtype=like.dtype, device=like.device)
        return kept[:size].view(shape)


@functools.cache
def _shifts(device: torch.device) -> Tensor:
    return torch.arange(_TWO, -1, -1, dtype=torch.int32, device=device)[:, None]


def dropped(words: Tensor, rows: int, scratch: Scratch, use: str = "dropped") -> Tensor:
    """Words of 32 random bits [G, B * H / 32] int32 as float32 [G, B, H]: 2.0 where the bit is set, 0.0 where not."""
    words = words[:, None]
    bits = scratch.take(use, (len(words), _WORD, words.shape[2]), words)
    torch.bitwise_left_shift(words, _shifts(words.device), out=bits[:, :-1])  # bits 0 to 30
    torch.bitwise_right_shift(words, 1, out=bits[:, -1:])  # bit 31
    return bits.bitwise_and_(1 << _TWO).view(torch.float32).view(len(words), rows, -1)


def forward_backward(
    layers: Sequence[Layer],
    x: Tensor,
    words: Sequence[Tensor],
    output_gradient: Callable[[Tensor], Tensor],
    scratch: Scratch,
) -> None:
    """One pass of G policies over their batches x [G, B, 64]; writes the gradients of all layers.

    `output_gradient` maps outputs [G, O, B] to the loss's gradient there. A unit to drop starts its sum far below zero,
    so the ReLU drops it, and its zero tells the way back, too: dropout costs the two passes over memory that make the
    mask. What dropout multiplies by, 2, waits for the next product.
    """
    groups, rows, _ = x.shape
    activations = [x]
    for depth, (layer, bits) in enumerate(zip(layers[:-1], words, strict=True)):
        hidden = dropped(bits, rows, scratch, f"hidden {depth}")
        hidden.baddbmm_(activations[-1], layer.weight, beta=_DROPPED, alpha=_KEPT if depth else 1)
        activations.append(hidden.add_(layer.bias).relu_())
    outputs = torch.baddbmm(layers[-1].bias, activations[-1], layers[-1].weight, alpha=_KEPT)
    gradient = output_gradient(outputs.transpose(1, 2).contiguous()).transpose(1, 2)  # O first: softmax in wide rows
    for depth in reversed(range(len(layers))):
        layer, hidden = layers[depth], activations[depth]
        torch.sum(gradient, 1, keepdim=True, out=layer.bias_gradient)
        layer.weight_gradient.baddbmm_(hidden.transpose(1, 2), gradient, beta=0, alpha=_KEPT if depth else 1)
        if depth:
            above, gradient = gradient, scratch.take(f"gradient {depth}", (groups, rows, hidden.shape[2]), x)
            gradient.baddbmm_(above, layer.weight.transpose(1, 2), beta=0, alpha=_KEPT)
            torch.ops.aten.threshold_backward.grad_input(gradient, hidden, 0.0, grad_input=gradient)


def outputs(weights: Sequence[tuple[Tensor, Tensor]], x: Tensor) -> Tensor:
    """Outputs [G, N, O] of G policies without dropout for x [N, 64]."""
    return torch.cat([through(weights, x[start : start + _ROWS]) for start in range(0, len(x), _ROWS)], 1)


def through(weights: Sequence[tuple[Tensor, Tensor]], x: Tensor) -> Tensor:
    """The same in one pass: weights [G, in, out] and biases [G, 1, out] layer by layer."""
    hidden = x.expand(len(weights[0][0]), -1, -1)
    for depth, (weight, bias) in enumerate(weights):
        hidden = torch.baddbmm(bias, hidden, weight)
        if depth < len(weights) - 1:
            hidden.relu_()
    return hidden


def predict(weights: Mapping[str, NDArray[Any]], z: NDArray[np.float32]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Steering [S, N] and logits of the accelerations [S, N, 3], float32, for latents [N, 64] as encoded."""
    x = torch.from_numpy(normalise(weights, z))
    results = {}
    with torch.inference_mode():
        for name, widths in WIDTHS.items():
            layers = [
                (
                    torch.from_numpy(weights[f"{name}_{layer}_weight"]),
                    torch.from_numpy(weights[f"{name}_{layer}_bias"])[:, None],
                )
                for layer in range(len(widths) - 1)
            ]
            seeds = range(len(layers[0][0]))
            results[name] = torch.cat([outputs([(w[s : s + 1], b[s : s + 1]) for w, b in layers], x) for s in seeds])
    return results["steering"][..., 0].numpy(), results["acceleration"].numpy()


# --- metrics --------------------------------------------------------------------------------------------------------


class Labels(NamedTuple):
    """What a policy should say: steering [N] float32 and acceleration class [N] int64."""

    steering: Tensor
    acceleration: Tensor


def likeliest(logits: Tensor) -> Tensor:
    """The class of the largest of logits [S, 3, N], the first of equal ones; argmax takes 40 times as long on a CPU."""
    first, second, third = logits.unbind(1)
    return torch.where(first >= torch.maximum(second, third), 0, torch.where(second >= third, 1, 2))


def measure(steering: Tensor, logits: Tensor, labels: Labels) -> Tensor:
    """METRICS of each seed, [4, S], from steering [S, N] and logits [S, N, 3].

    Balanced accuracy is the mean over the classes that occur of the share found of each.
    """
    errors = functional.smooth_l1_loss(steering, labels.steering.expand_as(steering), reduction="none").mean(1)
    by_class = logits.transpose(1, 2).contiguous()
    right = (likeliest(by_class) == labels.acceleration).to(torch.float32)
    there = functional.one_hot(labels.acceleration, len(ACCELERATIONS)).to(torch.float32)
    counts = there.sum(0)
    balanced = (right @ there / counts.clamp(min=1)).sum(1) / (counts > 0).sum()
    surprise = -(by_class.log_softmax(1) * there.T).sum(1).mean(1)
    return torch.stack([errors, right.mean(1), balanced, surprise])


# --- training -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class PolicyData:
    """What policies learn from and are measured on; x as `normalise` gives it.

    `x` [N, 64] and `labels` of the train split; `views`: for each split the x and labels that metrics are taken on.
    """

    x: Tensor
    labels: Labels
    views: dict[str, tuple[Tensor, Labels]]


class PolicyEnsemble(lightning.LightningModule):
    """S policies as stacked tensors: for each network a row of numbers a seed, and its layers as views of the rows.

    One training step is one batch of every seed. `after_epoch(epoch, {split: METRICS [4, S]})` hears of each epoch:
    on a GPU the only moment at which anyone waits for it.
    """

    def __init__(
        self,
        seeds: Sequence[int],
        settings: PolicySettings,
        data: PolicyData,
        after_epoch: AfterEpoch,
    ) -> None:
        super().__init__()
        self.automatic_optimization = False
        self.seeds, self.settings = tuple(seeds), settings
        self._data, self._after_epoch = data, after_epoch
        self.stacks = nn.ParameterDict({name: nn.Parameter(stack(seeds, name)) for name in WIDTHS})
        self._scratch = Scratch()
        self._ahead: Draws | None = None
        self._groups = _groups(len(self.seeds), data.x.device)

    def configure_optimizers(self) -> torch.optim.Optimizer:
        """Adam; fused, because the stack is small numbers in many places."""
        return torch.optim.Adam(self.parameters(), lr=self.settings.lr, fused=True)

    def on_train_start(self) -> None:
        """Cut the stacks into layers, once: views of weights and of gradients that stay where they are."""
        self._layers = {name: [self._cut(name, group) for group in self._groups] for name in WIDTHS}

    def _cut(self, name: str, group: slice) -> list[Layer]:
        weights = self.stacks[name]
        if weights.grad is None:
            weights.grad = torch.zeros_like(weights)
        rows, gradients = weights.detach()[group], weights.grad[group]
        places = slots(name)
        return [
            Layer(weight.cut(rows), bias.cut(rows)[:, None], weight.cut(gradients), bias.cut(gradients)[:, None])
            for weight, bias in zip(places[::2], places[1::2], strict=True)
        ]

    def weights(self) -> Arrays:
        """Weights [S, in, out] and biases [S, out] by name."""
        return {
            slot.key: np.ascontiguousarray(slot.cut(self.stacks[name].detach()).cpu().numpy())
            for name in WIDTHS
            for slot in slots(name)
        }

    def on_train_epoch_start(self) -> None:
        """Take the epoch's chance, and bring the labels into its order."""
        self._order, self._bits = self._ahead or self._draw(self.current_epoch)
        self._ahead = None
        self._steering = self._data.labels.steering[self._order]
        self._acceleration = self._data.labels.acceleration[self._order]

    def _draw(self, epoch: int) -> Draws:
        return draw_epoch(self.seeds, epoch, len(self._data.x), self._data.x.device)

    def training_step(self, batch: int) -> None:
        """One batch of every seed: the rows at `batch` in each seed's own order."""
        start = batch * self.settings.batch
        rows = slice(start, min(start + self.settings.batch, len(self._data.x)))
        with torch.inference_mode():
            for name, index in self._units():
                self._pass(name, index, rows)
        self.optimizers(use_pl_optimizer=False).step()  # type: ignore[union-attr]

    def _pass(self, name: str, index: int, rows: slice) -> None:
        group, count = self._groups[index], rows.stop - rows.start
        order = self._order[group, rows]
        x = self._scratch.take("x", (order.numel(), LATENT), self._data.x)
        torch.index_select(self._data.x, 0, order.reshape(-1), out=x)
        frames = len(self._data.x)
        words = []
        for layer in self._bits[name]:
            each = layer.shape[1] // frames
            words.append(layer[group, rows.start * each : rows.stop * each])
        gradient = _steering_gradient if name == "steering" else _acceleration_gradient
        labels = (self._steering if name == "steering" else self._acceleration)[group, None, rows]
        forward_backward(
            self._layers[name][index],
            x.view(len(order), count, LATENT),
            words,
            lambda outputs: gradient(outputs, labels),
            self._scratch,
        )

    def on_train_epoch_end(self) -> None:
        """Measure every policy without dropout."""
        views = self._data.views
        measured = torch.stack([measure(*self.outputs(x), labels) for x, labels in views.values()])
        if len(self._groups) == 1 and self.current_epoch + 1 < self.settings.epochs:
            self._ahead = self._draw(self.current_epoch + 1)  # a GPU is still busy with this epoch
        self._after_epoch(self.current_epoch + 1, dict(zip(views, measured.cpu().numpy(), strict=True)))

    def outputs(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Steering [S, N] and logits [S, N, 3] without dropout."""
        results = {name: x.new_empty((len(self.seeds), len(x), widths[-1])) for name, widths in WIDTHS.items()}

        with torch.inference_mode():
            for name, index in self._units():
                layers = [(layer.weight, layer.bias) for layer in self._layers[name][index]]
                results[name][self._groups[index]] = outputs(layers, x)
        return results["steering"][..., 0], results["acceleration"]

    def _units(self) -> Iterator[tuple[str, int]]:
        """Each network with each group."""
        return itertools.product(WIDTHS, range(len(self._groups)))


def _groups(seeds: int, device: torch.device) -> list[slice]:
    """Which seeds are computed at once."""
    return [slice(0, seeds)] if device.type == "cuda" else [slice(seed, seed + 1) for seed in range(seeds)]


def _steering_gradient(outputs: Tensor, labels: Tensor) -> Tensor:
    """Gradient of the mean smooth L1 loss; outputs and labels [G, 1, B]."""
    return outputs.sub_(labels).clamp_(-1, 1).div_(outputs.shape[2])


def _acceleration_gradient(logits: Tensor, labels: Tensor) -> Tensor:
    """Gradient of the mean cross-entropy; logits [G, 3, B], labels [G, 1, B]."""
    gradient = logits.softmax(1)
    gradient.scatter_add_(1, labels, gradient.new_full((), -1.0).expand_as(labels))
    return gradient.div_(logits.shape[2])


# --- all of it ------------------------------------------------------------------------------------------------------


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
    """Train one policy per seed on latents [N, 64] float32 and labels with columns "steering" and "acceleration".

    Train metrics are taken on a random part of the train split, the same for all seeds and epochs, that is no larger
    than the test split. `log(epoch, means over the seeds)` with names such as "test/acceleration_accuracy".
    Raises BadInputError for data that cannot be learnt from, TrainingDivergedError for a loss that is not finite.
    """
    started = time.perf_counter()
    _check(z_train, z_test, labels_train, labels_test, seeds, settings)
    scaling = normalisation(z_train, settings.normalise)
    data = _policy_data(scaling, (z_train, labels_train), (z_test, labels_test), torch.device(device))
    points: list[pd.DataFrame] = []

    def after_epoch(epoch: int, values: Arrays) -> None:
        for metrics in values.values():
            broken = ~np.isfinite(metrics).all(0)
            if broken.any():
                raise TrainingDivergedError(
                    f"policies: the loss of seed {seeds[int(broken.argmax())]} is not finite after epoch {epoch}; "
                    f"try a lower policy.lr than {settings.lr:g}"
                )
        points.append(_points(seeds, epoch, values))
        if log:
            log(
                epoch,
                {
                    f"{split}/{metric}": float(each.mean())
                    for split, metrics in values.items()
                    for metric, each in zip(METRICS, metrics, strict=True)
                },
            )
        if progress:
            progress(epoch, settings.epochs)

    with _one_thread():
        ensemble = PolicyEnsemble(seeds, settings, data, after_epoch)
        _fit(ensemble, settings, math.ceil(len(data.x) / settings.batch), device)
        steering, logits = ensemble.outputs(data.views["test"][0])
    return TrainedPolicies(
        weights=ensemble.weights() | scaling,
        curves=pd.concat(points, ignore_index=True)[list(CURVE_COLUMNS)],
        acceleration=logits.argmax(2).to(torch.uint8).cpu().numpy(),
        steering=steering.cpu().numpy(),
        seconds=time.perf_counter() - started,
    )


def join_policies(shares: Sequence[TrainedPolicies]) -> TrainedPolicies:
    """Return policies that were trained in shares on the same data as if they had been trained at once.

    `seconds` is the sum over the shares.
    """
    first = shares[0]
    curves = pd.concat([share.curves for share in shares], ignore_index=True)
    ranks = {name: curves[name].map({each: rank for rank, each in enumerate(order)}) for name, order in _ORDER.items()}
    order = np.lexsort((ranks["metric"], ranks["split"], curves["epoch"]))  # stable: seeds stay in order
    return TrainedPolicies(
        weights={
            name: value if name.startswith("z_") else np.concatenate([share.weights[name] for share in shares])
            for name, value in first.weights.items()
        },
        curves=curves.iloc[order].reset_index(drop=True),
        acceleration=np.concatenate([share.acceleration for share in shares]),
        steering=np.concatenate([share.steering for share in shares]),
        seconds=sum(share.seconds for share in shares),
    )


@contextmanager
def _one_thread() -> Iterator[None]:
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


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
        if z.ndim != 2 or z.shape[1] != LATENT or not len(z) or z.dtype != np.float32:
            raise BadInputError(f"{split} latents are {z.dtype} {list(z.shape)}; float32 [frames, {LATENT}] is needed")
        if not np.isfinite(z).all():
            raise BadInputError(f"{split} latents hold values that are not finite; train the encoder again")
        for column in ("steering", "acceleration"):
            values = np.asarray(labels[column])
            if values.shape != (len(z),) or not np.isfinite(values).all():
                raise BadInputError(f"{split} labels '{column}' must be {len(z)} finite numbers, one for each latent")
        if not np.isin(labels["acceleration"], range(len(ACCELERATIONS))).all():
            raise BadInputError(f"{split} labels 'acceleration' must be classes 0 to {len(ACCELERATIONS) - 1}")
    if settings.batch > len(z_train):
        raise BadInputError(
            f"policy.batch is {settings.batch}, more than the {len(z_train)} policy train frames; "
            f"set --policy.batch to at most that"
        )


def _policy_data(scaling: Arrays, train: Labelled, test: Labelled, device: torch.device) -> PolicyData:
    (x_train, y_train), (x_test, y_test) = (
        (
            torch.from_numpy(normalise(scaling, z)).to(device),
            Labels(
                torch.from_numpy(np.array(labels["steering"], np.float32)).to(device),
                torch.from_numpy(np.array(labels["acceleration"], np.int64)).to(device),
            ),
        )
        for z, labels in (train, test)
    )
    some = np.random.default_rng(_SUBSET).permutation(len(x_train))[: len(x_test)]
    part = torch.from_numpy(np.sort(some)).to(device)
    seen = (x_train[part], Labels(*(values[part] for values in y_train)))
    return PolicyData(x_train, y_train, {"train": seen, "test": (x_test, y_test)})


def _points(seeds: Sequence[int], epoch: int, values: dict[str, NDArray[Any]]) -> pd.DataFrame:
    """Rows of the tidy table for one epoch."""
    index = pd.MultiIndex.from_product([values, METRICS, seeds], names=["split", "metric", "policy_seed"])
    numbers = np.concatenate([metrics.reshape(-1) for metrics in values.values()])
    return (
        pd.DataFrame({"value": numbers.astype(np.float64)}, index=index)
        .reset_index()
        .assign(stage="policy", epoch=epoch)
    )


def _fit(ensemble: PolicyEnsemble, settings: PolicySettings, steps: int, device: str) -> None:
    with trainer(
        torch.device(device),
        settings.epochs,
        f"{len(ensemble.seeds)} policies at batch {settings.batch}",
        "lower --policy.batch or --policy_seeds, or end what else runs there",
    ) as lightning_trainer:
        lightning_trainer.fit(ensemble, train_dataloaders=range(steps))
