"""Train a sweep's cells where there is no tracker, no queue and no simulator; each result becomes a folder.

python -m study.train heads --profile paper --out results
python -m study.train heads --profile paper --out results --device cuda:1 --limit-seconds 540

The drives lie in data/episodes, recorded elsewhere by `python -m study.data record` with the same settings, and
`python -m study.sweep NAME --import-results DIR` takes the results to MLflow. Several of these commands may work on one
folder at a time, one for each GPU, say: every cell is trained by one of them.
"""

from __future__ import annotations

import fcntl
import shutil
import signal
import sys
import time
import traceback
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from study.command import EXIT_FAILED, EXIT_INTERRUPTED, Parser, run, stoppable, typed
from study.config import BadInputError
from study.cost import cell_cost
from study.data import DATA, prepare
from study.plan import Plan, add_machine_options, add_plan_options, check_machine, given_plan
from study.scratch import using

if TYPE_CHECKING:  # --help and errors in the settings come without these
    from study.display import Display
    from study.result import CellJob

EXIT_AGAIN = 75  # cells are left: the same command goes on


def parser() -> Parser:
    """The command line."""
    made = Parser(
        prog="study.train",
        usage="python -m study.train NAME --out DIR [--profile P] [--limit-seconds S] [--group.setting VALUE ...]",
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
    began = time.monotonic()
    options = parser().parse(args)
    limit = options.limit_seconds
    if limit is not None and not limit > 0:
        raise BadInputError(f"--limit-seconds is {limit}; it must be above 0")
    plan = given_plan(options)
    check_machine(options)
    if limit is not None:
        signal.signal(signal.SIGALRM, signal.default_int_handler)
        signal.setitimer(signal.ITIMER_REAL, limit)
    try:
        code = stoppable(lambda: train(plan, options.out, options.device, options.threads), typed("study.train", args))
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
    up = limit is not None and time.monotonic() - began >= limit
    return EXIT_AGAIN if up and code == EXIT_INTERRUPTED else code


def train(plan: Plan, out: Path, device: str, threads: int) -> int:
    """Train the cells that `out` lacks, one after the other, and return the exit code."""
    from study.display import Display  # noqa: PLC0415
    from study.provenance import cores  # noqa: PLC0415
    from study.result import CellJob  # noqa: PLC0415

    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise BadInputError(f"cannot write to {out}: {error.strerror}; name another folder with --out") from error
    jobs = {
        key: CellJob(cell, key, plan.settings, plan.grid.policy_seeds, plan.frames, plan.drives, DATA, device, threads)
        for key, cell in plan.cells.items()
        if not (out / key).is_dir()
    }
    costs = {key: cell_cost(plan.settings, job.cell, job.policy_seeds).seconds for key, job in jobs.items()}
    labels = {key: cell.label for key, cell in plan.cells.items()}
    ready = (plan.frames / "manifest.json").is_file()
    failed = {}
    with (
        Display(
            f"{plan.grid.name} ({plan.profile})", costs, labels, 0.0 if ready else plan.data_cost.seconds
        ) as display,
        using(DATA, lambda _: ()),
    ):
        if jobs:
            _check_installed()
            prepare(plan.settings, DATA, cores(), display.data, plan.imported)
            shutil.copyfile(plan.frames / "manifest.json", out / f"frames-{plan.frames.name}.json")
        for key, job in jobs.items():
            with _taken(out / f".{key}.lock") as mine:
                if not mine or (out / key).is_dir():
                    display.say(f"{labels[key]}: another process has taken it")
                elif reason := _train_cell(job, out / key, display):
                    failed[key] = reason
    for key, reason in failed.items():
        print(f"failed: {labels[key]} ({key}): {reason.strip()}", file=sys.stderr)
    if failed:
        return EXIT_FAILED
    return 0 if all((out / key).is_dir() for key in plan.cells) else EXIT_AGAIN


def _check_installed() -> None:
    """Raise BadInputError when the machine lacks what training needs, before hours are spent on the data."""
    try:
        import study.cell  # noqa: F401, PLC0415
    except ModuleNotFoundError as error:
        raise BadInputError(
            f"{error.name} is not installed here; bring its wheel along (WHEELS in benchmarks/paper_scale.sh)"
        ) from error


def _train_cell(job: CellJob, folder: Path, display: Display) -> str:
    """Train a cell and save its result as `folder`. Returns why it failed, or nothing."""
    from study.cell import run_cell  # noqa: PLC0415
    from study.result import CellResult, TrainingDivergedError  # noqa: PLC0415

    display.start(job.key)
    reason = ""
    try:
        if not job.result_folder.is_dir():  # else trained before, and only what follows was cut off
            run_cell(job, lambda *_: None, lambda *what: display.progress(job.key, *what))
        CellResult.load(job.result_folder).save(folder)
        shutil.rmtree(job.result_folder)
    except (BadInputError, TrainingDivergedError) as error:
        reason = str(error)
    except Exception:  # noqa: BLE001 - whatever it is belongs to this cell, and the others go on
        reason = traceback.format_exc()
    (display.fail if reason else display.finish)(job.key)
    return reason


@contextmanager
def _taken(path: Path) -> Iterator[bool]:
    """Whether this process holds the cell of that lock; another one may, until it ends."""
    with path.open("w") as stream:
        try:
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            yield False
            return
        yield True


if __name__ == "__main__":
    run(main)
