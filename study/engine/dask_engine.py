"""The engine of Dask distributed, which supervises every process of a study.

Workers that die are restarted, and their tasks run again. Each task computes in one thread of one worker, so results do
not depend on how many workers there are. Workers exit when this process does.
"""

from __future__ import annotations

import logging
import os
import pickle
import sys
import time
import uuid
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any, Self

import cloudpickle  # comes with dask
import dask
from distributed import CancelledError, Client, Future, KilledWorker, get_worker

from study.console.interrupts import check_stopped
from study.engine.flows import WAIT
from study.engine.room import TRIES
from study.engine.tasks import Failure, Hear, perform
from study.errors import BadInputError
from study.stages import Task

SIZE = 5.0  # [s] between two looks at how many workers there are
SET_BACK = 5.0  # [s] by which this machine's clock may be set back while tasks run
GPU = "GPU"  # the resource that a worker with a GPU has one of
CONFIGURATION = {
    "distributed.scheduler.allowed-failures": TRIES - 1,  # deaths of a worker with a task, before the task is given up
    "distributed.scheduler.worker-saturation": 1.0,
    "distributed.deploy.lost-worker-timeout": "2 minutes",  # a busy machine restarts a worker slowly
    "distributed.worker.daemon": False,
    "distributed.worker.memory.target": False,
    "distributed.worker.memory.spill": False,
    "distributed.worker.memory.pause": False,
    "distributed.worker.memory.terminate": False,
    "distributed.worker.profile.enabled": False,
    "distributed.admin.large-graph-warning-threshold": "1GB",  # latents travel as arguments
    "distributed.admin.tick.limit": "1h",  # a busy machine is no reason to warn
}


class EngineLostError(BadInputError):
    """The scheduler is gone; with a new one, the same command resumes."""


class DaskEngine:
    """Runs tasks on the workers of a Dask scheduler. See `Engine`."""

    def __init__(
        self, client: Client, address: str, cluster: Any = None, renew: Callable[[], object] | None = None
    ) -> None:
        """Take a connected client, and the cluster that was started for it; `renew` replaces workers that were lost."""
        self._client, self._address, self._cluster, self._renew = client, address, cluster, renew
        self._topic = f"study-{uuid.uuid4().hex}"
        self._futures: dict[int, Future[Any]] = {}
        self._messages: SimpleQueue[tuple[str, int, Any]] = SimpleQueue()
        self._looked, self._slots, self._gpus = 0.0, 0, 0
        self._clock = time.time() - time.monotonic()
        client.subscribe_topic(self._topic, self._take_event)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is None:  # else the process is about to exit, and its workers with it: closing would wait for them
            with suppress(OSError, TimeoutError):
                self._client.close()
                if self._cluster is not None:
                    self._cluster.close()

    def _take_event(self, event: tuple[float, tuple[int, tuple[Any, ...]]]) -> None:
        number, values = event[1]
        self._messages.put(("event", number, values))

    def _look(self) -> None:
        """Count the workers, every SIZE seconds."""
        if time.monotonic() - self._looked > SIZE or not self._slots:
            with self._lost():
                workers = self._client.scheduler_info(n_workers=-1).get("workers")
            if workers is None:
                raise self._gone()
            workers = workers.values()
            # Never fewer than there were: while a GPU's worker restarts, its tasks must not go to a CPU.
            self._gpus = max(self._gpus, int(sum(worker["resources"].get(GPU, 0) for worker in workers)))
            # Workers with a GPU train there, and leave the other tasks to workers without, if there are any.
            plain = sum(worker["nthreads"] for worker in workers if not worker["resources"].get(GPU))
            self._slots = plain or sum(worker["nthreads"] for worker in workers)
            self._looked = time.monotonic()
            if self._renew:
                self._renew()

    def slots(self) -> int:
        """Return how many tasks can run at a time at this moment; 1 while there is no worker yet."""
        self._look()
        return max(1, self._slots)

    def gpus(self) -> int:
        """Return how many GPUs the workers have had at most."""
        self._look()
        return self._gpus

    def workers_see(self, file: Path) -> bool:
        """Wait for a worker, and return whether all workers find this file under this path, as in a shared folder."""
        self._look()
        if not self._slots:
            print(f"waiting for a worker to come to the scheduler at {self._address}", file=sys.stderr, flush=True)
        while not self._slots:
            time.sleep(WAIT)
            check_stopped()
            self._look()
        name = str(file)  # a lambda travels by value: workers may lack this program, which the first task tells
        with self._lost():
            seen = self._client.run(lambda: os.path.isfile(name))  # noqa: PTH113
        return bool(seen) and all(seen.values())

    def submit(self, number: int, task: Task) -> None:
        """Hand the task to the scheduler."""
        with self._lost():
            future = self._client.submit(
                _UNPACKED,
                cloudpickle.dumps(partial(_run_on_worker, self._topic, number, task)),
                key=f"{task.stage.name}-{uuid.uuid4().hex}",
                pure=False,
                priority=-number,
                resources={GPU: 1} if task.accelerated and self._gpus else None,
            )
        self._futures[number] = future
        future.add_done_callback(lambda _: self._messages.put(("end", number, None)))

    def cancel(self, numbers: Collection[int]) -> None:
        """Forget tasks: queued ones are dropped, running ones end at their next report."""
        for number in numbers:
            self._futures.pop(number, None)  # Dask releases what nobody holds

    def wait(self, seconds: float, hear: Hear) -> list[tuple[int, Any]]:
        """Return the tasks that have ended; see `Engine`. Raises EngineLostError when the scheduler is gone."""
        self._check_clock()
        ended: list[tuple[int, Any]] = []
        deadline = time.monotonic() + seconds
        while not ended or not self._messages.empty():
            try:
                kind, number, values = self._messages.get(timeout=max(0.0, deadline - time.monotonic()))
            except Empty:
                break
            if kind == "event":
                hear(number, *values)
            elif (future := self._futures.pop(number, None)) is not None:
                ended.append((number, self._value(future)))
        if self._client.status != "running":  # its tasks are lost, even if it connects again
            raise self._gone()
        return ended

    def _check_clock(self) -> None:
        """Raise EngineLostError when the clock was set back: Dask's messages may wait until it has caught up."""
        before, self._clock = self._clock, time.time() - time.monotonic()
        if before - self._clock > SET_BACK:
            raise EngineLostError(
                f"this machine's clock was set back by {before - self._clock:.0f} s, which stops messages between "
                "processes; nothing that was finished is lost: give the same command again"
            )

    def _value(self, future: Future[Any]) -> Any:
        try:
            return future.result()
        except KilledWorker:
            reason = f"the process that ran it was killed {TRIES} times; is memory short?"
            return Failure(reason, transient=True, exhausted=True)
        except CancelledError:
            raise self._gone() from None
        except Exception as error:  # noqa: BLE001 - the task could not even start, for want of a package or so
            step = "; install this program and requirements.lock on every worker"
            text = f"{type(error).__name__}: {error}{step if isinstance(error, ImportError) else ''}"
            return Failure(text, transient=False)

    @contextmanager
    def _lost(self) -> Iterator[None]:
        try:
            yield
        except (OSError, RuntimeError, CancelledError) as error:
            raise self._gone() from error

    def _gone(self) -> EngineLostError:
        return EngineLostError(
            f"the scheduler at {self._address} went away; nothing that was finished is lost: start it again, with its "
            "workers, and give the same command"
        )


class _UnwantedError(RuntimeError):
    """Nobody waits for this task: its flow has failed, or its client or scheduler is gone."""


# A lambda travels by value: the scheduler needs none of this program, and a worker that lacks a part of it fails the
# task. If Dask itself unpacked the task there, that would end the worker, and the flow would wait for ever.
_UNPACKED = lambda packed: pickle.loads(packed)()  # noqa: E731, S301


def _run_on_worker(topic: str, number: int, task: Task) -> Any:
    worker = get_worker()
    key = worker.get_current_task()

    def report(*values: Any) -> None:
        # Dask cannot stop a thread. A task that nobody wants ends itself here, and frees the worker.
        state = worker.state.tasks.get(key)
        if state is None or state.state == "cancelled":
            raise _UnwantedError
        worker.log_event(topic, (number, values))

    return perform(task, report)


def configure_dask() -> None:
    """Set Dask's configuration for this process and the workers that it starts."""
    dask.config.set(CONFIGURATION)
    for name in ("distributed", "distributed.client", "distributed.core", "tornado", "asyncio"):
        logging.getLogger(name).setLevel(logging.CRITICAL)
