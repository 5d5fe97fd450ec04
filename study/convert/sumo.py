"""Eclipse SUMO's traffic as Episodes: a net with FCD output, or a scenario that is run (docs/extend/convert.md)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from study.convert.drives import as_recording, write_drives
from study.convert.routes import add_progress, chain
from study.convert.sumo_net import Net, read_net
from study.convert.sumo_trace import Trace, net_of, read_fcd, run_scenario
from study.episode.recording import Recording
from study.episode.schema import CYCLIST, PEDESTRIAN, VEHICLE, Agent
from study.errors import BadInputError

EGO = {"passenger", "private", "taxi", "evehicle", "hov", "vip", "custom1", "custom2"}  # vehicle classes
CLASSES = {"bicycle": CYCLIST, "pedestrian": PEDESTRIAN}  # the others are vehicles
BESIDE = 10.0  # a vehicle farther from its lane's box is not of this net [m]
SIDEWAYS = 1.0  # a vehicle that moves so much to the side in a step has changed lane at once [m]
CHANGE = 15.0  # before and after such a change, over which it is spread [m]

TIGHT = 0.6, 0.85  # share of its front's speed that a centre has in a turn to which SUMO's speed does not apply
SHOWS = 0.2  # least way in a step that shows its direction [m]

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


def convert(
    sources: Sequence[Path],
    out: Path,
    cut: float,
    fcd: Sequence[Path] = (),
    routes: Sequence[Path] = (),
    tls_states: Path | None = None,
    lights: bool = True,  # noqa: FBT001, FBT002
    drives: int = 1,
    warm_up: float = 0.0,
    seconds: float = 60.0,
) -> list[str]:
    """Write drives of scenarios, or of FCD files of one net, below `out`, and return a line about each.

    Each .sumocfg is run `drives` times, with the seeds from 0 on. Raises BadInputError, naming file and field, for
    anything that cannot be converted.
    """
    scenarios = [source for source in sources if not source.name.endswith((".net.xml", ".net.xml.gz"))]
    if fcd and (scenarios or len(sources) != 1):
        raise BadInputError("--fcd needs one source, the .net.xml that the vehicles drove on")
    if not fcd and len(scenarios) < len(sources):
        raise BadInputError(f"{sources[0]} is a net; give its FCD output with --fcd, or a .sumocfg in its place")
    if fcd:
        net = read_net(sources[0], lights)
        recordings = (_recording(net, read_fcd(path, net, routes, tls_states), {}) for path in fcd)
        return write_drives(recordings, len(fcd), out, cut)
    return write_drives(_runs(scenarios, lights, drives, warm_up, seconds), len(scenarios) * drives, out, cut)


def _runs(scenarios: Sequence[Path], lights: bool, drives: int, warm_up: float, seconds: float) -> Iterator[Recording]:  # noqa: FBT001
    for scenario in scenarios:
        net = read_net(net_of(scenario), lights)
        for seed in range(drives):
            yield _recording(net, run_scenario(scenario, net, seed, warm_up, seconds), {"seed": seed})


def _recording(net: Net, trace: Trace, details: dict[str, int]) -> Recording:
    _check_net(net, trace)
    agents = [
        Agent(key, length, width, group in EGO, CLASSES.get(group, VEHICLE))
        for key, (length, width, group) in enumerate(trace.kinds)
    ]
    front, heading = trace.values[:, :2].copy(), np.pi / 2 - np.radians(trace.values[:, 2])
    centre, speed, lanes = front.copy(), trace.values[:, 3].copy(), np.array(trace.lane)
    ways: list[Floats] = []
    stops: list[list[tuple[float, int]]] = []
    order = np.lexsort((trace.step, trace.vehicle))
    edges = np.searchsorted(trace.vehicle[order], np.arange(len(agents) + 1))
    for agent, route in zip(agents, trace.routes, strict=True):
        at = order[edges[agent.id] : edges[agent.id + 1]]
        walks = agent.kind == PEDESTRIAN
        if not walks:
            front[at] = _smooth(trace.step[at], lanes[at], front[at], heading[at], speed[at], trace.rate)
            heading[at] = _headings(trace.step[at], front[at], heading[at], agent.length)
        centre[at] = front[at] - agent.length / 2 * np.stack([np.cos(heading[at]), np.sin(heading[at])], axis=1)
        if not walks:
            speed[at] *= _share_of_speed(front[at], centre[at])
        way, lines = _route(net, [] if walks else lanes[at].tolist(), route)
        ways.append(way)
        stops.append(lines)
    rows = {"step": trace.step, "agent": trace.vehicle, "heading": heading, "speed": speed}
    rows |= dict(zip("xy", centre.T, strict=True))
    add_progress(rows, len(agents), ways, stops)
    name = trace.source.name.split(".")[0] + "".join(f"-{value:03d}" for value in details.values())
    source = {"writer": "study convert sumo", "file": trace.source.name, "net": net.path.name, **details}
    states = net.light_states(trace.states, trace.steps, trace.source)
    return as_recording(name, source, trace.rate, agents, rows, net.lanes, net.lights, states, ways)


def _check_net(net: Net, trace: Trace) -> None:
    """Raise BadInputError when a vehicle is on a lane that the net has not, or most are not where their lanes are."""
    names = {name: number for number, name in enumerate(net.shapes)}
    drives = [number for number, lane in enumerate(trace.lane) if lane]  # persons have no lane
    unknown = next((number for number in drives if trace.lane[number] not in names), None)
    if unknown is not None:
        vehicle, time = trace.names[trace.vehicle[unknown]], trace.times[trace.step[unknown]]
        raise BadInputError(
            f"{trace.source}: 'vehicle' {vehicle} at {time:g} s, field 'lane': {net.path} has no lane "
            f"'{trace.lane[unknown]}' for vehicles; give the net that they drove on"
        )
    boxes = np.array([(line.min(axis=0) - BESIDE, line.max(axis=0) + BESIDE) for line in net.shapes.values()])
    low, high = boxes[[names[trace.lane[number]] for number in drives]].transpose(1, 0, 2)
    places = trace.values[drives, :2]
    beside = ((places < low) | (places > high)).any(axis=1)
    if drives and beside.mean() > 0.5:
        first = drives[int(beside.argmax())]
        x, y = trace.values[first, :2]
        raise BadInputError(
            f"{trace.source}: 'vehicle' {trace.names[trace.vehicle[first]]}, fields 'x' and 'y': ({x:g}, {y:g}) is not "
            f"near lane '{trace.lane[first]}' of {net.path}: is it another net, or fcd-output.geo?"
        )


def _smooth(step: Ints, lane: NDArray[np.str_], front: Floats, heading: Floats, speed: Floats, rate: float) -> Floats:
    """Return the front bumpers [N, 2] of one vehicle with each sudden change of lane spread over some metres around it.

    SUMO moves a vehicle to the lane beside within one step, unless lanechange.duration or lateral-resolution is set.
    """
    moved = np.diff(front, axis=0)
    ahead = np.stack([np.cos(heading[:-1]), np.sin(heading[:-1])], axis=1)
    before = np.hypot(*moved[:-1].T) > SHOWS  # SUMO's angle is odd while the back is on another lane
    ahead[1:][before] = moved[:-1][before] / np.hypot(*moved[:-1][before].T)[:, None]
    carried = np.minimum(speed[1:] / rate, np.hypot(*moved.T))
    excess = moved - carried[:, None] * ahead
    sudden = (np.diff(step) == 1) & (np.hypot(*excess.T) > SIDEWAYS) & (lane[1:] != lane[:-1])
    if not sudden.any():
        return front
    along = np.concatenate([[0.0], np.where(sudden, carried, np.hypot(*moved.T)).cumsum()])
    front = front.copy()
    for at in np.flatnonzero(sudden).tolist():
        share = np.clip((along - (along[at] + along[at + 1]) / 2) / (2 * CHANGE) + 0.5, 0, 1)
        shift = share**2 * (3 - 2 * share) - (np.arange(len(front)) > at)
        front += shift[:, None] * excess[at]
    return front


def _headings(step: Ints, front: Floats, heading: Floats, size: float) -> Floats:
    """Return headings [N] of one vehicle whose back follows its front's way; SUMO's own hold where it is seen first."""
    headings = heading.copy()
    starts = np.flatnonzero(np.diff(step, prepend=-2) != 1)
    for first, last in pairwise([*starts.tolist(), len(step)]):
        part = slice(first, last)
        behind = front[first] - (size + 1) * np.array([np.cos(heading[first]), np.sin(heading[first])])
        way = np.concatenate([[behind], front[part]])
        along = np.concatenate([[0.0], np.hypot(*np.diff(way, axis=0).T).cumsum()])
        back = np.stack([np.interp(along[1:] - size, along, way[:, axis]) for axis in (0, 1)], axis=1)
        dx, dy = (front[part] - back).T
        headings[part] = np.arctan2(dy, dx)
    return headings


def _share_of_speed(front: Floats, centre: Floats) -> Floats:
    """Return how much of its front's speed a vehicle's centre has: all of it but in the tightest turns."""
    span = np.clip(np.arange(len(front)) + np.array([[-1], [1]]), 0, len(front) - 1)
    ways = [np.hypot(*(points[span[1]] - points[span[0]]).T) for points in (centre, front)]
    share = np.where(ways[1] > SHOWS, ways[0] / np.maximum(ways[1], SHOWS), 1).clip(0, 1)
    tight = np.clip((TIGHT[1] - share) / (TIGHT[1] - TIGHT[0]), 0, 1)
    scale: Floats = 1 - tight * (1 - share)
    return scale


def _route(net: Net, lanes: Sequence[str], planned: Sequence[str]) -> tuple[Floats, list[tuple[float, int]]]:
    """Return a vehicle's way over the lanes that it took, then those that its planned edges ask for, and its lights."""
    visits: list[str] = []  # the last lane on each edge that was driven on
    for lane in lanes:
        if lane.startswith(":"):
            continue
        if visits and net.edge_of[visits[-1]] == net.edge_of[lane]:
            visits[-1] = lane
        else:
            visits.append(lane)
    if not visits:
        return np.empty((0, 2)), []
    driven = [net.edge_of[lane] for lane in visits]
    onward = [edge for edge in planned[_end(planned, driven) :] if edge in net.lanes_of]
    here, lines, lights = visits[0], [], []
    for number, edge in enumerate([*driven[1:], *onward], start=1):
        way = net.way(here, edge)
        if way is None:  # not linked: the vehicle was moved, or the route is of another net
            break
        link, inside = way
        lines.append(net.shapes[link.start])
        lights.append(net.light_of.get((link.start, link.tl, link.signal), -1))
        lines.extend(net.shapes[lane] for lane in inside)
        lights.extend([-1] * len(inside))
        here = visits[number] if number < len(visits) else link.to
    route, ends = chain([*lines, net.shapes[here]])
    stops = [(end, light) for end, light in zip(ends, lights, strict=False) if light >= 0]
    return route, stops


def _end(planned: Sequence[str], driven: Sequence[str]) -> int:
    """Return the place in the planned edges after those that were driven on; the end where they do not agree."""
    for start in range(len(planned) - len(driven) + 1):
        if list(planned[start : start + len(driven)]) == list(driven):
            return start + len(driven)
    return len(planned)
