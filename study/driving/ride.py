"""One ego in one town: what it sees, what its command does, and what ends its drive."""

from __future__ import annotations

import copy
from typing import Any

import numpy as np

from study.birdview.limits import Limits
from study.birdview.renderer import Image, Renderer
from study.config.keys import drive_name
from study.config.paper import ACCELERATIONS
from study.config.settings import SPEEDS, StudySettings
from study.data.true_state import Columns, live_state
from study.driving.drives import Drive
from study.episode.schema import Episode
from study.errors import BadInputError
from study.randomness import rng
from study.sim.dynamics import DT
from study.sim.env import OFF_ROUTE, make_traffic
from study.sim.record import STANDING, Recorder, route_line, town_map

BLOCKED = 10.0  # standing this long while the expert, in its place, would go [s]
FASTEST = 14.0  # the ego's way is planned for this mean speed [m/s]


class Ride:
    """An ego at the end of its lead-in, in traffic that reacts to it.

    The autopilot drives the town's warm-up, and then the lead-in: the past poses that a bird view shows. Steps are
    recorded from the lead-in on. `ended` says in a word what has ended the drive, `reason` in a sentence; both are
    empty while it goes on. Steering commands are cropped at `driving.crop` either way (Sec. IV-C).
    """

    def __init__(self, drive: Drive, settings: StudySettings) -> None:
        self.drive, self.settings, self.crop = drive, settings, settings.driving.crop
        self.steps = round(drive.duration / DT)
        self.lead_in = settings.birdview.history
        if self.steps < 1:
            raise BadInputError(f"drive {drive.seed}: {drive.duration:g} s is shorter than one step of {DT:g} s")
        self.road = make_traffic(settings.town, drive.seed, settings.dynamics, town_seed=drive.town_seed)
        self.recorder = Recorder(self.road, self.lead_in + self.steps)
        self.slot = int(rng(drive.seed, "ego").integers(len(self.road.vehicles)))
        for _ in range(round(settings.recording.warm_up / DT)):
            self._move()
            self.recorder.watch()
        self.agent = self.road.agents[self.slot]
        self.road.fleet.plan(self.slot, FASTEST * (drive.duration + 1), rng(drive.seed, "route"))
        strips, starts = self.road.fleet.routes[self.slot], self.road.fleet.starts[self.slot]
        first = int(self.road.fleet.at[self.slot])
        self.route_start, self.route = starts[first], route_line(self.road.town, strips[first:])
        self.map = town_map(self.road.town)
        self.renderer: Renderer | None = None
        self.known: Episode | None = None
        self.ended = self.reason = ""
        self.waited = 0.0  # standing, while the expert would go [s]
        self.collision: dict[str, Any] | None = None
        for _ in range(self.lead_in):
            self.observe()
            self._move()
            self._settle()
        self.waited = 0.0

    def copy(self) -> Ride:
        """Return the same ride, for another driver: what never changes is shared."""
        network = self.road.network
        fixed = [self.settings, self.drive, self.road.town, self.road.lights, network, self.map, self.route]
        fixed += [self.road.fleet.town, self.renderer, self.known]
        fixed += [self.road.pedestrians.walks] if self.road.pedestrians else []
        return copy.deepcopy(self, {id(item): item for item in fixed})

    def observe(self) -> None:
        """Record where all vehicles are, before the step."""
        self.recorder.before()
        s = self.road.decisions.route_s[self.slot]
        self.recorder.arrays["route_s"][self.recorder.step, self.agent] = s - self.route_start
        self.expert_goes = bool(self.road.decisions.acceleration[self.slot] > ACCELERATIONS[0])

    def paint_map(self) -> Renderer:
        """Return the renderer, whose map is painted once for this ride and its copies."""
        if self.renderer is None:
            self.renderer = Renderer(self.live, self.settings.birdview, ())
        return self.renderer

    def view(self) -> Image:
        """Return what the ego sees after `observe`, [64, 64, 3] uint8: the bits that its Episode renders to."""
        renderer = self.paint_map()
        if renderer.episode is not self.live:
            self.renderer = renderer = renderer.on(self.live)
        images, _ = renderer.render(np.array([[self.recorder.step, self.agent]]))
        return np.asarray(images[0])

    def past(self) -> tuple[np.ndarray[Any, Any], float, int]:
        """Return the speeds [10] m/s of now and before, and the last command: steering and class."""
        now, arrays = self.recorder.step, self.recorder.arrays
        speeds = arrays["speed"][max(now - SPEEDS + 1, 0) : now + 1, self.agent][::-1]
        speeds = np.concatenate([speeds, np.repeat(speeds[:1], SPEEDS - len(speeds))])
        if not now:
            return speeds, 0.0, 0
        last = arrays["acceleration"][now - 1, self.agent]
        return speeds, float(arrays["steering"][now - 1, self.agent]), ACCELERATIONS.index(float(last))

    def state(self, limits: Limits) -> Columns:
        """Return what the expert decides by, of the last step that was observed, as `Observations` has it."""
        step = max(self.recorder.step - bool(self.ended), 0)
        return live_state(self.live, np.array([[step, self.agent]]), self.settings.birdview, limits)

    def act(self, steering: float, level: float) -> None:
        """Follow a command, the steering cropped; one that is none ends the drive as a failure."""
        if not np.isfinite(steering) or level not in range(len(ACCELERATIONS)):
            self.fail(f"the actor returned steering {steering:g} and class of acceleration {level:g}")
            return
        command = ACCELERATIONS[int(level)], float(np.clip(steering, -self.crop, self.crop))
        self.road.commands[self.slot] = command
        self.follow()

    def follow(self, *, cropped: bool = False) -> None:
        """Move everything on by a step, the ego by its command or the expert's, whose steering may be cropped."""
        if cropped:
            steering, acceleration = (getattr(self.road.decisions, name) for name in ("steering", "acceleration"))
            most = np.clip(steering[self.slot], -self.crop, self.crop)
            self.road.commands[self.slot] = float(acceleration[self.slot]), float(most)
        self._move()
        self._settle()

    def fail(self, reason: str) -> None:
        """End the drive as a failure of the actor."""
        self.ended, self.reason = "failure", f"{reason}, {self.time:.1f} s into drive {self.drive.seed}"

    @property
    def time(self) -> float:
        """Return the seconds that the actor has driven."""
        return max(self.recorder.step - self.lead_in, 0) * DT

    def _move(self) -> None:
        self.road.act()
        self.road.step(DT)
        self.road.commands.clear()

    def _settle(self) -> None:
        """Record what was done, and see whether it has ended the drive."""
        self.recorder.after()
        road, slot = self.road, self.slot
        standing = road.vehicles[slot].speed < STANDING and self.expert_goes
        self.waited = self.waited + DT if standing else 0.0
        if slot in road.crashed:
            self.ended, self.collision = "collision", self._collision()
        elif abs(road.fleet.lateral[slot]) > OFF_ROUTE:
            self.ended = "off route"
        elif self.waited > BLOCKED - DT / 2:
            self.ended = "blocked"
        elif self.recorder.step == self.lead_in + self.steps:
            self.ended = "time"

    def _collision(self) -> dict[str, Any]:
        """Return number and pose of the pedestrian hit, or else of the nearest vehicle that crashed, and the ego's."""
        road, slot = self.road, self.slot
        met = dict(road.hits).get(slot)
        if met is not None and road.pedestrians:
            agent, pose = road.walkers[met], np.stack(road.pedestrians.pose())[:, met]
        else:
            others = np.array([other for other in road.crashed if other != slot])
            x, y, _, _ = road.crash_pose
            other = others[np.hypot(x[others] - x[slot], y[others] - y[slot]).argmin()]
            agent, pose = int(self.recorder.seen[-1]["agent"][other]), np.stack(road.crash_pose)[:, other]
        ego = np.stack(road.crash_pose)[:, slot]
        poses = {name: (values * [1, -1, -1, 1]).tolist() for name, values in (("ego", ego), ("other", pose))}
        return {"agent": agent, **poses}

    @property
    def live(self) -> Episode:
        """Return the Episode so far, whose arrays are those that the recorder fills."""
        if self.known is None or self.known.x is not self.recorder.arrays["x"]:
            self.known = self._so_far()
        return self.known

    def _so_far(self) -> Episode:
        arrays = self.recorder.arrays
        columns = arrays["x"].shape[1]
        lanes, lights = self.map
        empty = np.empty((0, 2), np.float32)
        return Episode(
            id=drive_name(self.drive.seed),
            source={},
            rate_hz=1 / DT,
            labels="recorded",
            agents=tuple(self.recorder.agent(number) for number in range(columns)),
            lanes=lanes,
            lights=lights,
            light_state=self.recorder.light_state,
            routes=tuple(self.route if number == self.agent else empty for number in range(columns)),
            **arrays,
        )

    def episode(self, actor: str, driver: int) -> Episode:
        """Return the drive as an Episode; `source["drive"]` says who drove and what ended it."""
        settings = self.settings
        source = {
            "writer": "study.driving",
            "town": settings.town.model_dump(mode="json"),
            "dynamics": settings.dynamics.model_dump(mode="json"),
            "seed": self.drive.seed,
            "town_seed": self.drive.seed if settings.town.per_drive else self.drive.town_seed,
            "steering_unit": settings.dynamics.steering_unit,
            "drive": {
                "actor": actor,
                "driver": driver,
                "crop": self.crop,
                "ego": self.agent,
                "duration": self.drive.duration,
                "first_step": self.lead_in,
                "ended": self.ended,
                "reason": self.reason,
                "collision": self.collision,
            },
        }
        return self.recorder.episode(drive_name(self.drive.seed), source)
