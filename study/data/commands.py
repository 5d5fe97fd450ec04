"""What the commands of `python -m study.data` do."""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

from study.config.settings import StudySettings
from study.config.workspace import Workspace
from study.console.display import Display
from study.data.card import source_drives, write_card
from study.data.frames import open_frames
from study.data.in_use import shared_use
from study.data.prepare import data_flow, drives_flow, drives_folder
from study.data.preview import write_preview
from study.engine.flows import run_flow
from study.engine.local import local_engine
from study.errors import EXIT_BAD_INPUT, BadInputError
from study.intake.imported import open_import
from study.intake.importing import check_drives, describe, import_drives
from study.stages import Flow, data_cost, recording_cost


def record(settings: StudySettings, workers: int, workspace: Workspace) -> int:
    """Record the drives that are missing, and print their folder. Returns exit code 0."""
    flow = drives_flow(settings, workspace.data)
    paths = _run(flow, "drives", recording_cost(settings).seconds, workers, workspace)
    print(paths[0].parent)
    return 0


def build(show: str, settings: StudySettings, workers: int, workspace: Workspace, source: Path | None) -> int:
    """Make the frame store, print its folder, and make its card or preview if asked. Returns exit code 0."""
    imported = open_import(source) if source else None
    seconds = data_cost(settings, recorded=imported is None).seconds
    folder: Path = _run(data_flow(settings, workspace.data, imported), "data", seconds, workers, workspace)
    print(folder)
    if show == "build":
        return 0
    store = open_frames(folder)
    drives = source_drives(store, drives_folder(settings, workspace.data, imported))
    files = write_card(store, drives, folder) if show == "card" else write_preview(store, drives, folder)
    if show == "card":
        print(files[1].read_text(encoding="utf-8"))
    print(*files, sep="\n")
    return 0


def import_folder(folder: Path, out: Path | None, workspace: Workspace, drop_bad: bool = False) -> int:  # noqa: FBT001, FBT002
    """Import the Episodes in a folder, and print what became of them. Returns exit code 0."""
    out = out or workspace.data / "imported" / folder.resolve().name
    imported = import_drives(folder, out, drop_bad, tell=lambda text: print(text, file=sys.stderr))
    print(describe(imported))
    print(imported.folder)
    return 0


def check_folder(folder: Path) -> int:
    """Print all that is wrong with the Episodes in a folder. Returns exit code 0 where an import would take them."""
    errors = warnings = 0
    for finding in check_drives(folder):
        print(f"warning: {finding}" if finding.warning else str(finding))
        warnings += finding.warning
        errors += not finding.warning
    print(f"{errors} findings, {warnings} warnings")
    return EXIT_BAD_INPUT if errors else 0


def convert(name: str, sources: Sequence[Path], out: Path, cut: float, **options: Any) -> int:
    """Write drives with the converter of this name, and print them and their folder. Returns exit code 0."""
    for option, value in {"cut": cut, **options}.items():
        if isinstance(value, float) and not math.isfinite(value):
            raise BadInputError(f"--{option.replace('_', '-')}: {value} is not a number of seconds")
    converter = import_module(f"study.convert.{name}")
    print(*converter.convert(sources, out, cut, **options), out, f"next: python -m study.data import {out}", sep="\n")
    return 0


def _run(flow: Flow[Any], title: str, seconds: float, workers: int, workspace: Workspace) -> Any:
    with shared_use(workspace.data), Display(title, {}, {}, seconds) as display:
        if workers == 1:
            return run_flow(flow, progress=display.data)
        with local_engine(workers, workspace.tmp) as engine:
            return run_flow(flow, engine, display.data)
