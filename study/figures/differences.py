"""Figures of differences between head sets, encoders and sweeps."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from study.config.paper import ACCELERATIONS
from study.figures.style import BLUE, GREY, SIDES, STYLE, literal, look, new_figure

ACCURACY_LABEL = "difference in acceleration accuracy, test [percentage points]"


@mpl.rc_context(STYLE)
def differences(rows: Sequence[Mapping[str, float | str]]) -> Figure:
    """Draw paired differences in accuracy [points]: thick bar 95 % interval, thin bar simultaneous interval.

    Each row has name, value, low, high, low_all, high_all (shares, not points). The grey zone is the row's `allowance`
    for other encoders, 0 for none.
    """
    return bars(rows, 100.0, ACCURACY_LABEL)


def bars(rows: Sequence[Mapping[str, float | str]], scale: float, label: str) -> Figure:
    """Draw differences of any score, as `differences` does: the rows' numbers times `scale`."""
    figure, (axes,) = new_figure(0.7 + 0.24 * len(rows))
    names = ("value", "low", "high", "low_all", "high_all", "allowance")
    value, low, high, least, most, allowance = (scale * np.array([row[name] for row in rows], float) for name in names)
    places = np.arange(len(rows))
    axes.barh(places, 2 * allowance, 1.0, -allowance, color=GREY, alpha=0.15, linewidth=0)
    axes.hlines(places, least, most, color=BLUE, linewidth=0.8)
    axes.hlines(places, low, high, color=BLUE, linewidth=2.6)
    axes.plot(value, places, "o", color="black", markersize=3.5)
    _difference_axes(axes, [str(row["name"]) for row in rows], (len(rows) - 0.4, -0.6), label)
    return figure


def _difference_axes(
    axes: Axes, names: Sequence[str], limits: tuple[float, float], label: str = ACCURACY_LABEL
) -> None:
    """Name the rows, from the top down, and mark no difference."""
    axes.axvline(0, color=GREY, linewidth=0.6, zorder=1)
    axes.set_yticks(range(len(names)), names)
    axes.set(ylim=limits, xlabel=label)
    _without_left_side(axes)


def _without_left_side(axes: Axes) -> None:
    axes.spines["left"].set_visible(False)
    axes.tick_params(axis="y", length=0)


@mpl.rc_context(STYLE)
def by_encoder(scores: Mapping[str, Sequence[NDArray[np.float64]]]) -> Figure:
    """Draw the final accuracy of every policy, encoder by encoder, and the means of encoders and head sets.

    `scores`: for each head set, and each of its encoders, the scores of its policies.
    """
    figure, (axes,) = new_figure(2.6)
    place, ticks = 0, []
    for heads, encoders in scores.items():
        first = place
        for policies in encoders:
            axes.plot([place] * len(policies), 100 * policies, look(heads).marker, color=look(heads).colour, alpha=0.5)
            middle = 100 * float(policies.mean())
            axes.hlines(middle, place - 0.35, place + 0.35, color=look(heads).colour, linewidth=1.4)
            place += 1
        mean = 100 * float(np.mean([policies.mean() for policies in encoders]))
        axes.hlines(mean, first - 0.5, place - 0.5, color=GREY, linewidth=0.7, linestyle="--")
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
    figure, panels = new_figure(1.9, columns=len(tables))
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


Range = tuple[float, float, float]  # a value and the ends of its interval, as shares


@dataclass(frozen=True)
class TwoSided:
    """A head set and fraction on two sides: None where a side has none, or no difference, as the reference."""

    label: str
    heads: str
    fraction: float
    scores: tuple[Range | None, ...]
    differences: tuple[Range | None, ...]


@mpl.rc_context(STYLE)
def both_values(rows: Sequence[TwoSided], names: tuple[str, str]) -> Figure:
    """Draw the rows' differences in accuracy [points] on both sides, with their intervals; `names` are the sides'."""
    figure, (axes,) = new_figure(0.75 + 0.34 * len(rows))
    places = np.arange(len(rows), dtype=np.float64)
    for row, place in zip(rows, places, strict=True):
        _sides(axes, row.differences, place, 0.14, row.heads, "+.2f")
    _difference_axes(axes, [row.label for row in rows], (len(rows) - 0.5, -0.5))
    axes.margins(x=0.12)
    figure.legend(_keys(), names, loc="outside upper right", ncols=2)
    return figure


@mpl.rc_context(STYLE)
def two_sweeps(rows: Sequence[TwoSided], names: tuple[str, str], baselines: tuple[str, str], note: str) -> Figure:
    """Draw the final accuracy [%] of two sweeps, row by row, beside the differences to each one's reference [points].

    `names`: what the key says of each sweep; `note`: a line below. Bars are the intervals given. Without any difference
    there is one panel.
    """
    fractions = [row.fraction for row in rows]
    places = np.cumsum([0.0, *(1.0 if one == other else 1.5 for one, other in itertools.pairwise(fractions))])
    both = any(row.differences != (None, None) for row in rows)
    figure, panels = new_figure(1.7 + 0.3 * float(places[-1]), columns=1 + both)
    for axes, part, spec in zip(panels, ("scores", "differences"), (".1f", "+.2f"), strict=False):
        for place, row in zip(places, rows, strict=True):
            axes.axhline(place, color=GREY, alpha=0.25, linewidth=0.4, zorder=0)
            _sides(axes, getattr(row, part), place, 0.0 if None in row.scores else 0.2, row.heads, spec)
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
    figure.legend(_keys(), [literal(name) for name in names], loc="outside upper left")
    figure.supxlabel(note, x=0.01, ha="left", fontsize=6.5, color=GREY)
    return figure


def _keys() -> list[Line2D]:
    """Return the legend's marks of the two sides."""
    return [
        Line2D([], [], color="black", linestyle="none", marker=marker, markerfacecolor=fill or "black", markersize=4)
        for marker, fill in SIDES
    ]


def _sides(axes: Axes, pair: Sequence[Range | None], place: float, shift: float, heads: str, spec: str) -> None:
    """Draw the values of both sides with their intervals, and their numbers beside them."""
    colour = look(heads).colour
    for bar, (marker, fill), y in zip(pair, SIDES, (place - shift, place + shift), strict=True):
        if bar is None:
            continue
        value, low, high = (100 * end for end in bar)
        axes.hlines(y, low, high, color=colour, linewidth=1.4)
        axes.plot([value], [y], marker, color=colour, markerfacecolor=fill or colour, markersize=3.6)
        text, end = format(value, spec), value if math.isnan(high) else high
        axes.annotate(
            text.replace("-", "\N{MINUS SIGN}") if float(text) else text.lstrip("+-"),
            (end, y),
            (5, 0),
            textcoords="offset points",
            color=GREY,
            va="center",
            fontsize=6,
            bbox={"facecolor": "white", "edgecolor": "none", "pad": 0.8},  # above the row's line
        )
