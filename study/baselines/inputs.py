"""What a baseline is made from."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from filelock import FileLock
from numpy.typing import NDArray

from study.config.settings import StudySettings
from study.data.frames import FrameStore
from study.errors import BadInputError
from study.products import Arrays, read_product, write_product

HEAD = "baseline.json"

Z = NDArray[np.float32]


@dataclass(frozen=True)
class BaselineInputs:
    """The frames, the folder of the drives they were made from, and what a training needs.

    A baseline is a function of this that returns z [N, 64] float32 of all N frames of the policy set. It may raise
    BadInputError for frames that it cannot be made from. `progress(done, total)` is for those that take long. `folder`
    keeps what it has learned, see `learned`; without one, nothing is kept.
    """

    store: FrameStore
    drives: Path
    settings: StudySettings
    seed: int
    device: str
    progress: Callable[[int, int], Any]
    folder: Path | None = None


def learned(inputs: BaselineInputs, learn: Callable[[], Arrays]) -> Arrays:
    """Return the arrays that `learn` returns: those that are kept, or new ones where these are missing or damaged."""
    if inputs.folder is None:
        return learn()
    inputs.folder.parent.mkdir(parents=True, exist_ok=True)
    with FileLock(inputs.folder.with_name(f".{inputs.folder.name}.lock")):
        with suppress(BadInputError):
            return read_product(inputs.folder, HEAD, ("weights",))[1]["weights"]
        weights = learn()
        write_product(inputs.folder, HEAD, {}, {"weights": weights}, pd.DataFrame())
    return weights
