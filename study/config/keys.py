"""Content keys: what a product depends on names the product."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from study.config.baselines import SUPERVISED
from study.config.grid import Cell
from study.config.heads import HEAD_SETS, further_masks
from study.config.settings import StudySettings


def content_key(stage: str, settings: object, inputs: tuple[str, ...], format_version: int) -> str:
    """Key of a stage's product: 16 hex digits of sha256 over the canonical JSON of all that it is made from."""
    plain = settings.model_dump(mode="json") if isinstance(settings, BaseModel) else settings
    text = json.dumps(
        {"stage": stage, "settings": plain, "inputs": inputs, "format_version": format_version},
        sort_keys=True,
        separators=(",", ":"),
        allow_nan=False,
    )
    return hashlib.sha256(text.encode()).hexdigest()[:16]


# Raised on purpose when a stage's code changes what it makes; a test holds each product's digest.
FORMAT_VERSIONS = {"episodes": 3, "frames": 3, "encoder": 3, "baseline": 1, "cell": 3, "drive": 1}


def recording_key(settings: StudySettings) -> str:
    """Key of the drives: each is then known by its seed. How many there are does not matter here."""
    parts = {
        "town": settings.town.model_dump(mode="json"),
        "dynamics": settings.dynamics.model_dump(mode="json"),
        "warm_up": settings.recording.warm_up,
        "duration": settings.recording.duration,
    }
    if not settings.town.per_drive:
        parts["town_seed"] = settings.recording.seed
    return content_key("episodes", parts, (), FORMAT_VERSIONS["episodes"])


def drive_name(seed: int) -> str:
    """Name of the drive of that seed, in the folder of its recording key."""
    return f"{seed:08d}"


def frames_key(settings: StudySettings, source: str | None = None) -> str:
    """Key of the frame store; `source` stands for the drives when they are not our town's."""
    parts: dict[str, Any] = {
        "frames": settings.frames.model_dump(mode="json", exclude={"unit"}),  # says how a store is used
        "birdview": settings.birdview.model_dump(mode="json"),
    }
    if further_masks():
        parts["masks"] = further_masks()
    if source is None:
        parts["drives"] = settings.recording.model_dump(
            mode="json", include={"encoder_episodes", "policy_episodes", "seed"}
        )
    return content_key("frames", parts, (source or recording_key(settings),), FORMAT_VERSIONS["frames"])


def encoder_key(settings: StudySettings, cell: Cell, frames: str) -> str:
    """Key of a trained encoder, or of a baseline. What makes no difference at the full data is left out there."""
    if cell.baseline:
        training = settings.encoder.model_dump(mode="json", include={"batch", "lr"}) | {"share": settings.policy.share}
        named = {"name": cell.heads, "seed": cell.encoder_seed} | (training if cell.heads == SUPERVISED else {})
        return content_key("baseline", named, (frames,), FORMAT_VERSIONS["baseline"])
    parts: dict[str, Any] = {
        "encoder": settings.encoder.model_dump(mode="json", exclude={"budget", "head_weights"}),
        "heads": {head: settings.encoder.head_weights.get(head, 1.0) for head in HEAD_SETS[cell.heads].heads},
        "fraction": cell.fraction,
        "encoder_seed": cell.encoder_seed,
    }
    if cell.fraction < 1:
        parts |= {"budget": settings.encoder.budget, "unit": settings.frames.unit}
    return content_key("encoder", parts, (frames,), FORMAT_VERSIONS["encoder"])


def baseline_folder(products: Path, settings: StudySettings, cell: Cell, frames: str) -> Path:
    """Return the folder that keeps what a baseline has learned."""
    return products / f"baseline-{encoder_key(settings, cell, frames)}"


def cell_key(settings: StudySettings, cell: Cell, policy_seeds: int, frames: str) -> str:
    """Key of a cell's result: its encoder and the policies on it."""
    parts = {"policy": settings.policy.model_dump(mode="json"), "policy_seeds": policy_seeds}
    return content_key("cell", parts, (encoder_key(settings, cell, frames),), FORMAT_VERSIONS["cell"])


def drive_key(settings: StudySettings, cell: str = "") -> str:
    """Key of the held-out drives of a cell's policies, given its key, or of the expert's."""
    parts = {
        "driving": settings.driving.model_dump(mode="json", exclude=None if cell else {"crop", "baseline_policies"}),
        "birdview": settings.birdview.model_dump(mode="json"),
        "seed": settings.recording.seed,
    }
    inputs = (recording_key(settings), cell) if cell else (recording_key(settings),)
    return content_key("drive", parts, inputs, FORMAT_VERSIONS["drive"])
