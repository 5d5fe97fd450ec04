"""Flows on an engine: each is a sequence of stages, and many of them share the engine's slots.

A task that fails in a way that may pass is tried again, `TRIES` times in all; its flow fails with it, the others go on.
"""

from __future__ import annotations

import itertools
import math
from collections import defaultdict
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, TypeVar

from study.console.interrupts import check_stopped
from study.engine.inline import InlineEngine
from study.engine.tasks import Engine, Failure, failure_of
from study.errors import BadInputError, TrainingDivergedError
from study.stages import Batch, Flow, Task

TRIES = 3
WAIT = 0.5  # [s] between two looks at Ctrl-C, the display and the cluster's size

T = TypeVar("T")
NextFlow = Callable[[], tuple[str, Flow[Any]] | None]


class FlowFailedError(RuntimeError):
    """A stage failed for a reason that nobody expected; the text is its traceback."""


def ignore(*_: object) -> None:
    """Do nothing."""


@dataclass(frozen=True)
class Listener:
    """What is called when flows come along; `name` is the flow's."""

    finished: Callable[[str, Any], None]  # name, product
    failed: Callable[[str, Failure], None]  # name, why
    progress: Callable[[str, str, int, int], None] = ignore  # name, stage, done, total
    started: Callable[[str, str, int], None] = ignore  # name, host, process: of a task of the flow
    device: Callable[[str, str], None] = ignore  # name, what a task of the flow computes on
    log: Callable[[str, str, int, Mapping[str, float]], None] = ignore  # name, stage, epoch, means over its tasks
    retry: Callable[[str, str], None] = ignore  # name, why a task is tried again
    tick: Callable[[], None] = ignore  # some time has passed


@dataclass
class _Running:
    """A flow that has begun, and its present batch."""

    order: int
    name: str
    flow: Flow[Any]
    batch: Batch = field(default_factory=lambda: Batch(()))
    results: dict[int, Any] = field(default_factory=dict)
    shares: dict[int, float] = field(default_factory=dict)  # of each task's work, done
    total: int = 0  # as the tasks count, where they do
    logs: dict[int, dict[int, Mapping[str, float]]] = field(default_factory=lambda: defaultdict(dict))

    def report_progress(self, listener: Listener) -> None:
        weights = [task.weight for task in self.batch.tasks]
        done = sum(weight * self.shares.get(index, 0.0) for index, weight in enumerate(weights))
        whole = self.batch.before + sum(weights)
        share = (self.batch.before + done) / whole
        total = self.total or whole
        listener.progress(self.name, self.batch.tasks[0].stage.name, math.floor(share * total + 1e-9), total)


@dataclass(frozen=True)
class _Try:
    """A task of a flow's present batch, and which try at it this is."""

    running: _Running
    index: int
    attempt: int = 1

    @property
    def task(self) -> Task:
        return self.running.batch.tasks[self.index]


class _Flows:
    def __init__(
        self, engine: Engine, next_flow: Callable[[], tuple[str, Flow[Any]] | None], listener: Listener
    ) -> None:
        self._engine, self._next_flow, self._listener = engine, next_flow, listener
        self._ready: list[_Try] = []  # in the order in which they should run: earlier flows first
        self._submitted: dict[int, _Try] = {}
        self._numbers = itertools.count()
        self._begun = 0

    def run(self) -> None:
        while True:
            self._fill()
            if not self._submitted and not self._ready:
                return
            for number, value in self._engine.wait(WAIT, self._hear):
                tried = self._submitted.pop(number, None)
                if tried is not None:  # else its flow has failed meanwhile
                    self._end_task(tried, value)
            check_stopped()
            self._listener.tick()

    def _fill(self) -> None:
        """Submit tasks as long as the engine has room, and begin further flows when none are ready."""
        # Where no worker has come yet, one task waits for the first: a cluster without any must not look like the end.
        slots, gpus = max(1, self._engine.slots()), self._engine.gpus()
        while True:
            waiting = []
            for tried in self._ready:
                limit = gpus if gpus and tried.task.accelerated else slots
                same = sum(
                    gpus == 0 or one.task.accelerated == tried.task.accelerated for one in self._submitted.values()
                )
                if same >= limit:
                    waiting.append(tried)
                    continue
                number = next(self._numbers)
                self._submitted[number] = tried
                self._engine.submit(number, tried.task)
            self._ready = waiting
            if waiting or len(self._submitted) >= slots + gpus or (following := self._next_flow()) is None:
                return
            name, flow = following
            self._begun += 1
            self._advance(_Running(self._begun, name, flow), None)

    def _advance(self, running: _Running, results: list[Any] | None) -> None:
        """Send results into a flow, and make the tasks that it then asks for ready."""
        try:
            batch = next(running.flow) if results is None else running.flow.send(results)
            while not batch.tasks:
                batch = running.flow.send([])
        except StopIteration as end:
            self._listener.finished(running.name, end.value)
        except (BadInputError, TrainingDivergedError, OSError) as error:
            self._listener.failed(running.name, failure_of(error))
        else:
            running.batch, running.results, running.shares, running.total = batch, {}, {}, 0
            running.logs.clear()
            running.report_progress(self._listener)
            self._ready += [_Try(running, index) for index in range(len(batch.tasks))]
            self._ready.sort(key=lambda tried: tried.running.order)

    def _end_task(self, tried: _Try, value: Any) -> None:
        running = tried.running
        if not isinstance(value, Failure):
            running.results[tried.index] = value
            running.shares[tried.index] = 1.0
            running.report_progress(self._listener)
            if len(running.results) == len(running.batch.tasks):
                self._advance(running, [running.results[index] for index in range(len(running.results))])
        elif value.transient and not value.exhausted and tried.attempt < TRIES:
            self._listener.retry(running.name, value.reason)
            self._ready.insert(0, _Try(running, tried.index, tried.attempt + 1))
        else:
            self._ready = [other for other in self._ready if other.running is not running]
            left = [number for number, other in self._submitted.items() if other.running is running]
            self._engine.cancel(left)
            for number in left:
                del self._submitted[number]
            running.flow.close()
            self._listener.failed(running.name, value)

    def _hear(self, number: int, kind: str, *values: Any) -> None:
        tried = self._submitted.get(number)
        if tried is None:
            return
        running = tried.running
        if kind == "start":
            self._listener.started(running.name, *values)
        elif kind == "device":
            self._listener.device(running.name, *values)
        elif kind == "progress":
            done, running.total = values
            running.shares[tried.index] = done / max(running.total, 1)
            running.report_progress(self._listener)
        elif kind == "log":
            epoch, metrics = values
            running.logs[epoch][tried.index] = metrics
            if len(running.logs[epoch]) == len(running.batch.tasks):
                self._log(running, epoch)

    def _log(self, running: _Running, epoch: int) -> None:
        parts = running.logs.pop(epoch)
        weights = {index: running.batch.tasks[index].weight for index in parts}
        whole = sum(weights.values())
        means = {name: sum(weights[index] * parts[index][name] for index in parts) / whole for name in parts[0]}
        self._listener.log(running.name, running.batch.tasks[0].stage.name, epoch, means)


def run_flows(engine: Engine, next_flow: NextFlow, listener: Listener) -> None:
    """Run flows until `next_flow` has no more and all have ended. `next_flow` is asked whenever the engine has room."""
    _Flows(engine, next_flow, listener).run()


Progress = Callable[[str, int, int], None]


def run_flow(flow: Flow[T], engine: Engine | None = None, progress: Progress | None = None) -> T:
    """Run one flow, in this process unless an engine is given, and return its product.

    `progress(stage, done, total)`. Raises BadInputError for a failure with a clear reason, FlowFailedError for others.
    """
    only = iter([("", flow)])
    products: list[T] = []

    def fail(_: str, failure: Failure) -> None:
        raise BadInputError(failure.reason) if failure.expected else FlowFailedError(failure.reason)

    tell = progress or ignore
    listener = Listener(lambda _, product: products.append(product), fail, lambda _, *how: tell(*how))
    run_flows(engine or InlineEngine(), lambda: next(only, None), listener)
    return products[0]
