"""A stack of policy networks with a hand-written backward pass."""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from study.config.paper import ACCELERATION_HIDDEN, ACCELERATIONS, DROPOUT, LATENT, STEERING_HIDDEN
from study.policy.latents import normalise

WIDTHS = {  # of a policy that is given z alone
    "steering": (LATENT, *STEERING_HIDDEN, 1),
    "acceleration": (LATENT, *ACCELERATION_HIDDEN, len(ACCELERATIONS)),
}
WORD = 32  # random bits in an int32
_TWO = 30  # the one bit that makes an int32 the float32 2.0
VECTOR = 16  # float32 in the widest register
_DROPPED = -1e30  # starts the sum of a dropped unit far below zero
_KEPT = 1 / (1 - DROPOUT)
_ROWS = 2048  # evaluated at once: their hidden units fit into a core's cache

assert DROPOUT == 0.5, "masks are made of random bits"


class Slot(NamedTuple):
    """Where one weight or bias lies in the row of numbers that is one network of one seed."""

    key: str
    layer: int
    start: int
    shape: tuple[int, ...]

    def cut(self, rows: Tensor) -> Tensor:
        """Return this weight [G, in, out] or bias [G, out] of rows [G, numbers], without a copy."""
        return rows[:, self.start : self.start + math.prod(self.shape)].view(-1, *self.shape)


def slots(name: str, inputs: int = LATENT) -> list[Slot]:
    """Return the weights and biases of a network of so many inputs in their order, layer by layer."""
    places, start = [], 0
    for layer, (before, after) in enumerate(itertools.pairwise((inputs, *WIDTHS[name][1:]))):
        for part, shape in (("weight", (before, after)), ("bias", (after,))):
            places.append(Slot(f"{name}_{layer}_{part}", layer, start, shape))
            start += math.prod(shape)
    return places


class Layer(NamedTuple):
    """One fully connected layer of G seeds: weight [G, in, out], bias [G, 1, out], and where their gradients go."""

    weight: Tensor
    bias: Tensor
    weight_gradient: Tensor
    bias_gradient: Tensor


class Scratch:
    """Memory that every pass reuses: fresh pages from the system cost as much as the matrix products."""

    def __init__(self) -> None:
        self._kept: dict[tuple[str, torch.dtype], Tensor] = {}

    def take(self, use: str, shape: tuple[int, ...], like: Tensor) -> Tensor:
        """Return an uninitialised tensor of that shape; it overwrites the last one for the same use."""
        size, key = math.prod(shape), (use, like.dtype)
        kept = self._kept.get(key)
        if kept is None or kept.numel() < size:
            kept = self._kept[key] = torch.empty(size, dtype=like.dtype, device=like.device)
        return kept[:size].view(shape)


@functools.cache
def _shifts(device: torch.device) -> Tensor:
    return torch.arange(_TWO, -1, -1, dtype=torch.int32, device=device)[:, None]


def dropped(words: Tensor, rows: int, scratch: Scratch, use: str = "dropped") -> Tensor:
    """Return words of 32 random bits [G, B * H / 32] int32 as float32 [G, B, H]: 2.0 where a bit is set, else 0.0."""
    words = words[:, None]
    bits = scratch.take(use, (len(words), WORD, words.shape[2]), words)
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
    """Write the gradients of all layers of G policies for their batches x [G, B, 64].

    `output_gradient` maps outputs [G, O, B] to the loss's gradient there. A unit to drop starts its sum far below zero,
    so that the ReLU drops it, forward and backward: dropout costs only the two passes over memory that make the mask.
    Its factor of 2 is applied in the next product.
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
    """Return outputs [G, N, O] of G policies without dropout for x [N, 64]."""
    return torch.cat([through(weights, x[start : start + _ROWS]) for start in range(0, len(x), _ROWS)], 1)


def through(weights: Sequence[tuple[Tensor, Tensor]], x: Tensor) -> Tensor:
    """Return the same from one pass: weights [G, in, out] and biases [G, 1, out] layer by layer."""
    hidden = x.expand(len(weights[0][0]), -1, -1)
    for depth, (weight, bias) in enumerate(weights):
        hidden = torch.baddbmm(bias, hidden, weight)
        if depth < len(weights) - 1:
            hidden.relu_()
    return hidden


def predict(weights: Mapping[str, NDArray[Any]], z: NDArray[np.float32]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return steering [S, N] and logits of the accelerations [S, N, 3], float32, for latents [N, 64] as encoded."""
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
