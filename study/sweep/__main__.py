"""Run a sweep: plan its cells, make the data, train what is not finished, commit to MLflow, write the report.

python -m study.sweep heads
python -m study.sweep datasize --profile smoke --dry-run
python -m study.sweep heads --data data/imported/scenes
"""

from __future__ import annotations

import random
import signal
from collections.abc import Sequence
from pathlib import Path
from pkgutil import resolve_name  # the work is imported when it begins: --help and --dry-run need none of it
from typing import Any

import click

from study.console.interrupts import stoppable
from study.console.options import invoke, run, tracking_option
from study.errors import BadInputError
from study.planning import options
from study.planning.dry_run import dry_run
from study.planning.plan import Plan

no_report = click.option("--no-report", is_flag=True, help="stop when the cells are finished")


@click.command(
    options_metavar="[--profile P] [--dry-run] [--group.setting V ...]",
    epilog="""\b
Further commands, each with its own --help:
  status NAME      what is done, what runs where, what is left
  verify NAME      compute a finished cell again and compare
  drive NAME       watch a finished cell, or your own function, drive
  train NAME       train where there is no tracker; results become folders
  import NAME DIR  commit the results of train to MLflow
  clean [NAME...]  list sweeps and cached data with their sizes; delete chosen ones

In brackets: the value where the profile names no other.
Example: python -m study.sweep heads --profile smoke --heads '[rec, full]' --encoder.epochs 50""",
)
@options.plan_options()
@click.option("--dry-run", "show_only", is_flag=True, help="show what would run, what is done, and what it costs")
@click.option("--json", "as_json", is_flag=True, help="with --dry-run: one JSON object on stdout")
@options.run_options()
@no_report
@click.pass_obj
def sweep(
    command: str, *, plan: Plan, run_options: options.RunOptions, show_only: bool, as_json: bool, no_report: bool
) -> int:
    """Run the sweep NAME to its report. Finished cells never run again; a killed sweep goes on."""
    if show_only:
        return dry_run(plan, run_options.tracking, as_json=as_json)
    if as_json:
        raise BadInputError("--json goes with --dry-run; add --dry-run")
    execute = resolve_name("study.sweep.run:execute")
    return stoppable(lambda: execute(plan, run_options, command, report=not no_report), command)


@click.command
@options.plan_options()
@tracking_option()
@click.option("--json", "as_json", is_flag=True, help="one JSON object on stdout")
@options.accept_run_options()
def status(*, plan: Plan, tracking: str, as_json: bool) -> int:
    """Show what of the sweep NAME is finished, what runs where, and what is left. Give the settings of the sweep."""
    return int(resolve_name("study.sweep.status:show_status")(plan, tracking, as_json=as_json))


@click.command
@options.plan_options()
@click.option("--cell", metavar="CELL", help="label or key of a finished cell, as --dry-run shows them [any]")
@click.option("--seed", type=int, metavar="N", help="draws the cell [any]")
@options.workers
@tracking_option()
def verify(*, plan: Plan, cell: str | None, seed: int | None, workers: int | None, tracking: str) -> int:
    """Compute a finished cell of the sweep NAME again; compare curves, weights and predictions byte for byte."""
    draw = random.randrange(10**6) if seed is None else seed  # noqa: S311 - no secret
    return int(resolve_name("study.sweep.verify:verify")(plan, tracking, cell, draw, workers))


@click.command
@options.plan_options()
@click.option("--out", type=Path, required=True, metavar="DIR", help="where each result becomes a folder")
@click.option(
    "--limit-seconds", type=click.FloatRange(min=0, min_open=True), metavar="S", help="stop by then [go on to the end]"
)
@options.device
@options.threads
@click.pass_obj
def train(command: str, *, plan: Plan, out: Path, limit_seconds: float | None, device: str, threads: int) -> int:
    """Train the cells of the sweep NAME into a folder, without MLflow, Optuna and the simulator.

    Finished cells never run again; a stopped command goes on. Exit code 0: all cells are there; 1: cells failed; 75:
    cells are left, the same command goes on.
    """
    options.check_device(device)
    options.check_installed()
    train_cells = resolve_name("study.sweep.train:train")
    signal.setitimer(signal.ITIMER_REAL, limit_seconds or 0)
    try:
        return stoppable(lambda: train_cells(plan, out, device, threads), command)
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)


@click.command
@options.plan_options()
@click.argument("folder", metavar="DIR", type=Path)
@tracking_option()
@options.wait
@no_report
@click.pass_obj
def import_results(command: str, *, plan: Plan, folder: Path, tracking: str, wait: bool, no_report: bool) -> int:
    """Commit what `study.sweep train NAME --out DIR` has left in DIR to MLflow, and write the report."""
    import_folder = resolve_name("study.sweep.offline_results:import_folder")
    return stoppable(lambda: import_folder(plan, folder, tracking, wait=wait, report=not no_report), command)


@click.command(
    epilog="""\b
Examples:
  python -m study.sweep drive heads --cell 'rec+plan 100% e0' --seed 3 --town 12 --out drive.mp4
  python -m study.sweep drive heads --actor expert --traffic 4 --driving.duration 30
  python -m study.sweep drive heads --actor my_driver.py:drive --out drive.gif"""
)
@click.option("--cell", metavar="CELL", help="label or key of a finished cell, as --dry-run shows them")
@click.option("--seed", type=click.IntRange(min=0), default=0, metavar="N", help="which policy of the cell [0]")
@click.option(
    "--actor",
    metavar="WHO",
    help="in the place of a cell: expert, or FILE.py:function, your own function from what is seen (image, speeds, "
    "last command) to steering and class of acceleration",
)
@click.option("--traffic", type=click.IntRange(0, 9999), metavar="N", help="held-out drive in the study's town [0]")
@click.option("--town", type=click.IntRange(0, 9999), metavar="N", help="held-out drive in an unseen town, instead")
@click.option("--out", type=Path, metavar="FILE", help="film: .mp4, .webm (for browsers) or .gif [none]")
@tracking_option()
@options.plan_options()
@click.pass_obj
def drive(command: str, /, *, plan: Plan, tracking: str, out: Path | None, **choice: Any) -> int:
    """Watch one policy of a finished cell of the sweep NAME drive, in traffic that nothing was trained on.

    Prints its scores next to the expert's in the same drive, and what ended it.
    """
    module = resolve_name("study.sweep.drive")
    chosen = module.Choice(**choice)
    return stoppable(lambda: int(module.drive(plan, tracking, chosen, out)), command)


@click.command
@click.argument("names", metavar="[NAME...]", nargs=-1)
@click.option("--profile", metavar="P", help="of the named sweeps, those of this profile [every profile]")
@click.option(
    "--older-than",
    type=click.FloatRange(min=0),
    metavar="DAYS",
    help="of the named sweeps, or of all, those unused since",
)
@click.option("--unused", is_flag=True, help="all cached data that no remaining sweep uses, too")
@click.option("--dry-run", "show_only", is_flag=True, help="show what would go, and how much room that makes")
@click.option("--yes", is_flag=True, help="do not ask")
@click.option("--wait", is_flag=True, help="wait while a sweep runs on this tracking store or in this data folder")
@tracking_option()
@click.pass_obj
def clean(command: str, /, *, tracking: str, show_only: bool, yes: bool, wait: bool, **choice: Any) -> int:
    """List all sweeps and cached data with age and size; with a choice, delete for good what no other sweep uses.

    NAME is a sweep's name or the start of its run's id, as the list shows them. Reports stay.
    """
    module = resolve_name("study.sweep.clean")
    chosen = module.Choice(**choice)
    work = lambda: int(module.clean(chosen, tracking, show_only=show_only, yes=yes, wait=wait))  # noqa: E731
    return stoppable(work, command)


COMMANDS = {
    "status": status,
    "verify": verify,
    "drive": drive,
    "train": train,
    "import": import_results,
    "clean": clean,
}


def main(args: Sequence[str]) -> int:
    """Run the command and return its exit code."""
    return invoke(sweep, args, "study.sweep", COMMANDS)


if __name__ == "__main__":
    run(main)
