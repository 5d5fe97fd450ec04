"""Gives every test a user, a working folder and the fixtures that several modules share."""

from __future__ import annotations

import os
import shutil
import signal
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from filelock import FileLock

ROOT = Path(__file__).parent.parent
MEMORY = Path("/dev/shm")  # noqa: S108 - pytest makes a folder of the user's own there
ROOM = 6 << 30  # bytes, of which about 2 GiB are used

# Tests send SIGINT to themselves and to programs that they start. A shell that runs the suite in the background ignores
# it, and every child would inherit that.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# Databases wait for the disk at every commit, and these tests commit by the thousand: their folders lie in memory where
# there is room. What a test must survive is a killed process, which needs no disk.
if MEMORY.is_dir() and shutil.disk_usage(MEMORY).free >= ROOM:
    os.environ.setdefault("PYTEST_DEBUG_TEMPROOT", str(MEMORY))

# Nothing of the user is read or written: tests, and the programs that they start, have a home of their own. Matplotlib
# and MLflow look for it as soon as they are loaded, so this cannot be a fixture.
SANDBOX = Path(tempfile.mkdtemp(prefix="study-tests-", dir=os.environ.get("PYTEST_DEBUG_TEMPROOT")))
for name in [name for name in os.environ if name.startswith(("XDG_", "MPL", "MLFLOW_", "GIT_"))]:
    del os.environ[name]
os.environ |= {"HOME": str(SANDBOX), "PYTHONPATH": str(ROOT)}
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)  # a hundred programs start: each would compile the study again

# Tests that run side by side use one core each: threads that wait actively for each other take ten times as long.
if "PYTEST_XDIST_WORKER" in os.environ:
    os.environ["OMP_NUM_THREADS"] = "1"

# The study loads matplotlib and MLflow, which takes seconds: each fixture imports what it needs, after this is set.
if TYPE_CHECKING:
    from tests.support.sweeps import UndisturbedSweep


def pytest_unconfigure() -> None:
    """Remove the home."""
    shutil.rmtree(SANDBOX, ignore_errors=True)


@pytest.fixture(scope="session", autouse=True)
def _working_folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Run all tests in a working folder of their own; fails when one of them has left something there."""
    folder, before = tmp_path_factory.mktemp("work"), Path.cwd()
    shutil.copytree(ROOT / "sweeps", folder / "sweeps")
    os.chdir(folder)
    yield
    os.chdir(before)
    assert [path.name for path in folder.iterdir()] == ["sweeps"]


@pytest.fixture(scope="session")
def small_drives(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Return three drives for encoders, then three for policies."""
    from tests.support.drives import write_drives

    folder = tmp_path_factory.mktemp("drives")
    return write_drives(folder / "a", 3) + write_drives(folder / "b", 3, first_seed=10)


@pytest.fixture(scope="session")
def small_store(small_drives: list[Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of a frame store of those drives; cards and previews may be written there."""
    from study.config.settings import BirdviewSettings, FramesSettings
    from study.data.build import frames_flow
    from study.engine.flows import run_flow

    folder = tmp_path_factory.mktemp("frames") / "store"
    settings = FramesSettings(encoder=60, policy=40)
    run_flow(frames_flow(settings, BirdviewSettings(), small_drives[:3], small_drives[3:], folder))
    return folder


@pytest.fixture(scope="session")
def empty_store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a database file with MLflow's empty tables: making them takes seconds, copying the file nothing."""
    from study.tracking.experiment import create_database

    path = tmp_path_factory.mktemp("empty") / "mlflow.db"
    create_database(path)
    return path


@pytest.fixture(scope="session")
def undisturbed(empty_store: Path, tmp_path_factory: pytest.TempPathFactory) -> UndisturbedSweep:
    """Return a finished sweep of four cells, to copy and to compare with; processes that test side by side share it."""
    from tests.support.sweeps import UndisturbedSweep

    base = tmp_path_factory.getbasetemp()
    folder = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "undisturbed"
    with FileLock(f"{folder}.lock"):
        return UndisturbedSweep.run(folder, empty_store)
