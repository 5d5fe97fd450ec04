"""Import the Episodes below a folder: check them, adapt them, and write them as a folder that a sweep can use."""

from __future__ import annotations

import dataclasses
import json
import os
from collections.abc import Callable, Iterator
from dataclasses import asdict
from pathlib import Path

from study.atomic import atomic_folder
from study.episode.files import write_episode
from study.episode.findings import Finding, Findings
from study.episode.recording import Recording
from study.errors import BadInputError
from study.intake.adapt import Adapted, adapt
from study.intake.examine import examine
from study.intake.imported import SCHEMA_VERSION, Drive, Imported

ADVICE = "; --check lists all findings without importing, --drop-bad leaves out what is bad"


def check_drives(source: Path) -> Iterator[Finding]:
    """Yield all that is wrong with the Episodes below `source`, errors and warnings, and write nothing.

    Raises BadInputError when there are none, and for paths that lead out of `source`.
    """
    for _, _, findings in _examine_all(source):
        yield from findings.errors
        yield from findings.warnings


def import_drives(
    source: Path,
    out: Path,
    drop_bad: bool = False,
    tell: Callable[[str], None] = lambda _: None,  # noqa: FBT001, FBT002
) -> Imported:
    """Read all Episodes below `source`, adapt them, and write them as `out`: all of them, or nothing.

    With `drop_bad`, what is bad is left out; `tell` hears how much, and of warnings. A long recording of many agents
    becomes several drives, which stay in one set. An earlier import in `out` is replaced. The same Episodes give the
    same bytes.
    Raises BadInputError for anything that is no Episode, naming file, row and field, for paths that lead out of
    `source`, and when `out` holds something else.
    """
    if out.exists() and not (out / "import.json").is_file() and any(out.iterdir()):
        raise BadInputError(f"{out} holds something that is no import; name another folder with --out")
    if out.resolve().is_relative_to(source.resolve()):
        raise BadInputError(f"--out {out} lies within {source}; it would be imported the next time")
    try:
        with atomic_folder(out) as draft:
            drives = _import_all(source, draft, drop_bad, tell)
            content = {"schema_version": SCHEMA_VERSION, "drives": [asdict(drive) for drive in drives]}
            (draft / "import.json").write_text(json.dumps(content, indent=1, allow_nan=False))
    except OSError as error:
        raise BadInputError(f"cannot write {out}: {error.strerror}; name another folder with --out") from error
    return Imported(out, tuple(drives))


def _import_all(source: Path, draft: Path, drop_bad: bool, tell: Callable[[str], None]) -> list[Drive]:  # noqa: FBT001
    drives: list[Drive] = []
    warnings: dict[str, list[Finding]] = {}
    for name, recording, findings in _examine_all(source):
        if not drop_bad:
            findings.refuse(ADVICE)
        for finding in findings.warnings:
            warnings.setdefault(str(finding).removeprefix(str(findings.folder)), []).append(finding)
        if findings.errors:
            tell(_left_out(findings, recording))
        if recording:
            drives.extend(_import_recording(name, recording, findings, draft))
    for alike in warnings.values():
        tell(f"warning: {alike[0]}" + (f" [{len(alike)} drives]" if len(alike) > 1 else ""))
    if not drives:
        raise BadInputError(f"{source}: nothing is left of its Episodes; --check lists what is wrong with them")
    return drives


def _examine_all(source: Path) -> Iterator[tuple[str, Recording | None, Findings]]:
    """Yield the name of each Episode, what is right in it, if anything, and what is wrong with it."""
    folders = dict(_find_episodes(source))
    if not folders:
        raise BadInputError(f"{source} holds no Episode: a folder with an episode.json (see docs/extend/data.md)")
    seen: dict[str, Path] = {}
    for name, folder in folders.items():
        findings = Findings(folder)
        recording = examine(folder, findings)
        if recording:
            states = recording.digests["states.parquet"]
            if states in seen:
                findings.add("states.parquet", f" is that of {seen[states]}: the same drive twice; take one away")
                recording = None
            else:
                seen[states] = folder
        yield name, recording, findings


def _left_out(findings: Findings, recording: Recording | None) -> str:
    """Return how much of an Episode is left out, and why first."""
    faults = f"{len(findings.errors)} finding{'s' if len(findings.errors) > 1 else ''}, first: {findings.errors[0]}"
    if recording is None:
        return f"left out {findings.folder}, all of it ({faults})"
    rows = findings.rows + len(recording.rows["step"])
    values = f" and {findings.values:,} values in others" if findings.values else ""
    return (
        f"left out of {findings.folder}: {findings.rows:,} of {rows:,} rows ({findings.rows / max(rows, 1):.1%})"
        f"{values} ({faults})"
    )


def _import_recording(name: str, recording: Recording, findings: Findings, draft: Path) -> Iterator[Drive]:
    """Write a recording as one drive, or as several parts of it, and yield them."""
    if findings.errors:
        lost = {"rows": findings.rows, "values": findings.values, "findings": len(findings.errors)}
        recording = dataclasses.replace(recording, source=recording.source | {"left_out": lost})
    origin = _origin(name, recording)
    for number, part in enumerate(recording.parts()):
        whole = part is recording
        adapted = adapt(part.episode(), str(findings.folder))
        if not whole and not adapted.egos:
            continue
        yield _write_drive(name if whole else f"{name}-part-{number:03d}", origin, adapted, draft)


def _origin(name: str, recording: Recording) -> str:
    """Return the name of the recording that a drive was cut from, by its writer's word; else the drive's own."""
    cut_from = recording.source.get("recording")
    if isinstance(cut_from, str) and name.endswith(recording.id):
        return name.removesuffix(recording.id) + cut_from
    return name


def _write_drive(name: str, recording: str, adapted: Adapted, draft: Path) -> Drive:
    if (draft / name).exists():
        raise BadInputError(f"two drives would be imported as '{name}': rename one")
    episode = adapted.episode
    digest = write_episode(episode, draft / name)
    agents = int(episode.present.any(axis=0).sum())
    seconds = episode.steps / episode.rate_hz
    return Drive(name, digest, agents, adapted.egos, seconds, adapted.derived, adapted.skipped, recording)


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
