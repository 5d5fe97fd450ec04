"""One function for each figure: numbers or pictures in, a matplotlib Figure out. No statistic is computed here.

Colours are those of Okabe and Ito (told apart by colour-blind readers), one for each head set everywhere; line styles
and markers differ too, so that a grey print is readable. Curves are labelled where they end.
"""

from __future__ import annotations

import io
import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import matplotlib as mpl
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from study.config import ACCELERATIONS

COLOUR = {"rec": "#000000", "rec+pred": "#E69F00", "rec+plan": "#0072B2", "full": "#D55E00"}
LINE = {"rec": "-", "rec+pred": "-.", "rec+plan": "--", "full": "-"}
MARKER = {"rec": "o", "rec+pred": "^", "rec+plan": "s", "full": "D"}
FRACTION_COLOUR = ("#D55E00", "#E69F00", "#009E73", "#56B4E9", "#CC79A7")
FRACTION_MARKER = ("D", "^", "s", "v", "P")
LIGHT_COLOUR, LIGHT_WORDS = ("#BBBBBB", "#E69F00", "#D55E00"), ("green or none", "yellow", "red")
SIDES = (("o", None), ("D", "white"))  # marker and fill of the first of two sweeps, and of the second
GREY = "#666666"
CEILING_LINE, CEILING_WORDS = ":", "true state"
WIDTH = 6.4  # [in], the report's text width
LATE = 0.05  # share of the epochs after which the axis of a curve shows everything
STYLE: dict[Any, Any] = {
    "font.size": 7.5,
    "font.family": "DejaVu Sans",  # comes with matplotlib, so every machine draws the same
    "axes.titlesize": 8,
    "axes.titlelocation": "left",
    "axes.labelsize": 7.5,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.linewidth": 0.6,
    "axes.edgecolor": "#444444",
    "xtick.labelsize": 7,
    "ytick.labelsize": 7,
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "legend.frameon": False,
    "lines.linewidth": 1.2,
    "lines.markersize": 3.2,
    "svg.hashsalt": "study",
    "svg.fonttype": "path",
    "figure.dpi": 100,
}
METADATA: dict[str, dict[str, None]] = {  # of each format, what would say when and by what it was written
    "svg": {"Date": None, "Creator": None},
    "png": {"Software": None},
    "pdf": {"CreationDate": None, "Creator": None, "Producer": None},
}


@dataclass(frozen=True)
class Drawing:
    """A figure: its file name, where it belongs in the report, what it shows, and the same in words."""

    name: str
    place: str
    caption: str
    alt: str
    figure: Figure


def save(figure: Figure, folder: Path, name: str) -> tuple[Path, Path]:
    """Write a figure as `name.svg` and `name.png`."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = folder / f"{name}.svg", folder / f"{name}.png"
    for path in paths:
        write(figure, path)
    return paths


def write(figure: Figure, path: Path) -> None:
    """Write a figure whole, in the format of its ending (METADATA; 200 dots per inch), the same bytes each time."""
    kind, stream = path.suffix[1:].lower(), io.BytesIO()
    with mpl.rc_context(STYLE):
        figure.savefig(stream, format=kind, dpi=200, metadata=METADATA[kind])
    draft = path.with_name(f".{path.name}")
    draft.write_bytes(stream.getvalue())
    draft.replace(path)


def _figure(height: float, columns: int = 1, rows: int = 1) -> tuple[Figure, list[Axes]]:
    figure = Figure(figsize=(WIDTH, height), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False)
    return figure, list(axes.flat)


# --- curves ---------------------------------------------------------------------------------------------------------


@mpl.rc_context(STYLE)
def compare_heads(
    steering: pd.DataFrame,
    accuracy: pd.DataFrame,
    steering_floor: float,
    accuracy_floor: float,
    split: str = "test",
    ceiling: pd.DataFrame | None = None,
) -> Figure:
    """Draw steering loss and acceleration accuracy by epoch (fig:test_compare_heads, fig:train_compare_heads).

    All tables are those of `study.stats.curve_bands` at one fraction: mean line, band of one standard deviation over
    seeds, darker band for the 95 % interval of the mean. `ceiling`: accuracy of policies on the true state.
    """
    figure, panels = _figure(2.6, columns=2)
    for axes, bands, scale in zip(panels, (steering, accuracy), (1000.0, 100.0), strict=True):
        ends = []
        for index, (name, rows) in enumerate(bands.groupby("heads", sort=False)):
            heads = str(name)
            ends.append(_curve(axes, rows, scale, heads, COLOUR[heads], LINE[heads], MARKER[heads], index))
        if axes is panels[0]:
            axes.set_title(f"(a) Steering loss, {split}")
            _loss_axis(axes, bands, steering_floor)
        else:
            axes.set_title(f"(b) Acceleration accuracy, {split}")
            _accuracy_axis(axes, bands, accuracy_floor, _top(ceiling))
            ends += _ceiling(axes, ceiling)
        _label_ends(axes, ends)
    return figure


@mpl.rc_context(STYLE)
def converge_speed(
    accuracy: pd.DataFrame,
    baseline: str,
    reached: Mapping[float, float],
    accuracy_floor: float,
    ceiling: pd.DataFrame | None = None,
) -> Figure:
    """Draw test accuracy by epoch: full at every fraction, the baseline at the largest (fig:datasize_convergespeed).

    `accuracy`, `ceiling`: `study.stats.curve_bands`; `reached`: fraction -> epoch at which full's mean curve reaches
    the baseline's final accuracy, infinite when never.
    """
    figure, (axes,) = _figure(3.4)
    top = accuracy["fraction"].max()
    base = accuracy[(accuracy["heads"] == baseline) & (accuracy["fraction"] == top)]
    others = accuracy[accuracy["heads"] == "full"]
    ends, colours = [], {}
    for index, (fraction, rows) in enumerate(others.groupby("fraction", sort=False)):
        colour, marker = (marks[index % len(marks)] for marks in (FRACTION_COLOUR, FRACTION_MARKER))
        ends.append(_curve(axes, rows, 100.0, f"full, {_percent(fraction)}", colour, "-", marker, index))
        colours[float(str(fraction))] = colour
    words = f"{baseline}, {_percent(top)}"
    ends.append(_curve(axes, base, 100.0, words, COLOUR[baseline], "--", MARKER[baseline], 0))
    _accuracy_axis(axes, pd.concat([others, base]), accuracy_floor, _top(ceiling))
    goal = 100 * float(base["mean"].iloc[-5:].mean())
    axes.axhline(goal, color=GREY, linewidth=0.6, linestyle=":")
    for fraction, colour in colours.items():
        epoch = reached.get(fraction, np.inf)
        if np.isfinite(epoch):
            axes.plot([epoch, epoch], [axes.get_ylim()[0], goal], color=colour, linewidth=0.6, linestyle=":")
    axes.set_ylabel("acceleration accuracy, test [%]")
    _label_ends(axes, ends + _ceiling(axes, ceiling))
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


def _top(ceiling: pd.DataFrame | None) -> float:
    return 0.0 if ceiling is None else float(ceiling["mean"].max())


def _ceiling(axes: Axes, bands: pd.DataFrame | None) -> list[End]:
    """Draw the curve of the true state, without a band, and return the label for its end."""
    if bands is None:
        return []
    axes.plot(bands["epoch"], 100 * bands["mean"], CEILING_LINE, color=GREY, linewidth=0.8)
    return [(100 * float(bands["mean"].iloc[-1]), CEILING_WORDS, GREY)]


def _accuracy_axis(axes: Axes, bands: pd.DataFrame, floor: float, top: float) -> None:
    """Cut the axis below the curves, and say so: the majority class's accuracy is named where it is not in sight.

    It reaches up to `top`, the ceiling, at least.
    """
    part, floor = _settled(bands), 100 * floor
    low = 100 * float((part["mean"] - part["sd"].fillna(0)).min())
    high = 100 * max(float((part["mean"] + part["sd"].fillna(0)).max()), top)
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
    for _ in range(100):
        for index in range(len(places) - 1):
            lack = gap - (places[index + 1] - places[index])
            if lack > 0:
                places[index] -= lack / 2
                places[index + 1] += lack / 2
    lift = max(0.02 - places[0], 0) + min(1.02 - places[-1], 0) if places else 0
    for (value, text, colour), place in zip(ordered, places, strict=True):
        axes.annotate(
            text,
            (axes.get_xlim()[1], value),
            (1.05, place + lift),
            textcoords="axes fraction",
            color=colour,
            va="center",
            fontsize=7,
            annotation_clip=False,
            arrowprops={"arrowstyle": "-", "color": colour, "linewidth": 0.5, "shrinkA": 1, "shrinkB": 0},
        )


def _percent(fraction: object) -> str:
    return f"{float(str(fraction)) * 100:g} %"


# --- by data fraction -----------------------------------------------------------------------------------------------


@mpl.rc_context(STYLE)
def compare_fractions(
    scores: pd.DataFrame, steering_floor: float, accuracy_floor: float, ceiling: float | None = None
) -> Figure:
    """Draw the mean of the last five epochs by data fraction (fig:datasize_compare).

    `scores`: one row for each cell and metric, columns metric (steering_loss, acceleration_accuracy), heads, fraction,
    mean, sd, low, high. Thin bar: one standard deviation over seeds; thick bar: 95 % interval of the mean. `ceiling`:
    accuracy of policies on the true state.
    """
    figure, panels = _figure(2.6, columns=2)
    metrics = ("steering_loss", "acceleration_accuracy")
    for axes, metric, scale in zip(panels, metrics, (1000.0, 100.0), strict=True):
        own, ends = scores[scores["metric"] == metric], []
        for index, (name, rows) in enumerate(own.groupby("heads", sort=False)):
            heads, points = str(name), rows.sort_values("fraction")
            ends.append((scale * float(points["mean"].iloc[-1]), heads, COLOUR[heads]))
            _bars(axes, points, scale, heads, shift=1 + 0.03 * index)
        ticks = sorted(own["fraction"].unique())
        axes.set(xscale="log", xlabel="share of the encoder's training data [%]")
        axes.set_xticks(ticks, [f"{100 * tick:g}" for tick in ticks])
        axes.set_xticks([], minor=True)
        axes.set_xlim(ticks[0] / 1.2, ticks[-1] * 1.2)
        if axes is panels[0]:
            axes.set_title("(a) Steering loss, test")
            _loss_axis(axes, own.assign(epoch=1), steering_floor)
        else:
            axes.set_title("(b) Acceleration accuracy, test")
            _accuracy_axis(axes, own.assign(epoch=1), accuracy_floor, ceiling or 0.0)
            if ceiling:
                axes.axhline(100 * ceiling, color=GREY, linewidth=0.8, linestyle=CEILING_LINE)
                ends.append((100 * ceiling, CEILING_WORDS, GREY))
        _label_ends(axes, ends)
    return figure


def _bars(axes: Axes, rows: pd.DataFrame, scale: float, heads: str, shift: float) -> None:
    x, mean, sd, low, high = (rows[name].to_numpy(np.float64) for name in ("fraction", "mean", "sd", "low", "high"))
    colour = COLOUR[heads]
    axes.plot(x * shift, scale * mean, LINE[heads], color=colour, marker=MARKER[heads])
    axes.vlines(x * shift, scale * (mean - sd), scale * (mean + sd), color=colour, linewidth=0.7)
    axes.vlines(x * shift, scale * low, scale * high, color=colour, linewidth=2.2, alpha=0.6)


# --- differences ----------------------------------------------------------------------------------------------------


@mpl.rc_context(STYLE)
def differences(rows: Sequence[Mapping[str, float | str]], allowance: float) -> Figure:
    """Draw paired differences in accuracy [points]: thick bar 95 % interval, thin bar simultaneous interval.

    Each row has name, value, low, high, low_all, high_all (shares, not points). The grey zone is the allowance for
    other encoders, 0 for none.
    """
    figure, (axes,) = _figure(0.7 + 0.24 * len(rows))
    axes.axvspan(-100 * allowance, 100 * allowance, color=GREY, alpha=0.15, linewidth=0)
    value, low, high, least, most = _columns(rows, ("value", "low", "high", "low_all", "high_all"))
    places = np.arange(len(rows))
    axes.hlines(places, least, most, color=COLOUR["rec+plan"], linewidth=0.8)
    axes.hlines(places, low, high, color=COLOUR["rec+plan"], linewidth=2.6)
    axes.plot(value, places, "o", color=COLOUR["rec"], markersize=3.5)
    _difference_axes(axes, [str(row["name"]) for row in rows], (len(rows) - 0.4, -0.6))
    return figure


def _columns(rows: Sequence[Mapping[str, Any]], names: Sequence[str]) -> list[NDArray[np.float64]]:
    """Return columns of rows, shares as points."""
    return [100 * np.array([row[name] for row in rows], np.float64) for name in names]


def _difference_axes(axes: Axes, names: Sequence[str], limits: tuple[float, float]) -> None:
    """Name the rows, from the top down, and mark no difference."""
    axes.axvline(0, color=GREY, linewidth=0.6, zorder=1)
    axes.set_yticks(range(len(names)), names)
    axes.set(ylim=limits, xlabel="difference in acceleration accuracy, test [percentage points]")
    _without_left_side(axes)


def _without_left_side(axes: Axes) -> None:
    axes.spines["left"].set_visible(False)
    axes.tick_params(axis="y", length=0)


@mpl.rc_context(STYLE)
def by_encoder(scores: Mapping[str, Sequence[NDArray[np.float64]]]) -> Figure:
    """Draw the final accuracy of every policy, encoder by encoder, and the means of encoders and head sets.

    `scores`: for each head set, and each of its encoders, the scores of its policies.
    """
    figure, (axes,) = _figure(2.6)
    place, ticks = 0, []
    for heads, encoders in scores.items():
        first = place
        for policies in encoders:
            axes.plot([place] * len(policies), 100 * policies, MARKER[heads], color=COLOUR[heads], alpha=0.5)
            middle = 100 * float(policies.mean())
            axes.hlines(middle, place - 0.35, place + 0.35, color=COLOUR[heads], linewidth=1.4)
            place += 1
        whole = 100 * float(np.mean([policies.mean() for policies in encoders]))
        axes.hlines(whole, first - 0.5, place - 0.5, color=GREY, linewidth=0.7, linestyle="--")
        ticks.append(((first + place - 1) / 2, heads))
        place += 1
    axes.set_xticks([tick for tick, _ in ticks], [f"{heads}\n(each column an encoder)" for _, heads in ticks])
    axes.tick_params(axis="x", length=0)
    axes.set_ylabel("acceleration accuracy, test [%]")
    return figure


@mpl.rc_context(STYLE)
def confusions(tables: Sequence[tuple[str, NDArray[np.float64]]]) -> Figure:
    """Draw confusion matrices side by side: a name, and the share [3, 3] of each true class given each class."""
    names = [f"{value:g}" for value in ACCELERATIONS]
    figure, panels = _figure(1.9, columns=len(tables))
    for panel, (name, table) in zip(panels, tables, strict=True):
        panel.imshow(table, cmap="Greys", vmin=0, vmax=1)
        for row, column in np.ndindex(*table.shape):
            share = float(table[row, column])
            colour = "white" if share > 0.5 else "black"
            panel.text(column, row, f"{100 * share:.1f}", ha="center", va="center", color=colour, fontsize=7)
        panel.set_xticks(range(len(names)), names)
        panel.set_yticks(range(len(names)), names)
        panel.set(xlabel="given", title=name)
    panels[0].set_ylabel("true throttle \N{MINUS SIGN} brake")
    return figure


@mpl.rc_context(STYLE)
def both_values(rows: Sequence[Mapping[str, Any]], setting: str, values: tuple[str, str]) -> Figure:
    """Draw differences in accuracy [points] under two values of a setting, with their intervals.

    Each row has name, and here and there with value, low, high (shares, not points).
    """
    figure, (axes,) = _figure(0.75 + 0.34 * len(rows))
    colours = COLOUR["rec"], COLOUR["full"]
    for side, value, shift, colour, (marker, fill) in zip(
        ("here", "there"), values, (-0.14, 0.14), colours, SIDES, strict=True
    ):
        middle, low, high = _columns([row[side] for row in rows], ("value", "low", "high"))
        places = np.arange(len(rows)) + shift
        axes.hlines(places, low, high, color=colour, linewidth=1.4)
        style: dict[str, Any] = {"color": colour, "markerfacecolor": fill or colour, "markersize": 4}
        axes.plot(middle, places, marker, linestyle="none", label=f"{setting} {value}", **style)
    _difference_axes(axes, [str(row["name"]) for row in rows], (len(rows) - 0.5, -0.5))
    figure.legend(loc="outside upper right", ncols=2)
    return figure


Range = tuple[float, float | None, float | None]  # a value and the ends of its interval, as shares


@dataclass(frozen=True)
class Pair:
    """A head set and fraction in two sweeps: None where a sweep has none, or no difference, as the baseline."""

    label: str
    heads: str
    fraction: float
    scores: tuple[Range | None, Range | None]
    differences: tuple[Range | None, Range | None]


@mpl.rc_context(STYLE)
def two_sweeps(rows: Sequence[Pair], names: tuple[str, str], baselines: tuple[str, str], note: str) -> Figure:
    """Draw the final accuracy [%] of two sweeps, row by row, beside the differences to each one's baseline [points].

    `names`: what the key says of each sweep; `note`: a line below. Bars are the intervals given. Without any difference
    there is one panel.
    """
    fractions = [row.fraction for row in rows]
    places = np.cumsum([0.0, *(1.0 if one == other else 1.5 for one, other in itertools.pairwise(fractions))])
    both = any(row.differences != (None, None) for row in rows)
    figure, panels = _figure(1.7 + 0.3 * float(places[-1]), columns=1 + both)
    for axes, part, spec in zip(panels, ("scores", "differences"), (".1f", "+.2f"), strict=False):
        for place, row in zip(places, rows, strict=True):
            axes.axhline(place, color=GREY, alpha=0.25, linewidth=0.4, zorder=0)
            shift = 0.0 if None in row.scores else 0.2
            for found, mark, y in zip(getattr(row, part), SIDES, (place - shift, place + shift), strict=True):
                _dot(axes, found, y, COLOUR.get(row.heads, GREY), mark, spec)
        axes.set_yticks(places, [literal(row.label) for row in rows] if part == "scores" else [""] * len(rows))
        axes.set_ylim(places[-1] + 0.6, -0.6)
        _without_left_side(axes)
        axes.margins(x=0.12)
    panels[0].set_title("(a) Final acceleration accuracy, test")
    panels[0].set_xlabel("accuracy [%]")
    for axes in panels[1:]:
        axes.axvline(0, color=GREY, linewidth=0.6)
        axes.set_title(f"(b) Difference to {literal(' or '.join(dict.fromkeys(baselines)))}")
        axes.set_xlabel("difference in accuracy [percentage points]")
    keys = [
        Line2D([], [], color=COLOUR["rec"], marker=marker, markerfacecolor=fill or COLOUR["rec"], markersize=4)
        for marker, fill in SIDES
    ]
    figure.legend(keys, [literal(name) for name in names], loc="outside upper left")
    figure.supxlabel(note, x=0.01, ha="left", fontsize=6.5, color=GREY)
    return figure


def _dot(axes: Axes, found: Range | None, y: float, colour: str, mark: tuple[str, str | None], spec: str) -> None:
    """Draw a value with its interval, and its number beside it."""
    if found is None:
        return
    value, low, high = (math.nan if end is None else 100 * end for end in found)
    axes.hlines(y, low, high, color=colour, linewidth=1.4)
    axes.plot([value], [y], mark[0], color=colour, markerfacecolor=mark[1] or colour, markersize=3.6)
    text, end = format(value, spec), value if math.isnan(high) else high
    text = text.replace("-", "\N{MINUS SIGN}") if float(text) else text.lstrip("+-")
    axes.annotate(
        text,
        (end, y),
        (5, 0),
        textcoords="offset points",
        color=GREY,
        va="center",
        fontsize=6,
        bbox={"facecolor": "white", "edgecolor": "none", "pad": 0.8},  # above the row's line
    )


def literal(text: str) -> str:
    """Return words from outside, which matplotlib would else read as formulas."""
    return text.replace("$", r"\$")


# --- latents --------------------------------------------------------------------------------------------------------

Map = tuple[str, NDArray[np.float64], NDArray[np.float64], NDArray[np.float32], NDArray[np.uint8], NDArray[np.float32]]


@mpl.rc_context(STYLE)
def latent_maps(maps: Sequence[Map], most: int = 1500) -> Figure:
    """Draw three rows of scatter plots, one column for each head set: by speed, by light, and by steering.

    Each map is a name, places [N, 2], their shares of the variance [2], speed [N] [m/s], light [N] and steering [N];
    at most `most` evenly spread frames are drawn.
    """
    figure, axes = _figure(4.6, columns=len(maps), rows=3)
    dots: dict[str, Any] = {"s": 3, "linewidths": 0, "rasterized": True}
    for column, (name, places, shares, speed, light, steering) in enumerate(maps):
        every = max(len(places) // most, 1)
        x, y = places[::every].T
        above, middle, below = axes[column :: len(maps)]
        fast = above.scatter(x, y, c=speed[::every], cmap="cividis", vmin=0, **dots)
        for index, (word, colour) in enumerate(zip(LIGHT_WORDS, LIGHT_COLOUR, strict=True)):
            here = light[::every] == index
            middle.scatter(x[here], y[here], color=colour, label=word, **dots)
        turn = below.scatter(x, y, c=steering[::every], cmap="RdYlBu", vmin=-0.2, vmax=0.2, **dots)
        above.set_title(name)
        below.set_xlabel(f"{100 * shares[0]:.0f} + {100 * shares[1]:.0f} % of variance", fontsize=6.5)
    for panel in axes:
        panel.set(xticks=[], yticks=[])
    for panel, word in zip(axes[:: len(maps)], ("speed", "light", "steering"), strict=True):
        panel.set_ylabel(f"by {word}")
    figure.colorbar(fast, ax=axes[len(maps) - 1], label="speed [m/s]")
    figure.colorbar(turn, ax=axes[-1], label="steering, left above 0")
    right = axes[2 * len(maps) - 1]
    right.legend(
        title="light", loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize=6.5, title_fontsize=6.5, markerscale=2.5
    )
    return figure


# --- pictures -------------------------------------------------------------------------------------------------------

Rows = Sequence[tuple[str, NDArray[np.uint8]]]


@mpl.rc_context(STYLE)
def picture_rows(rows: Rows, columns: int = 10) -> Figure:
    """Draw rows of test pictures with their names (fig:single_head_rec, fig:multi_results).

    Each row is a name and pictures [K, 64, 64, 3] or [K, 64, 64] uint8; an empty name is a gap.
    """
    shown = [(name, pictures[:columns]) for name, pictures in rows]
    columns = max(len(pictures) for _, pictures in shown)
    names, space = 1.15, 0.12  # [in]
    side = (WIDTH - names) / columns
    spaces = sum(name == "" for name, _ in shown)
    height = side * (len(shown) - spaces) + space * spaces
    figure = Figure(figsize=(WIDTH, height))
    top = height
    for name, pictures in shown:
        if name == "":
            top -= space
            continue
        figure.text(0, (top - side / 2) / height, name, va="center", fontsize=7.5)
        top -= side
        _strip(figure, (names / WIDTH, top / height, side * len(pictures) / WIDTH, side / height), pictures)
    return figure


def _strip(figure: Figure, place: tuple[float, float, float, float], pictures: NDArray[np.uint8]) -> None:
    """Draw pictures side by side as one image, much faster than many; enlarged, as viewers blur small ones."""
    colour = pictures if pictures.ndim == 4 else np.repeat(pictures[..., None], 3, axis=3)
    colour = colour.repeat(3, axis=1).repeat(3, axis=2)
    framed = np.pad(colour, ((0, 0), (0, 8), (0, 8), (0, 0)), constant_values=255)
    axes = figure.add_axes(place, frame_on=False)
    axes.imshow(np.concatenate(list(framed), axis=1), interpolation="none", aspect="auto")
    axes.set_axis_off()


# --- data -----------------------------------------------------------------------------------------------------------

SET_COLOUR = {"encoder": "#0072B2", "policy": "#D55E00"}
SPLIT_COLOUR = {"episode": "#009E73", "frame": "#CC79A7"}
SPLIT_LINE = {"episode": "-", "frame": "--"}


@mpl.rc_context(STYLE)
def data_card(card: Mapping[str, Any]) -> Figure:
    """Draw the numbers of `study.card.make_card` in six panels: labels before and after selection, traffic, twins."""
    sets = card["sets"]
    figure, panels = _figure(4.9, columns=3, rows=2)
    edges = sets["policy"]["chosen"]["all"]["steering_edges"]
    names = [f"< {edges[0]:g}", *(f"to {edge:g}" for edge in edges[1:]), f"> {edges[-1]:g}"]
    _shares(panels[0], "(a) Steering", sets, lambda part: part["steering"], names)
    panels[0].tick_params(axis="x", rotation=55)
    _shares(
        panels[1], "(b) Command", sets, lambda part: part["acceleration"], [f"{value:g}" for value in ACCELERATIONS]
    )
    lights = ["yellow", "red", "standing"]
    _shares(panels[2], "(c) Lights, standing", sets, lambda part: [*part["light"][1:], part["standing"]], lights)
    panels[0].set_ylabel("share of frames [%]")
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=4)
    _in_view(panels[3], sets)
    for panel, (letter, name) in zip(panels[4:], (("e", "encoder"), ("f", "policy")), strict=True):
        twins = sets[name]["twins"]
        _distances(panel, twins, f"({letter}) Twins, {name} set, n = {twins['frame']['asked']:,}")
    panels[4].set_ylabel("test frames with a nearer one [%]")
    figure.suptitle(_headline(card), x=0.01, ha="left", fontsize=7.5)
    return figure


def _headline(card: Mapping[str, Any]) -> str:
    drives = card["drives"]
    frames = " + ".join(f"{entry['frames']:,} {name}" for name, entry in card["sets"].items())
    first = f"{frames} frames of {drives['used']} drives, split by {card['split']} (store {card['key']})"
    if "towns" not in drives:
        return first
    return (
        f"{first}\n{drives['towns']} towns, {drives['hours']:.2f} h of traffic, {drives['vehicles']:,} vehicles, "
        f"{drives['vehicle_hours']:.1f} vehicle hours, {drives['vehicle_km']:,.0f} vehicle km"
    )


def _shares(
    axes: Axes,
    title: str,
    sets: Mapping[str, Any],
    counts: Callable[[Mapping[str, Any]], Sequence[int]],
    names: Sequence[str],
) -> None:
    """Draw bars side by side, for each set outlined before selection and filled after."""
    wide, shift = 0.8 / (2 * len(sets)), -(len(sets) - 0.5)
    for name, entry in sets.items():
        for state, part in (("candidates", entry["candidates"]), ("chosen", entry["chosen"]["all"])):
            axes.bar(
                np.arange(len(names)) + shift * wide,
                100 * np.array(counts(part)) / max(part["frames"], 1),
                0.9 * wide,
                label=f"{name}, {state}",
                facecolor=SET_COLOUR[name] if state == "chosen" else "none",
                edgecolor=SET_COLOUR[name],
                linewidth=0.6,
            )
            shift += 1
    axes.set_xticks(range(len(names)), names)
    axes.set_title(title)


def _in_view(axes: Axes, sets: Mapping[str, Any]) -> None:
    for name, entry in sets.items():
        seen = entry["agents_in_view"]
        if seen["frames"]:
            label = f"{name} (n = {seen['frames']:,})"
            shares = 100 * np.array(seen["counts"]) / seen["frames"]
            axes.plot(range(len(shares)), shares, color=SET_COLOUR[name], marker="o", label=label)
            axes.legend(fontsize=6, handlelength=1.5)
    axes.set_ylim(0, 1.25 * axes.get_ylim()[1])
    axes.set(title="(d) Other vehicles in view", xlabel="vehicles", ylabel="share of frames [%]")


def _distances(axes: Axes, twins: Mapping[str, Any], title: str) -> None:
    for name, colour in SPLIT_COLOUR.items():
        if name not in twins:  # frames of a single drive
            continue
        within = 100 * np.array(twins[name]["within"])
        axes.plot(range(len(within)), within, SPLIT_LINE[name], color=colour, label=f"split: {name}")
    xlabel = "distance to nearest training frame\n[rms grey levels of 255]"
    axes.set(ylim=(0, 100), xlim=(0, len(twins["frame"]["within"]) - 1), title=title, xlabel=xlabel)
    axes.legend(fontsize=6, handlelength=2.2, loc="lower right")


@mpl.rc_context(STYLE)
def contact_sheet(sets: Mapping[str, Sequence[tuple[str, NDArray[np.uint8]]]], columns: int = 3) -> Figure:
    """Draw frames of each set as strips of input, pred and plan, [3, 64, 64, 3] uint8 each, with a text below."""
    side, words, head = WIDTH / columns / 3.15, 0.27, 0.3  # [in]
    lines = {name: -(-len(frames) // columns) for name, frames in sets.items()}
    height = sum(head + rows * (side + words) for rows in lines.values())
    figure, top = Figure(figsize=(WIDTH, height)), height
    for name, frames in sets.items():
        title = f"{name} set, training frames: input, pred (the others' next second), plan (the ego's)"
        figure.text(0, (top - 0.18) / height, title, fontsize=8)
        top -= head
        for index, (text, pictures) in enumerate(frames):
            row, column = divmod(index, columns)
            left, low = column * WIDTH / columns, top - row * (side + words) - side
            _strip(figure, (left / WIDTH, low / height, 3 * side / WIDTH, side / height), pictures)
            figure.text(left / WIDTH, (low - 0.01) / height, text, fontsize=5.5, va="top", linespacing=1.1)
        top -= lines[name] * (side + words)
    return figure
