"""Which figures a sweep's report shows, each with a caption that says n and kind, and words for who cannot see it."""

from __future__ import annotations

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from study import claims, figures, stats
from study.comparison import Report, labels
from study.config import CEILING, BadInputError
from study.figures import Drawing
from study.result import CellResult, SweepRecord
from study.summary import Numbers

HEAD_WORDS = {"rec": "reconstruction", "pred": "prediction", "plan": "planning"}


def draw(record: SweepRecord, made: Numbers) -> list[Drawing]:
    """The figures that the finished cells allow (PAPER.md section 4), each with a caption that says n and kind."""
    if not made["scores"]:
        return []
    if len(record.grid.fractions) > 1:
        own = [*_speed(record, made), *_fractions(made)]
    else:
        own = [_heads(record, made, "test", "main"), _heads(record, made, "train", "train")]
    own += [*_confusions(made), *_encoders(record, made), *_differences(made), *_confounds(made)]
    return [*own, *_latents(record, made), *_pictures(record, made)]


def _bands(made: Numbers) -> str:
    """What lines and bands are, with n."""
    counts = sorted({(score["n"], score["encoders"]) for score in made["scores"]})
    if made["sweep"]["design"] == "A":
        seeds = " or ".join(str(n) for n, _ in counts)
        over, units = f"n = {seeds} policies on one encoder", "those policies"
    else:
        over = " or ".join(f"n = {n} policies on {encoders} encoders" for n, encoders in counts)
        units = "the encoders"
    return (
        f"Line: mean over {over}. Light band: one standard deviation over all of them. Dark band: 95 % interval of the "
        f"mean (Student's t, over {units})."
    )


def _heads(record: SweepRecord, made: Numbers, split: str, place: str) -> Drawing:
    table, floor = record.table(), made["floor"]
    steering, accuracy = (stats.curve_bands(table, metric, split) for metric in (stats.STEERING, stats.ACCURACY))
    names = ", ".join(score["cell"] for score in made["scores"])
    alt = "; ".join(f"{score['cell']} ends at {100 * score['accuracy']['mean']:.1f} %" for score in made["scores"])
    return Drawing(
        f"{split}_compare_heads",
        place,
        f"Policies on frozen encoders by epoch, {split} split: (a) steering loss, (b) acceleration accuracy, for "
        f"encoders trained with {names}. {_bands(made)}{_ceiling_words(made)} Where the accuracy axis is cut, it says "
        f"so. The paper's fig:{split}_compare_heads.",
        f"Two line charts of steering loss and acceleration accuracy by epoch on the {split} split. On test {alt}.",
        figures.compare_heads(steering, accuracy, floor["steering"], floor["accuracy"], split, _ceiling(record, split)),
    )


def _ceiling(record: SweepRecord, split: str = "test") -> pd.DataFrame | None:
    """Accuracy of policies on the true state by epoch."""
    if record.ceiling is None:
        return None
    table = record.table(ceiling=True)
    return stats.curve_bands(table[table["heads"] == CEILING], stats.ACCURACY, split)


def _ceiling_words(made: Numbers) -> str:
    if made["ceiling"] is None:
        return ""
    return f" Dotted, true state: mean over n = {made['ceiling']['n']} policies that need no encoder, the ceiling."


def _speed(record: SweepRecord, made: Numbers) -> list[Drawing]:
    bands = stats.curve_bands(record.table(), stats.ACCURACY)
    base, floor = made["sweep"]["baseline"], made["floor"]["accuracy"]
    full = [row for row in made["convergence"] if row["heads"] == "full"]
    if not full:
        return []
    epochs = {row["fraction"]: row["mean_curve"]["value"] for row in full}
    reached = {fraction: float("inf") if epoch == "never" else epoch for fraction, epoch in epochs.items()}
    told = "; ".join(f"{100 * fraction:g} %: {epoch}" for fraction, epoch in epochs.items())
    return [
        Drawing(
            "datasize_convergespeed",
            "main",
            f"Test acceleration accuracy by policy epoch: full at every data fraction against {base} at the largest. "
            f"{_bands(made)}{_ceiling_words(made)} Fine dots: {base}'s final accuracy (mean of its last {stats.LAST} "
            "epochs) and the epoch at which each mean curve first reaches it. Where the axis is cut, it says so. "
            "The paper's fig:datasize_convergespeed.",
            f"Line chart. Epoch at which full reaches {base}'s final accuracy, by fraction: {told}.",
            figures.converge_speed(bands, base, reached, floor, _ceiling(record)),
        )
    ]


def _fractions(made: Numbers) -> list[Drawing]:
    names = {"accuracy": stats.ACCURACY, "steering": stats.STEERING}
    rows = [
        {"metric": metric, "heads": score["heads"], "fraction": score["fraction"], **score[name]}
        for name, metric in names.items()
        for score in made["scores"]
    ]
    told = "; ".join(f"{score['cell']} {100 * score['accuracy']['mean']:.1f} %" for score in made["scores"])
    kind = made["scores"][0]["accuracy"]["kind"]
    return [
        Drawing(
            "datasize_compare",
            "fractions",
            f"Test (a) steering loss and (b) acceleration accuracy, mean of the last {stats.LAST} epochs, by share of "
            f"the encoder's training data. Thin bar: one standard deviation over {_over(made)}; thick bar: 95 % "
            f"interval of the mean ({kind}).{_ceiling_words(made)} Where the accuracy axis is cut, it says so. "
            "The paper's fig:datasize_compare.",
            f"Two dot plots by data fraction. Accuracy: {told}.",
            figures.compare_fractions(
                pd.DataFrame(rows).astype({"sd": float, "low": float, "high": float}),
                made["floor"]["steering"],
                made["floor"]["accuracy"],
                made["ceiling"] and made["ceiling"]["mean"],
            ),
        )
    ]


def _over(made: Numbers) -> str:
    counts = sorted({score["n"] for score in made["scores"]})
    return f"n = {' or '.join(str(count) for count in counts)} policies"


def _differences(made: Numbers) -> list[Drawing]:
    rows = [row for row in made["comparisons"] if row["metric"] == stats.ACCURACY]
    if not rows or rows[0]["difference"]["low"] is None:
        return []
    allowance = made["rules"]["encoder_allowance"] if made["sweep"]["design"] == "A" else 0.0
    zone = f" Grey zone: the ±{100 * allowance:.1f} points that two encoders may differ by their seeds alone." * bool(
        allowance
    )
    counts = sorted({row["difference"]["n"] for row in rows})
    return [
        Drawing(
            "paired_differences",
            "differences",
            "Differences in final test acceleration accuracy, paired by seed, "
            f"n = {' or '.join(map(str, counts))} pairs. "
            f"Thick bar: 95 % interval ({rows[0]['difference']['kind']}). Thin bar: t interval for all "
            f"{made['planned_contrasts']} planned contrasts together.{zone}",
            "Dot plot of paired differences. "
            + "; ".join(f"{row['name']}: {100 * row['difference']['value']:+.2f} points" for row in rows),
            figures.differences(
                [
                    {
                        "name": row["name"],
                        **{name: row["difference"][name] for name in ("value", "low", "high")},
                        "low_all": row["simultaneous"][0],
                        "high_all": row["simultaneous"][1],
                    }
                    for row in rows
                ],
                allowance,
            ),
        )
    ]


def _encoders(record: SweepRecord, made: Numbers) -> list[Drawing]:
    """How far policies differ by their encoder, at the largest fraction; with one encoder each there is nothing."""
    if made["sweep"]["design"] == "A":
        return []
    top, curves = max(record.grid.fractions), stats.panel(record.table(), stats.ACCURACY)
    scores = {
        heads: [group.to_numpy(np.float64) for _, group in stats.final(frame).groupby(level="encoder_seed")]
        for (heads, fraction), frame in curves.items()
        if fraction == top
    }
    told = "; ".join(
        f"{heads} from {100 * min(map(np.mean, each)):.1f} to {100 * max(map(np.mean, each)):.1f} %"
        for heads, each in scores.items()
    )
    counts = sorted({(len(each), len(each[0])) for each in scores.values()})
    over = " or ".join(f"n = {encoders} encoders x {policies} policies" for encoders, policies in counts)
    return [
        Drawing(
            "by_encoder",
            "encoders",
            f"Final test accuracy (mean of the last {stats.LAST} epochs) of every policy, {over} for each head set. "
            "Marks: policies; bars: mean of an encoder's policies; dashed: mean of the encoders.",
            f"Strip chart of policies by encoder. Means of encoders: {told}.",
            figures.by_encoder(scores),
        )
    ]


def _confusions(made: Numbers) -> list[Drawing]:
    """Confusion matrices of the head sets at the largest fraction."""
    top = made["sweep"]["fractions"][0]
    own = [score for score in made["scores"] if score["fraction"] == top]
    told = "; ".join(
        f"{score['cell']} " + ", ".join(f"{100 * score['confusion'][i][i]:.0f} %" for i in range(3)) for score in own
    )
    return [
        Drawing(
            "confusion",
            "confusion",
            "How often each true class of throttle \N{MINUS SIGN} brake is given each class on test frames [%], after "
            f"the last epoch, mean over {_over(made)}.",
            f"Confusion matrices. Recall of the classes \N{MINUS SIGN}1, 0.5 and 1: {told}.",
            figures.confusions([(score["cell"], np.array(score["confusion"])) for score in own]),
        )
    ] * bool(own)


def _confounds(made: Numbers) -> list[Drawing]:
    """Each confound's contrasts under both of its values."""
    drawings = []
    for row in made["confounds"]:
        pairs = row["contrasts"]
        if not pairs or pairs[0]["here"]["low"] is None or pairs[0]["there"]["low"] is None:
            continue
        told = "; ".join(
            f"{pair['name']}: {100 * pair['here']['value']:+.2f} and {100 * pair['there']['value']:+.2f} points"
            for pair in pairs
        )
        counts = sorted({pair[side]["n"] for pair in pairs for side in ("here", "there")})
        drawings.append(
            Drawing(
                f"confound_{row['setting'].replace('.', '_')}",
                f"confound {row['setting']}",
                f"Differences in final test acceleration accuracy under both values of {row['setting']}, paired by "
                f"seed, n = {' or '.join(map(str, counts))} pairs. Bar: 95 % interval ({pairs[0]['here']['kind']}).",
                f"Dot plot of differences with {row['setting']} {row['here']} and {row['there']}. {told}.",
                figures.both_values(pairs, row["setting"], (row["here"], row["there"])),
            )
        )
    return drawings


def draw_sweeps(first: Report, second: Report, names: tuple[str, str]) -> Drawing:
    """Final accuracy, and differences to the baseline, of two sweeps; `names` say where each comes from.

    Raises BadInputError when neither has a finished cell.
    """
    sides, named = (first, second), labels(first, second)
    if not named:
        raise BadInputError(f"no cell is finished in {names[0]} or {names[1]}: nothing to draw, leave out --figure")
    scores = [{(row.heads, row.fraction): row.accuracy for row in side.scores} for side in sides]
    gains = [{point: gain for point in named if (gain := side.above_baseline(point))} for side in sides]
    pairs, told = [], []
    for point, label in named.items():
        one, other = ((own.mean, own.low, own.high) if (own := side.get(point)) else None for side in scores)
        up, more = ((gain.value, gain.low, gain.high) if (gain := side.get(point)) else None for side in gains)
        pairs.append(figures.Pair(label, point[0], point[1], (one, other), (up, more)))
        told.append(f"{label}: " + " and ".join(f"{100 * own[0]:.1f} %" if own else "none" for own in (one, other)))
    bases = (first.sweep.baseline, second.sweep.baseline)
    keys = (_key("first", first, names[0]), _key("second", second, names[1]))
    kinds = dict.fromkeys(own.kind for side in scores for own in side.values())
    above = ""
    if any(gains):
        kinds |= dict.fromkeys(gain.kind for side in gains for gain in side.values())
        above = f", and (b) as difference to {' or '.join(dict.fromkeys(bases))} of the same sweep, paired by seed"
    return Drawing(
        "two_sweeps",
        "comparison",
        f"(a) Test acceleration accuracy, mean of the last {stats.LAST} epochs{above}. Filled: {keys[0]}. Hollow: "
        f"{keys[1]}. Bar: 95 % interval ({'; '.join(kinds)}).",
        f"Dot plot of two sweeps. Accuracy, first and second: {'; '.join(told)}.",
        figures.two_sweeps(pairs, keys, bases, _ends(first, second)),
    )


def _key(word: str, report: Report, name: str, most: int = 60) -> str:
    """Which sweep it is, with n; of a long name the end."""
    shown = name if len(name) <= most else f"\N{HORIZONTAL ELLIPSIS}{name[1 - most :]}"
    counts = " or ".join(map(str, sorted({row.accuracy.n for row in report.scores}))) or "0"
    units = "policies on one encoder" if report.sweep.design == "A" else "encoders"
    return f"{word}, {shown} (n = {counts} {units})"


def _ends(first: Report, second: Report) -> str:
    """Floor and ceiling in words, of both sweeps where they differ."""
    floors = [side.floor.get("accuracy") for side in (first, second)]
    tops = [side.ceiling and side.ceiling.mean for side in (first, second)]
    told = []
    for word, values in (("majority class", floors), (figures.CEILING_WORDS, tops)):
        shown = dict.fromkeys(f"{100 * value:.1f}" for value in values if isinstance(value, float))
        told += [f"{word} at {' and '.join(shown)} %"] if shown else []
    return "; ".join(["(a): axis cut", *told])


def _latents(record: SweepRecord, made: Numbers) -> list[Drawing]:
    """Latent maps of one encoder of each head set, at the largest fraction."""
    found = _first_results(record, made)
    maps = []
    for name, result in found.items():
        own = result.predictions
        places, shares = stats.principal(own["z"])
        speed = own.get("speed")
        if speed is None:
            return []
        maps.append((name, places, shares, speed, own["light"], own["steering_label"]))
    encoders = "one encoder each" if made["sweep"]["encoder_seeds"] == 1 else "the first encoder of each"
    count = len(maps[0][1]) if maps else 0
    return [
        Drawing(
            "latent_maps",
            "latents",
            f"Latents of the policy set's {count} test frames on their first two principal components (of z-scored "
            f"dimensions; {encoders}), coloured by the vehicle's speed, the light that governs and the expert's "
            "steering.",
            "Scatter plots of latents for each head set, coloured by speed in the first row, by light in the second "
            "and by steering in the third.",
            figures.latent_maps(maps),
        )
    ] * bool(maps)


def _first_results(record: SweepRecord, made: Numbers) -> dict[str, CellResult]:
    top = max(record.grid.fractions)
    return {name: results[0] for name in made["sweep"]["heads"] if (results := claims.results_at(record, (name, top)))}


def _pictures(record: SweepRecord, made: Numbers) -> list[Drawing]:
    """What the decoders of one encoder of each kind make of test frames."""
    found = _first_results(record, made)
    drawings = []
    if "rec" in found:
        samples = found["rec"].samples
        drawings.append(
            Drawing(
                "single_head_rec",
                "pictures",
                "Test frames (first row) and what the single-head autoencoder (rec) makes of them. The paper's "
                "fig:single_head_rec.",
                "Two rows of bird-view pictures: inputs, and their reconstructions by the single-head network.",
                figures.picture_rows([("input", samples["input"]), ("reconstruction", samples["rec_output"])]),
            )
        )
    if "full" in found:
        samples, rows = found["full"].samples, []
        for head, word in HEAD_WORDS.items():
            rows += [("input", samples["input"]), (word, samples[f"{head}_output"])]
            rows += [(f"{word} target", samples[f"{head}_target"])] if f"{head}_target" in samples else []
            rows.append(("", samples["input"]))
        drawings.append(
            Drawing(
                "multi_results",
                "pictures",
                "The same test frames through the multi-head network (full): for each head its input, its output and, "
                "for prediction (other agents over the next second) and planning (the ego vehicle over the next "
                "second), the target. The reconstruction's target is its input. The paper's fig:multi_results.",
                "Rows of bird-view pictures: inputs, reconstructions, predicted masks with their targets, planned "
                "masks with their targets, by the three-head network.",
                figures.picture_rows(rows[:-1]),
            )
        )
    if len(found) > 1:
        drawings.append(
            Drawing(
                "all_head_sets",
                "pictures",
                "The same test frames through the networks of all head sets, with targets. Brighter is more certain.",
                f"Rows of bird-view pictures: outputs of {', '.join(found)} for the same inputs, with their targets.",
                figures.picture_rows(_side_by_side(found)),
            )
        )
    return drawings


def _side_by_side(found: dict[str, CellResult]) -> list[tuple[str, NDArray[np.uint8]]]:
    """Rows of pictures: for each head its target, then the output of every head set that has it."""
    rows = [("input", next(iter(found.values())).samples["input"])]
    for head in HEAD_WORDS:
        owners = {name: result.samples for name, result in found.items() if f"{head}_output" in result.samples}
        targets = [samples[f"{head}_target"] for samples in owners.values() if f"{head}_target" in samples]
        if head != "rec" and owners:
            rows += [("", targets[0]), (f"{head} target", targets[0])]
        rows += [(f"{head} of {name}", samples[f"{head}_output"]) for name, samples in owners.items()]
    return rows
