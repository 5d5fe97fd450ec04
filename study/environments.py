"""The town as gymnasium environments in which a policy sees what the study's policies see.

`gymnasium.make("study.sim.register:study/BirdviewTown-v0")` finds the first, `...:study/LatentTown-v0` the second.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.numpy import load_file

from study.birdview.scene import Scene
from study.config.paper import ACCELERATIONS, IMAGE, LATENT
from study.config.settings import StudySettings
from study.config.workspace import HERE
from study.driving.drives import Drive
from study.driving.ride import Ride
from study.encoder.inputs import to_float
from study.encoder.networks import encoder_of
from study.errors import BadInputError
from study.products import Arrays
from study.results.cell_result import CellResult
from study.sim.dynamics import DT
from study.tracking.reader import Reader

Image = NDArray[np.uint8]
Action = tuple[int, NDArray[Any]] | NDArray[Any]


class BirdviewTownEnv(gymnasium.Env[NDArray[Any], Action]):
    """One ego in a town whose other vehicles are the autopilot's and react, at 10 Hz.

    Observation: the ego's bird view [64, 64, 3] uint8, bit for bit what a recorded drive renders to; with `encode`,
    what that makes of it, [64] float32. Action: (class of acceleration: 0 brake, 1 keep, 2 go; steering [1], positive
    to the left, in +-`driving.crop`). With `continuous` it is one vector in [-1, 1]: steering as a share of that, and
    acceleration, whose thirds are the classes; agents that take vectors only need that.
    Reward: speed as a share of the limit, -1 for a step that ends in a collision or without a command. The episode is
    terminated by a collision, by leaving the route, by standing without cause, and by an action that is none; it is
    truncated after `driving.duration` [s]. Then the last observation is returned again. `info` has the `speed` [m/s],
    what the `expert` would do (class, steering), and what has `ended` the drive.

    `reset(seed=N)` draws traffic, lights, ego and route; equal seeds and actions give equal bits. Without a seed the
    next one is drawn. The town is that of `settings.recording.seed`, or drawn from the seed with `town.per_drive`.
    `settings` may be a dict. Raises BadInputError for settings that cannot be met.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": round(1 / DT)}  # noqa: RUF012 - gymnasium's own way

    def __init__(
        self,
        settings: StudySettings | dict[str, Any] | None = None,
        *,
        continuous: bool = False,
        render_mode: str | None = None,
        encode: Callable[[Image], NDArray[np.float32]] | None = None,
    ) -> None:
        self.settings = StudySettings.model_validate(settings or {})
        self.continuous, self.render_mode = continuous, render_mode
        self.duration, crop = self.settings.driving.duration, self.settings.driving.crop
        self.crop = crop
        self._encode = encode
        self.observation_space: spaces.Space[Any] = spaces.Box(0, 255, (IMAGE, IMAGE, 3), np.uint8)
        if encode:
            self.observation_space = spaces.Box(-np.inf, np.inf, (LATENT,), np.float32)
        steering = spaces.Box(-crop, crop, (1,), np.float32)
        self.action_space: spaces.Space[Any] = spaces.Tuple((spaces.Discrete(len(ACCELERATIONS)), steering))
        if continuous:
            self.action_space = spaces.Box(-1, 1, (2,), np.float32)
        self.ride: Ride | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[Any], dict[str, Any]]:
        """Begin the drive of a seed, at the end of its lead-in."""
        super().reset(seed=seed, options=options)
        drawn = int(self.np_random.integers(2**31)) if seed is None else seed
        self.ride = Ride(Drive(drawn, self.settings.recording.seed, self.duration), self.settings)
        self._scene: Scene | None = None
        self._see(self.ride)
        return self._observation, self._info(self.ride)

    def step(self, action: Action) -> tuple[NDArray[Any], float, bool, bool, dict[str, Any]]:
        """Follow a command for 0.1 s."""
        ride = self._begun()
        if ride.ended:
            raise BadInputError(f"the drive has ended ({ride.ended}); call reset")
        ride.act(*self._command(action))
        road = ride.road
        reward = -1.0
        if ride.ended not in {"collision", "failure"}:
            limit = road.fleet.limits[road.fleet.strip[ride.slot]]
            reward = float(road.vehicles[ride.slot].speed / limit)
        if not ride.ended:
            self._see(ride)
        ended: str = ride.ended
        return self._observation, reward, ended not in {"", "time"}, ended == "time", self._info(ride)

    def render(self) -> Image | None:
        """Return the town from above beside what the ego sees, and its last command, [336, 512, 3] uint8."""
        if self.render_mode is None:
            gymnasium.logger.warn("render_mode was not set; make the environment with render_mode='rgb_array'")
            return None
        ride = self._begun()
        step = ride.recorder.step - bool(ride.ended)
        if self._scene is None or self._scene.episode.x is not ride.recorder.arrays["x"]:
            self._scene = Scene(ride.live, ride.agent, self.crop, ride.lead_in)
        return self._scene.frame(step, self._view, ride.recorder.step - 1)

    def _begun(self) -> Ride:
        if self.ride is None:
            raise BadInputError("no drive has begun; call reset first")
        return self.ride

    def _see(self, ride: Ride) -> None:
        ride.observe()
        self._view = ride.view()
        self._observation: NDArray[Any] = self._encode(self._view) if self._encode else self._view
        decisions, slot = ride.road.decisions, ride.slot
        level = ACCELERATIONS.index(float(decisions.acceleration[slot]))
        self._expert = level, float(decisions.steering[slot])

    def _info(self, ride: Ride) -> dict[str, Any]:
        speed = float(ride.recorder.arrays["speed"][ride.recorder.step - bool(ride.ended), ride.agent])
        return {"speed": speed, "expert": self._expert, "ended": ride.ended, "reason": ride.reason}

    def _command(self, action: Action) -> tuple[float, float]:
        """Return the steering label and the class of acceleration of an action."""
        if self.continuous:
            steering, acceleration = np.asarray(action, np.float64)
            level = np.digitize(acceleration, [-1 / 3, 1 / 3]) if np.isfinite(acceleration) else np.nan
            return float(steering * self.crop), float(level)
        level, steering = action
        return float(np.asarray(steering).reshape(-1)[0]), float(level)


def latent_town(cell: str | Path, tracking: str = HERE.tracking, **options: Any) -> BirdviewTownEnv:
    """Return the environment whose observation is the latent z [64] float32 of a finished cell's encoder.

    `cell`: the cell's key in the tracking store, a folder with its result, or a file with its encoder's weights
    (`encoder.safetensors` of that folder). Where the cell says them, town and bird view are those that it was trained
    on. Raises BadInputError for a cell that is not there.
    """
    weights, settings = _encoder(cell, tracking)
    encoder = encoder_of(weights)

    @torch.inference_mode()
    def latent(image: Image) -> NDArray[np.float32]:
        z: NDArray[np.float32] = encoder(to_float(torch.from_numpy(image[None])))[0].float().numpy()
        return z

    return BirdviewTownEnv(**{"settings": settings, **options}, encode=latent)


def _encoder(cell: str | Path, tracking: str) -> tuple[Arrays, dict[str, Any]]:
    """Return the weights of a cell's encoder, and its settings where they are known."""
    path = Path(cell)
    if path.is_file():
        try:
            return load_file(path), {}
        except SafetensorError as error:
            raise BadInputError(f"{path} holds no weights: {error}; name a cell's encoder.safetensors") from error
    if path.is_dir():
        result = CellResult.load(path)
    else:
        reader = Reader.existing(tracking)
        runs = reader.finished([str(cell)])
        if not runs:
            raise BadInputError(
                f"no finished cell '{cell}' in {tracking}, and no such file; give a key, as "
                "'python -m study.sweep heads --dry-run --json' shows them, or a folder with a cell's result"
            )
        result = reader.load_result(runs[str(cell)])
    if not result.encoder:
        raise BadInputError(f"{result.cell.label}: a baseline has no encoder; choose a cell with heads")
    return result.encoder, {
        name: value for name, value in result.settings.items() if name in StudySettings.model_fields
    }
