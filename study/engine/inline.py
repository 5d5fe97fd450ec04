"""The engine without processes: tasks run one after the other in this one."""

from __future__ import annotations

from collections import deque
from collections.abc import Collection
from functools import partial
from typing import Any, Self

from study.engine.tasks import Hear, perform
from study.stages import Task


class InlineEngine:
    """Runs tasks where `wait` is called, without Dask: for tests, and for machines with one GPU. See `Engine`."""

    def __init__(self) -> None:
        self._waiting: deque[tuple[int, Task]] = deque()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._waiting.clear()

    def slots(self) -> int:
        """Return 1."""
        return 1

    def gpus(self) -> int:
        """Return 0: a task finds its GPU itself."""
        return 0

    def submit(self, number: int, task: Task) -> None:
        """Queue the task; `wait` runs it."""
        self._waiting.append((number, task))

    def cancel(self, numbers: Collection[int]) -> None:
        """Drop queued tasks."""
        self._waiting = deque(entry for entry in self._waiting if entry[0] not in numbers)

    def wait(self, seconds: float, hear: Hear) -> list[tuple[int, Any]]:  # noqa: ARG002 - a task cannot be interrupted
        """Run the next task to its end."""
        if not self._waiting:
            return []
        number, task = self._waiting.popleft()
        return [(number, perform(task, partial(hear, number)))]
