"""A sweep, decided: its settings and the key of each of its cells, from a sweep file, a profile and options."""

from __future__ import annotations

import argparse
import json
import os
import shlex
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from study.command import GRID_OPTIONS, Parser, add_options, add_tracking_option, grid_overrides, study_overrides
from study.config import (
    DEFAULT_GRACE,
    DEFAULT_QUEUE,
    SHARED_QUEUES,
    SWEEPS,
    BadInputError,
    Cell,
    Grid,
    StudySettings,
    cell_key,
    content_key,
    frames_key,
    load_grid,
    load_profile,
    merge,
    named_files,
)
from study.cost import Cost, data_cost
from study.data import DATA, drives_folder, frames_folder
from study.imported import Imported, open_import
from study.provenance import usual_threads

if TYPE_CHECKING:
    from study.tracking import Tracker


@dataclass(frozen=True)
class Plan:
    """What a sweep file, a profile and the command line come to.

    `cells`: key -> cell, in the order of the grid; `command`: runs it again, wherever the imported drives lie there.
    """

    grid: Grid
    profile: str
    settings: StudySettings
    cells: dict[str, Cell]
    command: str
    imported: Imported | None = None

    @property
    def frames(self) -> Path:
        """Where the frame store lies, or will lie."""
        return frames_folder(self.settings, DATA, self.imported)

    @property
    def drives(self) -> Path:
        """Where the drives behind it lie, or will lie."""
        return drives_folder(self.settings, DATA, self.imported)

    @property
    def data_cost(self) -> Cost:
        """Of the frame store, from nothing."""
        return data_cost(self.settings, recorded=self.imported is None)

    @property
    def key(self) -> str:
        """Key of the plan: the same cells under the same name."""
        return content_key("plan", {"sweep": self.grid.name, "profile": self.profile}, tuple(self.cells), 1)

    @property
    def queue_name(self) -> str:
        """Under which the plan's cells wait in a queue."""
        return f"{self.grid.name} {self.profile} {self.key}"


def make_plan(name: str, profile: str, study: dict[str, Any], grid: dict[str, Any], data: Path | None = None) -> Plan:
    """The plan of a sweep file, a profile, what the command line overrides, and imported drives if there are any.

    Raises BadInputError.
    """
    loaded = load_grid(name, grid, profile=profile)
    settings = load_profile(profile, merge(loaded.settings, study))
    imported = open_import(data) if data else None
    if imported:
        imported.assign(settings.frames)  # too few drives are told now
    frames = frames_key(settings, imported.key if imported else None)
    cells = {cell_key(settings, cell, loaded.policy_seeds, frames): cell for cell in loaded.cells()}
    words = ["python", "-m", "study.sweep", name, "--profile", profile, *_given(grid, study)]
    return Plan(loaded, profile, settings, cells, shlex.join([*words, *["--data", "FOLDER"] * bool(data)]), imported)


def _given(grid: dict[str, Any], study: dict[str, Any]) -> Iterator[str]:
    """Overrides as options."""
    settings = {f"{group}.{name}": value for group, part in study.items() for name, value in part.items()}
    for name, value in (grid | settings).items():
        yield f"--{name}"
        if isinstance(value, list):
            yield f"[{','.join(map(str, value))}]"
        else:
            yield json.dumps(value) if isinstance(value, dict) else str(value)


def add_plan_options(parser: Parser) -> None:
    """What every command takes that works on a plan."""
    parser.add_argument(
        "sweep",
        metavar="NAME",
        help=f"name of a sweep file in {SWEEPS}/: {', '.join(named_files(SWEEPS)) or 'none here'}",
    )
    parser.add_argument(
        "--profile",
        default="laptop",
        help=f"{', '.join(named_files(SWEEPS / 'profiles'))} (default: laptop)",
    )
    parser.add_argument(
        "--data", type=Path, metavar="FOLDER", help="imported drives (study.data import); default: our town's"
    )
    add_options(parser, Grid, GRID_OPTIONS)
    add_options(parser, StudySettings)


def add_machine_options(parser: Parser) -> None:
    """What every command takes that trains cells."""
    parser.add_argument("--device", default="auto", help="cpu, cuda, cuda:1, ... (default: cuda where there is one)")
    parser.add_argument(
        "--threads",
        type=int,
        default=usual_threads(),
        metavar="N",
        help="threads each cell computes with; with another number the last digits differ (default: %(default)s)",
    )


def check_machine(options: argparse.Namespace) -> None:
    """Raise BadInputError for a device that is not there, or no threads."""
    if options.threads < 1:
        raise BadInputError(f"--threads is {options.threads}; it must be 1 or more")
    if options.device not in {"auto", "cpu"}:
        from study.autoencoder import check_device  # noqa: PLC0415 - loads torch, which only a named GPU needs here

        check_device(options.device)


def thread_hint(workers: int, threads: int, there: int) -> str:
    """What to say when there are more threads than cores: they wait for each other, and keep the cores busy with it."""
    if threads == 1 or workers * threads <= there:
        return ""
    return (
        f"{workers} workers with {threads} threads each hinder each other on {there} cores: give fewer --workers, or "
        f"--threads {max(1, there // workers)}, whose results differ in their last digits"
    )


def given_plan(options: argparse.Namespace) -> Plan:
    """The plan that those options ask for. Raises BadInputError."""
    return make_plan(options.sweep, options.profile, study_overrides(options), grid_overrides(options), options.data)


def look_up(tracking: str) -> Tracker | None:
    """The tracking store of that URI, or None where nothing was tracked yet. Looking makes nothing."""
    path = tracking.removeprefix("sqlite:///")
    if path != tracking and not Path(path).is_file():
        return None  # and MLflow need not be loaded
    from study.tracking import Tracker  # noqa: PLC0415

    return Tracker.look(tracking)


def add_run_options(parser: Parser, workers: str) -> None:
    """What every command takes that trains the cells of a plan; `workers` says what --workers counts."""
    parser.add_argument("--workers", type=int, default=1, metavar="N", help=f"{workers} (default: 1)")
    add_machine_options(parser)
    add_tracking_option(parser)
    parser.add_argument(
        "--queue",
        default=os.environ.get("STUDY_QUEUE", DEFAULT_QUEUE),  # not in the help: it may hold a password
        metavar="URI",
        help=f"{SHARED_QUEUES[0]}user@host/database for many machines (default: STUDY_QUEUE, else {DEFAULT_QUEUE})",
    )
    parser.add_argument(
        "--grace",
        type=float,
        default=DEFAULT_GRACE,
        metavar="S",
        help="shared queue: seconds without a sign of life until a worker's cell waits again (default: %(default)g)",
    )
    parser.add_argument("--retry-failed", action="store_true", help="try cells again that are listed as failed")


def check_run_options(options: argparse.Namespace, fewest_workers: int = 1) -> None:
    """Raise BadInputError for options of `add_run_options` that cannot be used."""
    shared = options.queue.startswith(SHARED_QUEUES)
    if options.workers < fewest_workers:
        raise BadInputError(f"--workers is {options.workers}; it must be {fewest_workers} or more")
    if options.grace < 2:
        raise BadInputError(f"--grace is {options.grace:g}; it must be 2 s or more")
    if shared and options.tracking.startswith("sqlite"):
        raise BadInputError(
            "a shared queue needs a store that all its workers reach: --tracking http://host:port "
            f"(got {options.tracking}; start one with: mlflow server)"
        )
    check_machine(options)
