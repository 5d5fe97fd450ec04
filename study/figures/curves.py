"""One function for each figure: numbers or pictures in, a matplotlib Figure out. No statistic is computed here.

Colours are those of Okabe and Ito (told apart by colour-blind readers), one for each head set everywhere; line styles
and markers differ too, so that a grey print is readable. Curves are labelled where they end.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal

import matplotlib as mpl
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from study.config.heads import HeadSet
from study.figures.style import FRACTION_COLOUR, FRACTION_MARKER, GREY, STYLE, literal, look, new_figure

STEERING, ACCURACY = "steering_loss", "acceleration_accuracy"
LEADER = {"arrowstyle": "-", "linewidth": 0.5, "shrinkA": 1, "shrinkB": 0, "relpos": (0, 0.5)}  # to a label's left
LATE = 0.05  # share of the epochs after which the axis of a curve shows everything


@mpl.rc_context(STYLE)
def compare_heads(
    steering: pd.DataFrame,
    accuracy: pd.DataFrame,
    steering_floor: float,
    accuracy_floor: float,
    split: str = "test",
    baselines: Mapping[str, pd.DataFrame] | None = None,
) -> Figure:
    """Draw steering loss and acceleration accuracy by epoch (fig:test_compare_heads, fig:train_compare_heads).

    All tables are those of `analysis.intervals.curve_bands` at one fraction: mean line, band of one standard deviation
    over seeds, darker band for the 95 % interval of the mean. `baselines`: for each metric the bands of baselines, of
    which the mean is drawn.
    """
    figure, panels = new_figure(2.7, columns=2)
    for axes, bands, scale in zip(panels, (steering, accuracy), (1000.0, 100.0), strict=True):
        ends = []
        for index, (name, rows) in enumerate(bands.groupby("heads", sort=False)):
            heads = look(str(name))
            ends.append(_curve(axes, rows, scale, heads.name, heads.colour, heads.line, heads.marker, index))
        if axes is panels[0]:
            axes.set_title(f"(a) Steering loss, {split}")
            _loss_axis(axes, bands, steering_floor)
            ends += _baselines(axes, (baselines or {}).get(STEERING), scale)
        else:
            others = (baselines or {}).get(ACCURACY)
            axes.set_title(f"(b) Acceleration accuracy, {split}")
            _accuracy_axis(axes, bands, accuracy_floor, others)
            ends += _baselines(axes, others, scale)
        _label_ends(axes, ends)
    return figure


@mpl.rc_context(STYLE)
def converge_speed(
    accuracy: pd.DataFrame,
    reference: str,
    reached: Mapping[float, float],
    accuracy_floor: float,
    baselines: pd.DataFrame | None = None,
) -> Figure:
    """Draw test accuracy by epoch: full at every fraction, the reference at the largest (fig:datasize_convergespeed).

    `accuracy`, `baselines`: `analysis.intervals.curve_bands`; `reached`: fraction -> epoch at which full's mean curve
    reaches the reference's final accuracy, infinite when never.
    """
    figure, (axes,) = new_figure(3.4)
    top = accuracy["fraction"].max()
    base = accuracy[(accuracy["heads"] == reference) & (accuracy["fraction"] == top)]
    others = accuracy[accuracy["heads"] == "full"]
    ends, colours = [], {}
    for index, (fraction, rows) in enumerate(others.groupby("fraction", sort=False)):
        colour, marker = (marks[index % len(marks)] for marks in (FRACTION_COLOUR, FRACTION_MARKER))
        ends.append(_curve(axes, rows, 100.0, f"full, {_percent(fraction)}", colour, "-", marker, index))
        colours[float(str(fraction))] = colour
    heads = look(reference)
    ends.append(_curve(axes, base, 100.0, f"{reference}, {_percent(top)}", heads.colour, "--", heads.marker, 0))
    _accuracy_axis(axes, pd.concat([others, base]), accuracy_floor, baselines)
    goal = 100 * float(base["mean"].iloc[-5:].mean())
    axes.axhline(goal, color=GREY, linewidth=0.6, linestyle=":")
    for fraction, colour in colours.items():
        epoch = reached.get(fraction, np.inf)
        if np.isfinite(epoch):
            axes.plot([epoch, epoch], [axes.get_ylim()[0], goal], color=colour, linewidth=0.6, linestyle=":")
    axes.set_ylabel("acceleration accuracy, test [%]")
    _label_ends(axes, ends + _baselines(axes, baselines, 100.0))
    return figure


End = tuple[float, str, str]  # of a curve: value, label, colour


def _curve(
    axes: Axes, rows: pd.DataFrame, scale: float, label: str, colour: str, line: str, marker: str, index: int
) -> End:
    """Draw mean line, band of one standard deviation and darker band for the interval of the mean; return the end."""
    epoch, mean, sd, low, high = (rows[name].to_numpy(np.float64) for name in ("epoch", "mean", "sd", "low", "high"))
    axes.fill_between(epoch, scale * (mean - sd), scale * (mean + sd), color=colour, alpha=0.15, linewidth=0)
    axes.fill_between(epoch, scale * low, scale * high, color=colour, alpha=0.3, linewidth=0)
    every = max(len(epoch) // 8, 1)
    axes.plot(epoch, scale * mean, line, color=colour, marker=marker, markevery=(index * every // 5, every))
    axes.set_xlim(0, 1.01 * epoch.max())
    axes.set_xlabel("policy epoch")
    return scale * float(mean[-1]), label, colour


def _settled(bands: pd.DataFrame) -> pd.DataFrame:
    """Return the curves without the first epochs, which would press everything else together."""
    late: pd.DataFrame = bands[bands["epoch"] > LATE * bands["epoch"].max()]
    return late


def _loss_axis(axes: Axes, bands: pd.DataFrame, floor: float) -> None:
    """Begin the axis at 0; show the best constant command's loss as a line, or in words where it is far above."""
    part, floor = _settled(bands), 1000 * floor
    high = 1.15 * 1000 * float((part["mean"] + part["sd"].fillna(0)).max())
    axes.set_ylim(0, high)
    axes.set_ylabel("smooth L1 loss [$10^{-3}$]")
    _floor(axes, floor, "best constant ", "" if floor <= high else f"best constant command, above: {floor:.2f}", "top")


def _baselines(axes: Axes, bands: pd.DataFrame | None, scale: float) -> list[End]:
    """Draw the mean curves of baselines, thin and without bands, and return the labels of those that end in sight."""
    ends: list[End] = []
    low, high = axes.get_ylim()
    for name, rows in () if bands is None else bands.groupby("heads", sort=False):
        shown, last = look(str(name)), scale * float(rows["mean"].iloc[-1])
        axes.plot(rows["epoch"], scale * rows["mean"], shown.line, color=shown.colour, linewidth=0.8)
        ends += [(last, shown.word, shown.colour)] if low <= last <= high else []
    axes.set_ylim(low, high)
    return ends


def _accuracy_axis(axes: Axes, bands: pd.DataFrame, floor: float, baselines: pd.DataFrame | None) -> None:
    """Cut the axis below the curves, and say so: the majority class's accuracy is named where it is not in sight.

    It shows where the curves of the baselines end.
    """
    part, floor = _settled(bands), 100 * floor
    ends = [] if baselines is None else baselines.groupby("heads")["mean"].last().tolist()
    low = 100 * min([float((part["mean"] - part["sd"].fillna(0)).min()), *ends])
    high = 100 * max([float((part["mean"] + part["sd"].fillna(0)).max()), *ends])
    pad = 0.06 * (high - low)
    low, high = max(low - 2 * pad, 0), min(high + pad, 100)
    axes.set_ylim(low, high)
    axes.set_ylabel("accuracy [%]")
    _floor(
        axes, floor, "majority class ", "" if floor >= low else f"axis cut; majority class at {floor:.1f} %", "bottom"
    )


def _floor(axes: Axes, floor: float, name: str, note: str, side: Literal["top", "bottom"]) -> None:
    """Draw a floor as a line with its name or, where it is out of sight, write the note on that side."""
    words: dict[str, Any] = {"color": GREY, "fontsize": 6.5, "ha": "right"}
    if note:
        axes.text(0.98, 0.97 if side == "top" else 0.03, note, transform=axes.transAxes, va=side, **words)
    else:
        axes.axhline(floor, color=GREY, linewidth=0.6, linestyle=":")
        axes.text(axes.get_xlim()[1], floor, name, va="bottom", **words)


def _label_ends(axes: Axes, ends: Sequence[End]) -> None:
    """Write the labels at the right ends of their curves, moved apart where they would touch."""
    low, high = axes.get_ylim()
    gap = 0.14 / (axes.get_figure().get_figheight() - 0.6)  # type: ignore[union-attr]
    ordered = sorted(ends)
    wanted = [(value - low) / (high - low) for value, _, _ in ordered]
    places = list(wanted)
    for _ in range(200):
        for index in range(len(places) - 1):
            lack = gap - (places[index + 1] - places[index])
            if lack > 0:
                places[index] -= lack / 2
                places[index + 1] += lack / 2
        places = [min(max(place, 0.02), 1.02) for place in places]
    for (value, text, colour), place in zip(ordered, places, strict=True):
        axes.annotate(
            text,
            (axes.get_xlim()[1], value),
            (1.06, place),
            textcoords="axes fraction",
            color=colour,
            va="center",
            fontsize=7,
            annotation_clip=False,
            arrowprops={**LEADER, "color": colour},
        )


def _percent(fraction: object) -> str:
    return f"{float(str(fraction)) * 100:g} %"


@mpl.rc_context(STYLE)
def encoder_losses(lines: Sequence[tuple[str, str, float, pd.Series]], constants: Mapping[str, float]) -> Figure:
    """Draw what is left to reduce of each head's loss by epoch, one panel for each head.

    `lines`: head, head set, data fraction and values by epoch; the largest fraction is drawn in full colour.
    `constants`: what a constant picture leaves of each head's loss.
    """
    figure, panels = new_figure(2.3, columns=len(constants))
    top, several = max(line[2] for line in lines), len({line[2] for line in lines}) > 1
    labelled: dict[str, Any] = {}
    for axes, (head, constant) in zip(panels, constants.items(), strict=True):
        for _, name, fraction, values in (line for line in lines if line[0] == head):
            heads, pale = look(name), fraction < top
            label = f"{heads.name}, {_percent(fraction)}" if several else heads.name
            (labelled[label],) = axes.plot(
                values.index,
                values,
                heads.line,
                color=heads.colour,
                marker=heads.marker,
                alpha=0.45 if pale else 1,
                markevery=max(len(values) // 8, 1),
            )
        axes.locator_params(axis="x", integer=True)
        axes.axhline(constant, color=GREY, linewidth=0.8, linestyle="--")
        axes.set(yscale="log", title=literal(head), xlabel="encoder epoch")
    panels[0].set_ylabel("loss to reduce, test")
    figure.legend(
        labelled.values(), map(literal, labelled), loc="outside lower center", ncols=min(len(labelled), 4), fontsize=7
    )
    return figure


@mpl.rc_context(STYLE)
def compare_fractions(
    scores: pd.DataFrame, steering_floor: float, accuracy_floor: float, baselines: pd.DataFrame | None = None
) -> Figure:
    """Draw the mean of the last five epochs by data fraction (fig:datasize_compare).

    `scores`: one row for each cell and metric, columns metric (steering_loss, acceleration_accuracy), heads, fraction,
    mean, sd, low, high. Thin bar: one standard deviation over seeds; thick bar: 95 % interval of the mean. `baselines`:
    rows with metric, heads and mean, drawn as lines, since they do not depend on the fraction.
    """
    figure, panels = new_figure(2.7, columns=2)
    metrics = (STEERING, ACCURACY)
    for axes, metric, scale in zip(panels, metrics, (1000.0, 100.0), strict=True):
        shown, ends = scores[scores["metric"] == metric], []
        for index, (name, rows) in enumerate(shown.groupby("heads", sort=False)):
            heads, points = look(str(name)), rows.sort_values("fraction")
            ends.append((scale * float(points["mean"].iloc[-1]), heads.name, heads.colour))
            _bars(axes, points, scale, heads, shift=1 + 0.03 * index)
        levels = None if baselines is None else baselines[baselines["metric"] == metric]
        ticks = sorted(shown["fraction"].unique())
        axes.set(xscale="log", xlabel="share of the encoder's training data [%]")
        axes.set_xticks(ticks, [f"{100 * tick:g}" for tick in ticks])
        axes.set_xticks([], minor=True)
        axes.set_xlim(ticks[0] / 1.2, ticks[-1] * 1.2)
        if axes is panels[0]:
            axes.set_title("(a) Steering loss, test")
            _loss_axis(axes, shown.assign(epoch=1), steering_floor)
        else:
            axes.set_title("(b) Acceleration accuracy, test")
            _accuracy_axis(axes, shown.assign(epoch=1), accuracy_floor, levels)
        if levels is not None:
            across = pd.concat([levels.assign(epoch=x) for x in axes.get_xlim()])
            ends += _baselines(axes, across, scale)
        _label_ends(axes, ends)
    return figure


def _bars(axes: Axes, rows: pd.DataFrame, scale: float, heads: HeadSet, shift: float) -> None:
    x, mean, sd, low, high = (rows[name].to_numpy(np.float64) for name in ("fraction", "mean", "sd", "low", "high"))
    axes.plot(x * shift, scale * mean, heads.line, color=heads.colour, marker=heads.marker)
    axes.vlines(x * shift, scale * (mean - sd), scale * (mean + sd), color=heads.colour, linewidth=0.7)
    axes.vlines(x * shift, scale * low, scale * high, color=heads.colour, linewidth=2.2, alpha=0.6)
