"""Workers: child processes that train one cell each, and the parent's side of them.

The parent alone speaks to the queue and to the tracker. A child speaks to its parent through a pipe:
("device", name), ("log", stage, epoch, metrics), ("progress", stage, done, total), and last ("done",) or
("failed", whether another try may help, reason).
"""

from __future__ import annotations

import dataclasses
import multiprocessing
import shutil
import signal
import traceback
from dataclasses import dataclass
from multiprocessing import forkserver
from multiprocessing.connection import Connection, wait
from multiprocessing.context import ForkServerContext
from typing import Any, Self

from study.command import obey_parent
from study.config import BadInputError
from study.display import Display
from study.grid import Queue, Ticket
from study.result import CellJob, CellResult, TrainingDivergedError
from study.tracking import CellRun, Tracker

TRIES = 3  # of a cell whose process died or met an I/O error
GRACE = 3.0  # [s] a stopped child has to end by itself
SCORE = "acceleration_accuracy"


# --- the child's side -----------------------------------------------------------------------------------------------


def serve(job: CellJob, parent: Connection) -> None:
    """Run a cell in a child process and tell the parent of it."""
    obey_parent()
    try:
        from study.cell import choose_device, device_name, run_cell  # noqa: PLC0415 - the parent needs no torch

        parent.send(("device", device_name(choose_device(job))))
        run_cell(
            job,
            lambda *what: parent.send(("log", *what)),
            lambda *what: parent.send(("progress", *what)),
        )
    except (BadInputError, TrainingDivergedError) as error:
        parent.send(("failed", False, str(error)))
    except (OSError, MemoryError):
        parent.send(("failed", True, traceback.format_exc()))
    except Exception:  # noqa: BLE001 - whatever it is belongs to this cell, and the others go on
        parent.send(("failed", False, traceback.format_exc()))
    else:
        parent.send(("done",))


# --- the parent's side ----------------------------------------------------------------------------------------------


def fork_server() -> ForkServerContext:
    """Where children come from: a process that loads torch once, so that each of them starts within a moment.

    Ctrl-C reaches every process of a terminal; it is the parent's to answer, so the server is born deaf to it.
    """
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["study.cell", "study.worker"])
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        forkserver.ensure_running()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
    return context


@dataclass
class Worker:
    """A child process that trains one cell; `outcome` is its last message."""

    job: CellJob
    ticket: Ticket
    run: CellRun
    process: Any
    messages: Connection
    outcome: tuple[Any, ...] = ()


class Workers:
    """Hands cells to child processes, writes what they tell into the tracker, and commits their results."""

    def __init__(
        self, jobs: dict[str, CellJob], count: int, tracker: Tracker, sweep_run: str, queue: Queue, display: Display
    ) -> None:
        self._jobs, self._tracker, self._sweep_run = jobs, tracker, sweep_run
        self._queue, self._display = queue, display
        self._slots = list(range(count))
        self._running: list[Worker] = []
        self._tries: dict[str, int] = {}
        self._failed: dict[str, str] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        """End the children that are still there; their cells wait for the next time."""
        for worker in self._running:
            worker.process.terminate()
        for worker in self._running:
            worker.process.join(GRACE)
            worker.process.kill()
            worker.process.join()
            self._tracker.interrupt(worker.run)

    def run(self) -> dict[str, str]:
        """Run the queue dry. Returns the failed cells with their reasons."""
        while True:
            while self._slots and (ticket := self._queue.take()):
                self._start(ticket)
            if not self._running:
                return self._failed
            for messages in wait([worker.messages for worker in self._running], timeout=1.0):
                self._listen(next(worker for worker in self._running if worker.messages is messages))
            self._display.tick()

    def _start(self, ticket: Ticket) -> None:
        job = dataclasses.replace(self._jobs[ticket.key], slot=self._slots.pop(0))
        run = self._tracker.start_cell(self._sweep_run, job.cell, job.key, job.settings, job.policy_seeds)
        if job.result_folder.is_dir():  # trained before; only the commit was cut off
            self._slots.append(job.slot)
            self._commit(job, ticket, run)
            return
        here, there = multiprocessing.Pipe(duplex=False)
        process = fork_server().Process(target=serve, args=(job, there), name=job.cell.label, daemon=True)
        process.start()
        there.close()
        self._running.append(Worker(job, ticket, run, process, here))
        self._display.start(job.key)

    def _listen(self, worker: Worker) -> None:
        try:
            kind, *rest = worker.messages.recv()
        except EOFError:
            self._end(worker)
            return
        if kind == "log":
            worker.run.log(*rest)
        elif kind == "device":
            worker.run.note(device=rest[0])
        elif kind == "progress":
            worker.run.progress(*rest)
            self._display.progress(worker.job.key, *rest)
        else:
            worker.outcome = (kind, *rest)

    def _end(self, worker: Worker) -> None:
        worker.process.join()
        self._running.remove(worker)
        self._slots.append(worker.job.slot)
        key = worker.job.key
        match worker.outcome:
            case ("done",):
                self._commit(worker.job, worker.ticket, worker.run)
                return
            case ("failed", passing, reason):
                pass
            case _:
                passing, reason = True, f"the process ended with code {worker.process.exitcode}"
        self._tracker.fail(worker.run, reason)
        self._tries[key] = self._tries.get(key, 0) + 1
        if passing and self._tries[key] < TRIES:
            self._queue.again(worker.ticket, reason)
            self._display.say(f"{worker.job.cell.label}: {reason.strip().splitlines()[-1]}; it will be tried again")
        else:
            self._queue.failed(worker.ticket, reason)
            self._failed[key] = reason
            self._display.fail(key)

    def _commit(self, job: CellJob, ticket: Ticket, run: CellRun) -> None:
        result = CellResult.load(job.result_folder)
        self._tracker.commit(run, result)
        self._queue.done(ticket, _score(result))
        shutil.rmtree(job.result_folder)
        self._display.finish(job.key)


def _score(result: CellResult) -> float:
    curves = result.curves
    final = curves[(curves["metric"] == SCORE) & (curves["split"] == "test")]
    return float(final[final["epoch"] == final["epoch"].max()]["value"].mean())
