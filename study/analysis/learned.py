"""Whether encoders have learned: a claim about little data says nothing of encoders that were hardly trained."""

from __future__ import annotations

import math
from collections.abc import Iterable

from study.config.grid import Rules
from study.results.cell_result import CellResult
from study.results.sweep_record import SweepRecord
from study.statistics.effects import label, results_at
from study.statistics.learning_curves import Point


def unlearned(record: SweepRecord, points: Iterable[Point]) -> dict[Point, str]:
    """Return in words what speaks against a cell's encoders having learned; a cell that is not there has learned."""
    reasons = {}
    for point in points:
        for result in results_at(record, point):
            if reason := doubt(result, record.grid.rules):
                reasons[point] = f"{label(point, record.grid)}: {reason}"
    return reasons


def doubt(result: CellResult, rules: Rules) -> str:
    """Return why an encoder has not learned, or that it is unknown; empty when it has.

    It has when it took `rules.least_steps` steps or more, and the final test loss of each of its heads is at least
    `rules.learned_share` of the way from the loss of the best constant picture down to the least possible one.
    """
    taken = steps(result)
    if taken is not None and taken < rules.least_steps:
        return f"{taken} steps of its encoder, fewer than {rules.least_steps}"
    ends = result.facts.get("heads")
    if taken is None or not ends:
        return "unknown, its result is of a version that kept too little"
    for head, loss in final_losses(result).items():
        if head not in ends:
            return f"unknown, its result has no bounds of {head}'s loss"
        constant, least = float(ends[head]["constant"]), float(ends[head]["entropy"])
        bound = constant - rules.learned_share * (constant - least)
        if not loss <= bound:
            return f"test loss of {head} {loss:.4f}, a constant picture's is {constant:.4f}, {bound:.4f} is needed"
    return ""


def steps(result: CellResult) -> int | None:
    """Return how many steps an encoder was trained for, by its frames and settings; None where they are not known."""
    frames = result.facts.get("frames", {}).get("encoder_train")
    settings = result.settings.get("encoder", {})
    if frames is None or "batch" not in settings:
        return None
    epochs = int(settings["epochs"])
    if settings.get("budget") == "steps":  # as many as all the data would take
        frames = frames / result.cell.fraction
    return math.ceil(float(frames) / int(settings["batch"])) * epochs


def final_losses(result: CellResult) -> dict[str, float]:
    """Return the test loss of each head after the last epoch."""
    curves = result.curves
    rows = curves[(curves["stage"] == "encoder") & (curves["split"] == "test")]
    rows = rows[rows["metric"].str.startswith("loss_") & (rows["metric"] != "loss_kl")]
    last = rows[rows["epoch"] == rows["epoch"].max()]
    return {
        str(name).removeprefix("loss_"): float(loss) for name, loss in zip(last["metric"], last["value"], strict=True)
    }
