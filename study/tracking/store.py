"""The MLflow store behind a URI: opened or made whole, locked where it is a file, found again after it was moved.

Whoever imports from mlflow imports this first, since mlflow reads its environment when it is loaded.
"""

from __future__ import annotations

import os
import re
import shutil
import sqlite3
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from filelock import FileLock  # noqa: E402
from mlflow.exceptions import MlflowException  # noqa: E402 - reads the above
from mlflow.store.tracking.sqlalchemy_store import SqlAlchemyStore  # noqa: E402
from mlflow.tracking import MlflowClient  # noqa: E402
from sqlalchemy.exc import SQLAlchemyError  # noqa: E402 - comes with mlflow, which lets its errors through

from study.config.workspace import DEFAULT_TRACKING
from study.errors import BadInputError, masked

# Nothing phones home, nothing is printed. A lost server is asked again for about half a minute, MLflow's own default
# being four minutes; whoever sets these differently is obeyed.
os.environ["MLFLOW_DISABLE_TELEMETRY"] = "true"
for _name, _value in {
    "MLFLOW_LOGGING_LEVEL": "CRITICAL",  # its errors come with tracebacks; we tell them in one line
    "MLFLOW_SUPPRESS_PRINTING_URL_TO_STDOUT": "true",
    "MLFLOW_ENABLE_ARTIFACTS_PROGRESS_BAR": "false",
    "MLFLOW_HTTP_REQUEST_TIMEOUT": "30",
    "MLFLOW_HTTP_REQUEST_MAX_RETRIES": "5",
    "MLFLOW_HTTP_REQUEST_BACKOFF_FACTOR": "1",
    "GIT_PYTHON_REFRESH": "quiet",
    "MLFLOW_ALLOW_PICKLE_DESERIALIZATION": "false",  # a model that could carry code is refused
}.items():
    os.environ.setdefault(_name, _value)

SQLITE = "sqlite:///"
SCHEMES = ("sqlite:///", "http://", "https://", "postgresql://", "postgresql+psycopg2://", "postgresql+psycopg://")
PROBE = 3.0  # [s] a server has to answer when it is opened ...
BUSY = 30.0  # ... and one that has answered, to do so again while it serves others
BESIDE = "artifacts_beside_database"  # tag of an experiment whose artifacts move with its database
TROUBLES = (MlflowException, SQLAlchemyError, OSError)  # what a store raises when it is lost


class TrackerLostError(BadInputError):
    """The store does not answer or cannot be written just now: another try may help."""


@dataclass(frozen=True)
class Store:
    """An open store. `shown` is its URI without credentials; a database file has a `lock` beside it."""

    client: MlflowClient
    shown: str
    database: Path | None
    lock: Path | None
    artifacts: Path | None  # where a new experiment's go; a server knows itself

    def experiment(self, name: str, tags: Callable[[str, Mapping[str, str]], Mapping[str, str]]) -> str:
        """The number of the experiment of that name, made if it is not there.

        `tags` gives its tags by its number and those it has. Raises BadInputError when it is deleted.
        """
        found = self.client.get_experiment_by_name(name)
        if found is None:
            with suppress(MlflowException):  # another process was faster, or the next line says what is wrong
                self.client.create_experiment(name, str(self.artifacts) if self.artifacts else None, {BESIDE: "true"})
            found = self.client.get_experiment_by_name(name)
        if found is None or found.lifecycle_stage != "active":
            raise BadInputError(
                f"experiment '{name}' in {self.shown} cannot be used; if it is deleted, run: "
                f"MLFLOW_TRACKING_URI={self.shown} mlflow experiments restore --experiment-id "
                f"{found.experiment_id if found else '...'}"
            )
        number = str(found.experiment_id)
        for key, value in tags(number, found.tags).items():
            if found.tags.get(key) != value:
                insert(self.client.set_experiment_tag, number, key, value)
        if self.database and BESIDE in found.tags:  # without it, someone keeps them elsewhere on purpose
            self._follow(number, str(found.artifact_location))
        return number

    def _follow(self, experiment: str, old: str) -> None:
        """Let the database point to the artifacts beside it: MLflow stores whole paths, and folders are moved."""
        new = str(self.artifacts)
        if old == new:
            return
        assert self.database is not None
        with sqlite3.connect(self.database, timeout=20) as database:
            database.execute(
                "UPDATE experiments SET artifact_location = ? WHERE experiment_id = ?", (new, int(experiment))
            )
            database.execute(
                "UPDATE runs SET artifact_uri = ? || substr(artifact_uri, ?) WHERE substr(artifact_uri, 1, ?) = ?",
                (new, len(old) + 1, len(old) + 1, f"{old}/"),
            )
            database.execute(
                "UPDATE logged_models SET artifact_location = ? || substr(artifact_location, ?) "
                "WHERE substr(artifact_location, 1, ?) = ?",
                (new, len(old) + 1, len(old) + 1, f"{old}/"),
            )
        database.close()


def open_store(uri: str) -> Store:
    """The store behind a URI; a database file that is missing is made. Raises BadInputError when it cannot be used."""
    shown = masked(uri)
    if not uri.startswith(SCHEMES) or uri == SQLITE:
        raise BadInputError(f"tracking URI '{shown}' cannot be used; give {DEFAULT_TRACKING} or http://host:port")
    database = lock = artifacts = None
    if uri.startswith(SQLITE):
        database = Path(uri.removeprefix(SQLITE).partition("?")[0]).absolute()
        artifacts = database.parent / "artifacts"
        lock = database.with_name(f".{database.name}.lock")
        _prepare_file(database, artifacts, lock, shown)
        uri = f"{SQLITE}{database}"
    elif uri.startswith("http"):
        _probe(uri, shown)
    else:
        artifacts = Path(DEFAULT_TRACKING.removeprefix(SQLITE)).absolute().parent / "artifacts"
    with guard(shown, opening=True), few_tries(BUSY):
        return Store(MlflowClient(uri), shown, database, lock, artifacts)


@contextmanager
def guard(shown: str, *, opening: bool = False) -> Iterator[None]:
    """Turn the store's troubles into one clear error; mistakes of this program stay what they are."""
    try:
        yield
    except (*TROUBLES, ImportError) as error:  # or a database's driver is missing
        code = getattr(error, "error_code", None)
        if code in ("INVALID_PARAMETER_VALUE", "BAD_REQUEST") and not opening:
            raise
        text = " ".join(masked(str(error)).split())[:400]
        step = "start it, or choose another with --tracking"
        if shown.startswith("sqlite"):
            step = "look at disk space and rights, or choose another with --tracking"
        if "db upgrade" in text:
            step = f"copy the file, then run: mlflow db upgrade {shown}"
        # `from None`: what lies below may name credentials.
        raise TrackerLostError(f"the tracking store {shown} gave no usable answer: {text}; {step}") from None


def insert(write: Callable[..., Any], *what: Any, **more: Any) -> None:
    """Write; when another process has written the same in this moment, MLflow's insert fails once, then finds it."""
    try:
        write(*what, **more)
    except MlflowException as error:
        if error.error_code != "BAD_REQUEST":
            raise
        write(*what, **more)


@contextmanager
def few_tries(seconds: float = PROBE) -> Iterator[None]:
    """Ask a server once or twice only, with `seconds` to answer."""
    names = {"MLFLOW_HTTP_REQUEST_MAX_RETRIES": "1", "MLFLOW_HTTP_REQUEST_TIMEOUT": str(int(seconds))}
    before = {name: os.environ.get(name) for name in names}
    os.environ.update(names)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is not None:
                os.environ[name] = value


def _probe(uri: str, shown: str) -> None:
    """Raise TrackerLostError when a server does not answer at once."""
    url = re.sub(r"//[^/@]*@", "//", uri).rstrip("/") + "/health"
    try:
        with urllib.request.urlopen(url, timeout=PROBE):  # noqa: S310 - the scheme is http or https
            pass
    except urllib.error.HTTPError:
        pass  # it answers; whether it is MLflow shows at the first question
    except (OSError, ValueError) as error:
        reason = getattr(error, "reason", error)
        raise TrackerLostError(
            f"the tracking server {shown} does not answer ({reason}); start it (mlflow server), "
            f"check the address, or leave --tracking out to use {DEFAULT_TRACKING}"
        ) from None


def _prepare_file(path: Path, artifacts: Path, lock: Path, shown: str) -> None:
    """Make the database whole or not at all; refuse a file that is not MLflow's."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        if not path.exists():
            # MLflow needs seconds for its tables; a process killed in between would leave a database half made.
            with FileLock(lock):
                if not path.exists():
                    drafts = path.with_name(f".{path.name}.draft")  # a folder, since SQLite writes a journal beside
                    shutil.rmtree(drafts, ignore_errors=True)
                    drafts.mkdir()
                    draft = drafts / path.name
                    SqlAlchemyStore(f"{SQLITE}{draft}", str(artifacts))
                    draft.replace(path)
                    shutil.rmtree(drafts)
            return
        with sqlite3.connect(f"{path.as_uri()}?mode=ro", uri=True, timeout=20) as database:
            tables = {row[0] for row in database.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
        database.close()
    except (OSError, sqlite3.Error, SQLAlchemyError, MlflowException) as error:
        raise BadInputError(
            f"{shown} cannot be used as a tracking store: {error}; move the file away or give another --tracking"
        ) from None
    if not {"experiments", "runs", "alembic_version"} <= tables:
        raise BadInputError(f"{shown} is a database, but not MLflow's; give another file with --tracking")
