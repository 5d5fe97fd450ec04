"""Write converted recordings: cut into drives, at 10 Hz, all of them or nothing."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from study.atomic import atomic_folder
from study.console.terminal import follow
from study.episode.chart import REACH
from study.episode.files import write_episode
from study.episode.recording import Recording
from study.episode.rows import Rows
from study.episode.schema import OPTIONAL_FLOATS, Agent, Lane, Light
from study.errors import BadInputError
from study.intake.adapt import resample

SHORTEST = 3.0  # a recording below it has no moment with a second of history and one of future [s]


def write_drives(recordings: Iterable[Recording], count: int, out: Path, cut: float) -> list[str]:
    """Write `count` recordings below `out` as drives of about `cut` seconds each, and return a line about each drive.

    All drives are at 10 Hz and have an agent that may be ego. Nothing is written when anything is wrong.
    Raises BadInputError when `out` holds something, when no drive is left, and for rates below 2 Hz.
    """
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise BadInputError(f"{out} holds something; name a new folder with --out")
    lines = []
    with atomic_folder(out) as draft:
        for recording in follow(recordings, count, "converting"):
            for part in _parts(recording, cut):
                episode = resample(part.episode(), recording.id)
                write_episode(episode, draft / part.id)
                egos = sum(agent.ego for agent in part.agents)
                seconds = episode.steps / episode.rate_hz
                lines.append(f"{part.id}: {seconds:.1f} s, {len(part.agents)} agents, {egos} may be ego")
        if not lines:
            raise BadInputError(
                f"no drive is left: there is no vehicle that may be ego in {SHORTEST:g} s or more of any source"
            )
    return lines


def _parts(recording: Recording, cut: float) -> Iterator[Recording]:
    """Yield parts of equal length, near `cut` seconds, that have an agent which may be ego."""
    seconds = recording.steps / recording.rate_hz
    if seconds < SHORTEST:
        return
    count = max(1, round(seconds / cut))
    edges = np.linspace(0, recording.steps, count + 1).round().astype(int).tolist()
    for number, (first, last) in enumerate(pairwise(edges)):
        part = recording.part(first, last)
        if any(agent.ego for agent in part.agents):
            source = part.source | ({"recording": recording.id} if count > 1 else {})  # its parts stay in one set
            name = recording.id if count == 1 else f"{recording.id}-{number:03d}"
            yield dataclasses.replace(part, id=name, source=source)


def as_recording(
    name: str,
    source: dict[str, Any],
    rate: float,
    agents: Sequence[Agent],
    rows: Rows,
    lanes: Sequence[Lane] = (),
    lights: Sequence[Light] = (),
    light_state: NDArray[np.uint8] | None = None,
    routes: Sequence[NDArray[np.float64]] | None = None,
) -> Recording:
    """Return a recording without commands, moved so that all of it lies within reach of the origin.

    `rows` have at least step, agent (an index into `agents`), x, y, heading and speed, as `study.episode.rows` says;
    `light_state` is [T, L], `routes` are one polyline [P, 2] for each agent. The offset is kept in the source.
    """
    order = np.lexsort((rows["agent"], rows["step"]))
    count = len(order)
    full: Rows = {name: np.full(count, np.nan, np.float32) for name in OPTIONAL_FLOATS}
    full |= {"light": np.full(count, -1, np.int32)} | {name: values[order] for name, values in rows.items()}
    full["number"] = np.arange(count)
    routes = routes or [np.empty((0, 2))] * len(agents)
    points = np.concatenate([np.stack([full["x"], full["y"]], axis=1), *(lane.centre for lane in lanes)])
    shift = np.zeros(2)
    if count and np.abs(points).max() > REACH:
        shift = ((points.min(axis=0) + points.max(axis=0)) / 2).round()
        source = source | {"offset": shift.tolist()}
        lanes = [dataclasses.replace(lane, centre=lane.centre - shift) for lane in lanes]
        lights = [dataclasses.replace(light, stop_line=light.stop_line - shift) for light in lights]
    for name_, offset in zip("xy", shift, strict=True):
        full[name_] = (full[name_] - offset).astype(np.float32)
    steps = int(full["step"].max()) + 1 if count else 0
    for name_ in ("heading", "speed", *OPTIONAL_FLOATS):
        full[name_] = full[name_].astype(np.float32)
    states = np.zeros((steps, 0), np.uint8) if light_state is None else light_state[:steps]
    lines = tuple((route - shift).astype(np.float32) for route in routes)
    return Recording(
        name, source, rate, steps, "none", tuple(agents), tuple(lanes), tuple(lights), full, states, lines, digests={}
    )
