"""Sweeps of a store with their sizes, and their deletion for good: runs, artifacts, models and the rows of both.

MLflow's client marks runs as deleted; its documented command `mlflow gc` removes what is marked. That command needs the
database, so on a tracking server the runs are marked only.
"""

from __future__ import annotations

import sqlite3
import subprocess
import sys
from collections.abc import Collection, Iterable, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass
from pathlib import Path

from mlflow.entities import LoggedModel, Run, RunTag, ViewType

from study.atomic import scratch_folder
from study.errors import BadInputError
from study.tracking.experiment import SQLITE, Experiment, TrackerLostError, UnreadableError, database_file, local_folder
from study.tracking.reader import PARENT, Reader, opened_at

AT_ONCE = 500  # runs named in one command line


@dataclass(frozen=True)
class StoredSweep:
    """A sweep's run with the runs of the cells that it has trained, and how to name it.

    `planned`: keys of all its cells, whoever has trained them; None when that cannot be read. `state`: finished,
    failed (cells are), stopped, running or deleted (marked in MLflow, not removed yet). `bytes`: of its artifacts and
    its cells', None where they lie elsewhere.
    """

    run: Run
    cells: tuple[Run, ...]
    planned: tuple[str, ...] | None
    finished: int
    state: str
    bytes: int | None

    @property
    def id(self) -> str:
        """Return the identifier of its run."""
        return str(self.run.info.run_id)

    @property
    def name(self) -> str:
        """Return the name of its sweep file."""
        return str(self.run.data.tags.get("sweep"))

    @property
    def profile(self) -> str:
        """Return its profile."""
        return str(self.run.data.tags.get("profile"))

    @property
    def title(self) -> str:
        """Return name and profile, for people."""
        return f"{self.name} ({self.profile})"

    @property
    def used(self) -> float:
        """Return when it was last started or taken up again [s since 1970]."""
        return (opened_at(self.run) or self.run.info.start_time) / 1000


def stored_sweeps(reader: Reader) -> list[StoredSweep]:
    """Return the sweeps of a store, the latest used last, also those that are marked as deleted."""
    experiment = reader.experiment
    with experiment.guard():
        runs = experiment.search("tags.kind = 'sweep'", ViewType.ALL)
        cells = experiment.search("tags.kind = 'cell'", ViewType.ALL)
        models = _models(experiment)
    done = {cell.data.tags.get("cell_key") for cell in cells if cell.info.status == "FINISHED" and _active(cell)}
    sweeps = []
    for run in sorted(runs, key=opened_at):
        own = tuple(cell for cell in cells if cell.data.tags.get(PARENT) == run.info.run_id)
        planned = _planned(reader, run)
        finished = len(done & set(planned or ()))
        size = artifact_bytes((run, *own), models)
        sweeps.append(StoredSweep(run, own, planned, finished, _state(reader, run), size))
    return sweeps


def _active(run: Run) -> bool:
    return bool(run.info.lifecycle_stage == "active")


def _state(reader: Reader, run: Run) -> str:
    if not _active(run):
        return "deleted"
    states = {"FINISHED": "finished", "FAILED": "failed", "RUNNING": "running" if reader.lives(run) else "stopped"}
    return states.get(run.info.status, "stopped")


def _planned(reader: Reader, run: Run) -> tuple[str, ...] | None:
    try:
        return tuple(reader.experiment.read_json(run.info.run_id, "plan.json")["planned"])
    except (UnreadableError, KeyError, TypeError):
        return None


def _models(experiment: Experiment) -> list[LoggedModel]:
    models: list[LoggedModel] = []
    token = None
    while True:
        page = experiment.client.search_logged_models([experiment.id], page_token=token)
        models += page
        token = page.token
        if not token:
            return models


def artifact_bytes(runs: Collection[Run], models: Iterable[LoggedModel]) -> int | None:
    """Return the disk space of these runs' artifacts and models; None where they are not on this machine's disks."""
    ids = {run.info.run_id for run in runs}
    locations = [run.info.artifact_uri for run in runs]
    locations += [model.artifact_location for model in models if model.source_run_id in ids]
    folders = [local_folder(location) for location in locations]
    return None if None in folders else sum(disk_bytes(folder) for folder in folders if folder)


def disk_bytes(path: Path) -> int:
    """Return what a file takes on its disk, or the files in a folder."""
    files = [path] if path.is_file() else [file for file in path.rglob("*") if file.is_file()]
    return sum(file.lstat().st_blocks * 512 for file in files)


# --- deletion -------------------------------------------------------------------------------------------------------


def shared_cells(chosen: Sequence[StoredSweep], remaining: Sequence[StoredSweep]) -> dict[str, tuple[Run, StoredSweep]]:
    """Return run id -> run and first user of the chosen sweeps' cells that remaining sweeps use.

    Raises BadInputError when a remaining sweep does not say what it uses.
    """
    users: dict[str, StoredSweep] = {}
    for sweep in remaining:
        if sweep.planned is None:
            raise BadInputError(
                f"plan.json of {sweep.title}, run {sweep.id}, cannot be read, so the cells that it shares with others "
                "are unknown; clean it, too, or first"
            )
        for key in sweep.planned:
            users.setdefault(key, sweep)
    runs = [cell for sweep in chosen for cell in sweep.cells if _active(cell)]
    return {run.info.run_id: (run, users[key]) for run in runs if (key := run.data.tags.get("cell_key", "")) in users}


@dataclass(frozen=True)
class Deletion:
    """What is to be deleted, `sweeps` with `cells`, and the cells that `stay` with another sweep."""

    experiment: Experiment
    sweeps: tuple[Run, ...]
    cells: tuple[Run, ...]
    stay: dict[str, tuple[Run, StoredSweep]]
    models: tuple[LoggedModel, ...]

    @property
    def bytes(self) -> int:
        """Return the disk space of the artifacts, where they are on this machine's disks."""
        return artifact_bytes((*self.sweeps, *self.cells), self.models) or 0

    @property
    def final(self) -> bool:
        """Return whether this process can remove the runs for good: the database is a file and artifacts lie here."""
        return self.experiment.is_file and self._root is not None

    @property
    def _root(self) -> Path | None:
        return local_folder(self.experiment.client.get_experiment(self.experiment.id).artifact_location)

    def check(self) -> None:
        """Raise BadInputError when more than the chosen would be deleted: folders elsewhere, or other experiments."""
        with self.experiment.guard():
            others = self.experiment.client.search_experiments(view_type=ViewType.DELETED_ONLY)
            root = self._root
        if not self.experiment.is_file or root is None:
            return
        if others:
            raise BadInputError(
                f"experiment '{others[0].name}' in {self.experiment.uri} is deleted, and mlflow gc, which removes "
                "runs, would remove it for good, too; restore it, or remove it first: mlflow gc --backend-store-uri "
                f"{self.experiment.uri} --experiment-ids {others[0].experiment_id}"
            )
        for name, folder in self._folders():
            if folder is None or name not in folder.parts or not folder.resolve().is_relative_to(root.resolve()):
                raise BadInputError(
                    f"the artifacts of {name} are in {folder}, which is not its folder in {root}; nothing is deleted: "
                    "look at it in MLflow"
                )

    def _folders(self) -> list[tuple[str, Path | None]]:
        runs = [(run.info.run_id, run.info.artifact_uri) for run in (*self.sweeps, *self.cells)]
        models = [(model.model_id, model.artifact_location) for model in self.models]
        return [(name, local_folder(location)) for name, location in runs + models]

    def run(self) -> None:
        """Delete. A sweep's own run goes last: until then, the same deletion can be begun again after a kill."""
        self.check()
        client = self.experiment.client
        with self.experiment.guard():
            for run_id, (_, sweep) in self.stay.items():
                tags = {PARENT: sweep.id, "sweep": str(sweep.run.info.run_name)}
                client.log_batch(run_id, tags=[RunTag(*tag) for tag in tags.items()])
            for model in self.models:
                client.delete_logged_model(model.model_id)
            below = [*self.cells, *self._seeds()]
            self._delete(below)
            self._delete(self.sweeps)
        if self.final and (root := self._root):
            for folder in (*root.glob("*"), *root.glob("models/*")):  # MLflow leaves the empty folder around each
                with suppress(OSError):
                    folder.rmdir()

    def _seeds(self) -> list[Run]:
        """Return the seed runs below the cells."""
        cells = {cell.info.run_id for cell in self.cells}
        runs = self.experiment.search("tags.kind = 'seed'", ViewType.ALL)
        return [run for run in runs if run.data.tags.get(PARENT) in cells]

    def _delete(self, runs: Sequence[Run]) -> None:
        """Mark runs as deleted, and remove them for good where that is possible."""
        for run in runs:
            if _active(run):
                self.experiment.client.delete_run(run.info.run_id)
        if self.final:
            run_ids = [run.info.run_id for run in runs]
            for first in range(0, len(run_ids), AT_ONCE):  # without any, mlflow gc would remove whatever is marked
                self._collect(run_ids[first : first + AT_ONCE])

    def _collect(self, run_ids: Sequence[str]) -> None:
        """Have MLflow remove runs that are marked, with their artifacts, and all models that are."""
        database = f"{SQLITE}{database_file(self.experiment.uri)}"
        words = [sys.executable, "-m", "mlflow", "gc", "--backend-store-uri", database, "--tracking-uri", database]
        with scratch_folder() as folder:  # MLflow makes a folder of its own where it is
            done = subprocess.run(
                [*words, "--run-ids", ",".join(run_ids)], cwd=folder, capture_output=True, text=True, check=False
            )
        if done.returncode:
            reason = " ".join((done.stderr.strip().splitlines() or ["no reason given"])[-1].split())
            raise TrackerLostError(
                f"mlflow gc could not remove runs from {self.experiment.uri}: {reason}; give the same command again"
            )


def plan_deletion(reader: Reader, chosen: Sequence[StoredSweep], remaining: Sequence[StoredSweep]) -> Deletion:
    """Return what deleting sweeps comes to. Raises BadInputError when that is unknown, or one of them runs."""
    for sweep in chosen:
        if sweep.state == "running":
            tags = sweep.run.data.tags
            raise BadInputError(
                f"{sweep.title} runs now (process {tags.get('process')} on {tags.get('host')}); stop it first, or wait"
            )
    stay = shared_cells(chosen, remaining)
    cells = tuple(cell for sweep in chosen for cell in sweep.cells if cell.info.run_id not in stay)
    ids = {cell.info.run_id for cell in cells}
    with reader.experiment.guard():
        models = tuple(model for model in _models(reader.experiment) if model.source_run_id in ids)
    return Deletion(reader.experiment, tuple(sweep.run for sweep in chosen), cells, stay, models)


def shrink(experiment: Experiment) -> int:
    """Give the pages of deleted rows in a database file back to the disk; returns how many bytes.

    Raises TrackerLostError when others use the file just now, or the disk has no room for a copy.
    """
    file = database_file(experiment.uri)
    assert file is not None
    before = disk_bytes(file)
    try:
        with closing(sqlite3.connect(file, timeout=20)) as database:
            database.execute("vacuum")
    except sqlite3.Error as error:
        raise TrackerLostError(f"{file} keeps its size for now: {error}") from error
    return before - disk_bytes(file)
