"""Wait for room on a full disk, where the write failed: there, and for a bounded time."""

from __future__ import annotations

import shutil
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from study.config.workspace import HERE
from study.console.interrupts import check_stopped
from study.errors import full_place
from study.stages import RESULT_BYTES, duration_text, size_text

TRIES = 3
ROOM = 4 * RESULT_BYTES  # of free disk, from which a write is tried again [bytes]
PATIENCE = 1800.0  # [s] in which others may make room
PAUSES = 1.0, 60.0  # [s] before the first look at the disk, each doubled, and the longest
NAP = 0.5  # [s] between two looks at Ctrl-C

T = TypeVar("T")


def with_room(
    action: Callable[[], T], tell: Callable[[str, str], None] | None = None, *, into: Path | None = None
) -> T:
    """Do something that can be done again; when a disk is full, wait for room and do it again.

    `tell` hears before each look at the disk where room is missing and what is waited for; by default, stderr is told
    once. Where an error names no file, the disk is looked for among those of the data, the temporary files
    and `into`. When there is no room in PATIENCE, or none for this write after TRIES, its error is raised.
    """
    tell, pause, left = tell or _Once(), PAUSES[0], PATIENCE
    for number in range(TRIES):
        try:
            return action()
        except Exception as error:
            known = full_place(error)
            if known is None or number == TRIES - 1:
                raise
            place = known or _fullest(HERE.data, Path(tempfile.gettempdir()), *([into] if into else []))
            while left > 0:
                tell(place, _words(place))
                _sleep(min(pause, left))
                left, pause = left - pause, min(2 * pause, PAUSES[1])
                if _free(place) >= ROOM:
                    break
            else:
                raise
    raise AssertionError("the last try returns or raises")


class _Once:
    def __init__(self) -> None:
        self._told: set[str] = set()

    def __call__(self, place: str, words: str) -> None:
        if place not in self._told:
            print(words, file=sys.stderr, flush=True)
        self._told.add(place)


def _fullest(*folders: Path) -> str:
    """Return the folder with the least room."""
    return min((str(folder.absolute()) for folder in folders), key=_free)


def _words(place: str) -> str:
    free = _free(place)
    if free >= ROOM:
        return f"no room to write in {place}, where {size_text(free)} are free (has this user a quota?); trying again"
    return (
        f"no room to write in {place}: {size_text(free)} free, {size_text(ROOM)} are needed; waiting up to "
        f"{duration_text(PATIENCE)} for it"
    )


def _free(place: str) -> int:
    """Return the free bytes of the disk that a path lies on, whether the path exists or not."""
    path = Path(place).absolute()
    return shutil.disk_usage(next(each for each in (path, *path.parents) if each.exists())).free


def _sleep(seconds: float) -> None:
    deadline = time.monotonic() + seconds
    while (left := deadline - time.monotonic()) > 0:
        check_stopped()
        time.sleep(min(left, NAP))
