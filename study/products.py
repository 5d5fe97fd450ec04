"""Products of stages on disk: arrays, a table and facts in one folder, written atomically, with digests."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.numpy import load_file, save

from study.atomic import atomic_folder, twice_if_swept
from study.errors import BadInputError

Arrays = dict[str, NDArray[Any]]
TABLE = "curves.parquet"


@dataclass(frozen=True)
class Product:
    """What a training stage returns: arrays in named parts, curves, and facts as plain values."""

    parts: dict[str, Arrays]
    curves: pd.DataFrame
    facts: dict[str, Any]


def write_product(
    folder: Path, head_file: str, head: Mapping[str, Any], parts: Mapping[str, Arrays], table: pd.DataFrame
) -> Path:
    """Write a folder with the head as JSON, one safetensors file for each part, and the table."""

    def write() -> Path:
        with atomic_folder(folder) as draft:
            for part, arrays in parts.items():
                # Not `save_file`, whose error for a full disk is no OSError.
                content = save({key: np.ascontiguousarray(value) for key, value in arrays.items()})
                (draft / f"{part}.safetensors").write_bytes(content)
            table.to_parquet(draft / TABLE, index=False)
            digests = {file.name: _digest(file) for file in sorted(draft.iterdir())}
            (draft / head_file).write_text(json.dumps({**head, "digests": digests}, indent=1), encoding="utf-8")
        return folder

    return twice_if_swept(write)


def read_product(
    folder: Path, head_file: str, parts: Sequence[str]
) -> tuple[dict[str, Any], dict[str, Arrays], pd.DataFrame]:
    """Return head, parts and table of what `write_product` wrote. Raises BadInputError when a part is damaged."""
    files = (TABLE, *(f"{part}.safetensors" for part in parts))
    missing = [name for name in (head_file, *files) if not (folder / name).is_file()]
    if missing:
        raise BadInputError(f"{folder} is no complete product: {', '.join(missing)} missing")
    try:
        head = json.loads((folder / head_file).read_text(encoding="utf-8"))
        for name, digest in head.get("digests", {}).items():  # the first products had no digests
            if name not in files or _digest(folder / name) != digest:
                raise ValueError(f"{name} does not match its digest")  # noqa: TRY301 - one report for all damage
        arrays = {part: load_file(folder / f"{part}.safetensors") for part in parts}
        return head, arrays, pd.read_parquet(folder / TABLE)
    except (OSError, ValueError, TypeError, AttributeError, SafetensorError) as error:
        raise BadInputError(f"{folder} is no complete product: {error}") from error


def _digest(file: Path) -> str:
    return hashlib.sha256(file.read_bytes()).hexdigest()
