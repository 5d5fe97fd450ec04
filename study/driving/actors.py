"""Who drives: the expert, the policies of a cell, and any function."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from study.config.paper import LATENT
from study.config.settings import SPEEDS
from study.driving.driver import Policies
from study.driving.observations import Encode, Observation, Observations
from study.encoder.inputs import to_float
from study.encoder.networks import encoder_of
from study.errors import BadInputError


class Commands(NamedTuple):
    """Steering labels [S], positive to the left, not yet cropped, and classes of acceleration [S], 0 to 2."""

    steering: NDArray[Any]
    level: NDArray[Any]


class Actor(Protocol):
    """Drives `drivers` egos at once, each in a town of its own.

    `commands` may raise whatever it likes, and return NaN: the rollout says where.
    """

    @property
    def name(self) -> str:
        """Return a name for people."""

    @property
    def drivers(self) -> int:
        """Return how many egos it drives."""

    @property
    def sees(self) -> bool:
        """Return whether it looks at the bird view; where not, none is painted."""

    def commands(self, seen: Observations) -> Commands | None:
        """Return the commands of all drivers; None leaves the egos to the expert."""


@dataclass(frozen=True)
class Expert:
    """The autopilot that the policies imitate; `cropped` as their steering is: the best that a policy can do."""

    cropped: bool = False
    name: str = "expert"
    drivers: int = 1
    sees: bool = False

    def commands(self, seen: Observations) -> None:
        """Leave the egos to the autopilot."""


@dataclass(frozen=True)
class FunctionActor:
    """A function of an `Observation` that returns steering and class of acceleration."""

    function: Callable[[Observation], tuple[float, int]]
    name: str = "function"
    drivers: int = 1
    sees: bool = True

    def commands(self, seen: Observations) -> Commands:
        """Call the function for every driver that is still driving."""
        commands = Commands(np.zeros(self.drivers), np.zeros(self.drivers))
        for driver in np.flatnonzero(seen.driving).tolist():
            commands.steering[driver], commands.level[driver] = self.function(seen.of(driver))
        return commands


class PolicyActor:
    """The S policies of a cell, each at the wheel of its own ego.

    `encode` maps what is seen to latents z [S, 64] float32; `policies` are the weights of a CellResult. The ten speeds
    follow z where the policies were given them (`policy.inputs`).
    """

    def __init__(self, name: str, encode: Encode, policies: Mapping[str, NDArray[Any]], *, sees: bool = True) -> None:
        self.name, self.sees, self._encode, self._policies = name, sees, encode, Policies(policies)
        self.drivers, self._width = len(policies["steering_0_weight"]), len(policies["z_mean"])
        if self._width not in {LATENT, LATENT + SPEEDS}:
            raise BadInputError(
                f"{name}: its policies take {self._width} numbers; a driver has {LATENT} of a latent, or "
                f"{LATENT + SPEEDS} with its speeds"
            )

    @torch.inference_mode()
    def commands(self, seen: Observations) -> Commands:
        """Return the steering and the likeliest class of each policy."""
        z = torch.from_numpy(self._encode(seen))
        if self._width > LATENT:
            z = torch.cat([z, torch.from_numpy(seen.speeds)], dim=1)
        outputs = self._policies.decide(z[:, None])
        return _commands(outputs["steering"][:, 0], outputs["acceleration"][:, 0])


def _commands(steering: Tensor, logits: Tensor) -> Commands:
    """Return the steering [S] and the likeliest class of logits [S, 3]; NaN stays NaN, as the class -1."""
    level = torch.where(logits.isnan().any(dim=1), -1, logits.argmax(dim=1))
    return Commands(steering.numpy(), level.numpy())


def image_encoder(weights: Mapping[str, NDArray[Any]]) -> Encode:
    """Return the function from what is seen to the latents of a trained encoder with these weights."""
    encoder = encoder_of(weights)

    @torch.inference_mode()
    def encode(seen: Observations) -> NDArray[np.float32]:
        z: NDArray[np.float32] = encoder(to_float(torch.from_numpy(seen.image))).float().numpy()
        return z

    return encode


class ExportedActor:
    """The exported network of a cell (`export_driver`, or `torch.export.load(...).module()`), without our weights.

    It gives every policy's command for every image; a policy follows that for its own. `drivers` is the number of
    policies in it.
    """

    sees = True

    def __init__(self, name: str, network: Callable[[Tensor], Mapping[str, Tensor]], drivers: int) -> None:
        self.name, self.drivers, self._network = name, drivers, network

    @torch.inference_mode()
    def commands(self, seen: Observations) -> Commands:
        """Return the steering and the likeliest class of each policy."""
        images = torch.from_numpy(seen.image)
        if self.drivers == 1:  # the export takes batches of two and more
            images = images.repeat(2, 1, 1, 1)
        outputs, each = self._network(to_float(images)), torch.arange(self.drivers)
        return _commands(outputs["steering"][each, each], outputs["acceleration"][each, each])
