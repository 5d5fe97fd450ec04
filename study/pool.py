"""Child processes for the data stages: many small tasks on all cores, results as they come.

A child that is killed (by hand, or for its memory) is replaced, and its task is done again.
"""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from types import TracebackType
from typing import Any, Self

from study.command import check_stopped, deaf_to_interrupts, obey_parent
from study.config import BadInputError

TRIES = 5  # with not one task finished in between


class Pool:
    """Runs tasks in `processes` children, or, when that is 1, in this process. The children start with the first task.

    Leaving it by an exception, such as Ctrl-C, kills what still runs: tasks write whole things or nothing.
    """

    def __init__(self, processes: int) -> None:
        self._processes = processes
        self._executor: ProcessPoolExecutor | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._end(kill=kind is not None)

    def results(self, function: Callable[..., Any], tasks: Sequence[tuple[Any, ...]]) -> Iterator[tuple[int, Any]]:
        """Task number and result, as they are finished. Raises BadInputError when children are killed on and on."""
        if self._processes < 2:
            for number, task in enumerate(tasks):
                yield number, function(*task)
            return
        left = dict(enumerate(tasks))
        tries = TRIES
        while left:
            futures = self._submit(function, left)
            tries -= 1
            for future in as_completed(futures):
                check_stopped()
                try:
                    result = future.result()
                except BrokenProcessPool:  # each that is not done says so
                    continue
                number = futures.pop(future)
                del left[number]
                tries = TRIES
                yield number, result
            if left:
                self._end(kill=True)
            if left and not tries:
                raise BadInputError(
                    f"the processes that make the data were killed {TRIES} times in a row; is memory short? "
                    "Close other programs, or run study.data build --processes 1, then give the same command again"
                )

    def _submit(self, function: Callable[..., Any], tasks: dict[int, tuple[Any, ...]]) -> dict[Any, int]:
        with deaf_to_interrupts():
            if self._executor is None:
                # A fork would copy the threads' locks of torch and pyarrow.
                context = multiprocessing.get_context("spawn")
                self._executor = ProcessPoolExecutor(self._processes, mp_context=context, initializer=obey_parent)
            futures: dict[Any, int] = {}
            for number, task in tasks.items():
                try:
                    futures[self._executor.submit(function, *task)] = number
                except BrokenProcessPool:  # the first children are gone already
                    break
            return futures

    def _end(self, *, kill: bool) -> None:
        executor, self._executor = self._executor, None
        if executor is None:
            return
        for process in list((executor._processes or {}).values()) if kill else ():  # noqa: SLF001 - see below
            process.kill()  # Python 3.14 has kill_workers() for it; to wait for their tasks may take a minute
        executor.shutdown(cancel_futures=True)
