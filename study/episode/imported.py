"""Imported drives: Episodes of any writer, checked, adapted and kept together as a folder that a sweep can use.

The folder holds one adapted Episode for each that was found (see `study.episode.importing`), and

`import.json`   schema_version 1; drives: [{"name", "digest", "agents", "egos", "seconds", "derived", "skipped"}]
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

from study.config.keys import content_key
from study.config.settings import FramesSettings
from study.episode.head import episode_digest, read_json
from study.errors import BadInputError
from study.randomness import rng

SCHEMA_VERSION = 1


@dataclass(frozen=True)
class Drive:
    """One imported drive; `derived` and `skipped` count moments of its egos, by command (see `study.episode.adapt`)."""

    name: str
    digest: str
    agents: int
    egos: int
    seconds: float
    derived: int
    skipped: int


@dataclass(frozen=True)
class Imported:
    """An imported folder."""

    folder: Path
    drives: tuple[Drive, ...]

    @property
    def key(self) -> str:
        """Return the key that stands for these drives in the keys of all that is made from them."""
        return content_key("imported", sorted((drive.name, drive.digest) for drive in self.drives), (), SCHEMA_VERSION)

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

        Raises BadInputError when there are fewer than four: each set needs one to train and one to test.
        """
        count = len(self.drives)
        if count < 4:
            raise BadInputError(
                f"{self.folder} has {count} drives and a sweep needs 4 or more: two for encoders and two for "
                "policies, each one to train and one to test; import more, or cut long drives into several Episodes"
            )
        order = rng(frames.seed, "imported drives").permutation(count).tolist()
        split = min(max(round(count * frames.encoder / (frames.encoder + frames.policy)), 2), count - 2)
        paths = [self.folder / self.drives[place].name for place in order]
        return sorted(paths[:split]), sorted(paths[split:])


def open_import(folder: Path) -> Imported:
    """Return what an import has written to this folder. Raises BadInputError for any other folder."""
    path = folder / "import.json"
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        if content["schema_version"] != SCHEMA_VERSION:
            raise BadInputError(
                f"{path}: schema_version is {content['schema_version']!r}; this program reads {SCHEMA_VERSION}"
            )
        return Imported(folder, tuple(Drive(**drive) for drive in content["drives"]))
    except OSError as error:
        raise BadInputError(
            f"cannot read {path}: {error.strerror}; make it with 'python -m study.data import DIR --out {folder}'"
        ) from error
    except (ValueError, KeyError, TypeError) as error:
        raise BadInputError(f"{path} lists no imported drives ({error!r}): import again") from error
