"""Have the policies of finished cells drive in closed loop, and commit their drives."""

from __future__ import annotations

import shutil
from collections.abc import Collection

import pandas as pd

from study.cell.flow import drive_flow, driven_folders, expert_flow
from study.config.keys import drive_key
from study.console.display import Display
from study.driving.drives import planned_drives
from study.engine.flows import Listener, run_flow, run_flows
from study.engine.tasks import Engine, Failure
from study.errors import BadInputError, masked
from study.planning.options import RunOptions
from study.planning.plan import Plan, cell_jobs
from study.stages import DRIVE, Flow
from study.tracking.driven import commit_drives
from study.tracking.reader import Reader
from study.tracking.tracker import Tracker


def undriven(plan: Plan, reader: Reader) -> list[str]:
    """Return the finished cells whose policies should drive and have not."""
    done = reader.driven(plan.settings, plan.drivers)
    return [key for key in reader.finished(plan.drivers) if key not in done]


def drive_cells(plan: Plan, options: RunOptions, tracker: Tracker, engine: Engine) -> dict[str, str]:
    """Have the policies of all finished cells drive; returns the cells that could not, with reasons."""
    waiting = undriven(plan, tracker.reader)
    if not waiting:
        return {}
    return _Driving(plan, options, tracker, waiting).run(engine)


class _Driving:
    """Offers the flows of cells that drive, and commits what they give."""

    def __init__(self, plan: Plan, options: RunOptions, tracker: Tracker, waiting: Collection[str]) -> None:
        self._plan, self._tracker = plan, tracker
        self._jobs = cell_jobs(plan, options.device, options.threads)
        self._runs = tracker.reader.finished(list(waiting))
        self._left, self._failed = list(waiting), dict[str, str]()
        self._expert = pd.DataFrame()
        self._drives = planned_drives(plan.settings)
        works = {key: self._jobs[key].work for key in waiting}
        costs = {key: DRIVE.cost(work) for key, work in works.items()}
        labels = {key: plan.cells[key].label for key in waiting}
        self._display = Display(f"{plan.title}, driving", costs, labels, 0.0, works, (DRIVE,))

    def run(self, engine: Engine) -> dict[str, str]:
        """Drive on an engine; returns the cells that could not, with reasons."""
        products = self._plan.workspace.data / "products"
        display = self._display
        with display:
            self._expert = run_flow(expert_flow(self._plan.settings, self._drives, products), engine)
            listener = Listener(self._finished, self._fail, display.progress, tick=display.tick, retry=display.retry)
            run_flows(engine, self._next, listener)
        return self._failed

    def _next(self) -> tuple[str, Flow[tuple[pd.DataFrame, dict[str, bytes]]]] | None:
        while self._left:
            key = self._left.pop(0)
            self._display.start(key)
            try:
                result = self._tracker.reader.load_result(self._runs[key])
            except BadInputError as error:
                self._give_up(key, str(error))
            else:
                return key, drive_flow(self._jobs[key], result, self._drives, self._expert)
        return None

    def _finished(self, key: str, value: tuple[pd.DataFrame, dict[str, bytes]]) -> None:
        try:
            commit_drives(self._tracker, self._runs[key], drive_key(self._plan.settings, key), *value)
        except BadInputError as error:  # the store is away, or the run was deleted: the drives are kept
            self._give_up(key, str(error))
            return
        for folder in driven_folders(self._jobs[key]):
            shutil.rmtree(folder, ignore_errors=True)
        self._display.finish(key)

    def _fail(self, key: str, failure: Failure) -> None:
        self._give_up(key, failure.reason)

    def _give_up(self, key: str, reason: str) -> None:
        self._failed[key] = f"its policies could not drive: {masked(reason)}"
        self._display.fail(key)
