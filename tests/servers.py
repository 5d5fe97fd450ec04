"""Real servers for tests, on loopback only: PostgreSQL with a random port and password, and MLflow's tracking server.

Each can be stopped and started again at the same address. As root, PostgreSQL runs as another user, since it refuses
to be root.
"""

from __future__ import annotations

import http.client
import os
import secrets
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import psycopg
import pytest

LOOPBACK = "127.0.0.1"
PATIENCE = 300.0  # [s] for a server to answer; MLflow makes its tables first, and a busy machine is slow
PROGRAMS = Path("/usr/lib/postgresql")  # where Debian keeps them, off the PATH


def free_port() -> int:
    """A port that nobody listens on."""
    with socket.socket() as probe:
        probe.bind((LOOPBACK, 0))
        return int(probe.getsockname()[1])


def _await(process: subprocess.Popen[bytes], answers: Callable[[], bool], log: Path) -> None:
    """Wait until a server answers; its log is the error when it does not."""
    deadline = time.monotonic() + PATIENCE
    while process.poll() is None and time.monotonic() < deadline:
        if answers():
            return
        time.sleep(0.1)
    raise RuntimeError(f"the server did not start:\n{log.read_text(errors='replace')[-4000:]}")


# --- PostgreSQL -----------------------------------------------------------------------------------------------------


def _programs() -> Path | None:
    found = shutil.which("postgres")
    folders = [*sorted(PROGRAMS.glob("*/bin"), key=lambda at: int(at.parent.name), reverse=True)]
    folders += [Path(found).resolve().parent] if found else []
    return next((folder for folder in folders if (folder / "initdb").is_file()), None)


class PostgreSQL:
    """A PostgreSQL server of its own; `uri()` is a new, empty database in it."""

    def __init__(self, programs: Path) -> None:
        self.port, self.password = free_port(), secrets.token_urlsafe(12)
        self._programs, self._process = programs, None
        self._user = {"user": "postgres", "group": "postgres", "extra_groups": []} if os.geteuid() == 0 else {}
        # Not below pytest's folders, which another user may not enter.
        self._folder = Path(tempfile.mkdtemp(prefix="study-postgres-"))
        self._log = self._folder / "log"
        secret = self._folder / "password"
        secret.write_text(self.password)
        if self._user:
            for path in (self._folder, secret):
                shutil.chown(path, "postgres", "postgres")
        words = ["--pgdata", str(self._folder / "data"), "--username", "study", "--encoding", "UTF8", "--no-sync"]
        words += ["--auth", "scram-sha-256", "--pwfile", str(secret)]
        subprocess.run([programs / "initdb", *words], cwd=self._folder, check=True, capture_output=True, **self._user)
        self.start()

    def start(self) -> None:
        """Start it, again at the same port."""
        settings = {
            "listen_addresses": LOOPBACK,
            "port": self.port,
            "unix_socket_directories": "",
            "fsync": "off",  # nobody pulls the plug of a test
        }
        words = [part for name, value in settings.items() for part in ("-c", f"{name}={value}")]
        with self._log.open("ab") as log:
            self._process = subprocess.Popen(
                [self._programs / "postgres", "-D", self._folder / "data", *words],
                cwd=self._folder,
                stdout=log,
                stderr=log,
                **self._user,
            )
        _await(self._process, self._answers, self._log)

    def _answers(self) -> bool:
        try:
            self._do("select 1")
        except psycopg.OperationalError:
            return False
        return True

    def _do(self, statement: str) -> None:
        with psycopg.connect(self._address("postgres"), connect_timeout=5, autocommit=True) as connection:
            connection.execute(statement)

    def _address(self, database: str) -> str:
        return f"postgresql://study:{self.password}@{LOOPBACK}:{self.port}/{database}"

    def uri(self) -> str:
        """URI of a new database, with user and password."""
        name = f"d{secrets.token_hex(6)}"
        self._do(f"create database {name}")
        return self._address(name)

    def stop(self) -> None:
        """Stop it as a reboot would: connections are cut off, what was committed stays."""
        if self._process is not None:
            self._process.send_signal(signal.SIGINT)  # PostgreSQL's fast shutdown
            self._process.wait(30)
            self._process = None

    def remove(self) -> None:
        """Stop it for good."""
        self.stop()
        shutil.rmtree(self._folder)


@pytest.fixture(scope="session")
def postgres() -> Iterator[PostgreSQL]:
    """One PostgreSQL server for the whole run; who stops it starts it again."""
    programs = _programs()
    if programs is None:
        message = "PostgreSQL's programs are not on this machine (Debian: apt install postgresql)"
        if os.environ.get("CI"):
            pytest.fail(message)
        pytest.skip(message)
    server = PostgreSQL(programs)
    yield server
    server.remove()


@pytest.fixture
def database(postgres: PostgreSQL) -> str:
    """URI of a new, empty PostgreSQL database."""
    return postgres.uri()


# --- MLflow ---------------------------------------------------------------------------------------------------------


class TrackingServer:
    """An MLflow server with its store in `folder`, or in the database `store`; artifacts go through it."""

    def __init__(self, folder: Path, store: str | None = None, port: int | None = None) -> None:
        self.port = port or free_port()
        self.uri = f"http://{LOOPBACK}:{self.port}"
        self._folder, self._process = folder, None
        self._store = store or f"sqlite:///{folder}/mlflow.db"
        folder.mkdir(parents=True, exist_ok=True)
        self.start()

    def start(self) -> None:
        """Start it, again at the same port."""
        words = ["server", "--host", LOOPBACK, "--port", str(self.port), "--workers", "1"]
        words += ["--artifacts-destination", str(self._folder / "files")]
        log = self._folder / "server.log"
        with log.open("ab") as stream:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "mlflow", *words],
                cwd=self._folder,
                stdout=stream,
                stderr=stream,
                start_new_session=True,  # its own workers end with it
                env=os.environ
                | {
                    "MLFLOW_BACKEND_STORE_URI": self._store,
                    "MLFLOW_DISABLE_TELEMETRY": "true",
                    "MLFLOW_SERVER_ENABLE_JOB_EXECUTION": "false",  # eight more processes, for GenAI jobs
                },
            )
        try:
            _await(self._process, self._answers, log)
        except RuntimeError:
            self.stop()
            raise

    def _answers(self) -> bool:
        try:
            connection = http.client.HTTPConnection(LOOPBACK, self.port, timeout=1)
            connection.request("GET", "/health")
            connection.getresponse()
        except (OSError, http.client.HTTPException):
            return False
        return True

    def stop(self) -> None:
        """Stop it; what it has stored stays."""
        if self._process is not None:
            os.killpg(self._process.pid, signal.SIGTERM)
            try:
                self._process.wait(30)
            except subprocess.TimeoutExpired:  # a busy machine; what it was told is stored
                os.killpg(self._process.pid, signal.SIGKILL)
                self._process.wait()
            self._process = None


@pytest.fixture
def tracking_server(tmp_path: Path, empty_store: Path) -> Iterator[TrackingServer]:
    """An MLflow server of its own on SQLite; who needs its store in PostgreSQL makes a TrackingServer."""
    (tmp_path / "tracking").mkdir()
    shutil.copy(empty_store, tmp_path / "tracking")
    server = TrackingServer(tmp_path / "tracking")
    yield server
    server.stop()
