"""Imported drives: Episodes of any writer, checked, adapted and kept together as a folder that a sweep can use.

The folder holds one adapted Episode for each found, and

`import.json`   schema_version 1; drives: [{"name", "digest", "agents", "egos", "seconds", "derived", "skipped"}]
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from study.atomic import atomic_folder
from study.config.keys import content_key
from study.config.settings import FramesSettings
from study.errors import BadInputError

SCHEMA_VERSION = 1
_ASSIGN = 4  # what a random generator is for; `selection` and `frames` have others


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
        """Stands for these drives in the keys of all that is made from them."""
        return content_key("imported", sorted((drive.name, drive.digest) for drive in self.drives), (), SCHEMA_VERSION)

    @property
    def writers(self) -> list[str]:
        """What wrote the drives, by their own word."""
        heads = (json.loads((self.folder / drive.name / "episode.json").read_text()) for drive in self.drives)
        return sorted({str(head["source"].get("writer", "unknown")) for head in heads})

    def check(self) -> None:
        """Raise BadInputError when a drive is not the one that was imported."""
        from study.episode.files import episode_digest  # noqa: PLC0415 - planning needs no arrays

        for drive in self.drives:
            if episode_digest(self.folder / drive.name) != drive.digest:
                raise BadInputError(f"{self.folder / drive.name} is not what was imported: import again")

    def assign(self, frames: FramesSettings) -> tuple[list[Path], list[Path]]:
        """Drives for the encoder set and others for the policy set, by chance, in proportion to the frames wanted.

        Raises BadInputError when there are fewer than four: each set needs one to train and one to test.
        """
        number = len(self.drives)
        if number < 4:
            raise BadInputError(
                f"{self.folder} has {number} drives and a sweep needs 4 or more: two for encoders and two for "
                "policies, each one to train and one to test; import more, or cut long drives into several Episodes"
            )
        order = np.random.default_rng([frames.seed, _ASSIGN]).permutation(number).tolist()
        split = min(max(round(number * frames.encoder / (frames.encoder + frames.policy)), 2), number - 2)
        paths = [self.folder / self.drives[place].name for place in order]
        return sorted(paths[:split]), sorted(paths[split:])


def open_import(folder: Path) -> Imported:
    """The folder that an import has written. Raises BadInputError for any other."""
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


# --- importing ------------------------------------------------------------------------------------------------------


def import_drives(source: Path, out: Path) -> Imported:
    """Read all Episodes below `source`, adapt them, and write them as `out`: all of them, or nothing.

    An earlier import in `out` is replaced. The same Episodes give the same bytes.
    Raises BadInputError for anything that is no Episode, naming file, row and field, for paths that lead out of
    `source`, and when `out` holds something else.
    """
    from study.episode.adapt import adapt  # noqa: PLC0415 - planning needs no arrays
    from study.episode.files import read_episode, write_episode  # noqa: PLC0415

    found = dict(_episodes(source))
    if not found:
        raise BadInputError(f"{source} holds no Episode: a folder with an episode.json (see README, 'Data')")
    if out.exists() and not (out / "import.json").is_file() and any(out.iterdir()):
        raise BadInputError(f"{out} holds something that is no import; name another folder with --out")
    if out.resolve().is_relative_to(source.resolve()):
        raise BadInputError(f"--out {out} lies within {source}; it would be imported the next time")
    try:
        with atomic_folder(out) as draft:
            drives = []
            for drive, folder in found.items():
                adapted = adapt(read_episode(folder), str(folder))
                digest = write_episode(adapted.episode, draft / drive)
                seconds = adapted.episode.steps / adapted.episode.rate_hz
                there = int(adapted.episode.present.any(axis=0).sum())
                drives.append(Drive(drive, digest, there, adapted.egos, seconds, adapted.derived, adapted.skipped))
            content = {"schema_version": SCHEMA_VERSION, "drives": [asdict(drive) for drive in drives]}
            (draft / "import.json").write_text(json.dumps(content, indent=1, allow_nan=False))
    except OSError as error:
        raise BadInputError(f"cannot write {out}: {error.strerror}; name another folder with --out") from error
    return Imported(out, tuple(drives))


def _episodes(source: Path) -> Iterator[tuple[str, Path]]:
    """Name and folder of each Episode below `source`, by name. Raises BadInputError for what leads out of it."""
    if not source.is_dir():
        raise BadInputError(f"{source} is no folder; give one with Episodes in it")
    root = source.resolve()
    names: dict[str, Path] = {}

    def refuse(error: OSError) -> None:
        raise BadInputError(f"cannot read {error.filename}: {error.strerror}") from error

    for at, folders, files in os.walk(source, onerror=refuse):
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        here = Path(at)
        for path in (here / name for name in sorted([*folders, *files])):
            if path.is_symlink() and not path.resolve().is_relative_to(root):
                raise BadInputError(f"{path} leads out of {source}, to {path.resolve()}: copy it there instead")
        if "episode.json" not in files:
            continue
        folders.clear()  # an Episode holds no others
        name = "-".join(here.relative_to(source).parts) or root.name
        if name in names:
            raise BadInputError(f"{names[name]} and {here} would both be imported as '{name}': rename one")
        names[name] = here
    yield from sorted(names.items())


def describe(imported: Imported) -> str:
    """What was imported, for people: a line for each drive and one for all."""
    lines = [f"{'drive':<28} {'seconds':>8} {'agents':>7} {'egos':>6} {'derived':>9} {'skipped':>9}"]
    for drive in imported.drives:
        numbers = f"{drive.seconds:8.1f} {drive.agents:7} {drive.egos:6} {drive.derived:9} {drive.skipped:9}"
        lines.append(f"{drive.name:<28} {numbers}")
    whole: dict[str, Any] = {
        name: sum(getattr(drive, name) for drive in imported.drives)
        for name in ("seconds", "agents", "egos", "derived", "skipped")
    }
    lines.append(
        f"{len(imported.drives)} drives, {whole['seconds']:.0f} s, {whole['agents']} agents, {whole['egos']} may be "
        f"ego; commands derived at {whole['derived']:,} of their moments, unknown and left out at {whole['skipped']:,}"
    )
    return "\n".join(lines)
