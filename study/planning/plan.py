"""A sweep, decided: its settings and the key of each of its cells, from a sweep file, a profile and options."""

from __future__ import annotations

import json
import pkgutil
import shlex
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from study.cell.job import CellJob
from study.config.files import load_grid, load_profile, merge
from study.config.grid import Cell, Grid
from study.config.keys import cell_key, content_key, frames_key
from study.config.settings import StudySettings
from study.config.workspace import HERE, Workspace
from study.console.display import Display
from study.data.prepare import drives_folder, frames_folder
from study.errors import BadInputError
from study.intake.imported import Imported, open_import
from study.sim.dynamics import check_dynamics
from study.stages import Cost, Work, cell_cost, data_cost

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
    workspace: Workspace = HERE

    @property
    def title(self) -> str:
        """Return the sweep and its profile, for people."""
        return f"{self.grid.name} ({self.profile}{f', {self.imported.folder.name}' if self.imported else ''})"

    @property
    def frames(self) -> Path:
        """Return where the frame store lies, or will lie."""
        return frames_folder(self.settings, self.workspace.data, self.imported)

    @property
    def frames_ready(self) -> bool:
        """Return whether the frame store has been made."""
        return (self.frames / "manifest.json").is_file()

    @property
    def drives(self) -> Path:
        """Return where the drives behind it lie, or will lie."""
        return drives_folder(self.settings, self.workspace.data, self.imported)

    @property
    def data_cost(self) -> Cost:
        """Return the cost of making the frame store from nothing."""
        return data_cost(self.settings, recorded=self.imported is None)

    @property
    def costs(self) -> dict[str, Cost]:
        """Return the cost of each cell."""
        return {key: cell_cost(self.settings, cell, self.grid.policy_seeds) for key, cell in self.cells.items()}

    @property
    def drivers(self) -> list[str]:
        """Return the cells whose policies should drive in closed loop; on imported drives there is no town for it."""
        if not self.grid.drive or self.imported:
            return []
        return [key for key, cell in self.cells.items() if not cell.baseline or cell.baseline.driving]

    @property
    def works(self) -> dict[str, Work]:
        """Return what the keys and costs of each cell's stages follow from."""
        return {key: Work(self.settings, cell, self.grid.policy_seeds) for key, cell in self.cells.items()}

    @property
    def study_name(self) -> str:
        """Return the name of the plan's Optuna study."""
        return study_name(self.grid.name, self.profile, self.cells)


def study_name(sweep: str, profile: str, cells: Iterable[str]) -> str:
    """Return the name of the Optuna study of a plan: the same cells under the same name."""
    return f"{sweep} {profile} {content_key('plan', {'sweep': sweep, 'profile': profile}, tuple(cells), 1)}"


def make_plan(
    name: str,
    profile: str,
    study: dict[str, Any],
    grid: dict[str, Any],
    data: Path | None = None,
    workspace: Workspace = HERE,
) -> Plan:
    """Return the plan of a sweep file, a profile, what the command line overrides, and imported drives if any.

    Raises BadInputError.
    """
    loaded = load_grid(name, grid, workspace.sweeps, profile)
    if data and grid.get("drive"):
        raise BadInputError(f"--drive true: the imported drives of {data} have no town to drive in; leave it out")
    settings = load_profile(profile, merge(loaded.settings, study), workspace.sweeps)
    imported = open_import(data) if data else None
    if imported:
        imported.assign(settings.frames)  # so that too few drives are an error now
    else:
        check_dynamics(settings.town, settings.dynamics)
    frames = frames_key(settings, imported.key if imported else None)
    cells = {cell_key(settings, cell, loaded.policy_seeds, frames): cell for cell in loaded.cells()}
    words = ["python", "-m", "study.sweep", name, "--profile", profile, *_given(grid, study)]
    command = shlex.join([*words, *["--data", "FOLDER"] * bool(data)])
    return Plan(loaded, profile, settings, cells, command, imported, workspace)


def _given(grid: dict[str, Any], study: dict[str, Any]) -> Iterator[str]:
    """Yield overrides as options."""
    settings = {f"{group}.{name}": value for group, part in study.items() for name, value in part.items()}
    for name, value in (grid | settings).items():
        yield f"--{name}"
        if isinstance(value, list):
            yield f"[{','.join(map(str, value))}]"
        else:
            yield json.dumps(value) if isinstance(value, dict | bool) else str(value)


def look_up(tracking: str) -> Reader | None:
    """Return a reader of that tracking store, or None where nothing was tracked yet, and create nothing."""
    path = tracking.removeprefix("sqlite:///")
    if path != tracking and not Path(path).is_file():
        return None  # and MLflow need not be loaded
    reader: Reader | None = pkgutil.resolve_name("study.tracking.reader:Reader").look(tracking)
    return reader


def cell_jobs(plan: Plan, device: str, threads: int) -> dict[str, CellJob]:
    """Return what training each cell needs to know, by key."""
    seeds, folders = plan.grid.policy_seeds, (plan.frames, plan.drives, plan.workspace.data)
    return {
        key: CellJob(cell, key, plan.settings, seeds, *folders, device, threads, plan.imported, plan.grid.modules)
        for key, cell in plan.cells.items()
    }


def plan_display(plan: Plan, waiting: Collection[str], given_up: Collection[str] = ()) -> Display:
    """Return the display of a plan of which the cells `waiting` are to be trained."""
    costs = {key: cost.seconds for key, cost in plan.costs.items() if key in waiting}
    labels = {key: cell.label for key, cell in plan.cells.items()}
    data_seconds = plan.data_cost.seconds if waiting and not plan.frames_ready else 0.0
    return Display(plan.title, costs | dict.fromkeys(given_up, 0.0), labels, data_seconds, plan.works)
