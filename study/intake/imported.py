"""Imported drives: Episodes of any writer, checked, adapted and kept together as a folder that a sweep can use.

The folder holds one adapted Episode for each that was found (see `study.intake.importing`), and

`import.json`   schema_version 1; drives: [{"name", "digest", "agents", "egos", "seconds", "derived", "skipped",
                "recording"}]
"""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from study.config.keys import content_key
from study.config.settings import FramesSettings
from study.episode.head import episode_digest, read_json
from study.errors import BadInputError
from study.randomness import rng

SCHEMA_VERSION = 1


@dataclass(frozen=True)
class Drive:
    """One imported drive; `derived` and `skipped` count moments of its egos, by command (see `study.intake.adapt`).

    `recording`: name of what it was cut from, its own name where that was not cut.
    """

    name: str
    digest: str
    agents: int
    egos: int
    seconds: float
    derived: int
    skipped: int
    recording: str


def take_groups(sizes: Sequence[int], order: Sequence[int], wanted: int, least: int) -> list[int]:
    """Return the first groups in this order that hold about `wanted` items; `least` groups at least, here and left."""
    taken = [sum(sizes[group] for group in order[:count]) for count in range(len(order) + 1)]
    count = min(range(least, len(order) - least + 1), key=lambda count: abs(taken[count] - wanted))
    return list(order[:count])


@dataclass(frozen=True)
class Imported:
    """An imported folder."""

    folder: Path
    drives: tuple[Drive, ...]

    @property
    def key(self) -> str:
        """Return the key that stands for these drives in the keys of all that is made from them."""
        drives = sorted((drive.name, drive.digest) for drive in self.drives)
        cut = sorted(self.recordings.items())  # decides which drives go together, hence who tests whom
        return content_key("imported", [*drives, cut] if cut else drives, (), SCHEMA_VERSION)

    @property
    def recordings(self) -> dict[str, str]:
        """Return drive -> recording of those that were cut from one. Parts of a recording stay in one set."""
        return {drive.name: drive.recording for drive in self.drives if drive.recording != drive.name}

    @property
    def writers(self) -> list[str]:
        """Return the writers of the drives, by their own names."""
        heads = (read_json(self.folder / drive.name / "episode.json") for drive in self.drives)
        return sorted({str(head["source"].get("writer", "unknown")) for head in heads})

    def check(self) -> None:
        """Raise BadInputError when a drive is not the one that was imported."""
        for drive in self.drives:
            if episode_digest(self.folder / drive.name) != drive.digest:
                raise BadInputError(f"{self.folder / drive.name} is not what was imported: import again")

    def assign(self, frames: FramesSettings) -> tuple[list[Path], list[Path]]:
        """Return random drives for the encoder set and the others for the policy set, in proportion to their frames.

        Parts of one recording stay together. Raises BadInputError when there are fewer than four recordings: each set
        needs one to train and one to test.
        """
        groups: dict[str, list[Path]] = {}
        for drive in self.drives:
            groups.setdefault(drive.recording, []).append(self.folder / drive.name)
        if len(groups) < 4:
            cut = " (parts of one stay together, since they share vehicles and place)" if self.recordings else ""
            raise BadInputError(
                f"{self.folder} has {len(groups)} recordings{cut} and a sweep needs 4 or more: two for encoders and "
                "two for policies, each one to train and one to test; import more, or cut long drives into several"
            )
        order = rng(frames.seed, "imported drives").permutation(len(groups)).tolist()
        wanted = round(len(self.drives) * frames.encoder / (frames.encoder + frames.policy))
        names = list(groups)
        taken = take_groups([len(group) for group in groups.values()], order, wanted, 2)
        encoder = sorted(path for number in taken for path in groups[names[number]])
        return encoder, sorted(path for number in set(order) - set(taken) for path in groups[names[number]])


def open_import(folder: Path) -> Imported:
    """Return what an import has written to this folder. Raises BadInputError for any other folder."""
    path = folder / "import.json"
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        if content["schema_version"] != SCHEMA_VERSION:
            raise BadInputError(
                f"{path}: schema_version is {content['schema_version']!r}; this program reads {SCHEMA_VERSION}"
            )
        return Imported(folder, tuple(_drive(drive, path) for drive in content["drives"]))
    except OSError as error:
        raise BadInputError(
            f"cannot read {path}: {error.strerror}; make it with 'python -m study.data import DIR --out {folder}'"
        ) from error
    except (ValueError, KeyError, TypeError) as error:
        raise BadInputError(f"{path} lists no imported drives ({error!r}): import again") from error


def _drive(entry: dict[str, Any], path: Path) -> Drive:
    if "recording" not in entry and re.search(r"-part-\d{3}$", entry["name"]):
        raise BadInputError(f"{path} does not say which drives are parts of one recording: import again")
    return Drive(**{"recording": entry["name"]} | entry)
