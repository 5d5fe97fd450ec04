"""The folders that the commands work in."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Workspace:
    """Name the folders of a study; relative ones start at the current folder, here and in every worker."""

    data: Path = Path("data")
    mlruns: Path = Path("mlruns")
    reports: Path = Path("reports")
    sweeps: Path = Path("sweeps")

    @property
    def tmp(self) -> Path:
        """Return the folder of temporary files, whose content no later command needs."""
        return self.data / "tmp"

    @property
    def profiles(self) -> Path:
        """Return the folder of profiles."""
        return self.sweeps / "profiles"

    @property
    def tracking(self) -> str:
        """Return the URI of the MLflow store that is used when no other is named."""
        return f"sqlite:///{self.mlruns / 'mlflow.db'}"


HERE = Workspace()
