"""The folders that the commands work in."""

from __future__ import annotations

from pathlib import Path

SWEEPS = Path("sweeps")
DEFAULT_TRACKING = "sqlite:///mlruns/mlflow.db"


DATA = Path("data")
REPORTS = Path("reports")
