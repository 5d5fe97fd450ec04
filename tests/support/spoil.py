"""Spoil an Episode's files as a writer with a fault would: the digests are those of the spoilt files."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pandas as pd

from study.episode.head import file_digest


def spoil(folder: Path, file: str, change: Callable[[Any], Any]) -> None:
    """Replace a table by what `change` returns, or a JSON object by what `change` makes of it in place."""
    path = folder / file
    if file.endswith("parquet"):
        change(pd.read_parquet(path)).to_parquet(path, index=False)
    else:
        content = json.loads(path.read_text())
        change(content)
        path.write_text(json.dumps(content))
    if file != "episode.json":
        head = json.loads((folder / "episode.json").read_text())
        head["digests"][file] = file_digest(path)
        (folder / "episode.json").write_text(json.dumps(head))
