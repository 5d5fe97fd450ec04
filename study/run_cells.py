"""Train the cells of a plan on an engine, and commit what they give: the one writer to MLflow and Optuna."""

from __future__ import annotations

import argparse
import json
import os
import shutil
import sys
import tempfile
import threading
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, ParamSpec, Self, TypeVar

from filelock import FileLock, Timeout
from tenacity import RetryCallState, Retrying, retry_if_exception_type, stop_after_delay, wait_fixed

from study.card import card_files, source_drives
from study.cell import cell_flow, product_folders
from study.command import EXIT_FAILED, check_stopped
from study.config import BadInputError, masked
from study.data import DATA, data_flow, describe_data
from study.display import Display
from study.engine.cluster import DaskEngine, cluster_engine, local_engine, visible_gpus
from study.engine.flows import Listener, run_flow, run_flows
from study.engine.inline import InlineEngine
from study.engine.tasks import Engine, Failure
from study.engine.trials import Trials
from study.frames import open_frames
from study.plan import Plan, cell_jobs
from study.provenance import cores, provenance
from study.result import CellResult
from study.stages import DESCRIBE, Batch, Flow, Task, cell_cost
from study.store import SQLITE, TrackerLostError
from study.tracking import CellRun, Tracker

PATIENCE, RETRY = 600.0, 3.0  # [s] a lost server is waited for, and between two tries
END = 1.5  # [s] that a store has to be told of a stop
SCORE = "acceleration_accuracy"

P = ParamSpec("P")
T = TypeVar("T")


def run_cells(plan: Plan, options: argparse.Namespace, tracker: Tracker) -> dict[str, str]:
    """Train what is not finished, until every cell is finished or has failed. Returns the failed, with reasons."""
    done = tracker.finished(list(plan.cells))
    given_up = {} if options.retry_failed else tracker.given_up(set(plan.cells) - set(done))
    waiting = [key for key in plan.cells if key not in done and key not in given_up]
    costs = {key: cell_cost(plan.settings, plan.cells[key], plan.grid.policy_seeds).seconds for key in waiting}
    labels = {key: cell.label for key, cell in plan.cells.items()}
    ready = (plan.frames / "manifest.json").is_file()
    title = f"{plan.grid.name} ({plan.profile})"
    order = sorted(waiting, key=lambda key: -costs[key])
    with (
        Display(
            title,
            costs | dict.fromkeys(given_up, 0.0),
            labels,
            0.0 if ready or not waiting else plan.data_cost.seconds,
            plan.works,
        ) as display,
        temporary_folder(DATA),
        start_engine(options) if waiting else InlineEngine() as engine,
    ):
        if waiting:
            data, card = run_flow(_data_flow(plan, engine), engine, display.data)
        else:
            data, card = _describe_here(plan) if ready else ({}, {})
        if plan.imported:
            data["writers"] = plan.imported.writers  # a report must not call these drives our town's
        origin = provenance() | {"command": plan.command}
        sweep_run = tracker.open_sweep(plan.grid, plan.profile, plan.settings, plan.cells, data, origin)
        with Committing(plan, options, tracker, sweep_run, order, display, engine.gpus() > 0) as cells:
            with tempfile.TemporaryDirectory() as name:
                files = [Path(name) / file for file in card]
                for file in files:
                    file.write_bytes(card[file.name])
                tracker.log_files(sweep_run, files, "data")
            for key in given_up:
                display.fail(key)
            run_flows(engine, cells.next_flow, cells.listener())
            return given_up | cells.close()


def report_failed(plan: Plan, failed: Mapping[str, str], command: str) -> int:
    """Print the failed cells with their reasons and what can be done; returns the exit code."""
    for key, reason in failed.items():
        print(f"failed: {plan.cells[key].label} ({key}): {reason.strip()}", file=sys.stderr)
    if failed:
        print(f"Once the cause is gone: {command.removesuffix(' --retry-failed')} --retry-failed", file=sys.stderr)
    return EXIT_FAILED if failed else 0


# --- where it runs --------------------------------------------------------------------------------------------------


def start_engine(options: argparse.Namespace) -> DaskEngine | InlineEngine:
    """Start the engine that the options ask for."""
    if options.cluster:
        return cluster_engine(options.cluster, options.certificates)
    workers = options.workers or max(1, cores() // options.threads)
    return local_engine(workers, DATA / "tmp", visible_gpus(options.device))


@contextmanager
def temporary_folder(root: Path) -> Iterator[None]:
    """Have this process put its temporary files below `root`, where what a kill leaves is removed by the next sweep."""
    folder = root / "tmp"
    folder.mkdir(parents=True, exist_ok=True)
    before = tempfile.tempdir
    lock = FileLock(root / ".in-use")
    with suppress(Timeout):  # another sweep works here, and may need what it has there
        lock.acquire(blocking=False)
        _empty(folder)
    tempfile.tempdir = str(folder.absolute())
    try:
        yield
    finally:
        tempfile.tempdir = before
    if lock.is_locked:
        _empty(folder)
        lock.release()


def _empty(folder: Path) -> None:
    for path in folder.iterdir():
        shutil.rmtree(path, ignore_errors=True) if path.is_dir() else path.unlink(missing_ok=True)


def _data_flow(plan: Plan, engine: Engine) -> Flow[Any]:
    """Make and describe the frames: here, with the engine's help, unless its workers have folders of their own."""
    if _shares_folder(engine):
        yield from data_flow(plan.settings, DATA, plan.imported)
    task = Task(DESCRIBE, describe_data, (plan.frames, plan.drives, plan.settings, plan.imported))
    (described,) = yield Batch([task])
    return described


def _shares_folder(engine: Engine) -> bool:
    if not isinstance(engine, DaskEngine):
        return True
    with tempfile.NamedTemporaryFile(dir=DATA, prefix=".shared-") as token:
        return engine.workers_see(DATA / Path(token.name).name)


def _describe_here(plan: Plan) -> tuple[dict[str, Any], dict[str, bytes]]:
    store = open_frames(plan.frames)
    files = card_files(store, source_drives(store, plan.drives), plan.frames)
    return store.manifest, {path.name: path.read_bytes() for path in files}


# --- committing -----------------------------------------------------------------------------------------------------


class Committing:
    """Offers the cells' flows to the engine, writes what they report, and commits their results."""

    def __init__(
        self,
        plan: Plan,
        options: argparse.Namespace,
        tracker: Tracker,
        sweep_run: str,
        order: Collection[str],
        display: Display,
        accelerated: bool,
    ) -> None:
        self._plan, self._tracker, self._sweep_run, self._display = plan, tracker, sweep_run, display
        self._jobs = cell_jobs(plan, options.device, options.threads)
        self._runs: dict[str, CellRun] = {}
        self._failed: dict[str, str] = {}
        self._one_share = accelerated
        labels = {key: cell.label for key, cell in plan.cells.items()}
        self._trials = Trials(store_folder(options.tracking) / "optuna.db", plan.study_name, labels, order)
        # A file that cannot be written is no matter of seconds; a server that was restarted is.
        self._patience = 0.0 if tracker.uri.startswith("sqlite") else PATIENCE

    def next_flow(self) -> tuple[str, Flow[Any]] | None:
        """Return the flow of the cell that Optuna names, or None when there is none left."""
        key = self._trials.ask()
        return None if key is None else (key, cell_flow(self._jobs[key], one_share=self._one_share))

    def listener(self) -> Listener:
        """Return what the flows call."""
        return Listener(
            self.finished,
            self.failed,
            self.progress,
            self.started,
            lambda name, device: self._runs[name].note(device=device),
            lambda name, *epoch: self._runs[name].log(*epoch),
            self.retry,
            self.tick,
        )

    def started(self, name: str, host: str, process: int) -> None:
        """Open the cell's run when its first task starts; note who runs it."""
        if name not in self._runs:
            job = self._jobs[name]
            begin = self._tracker.start_cell
            self._runs[name] = self._patiently(
                begin, self._sweep_run, job.cell, job.key, job.settings, job.policy_seeds
            )
            self._display.start(name)
        self._runs[name].note(host=host, process=str(process))

    def progress(self, name: str, stage: str, done: int, total: int) -> None:
        """Show how far the cell is, and tag its run with it."""
        if name in self._runs:
            self._runs[name].progress(stage, done, total)
            self._display.progress(name, stage, done, total)

    def retry(self, name: str, reason: str) -> None:
        """Say that a task will be tried again."""
        self._display.say(f"{self._plan.cells[name].label}: {reason.strip().splitlines()[-1]}; it will be tried again")

    def finished(self, name: str, value: tuple[CellResult, bytes]) -> None:
        """Commit a result."""
        result, network = value
        run = self._runs.pop(name)
        self._patiently(self._tracker.commit, run, result, network)
        self._trials.finish(name, _score(result))
        for folder in product_folders(self._jobs[name].scratch, name):
            shutil.rmtree(folder, ignore_errors=True)
        self._display.finish(name)

    def failed(self, name: str, failure: Failure) -> None:
        """Record why a cell has failed."""
        self._failed[name] = masked(failure.reason)
        if name not in self._runs:  # before anything of it ran
            self.started(name, "", os.getpid())
        self._patiently(self._tracker.fail, self._runs.pop(name), failure.reason, permanent=not failure.transient)
        self._trials.fail(name, failure.reason)
        self._display.fail(name)

    def tick(self) -> None:
        """Write live curves, and draw the display again."""
        for run in self._runs.values():
            run.flush_live()
        self._display.tick()

    def close(self) -> dict[str, str]:
        """End the sweep's run; returns the cells that failed, with the reasons."""
        self._patiently(self._tracker.close_sweep, self._sweep_run, "FAILED" if self._failed else "FINISHED")
        return self._failed

    def _patiently(self, action: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
        """Do something that can be done again, and wait for a server that is away meanwhile."""

        def say(state: RetryCallState) -> None:
            check_stopped()
            if state.attempt_number == 1 and state.outcome is not None:
                minutes = self._patience / 60
                self._display.say(f"{state.outcome.exception()}; trying again for {minutes:.0f} minutes")

        return Retrying(
            retry=retry_if_exception_type(TrackerLostError),
            stop=stop_after_delay(self._patience),
            wait=wait_fixed(RETRY),
            before_sleep=say,
            reraise=True,
        )(action, *args, **kwargs)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """When something has cut the sweep short, say so in the store; a stop does not wait long for that."""
        if kind is None:
            return
        release = threading.Thread(target=self._release, daemon=True)
        release.start()
        release.join(END)

    def _release(self) -> None:
        with suppress(BadInputError):
            for run in self._runs.values():
                self._tracker.interrupt(run)
            self._tracker.close_sweep(self._sweep_run, "KILLED")
            self._trials.stop()


def store_folder(tracking: str) -> Path:
    """Return where the lock and Optuna's file of a tracking store lie: beside a database file, else in mlruns/."""
    if tracking.startswith(SQLITE):
        return Path(tracking.removeprefix(SQLITE).partition("?")[0]).parent
    return Path("mlruns")


@contextmanager
def hold_store(tracking: str, sweep: str, *, wait: bool) -> Iterator[None]:
    """Hold a tracking store for one sweep at a time.

    Raises BadInputError that says who holds it, unless told to `wait`.
    """
    folder = store_folder(tracking)
    folder.mkdir(parents=True, exist_ok=True)
    lock, holder = FileLock(folder / "sweep.lock"), folder / "sweep.json"
    try:
        lock.acquire(blocking=False)
    except Timeout:
        who = "another sweep"
        with suppress(OSError, ValueError, KeyError):  # it has not written its name yet
            other = json.loads(holder.read_text(encoding="utf-8"))
            who = f"another sweep, {other['sweep']} (process {other['process']}),"
        if not wait:
            raise BadInputError(
                f"{who} runs on this store ({masked(tracking)}); wait for it, or give --wait to start when it ends"
            ) from None
        print(f"waiting for {who}, which runs on this store", file=sys.stderr)
        lock.acquire()
    try:
        holder.write_text(json.dumps({"sweep": sweep, "process": os.getpid()}), encoding="utf-8")
        yield
    finally:
        holder.unlink(missing_ok=True)
        lock.release()


def _score(result: CellResult) -> float:
    curves = result.curves
    final = curves[(curves["metric"] == SCORE) & (curves["split"] == "test")]
    return float(final[final["epoch"] == final["epoch"].max()]["value"].mean())
