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
from study.episode.schema import Agent, Episode, Lane, Light, empty_states
from study.errors import BadInputError
from study.sim.dynamics import DT
from study.sim.env import TownEnv, Traffic
from study.sim.geometry import LANE_WIDTH, LENGTH, WIDTH, Floats
from study.sim.town import Town
from study.stages import RECORD, Batch, Flow, Task

FORMAT_VERSION = FORMAT_VERSIONS["episodes"]  # raised when the same settings and seed give another drive
BEYOND = 60.0  # length of the planned route that is recorded beyond the last position [m]
STANDING = 0.1  # [m/s]


def record_episode(town: TownSettings, dynamics: DynamicsSettings, recording: RecordingSettings, seed: int) -> Episode:
    """Drive by autopilot and record it at 10 Hz; equal arguments give equal bits.

    Traffic and lights are drawn from `seed`, and so is the town if it is `per_drive`; else from `recording.seed`.

    Raises BadInputError when the settings cannot be met.
    """
    steps = round(recording.duration / DT)
    if steps < 1:
        raise BadInputError(f"recording: a duration of {recording.duration:g} s is shorter than one step of {DT:g} s")
    env = TownEnv({"town": town, "dynamics": dynamics, "seed": seed, "town_seed": recording.seed, "duration": math.inf})
    recorder = Recorder(env.road)
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
    """Observes a road step by step, and makes an Episode of what it has seen."""

    def __init__(self, road: Traffic) -> None:
        self.road = road
        self.standing = np.zeros(len(road.vehicles))  # for how long [s]
        self.rows: list[dict[str, Any]] = []
        self.plans: dict[int, tuple[list[int], list[float]]] = {}
        self.collided = road.collided

    def watch(self) -> None:
        """Observe a step that is not recorded."""
        _, _, _, speed = self.road.pose()
        self.standing = np.where(speed < STANDING, self.standing + DT, 0)
        self.collided = self.road.collided

    def before(self) -> None:
        """Record the poses from which the next commands follow."""
        x, y, heading, speed = self.road.pose()
        self.standing = np.where(speed < STANDING, self.standing + DT, 0)
        fleet = self.road.fleet
        for slot, agent in enumerate(self.road.agents):
            self.plans.setdefault(agent, (fleet.routes[slot], fleet.starts[slot]))
        row = {"agent": np.array(self.road.agents), "x": x, "y": y, "heading": heading, "speed": speed}
        self.rows.append(row | {"standing": self.standing})

    def after(self) -> None:
        """Record the commands and what they were based on."""
        decisions, row = self.road.decisions, self.rows[-1]
        for name in ("steering", "acceleration", "light", "light_distance", "route_s", "lead_gap"):
            row[name] = getattr(decisions, name)
        row["light_state"] = self.road.light_states

    def facts(self, cycle: float) -> dict[str, Any]:
        """Return collisions, the share of vehicle-time standing longer than `cycle` [s], and the mean speed [m/s]."""
        standing = np.array([row["standing"] for row in self.rows])
        speed = np.array([row["speed"] for row in self.rows])
        return {
            "collided_vehicles": self.road.collided - self.collided,
            "standing_longer_than_cycle": round(float((standing > cycle).mean()), 6),
            "light_cycle": cycle,
            "mean_speed": round(float(speed.mean()), 4),
        }

    def episode(self, name: str, source: dict[str, Any]) -> Episode:
        """Return the Episode of all recorded steps. Here, and only here, y is turned to point north."""
        town, rows = self.road.town, self.rows
        agents = sorted(self.plans)
        arrays = empty_states(len(rows), len(agents))
        where = (np.arange(len(rows))[:, None], np.searchsorted(agents, np.array([row["agent"] for row in rows])))
        seen = {key: np.array([row[key] for row in rows]) for key in rows[0] if key != "agent"}
        routes, shifts = self._routes(agents, where[1], seen["route_s"])
        seen["route_s"] = seen["route_s"] - shifts[where[1]]
        seen["y"], seen["heading"] = -seen["y"], np.mod(-seen["heading"] + np.pi, 2 * np.pi) - np.pi
        seen["speed"] = np.maximum(seen["speed"], 0)  # a full stop leaves 1e-16 of either sign
        seen["lead_gap"] = np.where(np.isfinite(seen["lead_gap"]), seen["lead_gap"], np.nan)
        for key, values in arrays.items():
            values[where] = True if key == "present" else seen[key]
        return Episode(
            id=name,
            source=source,
            rate_hz=1 / DT,
            labels="recorded",
            agents=tuple(Agent(agent, LENGTH, WIDTH) for agent in agents),
            lanes=tuple(_lane(town, number) for number in range(len(town.strips))),
            lights=tuple(
                Light(number, signal.stop_line * [1, -1], signal.entry) for number, signal in enumerate(town.signals)
            ),
            light_state=seen["light_state"],
            routes=routes,
            **arrays,
        )

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
            line = _line(self.road.town, strips[first:last])
            lines.append((line * [1, -1]).astype(np.float32))
        return tuple(lines), shifts


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
