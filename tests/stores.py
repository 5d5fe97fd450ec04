"""Stores made once for all tests: small frames with their drives to look at, an empty MLflow store to copy."""

from __future__ import annotations

from pathlib import Path

import pytest

from drives import write_drives
from study.config.settings import BirdviewSettings, FramesSettings
from study.data.build import frames_flow
from study.engine.flows import run_flow
from study.tracking.store import SQLITE, open_store


@pytest.fixture(scope="session")
def small_drives(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Three drives for encoders, then three for policies."""
    made = tmp_path_factory.mktemp("drives")
    return write_drives(made / "a", 3) + write_drives(made / "b", 3, first_seed=10)


@pytest.fixture(scope="session")
def small_store(small_drives: list[Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a frame store of those drives; cards and previews may be written there."""
    made = tmp_path_factory.mktemp("frames") / "store"
    settings = FramesSettings(encoder=60, policy=40)
    run_flow(frames_flow(settings, BirdviewSettings(), small_drives[:3], small_drives[3:], made))
    return made


@pytest.fixture(scope="session")
def empty_store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A database file with MLflow's tables and nothing in them: making them takes seconds, copying them nothing."""
    made = tmp_path_factory.mktemp("empty") / "mlflow.db"
    open_store(f"{SQLITE}{made}")
    return made
