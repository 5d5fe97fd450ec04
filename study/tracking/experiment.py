"""One experiment of an MLflow store: opening it, searching its runs, and one clear error when the store fails."""

from __future__ import annotations

import json
import logging
import os
import platform
import re
import shutil
import sqlite3
import urllib.error
import urllib.parse
import urllib.request
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from filelock import FileLock
from mlflow.entities import Experiment as MlflowExperiment
from mlflow.entities import Run, ViewType
from mlflow.exceptions import MlflowException
from mlflow.tracking import MlflowClient
from sqlalchemy.exc import SQLAlchemyError  # MLflow depends on sqlalchemy and lets its errors through

from study.atomic import scratch_folder
from study.config.workspace import HERE
from study.errors import BadInputError, full_place, masked
from study.tracking.run_page import experiment_tags
from study.tracking.schema import has_tables

SQLITE = "sqlite:///"
SCHEMES = (SQLITE, "http://", "https://", "postgresql://", "postgresql+psycopg2://", "postgresql+psycopg://")
PROBE = 3.0  # [s] within which a server must answer the first question ...
BUSY = 30.0  # ... and the next ones, while it serves others
BESIDE = "artifacts_beside_database"  # tag of an experiment whose artifacts this program has put beside the database
STORE_ERRORS = (MlflowException, SQLAlchemyError, OSError)  # what MLflow raises when its store is lost
ENVIRONMENT = {  # MLflow reads these at each call; a value that the user has set is kept
    "MLFLOW_DISABLE_TELEMETRY": "true",
    "MLFLOW_SUPPRESS_PRINTING_URL_TO_STDOUT": "true",
    "MLFLOW_ENABLE_ARTIFACTS_PROGRESS_BAR": "false",
    "MLFLOW_HTTP_REQUEST_TIMEOUT": "30",
    "MLFLOW_HTTP_REQUEST_MAX_RETRIES": "5",  # gives up after half a minute; MLflow's default is four minutes
    "MLFLOW_HTTP_REQUEST_BACKOFF_FACTOR": "1",
}


class TrackerLostError(BadInputError):
    """The store does not answer or cannot be written just now: another try may help."""


class DeletedError(BadInputError):
    """A run, or the experiment, was deleted in MLflow by somebody else."""


class UnreadableError(BadInputError):
    """Something of a run is missing or damaged, although the store answers: reports name it and go on without it."""


@dataclass(frozen=True)
class Experiment:
    """An experiment of an open store. `uri` is the store's, without credentials."""

    client: MlflowClient
    uri: str
    id: str

    @property
    def is_file(self) -> bool:
        """Whether the store is a database file, which belongs to one machine."""
        return self.uri.startswith(SQLITE)

    def guard(self) -> AbstractContextManager[None]:
        """Turn errors of the store into TrackerLostError."""
        return guard(self.uri)

    def search(self, query: str, view: int = ViewType.ACTIVE_ONLY) -> list[Run]:
        """Return all runs that match, in the order of their start; deleted ones only with another `view`."""
        runs: list[Run] = []
        token = None
        while True:
            page = self.client.search_runs([self.id], query, view, max_results=1000, page_token=token)
            runs += page
            token = page.token
            if not token:
                return sorted(runs, key=lambda run: (run.info.start_time, run.info.run_id))

    def download(self, run_id: str, artifact: str, folder: str) -> Path:
        """Copy an artifact into a folder. Raises UnreadableError, and TrackerLostError when the store is away."""
        try:
            return Path(self.client.download_artifacts(run_id, artifact, folder))
        except STORE_ERRORS as error:
            reason = " ".join(masked(str(error)).replace(f"{folder}/", "").split())[:200]
        with self.guard():
            self.client.get_run(run_id)  # it answers, so the artifact is at fault
        raise UnreadableError(f"{artifact} of run {run_id} in {self.uri} cannot be read: {reason}")

    def read_text(self, run_id: str, artifact: str) -> str:
        """Return the content of a text artifact. Raises as `download`."""
        with scratch_folder() as folder:
            return self.download(run_id, artifact, folder).read_text(encoding="utf-8", errors="replace")

    def read_json(self, run_id: str, artifact: str) -> dict[str, Any]:
        """Return the content of a JSON artifact. Raises as `download`."""
        try:
            return dict(json.loads(self.read_text(run_id, artifact)))
        except (ValueError, TypeError):
            raise UnreadableError(f"{artifact} of run {run_id} in {self.uri} is no JSON object") from None


def open_experiment(uri: str, name: str) -> Experiment:
    """Open an experiment, and create it and its store where they are missing.

    Raises TrackerLostError when the store does not answer, BadInputError when it cannot be used.
    """
    client, shown, artifacts = _connect(uri)
    with guard(shown, opening=True), few_tries(BUSY):
        if client.get_experiment_by_name(name) is None:
            check_place(uri, name, None)
            client.create_experiment(name, str(artifacts) if artifacts else None, {BESIDE: "true"})
        entity = client.get_experiment_by_name(name)
        check_place(uri, name, entity.artifact_location)
        experiment = _usable(entity, client, shown, artifacts)
        for key, value in experiment_tags(experiment.id, entity.tags).items():
            if entity.tags.get(key) != value:
                client.set_experiment_tag(experiment.id, key, value)
    return experiment


def find_experiment(uri: str, name: str) -> Experiment | None:
    """Return an experiment, or None where there is none of that name, and create nothing."""
    database = database_file(uri)
    if database and not database.exists():
        return None
    if not uri.startswith("http") and not _checked(uri, masked(uri), database):
        return None
    client, shown, artifacts = _connect(uri)
    with guard(shown, opening=True), few_tries():
        entity = client.get_experiment_by_name(name)
        return _usable(entity, client, shown, artifacts) if entity else None


def database_file(uri: str) -> Path | None:
    """Return the file of a SQLite store, or None for another kind."""
    return Path(uri.removeprefix(SQLITE).partition("?")[0]).resolve() if uri.startswith(SQLITE) else None


@contextmanager
def guard(shown: str, *, opening: bool = False) -> Iterator[None]:
    """Turn errors of the store into TrackerLostError or DeletedError; those that tell of wrong calls stay."""
    try:
        yield
    except (*STORE_ERRORS, ImportError) as error:  # ImportError: the driver of a database is missing
        code = getattr(error, "error_code", None)
        if is_deleted(error):
            raise DeletedError(f"somebody has deleted in {shown} what was being written: {error}") from None
        if code in ("INVALID_PARAMETER_VALUE", "BAD_REQUEST") and not opening:
            raise
        text = " ".join(masked(str(error)).split())[:400]
        step = "start it, or choose another with --tracking"
        if shown.startswith(SQLITE):
            step = "look at disk space and rights, or choose another with --tracking"
        if "db upgrade" in text:
            step = f"copy the file, then run: mlflow db upgrade {shown}"
        # `from None`: the chained error may show credentials.
        raise TrackerLostError(f"the tracking store {shown} gave no usable answer: {text}; {step}") from None


def is_deleted(error: BaseException) -> bool:
    """Return whether an error of MLflow says that a run or experiment is deleted, or removed for good."""
    code = getattr(error, "error_code", None)
    return code == "RESOURCE_DOES_NOT_EXIST" or (code == "INVALID_PARAMETER_VALUE" and "'active' state" in str(error))


@contextmanager
def few_tries(seconds: float = PROBE) -> Iterator[None]:
    """Have MLflow ask a server at most twice, with `seconds` to answer."""
    fewer = {"MLFLOW_HTTP_REQUEST_MAX_RETRIES": "1", "MLFLOW_HTTP_REQUEST_TIMEOUT": str(int(seconds))}
    before = {name: os.environ[name] for name in fewer}  # set when the store was opened
    os.environ.update(fewer)
    try:
        yield
    finally:
        os.environ.update(before)


def _connect(uri: str) -> tuple[MlflowClient, str, Path | None]:
    """Return a client, the URI without credentials, and the folder of a new experiment's artifacts; servers know it."""
    # Process-wide, as MLflow wants it: nothing is printed, and no usage data are sent.
    for name, value in ENVIRONMENT.items():
        os.environ.setdefault(name, value)
    for name in ("mlflow", "alembic"):  # they log errors with tracebacks; commands print them in one line
        logging.getLogger(name).setLevel(logging.CRITICAL)
    shown = masked(uri)
    if not uri.startswith(SCHEMES) or uri == SQLITE:
        raise BadInputError(f"tracking URI '{shown}' cannot be used; give {HERE.tracking} or http://host:port")
    database, artifacts = database_file(uri), None
    if database:
        found = set(str(database))
        quotes = {"'", '"'}  # MLflow can write one kind of them, not both
        if odd := {"?", "%"} & found or (quotes if quotes <= found else set()):
            raise BadInputError(
                f"{database} cannot be a tracking store: MLflow misreads {' and '.join(sorted(odd))} in a folder's "
                "name; work in a folder without, or name one with --tracking"
            )
        _prepare_database(database, shown)
        uri, artifacts = f"{SQLITE}{database}", database.parent / "artifacts"
    elif uri.startswith("http"):
        _probe(uri, shown)
    else:
        _checked(uri, shown, None)
        artifacts = HERE.mlruns.absolute() / "artifacts"
    with guard(shown, opening=True), few_tries(BUSY):
        return MlflowClient(uri), shown, artifacts


def _usable(entity: MlflowExperiment, client: MlflowClient, shown: str, artifacts: Path | None) -> Experiment:
    """Return the experiment. Raises BadInputError when it is deleted or its artifacts are elsewhere."""
    if entity.lifecycle_stage != "active":
        raise BadInputError(
            f"experiment '{entity.name}' in {shown} is deleted; restore it: MLFLOW_TRACKING_URI={shown} "
            f"mlflow experiments restore --experiment-id {entity.experiment_id}"
        )
    # MLflow stores absolute paths of artifacts and has no way to change them.
    place = Path(entity.artifact_location)
    if shown.startswith(SQLITE) and artifacts and BESIDE in entity.tags and place.resolve() != artifacts.resolve():
        raise BadInputError(
            f"{shown} was moved or copied: it expects its artifacts in {place}, not in {artifacts}; use it where it "
            f"was, or, if it was moved, link the old path to the new one: ln -s {artifacts} {place}"
        )
    return Experiment(client, shown, str(entity.experiment_id))


def check_place(uri: str, name: str, location: str | None) -> None:
    """Raise BadInputError when artifacts would lie where other users of a database on another host cannot read them.

    `location`: where the experiment of that name has its artifacts; None: it is to be made.
    """
    host = None if uri.startswith((SQLITE, "http")) else _other_host(uri)
    folder = local_folder(location) if location else None
    if host is None or (location and (folder is None or folder.is_dir())):
        return
    shown = masked(uri)
    place = (
        f"its artifacts in {location}, a folder that this machine lacks" if location else "no place for artifacts yet"
    )
    raise BadInputError(
        f"{shown} is a database on {host}, and experiment '{name}' has {place}: results are files, which every machine "
        f"must reach. Start a server on {host}: mlflow server --host {host} --backend-store-uri {shown} "
        f"--artifacts-destination FOLDER, and give --tracking http://{host}:5000; or make the experiment with a place "
        f"that all machines reach: MLFLOW_TRACKING_URI={shown} mlflow experiments create --experiment-name NAME "
        f"--artifact-location s3://BUCKET/FOLDER (or a shared folder, which exists)"
    )


def local_folder(location: str) -> Path | None:
    """Return the folder that a location of artifacts names, or None for one that is not on this machine's disks."""
    if urllib.parse.urlsplit(location).scheme not in {"", "file"}:
        return None
    return Path(urllib.request.url2pathname(location.removeprefix("file://")))


def _other_host(uri: str) -> str | None:
    """Return the host of a database's URI, or None for this machine."""
    parts = urllib.parse.urlsplit(uri)
    host = parts.hostname or urllib.parse.parse_qs(parts.query).get("host", [""])[0]
    here = host in {"", "localhost", "::1", platform.node()} or host.startswith(("127.", "/"))
    return None if here else host


def _probe(uri: str, shown: str) -> None:
    """Raise TrackerLostError when a server does not answer within PROBE seconds."""
    url = re.sub(r"//[^/@]*@", "//", uri).rstrip("/") + "/health"
    try:
        with urllib.request.urlopen(url, timeout=PROBE):  # noqa: S310 - the scheme is http or https
            pass
    except urllib.error.HTTPError:
        pass  # it answers; the first question shows whether it is MLflow
    except (OSError, ValueError) as error:
        raise TrackerLostError(
            f"the tracking server {shown} does not answer ({getattr(error, 'reason', error)}); start it (mlflow "
            f"server), check the address, or leave --tracking out to use {HERE.tracking}"
        ) from None


def _prepare_database(database: Path, shown: str) -> None:
    """Create the file where it is missing; refuse one that is not MLflow's or of another version of it."""
    if not database.exists():
        with _usable_database(shown, database):
            create_database(database)
    _checked(f"{SQLITE}{database}", shown, database)


def _checked(uri: str, shown: str, database: Path | None) -> bool:
    """Return whether a database has MLflow's tables. Raises BadInputError when it cannot be used as it is."""
    if not uri.startswith(SCHEMES) or uri == SQLITE:
        return True  # `_connect` refuses it
    with _usable_database(shown, database):
        return has_tables(uri, shown, database)


@contextmanager
def _usable_database(shown: str, database: Path | None) -> Iterator[None]:
    """Turn errors of a database into one that says what to do."""
    if database is None:
        with guard(shown, opening=True):
            yield
        return
    try:
        yield
    except (OSError, sqlite3.Error, SQLAlchemyError, MlflowException) as error:
        reason = getattr(error, "orig", None) or error
        step = "move the file away" if full_place(error) is None else "make room"
        raise BadInputError(
            f"{shown} cannot be used as a tracking store: {reason}; {step} or give another --tracking"
        ) from None


def create_database(database: Path) -> None:
    """Create the file atomically: MLflow needs seconds for its tables, and may be killed meanwhile."""
    database.parent.mkdir(parents=True, exist_ok=True)
    with FileLock(database.with_name(f".{database.name}.lock")):
        if not database.exists():
            folder = database.with_name(f".{database.name}.draft")  # SQLite writes a journal beside the draft
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir()
            MlflowClient(f"{SQLITE}{folder / database.name}").search_experiments()
            (folder / database.name).replace(database)
            shutil.rmtree(folder)
