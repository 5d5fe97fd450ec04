"""What a baseline is made from."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from study.config.settings import StudySettings
from study.data.frames import FrameStore

Z = NDArray[np.float32]


@dataclass(frozen=True)
class BaselineInputs:
    """The frames, the folder of the drives they were made from, and what a training needs.

    A baseline is a function of this that returns z [N, 64] float32 of all N frames of the policy set. It may raise
    BadInputError for frames that it cannot be made from. `progress(done, total)` is for those that take long.
    """

    store: FrameStore
    drives: Path
    settings: StudySettings
    seed: int
    device: str
    progress: Callable[[int, int], Any]
