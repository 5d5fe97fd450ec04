"""Import the Episodes below a folder: check them, adapt them, and write them as a folder that a sweep can use."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path

from study.atomic import atomic_folder
from study.episode.adapt import adapt
from study.episode.files import read_episode, write_episode
from study.episode.imported import SCHEMA_VERSION, Drive, Imported
from study.errors import BadInputError


def import_drives(source: Path, out: Path) -> Imported:
    """Read all Episodes below `source`, adapt them, and write them as `out`: all of them, or nothing.

    An earlier import in `out` is replaced. The same Episodes give the same bytes.
    Raises BadInputError for anything that is no Episode, naming file, row and field, for paths that lead out of
    `source`, and when `out` holds something else.
    """
    folders = dict(_find_episodes(source))
    if not folders:
        raise BadInputError(f"{source} holds no Episode: a folder with an episode.json (see docs/extend/data.md)")
    if out.exists() and not (out / "import.json").is_file() and any(out.iterdir()):
        raise BadInputError(f"{out} holds something that is no import; name another folder with --out")
    if out.resolve().is_relative_to(source.resolve()):
        raise BadInputError(f"--out {out} lies within {source}; it would be imported the next time")
    try:
        with atomic_folder(out) as draft:
            drives = tuple(_import_drive(name, folder, draft) for name, folder in folders.items())
            content = {"schema_version": SCHEMA_VERSION, "drives": [asdict(drive) for drive in drives]}
            (draft / "import.json").write_text(json.dumps(content, indent=1, allow_nan=False))
    except OSError as error:
        raise BadInputError(f"cannot write {out}: {error.strerror}; name another folder with --out") from error
    return Imported(out, drives)


def _import_drive(name: str, folder: Path, draft: Path) -> Drive:
    adapted = adapt(read_episode(folder), str(folder))
    episode = adapted.episode
    digest = write_episode(episode, draft / name)
    agents = int(episode.present.any(axis=0).sum())
    seconds = episode.steps / episode.rate_hz
    return Drive(name, digest, agents, adapted.egos, seconds, adapted.derived, adapted.skipped)


def _find_episodes(source: Path) -> Iterator[tuple[str, Path]]:
    """Yield name and folder of each Episode below `source`, by name. Raises BadInputError for paths that lead out."""
    if not source.is_dir():
        raise BadInputError(f"{source} is no folder; give one with Episodes in it")
    root = source.resolve()
    episodes: dict[str, Path] = {}

    def refuse(error: OSError) -> None:
        raise BadInputError(f"cannot read {error.filename}: {error.strerror}") from error

    for at, folders, files in os.walk(source, onerror=refuse):
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        folder = Path(at)
        for path in (folder / name for name in sorted([*folders, *files])):
            if path.is_symlink() and not path.resolve().is_relative_to(root):
                raise BadInputError(f"{path} leads out of {source}, to {path.resolve()}: copy it there instead")
        if "episode.json" not in files:
            continue
        folders.clear()  # an Episode holds no others
        name = "-".join(folder.relative_to(source).parts) or root.name
        if name in episodes:
            raise BadInputError(f"{episodes[name]} and {folder} would both be imported as '{name}': rename one")
        episodes[name] = folder
    yield from sorted(episodes.items())


def describe(imported: Imported) -> str:
    """Return what was imported, for people: a line for each drive and one for all."""
    lines = [f"{'drive':<28} {'seconds':>8} {'agents':>7} {'egos':>6} {'derived':>9} {'skipped':>9}"]
    for drive in imported.drives:
        numbers = f"{drive.seconds:8.1f} {drive.agents:7} {drive.egos:6} {drive.derived:9} {drive.skipped:9}"
        lines.append(f"{drive.name:<28} {numbers}")
    names = ("seconds", "agents", "egos", "derived", "skipped")
    seconds, agents, egos, derived, skipped = (sum(getattr(drive, name) for drive in imported.drives) for name in names)
    lines.append(
        f"{len(imported.drives)} drives, {seconds:.0f} s, {agents} agents, {egos} may be ego; commands derived at "
        f"{derived:,} of their moments, unknown and left out at {skipped:,}"
    )
    return "\n".join(lines)
