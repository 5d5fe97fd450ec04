"""Write drives of another simulator as Episodes: highway-env's own intersection, roundabout and merge.

All vehicles are highway-env's IDM drivers, the environment's ego too, at the environment's own 15 Hz. They come and go.
There are no lights, and no commands in the study's sense: an import derives them. See docs/extend/data.md.

    python examples/highway_scenes.py scenes 60
    python -m study.data import scenes
    python -m study.sweep heads --profile smoke --data data/imported/scenes
"""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from highway_env.envs.common.abstract import AbstractEnv
from highway_env.envs.intersection_env import ContinuousIntersectionEnv
from highway_env.envs.merge_env import MergeEnv
from highway_env.envs.roundabout_env import RoundaboutEnv
from highway_env.road.lane import AbstractLane, LineType, StraightLane
from highway_env.road.road import LaneIndex, RoadNetwork
from highway_env.vehicle.behavior import IDMVehicle
from highway_env.vehicle.controller import ControlledVehicle

from study.episode.files import write_episode
from study.episode.schema import Agent, Episode, Lane, empty_states

SIMULATION_HZ = 15  # highway-env's own
LENGTH, WIDTH = 5.0, 2.0  # of every vehicle [m], highway-env's
SHORTEST = 6.0  # a drive that ends sooner, by a crash or because all have left, is driven again [s]
ATTEMPTS = 50
BORDERS = {
    LineType.NONE: "none",
    LineType.STRIPED: "dashed",
    LineType.CONTINUOUS: "curb",  # unbroken lines bound the drivable area in all three
    LineType.CONTINUOUS_LINE: "curb",
}


@dataclass(frozen=True)
class Scene:
    """One of highway-env's environments, how long it is recorded [s], and changes of its configuration."""

    environment: str
    make: type[AbstractEnv]
    seconds: float
    config: dict[str, Any]


SCENES = {
    "intersection": Scene(
        "intersection-v1",
        ContinuousIntersectionEnv,
        20.0,
        {"spawn_probability": 0.6 / SIMULATION_HZ},  # drawn at every step, by default once a second
    ),
    "roundabout": Scene("roundabout-v0", RoundaboutEnv, 14.0, {}),
    "merge": Scene("merge-v0", MergeEnv, 14.0, {}),
}


def record_scene(name: str, seed: int) -> Episode:
    """Record one drive until its time is over, a crash, or an empty road; equal arguments give equal bits."""
    for attempt in range(ATTEMPTS):
        with _kept_defaults():
            episode = _drive(name, SCENES[name], seed, attempt)
        if episode.steps >= SHORTEST * SIMULATION_HZ:
            return episode
    raise RuntimeError(f"{name}: no drive of {SHORTEST:g} s without a crash in {ATTEMPTS} attempts with seed {seed}")


@contextmanager
def _kept_defaults() -> Iterator[None]:
    """Restore the class of IDM drivers, which the intersection changes: else drives would depend on their order."""
    names = ("DISTANCE_WANTED", "COMFORT_ACC_MAX", "COMFORT_ACC_MIN")
    before = {name: getattr(IDMVehicle, name) for name in names}
    try:
        yield
    finally:
        for key, value in before.items():
            setattr(IDMVehicle, key, value)


def _drive(name: str, scene: Scene, seed: int, attempt: int) -> Episode:
    frequencies = {"simulation_frequency": SIMULATION_HZ, "policy_frequency": SIMULATION_HZ}
    drivers = {"other_vehicles_type": "highway_env.vehicle.behavior.IDMVehicle"}
    env: Any = scene.make(scene.config | frequencies | drivers)
    env.reset(seed=seed * ATTEMPTS + attempt)
    network = env.road.network
    _replace_ego(env)
    numbers: dict[int, int] = {}  # id of the vehicle object -> agent
    vehicles: list[ControlledVehicle] = []  # kept, so that no id is used again
    routes: list[np.ndarray[Any, Any]] = []
    rows: list[list[tuple[int, float, float, float, float]]] = []
    for _ in range(round(scene.seconds * SIMULATION_HZ)):
        env.road.vehicles = [vehicle for vehicle in env.road.vehicles if not _has_left(network, vehicle)]
        if not env.road.vehicles or any(vehicle.crashed for vehicle in env.road.vehicles):
            break
        row = []
        for vehicle in env.road.vehicles:
            if id(vehicle) not in numbers:
                numbers[id(vehicle)] = len(vehicles)
                vehicles.append(vehicle)
                routes.append(_route(network, vehicle))
            x, y = vehicle.position
            row.append((numbers[id(vehicle)], x, -y, -vehicle.heading, vehicle.speed))
        rows.append(row)
        env.step(None)
    env.close()
    arrays = empty_states(len(rows), len(vehicles))
    for step, row in enumerate(rows):
        for agent, x, y, heading, speed in row:
            arrays["present"][step, agent] = True
            arrays["x"][step, agent], arrays["y"][step, agent] = x, y
            arrays["heading"][step, agent] = math.remainder(heading, 2 * math.pi)
            arrays["speed"][step, agent] = max(speed, 0.0)
    return Episode(
        id=f"{name}-{seed:04d}",
        source={"writer": "highway_scenes.py", "environment": scene.environment, "seed": seed, "attempt": attempt},
        rate_hz=float(SIMULATION_HZ),
        labels="none",
        agents=tuple(Agent(number, LENGTH, WIDTH) for number in range(len(vehicles))),
        lanes=tuple(_lane(number, index, network) for number, index in enumerate(network.lanes_dict())),
        lights=(),
        light_state=np.zeros((len(rows), 0), np.uint8),
        routes=tuple(routes),
        **arrays,
    )


def _replace_ego(env: Any) -> None:
    """Put an IDM driver in the place of the environment's ego, which waits for commands."""
    ego = env.vehicle
    driver = IDMVehicle(env.road, ego.position, ego.heading, ego.speed, route=getattr(ego, "route", None))
    if driver.route is None and env.config.get("destination"):
        driver.plan_route_to(env.config["destination"])
    env.road.vehicles[env.road.vehicles.index(ego)] = driver
    env.vehicle = driver


def _has_left(network: RoadNetwork, vehicle: ControlledVehicle) -> bool:
    """Return whether a vehicle is beyond the end of a lane that leads nowhere."""
    return vehicle.lane_index[1] not in network.graph and bool(vehicle.lane.after_end(vehicle.position, None))


def _points(lane: AbstractLane) -> np.ndarray[Any, Any]:
    """Return the centre line [P, 2] m, y to the north: the ends of a straight, else points at most 1 m apart."""
    count = 1 if type(lane) is StraightLane else math.ceil(lane.length)
    return np.array([lane.position(s, 0) for s in np.linspace(0, lane.length, count + 1)]) * [1, -1]


def _lane(number: int, index: LaneIndex, network: RoadNetwork) -> Lane:
    lane = network.get_lane(index)
    left, right = (BORDERS[border] for border in lane.line_types)
    junction = index[0].startswith("ir")  # only the intersection has such a node
    return Lane(number, _points(lane), float(lane.width_at(0)), left, right, junction, lane.speed_limit)


def _route(network: RoadNetwork, vehicle: ControlledVehicle) -> np.ndarray[Any, Any]:
    """Return the planned way over the lanes nearest to each other, [P, 2] float32, empty where nothing is planned."""
    points = np.empty((0, 2))
    for start, end, number in vehicle.route or ():
        lanes = network.graph[start][end]
        options = [_points(lane) for lane in (lanes if number is None else [lanes[number]])]
        position = points[-1] if len(points) else vehicle.position * [1, -1]
        nearest = min(options, key=lambda option: float(np.hypot(*(option - position).T).min()))
        points = np.concatenate([points, nearest])
    return points.astype(np.float32)


def main(folder: Path, drives: int) -> None:
    """Record drives of the scenes in turn as `folder/<scene>-<number>`."""
    for number in range(drives):
        name = list(SCENES)[number % len(SCENES)]
        write_episode(record_scene(name, number // len(SCENES)), folder / f"{name}-{number // len(SCENES):04d}")


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]))
