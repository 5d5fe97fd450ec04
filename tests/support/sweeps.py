"""Runs a sweep that takes seconds, and compares disturbed sweeps with it."""

from __future__ import annotations

import shutil
import time
from dataclasses import dataclass
from pathlib import Path

import pandas as pd
import pytest

from study.engine.inline import InlineEngine
from study.sweep import run
from study.sweep.__main__ import main
from study.tracking.reader import Reader
from tests.support.processes import ROOT
from tests.support.run_database import RunDatabase, run_database

LOCKS = (".lock", ".in-use", ".mlflow.db.lock")  # stay, so that two processes never hold different files

# Every stage for real, in a few seconds. The files of a profile are read from the working folder.
TINY_PROFILE = """\
town: {rows: 3, columns: 3, dropped_edges: 0, vehicles: 12}
recording: {warm_up: 1, duration: 6, encoder_episodes: 2, policy_episodes: 2}
frames: {encoder: 40, policy: 40}
encoder: {epochs: 3, batch: 16}
policy: {epochs: 5, batch: 16}
driving: {drives: 2, unseen_towns: 0, duration: 1, baseline_policies: 2}
"""
TINY_SWEEP = ("heads", "--profile", "tiny", "--policy_seeds", "2")
FOUR_CELLS = (*TINY_SWEEP, "--baselines", "[]", "--workers", "2")
SECONDS = 14.0  # of FOUR_CELLS in one process, without report, on an idle machine, in memory


def working_folder(folder: Path) -> Path:
    """Prepare a folder to run sweeps in."""
    shutil.copytree(ROOT / "sweeps", folder / "sweeps")
    (folder / "sweeps/profiles/tiny.yaml").write_text(TINY_PROFILE)
    return folder


@dataclass(frozen=True)
class UndisturbedSweep:
    """Holds a working folder in which `FOUR_CELLS` has run undisturbed."""

    folder: Path
    slowdown: float  # of this machine against two idle cores, at least 1
    empty_store: Path

    @classmethod
    def run(cls, folder: Path, empty_store: Path) -> UndisturbedSweep:
        """Run the sweep, unless it has run in this folder."""
        slowdown = folder / "slowdown"
        if slowdown.exists():
            return cls(folder, float(slowdown.read_text()), empty_store)
        working_folder(folder)
        start = time.monotonic()
        with pytest.MonkeyPatch.context() as monkeypatch:
            assert sweep_here(folder, monkeypatch, *FOUR_CELLS, "--no-report") == 0
        assert len(run_database(folder).digests()) == 4
        assert leftovers(folder) == []
        slowdown.write_text(str(max(1.0, (time.monotonic() - start) / SECONDS)))
        return cls.run(folder, empty_store)

    def copy(self, folder: Path) -> Path:
        """Prepare another working folder with the same drives and frames and an empty store: nothing is trained."""
        working_folder(folder)
        for name in ("data/episodes", "data/frames"):
            shutil.copytree(self.folder / name, folder / name)
        (folder / "mlruns").mkdir()
        shutil.copy(self.empty_store, folder / "mlruns/mlflow.db")
        return folder


def sweep_here(folder: Path, monkeypatch: pytest.MonkeyPatch, *words: str) -> int:
    """Run a sweep in this process, without Dask, which starts no further process; return its exit code."""
    monkeypatch.chdir(folder)
    monkeypatch.setattr(run, "start_engine", lambda *_: InlineEngine())
    return main(words)


def leftovers(folder: Path) -> list[str]:
    """Return drafts, hidden files and uncollected results, which a finished sweep should not leave."""
    paths = [path for name in ("data", "mlruns", "reports") for path in (folder / name).rglob("*")]
    drafts = [path for path in paths if path.name[0] == "." and path.name not in LOCKS]
    uncollected = [path for path in paths if path.parent.name in ("parts", "tmp") or path.name.startswith("policies-")]
    return [str(path.relative_to(folder)) for path in drafts + uncollected]


def assert_same_outcome(folder: Path, undisturbed: Path, database: RunDatabase | None = None) -> None:
    """Fail unless a disturbed sweep ended like the undisturbed one: each cell once, nothing doubled or left behind.

    The disturbed sweep may have some of the cells only, and its runs in another `database`.
    """
    database = database or run_database(folder)
    doubled = "select run_uuid, key, step from metrics group by run_uuid, key, step having count(*) > 1"
    assert database.query("select run_uuid from runs where status = 'RUNNING'") == []
    assert database.query(doubled) == []
    curves = pd.read_parquet(folder / "reports/heads/curves.parquet")
    expected = Reader.look(f"sqlite:///{undisturbed}/mlruns/mlflow.db").read_sweep("heads").table(baselines=True)
    cells = curves[["heads", "encoder_seed"]].drop_duplicates()
    digests = database.digests()
    assert len(digests) == len(cells) >= 2
    assert digests.items() <= run_database(undisturbed).digests().items()
    pd.testing.assert_frame_equal(curves, expected.merge(cells), check_exact=True)
    assert (folder / "reports/heads.pdf").read_bytes().startswith(b"%PDF")
    assert leftovers(folder) == []
