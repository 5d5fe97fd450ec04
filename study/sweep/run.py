"""Train the cells of a plan on an engine, and commit what they give: the one writer to MLflow and Optuna."""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from study.atomic import scratch_folder
from study.compute.gpus import visible_gpus
from study.compute.provenance import cores, provenance, warn_of_unknown_origin
from study.data.card import card_files, source_drives
from study.data.frames import open_frames
from study.data.prepare import data_flow, describe_data
from study.engine.cluster import cluster_engine
from study.engine.dask_engine import DaskEngine
from study.engine.flows import run_flow, run_flows
from study.engine.inline import InlineEngine
from study.engine.local import local_engine
from study.engine.tasks import Engine
from study.errors import EXIT_FAILED
from study.planning.options import RunOptions
from study.planning.plan import Plan, plan_display
from study.report.build import publish
from study.stages import DESCRIBE, Batch, Flow, Task
from study.sweep.committing import Committing
from study.sweep.driving import drive_cells, undriven
from study.sweep.locks import hold_store, temporary_folder
from study.tracking.tracker import Tracker


def execute(plan: Plan, options: RunOptions, command: str, *, report: bool) -> int:
    """Run what is not finished, then write the report unless told not to. Returns the exit code."""
    origin = provenance()
    warn_of_unknown_origin(origin)
    with hold_store(plan.workspace, options.tracking, f"sweep, {plan.grid.name}", wait=options.wait):
        tracker = Tracker(options.tracking)
        failed, code = run_cells(plan, options, tracker, origin), 0
        try:
            if report:
                print("writing the report", file=sys.stderr)
                code = write_report(plan, tracker)
        finally:  # whatever becomes of the report
            _say_failed(plan, failed, command)
    return EXIT_FAILED if failed else code


def _say_failed(plan: Plan, failed: Mapping[str, str], command: str) -> None:
    for key, reason in failed.items():
        print(f"failed: {plan.cells[key].label} ({key}): {reason.strip()}", file=sys.stderr)
    if failed:
        print(f"Once the cause is gone: {command.removesuffix(' --retry-failed')} --retry-failed", file=sys.stderr)


def write_report(plan: Plan, tracker: Tracker) -> int:
    """Write the report of a plan's sweep, print where it is, and return the exit code."""
    pdf, code = publish(tracker, plan.grid.name, plan.profile, plan.workspace.reports)
    print(f"report: {pdf}", file=sys.stderr)
    return code


def run_cells(plan: Plan, options: RunOptions, tracker: Tracker, origin: dict[str, Any]) -> dict[str, str]:
    """Train what is not finished, and have its policies drive, until every cell is finished or has failed.

    Returns the failed, with reasons.
    """
    done = tracker.reader.finished(list(plan.cells))
    given_up = {} if options.retry_failed else tracker.reader.given_up(set(plan.cells) - set(done))
    waiting = [key for key in plan.cells if key not in done and key not in given_up]
    at_work = waiting or undriven(plan, tracker.reader)
    with temporary_folder(plan.workspace), start_engine(plan, options) if at_work else InlineEngine() as engine:
        failed = _train(plan, options, tracker, engine, origin, waiting, given_up)
        return failed | drive_cells(plan, options, tracker, engine)


def _train(
    plan: Plan,
    options: RunOptions,
    tracker: Tracker,
    engine: DaskEngine | InlineEngine,
    origin: dict[str, Any],
    waiting: list[str],
    given_up: dict[str, str],
) -> dict[str, str]:
    order = sorted(waiting, key=lambda key: -plan.costs[key].seconds)
    with plan_display(plan, waiting, given_up) as display:
        if waiting:
            data, card = run_flow(_data_flow(plan, engine), engine, display.data)
        else:
            data, card = _describe_here(plan) if plan.frames_ready else ({}, {})
        sweep_run = open_sweep(plan, data, tracker, origin)
        with Committing(plan, options, tracker, sweep_run, order, display, engine.gpus() > 0) as cells:
            with scratch_folder() as name:
                files = [Path(name) / file for file in card]
                for file in files:
                    file.write_bytes(card[file.name])
                tracker.log_files(sweep_run, files, "data")
            for key in given_up:
                display.fail(key)
            run_flows(engine, cells.next_flow, cells.listener())
            return given_up | cells.close()


def open_sweep(plan: Plan, data: dict[str, Any], tracker: Tracker, origin: dict[str, Any]) -> str:
    """Open the sweep's run, with the manifest of its frames; returns the run's identifier."""
    if plan.imported:
        data = data | {"writers": plan.imported.writers}  # a report must not call these drives our town's
    origin = origin | {"command": plan.command}
    return tracker.open_sweep(plan.grid, plan.profile, plan.settings, plan.cells, data, origin)


def start_engine(plan: Plan, options: RunOptions) -> DaskEngine:
    """Start the engine that the options ask for."""
    scratch = plan.workspace.tmp
    if options.cluster:
        return cluster_engine(options.cluster, options.certificates, scratch)
    workers = options.workers or max(1, cores() // options.threads)
    return local_engine(workers, scratch, visible_gpus(options.device))


def _data_flow(plan: Plan, engine: Engine) -> Flow[Any]:
    """Make and describe the frames: here, with the engine's help, unless its workers have folders of their own."""
    if _shares_folder(plan.workspace.data, engine):
        yield from data_flow(plan.settings, plan.workspace.data, plan.imported)
    arguments = (plan.workspace.data, plan.settings, plan.imported, plan.grid.modules)
    (described,) = yield Batch([Task(DESCRIBE, describe_data, arguments)])
    return described


def _shares_folder(folder: Path, engine: Engine) -> bool:
    if not isinstance(engine, DaskEngine):
        return True
    with tempfile.NamedTemporaryFile(dir=folder, prefix=".shared-") as token:
        return engine.workers_see(folder / Path(token.name).name)


def _describe_here(plan: Plan) -> tuple[dict[str, Any], dict[str, bytes]]:
    store = open_frames(plan.frames)
    files = card_files(store, source_drives(store, plan.drives), plan.frames)
    return store.manifest, {path.name: path.read_bytes() for path in files}
