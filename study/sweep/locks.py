"""What keeps commands apart that write to one tracking store, or work in one data folder."""

from __future__ import annotations

import json
import os
import shutil
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from filelock import FileLock, Timeout

from study.config.workspace import Workspace
from study.data.in_use import shared_use
from study.errors import BadInputError, masked
from study.tracking.experiment import database_file


def store_folder(workspace: Workspace, tracking: str) -> Path:
    """Return where the lock and Optuna's file of a tracking store lie: beside a database file, else in mlruns/."""
    database = database_file(tracking)
    return database.parent if database else workspace.mlruns


@contextmanager
def hold_store(workspace: Workspace, tracking: str, holder: str, *, wait: bool) -> Iterator[None]:
    """Hold a tracking store for one writer at a time; `holder` is its name for those who come meanwhile.

    Raises BadInputError that says who holds it, unless told to `wait`.
    """
    folder = store_folder(workspace, tracking)
    folder.mkdir(parents=True, exist_ok=True)
    lock, note = FileLock(folder / "sweep.lock"), folder / "sweep.json"
    try:
        lock.acquire(blocking=False)
    except Timeout:
        who = "another sweep"
        with suppress(OSError, ValueError, KeyError):  # it has not written its name yet
            other = json.loads(note.read_text(encoding="utf-8"))
            who = f"another {other['holder']} (process {other['process']}),"
        if not wait:
            raise BadInputError(
                f"{who} runs on this store ({masked(tracking)}); wait for it, or give --wait to start when it ends"
            ) from None
        print(f"waiting for {who} which runs on this store", file=sys.stderr)
        lock.acquire()
    try:
        note.write_text(json.dumps({"holder": holder, "process": os.getpid()}), encoding="utf-8")
        yield
    finally:
        note.unlink(missing_ok=True)
        lock.release()


@contextmanager
def temporary_folder(workspace: Workspace) -> Iterator[None]:
    """Have this process put its temporary files into the workspace, where the next sweep removes what a kill leaves."""
    folder = workspace.tmp
    folder.mkdir(parents=True, exist_ok=True)
    before = tempfile.tempdir
    with shared_use(workspace.data, lambda: _empty(folder)):
        tempfile.tempdir = str(folder.absolute())
        try:
            yield
        finally:
            tempfile.tempdir = before


def _empty(folder: Path) -> None:
    for path in folder.iterdir():
        shutil.rmtree(path, ignore_errors=True) if path.is_dir() else path.unlink(missing_ok=True)
