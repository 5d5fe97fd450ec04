"""What drivers see. It does not load torch, so that the process that plans a sweep may load a user's own baseline."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from study.birdview.renderer import Image
from study.data.true_state import Columns


class Observation(NamedTuple):
    """What one driver sees: the bird view [64, 64, 3] uint8, the speeds [10] m/s of now and 0.1 s to 0.9 s ago.

    `steering` and `level` are the command of 0.1 s ago, as it was applied; see `Commands`.
    """

    image: Image
    speeds: NDArray[np.float32]
    steering: float
    level: int


class Observations(NamedTuple):
    """What S drivers see, each in a town of its own; fields as in `Observation`, with S first.

    `driving` [S] bool: a drive that has ended keeps its last observation, so that a batch always has the same size.
    `state` returns what the expert decides by, see `study.data.true_state`; whoever calls it pays for it.
    """

    image: Image
    speeds: NDArray[np.float32]
    steering: NDArray[np.float32]
    level: NDArray[np.int64]
    driving: NDArray[np.bool_]
    state: Callable[[], Columns] = dict

    def of(self, driver: int) -> Observation:
        """Return what one driver sees, for it to keep."""
        image, speeds = self.image[driver].copy(), self.speeds[driver].copy()
        return Observation(image, speeds, float(self.steering[driver]), int(self.level[driver]))


Encode = Callable[[Observations], NDArray[np.float32]]  # to what policies are given, [S, 64]
