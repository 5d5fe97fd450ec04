"""Run one task on any engine; tell transient failures from permanent ones."""

from __future__ import annotations

import os
import pkgutil
import platform
import traceback
from collections.abc import Callable, Collection
from dataclasses import dataclass
from typing import Any, Protocol

from study.engine.room import with_room
from study.errors import BadInputError, TrainingDivergedError, full_place, write_failure
from study.stages import Task

NO_MEMORY = ("out of memory", "can't allocate memory")  # in torch's RuntimeErrors of GPUs and CPUs

Hear = Callable[..., None]  # hear(number of the task, kind of event, *values)


@dataclass(frozen=True)
class Failure:
    """Why a task failed.

    `transient`: another try may succeed; `exhausted`: the engine has tried often enough; `expected`: the reason is one
    clear message, else a traceback.
    """

    reason: str
    transient: bool
    exhausted: bool = False
    expected: bool = True


class Engine(Protocol):
    """What runs tasks. Use it as a context; leaving it on Ctrl-C does not wait for running tasks."""

    def slots(self) -> int:
        """Return how many tasks can run at a time at this moment."""

    def gpus(self) -> int:
        """Return how many accelerated tasks can run at a time; 0: they run like any other."""

    def submit(self, number: int, task: Task) -> None:
        """Queue the task under a number that the caller chooses."""

    def cancel(self, numbers: Collection[int]) -> None:
        """Give up tasks whose results are not needed, where that is possible."""

    def wait(self, seconds: float, hear: Hear) -> list[tuple[int, Any]]:
        """Wait up to `seconds` for tasks to end, and return the number and the value, or Failure, of each.

        Meanwhile, call `hear` with what running tasks report.
        """


def perform(task: Task, report: Callable[..., None]) -> Any:
    """Run a task in this process and return its value, or a Failure. Where a disk is full, wait for room."""
    report("start", platform.node(), os.getpid())
    try:
        function = pkgutil.resolve_name(task.function) if isinstance(task.function, str) else task.function
        arguments = [*task.args, *([report] if task.reports else [])]
        return with_room(lambda: function(*arguments), lambda *words: report("room", *words))
    except Exception as error:  # noqa: BLE001 - any error is this task's, and the others go on
        return failure_of(error)


def failure_of(error: Exception) -> Failure:
    """Return what an exception means: whether another try may succeed, and the reason."""
    problem, full = write_failure(error), full_place(error) is not None  # room was waited for
    if isinstance(error, BadInputError | TrainingDivergedError):
        return Failure(str(error), transient=problem is not None, exhausted=full)
    if problem:
        return Failure(problem, transient=True, exhausted=full)
    no_memory = isinstance(error, RuntimeError) and any(words in str(error).lower() for words in NO_MEMORY)
    transient = isinstance(error, OSError | MemoryError) or no_memory
    return Failure("".join(traceback.format_exception(error)), transient, expected=False)
