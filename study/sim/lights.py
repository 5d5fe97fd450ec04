"""Traffic lights: a fixed plan for each junction, in which each phase is green, yellow, then all red."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from study.config.settings import TownSettings
from study.episode.schema import GREEN, RED, YELLOW
from study.sim.town import Town


@dataclass(frozen=True)
class LightPlan:
    """The times at which lights are green. L lights, as `Town.signals`.

    `start`: [L] s, when in its cycle a light turns green, with the junction's own shift. `cycle`: [L] s.
    """

    start: NDArray[np.float64]
    cycle: NDArray[np.float64]
    green: float
    yellow: float

    def states(self, time: float) -> NDArray[np.uint8]:
        """Return the state of every light at `time` [s]: [L] uint8, GREEN, YELLOW or RED."""
        # Times are sums of tenths: without the tolerance, 5.0 may come out as 4.999... and a light 0.1 s late.
        since = np.mod(time - self.start + 1e-6, self.cycle)
        return np.where(since < self.green, GREEN, np.where(since < self.green + self.yellow, YELLOW, RED)).astype(
            np.uint8
        )

    def until_green(self, time: float) -> NDArray[np.float64]:
        """Return for how long every light stays red at `time` [s]: [L] s, 0 where it is not."""
        since = np.mod(time - self.start + 1e-6, self.cycle)
        return np.where(since < self.green + self.yellow, 0.0, self.cycle - since)


def plan_lights(town: Town, settings: TownSettings, rng: np.random.Generator) -> LightPlan:
    """Return the plan of a town's lights: each junction starts its cycle at its own moment, drawn from `rng`."""
    share = settings.green + settings.yellow + settings.all_red
    phases = np.array(town.phases)
    shift = rng.uniform(0, 1, len(phases)).round(1) * phases * share
    node = np.array([signal.node for signal in town.signals], np.int64)
    phase = np.array([signal.phase for signal in town.signals], np.int64)
    return LightPlan(phase * share - shift[node], phases[node] * share, settings.green, settings.yellow)
