"""CommonRoad scenarios, XML 2020a, as Episodes (docs/extend/convert.md). commonroad-io reads the files."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from study.convert.drives import as_recording, write_drives
from study.convert.routes import LaneMap, find_routes
from study.convert.xml import number, read_xml
from study.episode.recording import Recording
from study.episode.schema import CYCLIST, GREEN, PEDESTRIAN, RED, VEHICLE, YELLOW, Agent, Lane, Light
from study.errors import BadInputError

VERSION = "2020a"
EGO = {"car", "taxi", "priorityVehicle"}
CLASSES = dict.fromkeys(EGO | {"truck", "bus", "motorcycle", "parkedVehicle", "unknown"}, VEHICLE)
CLASSES |= {"bicycle": CYCLIST, "pedestrian": PEDESTRIAN}
STATES = {"green": GREEN, "inactive": GREEN, "yellow": YELLOW, "redYellow": RED, "red": RED}
WALKS = {"sidewalk", "crosswalk"}  # types of lanelets without vehicles

Floats = NDArray[np.float64]
State = tuple[int, float, float, float, float]  # step, x, y [m], heading [rad], speed [m/s]


def convert(sources: Sequence[Path], out: Path, cut: float) -> list[str]:
    """Write a drive of each scenario below `out`, and return a line about each.

    Raises BadInputError, naming file and field, for files of another version and for what cannot be converted.
    """
    if find_spec("commonroad") is None:
        raise BadInputError(
            "commonroad-io is not installed: pip install 'study[commonroad]', then pip install --no-deps commonroad-io"
        )
    return write_drives(_recordings(sources), len(sources), out, cut)


def _recordings(sources: Sequence[Path]) -> Iterator[Recording]:
    reader = import_module("commonroad.common.reader.file_reader_xml").XMLFileReader
    for path in sources:
        root = read_xml(path, "commonRoad")
        version = root.get("commonRoadVersion")
        if version != VERSION:
            raise BadInputError(
                f"{path}: field 'commonRoadVersion' is {version!r}; {VERSION} is needed, which commonroad-io writes"
            )
        step = number(root, "timeStepSize", path)
        if step <= 0:
            raise BadInputError(f"{path}: field 'timeStepSize' is {step:g} s; it must be above 0")
        try:
            scenario, _ = reader(str(path)).open()
        except Exception as error:  # the reader lets anything through that a faulty file brings about
            raise BadInputError(f"{path}: commonroad-io cannot read it ({error!r}): is a field missing?") from error
        yield _recording(path, scenario, round(1 / step, 6))


def _recording(path: Path, scenario: Any, rate: float) -> Recording:
    tracks = {key: states for key, _, states in _tracks(path, scenario)}
    agents = [agent for _, agent, _ in _tracks(path, scenario)]
    if not tracks:
        raise BadInputError(f"{path}: field 'dynamicObstacle': there is no vehicle, cyclist or pedestrian")
    steps = max(states[-1][0] for states in tracks.values()) + 1
    agents, columns = _columns(agents, tracks, scenario, path, steps)
    lanelets = [
        lane for lane in scenario.lanelet_network.lanelets if not WALKS & {kind.value for kind in lane.lanelet_type}
    ]
    lanes = [_lane(key, lanelet, scenario) for key, lanelet in enumerate(lanelets)]
    numbers = {lanelet.lanelet_id: key for key, lanelet in enumerate(lanelets)}
    lights, states, governing = _lights(lanelets, scenario, steps)
    onward = [[numbers[key] for key in lanelet.successor if key in numbers] for lanelet in lanelets]
    routes = find_routes(columns, agents, rate, LaneMap([lane.centre for lane in lanes], onward), governing)
    source = {"writer": "study convert commonroad", "file": path.name, "scenario": str(scenario.scenario_id)}
    return as_recording(path.name.removesuffix(".xml"), source, rate, agents, columns, lanes, lights, states, routes)


# --- obstacles ------------------------------------------------------------------------------------------------------


def _tracks(path: Path, scenario: Any) -> Iterator[tuple[int, Agent, list[State]]]:
    """Yield id, agent and states of each dynamic obstacle of a known class."""
    for obstacle in sorted(scenario.dynamic_obstacles, key=lambda obstacle: obstacle.obstacle_id):
        kind = obstacle.obstacle_type.value
        if kind not in CLASSES:
            continue
        key = obstacle.obstacle_id
        trajectory = getattr(obstacle.prediction, "trajectory", None)
        if obstacle.prediction is not None and trajectory is None:
            raise BadInputError(f"{path}: dynamicObstacle {key}, field 'occupancySet': a 'trajectory' is needed")
        states = [obstacle.initial_state, *(trajectory.state_list if trajectory else ())]
        yield key, _agent(path, obstacle, kind in EGO, CLASSES[kind]), _states(path, obstacle, states)


def _agent(path: Path, obstacle: Any, ego: bool, kind: str) -> Agent:  # noqa: FBT001
    shape = obstacle.obstacle_shape
    length, width = getattr(shape, "length", None), getattr(shape, "width", None)
    if length is None or width is None:
        radius = getattr(shape, "radius", None)
        if radius is None:
            raise BadInputError(
                f"{path}: dynamicObstacle {obstacle.obstacle_id}, field 'shape': a rectangle or circle is needed"
            )
        length = width = 2 * radius
    return Agent(int(obstacle.obstacle_id), float(length), float(width), ego, kind)


def _states(path: Path, obstacle: Any, states: Sequence[Any]) -> list[State]:
    """Return the states of the centre; positions are those of the shape's origin, which may be the rear axle."""
    key, shift = obstacle.obstacle_id, getattr(obstacle.obstacle_shape, "origin_x_shift", 0.0)
    track: list[State] = []
    for state in states:
        values: list[Any] = []
        for name in ("position", "orientation", "velocity"):
            value = getattr(state, name, None)
            if not isinstance(value, float | int | np.ndarray):
                text = "missing" if value is None else "not exact"
                raise BadInputError(f"{path}: dynamicObstacle {key}, step {state.time_step}, field '{name}' is {text}")
            values.append(value)
        (x, y), heading, speed = values
        centre = float(x - shift * np.cos(heading)), float(y - shift * np.sin(heading))
        track.append((int(state.time_step), *centre, float(heading), float(speed)))
    return sorted(track)


def _columns(
    agents: list[Agent], tracks: dict[int, list[State]], scenario: Any, path: Path, steps: int
) -> tuple[list[Agent], dict[str, NDArray[Any]]]:
    """Return all agents, parked vehicles too, and their rows."""
    tracks = dict(tracks)
    agents = list(agents)
    for obstacle in scenario.static_obstacles:
        if (kind := obstacle.obstacle_type.value) in CLASSES:
            state = obstacle.initial_state
            agents.append(_agent(path, obstacle, ego=False, kind=CLASSES[kind]))
            parked = (*state.position[:2], state.orientation, 0.0)
            tracks[obstacle.obstacle_id] = [(step, *parked) for step in range(steps)]
    index = np.repeat(np.arange(len(agents)), [len(tracks[agent.id]) for agent in agents])
    table = np.array([state for agent in agents for state in tracks[agent.id]], np.float64)
    names = ("x", "y", "heading", "speed")
    columns: dict[str, NDArray[Any]] = dict(zip(names, table[:, 1:].T, strict=True))
    columns["heading"] = np.mod(columns["heading"] + np.pi, 2 * np.pi) - np.pi
    return agents, columns | {"step": table[:, 0].astype(np.int64), "agent": index}


# --- lanelets and lights --------------------------------------------------------------------------------------------


def _lane(key: int, lanelet: Any, scenario: Any) -> Lane:
    left, right = lanelet.left_vertices[:, :2], lanelet.right_vertices[:, :2]
    inside = any(kind.value == "intersection" for kind in lanelet.lanelet_type)
    sides = (
        _border(lanelet.line_marking_left_vertices.value, inside or lanelet.adj_left is not None),
        _border(lanelet.line_marking_right_vertices.value, inside or lanelet.adj_right is not None),
    )
    width = float(np.hypot(*(left - right).T).mean())
    return Lane(key, (left + right) / 2, width, *sides, inside, _limit(lanelet, scenario))


def _border(marking: str, beside: bool) -> str:  # noqa: FBT001
    """Return the border that a marking stands for; an unmarked side is a curb where no lane is beside it."""
    if "curb" in marking:
        return "curb"
    if "dashed" in marking:
        return "dashed"
    if "solid" in marking:
        return "solid"
    return "none" if beside else "curb"


def _limit(lanelet: Any, scenario: Any) -> float | None:
    """Return the least limit on the lanelet's signs [m/s]."""
    signs = [scenario.lanelet_network.find_traffic_sign_by_id(key) for key in lanelet.traffic_signs]
    limits = [
        float(element.additional_values[0])
        for sign in signs
        for element in sign.traffic_sign_elements
        if element.traffic_sign_element_id.name == "MAX_SPEED" and element.additional_values
    ]
    return min(limits, default=None)


def _lights(
    lanelets: Sequence[Any], scenario: Any, steps: int
) -> tuple[list[Light], NDArray[np.uint8], dict[int, list[int]]]:
    """Return a light for each lanelet and traffic light, their states [T, L], and the lights of each lane."""
    lights: list[Light] = []
    governing: dict[int, list[int]] = {}
    states = []
    for lane, lanelet in enumerate(lanelets):
        for key in sorted(lanelet.traffic_lights):
            signal = scenario.lanelet_network.find_traffic_light_by_id(key)
            stop = lanelet.stop_line
            drawn = stop is not None and stop.start is not None
            ends = (stop.start, stop.end) if drawn else (lanelet.left_vertices[-1], lanelet.right_vertices[-1])
            governing.setdefault(lane, []).append(len(lights))
            lights.append(Light(len(lights), np.array(ends, np.float64)[:, :2], lane))
            names = [signal.get_state_at_time_step(step).value for step in range(steps)]
            states.append([STATES[name] if signal.active is not False else GREEN for name in names])
    table = np.array(states, np.uint8).T if states else np.zeros((steps, 0), np.uint8)
    return lights, table, governing
