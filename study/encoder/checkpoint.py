"""Checkpoints of training that notice their own damage."""

from __future__ import annotations

import hashlib
import io
import os
import pickle
import tempfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch

from study.errors import BadInputError

DIGEST = hashlib.sha256().digest_size  # bytes, before what torch writes
ZIP = b"PK"  # how a checkpoint from before there were digests begins


@dataclass
class TrainingState:
    """How far a training has come: whole epochs, steps of the next, seconds spent, and the curves so far."""

    epoch: int = 0
    step: int = 0
    seconds: float = 0.0
    rows: list[tuple[str, int, str, float]] = field(default_factory=list)


class DamagedCheckpointError(Exception):
    """A checkpoint that was changed or cut off on disk."""


def write_checkpoint(path: Path, content: dict[str, Any]) -> None:
    """Write a checkpoint and its digest, atomically."""
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


def read_checkpoint(path: Path, training: dict[str, Any]) -> dict[str, Any]:
    """Return what `write_checkpoint` wrote.

    Raises DamagedCheckpointError, and BadInputError when it belongs to another training.
    """
    raw = path.read_bytes()
    if not raw.startswith(ZIP):
        digest, raw = raw[:DIGEST], raw[DIGEST:]
        if hashlib.sha256(raw).digest() != digest:
            raise DamagedCheckpointError(f"{path} does not match its digest")
    try:
        content: dict[str, Any] = torch.load(io.BytesIO(raw), map_location="cpu", weights_only=True)
        other = content["training"]
    except (OSError, RuntimeError, EOFError, KeyError, TypeError, ValueError, pickle.UnpicklingError) as error:
        raise DamagedCheckpointError(f"{path} is no checkpoint of an encoder ({error})") from error
    for name in sorted(training | other):
        if training.get(name) != other.get(name):
            raise BadInputError(
                f"checkpoint {path} is of another configuration: {name} is {other.get(name)!r} there and "
                f"{training.get(name)!r} here; delete it to train anew, or name another file"
            )
    return content
