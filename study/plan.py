"""A sweep, decided: its settings and the key of each of its cells, from a sweep file, a profile and options."""

from __future__ import annotations

import argparse
import json
import shlex
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from study.command import GRID_OPTIONS, Parser, add_options, add_tracking_option, grid_overrides, study_overrides
from study.config import (
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
from study.data import DATA, drives_folder, frames_folder
from study.imported import Imported, open_import
from study.job import CellJob
from study.stages import Cost, Work, data_cost

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
    def works(self) -> dict[str, Work]:
        """What the keys and costs of each cell's stages follow from."""
        return {key: Work(self.settings, cell, self.grid.policy_seeds) for key, cell in self.cells.items()}

    @property
    def key(self) -> str:
        """Key of the plan: the same cells under the same name."""
        return content_key("plan", {"sweep": self.grid.name, "profile": self.profile}, tuple(self.cells), 1)

    @property
    def study_name(self) -> str:
        """Name of the plan's Optuna study."""
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
        default=1,
        metavar="N",
        help="threads each task computes with, for a lone large encoder; the last digits depend on it (default: 1)",
    )


def check_machine(options: argparse.Namespace) -> None:
    """Raise BadInputError for a device that is not there, or no threads."""
    if options.threads < 1:
        raise BadInputError(f"--threads is {options.threads}; it must be 1 or more")
    if options.device not in {"auto", "cpu"}:
        from study.autoencoder import check_device  # noqa: PLC0415 - loads torch, which only a named GPU needs here

        check_device(options.device)


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


def cell_jobs(plan: Plan, device: str, threads: int) -> dict[str, CellJob]:
    """Return what training each cell needs to know, by key."""
    seeds, folders = plan.grid.policy_seeds, (plan.frames, plan.drives, DATA)
    return {
        key: CellJob(cell, key, plan.settings, seeds, *folders, device, threads, plan.imported)
        for key, cell in plan.cells.items()
    }


def add_run_options(parser: Parser) -> None:
    """Add the options of a command that trains the cells of a plan and commits them."""
    parser.add_argument(
        "--workers", type=int, metavar="N", help="processes on this machine, one task each (default: all cores)"
    )
    parser.add_argument(
        "--cluster",
        metavar="WHERE",
        help="run on a Dask cluster: its scheduler's address (tls://host:8786), or a YAML file for a batch system",
    )
    parser.add_argument(
        "--certificates", type=Path, metavar="DIR", help="with tls://: folder with ca.pem, cert.pem and key.pem"
    )
    add_machine_options(parser)
    add_tracking_option(parser)
    parser.add_argument("--wait", action="store_true", help="wait while another sweep runs on this tracking store")
    parser.add_argument("--retry-failed", action="store_true", help="try cells again that are listed as failed")


def check_run_options(options: argparse.Namespace) -> None:
    """Raise BadInputError for options of `add_run_options` that cannot be used."""
    if options.workers is not None and options.workers < 1:
        raise BadInputError(f"--workers is {options.workers}; it must be 1 or more")
    if options.cluster and options.workers is not None:
        raise BadInputError("--workers counts processes on this machine; a cluster has its own: leave one of them out")
    if options.certificates and not (options.cluster or "").startswith("tls://"):
        raise BadInputError("--certificates goes with --cluster tls://host:port")
    if options.cluster:
        from study.engine.cluster import check_cluster  # noqa: PLC0415 - Dask, which only a run needs

        check_cluster(options.cluster, options.certificates)
    if options.threads < 1 or (options.device not in {"auto", "cpu"} and not options.cluster):
        check_machine(options)
