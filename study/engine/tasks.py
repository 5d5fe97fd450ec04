"""One task, wherever it runs: what it reports, and which failures another try may mend."""

from __future__ import annotations

import os
import platform
import traceback
from collections.abc import Callable, Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from study.errors import WRITE_ERRORS, BadInputError, TrainingDivergedError, cannot_write
from study.stages import Task

NO_MEMORY = ("out of memory", "can't allocate memory")  # torch says so in RuntimeErrors, GPUs and CPUs each

Hear = Callable[..., None]  # hear(number of the task, kind of event, *values)


@dataclass(frozen=True)
class Failure:
    """Why a task failed.

    `transient`: another try may succeed; `exhausted`: the engine has tried often enough for now; `expected`: the reason
    is one clear message.
    """

    reason: str
    transient: bool
    exhausted: bool = False
    expected: bool = True


class Engine(Protocol):
    """What runs tasks. Use it as a context; leaving it on Ctrl-C does not wait for what still runs."""

    def slots(self) -> int:
        """Return how many tasks can run at a time, just now."""

    def gpus(self) -> int:
        """Return how many accelerated tasks can run at a time, just now; 0: they run like any other."""

    def submit(self, number: int, task: Task) -> None:
        """Run the task, soon, under a number of the caller's."""

    def cancel(self, numbers: Collection[int]) -> None:
        """Give up tasks whose results are not needed any more, where that is possible."""

    def wait(self, seconds: float, hear: Hear) -> list[tuple[int, Any]]:
        """Return the number and the value, or Failure, of each task that has ended since; wait for one this long.

        Meanwhile, `hear` is called with what running tasks report.
        """


def perform(task: Task, report: Callable[..., None]) -> Any:
    """Run a task in this process and return its value, or a Failure."""
    report("start", platform.node(), os.getpid())
    try:
        return task.function(*task.args, *([report] if task.reports else []))
    except Exception as error:  # noqa: BLE001 - whatever it is belongs to this task, and the others go on
        return failure_of(error)


def failure_of(error: Exception) -> Failure:
    """Return what an exception means: whether another try may succeed, and the reason, a traceback where need be."""
    if isinstance(error, BadInputError | TrainingDivergedError):
        return Failure(str(error), transient=False)
    if isinstance(error, OSError) and error.errno in WRITE_ERRORS:
        return Failure(cannot_write(Path(error.filename or "a file"), error), transient=True)
    transient = isinstance(error, OSError | MemoryError) or (
        isinstance(error, RuntimeError) and any(words in str(error).lower() for words in NO_MEMORY)
    )
    return Failure("".join(traceback.format_exception(error)), transient, expected=False)
