"""Held-out drives: traffic that neither the encoder set nor the policy set holds, the same list for every actor."""

from __future__ import annotations

from dataclasses import dataclass

from study.config.settings import StudySettings
from study.data.prepare import POLICY_SEED
from study.results.drives import PLACES

STUDY_TOWN = 2 * POLICY_SEED  # held-out drives in the study's town are numbered from here
UNSEEN_TOWNS = 3 * POLICY_SEED  # and those in towns that no recorded drive is in, one for each drive


@dataclass(frozen=True)
class Drive:
    """A drive to be driven for `duration` [s]: traffic, lights, ego and its route from `seed`, the town from its own.

    With `town.per_drive` the town, too, is drawn from `seed`.
    """

    seed: int
    town_seed: int
    duration: float


def held_out_drives(
    settings: StudySettings, count: int | None = None, *, unseen_towns: bool = False
) -> tuple[Drive, ...]:
    """Return the list of drives in the study's town, or that in unseen towns: its first `count`, or the study's."""
    driving = settings.driving
    if count is None:
        count = driving.unseen_towns if unseen_towns else driving.drives
    first = settings.recording.seed + (UNSEEN_TOWNS if unseen_towns else STUDY_TOWN)
    town = settings.recording.seed
    return tuple(Drive(seed, seed if unseen_towns else town, driving.duration) for seed in range(first, first + count))


def planned_drives(settings: StudySettings) -> list[tuple[str, Drive]]:
    """Return the drives of every cell of a study with their place, "town" or "unseen"."""
    return [(place, drive) for place in PLACES for drive in held_out_drives(settings, unseen_towns=place != PLACES[0])]
