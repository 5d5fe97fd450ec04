"""Figures made of bird views: reconstructions, latent maps, contact sheets."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from study.config.heads import PAPER_MASKS, mask_heads
from study.figures.style import LIGHT_COLOUR, LIGHT_WORDS, STYLE, WIDTH, new_figure

Map = tuple[str, NDArray[np.float64], NDArray[np.float64], NDArray[np.float32], NDArray[np.uint8], NDArray[np.float32]]


@mpl.rc_context(STYLE)
def latent_maps(maps: Sequence[Map], most: int = 1500) -> Figure:
    """Draw three rows of scatter plots, one column for each head set: by speed, by light, and by steering.

    Each map is a name, places [N, 2], their shares of the variance [2], speed [N] [m/s], light [N] and steering [N];
    at most `most` evenly spread frames are drawn.
    """
    figure, axes = new_figure(4.6, columns=len(maps), rows=3)
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


@mpl.rc_context(STYLE)
def contact_sheet(sets: Mapping[str, Sequence[tuple[str, NDArray[np.uint8]]]], columns: int = 3) -> Figure:
    """Draw frames of each set as strips of input and masks, [1 + K, 64, 64, 3] uint8 each, with a text below."""
    further = [head.word for head in mask_heads().values() if head.target not in PAPER_MASKS]
    width = 3 + len(further)
    side, words, head = WIDTH / columns / (width + 0.15), 0.27, 0.3  # [in]
    lines = {name: -(-len(frames) // columns) for name, frames in sets.items()}
    height = sum(head + rows * (side + words) for rows in lines.values())
    figure, top = Figure(figsize=(WIDTH, height)), height
    for name, frames in sets.items():
        title = f"{name} set, training frames: input, pred (the others' next second), plan (the ego's)"
        title = ", ".join([title, *further])
        figure.text(0, (top - 0.18) / height, title, fontsize=8)
        top -= head
        for index, (text, pictures) in enumerate(frames):
            row, column = divmod(index, columns)
            left, low = column * WIDTH / columns, top - row * (side + words) - side
            _strip(figure, (left / WIDTH, low / height, width * side / WIDTH, side / height), pictures)
            figure.text(left / WIDTH, (low - 0.01) / height, text, fontsize=5.5, va="top", linespacing=1.1)
        top -= lines[name] * (side + words)
    return figure
