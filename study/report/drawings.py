"""Which figures a sweep's report shows, each with a caption that says n and kind, and words for who cannot see it."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import asdict

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from study.analysis import effects, intervals, learning_curves, predictions
from study.analysis.intervals import Estimate
from study.analysis.learning_curves import LAST
from study.config.heads import CEILING
from study.errors import BadInputError
from study.figures import curves, differences, pictures
from study.figures.style import Drawing
from study.products import Arrays
from study.report.comparison import labels
from study.report.model import Report, Spread
from study.report.rounding import epochs, kinds
from study.results.cell_result import CellResult
from study.results.sweep_record import SweepRecord

HEAD_WORDS = {"rec": "reconstruction", "pred": "prediction", "plan": "planning"}


def draw(record: SweepRecord, report: Report) -> list[Drawing]:
    """Return the figures that the finished cells allow (PAPER.md section 4); captions say n and kind."""
    if not report.scores:
        return []
    if len(record.grid.fractions) > 1:
        own = [*_speed(record, report), _fractions(report)]
    else:
        own = [_heads(record, report, "test", "main"), _heads(record, report, "train", "train")]
    own += [*_confusions(report), *_encoders(record, report), *_differences(report), *_confounds(report)]
    return [*own, *_latents(record, report), *_pictures(record, report)]


def _bands(report: Report) -> str:
    """Return what lines and bands are, with n."""
    if report.sweep.design == "A":
        over, units = f"n = {_counts(score.n for score in report.scores)} policies on one encoder", "those policies"
    else:
        counts = sorted({(score.n, score.encoders) for score in report.scores})
        over = " or ".join(f"n = {n} policies on {encoders} encoders" for n, encoders in counts)
        units = "the encoders"
    return (
        f"Line: mean over {over}. Light band: one standard deviation over all of them. Dark band: 95 % interval of the "
        f"mean (Student's t, over {units})."
    )


def _counts(counts: Iterable[int]) -> str:
    return " or ".join(map(str, sorted(set(counts))))


def _heads(record: SweepRecord, report: Report, split: str, place: str) -> Drawing:
    table, floor = record.table(), report.floor
    steering, accuracy = (
        intervals.curve_bands(table, metric, split) for metric in (learning_curves.STEERING, learning_curves.ACCURACY)
    )
    names = ", ".join(score.cell for score in report.scores)
    alt = "; ".join(f"{score.cell} ends at {100 * score.accuracy.mean:.1f} %" for score in report.scores)
    return Drawing(
        f"{split}_compare_heads",
        place,
        f"Policies on frozen encoders by epoch, {split} split: (a) steering loss, (b) acceleration accuracy, for "
        f"encoders trained with {names}. {_bands(report)}{_ceiling_words(report)} Where the accuracy axis is cut, it "
        f"says so. The paper's fig:{split}_compare_heads.",
        f"Two line charts of steering loss and acceleration accuracy by epoch on the {split} split. On test {alt}.",
        curves.compare_heads(steering, accuracy, floor["steering"], floor["accuracy"], split, _ceiling(record, split)),
    )


def _ceiling(record: SweepRecord, split: str = "test") -> pd.DataFrame | None:
    """Return the accuracy of policies on the true state by epoch."""
    if record.ceiling is None:
        return None
    table = record.table(ceiling=True)
    return intervals.curve_bands(table[table["heads"] == CEILING], learning_curves.ACCURACY, split)


def _ceiling_words(report: Report) -> str:
    if report.ceiling is None:
        return ""
    return f" Dotted, true state: mean over n = {report.ceiling.n} policies that need no encoder, the ceiling."


def _speed(record: SweepRecord, report: Report) -> Iterator[Drawing]:
    bands, base = intervals.curve_bands(record.table(), learning_curves.ACCURACY), report.sweep.baseline
    reached = {row.fraction: row.mean_curve.value for row in report.convergence if row.heads == "full"}
    words = "; ".join(f"{100 * fraction:g} %: {epochs(epoch)}" for fraction, epoch in reached.items())
    if reached:
        yield Drawing(
            "datasize_convergespeed",
            "main",
            f"Test acceleration accuracy by policy epoch: full at every data fraction against {base} at the largest. "
            f"{_bands(report)}{_ceiling_words(report)} Fine dots: {base}'s final accuracy (mean of its last "
            f"{LAST} epochs) and the epoch at which each mean curve first reaches it. Where the axis is cut, it "
            "says so. The paper's fig:datasize_convergespeed.",
            f"Line chart. Epoch at which full reaches {base}'s final accuracy, by fraction: {words}.",
            curves.converge_speed(bands, base, reached, report.floor["accuracy"], _ceiling(record)),
        )


def _fractions(report: Report) -> Drawing:
    rows = [
        {"metric": metric, "heads": score.heads, "fraction": score.fraction, **spread.model_dump()}
        for score in report.scores
        for metric, spread in ((learning_curves.ACCURACY, score.accuracy), (learning_curves.STEERING, score.steering))
    ]
    words = "; ".join(f"{score.cell} {100 * score.accuracy.mean:.1f} %" for score in report.scores)
    return Drawing(
        "datasize_compare",
        "fractions",
        f"Test (a) steering loss and (b) acceleration accuracy, mean of the last {LAST} epochs, by share of the "
        f"encoder's training data. Thin bar: one standard deviation over n = {_counts(row.n for row in report.scores)} "
        f"policies; thick bar: 95 % interval of the mean ({report.scores[0].accuracy.kind}).{_ceiling_words(report)} "
        "Where the accuracy axis is cut, it says so. The paper's fig:datasize_compare.",
        f"Two dot plots by data fraction. Accuracy: {words}.",
        curves.compare_fractions(
            pd.DataFrame(rows),
            report.floor["steering"],
            report.floor["accuracy"],
            report.ceiling.mean if report.ceiling else None,
        ),
    )


def _differences(report: Report) -> Iterator[Drawing]:
    rows = report.accuracy_contrasts
    if not rows or math.isnan(rows[0].difference.low):
        return
    allowance = report.rules["encoder_allowance"] if report.sweep.design == "A" else 0.0
    zone = f" Grey zone: the ±{100 * allowance:.1f} points that two encoders may differ by their seeds alone."
    ends = [dict(zip(("low_all", "high_all"), row.simultaneous, strict=True)) for row in rows]
    yield Drawing(
        "paired_differences",
        "differences",
        "Differences in final test acceleration accuracy, paired by seed, "
        f"n = {_counts(row.difference.n for row in rows)} pairs. "
        f"Thick bar: 95 % interval ({rows[0].difference.kind}). Thin bar: t interval for all "
        f"{report.planned_contrasts} planned contrasts together.{zone if allowance else ''}",
        "Dot plot of paired differences. "
        + "; ".join(f"{row.name}: {100 * row.difference.value:+.2f} points" for row in rows),
        differences.differences(
            [{"name": row.name, **asdict(row.difference), **own} for row, own in zip(rows, ends, strict=True)],
            allowance,
        ),
    )


def _encoders(record: SweepRecord, report: Report) -> Iterator[Drawing]:
    """Yield how far policies differ by their encoder, at the largest fraction; nothing with one encoder each."""
    if report.sweep.design == "A":
        return
    top, curves = max(record.grid.fractions), learning_curves.panel(record.table(), learning_curves.ACCURACY)
    scores = {
        heads: [group.to_numpy(np.float64) for _, group in learning_curves.final(frame).groupby(level="encoder_seed")]
        for (heads, fraction), frame in curves.items()
        if fraction == top
    }
    words = "; ".join(
        f"{heads} from {100 * min(map(np.mean, each)):.1f} to {100 * max(map(np.mean, each)):.1f} %"
        for heads, each in scores.items()
    )
    counts = sorted({(len(each), len(each[0])) for each in scores.values()})
    over = " or ".join(f"n = {encoders} encoders x {policies} policies" for encoders, policies in counts)
    yield Drawing(
        "by_encoder",
        "encoders",
        f"Final test accuracy (mean of the last {LAST} epochs) of every policy, {over} for each head set. "
        "Marks: policies; bars: mean of an encoder's policies; dashed: mean of the encoders.",
        f"Strip chart of policies by encoder. Means of encoders: {words}.",
        differences.by_encoder(scores),
    )


def _confusions(report: Report) -> Iterator[Drawing]:
    """Yield the confusion matrices of the head sets at the largest fraction."""
    own = [score for score in report.scores if score.fraction == report.sweep.fractions[0]]
    words = "; ".join(
        f"{score.cell} " + ", ".join(f"{100 * score.confusion[i][i]:.0f} %" for i in range(3)) for score in own
    )
    if own:
        yield Drawing(
            "confusion",
            "confusion",
            "How often each true class of throttle \N{MINUS SIGN} brake is given each class on test frames [%], after "
            f"the last epoch, mean over n = {_counts(score.n for score in report.scores)} policies.",
            f"Confusion matrices. Recall of the classes \N{MINUS SIGN}1, 0.5 and 1: {words}.",
            differences.confusions([(score.cell, np.array(score.confusion)) for score in own]),
        )


def _confounds(report: Report) -> Iterator[Drawing]:
    """Yield each confound's contrasts under both of its values."""
    for row in report.confounds:
        pairs = row.contrasts
        if not pairs or math.isnan(pairs[0].here.low) or math.isnan(pairs[0].there.low):
            continue
        words = "; ".join(
            f"{pair.name}: {100 * pair.here.value:+.2f} and {100 * pair.there.value:+.2f} points" for pair in pairs
        )
        counts = _counts(side.n for pair in pairs for side in (pair.here, pair.there))
        yield Drawing(
            f"confound_{row.setting.replace('.', '_')}",
            f"confound {row.setting}",
            f"Differences in final test acceleration accuracy under both values of {row.setting}, paired by seed, "
            f"n = {counts} pairs. Bar: 95 % interval ({pairs[0].here.kind}).",
            f"Dot plot of differences with {row.setting} {row.here} and {row.there}. {words}.",
            differences.both_values([asdict(pair) for pair in pairs], row.setting, (row.here, row.there or "")),
        )


def draw_sweeps(first: Report, second: Report, names: tuple[str, str]) -> Drawing:
    """Return final accuracy, and differences to the baseline, of two sweeps; `names` say where each comes from.

    Raises BadInputError when neither has a finished cell.
    """
    sides, cells = (first, second), labels(first, second)
    if not cells:
        raise BadInputError(f"no cell is finished in {names[0]} or {names[1]}: nothing to draw, leave out --figure")
    scores = [{(row.heads, row.fraction): row.accuracy for row in side.scores} for side in sides]
    gains = [{point: gain for point in cells if (gain := side.above_baseline(point))} for side in sides]
    pairs, words = [], []
    for point, label in cells.items():
        one, other = ((own.mean, own.low, own.high) if (own := side.get(point)) else None for side in scores)
        up, more = ((gain.value, gain.low, gain.high) if (gain := side.get(point)) else None for side in gains)
        pairs.append(differences.Pair(label, point[0], point[1], (one, other), (up, more)))
        words.append(f"{label}: " + " and ".join(f"{100 * own[0]:.1f} %" if own else "none" for own in (one, other)))
    bases = (first.sweep.baseline, second.sweep.baseline)
    keys = (_key("first", first, names[0]), _key("second", second, names[1]))
    bars: list[Spread | Estimate] = [own for side in scores for own in side.values()]
    bars += [own for side in gains for own in side.values()]
    above = ""
    if any(gains):
        above = f", and (b) as difference to {' or '.join(dict.fromkeys(bases))} of the same sweep, paired by seed"
    return Drawing(
        "two_sweeps",
        "comparison",
        f"(a) Test acceleration accuracy, mean of the last {LAST} epochs{above}. Filled: {keys[0]}. Hollow: "
        f"{keys[1]}. Bar: 95 % interval ({kinds(bars)}).",
        f"Dot plot of two sweeps. Accuracy, first and second: {'; '.join(words)}.",
        differences.two_sweeps(pairs, keys, bases, _ends(first, second)),
    )


def _key(word: str, report: Report, name: str, most: int = 60) -> str:
    """Return which sweep it is, with n; of a long name the end."""
    shown = name if len(name) <= most else f"\N{HORIZONTAL ELLIPSIS}{name[1 - most :]}"
    units = "policies on one encoder" if report.sweep.design == "A" else "encoders"
    return f"{word}, {shown} (n = {_counts(row.accuracy.n for row in report.scores) or 0} {units})"


def _ends(first: Report, second: Report) -> str:
    """Return floor and ceiling in words, of both sweeps where they differ."""
    floors = [side.floor["accuracy"] for side in (first, second)]
    tops = [side.ceiling.mean for side in (first, second) if side.ceiling]
    parts = ["(a): axis cut"]
    for word, values in (("majority class", floors), (curves.CEILING_WORDS, tops)):
        shown = dict.fromkeys(f"{100 * value:.1f}" for value in values if not math.isnan(value))
        parts += [f"{word} at {' and '.join(shown)} %"] if shown else []
    return "; ".join(parts)


def _first_results(record: SweepRecord, report: Report) -> dict[str, CellResult]:
    """Return the first encoder's result of each head set, at the largest fraction."""
    top = max(record.grid.fractions)
    return {name: results[0] for name in report.sweep.heads if (results := effects.results_at(record, (name, top)))}


def _latents(record: SweepRecord, report: Report) -> Iterator[Drawing]:
    found = {name: result.predictions for name, result in _first_results(record, report).items()}
    if not found or any("speed" not in own for own in found.values()):
        return
    maps = []
    for name, own in found.items():
        places, shares = predictions.principal(own["z"])
        maps.append((name, places, shares, own["speed"], own["light"], own["steering_label"]))
    encoders = "one encoder each" if report.sweep.encoder_seeds == 1 else "the first encoder of each"
    yield Drawing(
        "latent_maps",
        "latents",
        f"Latents of the policy set's {len(maps[0][1])} test frames on their first two principal components (of "
        f"z-scored dimensions; {encoders}), coloured by the vehicle's speed, the light that governs and the expert's "
        "steering.",
        "Scatter plots of latents for each head set, coloured by speed in the first row, by light in the second "
        "and by steering in the third.",
        pictures.latent_maps(maps),
    )


def _pictures(record: SweepRecord, report: Report) -> Iterator[Drawing]:
    """Yield what the decoders of one encoder of each kind make of test frames."""
    found = {name: result.samples for name, result in _first_results(record, report).items()}
    if "rec" in found:
        yield Drawing(
            "single_head_rec",
            "pictures",
            "Test frames (first row) and what the single-head autoencoder (rec) makes of them. The paper's "
            "fig:single_head_rec.",
            "Two rows of bird-view pictures: inputs, and their reconstructions by the single-head network.",
            pictures.picture_rows([("input", found["rec"]["input"]), ("reconstruction", found["rec"]["rec_output"])]),
        )
    if "full" in found:
        samples, rows = found["full"], []
        for head, word in HEAD_WORDS.items():
            rows += [("input", samples["input"]), (word, samples[f"{head}_output"])]
            rows += [(f"{word} target", samples[f"{head}_target"])] if f"{head}_target" in samples else []
            rows.append(("", samples["input"]))
        yield Drawing(
            "multi_results",
            "pictures",
            "The same test frames through the multi-head network (full): for each head its input, its output and, "
            "for prediction (other agents over the next second) and planning (the ego vehicle over the next "
            "second), the target. The reconstruction's target is its input. The paper's fig:multi_results.",
            "Rows of bird-view pictures: inputs, reconstructions, predicted masks with their targets, planned "
            "masks with their targets, by the three-head network.",
            pictures.picture_rows(rows[:-1]),
        )
    if len(found) > 1:
        yield Drawing(
            "all_head_sets",
            "pictures",
            "The same test frames through the networks of all head sets, with targets. Brighter is more certain.",
            f"Rows of bird-view pictures: outputs of {', '.join(found)} for the same inputs, with their targets.",
            pictures.picture_rows(_side_by_side(found)),
        )


def _side_by_side(found: dict[str, Arrays]) -> list[tuple[str, NDArray[np.uint8]]]:
    """Return rows of pictures: for each head its target, then the output of every head set that has it."""
    rows = [("input", next(iter(found.values()))["input"])]
    for head in HEAD_WORDS:
        owners = {name: samples for name, samples in found.items() if f"{head}_output" in samples}
        targets = [samples[f"{head}_target"] for samples in owners.values() if f"{head}_target" in samples]
        if head != "rec" and owners:
            rows += [("", targets[0]), (f"{head} target", targets[0])]
        rows += [(f"{head} of {name}", samples[f"{head}_output"]) for name, samples in owners.items()]
    return rows
