"""Read results from MLflow: which cells are finished, how attempts stand, and whole sweeps for reports.

A cell is done when its run is FINISHED with its `cell_key`, whichever sweep has trained it.
"""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any, Self

import pandas as pd
from mlflow.entities import Run

from study.atomic import scratch_folder
from study.config.grid import Cell, Grid
from study.config.keys import drive_key
from study.config.settings import StudySettings
from study.config.workspace import HERE
from study.errors import BadInputError, masked
from study.results.cell_result import CellResult
from study.results.sweep_record import SweepRecord
from study.tracking.cell_run import ALIVE, HOST, PROCESS
from study.tracking.experiment import Experiment, TrackerLostError, UnreadableError, find_experiment

PLAN_VERSION = 1
RESULT = "result"  # artifact folder of a cell run
DRIVES = PurePosixPath("drives/drives.parquet")  # artifact of a cell run whose policies have driven
DRIVE_KEY = "drive_key"  # its tag, written last
SWEEP_FILES = ("plan.json", "data.json", "provenance.json", "uncommitted.diff")  # artifacts of a sweep run
PARENT = "mlflow.parentRunId"  # tag of a cell's run and of a seed's: the run above it
LEAST = 6  # characters of a run id that name a sweep
LIVES = 600.0  # [s] around a sign of life from another machine, whose clock may differ by minutes
PERMANENT = "permanent"  # tag of a failed attempt: another try would not help


@dataclass(frozen=True)
class Attempt:
    """One attempt at a cell; `started` in ms since 1970."""

    run_id: str
    status: str
    started: int
    tags: Mapping[str, str]
    metrics: Mapping[str, float]


@dataclass(frozen=True)
class Reader:
    """Reads the results in an experiment. Every method raises TrackerLostError when the store stops answering."""

    experiment: Experiment

    @classmethod
    def look(cls, uri: str = HERE.tracking, experiment: str = "study") -> Self | None:
        """Return a reader, or None where nothing was tracked yet, and create nothing."""
        opened = find_experiment(uri, experiment)
        return cls(opened) if opened else None

    @classmethod
    def existing(cls, uri: str = HERE.tracking) -> Self:
        """Return a reader, and create nothing. Raises BadInputError where nothing was tracked yet."""
        if reader := cls.look(uri):
            return reader
        raise BadInputError(f"nothing was tracked in {masked(uri)} yet; run a sweep, or name its store with --tracking")

    def finished(self, keys: Collection[str]) -> dict[str, str]:
        """Return key -> run id of the cells that are done; of several runs of one key, the first that was done."""
        return {key: str(run.info.run_id) for key, run in self.finished_runs(keys).items()}

    def finished_runs(self, keys: Collection[str]) -> dict[str, Run]:
        """Return key -> run of the cells that are done, as `finished`."""
        with self.experiment.guard():
            runs = self.experiment.search("tags.kind = 'cell' and attributes.status = 'FINISHED'")
        first: dict[str, Run] = {}
        for run in in_order_of_end(runs):
            first.setdefault(run.data.tags.get("cell_key"), run)
        return {key: first[key] for key in keys if key in first}

    def attempts(self, keys: Collection[str]) -> dict[str, list[Attempt]]:
        """Return key -> the attempts at that cell in their order; cells without any are left out."""
        attempts: dict[str, list[Attempt]] = {}
        with self.experiment.guard():
            runs = self.experiment.search("tags.kind = 'cell'")
        for run in runs:
            if (key := run.data.tags.get("cell_key")) in keys:
                info, data = run.info, run.data
                attempt = Attempt(info.run_id, info.status, info.start_time, data.tags, data.metrics)
                attempts.setdefault(key, []).append(attempt)
        return attempts

    def given_up(self, keys: Collection[str]) -> dict[str, str]:
        """Return key -> reason of the cells whose last attempt has failed for a permanent reason."""
        last = {key: attempts[-1] for key, attempts in self.attempts(keys).items()}
        return {key: reason_of(attempt.tags) for key, attempt in last.items() if PERMANENT in attempt.tags}

    def load_result(self, run_id: str) -> CellResult:
        """Return the result that a finished cell run holds. Raises UnreadableError when it is missing or damaged."""
        with self.experiment.guard(), scratch_folder() as folder:
            key = self.experiment.client.get_run(run_id).data.tags.get("cell_key")
            try:
                result = CellResult.load(self.experiment.download(run_id, RESULT, folder))
                problem = "" if result.key == key else f"it is the result of cell {result.key}"
            except TrackerLostError:
                raise
            except (OSError, BadInputError) as error:
                problem = str(error).replace(f"{folder}/", "")
        if problem:
            raise UnreadableError(
                f"cell run {run_id} in {self.experiment.uri} is FINISHED but does not hold the result of cell {key} "
                f"({problem}); delete that run in MLflow and run the sweep again"
            )
        return result

    def driven(self, settings: StudySettings, keys: Collection[str]) -> dict[str, str]:
        """Return key -> run id of the finished cells whose policies have driven as these settings say."""
        runs = self.finished_runs(keys)
        return {
            key: str(run.info.run_id)
            for key, run in runs.items()
            if run.data.tags.get(DRIVE_KEY) == drive_key(settings, key)
        }

    def load_drives(self, run_id: str) -> pd.DataFrame:
        """Return the drives that a cell's run holds. Raises UnreadableError when they are missing or damaged."""
        with self.experiment.guard(), scratch_folder() as folder:
            try:
                return pd.read_parquet(self.experiment.download(run_id, str(DRIVES), folder))
            except (OSError, ValueError) as error:
                problem = str(error).replace(f"{folder}/", "")
        raise UnreadableError(f"{DRIVES} of run {run_id} in {self.experiment.uri} cannot be read: {problem}")

    def sweep_runs(self) -> list[Run]:
        """Return the sweep runs, the latest opened last."""
        with self.experiment.guard():
            return sorted(self.experiment.search("tags.kind = 'sweep'"), key=opened_at)

    def lives(self, sweep_run: Run) -> bool:
        """Return whether the process that opened a sweep goes on, as far as that can be known."""
        tags = sweep_run.data.tags
        process = tags.get(PROCESS, "")
        if tags.get(HOST) == platform.node():
            return process.isdecimal() and process != str(os.getpid()) and Path(f"/proc/{process}").exists()
        cells = self.experiment.search(running_cells(sweep_run.info.run_id))
        heard = max((int(cell.data.tags.get(ALIVE, 0)) for cell in cells), default=0)
        return abs(time.time() - heard / 1000) < LIVES

    def sweeps_of(self, name: str, profile: str | None = None) -> list[str]:
        """Return the run ids of the sweeps that `is_named` so, the latest first. Raises BadInputError for none."""
        runs = self.sweep_runs()
        found = [
            str(run.info.run_id)
            for run in reversed(runs)
            if is_named(run, name) and profile in (None, run.data.tags.get("profile"))
        ]
        if found:
            return found
        wanted = f"{name} ({profile})" if profile else name
        names = ", ".join(sorted({str(run.info.run_name) for run in runs})) or "none yet"
        raise BadInputError(
            f"no sweep '{wanted}' in {self.experiment.uri}; there are: {names}. Run it with python -m study.sweep, "
            "or take a run id that python -m study.sweep clean lists"
        )

    def read_sweep(self, name: str, profile: str | None = None) -> SweepRecord:
        """Return the latest readable sweep of that name with its finished cells; what is unreadable is named in it."""
        unread: list[str] = []
        for run_id in self.sweeps_of(name, profile):
            try:
                record = self.read_sweep_run(run_id)
            except UnreadableError as error:
                unread.append(str(error))
            else:
                return replace(record, unread=(*unread, *record.unread))
        raise UnreadableError(
            f"no sweep '{name}' can be read: {'; '.join(unread)}. Run the sweep again: what is finished is kept"
        )

    def read_settings(self, sweep_run_id: str) -> StudySettings:
        """Return a sweep's settings. Raises BadInputError when another version of this program planned it."""
        return self.read_plan(sweep_run_id)[2]

    def read_sweep_run(self, run_id: str) -> SweepRecord:
        """Return a sweep with its finished cells. Raises UnreadableError when its plan or its data cannot be read."""
        missing = self._missing(run_id)
        if missing and {"plan.json", "data.json"} & set(missing):
            raise UnreadableError(self._lacks(run_id, missing))
        grid, profile, settings, planned = self.read_plan(run_id)
        data = self.experiment.read_json(run_id, "data.json")
        unread = [self._lacks(run_id, missing)] if missing else []
        provenance: dict[str, Any] = {}
        try:
            if not missing:
                provenance = self.experiment.read_json(run_id, "provenance.json")
                provenance["diff"] = self.experiment.read_text(run_id, "uncommitted.diff")
        except UnreadableError as error:
            unread.append(str(error))
        with self.experiment.guard():
            failures = self.experiment.search("tags.kind = 'cell' and attributes.status = 'FAILED'")
        done = self.finished(planned)
        reasons = {run.data.tags.get("cell_key"): reason_of(run.data.tags) for run in failures}
        failed = {key: reason for key, reason in reasons.items() if key in planned and key not in done}
        results: dict[str, CellResult] = {}
        lost: list[str] = []
        for key, run in done.items():
            try:
                results[key] = self.load_result(run)
            except UnreadableError as error:
                failed[key] = f"its result cannot be read: {error}"
                unread.append(f"{planned[key].label}: {error}")
                lost.append(key)
        drives: dict[str, pd.DataFrame] = {}
        for key, run in self.driven(settings, list(results)).items():
            try:
                drives[key] = self.load_drives(run)
            except UnreadableError as error:
                unread.append(f"drives of {planned[key].label}: {error}")
        return SweepRecord(
            grid,
            profile,
            settings,
            planned,
            results,
            failed,
            provenance,
            data,
            run_id=run_id,
            unread=tuple(unread),
            lost=tuple(lost),
            drives=drives,
        )

    def _missing(self, run_id: str) -> list[str]:
        """Return the files that a sweep's run lacks, all of them."""
        with self.experiment.guard():
            there = {file.path for file in self.experiment.client.list_artifacts(run_id)}
        return [name for name in SWEEP_FILES if name not in there]

    def _lacks(self, run_id: str, missing: Sequence[str]) -> str:
        return f"{', '.join(missing)} of run {run_id} in {self.experiment.uri} cannot be read: no such artifact"

    def read_plan(self, run_id: str) -> tuple[Grid, str, StudySettings, dict[str, Cell]]:
        """Return a sweep's grid, profile, settings and cells by key. Raises as `read_settings` and `download`."""
        plan = self.experiment.read_json(run_id, "plan.json")
        try:
            if plan.get("format_version") != PLAN_VERSION:
                raise ValueError(f"format {plan.get('format_version')}, not {PLAN_VERSION}")  # noqa: TRY301
            planned = {key: Cell.model_validate(cell) for key, cell in plan["planned"].items()}
            grid = Grid.model_validate(plan["grid"])  # first: it loads the heads that the settings may name
            return grid, str(plan["profile"]), StudySettings.model_validate(plan["settings"]), planned
        except (ValueError, KeyError, TypeError, AttributeError) as error:  # pydantic's error is a ValueError
            raise BadInputError(
                f"sweep run {run_id} in {self.experiment.uri} was planned by another version of this program "
                f"({error}); run the sweep again"
            ) from error


def is_named(sweep_run: Run, name: str) -> bool:
    """Return whether a sweep has this name, with or without its profile, or a run id that begins so."""
    names = sweep_run.data.tags.get("sweep"), sweep_run.info.run_name
    return name in names or (len(name) >= LEAST and sweep_run.info.run_id.startswith(name))


def running_cells(sweep_run_id: str) -> str:
    """Return the query for the attempts of a sweep that are RUNNING."""
    return f"tags.kind = 'cell' and attributes.status = 'RUNNING' and tags.`{PARENT}` = '{sweep_run_id}'"


def reason_of(tags: Mapping[str, str]) -> str:
    """Return why an attempt has failed."""
    return tags.get("reason", "unknown")


def in_order_of_end(runs: Iterable[Run]) -> list[Run]:
    """Return finished runs, the first that ended first: of two results of one key it counts."""
    return sorted(runs, key=lambda run: (run.info.end_time, run.info.run_id))


def opened_at(sweep_run: Run) -> int:
    """Return when a sweep was last opened, in ms since 1970."""
    return int(sweep_run.data.tags.get("opened", 0))
