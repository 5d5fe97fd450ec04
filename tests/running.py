"""Sweeps as users run them: whole commands, in working folders of their own, on a study that takes seconds."""

from __future__ import annotations

import hashlib
import os
import shutil
import signal
import sqlite3
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable
from contextlib import closing, suppress
from dataclasses import dataclass
from pathlib import Path

import pandas as pd
import pytest

ROOT = Path(__file__).parent.parent
PATIENCE = 900.0  # [s] for anything to happen: a busy machine is slow, and no test here measures speed
LOCKS = (".lock", ".in-use", ".mlflow.db.lock")  # stay, so that two processes never hold different files

# Every stage for real, in a few seconds. The files of a profile are read from the working folder.
TINY = """\
town: {rows: 3, columns: 3, dropped_edges: 0, vehicles: 12}
recording: {warm_up: 1, duration: 6, encoder_episodes: 2, policy_episodes: 2}
frames: {encoder: 40, policy: 40}
encoder: {epochs: 3, batch: 16}
policy: {epochs: 5, batch: 16}
"""
PLAN = ("heads", "--profile", "tiny", "--policy_seeds", "2")
FOUR = (*PLAN, "--ceiling", "false", "--workers", "2")
QUIET_SECONDS = 20.0  # of FOUR on two quiet cores, in memory


def working_folder(folder: Path) -> Path:
    """A folder to run sweeps in."""
    shutil.copytree(ROOT / "sweeps", folder / "sweeps")
    (folder / "sweeps/profiles/tiny.yaml").write_text(TINY)
    return folder


@dataclass(frozen=True)
class Quiet:
    """A working folder in which all four cells of `FOUR` have run undisturbed, and how slow the machine is just now."""

    folder: Path
    pace: float  # 1 on two quiet cores, more on a busy machine
    empty: Path  # an empty store

    def copy(self, folder: Path) -> Path:
        """Another working folder, with the drives and frames of this one and an empty store: nothing is trained."""
        working_folder(folder)
        for name in ("data/episodes", "data/frames"):
            shutil.copytree(self.folder / name, folder / name)
        (folder / "mlruns").mkdir()
        shutil.copy(self.empty, folder / "mlruns/mlflow.db")
        return folder


@pytest.fixture(scope="session")
def quiet(empty_store: Path, tmp_path_factory: pytest.TempPathFactory) -> Quiet:
    folder = working_folder(tmp_path_factory.mktemp("quiet"))
    began = time.monotonic()
    run = Running(folder, *command(*FOUR))
    assert run.end() == 0, run.said
    assert len(store(folder).results()) == 4
    assert leftovers(folder) == []
    return Quiet(folder, max(1.0, (time.monotonic() - began) / QUIET_SECONDS), empty_store)


def command(*words: str) -> list[str]:
    return [sys.executable, "-m", "study.sweep", *words]


def environment(**more: str) -> dict[str, str]:
    return os.environ | {"PYTHONPATH": str(ROOT)} | more


def sweep(folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    """Run a sweep to its end."""
    return subprocess.run(command(*words), cwd=folder, capture_output=True, text=True, check=False, env=environment())


class Running:
    """A command that runs in a session of its own, as one that a terminal has started; stderr goes to a file."""

    def __init__(self, folder: Path, *words: str, log: Path | None = None, role: str = "client", **more: str) -> None:
        self.folder, self.log, self.role = folder, log or folder / "log", role
        with self.log.open("ab") as stream:
            self._from = stream.tell()
            self.process = subprocess.Popen(
                words, cwd=folder, stdout=stream, stderr=stream, start_new_session=True, env=environment(**more)
            )

    @property
    def said(self) -> str:
        """What it has written so far."""
        with self.log.open("rb") as log:
            log.seek(self._from)
            return log.read().decode(errors="replace")

    @property
    def running(self) -> bool:
        return self.process.poll() is None

    def until(self, sign: Callable[[], object]) -> bool:
        """Wait for a sign. False: the command ended before."""
        deadline = time.monotonic() + PATIENCE
        while self.running:
            if sign():
                return True
            assert time.monotonic() < deadline, f"no sign for {PATIENCE:.0f} s:\n{self.said}"
            time.sleep(0.05)
        return False

    def end(self) -> int:
        """Wait for its end, and for that of all it has started; its exit code."""
        code = self.process.wait(PATIENCE)
        deadline = time.monotonic() + PATIENCE
        while self.family():
            assert time.monotonic() < deadline, f"left behind: {self.family()}"
            time.sleep(0.01)
        return code

    def family(self) -> dict[int, str]:
        """Process id -> role of each process of the session: client, worker, scheduler, nanny, or other."""
        known = {}
        for path in Path("/proc").glob("[0-9]*"):
            with suppress(OSError):  # ended meanwhile
                fields = (path / "stat").read_text().rpartition(")")[2].split()
                if fields[3] == str(self.process.pid) and fields[0] not in "ZX":
                    known[int(path.name)] = (path / "cmdline").read_text(errors="replace")
        roles = {}
        for pid, words in known.items():
            if pid == self.process.pid:
                roles[pid] = self.role
            else:
                roles[pid] = "worker" if "spawn_main" in words else "other"
        return roles

    def of(self, role: str) -> list[int]:
        return [pid for pid, own in self.family().items() if own == role]

    def send(self, signal_: signal.Signals, *pids: int) -> int:
        """Send a signal; how many were still there to get it."""
        sent = 0
        for pid in pids:
            try:
                os.kill(pid, signal_)
            except ProcessLookupError:
                continue
            sent += 1
        return sent


@dataclass(frozen=True)
class Store:
    """What MLflow has stored, read past it: `database` is a SQLite file, `files` a server's artifacts."""

    database: Path
    files: Path | None = None

    def ask(self, query: str) -> list[tuple[str, ...]]:
        if not self.database.is_file():
            return []
        # Opened for writing: SQLite undoes what a killed process has left half written before anyone can read.
        with closing(sqlite3.connect(f"file:{self.database}?mode=rw", uri=True, timeout=60)) as database:
            return database.execute(query).fetchall()

    def cells(self) -> Counter[str]:
        """How many runs of cells there are, by status."""
        query = "select status from runs join tags on runs.run_uuid = tags.run_uuid where key = 'cell_key'"
        return Counter(status for (status,) in self.ask(query))

    def folders(self) -> dict[str, Path]:
        """Where the result of each finished cell lies, by key. Fails when a key has two finished runs."""
        query = "select value, artifact_uri from runs join tags on runs.run_uuid = tags.run_uuid"
        finished = self.ask(f"{query} where key = 'cell_key' and status = 'FINISHED'")
        assert len({key for key, _ in finished}) == len(finished), "a cell was committed twice"
        at = f"{self.files}/" if self.files else ""
        return {key: Path(uri.replace("mlflow-artifacts:/", at)) / "result" for key, uri in finished}

    def results(self) -> dict[str, list[str]]:
        """Digests of the arrays of each finished cell, by key."""
        return {
            key: [hashlib.sha256(file.read_bytes()).hexdigest() for file in sorted(folder.glob("*.safetensors"))]
            for key, folder in self.folders().items()
        }


def store(folder: Path) -> Store:
    """The store of a working folder."""
    return Store(folder / "mlruns/mlflow.db")


def leftovers(folder: Path) -> list[str]:
    """Drafts and hidden files that a finished sweep should not leave, and results that were not taken."""
    found = [path for name in ("data", "mlruns", "reports") for path in (folder / name).rglob("*")]
    drafts = [path for path in found if path.name[0] == "." and path.name not in LOCKS]
    waiting = [path for path in found if path.parent.name in ("parts", "tmp") or path.name.startswith("policies-")]
    return [str(path.relative_to(folder)) for path in drafts + waiting]


def check_like(folder: Path, quiet: Path, kept: Store | None = None) -> None:
    """A disturbed sweep has ended like the undisturbed one: every cell once, nothing doubled, nothing left behind.

    It may have had some of the other's cells only, and have `kept` its results elsewhere.
    """
    kept = kept or store(folder)
    assert kept.ask("select run_uuid from runs where status = 'RUNNING'") == []
    assert kept.ask("select run_uuid, key, step from metrics group by run_uuid, key, step having count(*) > 1") == []
    ours, theirs = (pd.read_parquet(at / "reports/heads/curves.parquet") for at in (folder, quiet))
    cells = ours[["heads", "encoder_seed"]].drop_duplicates()
    found = kept.results()
    assert len(found) == len(cells) >= 2
    assert found.items() <= store(quiet).results().items()
    pd.testing.assert_frame_equal(ours, theirs.merge(cells), check_exact=True)
    assert (folder / "reports/heads.pdf").read_bytes().startswith(b"%PDF")
    assert leftovers(folder) == []
