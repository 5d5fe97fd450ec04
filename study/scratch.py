"""What a killed process leaves in the data folder, and how it is swept.

Each process that trains cells there holds a lock, shared with the others; whoever is alone removes drafts, temporary
files, and results that were trained but are committed since. What carries a key stays: drives, frames, encoders.
"""

from __future__ import annotations

import fcntl
import multiprocessing.util
import shutil
import tempfile
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from pathlib import Path

TEMPORARY = "tmp"


@contextmanager
def using(scratch: Path, finished: Callable[[list[str]], Collection[str]]) -> Iterator[None]:
    """Work in a data folder: swept before and after, when nobody else works there.

    `finished` tells which of some cell keys are committed.
    """
    (scratch / TEMPORARY).mkdir(parents=True, exist_ok=True)
    with (scratch / ".in-use").open("w") as lock:
        _sweep(lock.fileno(), scratch, finished)
        yield
        _sweep(lock.fileno(), scratch, finished)


@contextmanager
def temporary_files(scratch: Path) -> Iterator[None]:
    """Have this process put its temporary files into the data folder, where `using` finds what a kill leaves."""
    multiprocessing.util.get_temp_dir()  # holds sockets, whose paths must be short: it stays where it would be
    before, tempfile.tempdir = tempfile.tempdir, str(scratch.absolute() / TEMPORARY)
    try:
        yield
    finally:
        tempfile.tempdir = before


def _sweep(lock: int, scratch: Path, finished: Callable[[list[str]], Collection[str]]) -> None:
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:  # somebody else works here
        fcntl.flock(lock, fcntl.LOCK_SH)
        return
    results = scratch / "cells"
    there = [path.name for path in results.glob("[!.]*")]
    committed = finished(there) if there else ()
    for path in (
        *(scratch / TEMPORARY).iterdir(),
        *results.glob(".*"),
        *(scratch / "encoders").glob(".*"),
        *(results / key for key in committed),
    ):
        if path.is_dir():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)
    fcntl.flock(lock, fcntl.LOCK_SH)
