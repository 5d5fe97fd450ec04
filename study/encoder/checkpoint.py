"""Checkpoints of training that notice their own damage."""

from __future__ import annotations

import hashlib
import io
import pickle
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch

from study.atomic import write_atomic
from study.errors import BadInputError

DIGEST_BYTES = hashlib.sha256().digest_size  # before what torch writes


@dataclass
class TrainingState:
    """How far a training has come: complete epochs, steps of the next, seconds spent, and the curves so far."""

    epoch: int = 0
    step: int = 0
    seconds: float = 0.0
    rows: list[tuple[str, int, str, float]] = field(default_factory=list)


class DamagedCheckpointError(Exception):
    """A checkpoint that was changed or cut off on disk."""


def write_checkpoint(path: Path, content: dict[str, Any]) -> None:
    """Write a checkpoint and its digest, atomically."""
    stream = io.BytesIO()  # torch turns the error of a full disk into one of its own, and keeps no digest
    torch.save(content, stream)
    raw = stream.getvalue()
    write_atomic(path, hashlib.sha256(raw).digest() + raw)


def read_checkpoint(path: Path, training: dict[str, Any]) -> dict[str, Any]:
    """Return the content that `write_checkpoint` wrote.

    Raises DamagedCheckpointError, and BadInputError when the checkpoint belongs to another training.
    """
    raw = path.read_bytes()
    if hashlib.sha256(raw[DIGEST_BYTES:]).digest() != raw[:DIGEST_BYTES]:
        raise DamagedCheckpointError(f"{path} does not match its digest")
    try:
        content: dict[str, Any] = torch.load(io.BytesIO(raw[DIGEST_BYTES:]), map_location="cpu", weights_only=True)
        other = content["training"]
    except (RuntimeError, EOFError, KeyError, TypeError, ValueError, pickle.UnpicklingError) as error:
        raise DamagedCheckpointError(f"{path} is no checkpoint of an encoder ({error})") from error
    for name in sorted(training | other):
        if training.get(name) != other.get(name):
            raise BadInputError(
                f"checkpoint {path} belongs to another configuration: {name} is {other.get(name)!r} there and "
                f"{training.get(name)!r} here; delete it to train from the start, or name another file"
            )
    return content
