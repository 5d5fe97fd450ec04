"""Recordings in the CSV layout of highD, inD, rounD and exiD as Episodes (docs/extend/convert.md)."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from study.convert.drives import as_recording, write_drives
from study.convert.lanelet2 import onward, read_lanes
from study.convert.routes import LaneMap, find_routes
from study.episode.recording import Recording
from study.episode.schema import CYCLIST, PEDESTRIAN, VEHICLE, Agent, Lane
from study.errors import BadInputError

HIGHD = ("frame", "id", "x", "y", "width", "height", "xVelocity", "yVelocity")
OTHERS = ("frame", "trackId", "xCenter", "yCenter", "heading", "xVelocity", "yVelocity")
SIZES = ("trackId", "width", "length", "class")
EGO = {"car", "van"}
CLASSES = {"bicycle": CYCLIST, "pedestrian": PEDESTRIAN}  # the others are vehicles
UNSIZED = {"bicycle": (1.8, 0.65), "pedestrian": (0.5, 0.5)}  # length and width where the table has 0 [m]
SLOW = 1.0  # below it a velocity does not show where a vehicle heads [m/s]

Rows = dict[str, NDArray[Any]]


def convert(sources: Sequence[Path], out: Path, cut: float, maps: Sequence[Path] = ()) -> list[str]:
    """Write drives of recordings below `out`, and return a line about each; `maps` is one map for all, or one for each.

    A source is an XX_tracks.csv, whose XX_tracksMeta.csv and XX_recordingMeta.csv lie beside it, or a folder of such.
    Raises BadInputError, naming file and field, for missing columns and values that are no numbers.
    """
    tracks: list[Path] = []
    for source in sources:
        found = sorted(source.glob("*_tracks.csv")) if source.is_dir() else [source]
        if not found or not all(path.name.endswith("_tracks.csv") for path in found):
            raise BadInputError(f"{source} is no XX_tracks.csv, and no folder with such")
        tracks.extend(found)
    if len(maps) > 1 and len(maps) != len(tracks):
        raise BadInputError(f"--map is given {len(maps)} times for {len(tracks)} recordings; give one, or one for each")
    every = maps if len(maps) > 1 else [*maps, None][:1] * len(tracks)
    recordings = (_recording(path, lanes) for path, lanes in zip(tracks, every, strict=True))
    return write_drives(recordings, len(tracks), out, cut)


def _recording(path: Path, lane_map: Path | None) -> Recording:
    meta_path = path.with_name(path.name.replace("_tracks.csv", "_recordingMeta.csv"))
    meta = _read(meta_path, ("frameRate",), others=True)
    rate = float(_numbers(meta, "frameRate", meta_path)[0])
    if rate <= 0:
        raise BadInputError(f"{meta_path}: field 'frameRate' is {rate:g}; it must be above 0")
    try:
        header = set(pd.read_csv(path, nrows=0).columns)
    except (OSError, ValueError) as error:
        raise BadInputError(f"cannot read {path}: {error}") from error
    motorway = "xCenter" not in header
    agents, rows = (_highd if motorway else _others)(path)
    order = np.lexsort((rows["agent"], rows["step"]))
    rows = {name: values[order] for name, values in rows.items()}
    limit = _limit(meta, meta_path)
    lanes = _motorway(meta, meta_path, rows, limit) if motorway else []
    following: list[list[int]] = [[] for _ in lanes]
    if lane_map is not None:
        if motorway:
            raise BadInputError(f"{path} has its lanes in {meta_path.name}; leave --map out")
        origin = [float(_numbers(meta, name, meta_path)[0]) for name in ("xUtmOrigin", "yUtmOrigin")]
        lanes = read_lanes(lane_map, (origin[0], origin[1]), limit)
        following = onward(lanes)
    routes = None
    if lanes:
        routes = find_routes(rows, agents, rate, LaneMap([lane.centre for lane in lanes], following), {})
    source = {"writer": "study convert highd", "file": path.name}
    return as_recording(path.name.removesuffix("_tracks.csv"), source, rate, agents, rows, lanes, routes=routes)


# --- tables ---------------------------------------------------------------------------------------------------------


def _read(path: Path, columns: Sequence[str], others: bool = False) -> pd.DataFrame:  # noqa: FBT001, FBT002
    """Return a table with these columns, and the `others`.

    Raises BadInputError when it cannot be read, has no rows, or a column is missing.
    """
    try:
        table = pd.read_csv(path, usecols=lambda name: others or name in columns, low_memory=False)
    except (OSError, ValueError) as error:
        raise BadInputError(f"cannot read {path}: {error}") from error
    if missing := [name for name in columns if name not in table.columns]:
        raise BadInputError(
            f"{path}: column '{missing[0]}' is missing; the layout of highD, inD, rounD or exiD is needed"
        )
    if not len(table):
        raise BadInputError(f"{path} has no rows")
    return table


def _numbers(table: pd.DataFrame, name: str, path: Path) -> NDArray[np.float64]:
    """Return a column. Raises BadInputError, with the line, for a value that is not a finite number."""
    if name not in table.columns:
        raise BadInputError(f"{path}: column '{name}' is missing")
    values: NDArray[np.float64] = pd.to_numeric(table[name], errors="coerce").to_numpy(np.float64)
    bad = ~np.isfinite(values)
    if bad.any():
        row = int(bad.argmax())
        raise BadInputError(f"{path}, line {row + 2}, field '{name}': '{table[name].iloc[row]}' is not a number")
    return values


def _limit(meta: pd.DataFrame, path: Path) -> float | None:
    """Return the speed limit [m/s]; where there is none it is negative."""
    speed = float(_numbers(meta, "speedLimit", path)[0]) if "speedLimit" in meta.columns else -1.0
    return speed if speed > 0 else None


def _columns(table: pd.DataFrame, names: Sequence[str], path: Path) -> Rows:
    return {name: _numbers(table, name, path) for name in names}


def _steps(frames: NDArray[np.float64]) -> NDArray[np.int64]:
    steps: NDArray[np.int64] = (frames - frames.min()).round().astype(np.int64)
    return steps


def _highd(path: Path) -> tuple[list[Agent], Rows]:
    """Return vehicles and rows of highD: x, y is a box's upper left corner in the picture, y points down."""
    meta_path = path.with_name(path.name.replace("_tracks.csv", "_tracksMeta.csv"))
    kinds = _read(meta_path, ("id", "class", "drivingDirection"))
    meta = _columns(kinds, ("id", "drivingDirection"), meta_path)
    c = _columns(_read(path, HIGHD), HIGHD, path)
    ids, first, agent = np.unique(c["id"], return_index=True, return_inverse=True)
    at = _find(meta["id"], ids, meta_path, path)
    agents = [
        Agent(int(key), float(c["width"][row]), float(c["height"][row]), str(kinds["class"].iloc[place]).lower() in EGO)
        for key, row, place in zip(ids, first, at, strict=True)
    ]
    left = meta["drivingDirection"][at][agent] == 1  # the upper lanes
    speed = np.hypot(c["xVelocity"], c["yVelocity"])
    along = np.where(left, -1.0, 1.0)
    moving = (speed > SLOW) & (along * c["xVelocity"] > 0)
    heading = np.where(moving, np.arctan2(-c["yVelocity"], c["xVelocity"]), np.where(left, np.pi, 0.0))
    rows: Rows = {"x": c["x"] + c["width"] / 2, "y": -(c["y"] + c["height"] / 2), "heading": heading}
    return agents, rows | {"step": _steps(c["frame"]), "agent": agent, "speed": speed}


def _others(path: Path) -> tuple[list[Agent], Rows]:
    """Return agents and rows of inD, rounD and exiD: centres, headings in degrees anticlockwise from x."""
    meta_path = path.with_name(path.name.replace("_tracks.csv", "_tracksMeta.csv"))
    kinds = _read(meta_path, SIZES)
    meta = _columns(kinds, SIZES[:3], meta_path)
    c = _columns(_read(path, OTHERS), OTHERS, path)
    ids, agent = np.unique(c["trackId"], return_inverse=True)
    at = _find(meta["trackId"], ids, meta_path, path)
    names = kinds["class"].astype(str).str.lower().to_numpy()[at]
    sizes = np.stack([meta["length"], meta["width"]], axis=1)[at]
    for name, size in UNSIZED.items():
        sizes[(names == name) & (sizes <= 0).any(axis=1)] = size
    kept = (names != "animal") & (sizes > 0).all(axis=1)
    agents = [
        Agent(int(key), length, width, name in EGO, CLASSES.get(name, VEHICLE))
        for key, (length, width), name, keep in zip(ids, sizes.tolist(), names, kept, strict=True)
        if keep
    ]
    heading = np.radians(c["heading"])
    forward = c["xVelocity"] * np.cos(heading) + c["yVelocity"] * np.sin(heading)
    speed = np.hypot(c["xVelocity"], c["yVelocity"]) * np.where((forward < 0) & (names != "pedestrian")[agent], -1, 1)
    heading = np.mod(heading + np.pi, 2 * np.pi) - np.pi
    rows: Rows = {"x": c["xCenter"], "y": c["yCenter"], "heading": heading, "speed": speed}
    rows |= {"step": _steps(c["frame"]), "agent": (kept.cumsum() - 1)[agent]}
    return agents, {name: values[kept[agent]] for name, values in rows.items()}


def _find(known: NDArray[np.float64], ids: NDArray[np.float64], meta_path: Path, path: Path) -> NDArray[np.int64]:
    """Return the row of each id in the table about tracks."""
    places = {key: place for place, key in enumerate(known.tolist())}
    if missing := [key for key in ids.tolist() if key not in places]:
        raise BadInputError(f"{meta_path} has no row of track {missing[0]:g}, which is in {path}")
    return np.array([places[key] for key in ids.tolist()], np.int64)


# --- lanes of highD -------------------------------------------------------------------------------------------------


def _motorway(meta: pd.DataFrame, path: Path, rows: Rows, limit: float | None) -> list[Lane]:
    """Return the lanes between the markings; those of the upper carriageway lead to the left."""
    first, last = float(rows["x"].min()), float(rows["x"].max())
    lanes: list[Lane] = []
    for name in ("upperLaneMarkings", "lowerLaneMarkings"):
        if name not in meta.columns:
            raise BadInputError(f"{path}: column '{name}' is missing")
        try:
            marks = [float(mark) for mark in str(meta[name].iloc[0]).split(";") if mark.strip()]
        except ValueError:
            raise BadInputError(f"{path}, field '{name}': '{meta[name].iloc[0]}' is no list of numbers") from None
        count = len(marks) - 1
        for number, (top, bottom) in enumerate(pairwise(marks)):
            y, upper = -(top + bottom) / 2, name.startswith("upper")
            centre = np.array([[first, y], [last, y]])
            above = "curb" if number == 0 else "dashed"
            below = "curb" if number == count - 1 else "dashed"
            left, right = (below, above) if upper else (above, below)
            lanes.append(
                Lane(len(lanes), centre[::-1] if upper else centre, bottom - top, left, right, speed_limit=limit)
            )
    return lanes
