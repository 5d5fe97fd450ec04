"""Data card: what is in a frame store and in the drives that it came from, as numbers, a text and a figure.

The card lies beside the frames, in `card/`: `card.json` (every number), `card.txt` and `card.png`. Numbers that would
take long at the paper's scale are taken from a random part of the frames, with its size beside them.
"""

from __future__ import annotations

import json
import sys
from collections import Counter
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from sklearn.metrics import pairwise_distances_chunked

from study.atomic import atomic_folder
from study.config.paper import ACCELERATIONS, IMAGE
from study.data.frames import Frames, FrameStore
from study.data.selection import SETS
from study.episode.head import episode_digest
from study.episode.schema import VEHICLE
from study.randomness import rng

FILES = ("card.json", "card.txt", "card.png")
VIEW_DRIVES, VIEW_FRAMES = 8, 1000  # of each set, in which the agents in view are counted
POOL, QUERIES = 12_000, 1000  # frames of each set that are split for the count of twins; test frames that are looked up
SIDE = 16  # pixels of a thumbnail
TWIN = 2.0  # [grey levels of 255], nearer frames are twins: the difference does not show
DISTANCES = tuple(range(31))  # [grey levels], where the distribution of the distances is given
QUANTILES = (0.05, 0.25, 0.5, 0.75)
MEMORY = 32  # [MiB] of distances at once
CHUNK = 500  # images read at once: 6 MB

Grey = NDArray[np.uint8]


def make_card(store: FrameStore, drives: Sequence[Path]) -> dict[str, Any]:
    """Return the numbers of the card: plain values, the same for the same store and drives.

    `drives` are those of the store's source drives that still exist; what is read from drives is counted over them.
    Raises BadInputError when one of them is no Episode.
    """
    paths = {episode_digest(path): path for path in drives}
    wanted = [source["digest"] for name in SETS for source in store.manifest["sources"][name]]
    existing = [paths[digest] for digest in wanted if digest in paths]
    sets = {}
    for number, name in enumerate(SETS):
        frames: Frames = getattr(store, name)
        entry = store.manifest["sets"][name]
        sources = [paths.get(source["digest"]) for source in store.manifest["sources"][name]]
        sets[name] = {key: entry[key] for key in ("frames", "train", "test", "test_drives", "candidates", "chosen")} | {
            "agents_in_view": _agents_in_view(frames, sources, store.manifest["settings"]["birdview"], number),
            "twins": _twins(frames, store.manifest["settings"]["frames"]["test_share"], number),
        }
    return {
        "key": store.key,
        "split": store.manifest["settings"]["frames"]["split"],
        "view": store.manifest["settings"]["birdview"]["view"],
        "drives": {"used": len(wanted), "here": len(existing)} | (_drives(existing) if existing else {}),
        "sets": sets,
    }


def write_card(store: FrameStore, drives: Sequence[Path], folder: Path) -> tuple[Path, ...]:
    """Write the card of the store in `folder`, atomically, and return its files."""
    from study.figures.data_card import data_card, headline  # noqa: PLC0415 - matplotlib, which one needs that is new
    from study.figures.fonts import fonts_for, lettering  # noqa: PLC0415 - as above
    from study.figures.style import write  # noqa: PLC0415 - as above

    card = make_card(store, drives)
    fonts = fonts_for(headline(card))
    if fonts.warning:
        print(f"warning: {fonts.warning}", file=sys.stderr)
    with atomic_folder(folder / "card") as draft:
        (draft / "card.json").write_text(json.dumps(card, indent=1, allow_nan=False) + "\n", encoding="utf-8")
        (draft / "card.txt").write_text(card_text(card), encoding="utf-8")
        with lettering(fonts):
            write(data_card(card), draft / "card.png")
    return tuple(folder / "card" / name for name in FILES)


def card_files(store: FrameStore, drives: Sequence[Path], folder: Path) -> tuple[Path, ...]:
    """Return the files of the card beside the frames in `folder`; writes them where they are missing."""
    files = tuple(folder / "card" / name for name in FILES)
    return files if all(file.is_file() for file in files) else write_card(store, drives, folder)


def source_drives(store: FrameStore, folder: Path) -> list[Path]:
    """Return the drives in `folder` that the store was made from, as far as they still exist."""
    names = [Path(source["name"]).name for name in SETS for source in store.manifest["sources"][name]]
    return [folder / name for name in names if (folder / name / "episode.json").is_file()]


# --- drives ---------------------------------------------------------------------------------------------------------


def _drives(paths: Sequence[Path]) -> dict[str, Any]:
    """Return sums over the drives, from their heads and one column of their states."""
    seconds, vehicle_seconds, metres = 0.0, 0.0, 0.0
    classes: Counter[str] = Counter()
    maps, seeds, writers, labels = set(), set(), set(), set()
    for path in paths:
        head = json.loads((path / "episode.json").read_text(encoding="utf-8"))
        speed = pd.read_parquet(path / "states.parquet", columns=["speed"])["speed"].to_numpy()
        seconds += head["steps"] / head["rate_hz"]
        vehicle_seconds += len(speed) / head["rate_hz"]
        metres += float(np.abs(speed, dtype=np.float64).sum()) / head["rate_hz"]
        classes.update(agent.get("class", VEHICLE) for agent in head["agents"])
        maps.add(head["digests"]["map.json"])
        seeds |= {head["source"]["seed"]} if isinstance(head["source"].get("seed"), int) else set()
        writers.add(str(head["source"].get("writer", "unknown")))
        labels.add(str(head["labels"]))
    return {
        "towns": len(maps),
        "seeds": len(seeds),
        "hours": round(seconds / 3600, 4),
        "vehicles": classes.total(),  # of all classes
        "classes": dict(sorted(classes.items())),
        "vehicle_hours": round(vehicle_seconds / 3600, 3),
        "vehicle_km": round(metres / 1000, 2),
        "writers": sorted(writers),
        "labels": sorted(labels),
    }


def _agents_in_view(
    frames: Frames, sources: Sequence[Path | None], birdview: dict[str, Any], number: int
) -> dict[str, Any]:
    """Count the other vehicles whose centres lie in the field of view, in frames of a few random drives."""
    generator = rng(0, f"card agents in view {number}")
    episode = frames.labels["episode"].to_numpy()
    here = [drive for drive in np.unique(episode).tolist() if sources[drive] is not None]
    drawn = np.sort(generator.permutation(here)[:VIEW_DRIVES]).tolist()
    counts: list[int] = []
    for drive in drawn:
        rows = np.flatnonzero(episode == drive)
        rows = np.sort(generator.permutation(rows)[: VIEW_FRAMES // len(drawn)])
        counts += _others(frames.labels.iloc[rows], Path(str(sources[drive])), birdview)
    return {"frames": len(counts), "drives": len(drawn), "counts": np.bincount(counts).tolist() if counts else []}


def _others(labels: pd.DataFrame, path: Path, birdview: dict[str, Any]) -> list[int]:
    states = pd.read_parquet(path / "states.parquet", columns=["step", "agent", "x", "y", "heading"])
    step, agent, x, y, heading = (states[name].to_numpy() for name in states.columns)
    ahead, behind, side = birdview["view"] - birdview["behind"], birdview["behind"], birdview["view"] / 2
    counts = []
    for now, ego in zip(labels["step"].tolist(), labels["agent"].tolist(), strict=True):
        start, end = np.searchsorted(step, [now, now + 1])
        me = start + int(np.argmax(agent[start:end] == ego))
        east, north = x[start:end] - x[me], y[start:end] - y[me]
        along = np.cos(heading[me]) * east + np.sin(heading[me]) * north
        across = np.cos(heading[me]) * north - np.sin(heading[me]) * east
        counts.append(int(((along < ahead) & (along > -behind) & (np.abs(across) < side)).sum()) - 1)
    return counts


# --- twins ----------------------------------------------------------------------------------------------------------


def _twins(frames: Frames, test_share: float, number: int) -> dict[str, Any]:
    """Return the distances of test frames to their nearest training frame, when drives and when frames are split.

    Complete drives are drawn until they have POOL frames, so that what lies close in time stays together; the same
    frames are then split both ways, into parts of about the same size. Frames of a single drive can only be split one
    by one: then there is no entry `episode`.
    """
    generator = rng(0, f"card drives {number}")
    episode = frames.labels["episode"].to_numpy()
    drives, sizes = np.unique(episode, return_counts=True)
    order = generator.permutation(len(drives))
    count = max(2, int(np.searchsorted(np.cumsum(sizes[order]), POOL, side="right")))
    drawn = np.sort(drives[order[:count]])
    rows = np.flatnonzero(np.isin(episode, drawn))
    if len(rows) > POOL:  # two drives with more frames than that
        rows = np.sort(generator.permutation(rows)[:POOL])
    pictures, drive = thumbnails(frames.images, rows), episode[rows]

    generator = rng(0, f"card test drives {number}")
    held = generator.permutation(drawn)[: min(max(1, round(len(drawn) * test_share)), len(drawn) - 1)]
    by_drive = np.isin(drive, held)
    by_frame = np.zeros(len(rows), bool)
    tests = int(by_drive.sum()) or max(1, round(len(rows) * test_share))
    by_frame[rng(0, f"card test frames {number}").permutation(len(rows))[:tests]] = True
    distances: dict[str, Any] = {"frames": len(rows), "drives": len(drawn)}
    for name, test in (("episode", by_drive), ("frame", by_frame)):
        if not test.any():
            continue
        asked = np.flatnonzero(test)
        asked = np.sort(generator.permutation(asked)[:QUERIES])
        distance, nearest = nearest_frames(pictures[asked], pictures[~test])
        same = drive[~test][nearest] == drive[asked]
        distances[name] = {
            "train": int((~test).sum()),
            "test": int(test.sum()),
            "asked": len(asked),
            "quantiles": np.quantile(distance, QUANTILES).round(3).tolist(),
            "twins": round(float((distance < TWIN).mean()), 4),
            "same_drive": round(float(same.mean()), 4),
            "within": [round(float((distance <= limit).mean()), 4) for limit in DISTANCES],
        }
    return distances


def thumbnails(images: Grey, rows: NDArray[np.int64]) -> Grey:
    """Return the area averages of rows of images [N, 64, 64, 3] as grey thumbnails [M, 256] uint8."""
    small = np.empty((len(rows), SIDE * SIDE), np.uint8)
    block = IMAGE // SIDE
    weights = np.array([77, 150, 29]) / (256 * block * block)  # of red, green and blue in what the eye calls bright
    for start in range(0, len(rows), CHUNK):
        part = images[rows[start : start + CHUNK]]
        lines = part.reshape(len(part), SIDE, block, IMAGE * 3).sum(axis=2, dtype=np.uint16)
        sums = lines.reshape(len(part), SIDE, SIDE, block, 3).sum(axis=3, dtype=np.uint16)
        small[start : start + CHUNK] = np.rint(sums @ weights).reshape(len(part), -1)
    return small


def nearest_frames(asked: Grey, among: Grey) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return the distance of each thumbnail [M, 256] to the nearest `among` [N, 256], and its row.

    The distance is the root mean square, in grey levels. It is exact, hence the same on every machine: all products
    and sums are whole numbers that float64 holds.
    """
    nearest = (
        (distances.argmin(axis=1), distances.min(axis=1))
        for distances in pairwise_distances_chunked(asked, among, working_memory=MEMORY)
    )
    rows, distance = (np.concatenate(part) for part in zip(*nearest, strict=True))
    return distance / np.sqrt(asked.shape[1]), rows


# --- text -----------------------------------------------------------------------------------------------------------


def card_text(card: dict[str, Any]) -> str:
    """Return the card as text."""
    drives = card["drives"]
    lines = [f"Data card of frame store {card['key']}", ""]
    if "towns" in drives:
        here = "" if drives["here"] == drives["used"] else f", {drives['here']} of them here and counted"
        lines += [
            f"drives         {drives['used']} episodes{here}",
            f"towns          {drives['towns']} different maps, {drives['seeds']} seeds",
            f"written by     {', '.join(drives['writers'])}; labels {', '.join(drives['labels'])}",
            f"driven         {drives['hours']:.2f} h of traffic",
            f"vehicles       {_vehicles(drives)}; {drives['vehicle_hours']:.1f} h, {drives['vehicle_km']:,.0f} km",
        ]
    else:
        lines.append(f"drives         {drives['used']}, none of them here: nothing is known of them")
    for name, entry in card["sets"].items():
        lines += ["", *_set_lines(name, entry, card)]
    return "\n".join(lines) + "\n"


def _vehicles(drives: dict[str, Any]) -> str:
    """Return the number of agents, and how many of them are no vehicles."""
    others = [f"{count:,} {name}s" for name, count in drives["classes"].items() if name != VEHICLE]
    return f"{drives['vehicles']:,}" + (f", of them {' and '.join(others)}" if others else "")


def _set_lines(name: str, entry: dict[str, Any], card: dict[str, Any]) -> list[str]:
    before, after = entry["candidates"], entry["chosen"]["all"]
    test = "" if card["split"] == "frame" else f", test drives {len(entry['test_drives'])}"
    edges = after["steering_edges"]
    bins = [f"< {edges[0]:g}", *(f"{low:g} to {high:g}" for low, high in pairwise(edges)), f"> {edges[-1]:g}"]
    labels = {
        "steering": [f"steering {label}" for label in bins],
        "acceleration": [f"command {value:g}" for value in ACCELERATIONS],
        "light": [f"light {light}" for light in ("none or green", "yellow", "red")],
    }
    rows = [(label, before[key][i], after[key][i]) for key in labels for i, label in enumerate(labels[key])]
    parts = f"{entry['train']:,} train and {entry['test']:,} test"
    lines = [
        f"{name} set: {entry['frames']:,} frames, {parts}, split by {card['split']}{test}",
        f"  {'':<24}{'before selection':>22}{'after':>20}",
        f"  {'frames':<24}{before['frames']:>22,}{after['frames']:>20,}",
    ]
    for label, *counts in [*rows, ("standing", before["standing"], after["standing"])]:
        first, second = (
            f"{count:,} ({100 * count / max(part['frames'], 1):5.1f} %)"
            for count, part in zip(counts, (before, after), strict=True)
        )
        lines.append(f"  {label:<24}{first:>22}{second:>20}")
    lines.append(f"  guessing the commonest class is right in {100 * after['majority_accuracy']:.1f} %")
    return [*lines, _view_line(entry["agents_in_view"], card["view"]), *_twin_lines(entry["twins"])]


def _view_line(seen: dict[str, Any], view: float) -> str:
    if not seen["frames"]:
        return "  other vehicles in view: unknown, the drives are not here"
    counts = np.repeat(np.arange(len(seen["counts"])), seen["counts"])
    low, middle, high = np.quantile(counts, (0.05, 0.5, 0.95))
    return (
        f"  other vehicles in view ({view:g} m a side): mean {counts.mean():.1f}, median {middle:.0f}, 5 to 95 % "
        f"{low:.0f} to {high:.0f} (n = {seen['frames']:,} frames of {seen['drives']} drives)"
    )


def _twin_lines(twins: dict[str, Any]) -> list[str]:
    lines = [
        f"  distance of a test frame to its nearest training frame, root mean square over {SIDE}x{SIDE} grey pixels,",
        f"  in grey levels of 255; {twins['frames']:,} frames of {twins['drives']} drives, split both ways",
    ]
    for name in ("episode", "frame"):
        if name not in twins:
            lines.append(f"    split: {name:<8} all frames are of one drive")
            continue
        part = twins[name]
        values = zip(QUANTILES, part["quantiles"], strict=True)
        quantiles = ", ".join(f"{100 * share:.0f} % {value:.2f}" for share, value in values)
        count = f"n = {part['asked']:,} of {part['test']:,} test frames against {part['train']:,}"
        lines += [
            f"    split: {name:<8} quantiles {quantiles}; below {TWIN:g}: {100 * part['twins']:.1f} %;",
            f"      nearest in the same drive: {100 * part['same_drive']:.1f} % ({count})",
        ]
    return lines
