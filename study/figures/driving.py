"""Figures of driving in closed loop."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib as mpl
import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from study.figures.differences import bars
from study.figures.style import GREY, STYLE, literal, look, new_figure

EXPERT = "expert"
# From the best end to the worst; grey and pale where nobody is to blame, so that a grey print tells them apart.
END_COLOUR = ("#009E73", "#BBBBBB", "#D55E00", "#E69F00", "#56B4E9", "#000000")
CROSS = "x"  # of baselines, which have no marker of their own


@mpl.rc_context(STYLE)
def scores(rows: Sequence[tuple[str, str, float, float, float]]) -> Figure:
    """Draw driving scores, 0 to 100: a row's label, its head set or baseline, mean and ends of the 95 % interval.

    Intervals of a few drives may end beyond what a score can be; they are cut there.
    """
    figure, (axes,) = new_figure(0.7 + 0.22 * len(rows))
    for place, (_, heads, mean, low, high) in enumerate(rows):
        colour, marker = _mark(heads)
        axes.hlines(place, max(low, 0), min(high, 100), color=colour, linewidth=2.2, alpha=0.6)
        axes.plot([mean], [place], marker, color=colour, markersize=4)
        end = mean if np.isnan(high) else min(max(high, mean), 100)
        axes.annotate(
            f"{mean:.1f}".replace("-", "\N{MINUS SIGN}"),
            (end, place),
            (5, 0),
            textcoords="offset points",
            va="center",
            fontsize=6.5,
            color=GREY,
        )
    axes.set_yticks(range(len(rows)), [literal(row[0]) for row in rows])
    axes.set(ylim=(len(rows) - 0.4, -0.6), xlim=(-1, 108), xlabel="driving score [0 to 100]")
    axes.spines["left"].set_visible(False)
    axes.tick_params(axis="y", length=0)
    axes.grid(axis="x", color=GREY, alpha=0.2, linewidth=0.4)
    return figure


def _mark(heads: str) -> tuple[str, str]:
    return ("black", "*") if heads == EXPERT else (look(heads).colour, look(heads).marker or CROSS)


@mpl.rc_context(STYLE)
def ends(rows: Sequence[tuple[str, Mapping[str, float]]], words: Mapping[str, str]) -> Figure:
    """Draw what ended the drives as stacked bars [%]: a row's label and the share of each end in `words`."""
    figure, (axes,) = new_figure(0.95 + 0.22 * len(rows))
    left, places = np.zeros(len(rows)), np.arange(len(rows))
    for (end, word), colour in zip(words.items(), END_COLOUR, strict=True):
        shares = 100 * np.array([row[1].get(end, 0.0) for row in rows])
        axes.barh(places, shares, 0.7, left, color=colour, label=word, edgecolor="white", linewidth=0.4)
        for place, share, start in zip(places, shares, left, strict=True):
            if share >= 8:
                dark = colour in {"#000000", "#D55E00", "#009E73"}
                text = "white" if dark else "black"
                axes.text(
                    start + share / 2, float(place), f"{share:.0f}", ha="center", va="center", fontsize=6, color=text
                )
        left += shares
    axes.set_yticks(places, [literal(row[0]) for row in rows])
    axes.set(ylim=(len(rows) - 0.4, -0.6), xlim=(0, 100), xlabel="share of drives [%]")
    axes.spines["left"].set_visible(False)
    axes.tick_params(axis="y", length=0)
    figure.legend(loc="outside upper center", ncols=len(words) // 2, fontsize=7)
    return figure


@mpl.rc_context(STYLE)
def accuracy_and_driving(policies: pd.DataFrame) -> Figure:
    """Draw accuracy [%] against driving score, one mark for each policy: columns heads, fraction, accuracy, score.

    Of several fractions the smaller are paler. The large mark is the mean of a head set or baseline and fraction.
    """
    figure, (axes,) = new_figure(3.2)
    top = float(policies["fraction"].max())
    labelled: dict[str, Any] = {}
    for (name, fraction), rows in policies.groupby(["heads", "fraction"], sort=False):
        colour, marker = _mark(str(name))
        strength = 0.45 + 0.55 * float(str(fraction)) / top
        axes.plot(100 * rows["accuracy"], rows["score"], marker, color=colour, alpha=0.4 * strength, markersize=3)
        middle = [100 * rows["accuracy"].mean()], [rows["score"].mean()]
        (mark,) = axes.plot(*middle, marker, color=colour, alpha=strength, markersize=7, markeredgewidth=1.4)
        labelled.setdefault(look(str(name)).word if marker == CROSS else str(name), mark)
    axes.set(xlabel="final acceleration accuracy, test [%]", ylabel="driving score [0 to 100]")
    figure.legend(labelled.values(), map(literal, labelled), loc="outside right upper", fontsize=7)
    return figure


@mpl.rc_context(STYLE)
def differences(rows: Sequence[Mapping[str, float | str]]) -> Figure:
    """Draw paired differences of the driving score [points of 100]; rows and bars as `figures.differences` has them."""
    return bars(rows, 1.0, "difference in driving score [points of 100]")
