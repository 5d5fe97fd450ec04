"""Who uses a data folder: commands that make or read its data share a lock, and `study.sweep clean` takes it alone."""

from __future__ import annotations

import fcntl
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from study.errors import BadInputError

LOCK = ".in-use"  # stays, so that two processes never lock different files


@contextmanager
def shared_use(data: Path, alone: Callable[[], None] = lambda: None) -> Iterator[None]:
    """Use a data folder beside others; `alone` is called before and after when no other command uses it."""
    data.mkdir(parents=True, exist_ok=True)
    with (data / LOCK).open("a") as lock:
        if _take(lock, fcntl.LOCK_EX):
            alone()
        if not _take(lock, fcntl.LOCK_SH):
            print(f"waiting for another command, which has {data} to itself", file=sys.stderr)
            fcntl.flock(lock, fcntl.LOCK_SH)
        yield
        if _take(lock, fcntl.LOCK_EX):
            alone()


@contextmanager
def sole_use(data: Path, *, wait: bool) -> Iterator[None]:
    """Have a data folder alone. Raises BadInputError while another command uses it, unless told to `wait`."""
    with (data / LOCK).open("a") as lock:
        if not _take(lock, fcntl.LOCK_EX):
            if not wait:
                raise BadInputError(
                    f"another command uses {data} (a sweep, train, verify or study.data); wait for it, or give --wait "
                    "to start when it ends"
                )
            print(f"waiting for another command, which uses {data}", file=sys.stderr)
            fcntl.flock(lock, fcntl.LOCK_EX)
        yield


def _take(lock: IO[str], kind: int) -> bool:
    """Return whether a lock could be had, or changed to this kind, at once."""
    try:
        fcntl.flock(lock, kind | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True
