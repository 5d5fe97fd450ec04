"""The run of one cell in MLflow, while it is written."""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Literal

from mlflow.entities import Metric, RunTag
from mlflow.tracking import MlflowClient

from study.config.grid import Cell
from study.tracking.experiment import STORE_ERRORS, DeletedError, is_deleted
from study.tracking.metrics import CurvePoint

HOST, PROCESS, ALIVE = "host", "process", "alive"  # tags of an attempt: who writes it, and when last [ms since 1970]
HEARTBEAT = 5.0  # [s] between two heartbeats
FLUSH = 5.0  # [s] between two writes of live curves

Status = Literal["FINISHED", "FAILED", "KILLED"]


@dataclass
class CellRun:
    """One attempt at a cell. Points and tags are collected until `flush` writes them, many at a time."""

    run_id: str
    key: str
    cell: Cell
    started: int  # [ms since 1970]
    client: MlflowClient
    seeds: dict[int, str] = field(default_factory=dict)  # policy seed -> run id
    _pending: list[Metric] = field(default_factory=list)
    _tags: dict[str, str] = field(default_factory=dict)
    _heard: float = -math.inf
    _flushed: float = -math.inf
    _seen: set[tuple[str, int]] = field(default_factory=set)

    def log(self, stage: str, epoch: int, metrics: Mapping[str, float]) -> None:
        """Add the points of one epoch, named such as "test/loss_rec"."""
        self.add((f"{stage}/{name}", epoch, float(value)) for name, value in metrics.items())

    def note(self, **tags: str) -> None:
        """Add tags of the attempt, with the time as its heartbeat."""
        self._tags |= tags | {ALIVE: str(time.time_ns() // 1_000_000)}

    def progress(self, stage: str, done: int, total: int) -> None:
        """Note how far the training is, a few times a minute."""
        now = time.monotonic()
        if now - self._heard >= HEARTBEAT or done == total:
            self._heard = now
            self.note(progress=f"{stage} {done}/{total}")

    def add(self, points: Iterable[CurvePoint]) -> None:
        """Add points; one that was added before is left out, since a resumed training logs it again."""
        for name, step, value in points:
            if (name, step) not in self._seen:
                self._seen.add((name, step))
                self._pending.append(Metric(name, value, self.started + step, step))

    def flush_live(self) -> None:
        """Write what was added, every few seconds. What cannot be written is kept: `commit` writes it or fails.

        Raises DeletedError when somebody has deleted the run.
        """
        if time.monotonic() - self._flushed >= FLUSH:
            self._flushed = time.monotonic()
            try:
                self.flush()
            except STORE_ERRORS as error:
                if is_deleted(error):
                    raise DeletedError(f"somebody has deleted its run {self.run_id} in MLflow") from None

    def flush(self) -> None:
        """Write what was added. After an error it can be written again: the same points are the same rows."""
        if self._pending or self._tags:
            tags = [RunTag(*tag) for tag in self._tags.items()]
            self.client.log_batch(self.run_id, metrics=self._pending, tags=tags)
            self._pending, self._tags = [], {}
