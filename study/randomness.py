"""Random numbers: one generator for each purpose of a seed."""

from __future__ import annotations

import hashlib

import numpy as np


def rng(seed: int, purpose: str, bits: type[np.random.BitGenerator] = np.random.PCG64) -> np.random.Generator:
    """Return the generator of one purpose of a seed: generators of other purposes or seeds are independent of it.

    `bits`: where raw bits are drawn by the million, SFC64 is faster.
    """
    digest = hashlib.sha256(f"{seed}/{purpose}".encode()).digest()
    return np.random.Generator(bits(int.from_bytes(digest, "big")))
