"""A cell to be trained, as every machine understands it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from study.config.grid import Cell
from study.config.settings import StudySettings
from study.episode.imported import Imported


@dataclass(frozen=True)
class CellJob:
    """All that training a cell needs to know, on any machine.

    `frames` is the frame store's folder and `drives` that of the drives it was made from, `imported` when these are not
    our town's; where the frames are missing they are made from them. `scratch` holds checkpoints and the products of
    finished stages. `device` is "auto" or a torch device. Folders are relative to the working folder of whoever runs.
    `head_modules` name further heads (see `Grid`).
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
    head_modules: tuple[str, ...] = ()
