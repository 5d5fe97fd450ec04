"""The stage that drives: a cell's policies in held-out traffic, and the expert in the same drives."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator
from dataclasses import asdict, replace
from typing import Any

import pandas as pd
import torch

from study.birdview.film import film
from study.cell.job import CellJob
from study.cell.stages import Reporter, begin
from study.config.settings import StudySettings
from study.driving.actors import Actor, Expert, PolicyActor
from study.driving.cell_actor import cell_actor
from study.driving.drives import Drive
from study.driving.metrics import progress, score_drive
from study.driving.rollout import rollout
from study.episode.schema import Episode
from study.products import Product
from study.results.cell_result import CellResult
from study.results.drives import EXPERT, WAY

Drives = list[tuple[str, Drive]]


def drive_expert(settings: StudySettings, drives: Drives) -> Product:
    """Return the expert's drives, one row each, with the way that it makes [m], the length of the others' routes."""
    return _drive(Expert(), drives, settings, {}, [EXPERT])


def drive_policies(
    job: CellJob, result: CellResult, drives: Drives, ways: dict[int, float], report: Reporter
) -> Product:
    """Return the drives of a cell's policies, one row for each policy and drive. `ways`: the expert's, by drive."""
    actor = _actor(job, result, report)
    return _drive(actor, drives, job.settings, ways, range(actor.drivers))


def film_drives(
    job: CellJob, result: CellResult, drives: Drives, driven: pd.DataFrame, report: Reporter
) -> dict[str, bytes]:
    """Return films of the best, the median and the worst of the drives in the study's town, by driving score."""
    actor = _actor(job, result, report)
    rows = driven[(driven["place"] == "town") & (driven["policy_seed"] != EXPERT)]
    rows = rows.sort_values(["driving_score", "time", "drive", "policy_seed"])
    by_seed = {drive.seed: drive for _, drive in drives}
    films = {}
    for name, place in {"worst": 0, "median": len(rows) // 2, "best": len(rows) - 1}.items():
        row = rows.iloc[place]
        drive, policy = by_seed[row["drive"]], int(row["policy_seed"])
        (episode,) = rollout(drive, actor, job.settings, only=[policy])
        films[f"{name}.gif"] = film(episode, job.settings.birdview, ".gif", row["driving_score"])
    return films


def _actor(job: CellJob, result: CellResult, report: Reporter) -> PolicyActor:
    if job.cell.baseline:  # it looks into the frames that it was made from
        begin(job, report)
        result = _first_policies(result, job.settings.driving.baseline_policies)
    torch.set_num_threads(job.threads)
    return cell_actor(result, job.frames, job.drives, job.products)


def _first_policies(result: CellResult, count: int) -> CellResult:
    """Return a result with its first policies only."""
    weights = {
        name: value[:count] if name.startswith(("steering", "acceleration")) else value
        for name, value in result.policies.items()
    }
    return replace(result, policies=weights)


def _drive(
    actor: Actor, drives: Drives, settings: StudySettings, ways: dict[int, float], seeds: Collection[int]
) -> Product:
    rows: list[dict[str, Any]] = []
    for place, drive in drives:
        episodes = rollout(drive, actor, settings)
        rows += _rows(place, drive, zip(seeds, episodes, strict=True), ways)
    return Product({}, pd.DataFrame(rows), {})


def _rows(
    place: str, drive: Drive, driven: Iterable[tuple[int, Episode]], ways: dict[int, float]
) -> Iterator[dict[str, Any]]:
    """Yield the row of each policy's drive; without the expert's way, the drive's own is the route's length."""
    for seed, episode in driven:
        way = ways.get(drive.seed, progress(episode))
        facts = episode.source["drive"]
        where = {"policy_seed": seed, "place": place, "drive": drive.seed, WAY: way}
        yield where | {"ended": facts["ended"], "reason": facts["reason"]} | asdict(score_drive(episode, way))
