"""MLflow as the one store of results: sweep run -> cell runs -> seed runs, written live, committed whole, read back.

A cell is done when its run is FINISHED with its `cell_key`. Everything a reader needs is logged before that, so a
process may be killed at any point. Each attempt at a cell has a run of its own: whatever an earlier one has logged
can then not double a curve, and is closed as KILLED when the next one starts.

Keys of metrics are `<stage>/<split>/<metric>`; on a cell run they hold the mean over the policy seeds, beside
`.../sd` (between seeds) and `.../low`, `.../high` (95 % interval of the mean, Student's t). `final/<metric>` is the
mean of the last five epochs on test frames. Steps are epochs, and a point's time is the run's start + its step [ms],
since MLflow takes the time into a point's identity.
"""

from __future__ import annotations

import json
import math
import os
import platform
import tempfile
import time
from collections.abc import Collection, Iterable, Mapping
from contextlib import AbstractContextManager, nullcontext, suppress
from pathlib import Path
from typing import Any, Self

import pandas as pd
from filelock import FileLock
from mlflow.entities import Dataset, DatasetInput, InputTag, Metric, Param, Run, RunTag

from study.config.grid import Cell, Grid
from study.config.keys import content_key
from study.config.settings import StudySettings
from study.config.workspace import DEFAULT_TRACKING
from study.errors import BadInputError, masked
from study.results.cell_result import ARRAYS, CellResult
from study.results.sweep_record import SweepRecord
from study.tracking.cell_run import ALIVE, HOST, PERMANENT, PROCESS, Attempt, CellRun, Status
from study.tracking.metrics import COMMIT, bands, cell_points, facts_of, flatten, points, scores_of
from study.tracking.model import log_model
from study.tracking.run_page import NOTE, about, welcome
from study.tracking.store import BUSY, TrackerLostError, few_tries, guard, insert, open_store

RESULT = "result"  # artifact folder of a cell run
RESULT_FILES = (*(f"{part}.safetensors" for part in ARRAYS), "curves.parquet", "cell.json")
PLAN_VERSION = 1
VALUE_LIMIT = 4000  # characters of a parameter or tag; MLflow takes 6000 and 8000, its databases 8000
PARENT = "mlflow.parentRunId"


class Tracker:
    """The store of results behind one URI and one experiment.

    Every method raises TrackerLostError, a BadInputError, when the store stops answering.
    """

    def __init__(self, uri: str = DEFAULT_TRACKING, experiment: str = "study") -> None:
        """Open the store and create what is missing. Raises BadInputError when it is not there or not MLflow's."""
        self._store = open_store(uri)
        self.uri, self.client = self._store.shown, self._store.client
        with guard(self.uri, opening=True), few_tries(BUSY):
            self.experiment = self._store.experiment(experiment, welcome)

    @classmethod
    def look(cls, uri: str = DEFAULT_TRACKING, experiment: str = "study") -> Self | None:
        """The store, or None where it has no such experiment: looking makes none."""
        store = open_store(uri)
        with guard(store.shown, opening=True), few_tries():
            found = store.client.get_experiment_by_name(experiment)
        return cls(uri, experiment) if found else None

    def _guard(self) -> AbstractContextManager[None]:
        return guard(self.uri)

    # --- sweeps ---------------------------------------------------------------------------------------------------

    def open_sweep(
        self,
        grid: Grid,
        profile: str,
        settings: StudySettings,
        planned: Mapping[str, Cell],
        data: Mapping[str, Any],
        provenance: Mapping[str, Any],
    ) -> str:
        """The run id of this plan's sweep run: the one there is, taken up again, or a new one.

        `data` is the frame store's manifest; it becomes an MLflow dataset whose digest is its `key`.
        """
        plan, key = _plan(grid, profile, settings, planned)
        name = f"{grid.name} ({profile})"
        facts = {name: value for name, value in provenance.items() if name != "diff"}
        with self._guard(), FileLock(self._store.lock) if self._store.lock else nullcontext():
            sweeps = self._search("tags.kind = 'sweep'")
            latest = max((_opened(run) for run in sweeps), default=0)
            tags = {
                "opened": str(max(time.time_ns() // 1_000_000, latest + 1)),  # the order holds when a clock jumps
                "uncommitted": str(bool(provenance.get("dirty"))).lower(),
                "reused": self._reused(planned, name),
                **({COMMIT: str(provenance["commit"])} if provenance.get("commit") else {}),
            }
            params = _params({**flatten(plan["grid"]), "profile": profile, **flatten(plan["settings"])})
            mine = [run for run in sweeps if run.data.tags.get("plan_key") == key]
            if mine:
                run_id = str(mine[0].info.run_id)
                self.client.update_run(run_id, status="RUNNING")
            else:
                identity = {"kind": "sweep", "sweep": grid.name, "profile": profile, "plan_key": key, NOTE: grid.title}
                identity["mlflow.source.name"] = _short(str(provenance.get("command", "python -m study.sweep")))
                created = self._create(name, identity)
                run_id = str(self._search(f"tags.plan_key = '{key}'")[0].info.run_id)
                if created != run_id:  # a server has no lock: of two parents started at once, both take the first
                    self.client.set_terminated(created, "KILLED")
                    self.client.delete_run(created)
            for run in sweeps:
                # A database file belongs to one machine, where one sweep runs at a time: others were killed.
                if self._store.database and run.info.status == "RUNNING" and run.info.run_id != run_id:
                    self._close_cells(run.info.run_id)
                    self._close(run.info.run_id, "KILLED", {"reason": "another sweep was started"})
            insert(self.client.log_batch, run_id, params=params)
            self.client.log_batch(run_id, tags=[RunTag(name, _short(value)) for name, value in tags.items() if value])
            self.client.log_dict(run_id, plan, "plan.json")
            if data or not mine:  # frames that were deleted since are still what the results were made from
                self.client.log_dict(run_id, dict(data), "data.json")
            self.client.log_dict(run_id, facts, "provenance.json")
            self.client.log_text(run_id, str(provenance.get("diff") or ""), "uncommitted.diff")
            if data:
                insert(self.client.log_inputs, run_id, datasets=[_dataset(data)])
        return run_id

    def _reused(self, planned: Mapping[str, Cell], name: str) -> str:
        """Planned cells that another sweep has finished, in words."""
        runs = self._finished(planned)
        others = {key: run.data.tags.get("sweep", "") for key, run in runs.items()}
        return ", ".join(f"{planned[key].label} from {sweep}" for key, sweep in others.items() if sweep != name)

    def close_sweep(self, sweep_run_id: str, status: Status) -> None:
        """End a sweep run, and whatever cell run under it still says RUNNING. Quick when it was stopped (KILLED)."""
        with self._guard(), few_tries() if status == "KILLED" else nullcontext():
            self._close_cells(sweep_run_id)
            planned = self._json(sweep_run_id, "plan.json")["planned"]
            done = len(self._finished(planned))
            self.client.set_tag(sweep_run_id, "cells", f"{done} of {len(planned)} finished")
            self.client.set_terminated(sweep_run_id, status)

    def _close_cells(self, sweep_run_id: str) -> None:
        running = f"tags.kind = 'cell' and attributes.status = 'RUNNING' and tags.`{PARENT}` = '{sweep_run_id}'"
        for run in self._search(running):
            self._close(run.info.run_id, "KILLED", {"reason": "the sweep ended"})

    def sweep_run(self, name: str, profile: str | None = None) -> str:
        """Run id of the latest sweep run of that name. Raises BadInputError naming the sweeps there are."""
        with self._guard():
            sweeps = sorted(self._search("tags.kind = 'sweep'"), key=_opened)
        for run in reversed(sweeps):
            tags = run.data.tags
            if tags.get("sweep") == name and profile in (None, tags.get("profile")):
                return str(run.info.run_id)
        wanted = f"{name} ({profile})" if profile else name
        there = ", ".join(sorted({str(run.info.run_name) for run in sweeps})) or "none yet"
        raise BadInputError(
            f"no sweep '{wanted}' in {self.uri}; there are: {there}. Run it with: python -m study.sweep {name}"
        )

    def read_sweep(self, name: str, profile: str | None = None) -> SweepRecord:
        """The latest sweep of that name with its finished cells, whichever sweep has trained them."""
        return self._read(self.sweep_run(name, profile))

    def read_variants(self, record: SweepRecord) -> dict[str, SweepRecord]:
        """Sweeps of the same profile that differ from this one in one confound alone; of each the latest."""
        from study.analysis.confounds import contrasts, varied  # noqa: PLC0415 - scipy, which only reports need

        found: dict[str, SweepRecord] = {}
        with self._guard():
            sweeps = sorted(self._search("tags.kind = 'sweep'"), key=_opened, reverse=True)
        for run in sweeps:
            if run.data.tags.get("profile") != record.profile:
                continue
            try:
                settings = StudySettings.model_validate(self._json(run.info.run_id, "plan.json")["settings"])
                confound = varied(record.settings, settings)
                if confound is None or confound.setting in found:
                    continue
                other = self._read(run.info.run_id)
            except (BadInputError, ValueError):  # planned by another version, or damaged: nothing to compare with
                continue
            if contrasts(record, other, confound):
                found[confound.setting] = other
        return found

    def _read(self, run_id: str) -> SweepRecord:
        with self._guard():
            plan = self._json(run_id, "plan.json")
            if plan.get("format_version") != PLAN_VERSION:
                raise BadInputError(f"sweep run {run_id}: plan format {plan.get('format_version')}, not {PLAN_VERSION}")
            provenance = self._json(run_id, "provenance.json") | {"diff": self._text(run_id, "uncommitted.diff")}
            data = self._json(run_id, "data.json")
            try:
                planned = {key: Cell.model_validate(cell) for key, cell in plan["planned"].items()}
                grid, settings = Grid.model_validate(plan["grid"]), StudySettings.model_validate(plan["settings"])
            except ValueError as error:  # pydantic's complaint is one
                raise BadInputError(
                    f"sweep run {run_id} in {self.uri} was planned by another version of this program ({error}); "
                    "run the sweep again"
                ) from error
            done = self.finished(planned)
            failed = {
                key: run.data.tags.get("reason", "unknown")
                for run in self._search("tags.kind = 'cell' and attributes.status = 'FAILED'")
                if (key := run.data.tags.get("cell_key")) in planned and key not in done
            }
        results = {key: self.load_result(done[key]) for key in planned if key in done}
        return SweepRecord(grid, str(plan["profile"]), settings, planned, results, failed, provenance, data)

    # --- cells ----------------------------------------------------------------------------------------------------

    def finished(self, keys: Collection[str]) -> dict[str, str]:
        """Key -> run id of the cells that are done, whichever sweep has trained them; of several, the first done."""
        with self._guard():
            return {key: str(run.info.run_id) for key, run in self._finished(keys).items()}

    def _finished(self, keys: Collection[str]) -> dict[str, Run]:
        wanted = set(keys)
        runs = self._search("tags.kind = 'cell' and attributes.status = 'FINISHED'")
        found: dict[str, Run] = {}
        for run in sorted(runs, key=_finished_order):
            key = run.data.tags.get("cell_key")
            if key in wanted:
                found.setdefault(key, run)
        return {key: found[key] for key in keys if key in found}

    def attempts(self, keys: Collection[str]) -> dict[str, list[Attempt]]:
        """Key -> the tries at that cell, the first first; cells that nobody has tried are left out."""
        found: dict[str, list[Attempt]] = {}
        with self._guard():
            for run in self._search("tags.kind = 'cell'"):
                key = run.data.tags.get("cell_key")
                if key in keys:
                    about = run.info
                    attempt = Attempt(about.run_id, about.status, about.start_time, run.data.tags, run.data.metrics)
                    found.setdefault(key, []).append(attempt)
        return found

    def given_up(self, keys: Collection[str]) -> dict[str, str]:
        """Key -> reason of the cells whose last attempt has failed for a reason that another try would meet again."""
        last = {key: attempts[-1] for key, attempts in self.attempts(keys).items()}
        return {
            key: attempt.tags.get("reason", "unknown")
            for key, attempt in last.items()
            if attempt.status == "FAILED" and PERMANENT in attempt.tags
        }

    def start_cell(
        self, sweep_run_id: str, cell: Cell, key: str, settings: StudySettings, policy_seeds: int
    ) -> CellRun:
        """A new attempt at a cell. Earlier attempts that still say RUNNING are closed as KILLED."""
        params = {
            "heads": cell.heads,
            "fraction": cell.fraction,
            "encoder_seed": cell.encoder_seed,
            "policy_seeds": policy_seeds,
            **flatten(settings.model_dump(mode="json")),
        }
        with self._guard():
            before = self._search(f"tags.kind = 'cell' and tags.cell_key = '{key}'")
            sweep = self.client.get_run(sweep_run_id)
            tags = {
                "kind": "cell",
                "cell_key": key,
                "attempt": str(1 + len(before)),
                "sweep": sweep.info.run_name,
                "state": "running",
                NOTE: about(cell, policy_seeds),
                PARENT: sweep_run_id,
            }
            started = time.time_ns() // 1_000_000
            tags |= {HOST: platform.node(), PROCESS: str(os.getpid()), ALIVE: str(started)}
            run_id = self._create(cell.label, tags, started)
            for run in before:
                if run.info.status == "RUNNING":
                    self._close(run.info.run_id, "KILLED", {"superseded_by": run_id})
                attempt = run.data.tags.get("attempt", "?")
                if run.info.status != "FINISHED" and run.info.run_name == cell.label:
                    self.client.update_run(run.info.run_id, name=f"{cell.label} (attempt {attempt})")
            self.client.log_batch(run_id, params=_params(params))
            if sweep.inputs.dataset_inputs:
                self.client.log_inputs(run_id, datasets=sweep.inputs.dataset_inputs)
        return CellRun(run_id, key, cell, started, self.client)

    def commit(self, cell_run: CellRun, result: CellResult, network: bytes = b"") -> str:
        """Log a result whole, and only then mark its run FINISHED. Returns the run id that holds the key's result.

        `network`, the result's as study.driving.driver makes it, becomes the run's MLflow model `driver`.
        When another attempt has finished this key meanwhile, that one counts and this run ends as KILLED. After a
        TrackerLostError it can be called again: nothing is doubled.
        """
        if result.key != cell_run.key:
            raise ValueError(f"result of cell {result.key} given for the run of {cell_run.key}")
        with self._guard():
            other = self._finished([cell_run.key]).get(cell_run.key)
            if other is not None and other.info.run_id != cell_run.run_id:
                self._close(cell_run.run_id, "KILLED", {"superseded_by": other.info.run_id})
                return str(other.info.run_id)
            with tempfile.TemporaryDirectory() as folder:
                for file in sorted(result.save(Path(folder) / RESULT).iterdir()):
                    self.client.log_artifact(cell_run.run_id, str(file), RESULT)
            if diff := result.facts.get("provenance", {}).get("diff"):
                self.client.log_text(cell_run.run_id, diff, "uncommitted.diff")
            scores = scores_of(result)
            self._log_seeds(cell_run, result.curves, scores)
            cell_run.add(cell_points(result.curves))
            cell_run.flush()
            numbers, words = facts_of(result.facts)
            words["state"] = "finished"
            for ending, values in bands(scores).items():
                numbers |= {
                    f"final/{name}{ending}": float(f"{v:.5g}") for name, v in zip(scores.columns, values, strict=True)
                }
            model = log_model(self.client, self.experiment, cell_run.run_id, result, network) if network else None
            self.client.log_batch(
                cell_run.run_id,
                metrics=[
                    Metric(name, float(value), cell_run.started, 0, model_id=model)
                    for name, value in numbers.items()
                    if math.isfinite(value)
                ],
                tags=[RunTag(name, _short(value)) for name, value in words.items()],
            )
            self.client.set_terminated(cell_run.run_id, "FINISHED")
            return self._settle(cell_run)

    def _settle(self, cell_run: CellRun) -> str:
        """Leave one finished run of a key: a process may have been stopped between its last look and its last word."""
        first, *others = sorted(
            (
                run
                for run in self._search(f"tags.cell_key = '{cell_run.key}' and attributes.status = 'FINISHED'")
                if run.data.tags.get("kind") == "cell"
            ),
            key=_finished_order,
        )
        for other in others:
            self._close(other.info.run_id, "KILLED", {"superseded_by": first.info.run_id})
        return str(first.info.run_id)

    def _log_seeds(self, cell_run: CellRun, curves: pd.DataFrame, scores: pd.DataFrame) -> None:
        start = cell_run.started
        for seed in scores.index.tolist():
            if seed not in cell_run.seeds:
                tags = {"kind": "seed", "policy_seed": str(seed), PARENT: cell_run.run_id}
                cell_run.seeds[seed] = self._create(f"policy {seed:02d}", tags, start)
            own = points(curves[curves["policy_seed"] == seed])
            metrics = [Metric(name, value, start + epoch, epoch) for name, epoch, value in own]
            metrics += [Metric(f"final/{name}", value, start, 0) for name, value in scores.loc[seed].to_dict().items()]
            self.client.log_batch(cell_run.seeds[seed], metrics=metrics)
            self.client.set_terminated(cell_run.seeds[seed], "FINISHED")

    def fail(self, cell_run: CellRun, reason: str, *, permanent: bool = False) -> None:
        """End an attempt that cannot be finished; the reason becomes a tag and, in full, an artifact.

        `permanent`: the next start of the sweep need not try again.
        """
        with self._guard():
            cell_run.flush()
            self.client.log_text(cell_run.run_id, masked(reason), "failure.txt")
            tags = {"reason": masked(reason)} | ({PERMANENT: "true"} if permanent else {})
            self._close(cell_run.run_id, "FAILED", tags)

    def interrupt(self, cell_run: CellRun, reason: str = "stopped") -> None:
        """End an attempt that was stopped, quickly; when the store does not answer, the next attempt closes it."""
        with suppress(TrackerLostError), self._guard(), few_tries():
            self._close(cell_run.run_id, "KILLED", {"reason": reason})

    def load_result(self, run_id: str) -> CellResult:
        """The result that a finished cell run holds. Raises BadInputError when it is not whole."""
        with self._guard(), tempfile.TemporaryDirectory() as name:
            key = self.client.get_run(run_id).data.tags.get("cell_key")
            folder = Path(name)
            there = {Path(file.path).name for file in self.client.list_artifacts(run_id, RESULT)}
            try:
                # Only names that we know are asked for, so no name from the store can point out of the folder.
                for file in RESULT_FILES:
                    if file not in there:
                        raise FileNotFoundError(f"{file} is missing")  # noqa: TRY301 - one report for all damage
                    Path(self.client.download_artifacts(run_id, f"{RESULT}/{file}", name)).replace(folder / file)
                result = CellResult.load(folder)
                wrong = f"it is the result of cell {result.key}" if result.key != key else ""
            except (OSError, BadInputError) as error:
                wrong = str(error).replace(f"{name}/", "").replace(name, RESULT)
            if wrong:
                raise BadInputError(
                    f"cell run {run_id} in {self.uri} is FINISHED but does not hold the whole result of cell {key} "
                    f"({wrong}); delete that run in MLflow and run the sweep again"
                )
        return result

    def log_files(self, run_id: str, files: Iterable[Path], artifact_path: str) -> None:
        """Add files to a run's artifacts."""
        with self._guard():
            for file in files:
                self.client.log_artifact(run_id, str(file), artifact_path)

    # --- below ----------------------------------------------------------------------------------------------------

    def _search(self, query: str) -> list[Run]:
        """All runs that match, the first started first."""
        runs: list[Run] = []
        token = None
        while True:
            page = self.client.search_runs([self.experiment], query, max_results=1000, page_token=token)
            runs += page
            token = page.token
            if not token:
                return sorted(runs, key=lambda run: (run.info.start_time, run.info.run_id))

    def _create(self, name: str, tags: Mapping[str, str], start: int | None = None) -> str:
        return str(self.client.create_run(self.experiment, start, dict(tags), name).info.run_id)

    def _close(self, run_id: str, status: Status, tags: Mapping[str, str]) -> None:
        """End a run and the seed runs below it."""
        for seed in self._search(f"tags.kind = 'seed' and tags.`{PARENT}` = '{run_id}'"):
            if seed.info.status == "RUNNING":
                self.client.set_terminated(seed.info.run_id, status)
        for model in self.client.search_logged_models([self.experiment], f"source_run_id = '{run_id}'"):
            self.client.delete_logged_model(model.model_id)  # its upload was cut off, and would seem to go on for ever
        words = {**tags, "state": status.lower()}
        self.client.log_batch(run_id, tags=[RunTag(name, _short(value)) for name, value in words.items()])
        self.client.set_terminated(run_id, status)

    def _text(self, run_id: str, name: str) -> str:
        with tempfile.TemporaryDirectory() as folder:
            return Path(self.client.download_artifacts(run_id, name, folder)).read_text(encoding="utf-8")

    def _json(self, run_id: str, name: str) -> dict[str, Any]:
        content = json.loads(self._text(run_id, name))
        if not isinstance(content, dict):
            raise BadInputError(f"{name} of run {run_id} in {self.uri} is no JSON object; run the sweep again")
        return content


def _plan(grid: Grid, profile: str, settings: StudySettings, planned: Mapping[str, Cell]) -> tuple[dict[str, Any], str]:
    """What a sweep run keeps of its plan, and its key."""
    plan: dict[str, Any] = {
        "format_version": PLAN_VERSION,
        "grid": grid.model_dump(mode="json"),
        "profile": profile,
        "settings": settings.model_dump(mode="json"),
        "planned": {key: cell.model_dump(mode="json") for key, cell in planned.items()},
    }
    return plan, content_key("sweep run", plan, (), PLAN_VERSION)


def _short(text: str) -> str:
    return text if len(text) <= VALUE_LIMIT else f"{text[: VALUE_LIMIT - 40]}... [{len(text)} characters, cut]"


def _params(values: Mapping[str, Any]) -> list[Param]:
    texts = {name: value if isinstance(value, str) else json.dumps(value) for name, value in values.items()}
    return [Param(name, _short(text)) for name, text in texts.items()]


def _dataset(data: Mapping[str, Any]) -> DatasetInput:
    digest = str(data.get("key") or content_key("data", dict(data), (), PLAN_VERSION))
    source = json.dumps({"tags": {"frame store": digest, "manifest": "data.json of the sweep run"}})
    profile = json.dumps({name: value for name, value in flatten(data).items() if isinstance(value, int | float)})
    entity = Dataset("frames", digest[:36], "code", source, profile=profile[:100_000])
    return DatasetInput(entity, [InputTag("mlflow.data.context", "train and test")])


def _finished_order(run: Run) -> tuple[int, str]:
    return int(run.info.end_time), str(run.info.run_id)


def _opened(run: Run) -> int:
    return int(run.data.tags.get("opened", 0))
