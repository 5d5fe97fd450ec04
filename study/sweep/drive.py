"""Watch one policy of a finished cell drive, a user's own function, or the expert.

python -m study.sweep drive heads --cell 'rec+plan 100% e0' --seed 3 --out drive.mp4
python -m study.sweep drive heads --actor my_driver.py:drive --town 12
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import click

from study.atomic import write_atomic
from study.birdview.film import check_suffix, film
from study.birdview.scene import ENDINGS
from study.console.interrupts import check_stopped
from study.console.terminal import print_table
from study.driving.actors import Actor, Commands, Expert
from study.driving.cell_actor import cell_actor
from study.driving.drives import Drive, held_out_drives
from study.driving.metrics import UNITS, DriveScores, progress, score_drive
from study.driving.observations import Observations
from study.driving.rollout import ActorError, rollout
from study.driving.user_function import function_actor, place
from study.episode.schema import Episode
from study.errors import BadInputError, one_of
from study.planning.plan import Plan, cell_jobs, look_up
from study.sim.dynamics import DT
from study.sweep.verify import choose

COUNTED = ("count", "0 or 1")  # units of scores without decimals


@dataclass(frozen=True)
class Choice:
    """Who drives which held-out drive: `traffic` counts those in the study's town, `town` those in unseen towns."""

    cell: str | None
    seed: int
    actor: str | None
    traffic: int | None
    town: int | None

    def __post_init__(self) -> None:
        if (self.cell is None) == (self.actor is None):
            raise BadInputError(
                "name who drives: either --cell with the label of a finished cell, as --dry-run shows them, "
                "or --actor expert or --actor FILE.py:function"
            )
        if self.traffic is not None and self.town is not None:
            raise BadInputError("--traffic is in the study's town and --town in an unseen one; leave one of them out")


class _Watched:
    """An actor whose steps move a progress bar."""

    def __init__(self, actor: Actor, bar: Any) -> None:
        self.name, self.drivers, self.sees, self._actor, self._bar = actor.name, actor.drivers, actor.sees, actor, bar

    def commands(self, seen: Observations) -> Commands | None:
        """Return the actor's commands."""
        check_stopped()
        self._bar.update(1)
        return self._actor.commands(seen)


def drive(plan: Plan, tracking: str, choice: Choice, out: Path | None) -> int:
    """Drive, print the scores next to the expert's in the same drive, write the film, and return the exit code."""
    if out:
        check_suffix(out)
    actor = choose_actor(plan, tracking, choice)
    number = choice.town if choice.town is not None else choice.traffic or 0
    chosen = held_out_drives(plan.settings, number + 1, unseen_towns=choice.town is not None)[number]
    expert = _rollout(plan, chosen, Expert(), 0)
    episode = expert if isinstance(actor, Expert) else _rollout(plan, chosen, actor, choice.seed if choice.cell else 0)
    best, scores = (score_drive(each, progress(expert)) for each in (expert, episode))
    print_table(*_table(actor.name, scores, best))
    print(f"\n{ending(episode, scores)}")
    if out:
        write_atomic(out, film(episode, plan.settings.birdview, out.suffix, scores.driving_score))
        print(f"{out} ({out.stat().st_size / 1e6:.1f} MB)")
    return 0


def choose_actor(plan: Plan, tracking: str, choice: Choice) -> Actor:
    """Return the one who drives. Raises BadInputError for one that cannot be found."""
    if choice.actor:
        return Expert() if choice.actor == "expert" else function_actor(choice.actor)
    reader = look_up(tracking)
    runs = reader.finished(list(plan.cells)) if reader else {}
    if not reader or not runs:
        raise BadInputError(f"no cell of {plan.title} is finished; run the sweep first, or give --actor")
    result = reader.load_result(runs[choose({key: plan.cells[key] for key in runs}, choice.cell, 0)])
    job = cell_jobs(plan, "cpu", 1)[result.key]
    seeds = len(result.policies["steering_2_bias"])
    if choice.seed not in range(seeds):
        raise one_of(f"policy seed of {result.cell.label}", choice.seed, range(seeds))
    actor = cell_actor(result, job.frames, job.drives, job.products)
    actor.name = f"{result.cell.label}, policy {choice.seed}"
    return actor


def _rollout(plan: Plan, chosen: Drive, actor: Actor, driver: int) -> Episode:
    steps = round(chosen.duration / DT)
    with click.progressbar(length=steps, label=f"{actor.name} drives", file=sys.stderr) as bar:
        try:
            (episode,) = rollout(chosen, _Watched(actor, bar), plan.settings, only=[driver])
        except ActorError as error:
            raise BadInputError(f"{error}{place(error.__cause__ or error)}") from error
    return episode


def _table(name: str, scores: DriveScores, expert: DriveScores) -> tuple[list[tuple[str, ...]], list[str]]:
    rows: list[tuple[str, ...]] = [("", name, "expert", "")]
    for score in fields(DriveScores):
        unit = UNITS[score.name]
        shape = ".0f" if unit in COUNTED else ".3g"
        numbers = (f"{getattr(each, score.name):{shape}}" for each in (scores, expert))
        rows.append((score.name.replace("_", " "), *numbers, unit))
    return rows, ["bold", *[""] * (len(rows) - 1)]


def ending(episode: Episode, scores: DriveScores) -> str:
    """Return in a sentence what ended a drive."""
    facts = episode.source["drive"]
    if facts["reason"]:
        return f"{ENDINGS[facts['ended']]}: {facts['reason']}"
    fault = "" if not scores.collision else ", at fault" if scores.at_fault else ", not at fault"
    return f"{ENDINGS[facts['ended']]}{fault}, {scores.time:.1f} s of {facts['duration']:g} s driven"
