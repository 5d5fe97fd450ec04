"""Provenance of a result: commit with the uncommitted diff, lock file, package versions, machine.

No user, host or folder names: results are passed on.
"""

from __future__ import annotations

import contextlib
import datetime as dt
import hashlib
import importlib.metadata
import os
import platform
import re
import shutil
import subprocess
import tempfile
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
DIFF_LIMIT = 1_000_000  # bytes
NEW_FILES = ("study", "sweeps", "tests", "benchmarks")  # elsewhere a new file may be a secret or a data set


def provenance(root: Path = ROOT) -> dict[str, Any]:
    """Return what computes here: `commit`, `dirty`, `diff`, `lock`, `packages`, `python`, `platform`, `cpu`, `cores`.

    And when it was asked: `time`, in UTC to the second.

    Outside a git checkout `commit` is the one that `git archive` wrote down or None, `dirty` False and `diff` empty;
    `lock` is the sha256 of requirements.lock or None, `diff_digest` that of the diff or None. A diff beyond 1 MB is
    cut, and says so in its last line.
    """
    # A commit counts only when `root` is the top of its checkout.
    below, _, head = _git(root, "rev-parse", "--show-prefix", "HEAD").partition("\n")
    commit = "" if below else head.strip()
    diff = _diff(root) if commit else ""
    lock = root / "requirements.lock"
    return {
        "time": dt.datetime.now(dt.UTC).isoformat(timespec="seconds"),
        "commit": commit or _archived(root),
        "dirty": bool(diff),
        "diff": diff,
        "diff_digest": hashlib.sha256(diff.encode()).hexdigest() if diff else None,
        "lock": hashlib.sha256(lock.read_bytes()).hexdigest() if lock.is_file() else None,
        "packages": packages(),
        "python": platform.python_version(),
        "platform": f"{platform.system()} {platform.release()} {platform.machine()}",
        "cpu": cpu_lines("model name")[0],
        "cores": cores(),
    }


def cores() -> int:
    """Return how many cores this process may use: a batch system often gives fewer than the machine has."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def packages() -> dict[str, str]:
    """Return the version of every installed distribution by name; of several, that which Python imports."""
    versions: dict[str, str] = {}
    for dist in importlib.metadata.distributions():  # in the order of the search path
        if dist.name:
            versions.setdefault(dist.name.lower().replace("_", "-"), dist.version)
    return dict(sorted(versions.items()))


def cpu_lines(field: str) -> list[str]:
    """Return the values of a field of /proc/cpuinfo; where it has none, what Python knows of the processor."""
    with contextlib.suppress(OSError):
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="ignore").splitlines()
        values = [line.partition(":")[2].strip() for line in lines if line.startswith(field)]
        return values or [platform.processor()]
    return [platform.processor()]


def _archived(root: Path) -> str | None:
    """Return the commit that `git archive` wrote into its copy of the code."""
    path = root / ".git_archival.txt"
    match = re.match("node: ([0-9a-f]{40})$", path.read_text(encoding="utf-8").strip()) if path.is_file() else None
    return match[1] if match else None


def _git(root: Path, *words: str, **environment: str) -> str:
    """Return git's answer, cut at DIFF_LIMIT bytes; empty where git or the repository is missing."""
    try:
        git = subprocess.run(
            ["git", "-C", str(root), *words],
            env={**os.environ, "GIT_OPTIONAL_LOCKS": "0", **environment},
            capture_output=True,
            check=True,
            timeout=30,
        )
    except (OSError, subprocess.SubprocessError):
        return ""
    text = git.stdout[:DIFF_LIMIT].decode("utf-8", errors="replace")
    return text if len(git.stdout) <= DIFF_LIMIT else f"{text}\n[cut: {len(git.stdout)} bytes in all]\n"


def _diff(root: Path) -> str:
    """Return the working tree against HEAD, new source files included, without touching the index."""
    index = root / _git(root, "rev-parse", "--git-path", "index").strip()
    with tempfile.TemporaryDirectory() as folder:
        draft = Path(folder) / "index"
        if index.is_file():
            shutil.copyfile(index, draft)
        new = [name for name in NEW_FILES if (root / name).is_dir()]
        if new:
            _git(root, "add", "--intent-to-add", "--", *new, GIT_INDEX_FILE=str(draft))
        return _git(root, "diff", "--no-color", "--no-ext-diff", "HEAD", "--", ".", GIT_INDEX_FILE=str(draft))
