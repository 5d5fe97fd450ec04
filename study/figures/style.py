"""Colours, sizes and files that all figures share."""

from __future__ import annotations

import io
import zlib
from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from study.atomic import write_atomic
from study.config.baselines import BASELINES
from study.config.heads import HEAD_SETS, HeadSet

BLUE, VERMILION = "#0072B2", "#D55E00"
FRACTION_COLOUR = (VERMILION, "#E69F00", "#009E73", "#56B4E9", "#CC79A7")
FURTHER = ("#009E73", "#CC79A7", "#56B4E9", "#8C6D1F", "#7A5195")  # for head sets that no record names
FRACTION_MARKER = ("D", "^", "s", "v", "P")
LIGHT_COLOUR, LIGHT_WORDS = ("#BBBBBB", "#E69F00", "#D55E00"), ("green or none", "yellow", "red")
SIDES = (("o", None), ("D", "white"))  # marker and fill of the first of two sweeps, and of the second
GREY = "#666666"
Drawing = Figure  # the type, for packages that do not speak to matplotlib
WIDTH = 6.4  # [in], the report's text width
DOTS = 200  # per inch
FONT = "DejaVu Sans"  # comes with matplotlib, so every machine draws the same
STYLE: dict[Any, Any] = {
    "font.size": 7.5,
    "font.family": [FONT],
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


def look(name: str) -> HeadSet:
    """Return colour, line and marker of a head set or baseline; what has no record gets a colour by its name."""
    if baseline := BASELINES.get(name):
        return HeadSet(name, (), baseline.word, baseline.colour, baseline.line, "")
    colour = FURTHER[zlib.crc32(name.encode()) % len(FURTHER)]
    return HEAD_SETS.get(name) or HeadSet(name, (), name, colour, ":", "v")


def paint(figure: Figure, kind: str) -> bytes:
    """Return a figure as a file of a format of METADATA (200 dots per inch), the same bytes each time."""
    stream = io.BytesIO()
    with mpl.rc_context(STYLE):
        figure.savefig(stream, format=kind, dpi=DOTS, metadata=METADATA[kind])
    return stream.getvalue()


def write(figure: Figure, path: Path) -> None:
    """Write a figure whole, in the format of its ending."""
    write_atomic(path, paint(figure, path.suffix[1:].lower()))


def new_figure(height: float, columns: int = 1, rows: int = 1) -> tuple[Figure, list[Axes]]:
    """Return a figure as wide as the page, and its axes row by row."""
    figure = Figure(figsize=(WIDTH, height), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False)
    return figure, list(axes.flat)


def literal(text: str) -> str:
    """Return words from outside, which matplotlib would else read as formulas."""
    return text.replace("$", r"\$")
