"""Record drives of TownEnv as Episodes, one for each seed."""

from __future__ import annotations

import math
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from filelock import FileLock

from study.config.keys import FORMAT_VERSIONS, drive_name
from study.config.settings import DynamicsSettings, RecordingSettings, TownSettings
from study.episode.files import write_episode
from study.episode.schema import PEDESTRIAN, Agent, Episode, Lane, Light, empty_states
from study.errors import BadInputError
from study.sim.dynamics import DT
from study.sim.env import TownEnv, Traffic
from study.sim.geometry import LANE_WIDTH, LENGTH, WIDTH, Floats, Ints
from study.sim.pedestrians import SIZE
from study.sim.town import Town
from study.stages import RECORD, Batch, Flow, Task

FORMAT_VERSION = FORMAT_VERSIONS["episodes"]  # raised when the same settings and seed give another drive
BEYOND = 60.0  # length of the planned route that is recorded beyond the last position [m]
STANDING = 0.1  # [m/s]
SPARE = 50  # columns for vehicles that replace others


def record_episode(town: TownSettings, dynamics: DynamicsSettings, recording: RecordingSettings, seed: int) -> Episode:
    """Drive by autopilot and record it at 10 Hz; equal arguments give equal bits.

    Traffic and lights are drawn from `seed`, and so is the town if it is `per_drive`; else from `recording.seed`.

    Raises BadInputError when the settings cannot be met.
    """
    steps = round(recording.duration / DT)
    if steps < 1:
        raise BadInputError(f"recording: a duration of {recording.duration:g} s is shorter than one step of {DT:g} s")
    env = TownEnv({"town": town, "dynamics": dynamics, "seed": seed, "town_seed": recording.seed, "duration": math.inf})
    recorder = Recorder(env.road, steps)
    for _ in range(round(recording.warm_up / DT)):
        env.step(None)
        recorder.watch()
    for _ in range(steps):
        recorder.before()
        env.step(None)
        recorder.after()
    cycle = 2 * (town.green + town.yellow + town.all_red)
    source = {
        "writer": "study.sim",
        "format_version": FORMAT_VERSION,
        "town": town.model_dump(mode="json"),
        "dynamics": dynamics.model_dump(mode="json"),
        "recording": {"warm_up": recording.warm_up, "duration": recording.duration},
        "seed": seed,
        "town_seed": seed if town.per_drive else recording.seed,
        "steering_unit": dynamics.steering_unit,
        "traffic": recorder.facts(cycle),
    }
    return recorder.episode(drive_name(seed), source)


class Recorder:
    """Observes a road step by step into arrays of up to `steps` steps, and makes an Episode of what it has seen.

    `arrays` are those of an Episode, with a column for each agent number; they are replaced by wider ones when vehicles
    with higher numbers come.
    """

    def __init__(self, road: Traffic, steps: int) -> None:
        self.road = road
        self.standing = np.zeros(len(road.vehicles))  # for how long [s]
        self.arrays = empty_states(steps, max(*road.agents, road.walkers.stop) + SPARE)
        self.light_state = np.zeros((steps, len(road.town.signals)), np.uint8)
        self.step = 0  # the next one, or the one between `before` and `after`
        self.seen: list[dict[str, Any]] = []  # of each step, as it was before rounding
        self.plans: dict[int, tuple[list[int], list[float]]] = {}
        self.agents = np.empty(0, np.int64)  # numbers of the vehicles in the last step recorded
        self.collided = road.collided

    def watch(self) -> None:
        """Observe a step that is not recorded."""
        _, _, _, speed = self.road.pose()
        self.standing = np.where(speed < STANDING, self.standing + DT, 0)
        self.collided = self.road.collided

    def before(self) -> None:
        """Record the poses, and what the next commands are based on. Here, and only here, y is turned to point north.

        A full stop leaves a speed of 1e-16 of either sign, which is recorded as 0.
        """
        decisions = self.road.decide()
        x, y, heading, speed = self.road.decided_pose
        self.standing = np.where(speed < STANDING, self.standing + DT, 0)
        if self.agents.tolist() != self.road.agents:
            self._meet()
        self.seen.append(
            {"agent": self.agents, "speed": speed, "standing": self.standing, "route_s": decisions.route_s}
        )
        self._write_pose(self.agents, x, y, heading, speed)
        if self.road.pedestrians:
            self._write_pose(np.array(self.road.walkers), *self.road.pedestrians.pose())
        self._write("light", decisions.light)
        self._write("light_distance", decisions.light_distance)
        self._write("route_s", decisions.route_s)
        self._write("lead_gap", np.where(np.isfinite(decisions.lead_gap), decisions.lead_gap, np.nan))
        self.light_state[self.step] = self.road.light_states

    def after(self) -> None:
        """Record the commands that were followed."""
        self._write("steering", self.road.decisions.steering)
        self._write("acceleration", self.road.decisions.acceleration)
        self.step += 1

    def _meet(self) -> None:
        """Note the plans of new vehicles, and make room for them."""
        self.agents, fleet = np.array(self.road.agents), self.road.fleet
        for slot, agent in enumerate(self.road.agents):
            self.plans.setdefault(agent, (fleet.routes[slot], fleet.starts[slot]))
        steps, columns = self.arrays["x"].shape
        if self.agents.max() >= columns:
            wider = empty_states(steps, 2 * int(self.agents.max()))
            for key, old in self.arrays.items():
                wider[key][:, :columns] = old
            self.arrays = wider

    def _write_pose(self, agents: Ints, x: Floats, y: Floats, heading: Floats, speed: Floats) -> None:
        values = {"x": x, "y": -y, "heading": np.mod(-heading + np.pi, 2 * np.pi) - np.pi}
        for name, value in {"present": True, "speed": np.maximum(speed, 0), **values}.items():
            self.arrays[name][self.step, agents] = value

    def _write(self, name: str, values: Any) -> None:
        self.arrays[name][self.step, self.agents] = values

    def facts(self, cycle: float) -> dict[str, Any]:
        """Return collisions, the share of vehicle-time standing longer than `cycle` [s], and the mean speed [m/s]."""
        standing, speed = (np.array([row[name] for row in self.seen]) for name in ("standing", "speed"))
        return {
            "collided_vehicles": self.road.collided - self.collided,
            "standing_longer_than_cycle": round(float((standing > cycle).mean()), 6),
            "light_cycle": cycle,
            "mean_speed": round(float(speed.mean()), 4),
        }

    def episode(self, name: str, source: dict[str, Any]) -> Episode:
        """Return the Episode of all recorded steps."""
        numbers, s = (np.array([row[name] for row in self.seen[: self.step]]) for name in ("agent", "route_s"))
        present, columns = np.unique(numbers, return_inverse=True)
        agents = present.tolist()
        everyone = [*agents, *self.road.walkers]
        arrays = {key: values[: self.step, everyone] for key, values in self.arrays.items()}
        routes, shifts = self._routes(agents, columns, s)
        arrays["route_s"][np.arange(self.step)[:, None], columns] = s - shifts[columns]
        lanes, lights = town_map(self.road.town)
        return Episode(
            id=name,
            source=source,
            rate_hz=1 / DT,
            labels="recorded",
            agents=tuple(self.agent(number) for number in everyone),
            lanes=lanes,
            lights=lights,
            light_state=self.light_state[: self.step].copy(),
            routes=(*routes, *[np.empty((0, 2), np.float32)] * len(self.road.walkers)),
            **arrays,
        )

    def agent(self, number: int) -> Agent:
        """Return the agent with this number."""
        walks = number in self.road.walkers
        return Agent(number, SIZE, SIZE, kind=PEDESTRIAN) if walks else Agent(number, LENGTH, WIDTH)

    def _routes(
        self, agents: list[int], columns: np.ndarray[Any, Any], s: Floats
    ) -> tuple[tuple[np.ndarray[Any, Any], ...], Floats]:
        """Return each agent's path from its first position to BEYOND its last, and its start on the route [m]."""
        lines, shifts = [], np.zeros(len(agents))
        for column, agent in enumerate(agents):
            strips, starts = self.plans[agent]
            progress = s[columns == column]
            first = int(np.searchsorted(starts, max(progress.min(), 0.0), side="right")) - 1
            last = int(np.searchsorted(starts, progress.max() + BEYOND))
            shifts[column] = starts[first]
            lines.append(route_line(self.road.town, strips[first:last]))
        return tuple(lines), shifts


def town_map(town: Town) -> tuple[tuple[Lane, ...], tuple[Light, ...]]:
    """Return the lanes and lights of a town as an Episode has them."""
    lanes = tuple(_lane(town, number) for number in range(len(town.strips)))
    signals = enumerate(town.signals)
    return lanes, tuple(Light(number, signal.stop_line * [1, -1], signal.entry) for number, signal in signals)


def route_line(town: Town, strips: list[int]) -> np.ndarray[Any, Any]:
    """Return the centre line of joined strips as an Episode has it, [P, 2] float32 m."""
    return (_line(town, strips) * [1, -1]).astype(np.float32)


def _line(town: Town, strips: list[int]) -> Floats:
    """Return the centre line of joined strips, [P, 2] m: ends of straights, points at most 1 m apart on arcs."""
    points: list[Floats] = []
    for strip in strips:
        piece = town.strips[strip].piece
        count = 1 if piece.curvature == 0 else math.ceil(piece.length)
        x, y, _ = piece.at(np.linspace(0, piece.length, count + 1))
        points.append(np.stack([x, y], axis=1)[len(points) > 0 :])
    return np.concatenate(points)


def _lane(town: Town, number: int) -> Lane:
    strip = town.strips[number]
    centre = _line(town, [number]) * [1, -1]
    return Lane(number, centre, LANE_WIDTH, strip.left, strip.right, strip.junction, strip.limit)


# --- many drives ----------------------------------------------------------------------------------------------------


def record_flow(
    town: TownSettings,
    dynamics: DynamicsSettings,
    recording: RecordingSettings,
    seeds: Sequence[int],
    folder: Path,
) -> Flow[list[Path]]:
    """Record the drives of `seeds` that `folder` lacks, as `folder/<seed:08d>`; return all paths in order of `seeds`.

    Each drive is written atomically, so a killed run can simply be repeated. Raises BadInputError for settings that
    cannot be met.
    """
    paths = [folder / drive_name(seed) for seed in seeds]
    folder.mkdir(parents=True, exist_ok=True)
    with FileLock(folder / ".lock"):
        _remove_drafts(folder)  # of runs that were killed
        missing = [(seed, path) for seed, path in zip(seeds, paths, strict=True) if not path.exists()]
        tasks = [Task(RECORD, record_drive, (town, dynamics, recording, seed, path)) for seed, path in missing]
        yield Batch(tasks, before=len(paths) - len(tasks))
        _remove_drafts(folder)  # of workers of this run that were killed
    return paths


def _remove_drafts(folder: Path) -> None:
    for draft in folder.glob(".*/"):
        shutil.rmtree(draft)


def record_drive(
    town: TownSettings, dynamics: DynamicsSettings, recording: RecordingSettings, seed: int, path: Path
) -> None:
    """Record one drive and write it to `path`."""
    write_episode(record_episode(town, dynamics, recording, seed), path)
