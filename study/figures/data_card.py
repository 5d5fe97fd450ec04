"""Figures of the data card."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from study.config.paper import ACCELERATIONS
from study.figures.style import STYLE, new_figure

SET_COLOUR = {"encoder": "#0072B2", "policy": "#D55E00"}
SPLIT_COLOUR = {"episode": "#009E73", "frame": "#CC79A7"}
WRITERS = 3  # that are named at most
SPLIT_LINE = {"episode": "-", "frame": "--"}


@mpl.rc_context(STYLE)
def data_card(card: Mapping[str, Any]) -> Figure:
    """Draw `data.card.make_card` in six panels: labels before and after selection, traffic, twins."""
    sets = card["sets"]
    figure, panels = new_figure(4.9, columns=3, rows=2)
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
    figure.suptitle(headline(card), x=0.01, ha="left", fontsize=7.5, parse_math=False)
    return figure


def headline(card: Mapping[str, Any]) -> str:
    """Return the title: what the frames were made from, by whom, and how much of it there is."""
    drives = card["drives"]
    frames = " + ".join(f"{entry['frames']:,} {name}" for name, entry in card["sets"].items())
    first = f"{frames} frames of {drives['used']} drives, split by {card['split']} (store {card['key']})"
    if "towns" not in drives:
        return first
    writers = [" ".join(name.split()) for name in drives["writers"][:WRITERS]] + ["..."] * (
        len(drives["writers"]) > WRITERS
    )
    return (
        f"{first}\n{drives['towns']} towns, {drives['hours']:.2f} h of traffic, {drives['vehicles']:,} vehicles, "
        f"{drives['vehicle_hours']:.1f} vehicle hours, {drives['vehicle_km']:,.0f} vehicle km\n"
        f"written by {', '.join(writers)}"
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
