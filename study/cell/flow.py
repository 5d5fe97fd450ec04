"""The main path of one cell: a trained encoder, its latents, the policies on them, one CellResult.

Products of finished stages are kept under the job's `scratch` by key, so that a killed sweep resumes. Tasks name the
functions of `study.cell.stages`, since the process that only plans and commits does not load torch.
"""

from __future__ import annotations

import math
from collections.abc import Generator, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from study.cell.job import CellJob
from study.config.keys import drive_key
from study.config.settings import StudySettings
from study.engine.room import with_room
from study.errors import BadInputError
from study.products import Product, read_product, write_product
from study.results.cell_result import CellResult
from study.results.drives import WAY
from study.stages import DRIVE, ENCODER, LATENTS, POLICY, RESULT, Batch, Flow, Stage, Task

SHARE_SECONDS = 40.0  # on one core of the reference machine, of a share of the policies: what a kill costs at most
HEAD = "product.json"
STAGE_MODULE, DRIVING_MODULE = "study.cell.stages", "study.cell.driving"
EXPERT_DRIVES = 5  # of the expert in one task: some ten seconds


def cell_flow(job: CellJob, *, one_share: bool = False) -> Flow[tuple[CellResult, bytes]]:
    """Train the cell's encoder, encode the policy set, train its policies in shares, and assemble the result.

    A baseline has no encoder: what its policies are given stands in the place of latents. With `one_share` all policies
    are trained at once, which is fastest on a GPU. Returns the result and its network, an archive of torch.export,
    empty for a baseline.
    """
    encoder = None
    if not job.cell.baseline:
        folder = job.products / f"encoder-{ENCODER.key(job.work)}"
        (encoder,) = yield from _keep([folder], ("weights", "samples"), [_task(ENCODER, "train_cell_encoder", job)])
    (latents,) = yield Batch([_task(LATENTS, "encode_policy_set", job, encoder)])
    count = min(job.policy_seeds, math.ceil(2 * POLICY.cost(job.work) / SHARE_SECONDS))
    if one_share and job.policy_device == job.device:
        count = 1
    shares = [share.tolist() for share in np.array_split(np.arange(job.policy_seeds), count)]
    policies = yield from _keep(
        [job.products / f"policies-{job.key}-{seeds[0]}-{seeds[-1]}" for seeds in shares],
        ("weights", "predictions"),
        [_task(POLICY, "train_policy_share", job, latents, seeds, weight=len(seeds)) for seeds in shares],
    )
    result: tuple[CellResult, bytes]
    (result,) = yield Batch([Task(RESULT, f"{STAGE_MODULE}:assemble_result", (job, encoder, latents, policies))])
    return result


def expert_flow(settings: StudySettings, drives: Sequence[Any], products: Path) -> Flow[pd.DataFrame]:
    """Have the expert drive, and return its drives, one row each."""
    shares = [drives[first : first + EXPERT_DRIVES] for first in range(0, len(drives), EXPERT_DRIVES)]
    folders = [products / f"drive-{drive_key(settings)}-{first}" for first in range(len(shares))]
    tasks = [Task(DRIVE, f"{DRIVING_MODULE}:drive_expert", (settings, share), len(share)) for share in shares]
    driven = yield from _keep(folders, (), tasks)
    return pd.concat([product.curves for product in driven], ignore_index=True)


def drive_flow(
    job: CellJob, result: CellResult, drives: Sequence[Any], expert: pd.DataFrame
) -> Flow[tuple[pd.DataFrame, dict[str, bytes]]]:
    """Have the policies of a finished cell drive; return the drives, the expert's first, and films by file name.

    Nothing of the tracker is needed: the weights are those of the result.
    """
    needed = replace(result, curves=result.curves[:0], samples={}, predictions={})
    ways = dict(zip(expert["drive"], expert[WAY], strict=True))
    count = math.ceil(len(drives) * SHARE_SECONDS / max(2 * DRIVE.cost(job.work), 1.0))
    shares = [drives[first : first + count] for first in range(0, len(drives), count)]
    folders = [job.products / f"drive-{DRIVE.key(job.work)}-{count}-{first}" for first in range(len(shares))]
    tasks = [
        Task(DRIVE, f"{DRIVING_MODULE}:drive_policies", (job, needed, share, ways), len(share), reports=True)
        for share in shares
    ]
    driven = yield from _keep(folders, (), tasks)
    table = pd.concat([expert, *(product.curves for product in driven)], ignore_index=True)
    filming = Task(DRIVE, f"{DRIVING_MODULE}:film_drives", (job, needed, drives, table), reports=True)
    (films,) = yield Batch([filming], before=len(drives))
    return table, films


def _task(stage: Stage, function: str, job: CellJob, *args: Any, weight: int = 1) -> Task:
    accelerated = stage is not POLICY or job.policy_device == job.device
    return Task(stage, f"{STAGE_MODULE}:{function}", (job, *args), weight, reports=True, accelerated=accelerated)


def product_folders(job: CellJob) -> list[Path]:
    """Return the kept policies of a cell: nobody needs them once the cell is committed."""
    return list(job.products.glob(f"policies-{job.key}-*"))


def driven_folders(job: CellJob) -> list[Path]:
    """Return the kept drives of a cell: nobody needs them once they are committed."""
    return list(job.products.glob(f"drive-{DRIVE.key(job.work)}-*"))


def _keep(folders: list[Path], parts: tuple[str, ...], tasks: list[Task]) -> Generator[Batch, list[Any], list[Product]]:
    """Return the products in these folders; the tasks make those that are missing or damaged, and these are kept."""
    products: dict[Path, Product] = {}
    for folder in folders:
        with suppress(BadInputError):
            head, arrays, curves = read_product(folder, HEAD, parts)
            products[folder] = Product(arrays, curves, head["facts"])
    missing = {folder: task for folder, task in zip(folders, tasks, strict=True) if folder not in products}
    before = sum(task.weight for folder, task in zip(folders, tasks, strict=True) if folder in products)
    left = list(missing)

    def keep(index: int, product: Product) -> None:
        facts = {"facts": product.facts}
        with_room(partial(write_product, left[index], HEAD, facts, product.parts, product.curves))

    products |= zip(left, (yield Batch(list(missing.values()), before, keep)), strict=True)
    return [products[folder] for folder in folders]
