"""Train a sweep's cells where there is no tracker, no queue and no simulator; each result becomes a folder.

python -m study.sweep train heads --profile paper --out results
python -m study.sweep train heads --profile paper --out results --device cuda:1 --limit-seconds 540

The drives lie in data/episodes, recorded elsewhere by `python -m study.data record` with the same settings, and
`python -m study.sweep import NAME DIR` takes the results to MLflow. All cores and GPUs are used where Dask is
installed; without it, cells are trained one after the other in this process.
"""

from __future__ import annotations

import importlib
import shutil
import sys
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from filelock import FileLock, Timeout

from study.cell.flow import cell_flow, product_folders
from study.cell.job import CellJob
from study.compute.gpus import visible_gpus
from study.compute.provenance import cores, provenance, warn_of_unknown_origin
from study.console.display import Display
from study.data.in_use import shared_use
from study.data.prepare import data_flow
from study.engine.flows import Listener, run_flow, run_flows
from study.engine.inline import InlineEngine
from study.engine.tasks import Failure
from study.errors import EXIT_AGAIN, EXIT_FAILED, BadInputError
from study.planning.plan import Plan, cell_jobs, plan_display
from study.results.cell_result import CellResult
from study.stages import Flow

if TYPE_CHECKING:  # Dask, which may be missing
    from study.engine.dask_engine import DaskEngine


def train(plan: Plan, out: Path, device: str, threads: int) -> int:
    """Train the cells that `out` lacks, and return the exit code."""
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise BadInputError(f"cannot write to {out}: {error.strerror}; name another folder with --out") from error
    jobs = {key: job for key, job in cell_jobs(plan, device, threads).items() if not (out / key).is_dir()}
    if not jobs:
        return 0
    warn_of_unknown_origin(provenance())
    gpus = visible_gpus(device)
    using = shared_use(plan.workspace.data)
    with using, plan_display(plan, jobs) as display, _engine(plan, gpus, threads) as engine:
        run_flow(data_flow(plan.settings, plan.workspace.data, plan.imported), engine, display.data)
        shutil.copyfile(plan.frames / "manifest.json", out / f"frames-{plan.frames.name}.json")
        saving = _Saving(out, jobs, display, one_share=bool(gpus))
        run_flows(
            engine,
            saving.next_flow,
            Listener(saving.finished, saving.failed, display.progress, retry=saving.retry, tick=display.tick),
        )
    for key, reason in saving.reasons.items():
        print(f"failed: {plan.cells[key].label} ({key}): {reason.strip()}", file=sys.stderr)
    if saving.reasons:
        return EXIT_FAILED
    return 0 if all((out / key).is_dir() for key in plan.cells) else EXIT_AGAIN


def _engine(plan: Plan, gpus: list[str], threads: int) -> DaskEngine | InlineEngine:
    """Use Dask, and with it all cores and GPUs, where it is installed."""
    try:
        local = importlib.import_module("study.engine.local")
    except ModuleNotFoundError:
        return InlineEngine()
    engine: DaskEngine = local.local_engine(max(1, cores() // threads), plan.workspace.tmp, gpus)
    return engine


class _Saving:
    """Saves results as folders. Each cell is locked while it is trained, so several commands may share `out`."""

    def __init__(self, out: Path, jobs: dict[str, CellJob], display: Display, *, one_share: bool) -> None:
        self._out, self._jobs, self._display, self._one_share = out, jobs, display, one_share
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
                    return key, cell_flow(self._jobs[key], one_share=self._one_share)
            self._display.say(f"{self._jobs[key].cell.label}: another process has taken it")
        return None

    def finished(self, name: str, value: tuple[CellResult, bytes]) -> None:
        """Save the result."""
        value[0].save(self._out / name)
        for folder in product_folders(self._jobs[name]):
            shutil.rmtree(folder, ignore_errors=True)
        self._display.finish(name)
        self._locks.pop(name).release()

    def retry(self, name: str, reason: str) -> None:
        """Say that a task will be tried again."""
        line = reason.strip().splitlines()[-1]
        self._display.say(f"{self._jobs[name].cell.label}: {line}; it will be tried again")

    def failed(self, name: str, failure: Failure) -> None:
        """Keep the reason."""
        self.reasons[name] = failure.reason
        self._display.fail(name)
        self._locks.pop(name).release()
