"""The crew of one process: it takes cells from the queue, has children train them, and commits their results.

The same piece serves `study.sweep` on one machine, where it is the one that asks, and any number of `study.sweep` and
`study.worker` around a shared queue. The parent alone speaks to the queue and to the tracker.

A result counts by its commit to MLflow, and whoever commits must hold the cell's trial. A process that was stopped for
longer than the grace period finds its trial failed: it takes the cell up again when nobody else has, else lets it go.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import shutil
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from typing import Any, ParamSpec, Self, TypeVar

from study import child
from study.card import card_files, source_drives
from study.command import EXIT_FAILED, check_stopped, unbroken
from study.config import BadInputError
from study.cost import cell_cost
from study.data import DATA, prepare
from study.display import Display
from study.frames import open_frames
from study.grid import TRIES, Queue, QueueLostError, Ticket
from study.plan import Plan, thread_hint
from study.provenance import cores, provenance
from study.result import NETWORK, CellJob, CellResult
from study.scratch import temporary_files, using
from study.store import TrackerLostError
from study.tracking import CellRun, Tracker

GRACE = 2.0  # [s] a stopped child has to end by itself
END = 4.0  # [s] that ending takes at most, whatever the servers do
POLL = 5.0  # [s] between two looks at what others have done
PATIENCE, RETRY = 600.0, 3.0  # [s] a lost server is waited for, and between two tries
SCORE = "acceleration_accuracy"

P = ParamSpec("P")
T = TypeVar("T")


# --- the way of a process -------------------------------------------------------------------------------------------


def work(plan: Plan, options: argparse.Namespace, tracker: Tracker, *, lead: bool) -> dict[str, str]:
    """Train what is not finished, until every cell is finished or listed as failed. Returns the failed, with reasons.

    Who leads writes the sweep's data and provenance, and has cells tried again that were given up before.
    """
    done = tracker.finished(list(plan.cells))
    waiting = [key for key in plan.cells if key not in done]
    costs = {key: cell_cost(plan.settings, plan.cells[key], plan.grid.policy_seeds).seconds for key in waiting}
    labels = {key: cell.label for key, cell in plan.cells.items()}
    ready = (plan.frames / "manifest.json").is_file()
    title = f"{plan.grid.name} ({plan.profile})"
    with (
        Display(title, costs, labels, 0.0 if ready else plan.data_cost.seconds) as display,
        using(DATA, tracker.finished),
        temporary_files(DATA),
    ):
        if not waiting and not lead:
            return {}
        queue = Queue(plan.queue_name, plan.cells, options.queue, options.grace)
        frames = plan.frames
        if waiting:
            if hint := thread_hint(options.workers, options.threads, cores()):
                display.say(hint)
            if queue.shared:
                how = "there already" if ready else "made here from their key"
                display.say(f"frames {frames.name}: {how}, in {frames.resolve().parent}")
            frames = prepare(plan.settings, DATA, cores(), display.data, plan.imported)
        manifest = frames / "manifest.json"
        data = json.loads(manifest.read_text(encoding="utf-8")) if manifest.is_file() else {}
        if plan.imported:
            data["writers"] = plan.imported.writers  # a report must not call these drives our town's
        origin = provenance() | {"command": plan.command}
        opened = (plan.grid, plan.profile, plan.settings, plan.cells, data, origin)
        sweep_run = tracker.open_sweep(*opened, join=not lead)
        jobs = {
            key: CellJob(
                cell,
                key,
                plan.settings,
                plan.grid.policy_seeds,
                frames,
                plan.drives,
                DATA,
                options.device,
                options.threads,
            )
            for key, cell in plan.cells.items()
        }
        with Crew(jobs, set(waiting), options.workers, tracker, sweep_run, queue, display) as crew:
            queue.plan(waiting, restart=lead, retry_failed=options.retry_failed)
            if data and lead:
                store = open_frames(frames)
                tracker.log_files(sweep_run, card_files(store, source_drives(store, plan.drives), frames), "data")
            return crew.run()


def tell_failed(plan: Plan, failed: Mapping[str, str], command: str) -> int:
    """Print the failed cells with their reasons and what can be done; returns the exit code."""
    for key, reason in failed.items():
        print(f"failed: {plan.cells[key].label} ({key}): {reason.strip()}", file=sys.stderr)
    if failed:
        print(f"Once the cause is gone: {command.removesuffix(' --retry-failed')} --retry-failed", file=sys.stderr)
    return EXIT_FAILED if failed else 0


# --- the crew -------------------------------------------------------------------------------------------------------


@dataclass
class Worker:
    """A child process that trains one cell; `outcome` is its last message."""

    job: CellJob
    ticket: Ticket
    run: CellRun
    process: BaseProcess
    messages: Connection
    outcome: tuple[Any, ...] = ()


class Crew:
    """Hands cells to child processes, writes what they tell into the tracker, and commits their results."""

    def __init__(
        self,
        jobs: Mapping[str, CellJob],
        wanted: set[str],
        count: int,
        tracker: Tracker,
        sweep_run: str,
        queue: Queue,
        display: Display,
    ) -> None:
        self._jobs, self._wanted, self._told = jobs, wanted, set[str]()
        self._tracker, self._sweep_run = tracker, sweep_run
        self._queue, self._display = queue, display
        self._slots = list(range(count))
        self._running: list[Worker] = []
        self._next_look = 0.0
        # A file that cannot be written is no matter of seconds; a server that was restarted is.
        self._patience = PATIENCE if queue.shared or not tracker.uri.startswith("sqlite") else 0.0

    def run(self) -> dict[str, str]:
        """Run until every wanted cell is finished or given up. Returns the latter, with the reasons."""
        while self._hand_out():
            ready = wait([worker.messages for worker in self._running], timeout=1.0)
            with self._calm():
                for messages in ready:
                    self._listen(next(worker for worker in self._running if worker.messages is messages))
            self._display.tick()
        failed = {key: reason for key, reason in self._queue.failed.items() if key in self._wanted}
        with self._calm():
            self._patiently(self._tracker.close_sweep, self._sweep_run, "FAILED" if failed else "FINISHED")
            self._queue.close()
        return failed

    def _hand_out(self) -> bool:
        """Give free slots a cell each, when it is time to look. Returns whether anything is left to wait for."""
        if time.monotonic() < self._next_look:
            return True
        with self._calm():
            self._patiently(self._look)
        while self._slots:
            with self._calm():
                ticket = self._patiently(self._queue.take)
            if ticket is None:
                break
            self._patiently(self._start, ticket)
        return bool(self._running) or not self._wanted <= set(self._queue.failed)

    @contextmanager
    def _calm(self) -> Iterator[None]:
        """Have Ctrl-C wait while files are written. For a server it does not, which may be long in answering."""
        with nullcontext() if self._patience else unbroken():
            yield
        check_stopped()

    def _look(self) -> None:
        """See what others have done, and make wait what is neither finished nor open."""
        open_ = self._queue.open()
        closed = [key for key in self._wanted if key not in open_]
        for key in self._tracker.finished(closed) if closed else ():
            self._finish(key)
        self._queue.plan(self._wanted)
        for key in self._queue.failed.keys() - self._told:
            self._told.add(key)
            self._display.fail(key)
        if self._queue.shared:
            for worker in list(self._running):
                self._hold(worker)
        self._next_look = time.monotonic() + POLL if self._queue.shared else float("inf")

    def _start(self, ticket: Ticket) -> None:
        job = dataclasses.replace(self._jobs[ticket.key], slot=self._slots[0])
        with self._calm():
            if self._tracker.finished([ticket.key]):  # by a process that could not tell the queue
                self._queue.drop(ticket)
                self._finish(ticket.key)
                return
            run = self._tracker.start_cell(self._sweep_run, job.cell, job.key, job.settings, job.policy_seeds)
            if result := _trained(job):  # before; only the commit was cut off
                self._commit(job, ticket, run, result)
                return
        process, messages = child.start(job)  # the first waits for torch
        self._slots.remove(job.slot)
        self._running.append(Worker(job, ticket, run, process, messages))
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
        self._remove(worker)
        match worker.outcome:
            case ("done",):
                if result := _trained(worker.job):
                    self._commit(worker.job, worker.ticket, worker.run, result)
                    return
                passing, reason = True, "its result could not be read back"
            case ("failed", passing, reason):
                pass
            case _:
                passing, reason = True, f"the process ended with code {worker.process.exitcode}"
        again = passing and worker.ticket.attempt < TRIES
        self._patiently(self._tracker.fail, worker.run, reason, again=again)
        if self._patiently(self._queue.fail, worker.ticket, reason, passing=passing):
            self._display.wait(worker.job.key, f"{reason.strip().splitlines()[-1]}; it will be tried again")

    def _remove(self, worker: Worker) -> None:
        worker.process.join()
        worker.messages.close()
        self._running.remove(worker)
        self._slots.append(worker.job.slot)
        self._next_look = 0.0

    def _commit(self, job: CellJob, ticket: Ticket, run: CellRun, result: CellResult) -> None:
        held = self._patiently(self._queue.hold, ticket)
        if held is None:
            self._let_go(job, run)
            return
        network = job.result_folder / NETWORK
        self._patiently(self._tracker.commit, run, result, network if network.is_file() else None)  # a ceiling has none
        self._patiently(self._queue.done, held, _score(result))
        shutil.rmtree(job.result_folder)
        self._finish(job.key)

    def _finish(self, key: str) -> None:
        if key in self._wanted:
            self._wanted.remove(key)
            self._display.finish(key)

    def _hold(self, worker: Worker) -> None:
        """Make sure that the worker's cell is still ours."""
        held = self._queue.hold(worker.ticket)
        if held is None:
            worker.process.kill()
            self._remove(worker)
            self._let_go(worker.job, worker.run)
        else:
            worker.ticket = held

    def _let_go(self, job: CellJob, run: CellRun) -> None:
        self._tracker.interrupt(run, "another worker has the cell")
        self._display.wait(job.key, "we were away too long, and another worker has it now")

    def _patiently(self, action: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
        """Do something that can be done again, and wait for a server that is away meanwhile."""
        until = None
        while True:
            try:
                return action(*args, **kwargs)
            except (QueueLostError, TrackerLostError) as error:
                if until is None:
                    until = time.monotonic() + self._patience
                    if self._patience:
                        self._display.say(f"{error}; trying again for {self._patience / 60:.0f} minutes")
                if time.monotonic() >= until:
                    raise
            time.sleep(RETRY)

    # --- the end --------------------------------------------------------------------------------------------------

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """When something has cut the run short: end the children and let their cells wait, in a few seconds."""
        if kind is None:
            return
        for number in (signal.SIGINT, signal.SIGTERM):  # pressed twice is not more
            signal.signal(number, signal.SIG_IGN)
        until = time.monotonic() + END
        for worker in self._running:
            worker.process.terminate()
        for worker in self._running:
            worker.process.join(max(0.0, until - END + GRACE - time.monotonic()))
            worker.process.kill()
        # A thread that may be left behind: a server that does not answer must not hold up the end.
        release = threading.Thread(target=self._release, daemon=True)
        release.start()
        release.join(max(0.0, until - time.monotonic()))

    def _release(self) -> None:
        with suppress(QueueLostError, TrackerLostError):
            for worker in self._running:
                self._queue.stopped(worker.ticket)
            for worker in self._running:
                self._tracker.interrupt(worker.run)
            if not self._queue.shared or not self._queue.running():
                self._tracker.close_sweep(self._sweep_run, "KILLED")
        self._queue.close()


def _trained(job: CellJob) -> CellResult | None:
    """The result that lies ready to be committed; one that is not whole is removed."""
    if not job.result_folder.is_dir():
        return None
    try:
        return CellResult.load(job.result_folder)
    except BadInputError:
        shutil.rmtree(job.result_folder)
        return None


def _score(result: CellResult) -> float:
    curves = result.curves
    final = curves[(curves["metric"] == SCORE) & (curves["split"] == "test")]
    return float(final[final["epoch"] == final["epoch"].max()]["value"].mean())
