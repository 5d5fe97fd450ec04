"""Runs the study's commands as a user's terminal does: as processes, in a working folder."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

ROOT = Path(__file__).parents[2]
PATIENCE = 900.0  # [s] for anything to happen: a busy machine is slow, and no test here measures speed


def sweep_command(*words: str) -> list[str]:
    """Return the command line of a sweep."""
    return [sys.executable, "-m", "study.sweep", *words]


def sweep(folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    """Run a sweep to its end."""
    return subprocess.run(sweep_command(*words), cwd=folder, capture_output=True, text=True, check=False)


class CommandProcess:
    """Runs a command in a session of its own, as a terminal does; its output goes to a file."""

    def __init__(self, folder: Path, *words: str, log: Path | None = None, role: str = "client", **more: str) -> None:
        self.folder, self.log, self.role = folder, log or folder / "log", role
        with self.log.open("ab") as stream:
            self._log_start = stream.tell()
            self.process = subprocess.Popen(
                words, cwd=folder, stdout=stream, stderr=stream, start_new_session=True, env=os.environ | more
            )

    @property
    def output(self) -> str:
        """Return what it has written so far."""
        with self.log.open("rb") as log:
            log.seek(self._log_start)
            return log.read().decode(errors="replace")

    @property
    def running(self) -> bool:
        return self.process.poll() is None

    def wait_for(self, condition: Callable[[], object]) -> bool:
        """Wait for a condition. False: the command ended first."""
        deadline = time.monotonic() + PATIENCE
        while self.running:
            if condition():
                return True
            assert time.monotonic() < deadline, f"the condition did not hold within {PATIENCE:.0f} s:\n{self.output}"
            time.sleep(0.05)
        return False

    def wait(self) -> int:
        """Wait for the command and for every process that it started; return its exit code."""
        code = self.process.wait(PATIENCE)
        deadline = time.monotonic() + PATIENCE
        while self.roles():
            assert time.monotonic() < deadline, f"still running: {self.roles()}"
            time.sleep(0.01)
        return code

    def roles(self) -> dict[int, str]:
        """Return the role of each process of the session, by process id: client, worker, scheduler, nanny or other."""
        roles = {}
        for path in Path("/proc").glob("[0-9]*"):
            with suppress(OSError):  # ended meanwhile
                fields = (path / "stat").read_text().rpartition(")")[2].split()
                if fields[3] == str(self.process.pid) and fields[0] not in "ZX":
                    spawned = "spawn_main" in (path / "cmdline").read_text(errors="replace")
                    roles[int(path.name)] = "worker" if spawned else "other"
        return roles | ({self.process.pid: self.role} if self.process.pid in roles else {})

    def pids(self, role: str) -> list[int]:
        """Return the processes of a role."""
        return [pid for pid, each in self.roles().items() if each == role]

    def send(self, signal_: signal.Signals, *pids: int) -> int:
        """Send a signal and return how many of the processes were still running."""
        sent = 0
        for pid in pids:
            with suppress(ProcessLookupError):
                os.kill(pid, signal_)
                sent += 1
        return sent
