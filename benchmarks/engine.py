"""What the engine and tracking add to a sweep's own work: `python benchmarks/engine.py`.

Measured: the import of Dask in a new process; the start of two workers to the first result, and their end; a worker's
import of what stages compute with; empty tasks, one after the other and many at once; a task with the latents of a
laptop cell; a report from a task; and in MLflow, on SQLite, the opening and closing of a sweep, and for each cell its
start, a write of its live curves and its commit. The result that is committed is real: an encoder of `rec` and 15
policies with the epochs of `laptop`, trained on the frames of `smoke`.

From these follows the share of a laptop `heads`: what all its tasks, reports and cells take, over what its stages are
expected to take (`study.stages`). That is an upper bound: the client works while the workers compute, and is counted as
if everybody waited for it. Printed are medians with the lowest and highest.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable
from contextlib import chdir
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from study.cell.flow import SHARE_SECONDS, cell_flow
from study.compute.provenance import ROOT, provenance
from study.config.files import load_profile
from study.config.paper import LATENT
from study.config.workspace import HERE
from study.data.prepare import data_flow
from study.engine.dask_engine import DaskEngine
from study.engine.flows import run_flow
from study.engine.local import local_engine
from study.planning.plan import Plan, cell_jobs, make_plan
from study.results.cell_result import CellResult
from study.stages import ENCODER, POLICY, RESULT, Batch, Flow, Task, cell_cost

RESULT_FILE = Path(__file__).parent / "results" / "engine.json"
WORKERS = 2
STARTS, SINGLE, MANY, REPORTS, CELLS, LIVE = 5, 50, 400, 2000, 8, 20
REPORT_EVERY = 0.25  # [s] between two reports of an encoder's progress
PACKAGES = ("distributed", "mlflow", "optuna", "numpy", "torch")
IMPORT = "import time; t = time.perf_counter(); import study.engine.local; print(time.perf_counter() - t)"

Numbers = dict[str, Any]


def spread(values: Iterable[float]) -> Numbers:
    """Median, lowest and highest."""
    listed = sorted(values)
    return {"median": float(np.median(listed)), "low": listed[0], "high": listed[-1], "n": len(listed)}


def seconds(work: Callable[[], Any]) -> float:
    """Seconds that a call takes."""
    begin = time.perf_counter()
    work()
    return time.perf_counter() - begin


# --- the engine -----------------------------------------------------------------------------------------------------


def nothing(*_: object) -> None:
    """Do nothing, as a task."""


def load_libraries() -> float:
    """Import what the stages of a cell compute with; returns the seconds."""
    begin = time.perf_counter()
    import study.driving.driver  # noqa: PLC0415
    import study.encoder.training  # noqa: PLC0415
    import study.policy.training  # noqa: F401, PLC0415

    return time.perf_counter() - begin


def report_often(report: Callable[..., None]) -> float:
    """Seconds of one report, from a task."""
    begin = time.perf_counter()
    for count in range(REPORTS):
        report("progress", count, REPORTS)
    return (time.perf_counter() - begin) / REPORTS


def batch(tasks: list[Task]) -> Flow[list[Any]]:
    """Yield one batch of one stage."""
    return (yield Batch(tasks))


def start_and_end(folder: Path) -> tuple[float, float]:
    """Seconds from the start of an engine to the result of its first task, and of its end."""
    begin = time.perf_counter()
    engine = local_engine(WORKERS, folder)
    run_flow(batch([Task(RESULT, nothing, ())]), engine)
    ready = time.perf_counter()
    engine.__exit__(None)
    return ready - begin, time.perf_counter() - ready


def measure_engine(engine: DaskEngine, settings: Any) -> Numbers:
    """Tasks and reports on an engine that runs."""
    loading = run_flow(batch([Task(RESULT, load_libraries, ()) for _ in range(WORKERS)]), engine)
    single = [seconds(lambda: run_flow(batch([Task(RESULT, nothing, ())]), engine)) for _ in range(SINGLE)]
    many = [
        seconds(lambda: run_flow(batch([Task(RESULT, nothing, ()) for _ in range(MANY)]), engine)) / MANY
        for _ in range(STARTS)
    ]
    z = np.zeros((settings.frames.policy, LATENT), np.float32)
    latents = [seconds(lambda: run_flow(batch([Task(POLICY, nothing, (z,))]), engine)) for _ in range(SINGLE)]
    reports = [run_flow(batch([Task(RESULT, report_often, (), reports=True)]), engine)[0] for _ in range(STARTS)]
    return {
        "worker_import_s": spread(loading),
        "single_task_s": spread(single),
        "task_of_many_s": spread(many),
        "task_with_latents_s": spread(latents),
        "report_s": spread(reports),
    }


# --- tracking -------------------------------------------------------------------------------------------------------


def train_cell(engine: DaskEngine, plan: Plan) -> tuple[CellResult, bytes]:
    """Train the plan's first cell."""
    run_flow(data_flow(plan.settings, HERE.data), engine)
    (job, *_) = cell_jobs(plan, "cpu", 1).values()
    return run_flow(cell_flow(job), engine)


def measure_tracking(plan: Plan, result: CellResult, network: bytes) -> Numbers:
    """Measure what a sweep of CELLS cells takes in MLflow and Optuna, all with the same result."""
    # Not at the top: workers load this file, too, and in a sweep they need no MLflow.
    from study.engine.trials import Trials  # noqa: PLC0415
    from study.tracking.tracker import Tracker  # noqa: PLC0415

    keys = {f"{number:016x}": result.cell for number in range(CELLS)}
    found: dict[str, list[float]] = {"cell_start_s": [], "live_write_s": [], "cell_commit_s": [], "cell_trial_s": []}
    times: list[float] = [time.perf_counter()]
    tracker = Tracker("sqlite:///mlruns/mlflow.db")
    times.append(time.perf_counter())
    sweep = tracker.open_sweep(plan.grid, plan.profile, plan.settings, keys, {}, provenance())
    times.append(time.perf_counter())
    trials = Trials(Path("mlruns/optuna.db"), "benchmark", {key: cell.label for key, cell in keys.items()}, keys)
    times.append(time.perf_counter())
    metrics = {f"{split}/metric{number}": 0.5 for split in ("train", "test") for number in range(4)}
    for key, cell in keys.items():
        begin = time.perf_counter()
        asked = trials.ask()
        middle = time.perf_counter()
        run = tracker.start_cell(sweep, cell, key, plan.settings, plan.grid.policy_seeds)
        started = time.perf_counter()
        for epoch in range(1, LIVE + 1):
            for stage in ("encoder", "policy"):
                run.log(stage, epoch, metrics)
                run.note(progress=f"{stage} {epoch}/{LIVE}")
            found["live_write_s"].append(seconds(run.flush))
        live = time.perf_counter()
        tracker.commit(run, replace(result, key=key), network)
        committed = time.perf_counter()
        trials.finish(str(asked), 0.5)
        end = time.perf_counter()
        for name, value in (
            ("cell_start_s", started - middle),
            ("cell_commit_s", committed - live),
            ("cell_trial_s", middle - begin + end - committed),
        ):
            found[name].append(value)
    closing = seconds(lambda: tracker.close_sweep(sweep, "FINISHED"))
    opened = dict(zip(("open_store_s", "open_sweep_s", "open_trials_s"), np.diff(times).tolist(), strict=True))
    return {name: spread(values) for name, values in found.items()} | opened | {"close_sweep_s": closing}


# --- the share of a sweep -------------------------------------------------------------------------------------------


def count_work(plan: Plan) -> Numbers:
    """Tasks, reports and cells of a sweep, and the seconds that its stages are expected to take."""
    from study.tracking.cell_run import FLUSH, HEARTBEAT  # noqa: PLC0415 - as above

    recording = plan.settings.recording
    drives = recording.encoder_episodes + recording.policy_episodes
    shares = {key: -(-2 * POLICY.cost(work) // SHARE_SECONDS) for key, work in plan.works.items()}
    expected = plan.data_cost.seconds + sum(
        cell_cost(plan.settings, cell, plan.grid.policy_seeds).seconds for cell in plan.cells.values()
    )
    encoders = sum(ENCODER.cost(work) for work in plan.works.values())
    policies = sum(POLICY.cost(work) for work in plan.works.values())
    return {
        "cells": len(plan.cells),
        # Recording, choosing and rendering each drive, and the card; encoder, latents, result and the policies' shares.
        "tasks": 3 * drives + 1 + 3 * len(plan.cells) + int(sum(shares.values())),
        "shares": int(sum(shares.values())),
        # On one core each takes twice as long.
        "live_writes": int(2 * encoders / HEARTBEAT + 2 * policies / FLUSH),
        "reports": int(2 * encoders / REPORT_EVERY + 2 * plan.settings.policy.epochs * sum(shares.values())),
        "expected_s": expected,
    }


def overhead(counts: Numbers, measured: Numbers) -> Numbers:
    """Seconds that engine and tracking add, part by part, and their share of the sweep."""

    def median(name: str) -> float:
        value = measured[name]
        return float(value["median"] if isinstance(value, dict) else value)

    cells = ("cell_start_s", "cell_commit_s", "cell_trial_s")
    once = ("open_store_s", "open_sweep_s", "open_trials_s", "close_sweep_s")
    parts = {
        "start": median("import_s") + median("start_s") + median("worker_import_s") + median("end_s"),
        "tasks": counts["tasks"] * median("single_task_s")
        + counts["shares"] * (median("task_with_latents_s") - median("single_task_s")),
        "reports": counts["reports"] * median("report_s"),
        "tracking": sum(map(median, once))
        + counts["cells"] * sum(map(median, cells))
        + counts["live_writes"] * median("live_write_s"),
    }
    total = sum(parts.values())
    return {"seconds": parts | {"total": total}, "share": total / counts["expected_s"]}


# --- main -----------------------------------------------------------------------------------------------------------


def machine() -> Numbers:
    """Return the machine that measured."""
    facts = provenance()
    return {
        **{name: facts[name] for name in ("cpu", "cores", "platform", "python", "commit")},
        "packages": {name: facts["packages"].get(name) for name in PACKAGES},
        "load_before": os.getloadavg()[0],
    }


def measure(folder: Path) -> Numbers:
    """Everything, in a working folder."""
    (folder / "sweeps").symlink_to(ROOT / "sweeps")
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    with chdir(folder):
        laptop = load_profile("laptop")
        epochs = {"encoder": {"epochs": laptop.encoder.epochs}, "policy": {"epochs": laptop.policy.epochs}}
        small = make_plan("heads", "smoke", epochs, {"heads": ["rec"], "baselines": ()})
        run = [sys.executable, "-c", IMPORT]
        imports = [
            float(subprocess.run(run, env=environment, check=True, capture_output=True, text=True).stdout)
            for _ in range(STARTS)
        ]
        starts, ends = zip(*(start_and_end(folder / "tmp") for _ in range(STARTS)), strict=True)
        measured = {"import_s": spread(imports), "start_s": spread(starts), "end_s": spread(ends)}
        with local_engine(WORKERS, folder / "tmp") as engine:
            measured |= measure_engine(engine, laptop)
            result, network = train_cell(engine, small)
        measured |= measure_tracking(small, result, network)
        counts = count_work(make_plan("heads", "laptop", {}, {}))
    return {"machine": machine(), "measured": measured, "heads": counts, "overhead": overhead(counts, measured)}


def main() -> None:
    """Measure, print, and keep the result."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--dry-run", action="store_true", help="keep nothing")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        result = measure(Path(folder))
    print("\n| what | median [s] | low | high | n |\n|---|---|---|---|---|")
    for name, value in result["measured"].items():
        one = value if isinstance(value, dict) else spread([value])
        print(f"| {name} | {one['median']:.4g} | {one['low']:.4g} | {one['high']:.4g} | {one['n']} |")
    print(json.dumps({name: result[name] for name in ("machine", "heads", "overhead")}, indent=1))
    if not options.dry_run:
        RESULT_FILE.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
