"""The cache in the data folder: which recordings, frames and products are there, and which sweeps use them."""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from study.config.keys import drive_key, frames_key, recording_key
from study.errors import BadInputError
from study.stages import DRIVE, ENCODER, Work
from study.tracking.cleaning import StoredSweep, disk_bytes
from study.tracking.experiment import TrackerLostError
from study.tracking.reader import Reader

FOLDERS = {"episodes": "recordings", "frames": "frame stores", "encoders": "encoder checkpoints", "products": ""}
PRODUCTS = {"encoder": "encoders", "baseline": "baselines", "policies": "policies", "drive": "drives of policies"}
KEY = re.compile(r"(?<![0-9a-f])[0-9a-f]{16}(?![0-9a-f])")
REMOVED = ".removed"  # what a deletion has begun with


@dataclass(frozen=True)
class Cached:
    """A folder or file of the cache, under the content key in its name; without a key it is left of a deletion."""

    kind: str
    path: Path
    key: str
    bytes: int


def cached_data(data: Path) -> list[Cached]:
    """Return what is in the cache; links and whatever has no key in its name are left out, and stay."""
    return [
        Cached(kind or PRODUCTS.get(path.name.lstrip(".").partition("-")[0], "products"), path, key, disk_bytes(path))
        for folder, kind in FOLDERS.items()
        for path, key in _keyed(data / folder)
    ]


def _keyed(folder: Path) -> Iterator[tuple[Path, str]]:
    if folder.is_symlink() or not folder.is_dir():
        return
    for path in sorted(folder.iterdir()):
        found = KEY.search(path.name)
        if found and not path.is_symlink() and path.suffix != ".lock":
            yield path, "" if path.suffix == REMOVED else found[0]


def used_keys(reader: Reader, sweep: StoredSweep) -> frozenset[str] | None:
    """Return the keys of all data that a sweep uses, or None when this program cannot tell."""
    try:
        grid, _, settings, planned = reader.read_plan(sweep.id)
        data = reader.experiment.read_json(sweep.id, "data.json")
    except TrackerLostError:
        raise
    except BadInputError:
        return None
    frames = str(data.get("key") or frames_key(settings))
    works = [Work(settings, cell, grid.policy_seeds, frames) for cell in planned.values()]
    of_cells = {stage.key(work) for work in works for stage in (ENCODER, DRIVE)}
    imported = "writers" in data
    return frozenset(
        {frames, *planned, *of_cells} | (set() if imported else {recording_key(settings), drive_key(settings)})
    )


def remove(cached: Sequence[Cached]) -> None:
    """Delete parts of the cache. Each is renamed first: a kill leaves nothing that could be taken for whole."""
    for each in cached:
        path = each.path
        if each.key:
            path = path.with_name(f".{path.name.lstrip('.')}{REMOVED}")
            _delete(path)
            each.path.rename(path)
        _delete(path)


def _delete(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
