"""How far a sweep is, asked from any terminal while it runs: what is finished, what runs where, what is left.

MLflow is asked, not Optuna: a cell's attempts say who runs them and have signs of life.

python -m study.sweep status heads
"""

from __future__ import annotations

import dataclasses
import json
import math
import platform
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from study.console.display import show_table
from study.errors import masked
from study.planning.plan import Plan, look_up
from study.stages import CELL_STAGES, RESULT_S, STAGES, duration_text, share_done

if TYPE_CHECKING:
    from study.tracking.reader import Attempt


State = Literal["finished", "running", "silent", "waiting", "failed"]
STATES: dict[State, str] = {  # with its style on a terminal
    "finished": "green",
    "running": "bold",
    "silent": "yellow",
    "waiting": "dim",
    "failed": "red",
}
Attempts = Mapping[str, Sequence["Attempt"]]
AGAIN = 12.0  # [s] between two looks at a machine that seems silent: more than two signs of life take
SILENT = 120.0  # [s] without a sign of life: several times what loading torch or a commit takes on a busy machine


@dataclass(frozen=True)
class CellStatus:
    """Where a cell stands. Times in s: `since` 1970, `took` by the finished attempt, `quiet` without a sign of life.

    `silent`: it says RUNNING and nothing has been heard for two minutes; a sweep must take it up again. `share`: of the
    cell's work that is done.
    """

    key: str
    label: str
    state: State
    attempt: int = 0
    host: str = ""
    process: str = ""
    device: str = ""
    since: float | None = None
    quiet: float = 0.0
    stage: str = ""
    epoch: int = 0
    epochs: int = 0
    share: float = 0.0
    took: float | None = None
    reason: str = ""


def cell_statuses(plan: Plan, attempts: Attempts, now: float) -> list[CellStatus]:
    """Return where each cell of a plan stands at a time [s since 1970]."""
    return [_cell_status(plan, key, attempts.get(key, ()), now) for key in plan.cells]


def _cell_status(plan: Plan, key: str, attempts: Sequence[Attempt], now: float) -> CellStatus:
    status = CellStatus(key, plan.cells[key].label, "waiting", len(attempts))
    done = next((attempt for attempt in attempts if attempt.status == "FINISHED"), None)
    if done is not None:
        return dataclasses.replace(status, state="finished", share=1.0, took=done.metrics.get("seconds/cell"))
    if not attempts:
        return status
    last = attempts[-1]
    if last.status == "FAILED":
        return dataclasses.replace(status, state="failed", reason=_first(last.tags.get("reason", "unknown")))
    if last.status != "RUNNING":
        return status
    tags = last.tags
    heard = float(tags.get("alive", last.started)) / 1000
    quiet = abs(now - heard)  # a sign from the future tells no more than an old one
    state: State = "silent" if quiet > SILENT else "running"
    stage, _, steps = tags.get("progress", "").partition(" ")
    part, total = (int(number) for number in steps.split("/")) if steps else (0, 1)
    epochs = {"encoder": plan.settings.encoder.epochs, "policy": plan.settings.policy.epochs}.get(stage, 0)
    return dataclasses.replace(
        status,
        state=state,
        host=tags.get("host", ""),
        process=tags.get("process", ""),
        device=tags.get("device", ""),
        since=last.started / 1000,
        quiet=quiet,
        stage=stage,
        epoch=math.ceil(part * epochs / total),
        epochs=epochs,
        share=share_done(CELL_STAGES, plan.works[key], STAGES[stage], part / total) if stage in STAGES else 0.0,
    )


def heard_again(before: Attempts, after: Attempts, now: float) -> Attempts:
    """Return later attempts; one that has given a sign of life since the earlier look has given it now.

    The clock of its machine may differ from this one's by minutes.
    """
    signs = {attempt.run_id: attempt.tags.get("alive") for each in before.values() for attempt in each}

    def corrected(attempt: Attempt) -> Attempt:
        sign = attempt.tags.get("alive")
        if sign == signs.get(attempt.run_id, sign):
            return attempt
        return dataclasses.replace(attempt, tags={**attempt.tags, "alive": str(round(now * 1000))})

    return {key: [corrected(attempt) for attempt in each] for key, each in after.items()}


def _first(reason: str) -> str:
    """Return the line of a reason that says most: of a traceback the last."""
    lines = reason.strip().splitlines() or ["unknown"]
    return lines[-1] if lines[0].startswith("Traceback") else lines[0]


def seconds_left(plan: Plan, cells: Sequence[CellStatus], now: float, *, frames_ready: bool) -> float:
    """Estimate the time that is left [s]: expected costs, times what the cells so far have shown them to be wrong by.

    Failed cells are not counted, since nobody takes them up by themselves.
    """
    costs = {key: cost.seconds for key, cost in plan.costs.items()}
    expected = measured = left = 0.0
    for cell in cells:
        if cell.took is not None:
            expected, measured = expected + costs[cell.key], measured + cell.took
        if cell.state == "running" and cell.since is not None and cell.share > 0:
            begun = RESULT_S + (costs[cell.key] - RESULT_S) * cell.share
            expected, measured = expected + begun, measured + max(0.0, now - cell.since)
        if cell.state not in ("finished", "failed"):
            left += costs[cell.key] * (1 - (cell.share if cell.state == "running" else 0.0))
    at_a_time = max(1, sum(cell.state == "running" for cell in cells))
    data = plan.data_cost.seconds if left and not frames_ready else 0.0
    return data + left / at_a_time * (measured / expected if expected else 1.0)


def show_status(plan: Plan, tracking: str, *, as_json: bool) -> int:
    """Print where the cells of a plan stand, and return exit code 0."""
    reader = look_up(tracking)
    now = time.time()
    attempts: Attempts = reader.attempts(plan.cells) if reader else {}
    cells = cell_statuses(plan, attempts, now)
    if reader and any(cell.state == "silent" and cell.host != platform.node() for cell in cells):
        time.sleep(AGAIN)
        now = time.time()
        attempts = heard_again(attempts, reader.attempts(plan.cells), now)
        cells = cell_statuses(plan, attempts, now)
    driven = reader.driven(plan.settings, plan.drivers) if reader else {}
    left = seconds_left(plan, cells, now, frames_ready=plan.frames_ready)
    if as_json:
        facts = {
            "sweep": plan.grid.name,
            "profile": plan.profile,
            "tracking": masked(tracking),
            "cells": [dataclasses.asdict(cell) for cell in cells],
            "driven": sorted(driven),
            "seconds_left": round(left, 1),
        }
        print(json.dumps(facts))
    else:
        _show(plan, cells, left, now, len(driven))
    return 0


def _show(plan: Plan, cells: Sequence[CellStatus], left: float, now: float, driven: int) -> None:
    counts = Counter(cell.state for cell in cells)
    parts = [f"{counts[state]} {state}" for state in STATES if state != "finished" and counts[state]]
    parts = [f"{plan.grid.name} ({plan.profile}): {counts['finished']} of {len(cells)} cells finished", *parts]
    if driven < len(plan.drivers):
        parts.append(f"{driven} of {len(plan.drivers)} have driven")
    if left:
        parts.append(f"about {duration_text(left)} left")
    print(", ".join(parts))
    if not plan.frames_ready and counts["finished"] < len(cells):
        print("frames are not made yet")
    show_table([_row(cell, now) for cell in cells], [STATES[cell.state] for cell in cells])


def _row(cell: CellStatus, now: float) -> tuple[str, str, str, str, str]:
    """Return label, state, how far, since when, where."""
    how, since, where = "", "", ""
    if cell.state == "finished" and cell.took is not None:
        how = f"in {duration_text(cell.took)}"
    elif cell.state == "failed":
        how = cell.reason
    elif cell.since is not None:
        how = STAGES[cell.stage].activity if cell.stage in STAGES else "starting"
        how += f", epoch {cell.epoch} of {cell.epochs}" if cell.epochs else ""
        if cell.state != "running":
            how += f"; no sign of life for {duration_text(cell.quiet)}"
        since = (
            f"since {time.strftime('%H:%M', time.localtime(cell.since))} ({duration_text(max(0.0, now - cell.since))})"
        )
        where = f"{cell.host}, process {cell.process}" if cell.host else ""
        where += f", {cell.device}" if cell.device else ""
    elif cell.attempt:
        how = f"{cell.reason or 'stopped'}; tried {cell.attempt} time{'s' if cell.attempt > 1 else ''}"
    return cell.label, cell.state, how, since, where
