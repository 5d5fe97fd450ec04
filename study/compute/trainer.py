"""Lightning's Trainer as encoders and policies use it: one process, one device, none of its own words."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import lightning
import torch
from lightning.fabric.plugins.environments.lightning import LightningEnvironment

from study.errors import BadInputError


@contextmanager
def trainer(device: torch.device, epochs: int, load: str, remedy: str, **options: Any) -> Iterator[lightning.Trainer]:
    """Yield a Trainer for `epochs` on a device; `options` are Lightning's own.

    Raises BadInputError with the `remedy` when the device has too little memory for the `load`.
    """
    logger = logging.getLogger("lightning.pytorch")
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", module="lightning.*")  # devices, workers and its own products
            yield lightning.Trainer(
                accelerator="gpu" if device.type == "cuda" else device.type,
                devices=1 if device.index is None else [device.index],
                max_epochs=epochs,
                plugins=[LightningEnvironment()],  # one process, also inside a Slurm job
                logger=False,
                enable_checkpointing=False,
                enable_progress_bar=False,
                enable_model_summary=False,
                **options,
            )
    except torch.OutOfMemoryError as error:
        raise BadInputError(f"{device} has too little memory for {load} ({error}); {remedy}") from error
    except SystemExit as error:
        if isinstance(error.__context__, KeyboardInterrupt):  # Lightning turns Ctrl-C into an exit with code 1
            raise KeyboardInterrupt from None
        raise
    finally:
        logger.setLevel(level)
