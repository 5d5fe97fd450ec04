"""Write results to MLflow: sweep run -> cell runs -> seed runs, live while they train, and committed as a whole.

A cell is done when its run is FINISHED with its `cell_key`. Everything a reader needs is logged before that, so a
process may be killed at any point. Each attempt at a cell has a run of its own: what an earlier attempt has logged
cannot double a curve. It is closed as KILLED when the next one starts.

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
import time
from collections.abc import Iterable, Mapping
from contextlib import nullcontext, suppress
from pathlib import Path
from typing import Any

import pandas as pd
from mlflow.entities import Dataset, DatasetInput, InputTag, Metric, Param, RunTag

from study.atomic import scratch_folder
from study.config.grid import Cell, Grid
from study.config.keys import content_key
from study.config.settings import StudySettings
from study.config.workspace import HERE
from study.errors import masked
from study.results.cell_result import CellResult
from study.tracking.cell_run import ALIVE, HOST, PROCESS, CellRun, Status
from study.tracking.experiment import DeletedError, TrackerLostError, UnreadableError, few_tries, open_experiment
from study.tracking.metrics import COMMIT, bands, cell_points, describe_facts, final_scores, flatten, known, points
from study.tracking.model import log_model
from study.tracking.reader import (
    PARENT,
    PERMANENT,
    PLAN_VERSION,
    RESULT,
    Reader,
    in_order_of_end,
    opened_at,
    running_cells,
)
from study.tracking.run_page import NOTE, cell_tags

VALUE_LIMIT = 4000  # characters of a parameter or tag; MLflow takes 6000 and 8000, its databases 8000


class Tracker:
    """The writer of an experiment; `reader` reads from the same one.

    Every method raises TrackerLostError, a BadInputError, when the store stops answering, and DeletedError, another,
    when somebody has deleted the run that it writes to.
    """

    def __init__(self, uri: str = HERE.tracking, experiment: str = "study") -> None:
        """Open the store and create what is missing. Raises BadInputError when it cannot be used."""
        self.experiment = open_experiment(uri, experiment)
        self.reader = Reader(self.experiment)
        self.client = self.experiment.client

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
        """Return the run id of this plan's sweep run: an earlier one is resumed, else a new one is created.

        `data` is the frame store's manifest; it becomes an MLflow dataset whose digest is its `key`.
        """
        plan: dict[str, Any] = {
            "format_version": PLAN_VERSION,
            "grid": grid.model_dump(mode="json"),
            "profile": profile,
            "settings": settings.model_dump(mode="json"),
            "planned": {key: cell.model_dump(mode="json") for key, cell in planned.items()},
        }
        key, name = content_key("sweep run", plan, (), PLAN_VERSION), f"{grid.name} ({profile})"
        with self.experiment.guard():
            sweeps = self.reader.sweep_runs()
            latest = max(map(opened_at, sweeps), default=0)
            tags = {
                "opened": str(max(time.time_ns() // 1_000_000, latest + 1)),  # the order holds when a clock jumps
                "uncommitted": known(provenance, "dirty"),
                "reused": self._describe_reused(planned, name),
                COMMIT: known(provenance, "commit"),
                HOST: platform.node(),
                PROCESS: str(os.getpid()),
            }
            resumed = [str(run.info.run_id) for run in sweeps if run.data.tags.get("plan_key") == key]
            if resumed:
                run_id = resumed[0]
                self.client.update_run(run_id, status="RUNNING")
            else:
                identity = {"kind": "sweep", "sweep": grid.name, "profile": profile, "plan_key": key, NOTE: grid.title}
                identity["mlflow.source.name"] = _short(str(provenance.get("command", "python -m study.sweep")))
                run_id = self._create_run(name, identity)
            for run in sweeps:
                # One sweep at a time opens a database file: the others were killed, unless they go through a server.
                running = run.info.status == "RUNNING" and run.info.run_id != run_id
                if self.experiment.is_file and running and not self.reader.lives(run):
                    self._close_cells(run.info.run_id)
                    self._close_run(run.info.run_id, "KILLED", {"reason": "another sweep was started"})
            params = _params({**flatten(plan["grid"]), "profile": profile, **flatten(plan["settings"])})
            self.client.log_batch(run_id, params=params, tags=_tags(tags))
            self.client.log_dict(run_id, plan, "plan.json")
            if data or not resumed:  # the manifest of frames that were deleted since is kept
                self.client.log_dict(run_id, dict(data), "data.json")
            if data:
                self.client.log_inputs(run_id, datasets=[_dataset(data)])
            facts = {name: value for name, value in provenance.items() if name != "diff"}
            self.client.log_dict(run_id, facts, "provenance.json")
            self.client.log_text(run_id, str(provenance.get("diff") or ""), "uncommitted.diff")
        return run_id

    def _describe_reused(self, planned: Mapping[str, Cell], name: str) -> str:
        """Return the planned cells that another sweep has finished, in words."""
        runs = self.reader.finished_runs(planned)
        sources = {key: run.data.tags.get("sweep", "") for key, run in runs.items()}
        return ", ".join(f"{planned[key].label} from {sweep}" for key, sweep in sources.items() if sweep != name)

    def close_sweep(self, sweep_run_id: str, status: Status) -> None:
        """End a sweep run and the cell runs under it that are still RUNNING; KILLED does not wait long for a server."""
        with self.experiment.guard(), few_tries() if status == "KILLED" else nullcontext():
            self._close_cells(sweep_run_id)
            with suppress(UnreadableError):  # somebody has removed it meanwhile
                planned = self.experiment.read_json(sweep_run_id, "plan.json")["planned"]
                done = len(self.reader.finished(planned))
                self.client.set_tag(sweep_run_id, "cells", f"{done} of {len(planned)} finished")
            self.client.set_terminated(sweep_run_id, status)

    def _close_cells(self, sweep_run_id: str) -> None:
        for run in self.experiment.search(running_cells(sweep_run_id)):
            self._close_run(run.info.run_id, "KILLED", {"reason": "the sweep ended"})

    def restore(self, sweep_run_id: str) -> None:
        """Take back that somebody has deleted the experiment or a sweep's run: a sweep that is going on needs them.

        Raises DeletedError when they were removed for good.
        """
        with self.experiment.guard():
            if self.client.get_experiment(self.experiment.id).lifecycle_stage != "active":
                self.client.restore_experiment(self.experiment.id)
            if self.client.get_run(sweep_run_id).info.lifecycle_stage != "active":
                self.client.restore_run(sweep_run_id)

    def log_files(self, run_id: str, files: Iterable[Path], artifact_path: str) -> None:
        """Add files to a run's artifacts."""
        with self.experiment.guard():
            for file in files:
                self.client.log_artifact(run_id, str(file), artifact_path)

    # --- cells ----------------------------------------------------------------------------------------------------

    def start_cell(
        self, sweep_run_id: str, cell: Cell, key: str, settings: StudySettings, policy_seeds: int
    ) -> CellRun:
        """Start an attempt at a cell. Earlier attempts that are still RUNNING are closed as KILLED."""
        params = {
            "heads": cell.heads,
            "fraction": cell.fraction,
            "encoder_seed": cell.encoder_seed,
            "policy_seeds": policy_seeds,
            **flatten(settings.model_dump(mode="json")),
        }
        with self.experiment.guard():
            earlier = self.experiment.search(f"tags.kind = 'cell' and tags.cell_key = '{key}'")
            sweep = self.client.get_run(sweep_run_id)
            started = time.time_ns() // 1_000_000
            tags = {
                "kind": "cell",
                "cell_key": key,
                "attempt": str(1 + len(earlier)),
                "sweep": sweep.info.run_name,
                "state": "running",
                PARENT: sweep_run_id,
                **cell_tags(cell, policy_seeds),
                HOST: platform.node(),
                PROCESS: str(os.getpid()),
                ALIVE: str(started),
            }
            run_id = self._create_run(cell.label, tags, started)
            for run in earlier:
                if run.info.status == "RUNNING":
                    self._close_run(run.info.run_id, "KILLED", {"superseded_by": run_id})
                attempt = run.data.tags.get("attempt", "?")
                if run.info.status != "FINISHED" and run.info.run_name == cell.label:
                    self.client.update_run(run.info.run_id, name=f"{cell.label} (attempt {attempt})")
            self.client.log_batch(run_id, params=_params(params))
            if sweep.inputs.dataset_inputs:
                self.client.log_inputs(run_id, datasets=sweep.inputs.dataset_inputs)
        return CellRun(run_id, key, cell, started, self.client)

    def commit(self, cell_run: CellRun, result: CellResult, network: bytes = b"") -> str:
        """Log a whole result, and only then mark its run FINISHED. Returns the run id that holds the key's result.

        `network`, made from the result by study.driving.driver, becomes the run's MLflow model `driver`.
        When another attempt has finished this key meanwhile, that one counts and this run ends as KILLED. After a
        TrackerLostError it can be called again: nothing is doubled.
        """
        if result.key != cell_run.key:
            raise ValueError(f"result of cell {result.key} given for the run of {cell_run.key}")
        with self.experiment.guard():
            winner = self.reader.finished([cell_run.key]).get(cell_run.key, cell_run.run_id)
            if winner != cell_run.run_id:
                self._close_run(cell_run.run_id, "KILLED", {"superseded_by": winner})
                return winner
            with scratch_folder() as folder:
                self.client.log_artifacts(cell_run.run_id, str(result.save(Path(folder) / RESULT)), RESULT)
            if diff := result.facts.get("provenance", {}).get("diff"):
                self.client.log_text(cell_run.run_id, diff, "uncommitted.diff")
            scores = final_scores(result)
            self._log_seeds(cell_run, result.curves, scores)
            cell_run.add(cell_points(result.curves))
            cell_run.flush()
            numbers, words = describe_facts(result.facts)
            for ending, values in bands(scores).items():
                names = [f"final/{name}{ending}" for name in scores.columns]
                numbers |= {name: float(f"{value:.5g}") for name, value in zip(names, values, strict=True)}
            model = None
            if network:
                model = log_model(self.client, self.experiment.id, cell_run.run_id, result, network)
            metrics = [
                Metric(name, value, cell_run.started, 0, model_id=model)
                for name, value in numbers.items()
                if math.isfinite(value)
            ]
            self.client.log_batch(cell_run.run_id, metrics=metrics, tags=_tags({**words, "state": "finished"}))
            self.client.set_terminated(cell_run.run_id, "FINISHED")
            return self._settle(cell_run)

    def _settle(self, cell_run: CellRun) -> str:
        """Leave one finished run of a key: another process may have committed it at the same moment."""
        query = f"tags.kind = 'cell' and tags.cell_key = '{cell_run.key}' and attributes.status = 'FINISHED'"
        first, *others = in_order_of_end(self.experiment.search(query))
        for other in others:
            self._close_run(other.info.run_id, "KILLED", {"superseded_by": first.info.run_id})
        return str(first.info.run_id)

    def _log_seeds(self, cell_run: CellRun, curves: pd.DataFrame, scores: pd.DataFrame) -> None:
        start = cell_run.started
        for seed in scores.index.tolist():
            if seed not in cell_run.seeds:
                tags = {"kind": "seed", "policy_seed": str(seed), PARENT: cell_run.run_id}
                cell_run.seeds[seed] = self._create_run(f"policy {seed:02d}", tags, start)
            rows = curves[curves["policy_seed"] == seed]
            metrics = [Metric(name, value, start + epoch, epoch) for name, epoch, value in points(rows)]
            metrics += [Metric(f"final/{name}", value, start, 0) for name, value in scores.loc[seed].to_dict().items()]
            self.client.log_batch(cell_run.seeds[seed], metrics=metrics)
            self.client.set_terminated(cell_run.seeds[seed], "FINISHED")

    def fail(self, cell_run: CellRun, reason: str, *, permanent: bool = False) -> None:
        """End an attempt that has failed; the reason becomes a tag and, in full, an artifact.

        After a `permanent` failure the next start of the sweep does not try again.
        """
        reason = masked(reason)
        with self.experiment.guard():
            cell_run.flush()
            self.client.log_text(cell_run.run_id, reason, "failure.txt")
            self._close_run(cell_run.run_id, "FAILED", {"reason": reason, PERMANENT: "true" if permanent else ""})

    def interrupt(self, cell_run: CellRun, reason: str = "stopped") -> None:
        """End an attempt that was stopped, quickly; when the store does not answer, the next attempt closes it."""
        with suppress(TrackerLostError, DeletedError), self.experiment.guard(), few_tries():
            self._close_run(cell_run.run_id, "KILLED", {"reason": reason})

    # --- runs -----------------------------------------------------------------------------------------------------

    def _create_run(self, name: str, tags: Mapping[str, str], start: int | None = None) -> str:
        return str(self.client.create_run(self.experiment.id, start, dict(tags), name).info.run_id)

    def _close_run(self, run_id: str, status: Status, tags: Mapping[str, str]) -> None:
        """End a run and the seed runs below it."""
        for seed in self.experiment.search(f"tags.kind = 'seed' and tags.`{PARENT}` = '{run_id}'"):
            if seed.info.status == "RUNNING":
                self.client.set_terminated(seed.info.run_id, status)
        for model in self.client.search_logged_models([self.experiment.id], f"source_run_id = '{run_id}'"):
            self.client.delete_logged_model(model.model_id)  # its upload was cut off and would look unfinished for ever
        self.client.log_batch(run_id, tags=_tags({**tags, "state": status.lower()}))
        self.client.set_terminated(run_id, status)


def _short(text: str) -> str:
    return text if len(text) <= VALUE_LIMIT else f"{text[: VALUE_LIMIT - 40]}... [{len(text)} characters, cut]"


def _params(values: Mapping[str, Any]) -> list[Param]:
    texts = {name: value if isinstance(value, str) else json.dumps(value) for name, value in values.items()}
    return [Param(name.replace("+", "_"), _short(text)) for name, text in texts.items()]  # MLflow takes no plus


def _tags(values: Mapping[str, str]) -> list[RunTag]:
    return [RunTag(name, _short(value)) for name, value in values.items() if value]


def _dataset(data: Mapping[str, Any]) -> DatasetInput:
    digest = str(data.get("key") or content_key("data", dict(data), (), PLAN_VERSION))
    source = json.dumps({"tags": {"frame store": digest, "manifest": "data.json of the sweep run"}})
    profile = json.dumps({name: value for name, value in flatten(data).items() if isinstance(value, int | float)})
    entity = Dataset("frames", digest[:36], "code", source, profile=profile[:100_000])
    return DatasetInput(entity, [InputTag("mlflow.data.context", "train and test")])
