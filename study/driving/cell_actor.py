"""The policies of a finished cell as an actor, given an encoder's latents or a baseline's numbers."""

from __future__ import annotations

import pkgutil
from pathlib import Path

from study.baselines.inputs import BaselineInputs
from study.config.keys import baseline_folder
from study.data.frames import open_frames
from study.driving.actors import PolicyActor, image_encoder
from study.errors import BadInputError
from study.results.cell_result import CellResult


def cell_actor(
    result: CellResult, frames: Path, drives: Path, products: Path | None = None, device: str = "cpu"
) -> PolicyActor:
    """Return the policies of a cell, to be given to `rollout`.

    A baseline is made from the folders `frames` and `drives` of its frame store, and reads in `products` what it has
    learned (see `CellJob`, which names all three); what is missing there is learned again, on `device`. A trained
    encoder needs none of them. The modules of a user's own baseline must have been loaded (`load_modules`).
    Raises BadInputError for a baseline that cannot drive, and where its frames or drives are gone.
    """
    name, baseline = result.cell.label, result.cell.baseline
    if baseline is None:
        return PolicyActor(name, image_encoder(result.encoder), result.policies)
    if not baseline.driving:
        raise BadInputError(
            f"baseline '{baseline.name}' cannot drive: name a function as `driving` of its record "
            "(docs/extend/baseline.md), or leave it out of --baselines"
        )
    store, seed = open_frames(frames), result.cell.encoder_seed
    folder = baseline_folder(products, result.study, result.cell, store.key) if products else None
    inputs = BaselineInputs(store, drives, result.study, seed, device, lambda *_: None, folder)
    encode = pkgutil.resolve_name(baseline.driving)(inputs)
    return PolicyActor(name, encode, result.policies, sees=baseline.sees)
