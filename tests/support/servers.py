"""Runs MLflow's tracking server on loopback; it can be stopped and started again."""

from __future__ import annotations

import http.client
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

LOOPBACK = "127.0.0.1"
PATIENCE = 300.0  # [s] for a server to answer; MLflow makes its tables first, and a busy machine is slow


def free_port() -> int:
    """Return a port that nobody listens on."""
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


# --- MLflow ---------------------------------------------------------------------------------------------------------


class TrackingServer:
    """Runs an MLflow server with its store in `folder`, or in the database `store`; artifacts go through it."""

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
