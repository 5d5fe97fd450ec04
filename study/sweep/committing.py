"""The one writer of a sweep's results to MLflow."""

from __future__ import annotations

import os
import shutil
import threading
from collections.abc import Callable, Collection
from contextlib import suppress
from typing import Any, ParamSpec, Self, TypeVar

from tenacity import RetryCallState, Retrying, retry_if_exception_type, stop_after_delay, wait_fixed

from study.cell.flow import cell_flow, product_folders
from study.console.display import Display
from study.console.interrupts import check_stopped
from study.engine.flows import Listener
from study.engine.room import with_room
from study.engine.tasks import Failure
from study.engine.trials import Trials
from study.errors import BadInputError, masked
from study.planning.options import RunOptions
from study.planning.plan import Plan, cell_jobs
from study.results.cell_result import CellResult
from study.stages import Flow
from study.sweep.locks import store_folder
from study.tracking.cell_run import CellRun
from study.tracking.experiment import DeletedError, TrackerLostError
from study.tracking.tracker import Tracker

PATIENCE, RETRY = 600.0, 3.0  # [s] a lost server is waited for, and between two tries
END = 1.5  # [s] that a store has to be told of a stop
SCORE = "acceleration_accuracy"

P = ParamSpec("P")
T = TypeVar("T")


class Committing:
    """Offers the cells' flows to the engine, writes what they report, and commits their results."""

    def __init__(
        self,
        plan: Plan,
        options: RunOptions,
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
        self._store = store_folder(plan.workspace, options.tracking)
        self._trials = Trials(self._store / "optuna.db", plan.study_name, labels, order)
        # A file that cannot be written is no matter of seconds; a server that was restarted is.
        self._patience = 0.0 if tracker.experiment.is_file else PATIENCE

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
            self._display.retry,
            self.tick,
        )

    def started(self, name: str, host: str, process: int) -> None:
        """Open the cell's run when its first task starts; note who runs it."""
        if name not in self._runs:
            self._begin(name)
            self._display.start(name)
        self._runs[name].note(host=host, process=str(process))

    def progress(self, name: str, stage: str, done: int, total: int) -> None:
        """Show how far the cell is, and tag its run with it."""
        if name in self._runs:
            self._runs[name].progress(stage, done, total)
            self._display.progress(name, stage, done, total)

    def finished(self, name: str, value: tuple[CellResult, bytes]) -> None:
        """Commit a result."""
        result, network = value
        self._write(name, lambda run: self._tracker.commit(run, result, network))
        del self._runs[name]
        self._trials.finish(name, _score(result))
        for folder in product_folders(self._jobs[name]):
            shutil.rmtree(folder, ignore_errors=True)
        self._display.finish(name)

    def failed(self, name: str, failure: Failure) -> None:
        """Record why a cell has failed."""
        self._failed[name] = masked(failure.reason)
        if name not in self._runs:  # before anything of it ran
            self.started(name, "", os.getpid())
        self._write(name, lambda run: self._tracker.fail(run, failure.reason, permanent=not failure.transient))
        del self._runs[name]
        self._trials.fail(name, failure.reason)
        self._display.fail(name)

    def tick(self) -> None:
        """Write live curves, and draw the display again."""
        for name, run in list(self._runs.items()):
            try:
                run.flush_live()
            except DeletedError as error:
                self._begin_again(name, error)
        self._display.tick()

    def close(self) -> dict[str, str]:
        """End the sweep's run; returns the cells that failed, with the reasons."""
        self._restoring(self._tracker.close_sweep, self._sweep_run, "FAILED" if self._failed else "FINISHED")
        return self._failed

    def _begin(self, name: str) -> None:
        """Open a run for a cell."""
        job = self._jobs[name]
        words = self._sweep_run, job.cell, job.key, job.settings, job.policy_seeds
        self._runs[name] = self._restoring(self._tracker.start_cell, *words)

    def _begin_again(self, name: str, error: DeletedError) -> None:
        """Open another run for a cell whose run somebody has deleted; its training goes on."""
        self._display.say(f"{self._plan.cells[name].label}: {error}; the cell goes on in a new run")
        self._patiently(self._tracker.restore, self._sweep_run)
        self._begin(name)

    def _write(self, name: str, action: Callable[[CellRun], T]) -> T:
        """Write to a cell's run; when somebody has deleted it, to another one."""
        try:
            return self._patiently(action, self._runs[name])
        except DeletedError as error:
            self._begin_again(name, error)
            return self._patiently(action, self._runs[name])

    def _restoring(self, action: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
        """Do something; when somebody has deleted the sweep's run or the experiment, take that back and try again."""
        try:
            return self._patiently(action, *args, **kwargs)
        except DeletedError as error:
            self._display.say(f"{error}; it is restored, since this sweep writes to it")
            self._patiently(self._tracker.restore, self._sweep_run)
            return self._patiently(action, *args, **kwargs)

    def _patiently(self, action: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
        """Do something that can be done again, and wait for a server that is away meanwhile, or for room on a disk."""

        def say(state: RetryCallState) -> None:
            check_stopped()
            if state.attempt_number == 1 and state.outcome is not None:
                minutes = self._patience / 60
                self._display.say(f"{state.outcome.exception()}; trying again for {minutes:.0f} minutes")

        tries = Retrying(
            retry=retry_if_exception_type(TrackerLostError),
            stop=stop_after_delay(self._patience),
            wait=wait_fixed(RETRY),
            before_sleep=say,
            reraise=True,
        )
        return with_room(lambda: tries(action, *args, **kwargs), into=self._store)

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


def _score(result: CellResult) -> float:
    curves = result.curves
    final = curves[(curves["metric"] == SCORE) & (curves["split"] == "test")]
    return float(final[final["epoch"] == final["epoch"].max()]["value"].mean())
