"""Policies on a frozen latent (Sec. III-B.3, IV-C): all seeds at once, as one stack of tensors.

Two small networks without shared weights learn from z: one gives the steering, one the logits of the three
accelerations. Seeds do not influence each other: the loss is their sum and Adam works number by number. A seed ends the
same whichever seeds are trained beside it, so shares of the seeds can be trained by different processes.

A unit of work is one network on a group of seeds. On a CPU a group is one seed, whose step fits into one core's cache,
computed on one thread: threads inside an operation would wait for each other forty times a step. On a GPU all seeds are
one group.

Suffixes: S seeds, G seeds of a group, B rows of a batch, N frames, H hidden units, O outputs, Z numbers given: 64 of
the latent, and past speeds where the settings say so.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import lightning
import numpy as np
import torch
from torch import Tensor, nn

from study.config.settings import PolicySettings
from study.policy.draws import Draws, draw_epoch, initial_weights
from study.policy.latents import Arrays
from study.policy.metrics import Labels, measure
from study.policy.networks import VECTOR, WIDTHS, Layer, Scratch, forward_backward, outputs, slots

AfterEpoch = Callable[[int, Arrays], None]


@dataclass(frozen=True)
class PolicyData:
    """The data of policies: `x` [N, Z], normalised, and `labels` of the train split.

    `views`: for each split the x and labels that metrics are taken on.
    """

    x: Tensor
    labels: Labels
    views: dict[str, tuple[Tensor, Labels]]


class PolicyEnsemble(lightning.LightningModule):
    """S policies as stacked tensors: for each network a row of numbers a seed, and its layers as views of the rows.

    One training step is one batch of every seed. `after_epoch(epoch, {split: METRICS [7, S]})` is called after each
    epoch; only then does the process wait for a GPU.
    """

    def __init__(
        self, seeds: Sequence[int], settings: PolicySettings, data: PolicyData, after_epoch: AfterEpoch
    ) -> None:
        super().__init__()
        self.automatic_optimization = False
        self.seeds, self.settings = tuple(seeds), settings
        self._data, self._after_epoch = data, after_epoch
        self.stacks = nn.ParameterDict({name: nn.Parameter(stack(seeds, name, data.x.shape[1])) for name in WIDTHS})
        self._scratch = Scratch()
        self._ahead: Draws | None = None
        self._groups = _groups(len(self.seeds), data.x.device)

    def configure_optimizers(self) -> torch.optim.Optimizer:
        """Return Adam; fused, because the stack has few numbers in many places."""
        return torch.optim.Adam(self.parameters(), lr=self.settings.lr, fused=True)

    def on_train_start(self) -> None:
        """Cut the stacks into layers, once: views of weights and of gradients that stay where they are."""
        self._layers = {name: [self._cut(name, group) for group in self._groups] for name in WIDTHS}

    def _cut(self, name: str, group: slice) -> list[Layer]:
        weights = self.stacks[name]
        if weights.grad is None:
            weights.grad = torch.zeros_like(weights)
        rows, gradients = weights.detach()[group], weights.grad[group]
        places = slots(name, self._data.x.shape[1])
        return [
            Layer(weight.cut(rows), bias.cut(rows)[:, None], weight.cut(gradients), bias.cut(gradients)[:, None])
            for weight, bias in zip(places[::2], places[1::2], strict=True)
        ]

    def weights(self) -> Arrays:
        """Return weights [S, in, out] and biases [S, out] by name."""
        return {
            slot.key: np.ascontiguousarray(slot.cut(self.stacks[name].detach()).cpu().numpy())
            for name in WIDTHS
            for slot in slots(name, self._data.x.shape[1])
        }

    def on_train_epoch_start(self) -> None:
        """Draw the random numbers of the epoch, and bring the labels into its order."""
        self._order, self._bits = self._ahead or self._draw(self.current_epoch)
        self._ahead = None
        self._steering = self._data.labels.steering[self._order]
        self._acceleration = self._data.labels.acceleration[self._order]

    def _draw(self, epoch: int) -> Draws:
        return draw_epoch(self.seeds, epoch, len(self._data.x), self._data.x.device)

    def training_step(self, batch: int) -> None:
        """Train one batch of every seed: the rows at `batch` in the order of each seed."""
        start = batch * self.settings.batch
        rows = slice(start, min(start + self.settings.batch, len(self._data.x)))
        with torch.inference_mode():
            for name, index in self._units():
                self._pass(name, index, rows)
        self.optimizers(use_pl_optimizer=False).step()  # type: ignore[union-attr]

    def _pass(self, name: str, index: int, rows: slice) -> None:
        group, count = self._groups[index], rows.stop - rows.start
        order = self._order[group, rows]
        x = self._scratch.take("x", (order.numel(), self._data.x.shape[1]), self._data.x)
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
            x.view(len(order), count, -1),
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
        """Return steering [S, N] and logits [S, N, 3] without dropout."""
        results = {name: x.new_empty((len(self.seeds), len(x), widths[-1])) for name, widths in WIDTHS.items()}
        with torch.inference_mode():
            for name, index in self._units():
                layers = [(layer.weight, layer.bias) for layer in self._layers[name][index]]
                results[name][self._groups[index]] = outputs(layers, x)
        return results["steering"][..., 0], results["acceleration"]

    def _units(self) -> Iterator[tuple[str, int]]:
        """Return each network with each group."""
        return itertools.product(WIDTHS, range(len(self._groups)))


def _groups(seeds: int, device: torch.device) -> list[slice]:
    """Return the seeds that are computed at once."""
    return [slice(0, seeds)] if device.type == "cuda" else [slice(seed, seed + 1) for seed in range(seeds)]


def _steering_gradient(outputs: Tensor, labels: Tensor) -> Tensor:
    """Return the gradient of the mean smooth L1 loss; outputs and labels [G, 1, B]."""
    return outputs.sub_(labels).clamp_(-1, 1).div_(outputs.shape[2])


def _acceleration_gradient(logits: Tensor, labels: Tensor) -> Tensor:
    """Return the gradient of the mean cross-entropy; logits [G, 3, B], labels [G, 1, B]."""
    gradient = logits.softmax(1)
    gradient.scatter_add_(1, labels, gradient.new_full((), -1.0).expand_as(labels))
    return gradient.div_(logits.shape[2])


def stack(seeds: Sequence[int], name: str, inputs: int) -> Tensor:
    """Return the initial weights of all seeds [S, numbers], rows padded to full vectors of the processor.

    Adam would round the numbers of a last, half-filled vector differently, and a seed's result would depend on its
    place in the stack.
    """
    places = slots(name, inputs)
    used = places[-1].start + math.prod(places[-1].shape)
    rows = torch.zeros(len(seeds), math.ceil(used / VECTOR) * VECTOR)
    for row, seed in enumerate(seeds):
        start = dict(initial_weights(seed, inputs))
        for slot in places:
            slot.cut(rows[row : row + 1]).copy_(start[slot.key][None])
    return rows
