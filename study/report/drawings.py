"""The figures of a report and of a comparison; their captions are in the text, next to which they stand."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import asdict

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from study.analysis import predictions
from study.config.baselines import BASELINES
from study.config.heads import HEADS
from study.errors import BadInputError
from study.figures import curves, differences, pictures
from study.figures.style import Drawing
from study.products import Arrays
from study.report.comparison import ends_text, labels, side_key
from study.report.driving import draw_driving
from study.report.model import Report, Score, VariedSetting
from study.results.cell_result import CellResult
from study.results.sweep_record import SweepRecord
from study.statistics import effects, intervals, learning_curves
from study.statistics.intervals import Estimate
from study.statistics.learning_curves import ACCURACY, STEERING


def draw(record: SweepRecord, report: Report) -> dict[str, Drawing]:
    """Return the figures that the finished cells allow, by name."""
    if not report.scores:
        return {}
    drawn: dict[str, Drawing | None]
    if len(record.grid.fractions) > 1:
        drawn = {"datasize_convergespeed": _speed(record, report), "datasize_compare": _fractions(report)}
    else:
        drawn = {f"{split}_compare_heads": _heads(record, report, split) for split in ("test", "train")}
    top = [score for score in report.scores if score.fraction == report.sweep.fractions[0]]
    if top:
        drawn["confusion"] = differences.confusions([(score.cell, np.array(score.confusion)) for score in top])
    if report.sweep.design == "B":
        drawn["by_encoder"] = _encoders(record)
    drawn["paired_differences"] = _differences(report)
    drawn |= {f"confound_{row.setting.replace('.', '_')}": _confound(row) for row in report.confounds}
    if report.driving:
        drawn |= draw_driving(record, report.driving)
    drawn["encoder_losses"] = _encoder_losses(record, report)
    first = _first_results(record, report)
    drawn |= {"latent_maps": _latents(first), **_pictures(first)}
    return {name: figure for name, figure in drawn.items() if figure}


def _heads(record: SweepRecord, report: Report, split: str) -> Drawing:
    table, floor = record.table(), report.floor
    steering, accuracy = (intervals.curve_bands(table, metric, split) for metric in (STEERING, ACCURACY))
    beside = {
        metric: bands for metric in (STEERING, ACCURACY) if (bands := _baselines(record, metric, split)) is not None
    }
    return curves.compare_heads(steering, accuracy, floor[STEERING], floor[ACCURACY], split, beside)


def _baselines(record: SweepRecord, metric: str = ACCURACY, split: str = "test") -> pd.DataFrame | None:
    """Return the baselines' curves by epoch, where any is finished."""
    table = record.table(baselines=True)
    bands = intervals.curve_bands(table[table["heads"].isin(BASELINES)], metric, split)
    return bands if len(bands) else None


def _speed(record: SweepRecord, report: Report) -> Drawing | None:
    reached = {row.fraction: row.mean_curve.value for row in report.convergence if row.heads == "full"}
    if not reached:
        return None
    bands = intervals.curve_bands(record.table(), ACCURACY)
    return curves.converge_speed(bands, report.sweep.reference, reached, report.floor[ACCURACY], _baselines(record))


def _fractions(report: Report) -> Drawing:
    def rows(scores: Iterable[Score]) -> pd.DataFrame:
        return pd.DataFrame(
            [
                {"metric": name, "heads": row.heads, "fraction": row.fraction, **row.metrics[name].model_dump()}
                for row in scores
                for name in (ACCURACY, STEERING)
            ]
        )

    beside = rows(report.baselines) if report.baselines else None
    return curves.compare_fractions(rows(report.scores), report.floor[STEERING], report.floor[ACCURACY], beside)


def _differences(report: Report) -> Drawing | None:
    rows = report.accuracy_contrasts
    if not rows or math.isnan(rows[0].difference.low):
        return None
    ends = [dict(zip(("low_all", "high_all"), row.simultaneous, strict=True)) for row in rows]
    return differences.differences(
        [
            {"name": row.name, "allowance": row.allowance, **asdict(row.difference), **end}
            for row, end in zip(rows, ends, strict=True)
        ]
    )


def _encoders(record: SweepRecord) -> Drawing:
    """Draw how far policies differ by their encoder, at the largest fraction."""
    top, panel = max(record.grid.fractions), learning_curves.panel(record.table(), ACCURACY)
    return differences.by_encoder(
        {
            heads: [
                group.to_numpy(np.float64) for _, group in learning_curves.final(frame).groupby(level="encoder_seed")
            ]
            for (heads, fraction), frame in panel.items()
            if fraction == top
        }
    )


def _encoder_losses(record: SweepRecord, report: Report) -> Drawing | None:
    """Draw what is left to reduce of the heads' losses, at the largest and the smallest fraction."""
    table, ends = record.table(), {report.sweep.fractions[0], report.sweep.fractions[-1]}
    table = table[(table["stage"] == "encoder") & (table["split"] == "test") & table["fraction"].isin(ends)]
    means = table.groupby(["heads", "fraction", "metric", "epoch"])["value"].mean()
    lines, constants = [], {}
    for score in report.scores:
        for head, loss in score.losses.items():
            if score.fraction in ends and math.isfinite(loss["constant"]):
                values = means[score.heads, score.fraction, f"loss_{head}"] - loss["entropy"]
                lines.append((head, score.heads, score.fraction, values))
                constants[head] = loss["constant"] - loss["entropy"]
    return curves.encoder_losses(lines, constants) if lines else None


def _confound(row: VariedSetting) -> Drawing | None:
    """Draw a confound's contrasts under both of its values."""
    pairs = row.contrasts
    if not pairs or math.isnan(pairs[0].here.low) or math.isnan(pairs[0].there.low):
        return None
    rows = [
        differences.TwoSided(pair.name, *pair.first, (None, None), (_range(pair.here), _range(pair.there)))
        for pair in pairs
    ]
    return differences.both_values(rows, (f"{row.setting} {row.here}", f"{row.setting} {row.there}"))


def _range(estimate: Estimate | None) -> differences.Range | None:
    return (estimate.value, estimate.low, estimate.high) if estimate else None


# --- pictures of frames and latents ---------------------------------------------------------------------------------


def _first_results(record: SweepRecord, report: Report) -> dict[str, CellResult]:
    """Return the first encoder's result of each head set, at the largest fraction."""
    top = max(record.grid.fractions)
    return {name: results[0] for name in report.sweep.heads if (results := effects.results_at(record, (name, top)))}


def _latents(results: dict[str, CellResult]) -> Drawing | None:
    """Draw the latents of each head set on their principal components; not of results without the quantities."""
    outputs = {name: result.predictions for name, result in results.items()}
    if not outputs or any("speed" not in arrays for arrays in outputs.values()):
        return None
    return pictures.latent_maps(
        [
            (name, *predictions.principal(arrays["z"]), arrays["speed"], arrays["light"], arrays["steering_label"])
            for name, arrays in outputs.items()
        ]
    )


def _pictures(results: dict[str, CellResult]) -> dict[str, Drawing]:
    """Draw what the decoders of one encoder of each kind make of test frames."""
    samples_of = {name: result.samples for name, result in results.items()}
    drawn: dict[str, Drawing] = {}
    if "rec" in samples_of:
        rows = [("input", samples_of["rec"]["input"]), ("reconstruction", samples_of["rec"]["rec_output"])]
        drawn["single_head_rec"] = pictures.picture_rows(rows)
    if "full" in samples_of:
        drawn["multi_results"] = pictures.picture_rows(_head_by_head(samples_of["full"]))
    if len(samples_of) > 1:
        drawn["all_head_sets"] = pictures.picture_rows(_side_by_side(samples_of))
    return drawn


Rows = list[tuple[str, NDArray[np.uint8]]]


def _heads_of(samples: Arrays) -> list[str]:
    """Return the heads that some samples have an output of, in their order."""
    names = [name.removesuffix("_output") for name in samples if name.endswith("_output")]
    return sorted(names, key=[*HEADS, *sorted(names)].index)


def _word(head: str) -> str:
    return HEADS[head].word if head in HEADS else head


def _head_by_head(samples: Arrays) -> Rows:
    """Return rows of pictures: for each head its input, its output and, where it is another picture, its target."""
    rows: Rows = []
    for head in _heads_of(samples):
        rows += [("", samples["input"])] * bool(rows)
        rows += [("input", samples["input"]), (_word(head), samples[f"{head}_output"])]
        rows += [(f"{_word(head)} target", samples[f"{head}_target"])] if f"{head}_target" in samples else []
    return rows


def _side_by_side(samples_of: dict[str, Arrays]) -> Rows:
    """Return rows of pictures: for each head its target, then the output of every head set that has it."""
    rows: Rows = [("input", next(iter(samples_of.values()))["input"])]
    for head in dict.fromkeys(head for samples in samples_of.values() for head in _heads_of(samples)):
        owners = {name: samples for name, samples in samples_of.items() if f"{head}_output" in samples}
        targets = [samples[f"{head}_target"] for samples in owners.values() if f"{head}_target" in samples]
        rows += [("", targets[0]), (f"{head} target", targets[0])] if targets else []
        rows += [(f"{head} of {name}", samples[f"{head}_output"]) for name, samples in owners.items()]
    return rows


# --- two sweeps -----------------------------------------------------------------------------------------------------


def draw_sweeps(first: Report, second: Report, names: tuple[str, str]) -> Drawing:
    """Return final accuracy, and differences to the reference, of two sweeps; `names` say where each comes from.

    Raises BadInputError when neither has a finished cell.
    """
    sides, cells = (first, second), labels(first, second)
    if not cells:
        raise BadInputError(f"no cell is finished in {names[0]} or {names[1]}: nothing to draw, leave out --figure")
    rows = []
    for point, label in cells.items():
        scores = [side.by_point[point].accuracy if point in side.by_point else None for side in sides]
        ranges = tuple((row.mean, row.low, row.high) if row else None for row in scores)
        rows.append(
            differences.TwoSided(label, *point, ranges, tuple(_range(side.above_reference(point)) for side in sides))
        )
    keys = (side_key("first", first, names[0]), side_key("second", second, names[1]))
    return differences.two_sweeps(rows, keys, (first.sweep.reference, second.sweep.reference), ends_text(first, second))
