"""A finished cell computed again in a folder of its own, and compared with what MLflow holds, byte for byte.

Nothing is written to MLflow.

python -m study.sweep verify heads
python -m study.sweep verify heads --cell 'rec+plan 100% e0'
"""

from __future__ import annotations

import hashlib
import math
import random
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from study.cell.job import CellJob
from study.compute.provenance import cores
from study.config.grid import Cell
from study.config.keys import cell_key
from study.config.settings import StudySettings
from study.config.workspace import DATA
from study.console.display import Display
from study.console.options import Parser, add_tracking_option
from study.data.prepare import data_flow
from study.engine.flows import run_flow
from study.errors import BadInputError, one_of
from study.results.cell_result import ARRAYS, CURVE_COLUMNS, CellResult
from study.stages import cell_cost
from study.sweep.options import add_plan_options
from study.sweep.plan import Plan, given_plan, look_up
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
    """What differs between two results, bit for bit: curves, weights, samples and predictions. Not the facts."""
    pairs = {f"curves: {name}": _columns(recorded, again, name) for name in CURVE_COLUMNS}
    for part in ARRAYS:
        mine, theirs = getattr(recorded, part), getattr(again, part)
        pairs |= {f"{part}: {name}": (mine.get(name), theirs.get(name)) for name in sorted(mine | theirs)}
    return [found for name, (left, right) in pairs.items() if (found := _difference(name, left, right))]


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
    """What of the recorded facts that a bit can hang on is not so now, in words; what was not recorded is left out."""
    found = []
    for name, before, here in _conditions(recorded, now):
        if before is not None and before != here:
            found.append(f"{name}: {before or 'none'} then, {here or 'none'} now")
    return found


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
class Verdict:
    """How far two results agree in the end: mean accuracy over policies of the last five epochs, and what may be."""

    recorded: float
    again: float
    allowed: float

    @property
    def close(self) -> bool:
        """Whether they agree."""
        return abs(self.recorded - self.again) <= self.allowed


def judge(recorded: CellResult, again: CellResult, allowance: float) -> Verdict:
    """Compare final accuracies where equal bits are not to be expected.

    Allowed is what two encoders may differ by their seeds alone, and three standard errors of the difference.
    """
    scores = [final_scores(result)[ACCURACY].to_numpy(np.float64) for result in (recorded, again)]
    errors = [each.var(ddof=1) / len(each) if len(each) > 1 else 0.0 for each in scores]
    return Verdict(float(scores[0].mean()), float(scores[1].mean()), allowance + 3 * math.sqrt(sum(errors)))


def choose(finished: Mapping[str, Cell], wanted: str | None, seed: int) -> str:
    """The key of the finished cell of that label or key, or of one drawn from the seed. Raises BadInputError."""
    if wanted is None:
        return random.Random(f"verify {seed}").choice(sorted(finished))  # noqa: S311 - no secret
    for key, cell in finished.items():
        if wanted in (key, cell.label):
            return key
    raise one_of("finished cell", wanted, [cell.label for cell in finished.values()])


def compute_again(plan: Plan, recorded: CellResult, display: Display) -> CellResult:
    """The cell of a result once more, as its facts say: threads, device, precision. Leaves only frames behind."""
    # Finding nothing to verify needs none of these.
    import torch  # noqa: PLC0415

    from study.cell.flow import cell_flow  # noqa: PLC0415
    from study.engine.local import local_engine  # noqa: PLC0415

    own = {name: value for name, value in recorded.settings.items() if name in StudySettings.model_fields}
    own["encoder"] = own["encoder"] | {"precision": recorded.facts["precision"]}  # "auto" is another elsewhere
    settings = StudySettings.model_validate(own)
    seeds = int(recorded.settings["policy_seeds"])
    gpus = [str(index) for index in range(torch.cuda.device_count())]
    name = recorded.facts["device"]
    alike = [gpu for gpu in gpus if torch.cuda.get_device_name(int(gpu)) == name]
    use = [] if name.lower() == "cpu" else (alike or gpus)[:1]
    with (
        local_engine(cores(), DATA / "tmp", use) as engine,
        tempfile.TemporaryDirectory(prefix=".verify-", dir=DATA) as scratch,
    ):
        frames = run_flow(data_flow(plan.settings, DATA, plan.imported), engine, display.data)
        display.start(recorded.key)
        job = CellJob(
            recorded.cell,
            cell_key(settings, recorded.cell, seeds, recorded.settings["frames_key"]),
            settings,
            seeds,
            frames,
            plan.drives,
            Path(scratch),
            "auto" if use else "cpu",
            int(recorded.facts["threads"]),
            plan.imported,
            plan.grid.head_modules,
        )
        again, _ = run_flow(
            cell_flow(job, one_share=bool(use)), engine, lambda *how: display.progress(recorded.key, *how)
        )
        return CellResult.load(again.save(Path(scratch) / "result"))  # as the recorded one was


# --- the command ----------------------------------------------------------------------------------------------------


def main(args: Sequence[str]) -> int:
    """Run the command and return its exit code."""
    made = Parser(
        prog="study.sweep verify",
        usage="python -m study.sweep verify NAME [--cell CELL] [--seed N] [--tracking URI] [--group.setting VALUE ...]",
        description="Compute a finished cell again and compare curves, weights and predictions byte for byte.",
    )
    add_plan_options(made)
    made.add_argument("--cell", help="label or key of a finished cell, as --dry-run shows them (default: any)")
    made.add_argument("--seed", type=int, default=random.randrange(10**6), help="draws the cell (default: any)")  # noqa: S311
    add_tracking_option(made)
    options = made.parse(args)
    plan = given_plan(options)
    tracker = look_up(options.tracking)
    runs = tracker.finished(list(plan.cells)) if tracker else {}
    if not tracker or not runs:
        raise BadInputError(f"no cell of {plan.grid.name} ({plan.profile}) is finished; run the sweep first")
    key = choose({key: plan.cells[key] for key in runs}, options.cell, options.seed)
    cell = plan.cells[key]
    print(f"{cell.label} ({key})" + ("" if options.cell else f", drawn with --seed {options.seed}"))
    recorded = tracker.load_result(runs[key])
    cost = cell_cost(plan.settings, cell, plan.grid.policy_seeds).seconds
    ready = (plan.frames / "manifest.json").is_file()
    data_seconds = 0.0 if ready else plan.data_cost.seconds
    DATA.mkdir(exist_ok=True)
    with Display("verify", {key: cost}, {key: cell.label}, data_seconds, plan.works) as display:
        again = compute_again(plan, recorded, display)
    return report(recorded, again, plan.grid.rules.encoder_allowance)


def report(recorded: CellResult, again: CellResult, allowance: float) -> int:
    """Print how a result and its repetition compare; 0 when they are as equal as could be expected."""
    found = differences(recorded, again)
    if not found:
        print("equal: curves, weights, samples and predictions, byte for byte")
        return 0
    print(f"{len(found)} arrays differ:")
    for difference in found:
        by = f"by up to {difference.largest:.3g}" if math.isfinite(difference.largest) else "in shape or words"
        print(f"  {difference.name}: {difference.values} values {by}")
    other = changes(recorded.facts, again.facts)
    if not other:
        print("commit, versions, processor, threads and flags are as recorded: the bytes should have been equal")
        return EXIT_DIFFERS
    print("equal bytes were not to be expected:")
    for line in other:
        print(f"  {line if len(line) < 200 else line[:200] + '...'}")
    verdict = judge(recorded, again, allowance)
    print(
        f"final accuracy {verdict.recorded:.4f} then, {verdict.again:.4f} now: "
        f"{'within' if verdict.close else 'NOT within'} {verdict.allowed:.4f} "
        f"({allowance:g} for another encoder, and three standard errors)"
    )
    return 0 if verdict.close else EXIT_DIFFERS
