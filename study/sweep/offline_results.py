"""Results that were trained elsewhere (`study.sweep train`), committed to MLflow as if they had been trained here."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from study.compute.provenance import provenance
from study.driving.driver import export_driver
from study.errors import BadInputError
from study.planning.plan import Plan
from study.results.cell_result import CellResult, load_results
from study.sweep.locks import hold_store
from study.sweep.run import open_sweep, write_report
from study.tracking.tracker import Tracker


def import_folder(plan: Plan, folder: Path, tracking: str, *, wait: bool, report: bool) -> int:
    """Commit what was trained elsewhere, then write the report or name the missing cells; returns the exit code."""
    keys = planned_results(plan, folder)
    with hold_store(plan.workspace, tracking, f"sweep, {plan.grid.name}", wait=wait):
        tracker = Tracker(tracking)
        missing = take_in(plan, folder, keys, tracker)
        for key in missing:
            _say(f"missing: {plan.cells[key].label} ({key})")
        if missing:
            _say(f"Import them, too, or train them here: {plan.command}")
        elif report:
            return write_report(plan, tracker)
    return 0


def planned_results(plan: Plan, folder: Path) -> list[str]:
    """Return the keys of the results in `folder` that the plan has; name and leave out those of other plans.

    Raises BadInputError when one is not whole, or when none is of this plan.
    """
    cells = {result.key: result.cell for result in load_results(folder)}
    foreign = [f"{cell.label} ({key})" for key, cell in cells.items() if key not in plan.cells]
    if len(foreign) == len(cells):
        raise BadInputError(
            f"{folder} holds {', '.join(foreign)}, and none of them is planned in {plan.grid.name} ({plan.profile}); "
            "give the --profile and the settings that they were trained with"
        )
    if foreign:
        _say(f"left out, since this sweep does not plan them: {', '.join(foreign)}")
    return [key for key in plan.cells if key in cells]


def take_in(plan: Plan, folder: Path, keys: Sequence[str], tracker: Tracker) -> list[str]:
    """Commit the results of those keys, unless their cells are finished. Returns the keys that are still missing.

    Raises BadInputError when the frames' manifest beside the results is not theirs.
    """
    data = _manifest(plan, folder)
    done = tracker.reader.finished(list(plan.cells))
    sweep_run = open_sweep(plan, data, tracker, provenance())
    missing = list(plan.cells)
    try:
        for key in keys:
            if key in done:
                _say(f"{plan.cells[key].label} ({key}): finished before")
                continue
            run = tracker.start_cell(sweep_run, plan.cells[key], key, plan.settings, plan.grid.policy_seeds)
            try:
                result = CellResult.load(folder / key)
                network = export_driver(result) if result.encoder else b""  # made here: none comes from outside
                done[key] = tracker.commit(run, result, network)
            except BaseException:
                tracker.interrupt(run)
                raise
            _say(f"{plan.cells[key].label} ({key}): imported")
        missing = [key for key in plan.cells if key not in done]
    finally:
        tracker.close_sweep(sweep_run, "KILLED" if missing else "FINISHED")
    return missing


def _say(line: str) -> None:
    print(line, file=sys.stderr)


def _manifest(plan: Plan, folder: Path) -> dict[str, Any]:
    """Return the manifest of the plan's frames, from beside the results or from here; empty where there is neither."""
    key = plan.frames.name
    data: dict[str, Any] = {}
    for path in (folder / f"frames-{key}.json", plan.frames / "manifest.json"):
        if not path.is_file():
            continue
        try:
            data = json.loads(path.read_text(encoding="utf-8"))
            if data["key"] == key:
                break
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise BadInputError(f"{path} is no manifest of a frame store ({error!r}); copy it again") from error
        raise BadInputError(f"{path} is the manifest of other frames, {data['key']}; copy it again")
    return data
