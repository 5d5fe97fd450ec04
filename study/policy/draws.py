"""The random numbers of policies: initial weights, data order, dropout."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from study.config.paper import LATENT
from study.policy.networks import WIDTHS, WORD, slots
from study.randomness import rng


class Draws(NamedTuple):
    """All random numbers of one epoch: `order` [S, N] int64 and, for each hidden layer, bits [S, N * H / 32] int32."""

    order: Tensor
    bits: dict[str, tuple[Tensor, Tensor]]


def draw_epoch(seeds: Sequence[int], epoch: int, frames: int, device: torch.device | str = "cpu") -> Draws:
    """Return the order of the data and the dropout bits of each seed, a function of (seed, epoch) only.

    They are drawn on the CPU, so that a seed means the same on every device; a GPU copies them while it computes.
    """
    words = {name: tuple(width // WORD for width in widths[1:-1]) for name, widths in WIDTHS.items()}
    ends = np.cumsum([0, *(frames * each for layers in words.values() for each in layers)]).tolist()
    pinned = torch.device(device).type == "cuda"
    order = torch.empty((len(seeds), frames), dtype=torch.int64, pin_memory=pinned)
    bits = torch.empty((len(seeds), ends[-1]), dtype=torch.int32, pin_memory=pinned)
    orders, random_words = order.numpy(), bits.numpy()
    for row, seed in enumerate(seeds):
        generator = rng(seed, f"policy epoch {epoch}", np.random.SFC64)
        orders[row] = generator.permutation(frames)
        random_words[row] = generator.bit_generator.random_raw(math.ceil(ends[-1] / 2)).view(np.int32)[: ends[-1]]
    on_device = bits.to(device, non_blocking=True)
    parts = iter([on_device[:, a:b] for a, b in itertools.pairwise(ends)])
    return Draws(order.to(device, non_blocking=True), {name: (next(parts), next(parts)) for name in WIDTHS})


def initial_weights(seed: int, inputs: int = LATENT) -> Iterator[tuple[str, Tensor]]:
    """Yield one policy's weights by name, as torch's Linear draws them: uniform within 1 / sqrt(inputs)."""
    generator = rng(seed, "policy weights")
    for name, widths in WIDTHS.items():
        for slot in slots(name, inputs):
            bound = (inputs, *widths[1:])[slot.layer] ** -0.5
            yield slot.key, torch.from_numpy(generator.uniform(-bound, bound, slot.shape).astype(np.float32))
