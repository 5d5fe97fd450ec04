"""One function for each figure: numbers or pictures in, a matplotlib Figure out. No statistic is computed here.

Colours are those of Okabe and Ito (told apart by colour-blind readers), one for each head set everywhere; line styles
and markers differ too, so that a grey print is readable. Curves are labelled where they end.
"""

from __future__ import annotations

import io
import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator
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


def compare_heads(
    steering: pd.DataFrame,
    accuracy: pd.DataFrame,
    steering_floor: float,
    accuracy_floor: float,
    split: str = "test",
    ceiling: pd.DataFrame | None = None,
) -> Figure:
    """Steering loss and acceleration accuracy by epoch (fig:test_compare_heads, fig:train_compare_heads).

    All tables are those of `study.stats.curve_bands` at one fraction: mean line, band of one standard deviation over
    seeds, darker band for the 95 % interval of the mean. `ceiling`: accuracy of policies on the true state.
    """
    with mpl.rc_context(STYLE):
        figure, (left, right) = _figure(2.6, columns=2)
        for axes, bands, scale in ((left, steering, 1000.0), (right, accuracy, 100.0)):
            for index, (name, rows) in enumerate(bands.groupby("heads", sort=False)):
                _curve(axes, rows, scale, COLOUR[str(name)], LINE[str(name)], MARKER[str(name)], index)
            axes.set_xlabel("policy epoch")
        left.set_title(f"(a) Steering loss, {split}")
        _loss_axis(left, steering, steering_floor)
        right.set_title(f"(b) Acceleration accuracy, {split}")
        _accuracy_axis(right, accuracy, accuracy_floor, _top(ceiling))
        for axes, bands, scale in ((left, steering, 1000.0), (right, accuracy, 100.0)):
            last = bands[bands["epoch"] == bands["epoch"].max()]
            values = zip(last["mean"] * scale, last["heads"], strict=True)
            ends = [(float(value), str(heads), COLOUR[str(heads)]) for value, heads in values]
            _label_ends(axes, ends + (_ceiling(axes, ceiling) if axes is right else []))
    return figure


def converge_speed(
    accuracy: pd.DataFrame,
    baseline: str,
    reached: Mapping[float, float],
    accuracy_floor: float,
    ceiling: pd.DataFrame | None = None,
) -> Figure:
    """Test accuracy by epoch: full at every fraction against the baseline at the largest (fig:datasize_convergespeed).

    `accuracy`, `ceiling`: `study.stats.curve_bands`; `reached`: fraction -> epoch at which full's mean curve reaches
    the baseline's final accuracy, infinite when never.
    """
    with mpl.rc_context(STYLE):
        figure, (axes,) = _figure(3.4)
        top = accuracy["fraction"].max()
        base = accuracy[(accuracy["heads"] == baseline) & (accuracy["fraction"] == top)]
        others = accuracy[accuracy["heads"] == "full"]
        ends = []
        for index, (fraction, rows) in enumerate(others.groupby("fraction", sort=False)):
            colour, marker = (marks[index % len(marks)] for marks in (FRACTION_COLOUR, FRACTION_MARKER))
            _curve(axes, rows, 100.0, colour, "-", marker, index)
            ends.append((100 * float(rows["mean"].iloc[-1]), f"full, {_percent(fraction)}", colour))
        _curve(axes, base, 100.0, COLOUR[baseline], "--", MARKER[baseline], 0)
        ends.append((100 * float(base["mean"].iloc[-1]), f"{baseline}, {_percent(top)}", COLOUR[baseline]))
        shown = pd.concat([others, base])
        _accuracy_axis(axes, shown, accuracy_floor, _top(ceiling))
        goal = 100 * float(base["mean"].iloc[-5:].mean())
        axes.axhline(goal, color=GREY, linewidth=0.6, linestyle=":")
        for index, fraction in enumerate(others["fraction"].unique()):
            epoch = reached.get(float(fraction), np.inf)
            if np.isfinite(epoch):
                colour = FRACTION_COLOUR[index % len(FRACTION_COLOUR)]
                axes.plot([epoch, epoch], [axes.get_ylim()[0], goal], color=colour, linewidth=0.6, linestyle=":")
        axes.set_xlabel("policy epoch")
        axes.set_ylabel("acceleration accuracy, test [%]")
        _label_ends(axes, ends + _ceiling(axes, ceiling))
    return figure


def _curve(axes: Axes, rows: pd.DataFrame, scale: float, colour: str, line: str, marker: str, index: int) -> None:
    """Mean line, band of one standard deviation, darker band for the interval of the mean."""
    epoch, mean, sd, low, high = (rows[name].to_numpy(np.float64) for name in ("epoch", "mean", "sd", "low", "high"))
    axes.fill_between(epoch, scale * (mean - sd), scale * (mean + sd), color=colour, alpha=0.15, linewidth=0)
    axes.fill_between(epoch, scale * low, scale * high, color=colour, alpha=0.3, linewidth=0)
    every = max(len(epoch) // 8, 1)
    axes.plot(epoch, scale * mean, line, color=colour, marker=marker, markevery=(index * every // 5, every))
    axes.set_xlim(0, 1.01 * epoch.max())


def _settled(bands: pd.DataFrame) -> pd.DataFrame:
    """The curves without the first epochs, which would press everything else together."""
    late: pd.DataFrame = bands[bands["epoch"] > LATE * bands["epoch"].max()]
    return late


def _loss_axis(axes: Axes, bands: pd.DataFrame, floor: float) -> None:
    """From 0; the best constant command's loss as a line, or in words where it is far above."""
    part, floor = _settled(bands), 1000 * floor
    high = 1.15 * 1000 * float((part["mean"] + part["sd"].fillna(0)).max())
    axes.set_ylim(0, high)
    axes.set_ylabel("smooth L1 loss [$10^{-3}$]")
    if floor <= high:
        axes.axhline(floor, color=GREY, linewidth=0.6, linestyle=":")
        axes.text(axes.get_xlim()[1], floor, "best constant ", color=GREY, fontsize=6.5, ha="right", va="bottom")
    else:
        _note(axes, 0.97, f"best constant command, above: {floor:.2f}")


def _top(ceiling: pd.DataFrame | None) -> float:
    return 0.0 if ceiling is None else float(ceiling["mean"].max())


def _ceiling(axes: Axes, bands: pd.DataFrame | None) -> list[tuple[float, str, str]]:
    """Draw the curve of the true state, without a band, and return the label for its end."""
    if bands is None:
        return []
    axes.plot(bands["epoch"], 100 * bands["mean"], CEILING_LINE, color=GREY, linewidth=0.8)
    return [(100 * float(bands["mean"].iloc[-1]), CEILING_WORDS, GREY)]


def _accuracy_axis(axes: Axes, bands: pd.DataFrame, floor: float, top: float) -> None:
    """Cut below the curves, and says so: the majority class's accuracy is named where it is not in sight.

    It reaches up to `top`, the ceiling, at least.
    """
    part = _settled(bands)
    low = 100 * float((part["mean"] - part["sd"].fillna(0)).min())
    high = 100 * max(float((part["mean"] + part["sd"].fillna(0)).max()), top)
    pad = 0.06 * (high - low)
    low, high = max(low - 2 * pad, 0), min(high + pad, 100)
    axes.set_ylim(low, high)
    axes.set_ylabel("accuracy [%]")
    if 100 * floor >= low:
        axes.axhline(100 * floor, color=GREY, linewidth=0.6, linestyle=":")
        axes.text(axes.get_xlim()[1], 100 * floor, "majority class ", color=GREY, fontsize=6.5, ha="right", va="bottom")
    else:
        _note(axes, 0.03, f"axis cut; majority class at {100 * floor:.1f} %")


def _note(axes: Axes, height: float, text: str) -> None:
    at = "bottom" if height < 0.5 else "top"
    axes.text(0.98, height, text, transform=axes.transAxes, color=GREY, fontsize=6.5, ha="right", va=at)


def _label_ends(axes: Axes, ends: Sequence[tuple[float, str, str]]) -> None:
    """Names (value, text, colour) at the right end of their curves, moved apart where they would touch."""
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


def compare_fractions(
    scores: pd.DataFrame, steering_floor: float, accuracy_floor: float, ceiling: float | None = None
) -> Figure:
    """Mean of the last five epochs by data fraction (fig:datasize_compare).

    `scores`: one row for each cell and metric, columns metric (steering_loss, acceleration_accuracy), heads, fraction,
    mean, sd, low, high. Thin bar: one standard deviation over seeds; thick bar: 95 % interval of the mean. `ceiling`:
    accuracy of policies on the true state.
    """
    with mpl.rc_context(STYLE):
        figure, panels = _figure(2.6, columns=2)
        titles = ("(a) Steering loss, test", "(b) Acceleration accuracy, test")
        for axes, metric, scale, title in zip(
            panels, ("steering_loss", "acceleration_accuracy"), (1000.0, 100.0), titles, strict=True
        ):
            own, ends = scores[scores["metric"] == metric], []
            for index, (name, rows) in enumerate(own.groupby("heads", sort=False)):
                heads, points = str(name), rows.sort_values("fraction")
                ends.append((scale * float(points["mean"].iloc[-1]), heads, COLOUR[heads]))
                _bars(axes, points, scale, heads, shift=1 + 0.03 * index)
            axes.set_xscale("log")
            ticks = sorted(own["fraction"].unique())
            axes.xaxis.set_major_locator(FixedLocator(ticks))
            axes.xaxis.set_minor_locator(NullLocator())
            axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value * 100:g}"))
            axes.set_xlim(ticks[0] / 1.2, ticks[-1] * 1.2)
            axes.set_xlabel("share of the encoder's training data [%]")
            axes.set_title(title)
            bands = own.assign(epoch=1)
            if metric == "steering_loss":
                _loss_axis(axes, bands, steering_floor)
            else:
                _accuracy_axis(axes, bands, accuracy_floor, ceiling or 0.0)
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


def differences(rows: Sequence[Mapping[str, float | str]], allowance: float) -> Figure:
    """Paired differences in accuracy [points]: thick bar 95 % interval, thin bar simultaneous interval.

    Each row has name, value, low, high, low_all, high_all (shares, not points). The grey zone is the allowance for
    other encoders, 0 for none.
    """
    with mpl.rc_context(STYLE):
        figure, (axes,) = _figure(0.7 + 0.24 * len(rows))
        axes.axvspan(-100 * allowance, 100 * allowance, color=GREY, alpha=0.15, linewidth=0)
        axes.axvline(0, color=GREY, linewidth=0.6)
        for index, row in enumerate(rows):
            value, low, high, least, most = (
                100 * float(row[name]) for name in ("value", "low", "high", "low_all", "high_all")
            )
            axes.hlines(index, least, most, color=COLOUR["rec+plan"], linewidth=0.8)
            axes.hlines(index, low, high, color=COLOUR["rec+plan"], linewidth=2.6)
            axes.plot(value, index, "o", color=COLOUR["rec"], markersize=3.5)
        axes.set_yticks(range(len(rows)), [str(row["name"]) for row in rows])
        axes.set_ylim(len(rows) - 0.4, -0.6)
        axes.spines["left"].set_visible(False)
        axes.tick_params(axis="y", length=0)
        axes.set_xlabel("difference in acceleration accuracy, test [percentage points]")
    return figure


def by_encoder(scores: Mapping[str, Sequence[NDArray[np.float64]]]) -> Figure:
    """Final accuracy of every policy, encoder by encoder, and the means of encoders and head sets.

    `scores`: for each head set, and each of its encoders, the scores of its policies.
    """
    with mpl.rc_context(STYLE):
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


def confusions(tables: Sequence[tuple[str, NDArray[np.float64]]]) -> Figure:
    """Confusion matrices side by side, one for each name: share [3, 3] of each true class that is given each class."""
    names = [f"{value:g}" for value in ACCELERATIONS]
    with mpl.rc_context(STYLE):
        figure, panels = _figure(1.9, columns=len(tables))
        for panel, (name, table) in zip(panels, tables, strict=True):
            panel.imshow(table, cmap="Greys", vmin=0, vmax=1)
            for row, column in np.ndindex(*table.shape):
                share = float(table[row, column])
                colour = "white" if share > 0.5 else "black"
                panel.text(column, row, f"{100 * share:.1f}", ha="center", va="center", color=colour, fontsize=7)
            panel.set_xticks(range(len(names)), names)
            panel.set_yticks(range(len(names)), names)
            panel.set_xlabel("given")
            panel.set_title(name)
        panels[0].set_ylabel("true throttle \N{MINUS SIGN} brake")
    return figure


def both_values(rows: Sequence[Mapping[str, Any]], setting: str, values: tuple[str, str]) -> Figure:
    """Differences in accuracy [points] under two values of a setting, with their intervals.

    Each row has name, and here and there with value, low, high (shares, not points).
    """
    with mpl.rc_context(STYLE):
        figure, (axes,) = _figure(0.75 + 0.34 * len(rows))
        axes.axvline(0, color=GREY, linewidth=0.6)
        for side, value, shift, colour, marker in (
            ("here", values[0], -0.14, COLOUR["rec"], "o"),
            ("there", values[1], 0.14, COLOUR["full"], "D"),
        ):
            for index, row in enumerate(rows):
                middle, low, high = (100 * float(row[side][name]) for name in ("value", "low", "high"))
                label = f"{setting} {value}" if index == 0 else None
                axes.hlines(index + shift, low, high, color=colour, linewidth=1.4)
                fill = colour if side == "here" else "white"
                axes.plot(middle, index + shift, marker, color=colour, markerfacecolor=fill, markersize=4, label=label)
        axes.set_yticks(range(len(rows)), [str(row["name"]) for row in rows])
        axes.set_ylim(len(rows) - 0.5, -0.5)
        axes.spines["left"].set_visible(False)
        axes.tick_params(axis="y", length=0)
        axes.set_xlabel("difference in acceleration accuracy, test [percentage points]")
        figure.legend(loc="outside upper right", ncols=2, frameon=False)
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


def two_sweeps(rows: Sequence[Pair], names: tuple[str, str], baselines: tuple[str, str], note: str) -> Figure:
    """Final accuracy [%] of two sweeps, row by row, and beside it the differences to each one's baseline [points].

    `names`: what the key says of each sweep; `note`: a line below. Bars are the intervals given. Without any difference
    there is one panel.
    """
    fractions = [row.fraction for row in rows]
    places = np.cumsum([0.0, *(1.0 if one == other else 1.5 for one, other in itertools.pairwise(fractions))])
    both = any(row.differences != (None, None) for row in rows)
    with mpl.rc_context(STYLE):
        figure, panels = _figure(1.7 + 0.3 * float(places[-1]), columns=1 + both)
        for axes, part, spec in zip(panels, ("scores", "differences"), (".1f", "+.2f"), strict=False):
            for place, row in zip(places, rows, strict=True):
                axes.axhline(place, color=GREY, alpha=0.25, linewidth=0.4, zorder=0)
                shift = 0.0 if None in row.scores else 0.2
                for found, mark, y in zip(getattr(row, part), SIDES, (place - shift, place + shift), strict=True):
                    _dot(axes, found, y, COLOUR.get(row.heads, GREY), mark, spec)
            axes.set_yticks(places, [literal(row.label) for row in rows] if part == "scores" else [""] * len(rows))
            axes.set_ylim(places[-1] + 0.6, -0.6)
            axes.spines["left"].set_visible(False)
            axes.tick_params(axis="y", length=0)
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
        figure.legend(keys, [literal(name) for name in names], loc="outside upper left", frameon=False)
        figure.supxlabel(note, x=0.01, ha="left", fontsize=6.5, color=GREY)
    return figure


def _dot(axes: Axes, found: Range | None, y: float, colour: str, mark: tuple[str, str | None], spec: str) -> None:
    """A value with its interval, and its number beside it."""
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
    """Words from outside, which matplotlib would else read as formulas."""
    return text.replace("$", r"\$")


# --- latents --------------------------------------------------------------------------------------------------------

Map = tuple[str, NDArray[np.float64], NDArray[np.float64], NDArray[np.float32], NDArray[np.uint8], NDArray[np.float32]]


def latent_maps(maps: Sequence[Map], most: int = 1500) -> Figure:
    """Three rows of scatter plots, one column for each head set: by speed, by light, and by steering.

    Each map is a name, places [N, 2], their shares of the variance [2], speed [N] [m/s], light [N] and steering [N];
    at most `most` evenly spread frames are drawn.
    """
    with mpl.rc_context(STYLE):
        figure, axes = _figure(4.6, columns=len(maps), rows=3)
        for column, (name, places, shares, speed, light, steering) in enumerate(maps):
            every = max(len(places) // most, 1)
            x, y = places[::every].T
            above, middle, below = axes[column :: len(maps)]
            fast = above.scatter(x, y, c=speed[::every], s=3, cmap="cividis", vmin=0, linewidths=0, rasterized=True)
            for index, word in enumerate(LIGHT_WORDS):
                here = light[::every] == index
                middle.scatter(
                    x[here], y[here], s=3, color=LIGHT_COLOUR[index], linewidths=0, label=word, rasterized=True
                )
            turn = below.scatter(
                x, y, c=steering[::every], s=3, cmap="RdYlBu", vmin=-0.2, vmax=0.2, linewidths=0, rasterized=True
            )
            above.set_title(name)
            below.set_xlabel(f"{100 * shares[0]:.0f} + {100 * shares[1]:.0f} % of variance", fontsize=6.5)
        for panel in axes:
            panel.set_xticks([])
            panel.set_yticks([])
        figure.colorbar(fast, ax=axes[len(maps) - 1], label="speed [m/s]")
        figure.colorbar(turn, ax=axes[-1], label="steering, left above 0")
        axes[2 * len(maps) - 1].legend(
            title="light",
            loc="center left",
            bbox_to_anchor=(1.0, 0.5),
            frameon=False,
            fontsize=6.5,
            title_fontsize=6.5,
            markerscale=2.5,
        )
        axes[0].set_ylabel("by speed")
        axes[len(maps)].set_ylabel("by light")
        axes[2 * len(maps)].set_ylabel("by steering")
    return figure


# --- pictures -------------------------------------------------------------------------------------------------------

Rows = Sequence[tuple[str, NDArray[np.uint8]]]


def picture_rows(rows: Rows, columns: int = 10) -> Figure:
    """Rows of test pictures with their names (fig:single_head_rec, fig:multi_results).

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
    with mpl.rc_context(STYLE):
        for name, pictures in shown:
            if name == "":
                top -= space
                continue
            figure.text(0, (top - side / 2) / height, name, va="center", fontsize=7.5)
            strip = _strip(pictures)
            wide = side * len(pictures)
            axes = figure.add_axes((names / WIDTH, (top - side) / height, wide / WIDTH, side / height), frame_on=False)
            axes.imshow(strip, interpolation="none", aspect="auto")
            axes.set_axis_off()
            top -= side
    return figure


def _strip(pictures: NDArray[np.uint8], larger: int = 3, gap: int = 8) -> NDArray[np.uint8]:
    """Pictures side by side, on white: one image draws much faster than many. Enlarged, as viewers blur small ones."""
    colour = pictures if pictures.ndim == 4 else np.repeat(pictures[..., None], 3, axis=3)
    colour = colour.repeat(larger, axis=1).repeat(larger, axis=2)
    framed = np.pad(colour, ((0, 0), (0, gap), (0, gap), (0, 0)), constant_values=255)
    strip: NDArray[np.uint8] = np.concatenate(list(framed), axis=1)
    return strip


# --- data -----------------------------------------------------------------------------------------------------------

SET_COLOUR = {"encoder": "#0072B2", "policy": "#D55E00"}
SPLIT_COLOUR = {"episode": "#009E73", "frame": "#CC79A7"}
SPLIT_LINE = {"episode": "-", "frame": "--"}


def data_card(card: Mapping[str, Any]) -> Figure:
    """The numbers of `study.card.make_card` in six panels: labels before and after selection, traffic, twins."""
    sets = card["sets"]
    with mpl.rc_context(STYLE):
        figure, panels = _figure(4.9, columns=3, rows=2)
        edges = sets["policy"]["chosen"]["all"]["steering_edges"]
        names = [f"< {edges[0]:g}", *(f"to {edge:g}" for edge in edges[1:]), f"> {edges[-1]:g}"]
        _shares(panels[0], "(a) Steering", _rows(sets, "steering"), names)
        panels[0].tick_params(axis="x", rotation=55)
        _shares(panels[1], "(b) Command", _rows(sets, "acceleration"), [f"{value:g}" for value in ACCELERATIONS])
        lights = {
            label: ([part["light"][1], part["light"][2], part["standing"]], part["frames"], colour, filled)
            for label, part, colour, filled in _parts(sets)
        }
        _shares(panels[2], "(c) Lights, standing", lights, ["yellow", "red", "standing"])
        panels[0].set_ylabel("share of frames [%]")
        figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=4, frameon=False)
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


_Shares = dict[str, tuple[list[int], int, str, bool]]  # label -> counts, of how many, colour, filled


def _parts(sets: Mapping[str, Any]) -> list[tuple[str, Mapping[str, Any], str, bool]]:
    return [
        (f"{name}, {state}", part, SET_COLOUR[name], state == "chosen")
        for name, entry in sets.items()
        for state, part in (("candidates", entry["candidates"]), ("chosen", entry["chosen"]["all"]))
    ]


def _rows(sets: Mapping[str, Any], key: str) -> _Shares:
    return {label: (part[key], part["frames"], colour, filled) for label, part, colour, filled in _parts(sets)}


def _shares(axes: Axes, title: str, rows: _Shares, names: Sequence[str]) -> None:
    """Bars side by side: outlined before selection, filled after."""
    wide = 0.8 / len(rows)
    for index, (label, (counts, whole, colour, filled)) in enumerate(rows.items()):
        axes.bar(
            np.arange(len(names)) + (index - (len(rows) - 1) / 2) * wide,
            100 * np.array(counts) / max(whole, 1),
            0.9 * wide,
            label=label,
            facecolor=colour if filled else "none",
            edgecolor=colour,
            linewidth=0.6,
        )
    axes.set_xticks(range(len(names)), names)
    axes.set_title(title)


def _in_view(axes: Axes, sets: Mapping[str, Any]) -> None:
    for name, entry in sets.items():
        seen = entry["agents_in_view"]
        if seen["frames"]:
            label = f"{name} (n = {seen['frames']:,})"
            shares = 100 * np.array(seen["counts"]) / seen["frames"]
            axes.plot(range(len(shares)), shares, color=SET_COLOUR[name], marker="o", label=label)
            axes.legend(frameon=False, fontsize=6, handlelength=1.5)
    axes.set_ylim(0, 1.25 * axes.get_ylim()[1])
    axes.set_title("(d) Other vehicles in view")
    axes.set_xlabel("vehicles")
    axes.set_ylabel("share of frames [%]")


def _distances(axes: Axes, twins: Mapping[str, Any], title: str) -> None:
    for name, colour in SPLIT_COLOUR.items():
        if name not in twins:  # frames of a single drive
            continue
        within = 100 * np.array(twins[name]["within"])
        axes.plot(range(len(within)), within, SPLIT_LINE[name], color=colour, label=f"split: {name}")
    axes.set_ylim(0, 100)
    axes.set_xlim(0, len(twins["frame"]["within"]) - 1)
    axes.set_title(title)
    axes.set_xlabel("distance to nearest training frame\n[rms grey levels of 255]")
    axes.legend(frameon=False, fontsize=6, handlelength=2.2, loc="lower right")


def contact_sheet(sets: Mapping[str, Sequence[tuple[str, NDArray[np.uint8]]]], columns: int = 3) -> Figure:
    """Frames of each set as strips of input, pred and plan, [3, 64, 64, 3] uint8 each, with a text below."""
    side, words, head = WIDTH / columns / 3.15, 0.27, 0.3  # [in]
    lines = {name: -(-len(frames) // columns) for name, frames in sets.items()}
    height = sum(head + rows * (side + words) for rows in lines.values())
    figure, top = Figure(figsize=(WIDTH, height)), height
    with mpl.rc_context(STYLE):
        for name, frames in sets.items():
            title = f"{name} set, training frames: input, pred (the others' next second), plan (the ego's)"
            figure.text(0, (top - 0.18) / height, title, fontsize=8)
            top -= head
            for index, (text, pictures) in enumerate(frames):
                row, column = divmod(index, columns)
                left, low = column * WIDTH / columns, top - row * (side + words) - side
                place = (left / WIDTH, low / height, 3 * side / WIDTH, side / height)
                axes = figure.add_axes(place, frame_on=False)
                axes.imshow(_strip(pictures), interpolation="none", aspect="auto")
                axes.set_axis_off()
                figure.text(left / WIDTH, (low - 0.01) / height, text, fontsize=5.5, va="top", linespacing=1.1)
            top -= lines[name] * (side + words)
    return figure
