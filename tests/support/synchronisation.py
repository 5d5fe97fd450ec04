"""Detects code that waits for its device, which it does whenever it reads a number from a tensor."""

from __future__ import annotations

import functools
from typing import Any

import pytest
import torch

READS = ("item", "tolist", "cpu", "numpy", "nonzero", "__bool__", "__int__", "__float__")


def record_synchronisations(monkeypatch: pytest.MonkeyPatch, owner: type, *methods: str) -> list[str]:
    """Return a list to which every read of a tensor during those methods of `owner` adds its name."""
    reads: list[str] = []

    def watched(method: Any) -> Any:
        @functools.wraps(method)  # Lightning inspects the signature
        def run(*arguments: Any) -> None:
            with pytest.MonkeyPatch.context() as patch:
                for name in READS:
                    patch.setattr(torch.Tensor, name, lambda *_, name=name, **__: reads.append(name))
                method(*arguments)

        return run

    for name in methods:
        monkeypatch.setattr(owner, name, watched(getattr(owner, name)))
    return reads
