"""Whether agents, lanes and lights lie in one frame of reference: vehicles drive on lanes and stop lines cross them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from study.episode.findings import Findings
from study.episode.recording import Recording
from study.episode.rows import Rows
from study.episode.schema import Agent, Lane, Light

CELL = 10.0  # [m] a vehicle in a lane's cell, or in one beside it, is near the lane
FARTHEST = 1 << 15  # cell from the origin: 300 km, far beyond what an Episode may hold
FEW = 0.8  # share of rows near a lane below which the drive is remarkable


AROUND = np.stack(np.meshgrid([-1, 0, 1], [-1, 0, 1]), axis=-1).reshape(-1, 2)


def check_places(recording: Recording, findings: Findings) -> None:
    """Add an error when no agent is ever near a lane, or near its route; a warning, with the share, when few are.

    The same for stop lines, each of which is near a lane: near its own, where it names one.
    """
    if len(recording.rows["x"]):
        _check_lanes(recording.rows, recording.agents, recording.lanes, findings)
        _check_routes(recording.rows, recording.agents, recording.routes, findings)
    _check_lights(recording.lights, recording.lanes, findings)


def _check_routes(
    rows: Rows, agents: Sequence[Agent], routes: Sequence[NDArray[np.float32]], findings: Findings
) -> None:
    there = np.bincount(rows["agent"], minlength=len(agents)) > 0
    routed = [agent for agent in np.flatnonzero(there).tolist() if len(routes[agent]) > 1]
    if not routed:
        return
    ways = [np.unique(_cells(_dense(routes[agent].astype(np.float64))), axis=0) for agent in routed]
    cells = (np.concatenate(ways)[:, None] + AROUND).reshape(-1, 2)
    owners = np.repeat(routed, [len(way) * len(AROUND) for way in ways])
    places = _cells(np.stack([rows["x"], rows["y"]], axis=1).astype(np.float64))
    near = np.isin(_key(places, rows["agent"]), _key(cells, owners))
    ever = np.bincount(rows["agent"], weights=near, minlength=len(agents)) > 0
    away = [agent for agent in routed if not ever[agent]]
    if away:
        text = (
            f": the route of agent {agents[away[0]].id} is nowhere near it, as those of {len(away)} of {len(routed)} "
            "agents: bring routes and agents into one frame of reference, or leave such routes out"
        )
        (findings.add if len(away) == len(routed) else findings.warn)("routes.parquet", text)


def _check_lanes(rows: Rows, agents: Sequence[Agent], lanes: Sequence[Lane], findings: Findings) -> None:
    if not lanes:
        return
    occupied = np.unique(_cells(np.concatenate([_dense(lane.centre) for lane in lanes])), axis=0)
    beside = (occupied[:, None] + AROUND).reshape(-1, 2)
    places = _cells(np.stack([rows["x"], rows["y"]], axis=1).astype(np.float64))
    near = np.isin(_key(places), _key(beside))
    share = float(near.mean())
    if share >= FEW:
        return
    ever = np.bincount(rows["agent"], weights=near, minlength=len(agents)) > 0
    there = np.bincount(rows["agent"], minlength=len(agents)) > 0
    row = int(near.argmin())
    agent, step, number = agents[rows["agent"][row]].id, rows["step"][row], rows["number"][row]
    never = int((there & ~ever).sum())
    place = (
        f", row {number}, field 'x' (step {step}, agent {agent}): ({rows['x'][row]:.6g}, {rows['y'][row]:.6g}) is not "
        f"near a lane, as {1 - share:.1%} of all rows, and {never} of {there.sum()} agents never are"
    )
    if share == 0:
        low, high = occupied.min(axis=0) * CELL, (occupied.max(axis=0) + 1) * CELL
        findings.add(
            "states.parquet",
            f"{place}; lanes lie between ({low[0]:g}, {low[1]:g}) and ({high[0]:g}, {high[1]:g}): bring map and agents "
            "into one frame of reference",
            len(near),
        )
    else:
        findings.warn("states.parquet", f"{place}: do map and agents lie in one frame of reference?")


def _check_lights(lights: Sequence[Light], lanes: Sequence[Lane], findings: Findings) -> None:
    if not (lights and lanes):
        return
    around = {
        lane.id: _key((np.unique(_cells(_dense(lane.centre)), axis=0)[:, None] + AROUND).reshape(-1, 2))
        for lane in lanes
    }
    anywhere = np.unique(np.concatenate(list(around.values())))
    away = []
    for light in lights:
        place = _key(_cells(light.stop_line.mean(axis=0, keepdims=True)))
        if not np.isin(place, anywhere if light.lane is None else around[light.lane]).any():
            away.append(light)
    if not away:
        return
    first = away[0]
    x, y = first.stop_line.mean(axis=0)
    lane = "any lane" if first.lane is None else f"its lane {first.lane}"
    text = (
        f", field 'lights[*].stop_line' (light {first.id}): its middle ({x:.6g}, {y:.6g}) is not near {lane}, as those "
        f"of {len(away)} of {len(lights)} lights ({len(away) / len(lights):.0%}): bring lights and lanes into one "
        "frame of reference, name the lane that each light governs, or leave such lights out"
    )
    (findings.add if len(away) == len(lights) else findings.warn)("map.json", text)


def _cells(points: NDArray[np.float64]) -> NDArray[np.int64]:
    cells: NDArray[np.int64] = np.clip(np.floor(points / CELL), -FARTHEST, FARTHEST).astype(np.int64)
    return cells


def _key(cells: NDArray[np.int64], owners: NDArray[np.int64] | int = 0) -> NDArray[np.int64]:
    """Return one number for each owner and cell."""
    side = 2 * FARTHEST + 4
    key: NDArray[np.int64] = (owners * side + cells[:, 0] + FARTHEST + 1) * side + cells[:, 1] + FARTHEST + 1
    return key


def _dense(line: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return points of a polyline that miss no cell by more than a metre or two."""
    along = np.concatenate([[0.0], np.hypot(*np.diff(line, axis=0).T).cumsum()])
    at = np.linspace(0, along[-1], max(2, int(along[-1] / CELL * 2) + 1))
    return np.stack([np.interp(at, along, line[:, axis]) for axis in (0, 1)], axis=1)
