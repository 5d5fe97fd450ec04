"""The run of one cell in MLflow."""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Literal

from mlflow.entities import Metric, RunTag
from mlflow.tracking import MlflowClient

from study.config.grid import Cell
from study.tracking.metrics import Point
from study.tracking.store import TROUBLES

HOST, PROCESS, ALIVE = "host", "process", "alive"  # tags of an attempt: who writes it, and when last [ms since 1970]
PERMANENT = "permanent"  # tag of a failed attempt: another try would not help
SIGN = 5.0  # [s] between two signs of life
FLUSH = 2.0  # [s] between two writes of live curves

Status = Literal["FINISHED", "FAILED", "KILLED"]


@dataclass
class CellRun:
    """One attempt at a cell. Points and tags gather here until `flush` writes them, many at a time."""

    run_id: str
    key: str
    cell: Cell
    started: int
    client: MlflowClient
    seeds: dict[int, str] = field(default_factory=dict)
    _pending: list[Metric] = field(default_factory=list)
    _tags: dict[str, str] = field(default_factory=dict)
    _signed: float = -math.inf
    _flushed: float = -math.inf
    _seen: set[tuple[str, int]] = field(default_factory=set)

    def log(self, stage: str, epoch: int, metrics: Mapping[str, float]) -> None:
        """Take the points of one epoch, named such as "test/loss_rec". A point that is there already is left out."""
        self.add((f"{stage}/{name}", epoch, float(value)) for name, value in metrics.items())

    def note(self, **tags: str) -> None:
        """Take tags of the attempt; the time goes with them as a sign of life."""
        self._tags |= tags | {ALIVE: str(time.time_ns() // 1_000_000)}

    def progress(self, stage: str, done: int, whole: int) -> None:
        """Take how far the training is; a few times a minute is enough for those who look."""
        now = time.monotonic()
        if now - self._signed >= SIGN or done == whole:
            self._signed = now
            self.note(progress=f"{stage} {done}/{whole}")

    def add(self, points: Iterable[Point]) -> None:
        """Take points, less those that are there already."""
        for name, step, value in points:
            if (name, step) not in self._seen:
                self._seen.add((name, step))
                self._pending.append(Metric(name, value, self.started + step, step))

    def flush_live(self) -> None:
        """Write what has gathered, every now and then. What cannot be written waits: `commit` writes it or says why."""
        if time.monotonic() - self._flushed >= FLUSH:
            self._flushed = time.monotonic()
            with suppress(*TROUBLES):
                self.flush()

    def flush(self) -> None:
        """Write what has gathered. Written in part, it may be written again: the same points are the same rows."""
        if self._pending or self._tags:
            tags = [RunTag(*tag) for tag in self._tags.items()]
            self.client.log_batch(self.run_id, metrics=self._pending, tags=tags)
            self._pending, self._tags = [], {}


@dataclass(frozen=True)
class Attempt:
    """One try at a cell as the store knows it; `started` in ms since 1970."""

    run_id: str
    status: str
    started: int
    tags: Mapping[str, str]
    metrics: Mapping[str, float]
