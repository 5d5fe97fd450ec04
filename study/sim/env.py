"""TownEnv: the town as a gymnasium environment on highway-env (Sec. IV-A)."""

from __future__ import annotations

import math
from typing import Any, SupportsFloat

import numpy as np
from gymnasium import spaces
from highway_env.envs.common.abstract import AbstractEnv
from highway_env.envs.common.action import ActionType
from highway_env.envs.common.observation import ObservationType

from study.config.paper import ACCELERATIONS
from study.config.settings import DynamicsSettings, Model, TownSettings
from study.episode.schema import GREEN
from study.errors import BadInputError
from study.randomness import rng
from study.sim.autopilot import MOST_STEERING, REACH, Decisions, Fleet
from study.sim.dynamics import BRAKE, DT, LOOK, THROTTLE, TOP_SPEED, check_dynamics, follow_command
from study.sim.geometry import LENGTH, Floats, Ints, Pose
from study.sim.lights import LightPlan, plan_lights
from study.sim.pedestrians import Pedestrians
from study.sim.road import TownNetwork, TownRoad, TownVehicle
from study.sim.town import Town, draw_town

EGO = 0  # position of the ego among the vehicles
APART = 14.0  # smallest distance between vehicles at the start [m]
APART_LATER = 25.0  # and from a vehicle that enters later to the others, where there is such a place [m]
SPOTS = 200  # drawn for each vehicle, which takes the first good one
START_SPEED = 5.0  # [m/s]
OFF_ROUTE = 4.0  # an ego farther than this from its path has left it [m]
CURVATURES = (5.0, 10.0, 20.0)  # distances at which the ego observes the curvature of its path [m]


class Traffic(TownRoad):
    """The town's road with lights and autopilot: decides for all vehicles, then moves them with highway-env."""

    def __init__(
        self,
        town: Town,
        settings: TownSettings,
        dynamics: DynamicsSettings,
        rng: np.random.Generator,
        *,
        fast: bool,
        lights: LightPlan,
        pedestrians: Pedestrians | None = None,
    ) -> None:
        super().__init__(network=TownNetwork(town, fast=fast), np_random=rng)
        self.town, self.lights = town, lights
        self.dynamics, self.pedestrians = dynamics, pedestrians
        count = len(pedestrians) if pedestrians else 0
        self.walkers = range(settings.vehicles, settings.vehicles + count)  # the pedestrians' numbers as agents
        self.hits: list[tuple[int, int]] = []  # vehicles and the pedestrians whom they hit in the last step
        self.fleet = Fleet(town, settings.vehicles, settings.brake_hold, dynamics, rng)
        self.force, self.wheel = np.zeros((2, settings.vehicles))  # as they act [m/s2, rad]
        self.steps = 0
        self.agents: list[int] = []  # of each vehicle; a vehicle that replaces another has a new number
        self.commands: dict[int, tuple[float, float]] = {}  # vehicle -> (acceleration, steering) for this step
        self.crashed: list[int] = []  # vehicles that collided in the last step, by now replaced
        self.crash_pose: Pose  # of all vehicles after that step, before these were replaced
        self.collided = 0  # vehicles since the start
        self.decisions: Decisions  # of the step that `decided` numbers
        self.decided = -1
        self.decided_pose: Pose  # from which they follow
        self.decided_pairs: tuple[Ints, Ints]  # of vehicles within REACH of each other then
        streets = [k for k, strip in enumerate(town.strips) if k in town.ways and strip.piece.length > 2 * APART]
        self.streets = np.array(streets or sorted(town.ways), np.int64)
        pieces = [strip.piece for strip in town.strips]
        self.origins = np.array([(piece.x, piece.y) for piece in pieces])
        self.directions = np.array([(math.cos(piece.heading), math.sin(piece.heading)) for piece in pieces])
        self.lengths = np.array([piece.length for piece in pieces])
        for slot in range(settings.vehicles):
            self._enter(slot)
        self._follow(self.pose())

    @property
    def time(self) -> float:
        """Return the seconds since the start."""
        return self.steps * DT

    def _enter(self, slot: int) -> None:
        """Put a new vehicle on a free spot of some street, in place of the one in `slot`, if any."""
        others = np.array([v.position for k, v in enumerate(self.vehicles) if k != slot]).reshape(-1, 2)
        strips = self.np_random.choice(self.streets, SPOTS)
        room = np.maximum(self.lengths[strips] - APART - LENGTH, 1.0)  # not right before a stop line
        s = LENGTH + self.np_random.random(SPOTS) * room
        spots = self.origins[strips] + s[:, None] * self.directions[strips]
        free = np.sqrt(((spots[:, None] - others[None]) ** 2).sum(-1)).min(axis=1, initial=np.inf)
        good = free > (APART_LATER if self.steps else APART)
        best = int(good.argmax() if good.any() else free.argmax())
        strip, (x, y) = int(strips[best]), spots[best].tolist()
        vehicle = TownVehicle(self, [x, y], self.town.strips[strip].piece.heading, START_SPEED)
        self.fleet.place(slot, strip, float(s[best]))
        self.force[slot] = self.wheel[slot] = 0.0
        if slot < len(self.vehicles):
            self.vehicles[slot] = vehicle
            self.agents[slot] = max(*self.agents, self.walkers.stop - 1) + 1
        else:
            self.vehicles.append(vehicle)
            self.agents.append(slot)

    def _follow(self, pose: Pose) -> None:
        x, y, _, _ = pose
        self.fleet.follow(x, y)

    def decide(self) -> Decisions:
        """Return the autopilot's commands for this step, decided once; `act` may replace some."""
        if self.decided < self.steps:
            pose = self.decided_pose = self.pose()
            self.light_states = self.lights.states(self.time)
            crossings = self.pedestrians.gaps(self.fleet) if self.pedestrians else np.inf
            self.decided_pairs = self.pairs_within(REACH, pose)
            controls = self.force, self.wheel
            self.decisions = self.fleet.decide(
                self.steps, pose, controls, self.decided_pairs, self.light_states, crossings
            )
            self.decided = self.steps
        return self.decisions

    def act(self) -> None:
        """Have every vehicle do what is decided; one in `commands` takes its command from there."""
        decisions = self.decide()
        for slot, (acceleration, steering) in self.commands.items():
            decisions.acceleration[slot], decisions.steering[slot] = acceleration, steering
        speed = self.decided_pose[3]
        push = np.where(decisions.acceleration == ACCELERATIONS[1], THROTTLE[0.5], THROTTLE[1.0])
        force = np.where(decisions.acceleration == ACCELERATIONS[0], -BRAKE, push * (1 - speed / TOP_SPEED))
        force = follow_command(self.force, force, self.dynamics.lag)
        self.force = np.maximum(force, -speed / DT)  # never backwards
        wheel = -decisions.steering * self.dynamics.steering_unit
        self.wheel = follow_command(self.wheel, wheel, self.dynamics.wheel_lag)
        if not self.fast:
            for vehicle, force_now, wheel_now in zip(
                self.vehicles, self.force.tolist(), self.wheel.tolist(), strict=True
            ):
                vehicle.act({"acceleration": force_now, "steering": wheel_now})

    def near_pairs(self) -> tuple[Ints, Ints]:
        """Return at least the pairs that may touch: those of the decision, if it is of this step, reach far enough."""
        return self.decided_pairs if self.decided == self.steps else super().near_pairs()

    def controls(self) -> tuple[Pose, Floats, Floats]:
        """Return what `TownRoad.controls` does, without asking every vehicle."""
        return self.decided_pose if self.decided == self.steps else self.pose(), self.force, self.wheel

    def step(self, dt: float) -> None:
        """Move all vehicles by `dt` [s]; a new vehicle replaces each that has crashed, elsewhere."""
        super().step(dt)
        self.steps += 1
        # highway-env marks vehicles that will overlap after one more step; they count as crashed now
        self.crashed = self.struck if self.fast else self.find_struck(range(len(self.vehicles)))
        if self.pedestrians:
            self.pedestrians.walk()
            self.hits = self.pedestrians.hits(self.pose())
            self.crashed = sorted({*self.crashed, *(slot for slot, _ in self.hits)})
        self.collided += len(self.crashed)
        if self.crashed:
            self.crash_pose = self.pose()
        for slot in self.crashed:
            self._enter(slot)
        pose = self.moved if self.fast and not self.crashed else self.pose()
        self._follow(pose)
        if self.pedestrians:
            self.pedestrians.set_off(self.time, self.fleet, pose[3], self.force)


class TownAction(ActionType):
    """The ego's command: position in ACCELERATIONS, and a steering label in the autopilot's unit."""

    def space(self) -> spaces.Space[Any]:
        """Return the space: class of acceleration, and steering (positive to the left; 0.25 is the paper's crop)."""
        most = MOST_STEERING / settings_of(self.env.config, "dynamics", DynamicsSettings).steering_unit
        return spaces.Tuple((spaces.Discrete(len(ACCELERATIONS)), spaces.Box(-most, most, (1,), np.float32)))

    @property
    def vehicle_class(self) -> type[TownVehicle]:
        """Return the class of the ego."""
        return TownVehicle

    def act(self, action: tuple[int, np.ndarray[Any, Any]]) -> None:
        """Hand the command to the road, which applies all commands together."""
        level, steering = action
        self.env.road.commands[EGO] = (ACCELERATIONS[int(level)], float(np.asarray(steering).reshape(-1)[0]))


class TownObservation(ObservationType):
    """The inputs of the ego's autopilot, as a vector."""

    # speed, limit, lateral and heading error, curvatures ahead, light's distance and whether it is green, free way
    HIGH = np.array([40, 40, 20, np.pi, *[1] * len(CURVATURES), LOOK, 1, LOOK], np.float32)
    LOW = np.array([-1, 0, -20, -np.pi, *[-1] * len(CURVATURES), 0, 0, -LENGTH], np.float32)

    def space(self) -> spaces.Space[Any]:
        """Return the space in m, m/s, rad and 1/m; to the right is positive."""
        return spaces.Box(self.LOW, self.HIGH, dtype=np.float32)

    def observe(self) -> np.ndarray[Any, Any]:
        """Return the vector after the last step."""
        road: Traffic = self.env.road
        fleet, vehicle = road.fleet, road.vehicles[EGO]
        move = int(fleet.move[EGO])
        distance, green = LOOK, 1.0
        if move >= 0 and fleet.s[EGO] <= fleet.move_start[EGO]:
            distance = min(float(fleet.move_start[EGO] - fleet.s[EGO]), LOOK)
            green = float(road.lights.states(road.time)[fleet.move_signal[move]] == GREEN)
        bends = [float(fleet.ahead(fleet.curvature, np.full(len(fleet.s), s))[EGO]) for s in CURVATURES]
        course = float(fleet.ahead(fleet.heading, np.zeros(len(fleet.s)))[EGO])
        error = (course - vehicle.heading + np.pi) % (2 * np.pi) - np.pi
        gap = min(float(road.decisions.lead_gap[EGO]), LOOK) if road.steps else LOOK
        limit = float(fleet.limits[fleet.strip[EGO]])
        values = [vehicle.speed, limit, fleet.lateral[EGO], error, *bends, distance, green, gap]
        vector: np.ndarray[Any, Any] = np.array(values, np.float32).clip(self.LOW, self.HIGH)
        return vector


class TownEnv(AbstractEnv):
    """A town with its traffic at 10 Hz; the ego is one of the vehicles, the autopilot drives the others.

    An action is (class of acceleration, steering); `None` leaves the ego to the autopilot. The episode ends when the
    ego collides or leaves its planned path. Config: `town` and `dynamics` (settings or a dict), `seed` (of a `reset`
    without one; None draws one), `town_seed` (of the one town; unused with `per_drive`), `duration` [s],
    `fast_lookups` (False: highway-env's own searches). Raises BadInputError for settings that cannot be met.
    """

    @classmethod
    def default_config(cls) -> dict[str, Any]:
        """Return highway-env's settings and ours."""
        config: dict[str, Any] = super().default_config()
        return config | {
            "town": TownSettings(),
            "dynamics": DynamicsSettings(),
            "seed": None,
            "town_seed": 0,
            "duration": 60.0,
            "fast_lookups": True,
            "simulation_frequency": round(1 / DT),
            "policy_frequency": round(1 / DT),
            "screen_width": 800,
            "screen_height": 800,
            "centering_position": [0.5, 0.5],
        }

    def define_spaces(self) -> None:
        """Set our own action and observation spaces."""
        self.action_type = TownAction(self)
        self.observation_type = TownObservation(self)
        self.action_space = self.action_type.space()
        self.observation_space = self.observation_type.space()

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Draw the drive from `seed`; the same seed gives the same drive."""
        self.drive_seed = self.config["seed"] if seed is None else seed
        observation, info = super().reset(seed=seed, options=options)
        return observation, info

    def _reset(self) -> None:
        town = settings_of(self.config, "town", TownSettings)
        dynamics = settings_of(self.config, "dynamics", DynamicsSettings)
        seed = int(self.np_random.integers(2**31)) if self.drive_seed is None else self.drive_seed
        self.road = make_traffic(
            town, seed, dynamics, town_seed=self.config["town_seed"], fast=self.config["fast_lookups"]
        )
        self.controlled_vehicles = [self.road.vehicles[EGO]]

    def _simulate(self, action: Any = None) -> None:
        self.controlled_vehicles = [self.road.vehicles[EGO]]  # a new one, if the last has collided
        self.road.commands.clear()
        super()._simulate(action)

    def _reward(self, action: Any) -> SupportsFloat:
        """Return the speed as a share of the limit, -1 for a collision."""
        del action
        if EGO in self.road.crashed:
            return -1.0
        fleet = self.road.fleet
        return float(self.vehicle.speed / fleet.limits[fleet.strip[EGO]])

    def _is_terminated(self) -> bool:
        return bool(EGO in self.road.crashed or abs(self.road.fleet.lateral[EGO]) > OFF_ROUTE)

    def _is_truncated(self) -> bool:
        return bool(self.time >= self.config["duration"])


def settings_of(config: dict[str, Any], name: str, kind: type[Model]) -> Model:
    """Return a group of settings from an environment's config, where it may be a dict."""
    return kind.model_validate(config[name])


def make_traffic(
    settings: TownSettings,
    seed: int,
    dynamics: DynamicsSettings = DynamicsSettings(),  # noqa: B008 - frozen
    *,
    town_seed: int = 0,
    fast: bool = True,
) -> Traffic:
    """Return a town with lights and vehicles drawn from `seed`; the town is, unless `per_drive`, from `town_seed`.

    Raises BadInputError when the settings cannot be met.
    """
    check_dynamics(settings, dynamics)
    light_rng, traffic_rng = (rng(seed, purpose) for purpose in ("lights", "traffic"))
    town = draw_town(settings, rng(seed if settings.per_drive else town_seed, "town"))
    room = sum(town.strips[entry].piece.length for entry in town.ways)
    if settings.vehicles * 2 * APART > room:
        raise BadInputError(
            f"town: {settings.vehicles} vehicles do not fit on {room:.0f} m of lanes with {2 * APART:g} m for each; "
            f"take at most {int(room / APART / 2)} (vehicles) or a larger grid"
        )
    lights = plan_lights(town, settings, light_rng)
    walkers = None
    if settings.pedestrians:
        walkers = Pedestrians(town, settings.pedestrians, lights, rng(seed, "pedestrians"))
    return Traffic(town, settings, dynamics, traffic_rng, fast=fast, lights=lights, pedestrians=walkers)
