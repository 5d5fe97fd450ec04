"""Atomic writes: whoever reads finds the whole folder or none."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.numpy import load_file, save

from study.atomic import atomic_folder
from study.errors import BadInputError

Arrays = dict[str, NDArray[Any]]
TABLE = "curves.parquet"


def write_product(
    folder: Path,
    head_file: str,
    head: Mapping[str, Any],
    parts: Mapping[str, Arrays],
    table: pd.DataFrame,
    add: Callable[[Path], object] | None = None,
) -> Path:
    """Write `folder` with `head_file`, one safetensors file for each part, the table, and what `add` writes into it."""
    with atomic_folder(folder) as draft:
        for part, arrays in parts.items():
            # Not `save_file`, whose error for a full disk is no OSError.
            content = save({key: np.ascontiguousarray(value) for key, value in arrays.items()})
            (draft / f"{part}.safetensors").write_bytes(content)
        table.to_parquet(draft / TABLE, index=False)
        digests = {file.name: _digest(file) for file in sorted(draft.iterdir())}
        (draft / head_file).write_text(json.dumps({**head, "digests": digests}, indent=1), encoding="utf-8")
        if add:
            add(draft)
    return folder


def read_product(
    folder: Path, head_file: str, parts: Sequence[str]
) -> tuple[dict[str, Any], dict[str, Arrays], pd.DataFrame]:
    """Return head, parts and table of what `write_product` wrote. Raises BadInputError when it is not whole."""
    files = (TABLE, *(f"{part}.safetensors" for part in parts))
    try:
        head = json.loads((folder / head_file).read_text(encoding="utf-8"))
        for name, digest in head.get("digests", {}).items():  # the first products had no digests
            if name not in files or _digest(folder / name) != digest:
                raise ValueError(f"{name} does not match its digest")  # noqa: TRY301 - one report for all damage
        arrays = {part: load_file(folder / f"{part}.safetensors") for part in parts}
        return head, arrays, pd.read_parquet(folder / TABLE)
    except (OSError, ValueError, TypeError, AttributeError, SafetensorError) as error:
        raise BadInputError(f"{folder} is not a whole product: {error}") from error


def _digest(file: Path) -> str:
    return hashlib.sha256(file.read_bytes()).hexdigest()
