"""A cell to be trained, as every machine understands it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from study.config.grid import Cell
from study.config.settings import StudySettings
from study.intake.imported import Imported
from study.stages import Work


@dataclass(frozen=True)
class CellJob:
    """What a machine must know to train a cell.

    `frames` is the folder of the frame store and `drives` that of the drives it was made from, `imported` when these
    are not our town's; missing frames are made from them. `scratch` holds checkpoints and the products of finished
    stages. `device` is "auto" or a torch device. Folders are relative to the working folder of the process that runs.
    `modules` have further heads and baselines (see `Grid`).
    """

    cell: Cell
    key: str
    settings: StudySettings
    policy_seeds: int
    frames: Path
    drives: Path
    scratch: Path
    device: str = "auto"
    threads: int = 1
    imported: Imported | None = None
    modules: tuple[str, ...] = ()

    @property
    def work(self) -> Work:
        """Return what keys and costs of the cell's stages follow from."""
        return Work(self.settings, self.cell, self.policy_seeds, self.frames.name)

    @property
    def policy_device(self) -> str:
        """Return where policies are trained: beside an Apple GPU on the CPU, for whose cores they are small enough."""
        return "cpu" if self.device == "mps" else self.device

    @property
    def products(self) -> Path:
        """Return the folder that keeps the products of finished stages."""
        return self.scratch / "products"
