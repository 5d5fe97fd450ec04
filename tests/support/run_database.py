"""Reads MLflow's database directly, so that tests see what is stored and not what the tracker makes of it."""

from __future__ import annotations

import hashlib
import sqlite3
from collections import Counter
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class RunDatabase:
    """Reads a SQLite file of MLflow's; `files` is the folder of the artifacts where a server keeps them."""

    database: Path
    files: Path | None = None

    def query(self, statement: str) -> list[tuple[str, ...]]:
        """Return the rows of a statement; none as long as there is no database."""
        if not self.database.is_file():
            return []
        # Opened for writing: SQLite rolls back what a killed process has half written before anyone can read.
        with closing(sqlite3.connect(f"file:{self.database}?mode=rw", uri=True, timeout=60)) as database:
            return database.execute(statement).fetchall()

    def cell_counts(self) -> Counter[str]:
        """Count the runs of cells, by status."""
        statement = "select status from runs join tags on runs.run_uuid = tags.run_uuid where key = 'cell_key'"
        return Counter(status for (status,) in self.query(statement))

    def result_folders(self) -> dict[str, Path]:
        """Return the folder of each finished cell's result, by key. Fails when a key has two finished runs."""
        statement = "select value, artifact_uri from runs join tags on runs.run_uuid = tags.run_uuid"
        finished = self.query(f"{statement} where key = 'cell_key' and status = 'FINISHED'")
        assert len({key for key, _ in finished}) == len(finished), "a cell was committed twice"
        prefix = f"{self.files}/" if self.files else ""
        return {key: Path(uri.replace("mlflow-artifacts:/", prefix)) / "result" for key, uri in finished}

    def digests(self) -> dict[str, list[str]]:
        """Return digests of the arrays of each finished cell, by key."""
        return {
            key: [hashlib.sha256(file.read_bytes()).hexdigest() for file in sorted(folder.glob("*.safetensors"))]
            for key, folder in self.result_folders().items()
        }


def run_database(folder: Path) -> RunDatabase:
    """Return the database of a working folder."""
    return RunDatabase(folder / "mlruns/mlflow.db")
