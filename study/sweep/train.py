"""Train a sweep's cells where there is no tracker, no queue and no simulator; each result becomes a folder.

python -m study.sweep train heads --profile paper --out results
python -m study.sweep train heads --profile paper --out results --device cuda:1 --limit-seconds 540

The drives lie in data/episodes, recorded elsewhere by `python -m study.data record` with the same settings, and
`python -m study.sweep NAME --import-results DIR` takes the results to MLflow. All cores and GPUs are used where Dask is
installed; without it, cells are trained one after the other in this process.
"""

from __future__ import annotations

import argparse
import importlib.util
import shutil
import signal
import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from filelock import FileLock, Timeout

from study.cell.job import CellJob
from study.compute.provenance import cores
from study.config.workspace import DATA
from study.console.display import Display
from study.console.interrupts import stoppable
from study.console.options import Parser, typed
from study.data.prepare import data_flow
from study.engine.flows import Listener, run_flow, run_flows
from study.engine.inline import InlineEngine
from study.engine.tasks import Failure
from study.errors import EXIT_AGAIN, EXIT_FAILED, BadInputError
from study.results.cell_result import CellResult
from study.stages import Flow, cell_cost
from study.sweep.options import add_machine_options, add_plan_options, check_machine
from study.sweep.plan import Plan, cell_jobs, given_plan

if TYPE_CHECKING:  # Dask, which may be missing
    from study.engine.dask_engine import DaskEngine


def parser() -> Parser:
    """The command line."""
    made = Parser(
        prog="study.sweep train",
        usage="python -m study.sweep train NAME --out DIR [--profile P] [--limit-seconds S] [--group.setting V ...]",
        description="Train a sweep's cells into a folder, without MLflow, Optuna and the simulator. "
        "Finished cells never run again; a stopped command goes on. "
        "Exit code 0: all cells are there; 1: cells failed; 75: cells are left, the same command goes on.",
    )
    made.add_argument("--out", type=Path, required=True, metavar="DIR", help="where each result becomes a folder")
    add_machine_options(made)
    made.add_argument("--limit-seconds", type=float, metavar="S", help="stop by then (default: go on to the end)")
    add_plan_options(made)
    return made


def main(args: Sequence[str]) -> int:
    """Run the command and return its exit code."""
    options = parser().parse(args)
    limit = options.limit_seconds
    if limit is not None and not limit > 0:
        raise BadInputError(f"--limit-seconds is {limit}; it must be above 0")
    plan = given_plan(options)
    check_machine(options)
    if limit is not None:
        signal.setitimer(signal.ITIMER_REAL, limit)
    try:
        return stoppable(lambda: train(plan, options.out, options), typed("study.sweep train", args))
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)


def train(plan: Plan, out: Path, options: argparse.Namespace) -> int:
    """Train the cells that `out` lacks, and return the exit code."""
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise BadInputError(f"cannot write to {out}: {error.strerror}; name another folder with --out") from error
    jobs = {
        key: job for key, job in cell_jobs(plan, options.device, options.threads).items() if not (out / key).is_dir()
    }
    costs = {key: cell_cost(plan.settings, job.cell, job.policy_seeds).seconds for key, job in jobs.items()}
    labels = {key: cell.label for key, cell in plan.cells.items()}
    data_seconds = 0.0 if (plan.frames / "manifest.json").is_file() else plan.data_cost.seconds
    if not jobs:
        return 0
    _check_installed()
    from study.cell.flow import cell_flow, product_folders  # noqa: PLC0415 - what it computes with may be missing

    DATA.mkdir(exist_ok=True)
    title = f"{plan.grid.name} ({plan.profile})"
    with Display(title, costs, labels, data_seconds, plan.works) as display, _engine(options) as engine:
        run_flow(data_flow(plan.settings, DATA, plan.imported), engine, display.data)
        shutil.copyfile(plan.frames / "manifest.json", out / f"frames-{plan.frames.name}.json")
        flow = partial(cell_flow, one_share=engine.gpus() > 0)
        saving = _Saving(out, jobs, display, flow, product_folders)
        run_flows(
            engine, saving.next_flow, Listener(saving.finished, saving.failed, display.progress, tick=display.tick)
        )
    for key, reason in saving.reasons.items():
        print(f"failed: {labels[key]} ({key}): {reason.strip()}", file=sys.stderr)
    if saving.reasons:
        return EXIT_FAILED
    return 0 if all((out / key).is_dir() for key in plan.cells) else EXIT_AGAIN


def _engine(options: argparse.Namespace) -> DaskEngine | InlineEngine:
    """Use Dask, and with it all cores and GPUs, where it is installed."""
    try:
        from study.engine.local import local_engine, visible_gpus  # noqa: PLC0415
    except ModuleNotFoundError:
        return InlineEngine()
    return local_engine(max(1, cores() // options.threads), DATA / "tmp", visible_gpus(options.device))


def _check_installed() -> None:
    """Raise BadInputError when the machine lacks what training needs, before hours are spent on the data."""
    for name in ("torch", "lightning", "pandas", "pyarrow", "cv2", "safetensors", "filelock"):
        if importlib.util.find_spec(name) is None:
            raise BadInputError(
                f"{name} is not installed here; bring its wheel along (WHEELS in benchmarks/paper_scale.sh)"
            )


class _Saving:
    """Saves results as folders. Each cell is locked while it is trained, so several commands may share `out`."""

    def __init__(
        self,
        out: Path,
        jobs: dict[str, CellJob],
        display: Display,
        flow: Callable[[CellJob], Flow[tuple[CellResult, bytes]]],
        kept: Callable[[CellJob], list[Path]],
    ) -> None:
        self._out, self._jobs, self._display, self._flow, self._kept = out, jobs, display, flow, kept
        self._left = list(jobs)
        self._locks: dict[str, FileLock] = {}
        self.reasons: dict[str, str] = {}

    def next_flow(self) -> tuple[str, Flow[tuple[CellResult, bytes]]] | None:
        """Return the flow of the next cell that nobody else trains."""
        while self._left:
            key = self._left.pop(0)
            lock = FileLock(self._out / f".{key}.lock")
            with suppress(Timeout):
                lock.acquire(blocking=False)
                self._locks[key] = lock
                if not (self._out / key).is_dir():
                    self._display.start(key)
                    return key, self._flow(self._jobs[key])
            self._display.say(f"{self._jobs[key].cell.label}: another process has taken it")
        return None

    def finished(self, name: str, value: tuple[CellResult, bytes]) -> None:
        """Save the result."""
        value[0].save(self._out / name)
        for folder in self._kept(self._jobs[name]):
            shutil.rmtree(folder, ignore_errors=True)
        self._display.finish(name)
        self._locks.pop(name).release()

    def failed(self, name: str, failure: Failure) -> None:
        """Keep the reason."""
        self.reasons[name] = failure.reason
        self._display.fail(name)
        self._locks.pop(name).release()
