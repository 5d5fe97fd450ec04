"""A sweep, decided: its settings and the key of each of its cells, from a sweep file, a profile and options."""

from __future__ import annotations

import argparse
import json
import shlex
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from study.cell.job import CellJob
from study.config.files import load_grid, load_profile, merge
from study.config.grid import Cell, Grid
from study.config.keys import cell_key, content_key, frames_key
from study.config.settings import StudySettings
from study.config.workspace import DATA
from study.console.options import (
    grid_overrides,
    study_overrides,
)
from study.data.prepare import drives_folder, frames_folder
from study.episode.imported import Imported, open_import
from study.stages import Cost, Work, data_cost

if TYPE_CHECKING:
    from study.tracking.reader import Reader


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


def given_plan(options: argparse.Namespace) -> Plan:
    """The plan that those options ask for. Raises BadInputError."""
    return make_plan(options.sweep, options.profile, study_overrides(options), grid_overrides(options), options.data)


def look_up(tracking: str) -> Reader | None:
    """Return a reader of that tracking store, or None where nothing was tracked yet, and create nothing."""
    path = tracking.removeprefix("sqlite:///")
    if path != tracking and not Path(path).is_file():
        return None  # and MLflow need not be loaded
    from study.tracking.reader import Reader  # noqa: PLC0415

    return Reader.look(tracking)


def cell_jobs(plan: Plan, device: str, threads: int) -> dict[str, CellJob]:
    """Return what training each cell needs to know, by key."""
    seeds, folders = plan.grid.policy_seeds, (plan.frames, plan.drives, DATA)
    return {
        key: CellJob(cell, key, plan.settings, seeds, *folders, device, threads, plan.imported, plan.grid.head_modules)
        for key, cell in plan.cells.items()
    }
