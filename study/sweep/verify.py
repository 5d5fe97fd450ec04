"""Compute a finished cell again in a folder of its own, and compare it with what MLflow holds, byte for byte.

Nothing is written to MLflow.

python -m study.sweep verify heads
python -m study.sweep verify heads --cell 'rec+plan 100% e0'
"""

from __future__ import annotations

import hashlib
import math
import random
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from study.cell.flow import cell_flow
from study.cell.job import CellJob
from study.compute.device import APPLE
from study.compute.gpus import visible_gpus
from study.compute.provenance import cores
from study.config.grid import Cell
from study.config.keys import cell_key
from study.config.settings import StudySettings
from study.console.display import Display
from study.data.in_use import shared_use
from study.data.prepare import data_flow
from study.engine.flows import run_flow
from study.engine.local import local_engine
from study.errors import BadInputError, one_of
from study.planning.plan import Plan, look_up, plan_display
from study.results.cell_result import ARRAYS, CURVE_COLUMNS, CellResult
from study.tracking.metrics import final_scores

EXIT_DIFFERS = 1
COMPUTING = ("torch", "lightning", "numpy", "pandas")  # packages whose version can change a number
ACCURACY = "acceleration_accuracy"


@dataclass(frozen=True)
class Difference:
    """One array or column of curves that is not the same; `largest` absolute difference, NaN where shapes differ."""

    name: str
    values: int
    largest: float


def differences(recorded: CellResult, again: CellResult) -> list[Difference]:
    """Return what differs between two results, bit for bit: curves, weights, samples and predictions. Not the facts."""
    pairs = {f"curves: {name}": _columns(recorded, again, name) for name in CURVE_COLUMNS}
    for part in ARRAYS:
        mine, theirs = getattr(recorded, part), getattr(again, part)
        pairs |= {f"{part}: {name}": (mine.get(name), theirs.get(name)) for name in sorted(mine | theirs)}
    return [difference for name, (left, right) in pairs.items() if (difference := _difference(name, left, right))]


def _columns(recorded: CellResult, again: CellResult, name: str) -> tuple[NDArray[Any], NDArray[Any]]:
    left, right = (result.curves[name].to_numpy() for result in (recorded, again))
    return (left, right) if left.dtype.kind in "fiu" else (left.astype(str), right.astype(str))


def _difference(name: str, left: NDArray[Any] | None, right: NDArray[Any] | None) -> Difference | None:
    if left is None or right is None or left.shape != right.shape or left.dtype.kind != right.dtype.kind:
        return Difference(name, max(0 if array is None else array.size for array in (left, right)), math.nan)
    if left.dtype == right.dtype and left.tobytes() == right.tobytes():
        return None
    if left.dtype.kind == "U":
        other = left != right
        return Difference(name, int(other.sum()), math.nan) if other.any() else None
    gap = np.abs(left.astype(np.float64) - right.astype(np.float64))
    gap = gap[~(np.isnan(left.astype(np.float64)) & np.isnan(right.astype(np.float64)))]
    return Difference(name, int((gap > 0).sum()), float(gap.max(initial=0.0)))


def changes(recorded: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    """Return in words which recorded conditions that can change a bit are different now."""
    return [
        f"{name}: {before or 'none'} then, {here or 'none'} now"
        for name, before, here in _conditions(recorded, now)
        if before is not None and before != here
    ]


def _conditions(recorded: Mapping[str, Any], now: Mapping[str, Any]) -> Iterator[tuple[str, Any, Any]]:
    for name in ("device", "precision", "threads"):
        yield name, recorded.get(name), now.get(name)
    before, here = recorded.get("provenance", {}), now.get("provenance", {})
    for name in ("commit", "cpu", "python"):
        yield name, before.get(name), here.get(name)
    yield "uncommitted changes", _digest(before.get("diff")), _digest(here.get("diff"))
    for name in COMPUTING:
        yield name, before.get("packages", {}).get(name), here.get("packages", {}).get(name)
    for name, value in before.get("determinism", {}).items():
        yield name, value, here.get("determinism", {}).get(name)


def _digest(diff: str | None) -> str | None:
    return diff and hashlib.sha256(diff.encode()).hexdigest()[:12]


@dataclass(frozen=True)
class Agreement:
    """How far two results agree in the end: mean accuracy over policies of the last five epochs, and what may be."""

    recorded: float
    again: float
    allowed: float

    @property
    def close(self) -> bool:
        """Return whether they agree."""
        return abs(self.recorded - self.again) <= self.allowed


def judge(recorded: CellResult, again: CellResult, allowance: float) -> Agreement:
    """Compare final accuracies where equal bits are not to be expected.

    Allowed is what two encoders may differ by their seeds alone, and three standard errors of the difference.
    """
    scores = [final_scores(result)[ACCURACY].to_numpy(np.float64) for result in (recorded, again)]
    errors = [each.var(ddof=1) / len(each) if len(each) > 1 else 0.0 for each in scores]
    return Agreement(float(scores[0].mean()), float(scores[1].mean()), allowance + 3 * math.sqrt(sum(errors)))


def choose(finished: Mapping[str, Cell], wanted: str | None, seed: int) -> str:
    """Return the key of the finished cell of that label, key or head set, or of one drawn from the seed.

    Raises BadInputError for a name that no cell has, or several.
    """
    if wanted is None:
        return random.Random(f"verify {seed}").choice(sorted(finished))  # noqa: S311 - no secret
    for key, cell in finished.items():
        if wanted in (key, cell.label):
            return key
    if len(named := [key for key, cell in finished.items() if cell.heads == wanted]) == 1:
        return named[0]
    raise one_of("finished cell", wanted, [cell.label for cell in finished.values()])


def compute_again(plan: Plan, recorded: CellResult, display: Display, workers: int | None = None) -> CellResult:
    """Compute the cell of a result again, as its facts say: threads, device, precision. Only frames are kept.

    `workers`: processes, by default one for each core; the result does not depend on it.
    """
    values = {name: value for name, value in recorded.settings.items() if name in StudySettings.model_fields}
    values["encoder"] = values["encoder"] | {"precision": recorded.facts["precision"]}  # "auto" is another elsewhere
    settings = StudySettings.model_validate(values)
    seeds = int(recorded.settings["policy_seeds"])
    gpus = [str(index) for index in range(torch.cuda.device_count())]
    name = recorded.facts["device"]
    alike = [gpu for gpu in gpus if torch.cuda.get_device_name(int(gpu)) == name]
    use = [] if name.lower() == "cpu" else (alike or gpus)[:1]
    device = "auto" if use else "cpu"
    if name == APPLE and torch.backends.mps.is_available():
        use = visible_gpus(device := "mps")
    with (
        local_engine(workers or cores(), plan.workspace.tmp, use) as engine,
        tempfile.TemporaryDirectory(prefix=".verify-", dir=plan.workspace.data) as scratch,
    ):
        frames = run_flow(data_flow(plan.settings, plan.workspace.data, plan.imported), engine, display.data)
        display.start(recorded.key)
        job = CellJob(
            recorded.cell,
            cell_key(settings, recorded.cell, seeds, recorded.settings["frames_key"]),
            settings,
            seeds,
            frames,
            plan.drives,
            Path(scratch),
            device,
            int(recorded.facts["threads"]),
            plan.imported,
            plan.grid.modules,
        )
        again, _ = run_flow(
            cell_flow(job, one_share=bool(use)), engine, lambda *how: display.progress(recorded.key, *how)
        )
        return CellResult.load(again.save(Path(scratch) / "result"))  # as the recorded one was


def verify(plan: Plan, tracking: str, wanted: str | None, seed: int, workers: int | None = None) -> int:
    """Compute a finished cell again, print how it compares, and return the exit code."""
    reader = look_up(tracking)
    runs = reader.finished(list(plan.cells)) if reader else {}
    if not reader or not runs:
        raise BadInputError(f"no cell of {plan.title} is finished; run the sweep first")
    key = choose({key: plan.cells[key] for key in runs}, wanted, seed)
    print(f"{plan.cells[key].label} ({key})" + ("" if wanted else f", drawn with --seed {seed}"))
    recorded = reader.load_result(runs[key])
    with shared_use(plan.workspace.data), plan_display(plan, [key]) as display:
        again = compute_again(plan, recorded, display, workers)
    return report(recorded, again, plan.grid.rules.allowance([recorded.cell.heads] * 2))


def report(recorded: CellResult, again: CellResult, allowance: float) -> int:
    """Print how a result and its repetition compare; 0 when they are as equal as could be expected."""
    unequal = differences(recorded, again)
    if not unequal:
        print("equal: curves, weights, samples and predictions, byte for byte")
        return 0
    print(f"{len(unequal)} arrays differ:")
    for difference in unequal:
        by = f"by up to {difference.largest:.3g}" if math.isfinite(difference.largest) else "in shape or words"
        print(f"  {difference.name}: {difference.values} values {by}")
    other = changes(recorded.facts, again.facts)
    if not other:
        print("commit, versions, processor, threads and flags are as recorded: the bytes should have been equal")
        return EXIT_DIFFERS
    print("equal bytes were not to be expected:")
    for line in other:
        print(f"  {line if len(line) < 200 else line[:200] + '...'}")
    agreement = judge(recorded, again, allowance)
    print(
        f"final accuracy {agreement.recorded:.4f} then, {agreement.again:.4f} now: "
        f"{'within' if agreement.close else 'NOT within'} {agreement.allowed:.4f} "
        f"({allowance:g} for another encoder, and three standard errors)"
    )
    return 0 if agreement.close else EXIT_DIFFERS
