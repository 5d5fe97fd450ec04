"""Whether code waits for its device: asks a tensor for a number, and so for all that was begun before."""

from __future__ import annotations

import functools
from typing import Any

import pytest
import torch

QUESTIONS = ("item", "tolist", "cpu", "numpy", "nonzero", "__bool__", "__int__", "__float__")


def questions(monkeypatch: pytest.MonkeyPatch, owner: type, *methods: str) -> list[str]:
    """A list that will name each question which those methods of `owner` ask from now on."""
    asked: list[str] = []

    def watched(method: Any) -> Any:
        @functools.wraps(method)  # Lightning looks at its arguments
        def run(*arguments: Any) -> None:
            with pytest.MonkeyPatch.context() as patch:
                for name in QUESTIONS:
                    patch.setattr(torch.Tensor, name, lambda *_, name=name, **__: asked.append(name))
                method(*arguments)

        return run

    for name in methods:
        monkeypatch.setattr(owner, name, watched(getattr(owner, name)))
    return asked
