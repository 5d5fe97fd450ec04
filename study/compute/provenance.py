"""Where a number comes from: commit with the uncommitted diff, lock file, package versions, machine.

No user, host or folder names: results are passed on.
"""

from __future__ import annotations

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
    """What made a result: `commit`, `dirty`, `diff`, `lock`, `packages`, `python`, `platform`, `cpu`, `cores`.

    Outside a git checkout `commit` is what `git archive` wrote down or None, `dirty` False and `diff` empty; `lock` is
    the sha256 of requirements.lock or None, `diff_digest` that of the diff or None. A diff beyond 1 MB is cut, and says
    so in its last line.
    """
    head = _head(root)
    diff = _diff(root) if head else ""
    lock = root / "requirements.lock"
    return {
        "commit": head or _archived(root),
        "dirty": bool(diff),
        "diff": diff,
        "diff_digest": hashlib.sha256(diff.encode()).hexdigest() if diff else None,
        "lock": hashlib.sha256(lock.read_bytes()).hexdigest() if lock.is_file() else None,
        "packages": packages(),
        "python": platform.python_version(),
        "platform": f"{platform.system()} {platform.release()} {platform.machine()}",
        "cpu": _cpu(),
        "cores": cores(),
    }


def cores() -> int:
    """How many cores this process may use: a batch system or a container often gives fewer than the machine has."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def packages() -> dict[str, str]:
    """Name -> version of every installed distribution."""
    found = ((dist.name, dist.version) for dist in importlib.metadata.distributions())
    return dict(sorted((name.lower().replace("_", "-"), version) for name, version in found if name))


def _head(root: Path) -> str:
    """The commit of the checkout whose top is `root`; empty where there is none, or only one that lies around it."""
    below, _, commit = _git(root, "rev-parse", "--show-prefix", "HEAD").partition("\n")
    return "" if below else commit.strip()


def _archived(root: Path) -> str | None:
    """The commit that `git archive` wrote into its copy of the code."""
    path = root / ".git_archival.txt"
    found = re.match("node: ([0-9a-f]{40})$", path.read_text(encoding="utf-8").strip()) if path.is_file() else None
    return found[1] if found else None


def _git(root: Path, *words: str, index: Path | None = None) -> str:
    """Git's answer, cut at DIFF_LIMIT bytes; empty where git or the repository is missing."""
    environment = {**os.environ, "GIT_OPTIONAL_LOCKS": "0"}
    if index is not None:
        environment["GIT_INDEX_FILE"] = str(index)
    command = ["git", "-C", str(root), *words]
    with tempfile.TemporaryFile() as out:  # a file, not a pipe: the length is not known beforehand
        try:
            done = subprocess.run(
                command, env=environment, stdout=out, stderr=subprocess.DEVNULL, check=False, timeout=30
            )
        except (OSError, subprocess.TimeoutExpired):
            return ""
        size = out.tell()
        out.seek(0)
        text = out.read(DIFF_LIMIT).decode("utf-8", errors="replace")
    if done.returncode != 0:
        return ""
    return text if size <= DIFF_LIMIT else f"{text}\n[cut: {size} bytes in all]\n"


def _diff(root: Path) -> str:
    """The working tree against HEAD, new source files included; the index is left as it is."""
    index = root / _git(root, "rev-parse", "--git-path", "index").strip()
    with tempfile.TemporaryDirectory() as folder:
        draft = Path(folder) / "index"
        if index.is_file():
            shutil.copyfile(index, draft)
        new = [name for name in NEW_FILES if (root / name).is_dir()]
        if new:
            _git(root, "add", "--intent-to-add", "--", *new, index=draft)
        return _git(root, "diff", "--no-color", "--no-ext-diff", "HEAD", "--", ".", index=draft)


def _cpu() -> str:
    """The processor's model name."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor()
    names = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return next(names, platform.processor())
