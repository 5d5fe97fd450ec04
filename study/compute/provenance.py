"""Provenance of a result: commit with the uncommitted diff, lock file, package versions, machine.

No user, host or folder names: results are passed on.
"""

from __future__ import annotations

import contextlib
import datetime as dt
import functools
import hashlib
import importlib.metadata
import os
import platform
import re
import shutil
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from study.atomic import scratch_folder

ROOT = Path(__file__).resolve().parents[2]
DIFF_LIMIT = 1_000_000  # bytes
REFUSALS = {  # words of git's -> what they mean
    "not a git repository": "the code is no git checkout",
    "dubious ownership": "git refuses a checkout of another user; allow it: git config --global --add safe.directory "
    "FOLDER",
}
NEW_FILES = ("study", "sweeps", "tests", "benchmarks")  # elsewhere a new file may be a secret or a data set


class _UnknownError(Exception):
    """Git does not tell what computes here; the text is the reason."""


def warn_of_unknown_origin(origin: Mapping[str, Any]) -> None:
    """Say on stderr when the results will not be able to say which code has made them; `origin`: of `provenance`."""
    if origin["unknown"]:
        what = "whether the code was changed" if origin["commit"] else "the commit"
        print(f"warning: {what} is unknown, and results will say so: {origin['unknown']}", file=sys.stderr)


def provenance(root: Path = ROOT) -> dict[str, Any]:
    """Return what computes here: `commit`, `dirty`, `diff`, `lock`, `packages`, `python`, `platform`, `cpu`, `cores`.

    And when it was asked: `time`, in UTC to the second.

    What git cannot tell is None, and `unknown` says why: `commit` (unless `git archive` wrote it down) and `dirty`;
    `lock` is the sha256 of requirements.lock or None, `diff_digest` that of the diff or None. A diff beyond 1 MB is
    cut, and says so in its last line.
    """
    commit, dirty, diff, unknown = _archived(root), None, "", None
    try:
        below, _, head = _git(root, "rev-parse", "--show-prefix", "HEAD").partition("\n")
        if below:  # a commit counts only when `root` is the top of its checkout
            raise _UnknownError("the code lies inside a checkout that is not its own")  # noqa: TRY301 - one way out
        commit = head.strip()
        diff = _diff(root)
        dirty = bool(diff)
    except _UnknownError as error:
        unknown = str(error)
    lock = root / "requirements.lock"
    return {
        "time": dt.datetime.now(dt.UTC).isoformat(timespec="seconds"),
        "commit": commit,
        "dirty": dirty,
        "unknown": unknown,
        "diff": diff,
        "diff_digest": hashlib.sha256(diff.encode()).hexdigest() if diff else None,
        "lock": hashlib.sha256(lock.read_bytes()).hexdigest() if lock.is_file() else None,
        "packages": dict(packages(tuple(sys.path))),
        "python": platform.python_version(),
        "platform": f"{platform.system()} {platform.release()} {platform.machine()}",
        "cpu": cpu_lines("model name")[0],
        "cores": cores(),
    }


def cores() -> int:
    """Return how many cores this process may use: a batch system often gives fewer than the machine has."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@functools.cache  # every stage of a cell asks
def packages(path: tuple[str, ...]) -> dict[str, str]:
    """Return the version of every distribution on a search path by name; of several, that which Python imports."""
    versions: dict[str, str] = {}
    for dist in importlib.metadata.distributions(path=list(path)):  # in the order of the search path
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
    """Return git's answer, cut at DIFF_LIMIT bytes. Raises _UnknownError with the reason when it gives none."""
    try:
        git = subprocess.run(
            ["git", "-C", str(root), *words],
            env={**os.environ, "GIT_OPTIONAL_LOCKS": "0", "LC_ALL": "C", **environment},
            capture_output=True,
            check=True,
            timeout=30,
        )
    except FileNotFoundError:
        raise _UnknownError("git is not installed") from None
    except subprocess.CalledProcessError as error:
        raise _UnknownError(_reason(error.stderr.decode("utf-8", errors="replace"))) from None
    except (OSError, subprocess.SubprocessError) as error:
        raise _UnknownError(f"git gave no answer ({type(error).__name__})") from None
    text = git.stdout[:DIFF_LIMIT].decode("utf-8", errors="replace")
    return text if len(git.stdout) <= DIFF_LIMIT else f"{text}\n[cut: {len(git.stdout)} bytes in all]\n"


def _reason(words: str) -> str:
    """Return why git has refused, without the names of folders: results are passed on."""
    for part, reason in REFUSALS.items():
        if part in words:
            return reason
    line = (words.strip().splitlines() or ["no reason"])[0]
    return f"git refused: {re.sub(r'/[^ ]*', '...', line)[:200]}"


def _diff(root: Path) -> str:
    """Return the working tree against HEAD, new source files included, without touching the index."""
    index = root / _git(root, "rev-parse", "--git-path", "index").strip()
    with scratch_folder() as folder:
        draft = Path(folder) / "index"
        if index.is_file():
            shutil.copyfile(index, draft)
        new = [name for name in NEW_FILES if (root / name).is_dir()]
        if new:
            with contextlib.suppress(_UnknownError):  # a folder that the checkout ignores
                _git(root, "add", "--intent-to-add", "--", *new, GIT_INDEX_FILE=str(draft))
        return _git(root, "diff", "--no-color", "--no-ext-diff", "HEAD", "--", ".", GIT_INDEX_FILE=str(draft))
