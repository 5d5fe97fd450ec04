"""Run flows on an engine: each is a sequence of stages, and many of them share the engine's slots.

A task that fails for a transient reason is tried `TRIES` times; its flow fails with it, and the others go on.
"""

from __future__ import annotations

import itertools
import math
import sys
from collections import defaultdict
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, TypeVar

from study.console.interrupts import check_stopped
from study.engine.inline import InlineEngine
from study.engine.room import TRIES
from study.engine.tasks import Engine, Failure, failure_of
from study.errors import BadInputError, TrainingDivergedError
from study.stages import Batch, Flow, Task

WAIT = 0.5  # [s] between two looks at Ctrl-C, the display and the cluster's size

T = TypeVar("T")
NextFlow = Callable[[], tuple[str, Flow[Any]] | None]
Progress = Callable[[str, int, int], None]  # stage, done, total


class FlowFailedError(RuntimeError):
    """A stage failed for an unexpected reason; the text is its traceback."""


def ignore(*_: object) -> None:
    """Do nothing."""


@dataclass(frozen=True)
class Listener:
    """Callbacks for the events of flows; `name` is the flow's."""

    finished: Callable[[str, Any], None]  # name, product
    failed: Callable[[str, Failure], None]  # name, why
    progress: Callable[[str, str, int, int], None] = ignore  # name, stage, done, total
    started: Callable[[str, str, int], None] = ignore  # name, host, process: of a task of the flow
    device: Callable[[str, str], None] = ignore  # name, what a task of the flow computes on
    log: Callable[[str, str, int, Mapping[str, float]], None] = ignore  # name, stage, epoch, means over its tasks
    retry: Callable[[str, str], None] = ignore  # name, why a task is tried again
    tick: Callable[[], None] = ignore  # at least every WAIT seconds, unless a task runs in this process


@dataclass
class _Running:
    """A flow that has started, and its present batch."""

    order: int
    name: str
    flow: Flow[Any]
    batch: Batch = field(default_factory=lambda: Batch(()))
    results: dict[int, Any] = field(default_factory=dict)
    shares: dict[int, float] = field(default_factory=dict)  # task -> share of it that is done
    total: int = 0  # in the tasks' own unit, once they have reported it
    logs: dict[int, dict[int, Mapping[str, float]]] = field(default_factory=lambda: defaultdict(dict))

    @property
    def stage(self) -> str:
        return self.batch.tasks[0].stage.name

    def progress(self) -> tuple[str, str, int, int]:
        """Return name, stage, done and total."""
        weights = [task.weight for task in self.batch.tasks]
        done = self.batch.before + sum(weight * self.shares.get(index, 0.0) for index, weight in enumerate(weights))
        weight = self.batch.before + sum(weights)
        total = self.total or weight
        return self.name, self.stage, math.floor(done / weight * total + 1e-9), total

    def mean_log(self, epoch: int) -> dict[str, float]:
        """Return the weighted means of what the tasks have logged for an epoch."""
        logs = self.logs.pop(epoch)
        weights = {index: self.batch.tasks[index].weight for index in logs}
        total = sum(weights.values())
        return {name: sum(weights[index] * logs[index][name] for index in logs) / total for name in logs[0]}


@dataclass(frozen=True)
class _Attempt:
    """A task of a flow's present batch, and how often it was tried with this one."""

    running: _Running
    index: int
    tries: int = 1

    @property
    def task(self) -> Task:
        return self.running.batch.tasks[self.index]


class _Runner:
    def __init__(self, engine: Engine, next_flow: NextFlow, listener: Listener) -> None:
        self._engine, self._next_flow, self._listener = engine, next_flow, listener
        self._ready: list[_Attempt] = []  # in the order in which they should run: earlier flows first
        self._submitted: dict[int, _Attempt] = {}
        self._full: set[str] = set()  # where room is waited for
        self._task_numbers, self._flow_numbers = itertools.count(), itertools.count()

    def run(self) -> None:
        while True:
            self._fill()
            if not self._submitted and not self._ready:
                return
            for number, value in self._engine.wait(WAIT, self._hear):
                if (attempt := self._submitted.pop(number, None)) is not None:  # else its flow has failed meanwhile
                    self._end_task(attempt, value)
            check_stopped()
            self._listener.tick()

    def _fill(self) -> None:
        """Submit tasks as long as the engine has room, and start further flows when none are ready."""
        # A cluster that has no worker yet gets one task, which waits for the first.
        slots, gpus = max(1, self._engine.slots()), self._engine.gpus()
        while True:
            waiting = []
            for attempt in self._ready:
                accelerated = attempt.task.accelerated
                running = sum(not gpus or each.task.accelerated == accelerated for each in self._submitted.values())
                if running >= (gpus if gpus and accelerated else slots):
                    waiting.append(attempt)
                else:
                    number = next(self._task_numbers)
                    self._submitted[number] = attempt
                    self._engine.submit(number, attempt.task)
            self._ready = waiting
            if waiting or len(self._submitted) >= slots + gpus or (following := self._next_flow()) is None:
                return
            self._advance(_Running(next(self._flow_numbers), *following), None)

    def _advance(self, running: _Running, results: list[Any] | None) -> None:
        """Send results into a flow, and make the tasks of its next batch ready."""
        try:
            batch = next(running.flow) if results is None else running.flow.send(results)
            while not batch.tasks:
                batch = running.flow.send([])
        except StopIteration as end:
            self._listener.finished(running.name, end.value)
        except (BadInputError, TrainingDivergedError, OSError, RuntimeError) as error:
            failure = failure_of(error)
            if not (failure.transient or failure.expected):
                raise  # a fault of this program
            self._listener.failed(running.name, failure)
        else:
            running.batch, running.results, running.shares, running.total = batch, {}, {}, 0
            running.logs.clear()
            self._listener.progress(*running.progress())
            self._ready += [_Attempt(running, index) for index in range(len(batch.tasks))]
            self._ready.sort(key=lambda attempt: attempt.running.order)

    def _end_task(self, attempt: _Attempt, value: Any) -> None:
        running = attempt.running
        if not isinstance(value, Failure):
            value = self._receive(running.batch, attempt.index, value)
        if not isinstance(value, Failure):
            self._full.clear()
            running.results[attempt.index] = value
            running.shares[attempt.index] = 1.0
            self._listener.progress(*running.progress())
            if len(running.results) == len(running.batch.tasks):
                self._advance(running, [running.results[index] for index in range(len(running.results))])
        elif value.transient and not value.exhausted and attempt.tries < TRIES:
            self._listener.retry(running.name, value.reason)
            self._ready.insert(0, _Attempt(running, attempt.index, attempt.tries + 1))
        else:
            self._ready = [other for other in self._ready if other.running is not running]
            unwanted = [number for number, other in self._submitted.items() if other.running is running]
            self._engine.cancel(unwanted)
            for number in unwanted:
                del self._submitted[number]
            running.flow.close()
            self._listener.failed(running.name, value)

    @staticmethod
    def _receive(batch: Batch, index: int, value: Any) -> Any:
        """Have the flow keep a result; returns it, or why that has failed."""
        try:
            batch.receive(index, value)
        except (BadInputError, OSError, RuntimeError) as error:
            failure = failure_of(error)
            if not (failure.transient or failure.expected):
                raise  # a fault of this program
            return failure
        return value

    def _hear(self, number: int, kind: str, *values: Any) -> None:
        if (attempt := self._submitted.get(number)) is None:
            return
        running, listener = attempt.running, self._listener
        if kind == "start":
            listener.started(running.name, *values)
        elif kind == "device":
            listener.device(running.name, *values)
        elif kind == "room":
            place, words = values
            if place not in self._full:  # tasks that fail beside each other wait for the same
                listener.retry(running.name, words)
            self._full.add(place)
        elif kind == "progress":
            done, running.total = values
            running.shares[attempt.index] = done / max(running.total, 1)
            listener.progress(*running.progress())
        elif kind == "log":
            epoch, metrics = values
            running.logs[epoch][attempt.index] = metrics
            if len(running.logs[epoch]) == len(running.batch.tasks):
                listener.log(running.name, running.stage, epoch, running.mean_log(epoch))


def run_flows(engine: Engine, next_flow: NextFlow, listener: Listener) -> None:
    """Run flows until `next_flow` has no more and all have ended. `next_flow` is asked whenever the engine has room."""
    _Runner(engine, next_flow, listener).run()


def run_flow(flow: Flow[T], engine: Engine | None = None, progress: Progress = ignore) -> T:
    """Run one flow, in this process unless an engine is given, and return its product.

    Raises BadInputError for a failure with a clear reason, FlowFailedError for others.
    """
    flows, products = iter([("", flow)]), list[T]()

    def fail(_: str, failure: Failure) -> None:
        raise BadInputError(failure.reason) if failure.expected else FlowFailedError(failure.reason)

    def retry(_: str, reason: str) -> None:
        print(f"{reason.strip().splitlines()[-1]}; it will be tried again", file=sys.stderr, flush=True)

    listener = Listener(
        lambda _, product: products.append(product), fail, lambda _, *step: progress(*step), retry=retry
    )
    run_flows(engine or InlineEngine(), lambda: next(flows, None), listener)
    return products[0]
