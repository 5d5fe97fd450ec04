"""Confounds: settings that could make or unmake a difference between head sets, shown under both of their values.

A confound is seen where a second sweep of the same profile differs from this one in that setting alone. Such sweeps
have files of their own (`sweeps/heads-split-frame.yaml`), so that they never take the place of the one they vary.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

from study.config.grid import Grid
from study.config.settings import Number, StudySettings
from study.results.sweep_record import SweepRecord
from study.statistics import comparisons, effects, intervals, learning_curves
from study.statistics.effects import Interval
from study.statistics.intervals import Sample
from study.statistics.learning_curves import ACCURACY, Point


@dataclass(frozen=True)
class Confound:
    """A setting, the sweep that varies it, why it matters; `fractions`: at less than all the data only."""

    setting: str
    sweep: str
    fractions: bool
    about: str


CONFOUNDS = (
    Confound(
        "frames.split",
        "heads-split-frame",
        fractions=False,
        about="Split by episode, no test frame comes from a drive that was trained on. Split by frame, as the text may "
        "be read, the same vehicle a second earlier is among the training frames: what is gained there is memory of "
        "drives, not driving.",
    ),
    Confound(
        "town.brake_hold",
        "heads-brake-hold-0",
        fractions=False,
        about="A brake, once on, is held for half a second, so that labels do not flip from frame to frame; 0 is "
        "CARLA to the letter. With the hold, half a second of labels follows from the last one: a head set that only "
        "keeps the last command better gains from it.",
    ),
    Confound(
        "frames.balance",
        "heads-balance-steering",
        fractions=False,
        about="The paper balances its policy set 'especially for steering'. Balanced for steering alone, the classes "
        "of acceleration are as common as on the road: the floor is higher, and less is left to gain above it.",
    ),
    Confound(
        "encoder.loss",
        "heads-loss-mean",
        fractions=False,
        about="Summed over an image's numbers, as the paper writes it, rec weighs three times as much as a mask; as "
        "means, each head weighs the same. A difference that is there with the means alone is one of weights.",
    ),
    Confound(
        "encoder.epochs",
        "heads-short",
        fractions=False,
        about="The same data in fewer steps. A difference that grows with the steps may grow further than this scale "
        "shows.",
    ),
    Confound(
        "policy.inputs",
        "heads-given-speed",
        fractions=False,
        about="Policies that are given the true speeds of the past second need not read them off the latent. A "
        "difference that goes away then was one in how well speed can be read.",
    ),
    Confound(
        "policy.share",
        "heads-policy-half",
        fractions=False,
        about="Policies learn from a part of their training frames. A difference that is larger there is one that more "
        "frames for policies would make smaller.",
    ),
    Confound(
        "encoder.budget",
        "datasize-budget-steps",
        fractions=True,
        about="With the same epochs, less data is also fewer steps. With the same steps, only the data differ: a "
        "difference at a small fraction that shrinks then was one of training length.",
    ),
    Confound(
        "frames.unit",
        "datasize-unit-drive",
        fractions=True,
        about="A part of the frames, as the text says, still comes from every drive. A part of the drives is what "
        "recording less would give: fewer towns, fewer situations.",
    ),
)

Movement = Literal["moved", "open"]


@dataclass(frozen=True)
class ContrastChange:
    """A difference in final accuracy under this sweep's setting and under the other, and what it changes by.

    `bounds`: the ends that decide, simultaneous over the confound's contrasts and widened by the allowance for other
    encoders; `state`: "moved" where they exclude 0. "open" is no proof that nothing moves.
    """

    name: str
    first: Point
    second: Point
    here: Interval
    there: Interval
    change: Interval
    state: Movement
    bounds: tuple[Number, Number] = (math.nan, math.nan)


def concerned(record: SweepRecord) -> list[Confound]:
    """Return the confounds that this kind of sweep has. Imported drives have none of our town's."""
    several, imported = len(record.grid.fractions) > 1, bool(record.data.get("writers"))
    return [
        confound
        for confound in CONFOUNDS
        if confound.fractions == several and not (imported and confound.setting.startswith("town."))
    ]


def varied(one: StudySettings, other: StudySettings) -> Confound | None:
    """Return the confound that two settings differ in, where they differ in nothing else."""
    here, there = (
        {f"{group}.{name}": value for group, part in settings for name, value in part} for settings in (one, other)
    )
    names = [name for name in here if here[name] != there[name]]
    return next((confound for confound in CONFOUNDS if [confound.setting] == names), None)


def value(settings: StudySettings, setting: str) -> str:
    """Return a setting's value as a word."""
    group, _, name = setting.partition(".")
    return str(getattr(getattr(settings, group), name))


def pairs(grid: Grid, confound: Confound) -> list[tuple[Point, Point]]:
    """Return the contrasts that a confound may move: all pairs of head sets at each fraction, and across fractions.

    Across fractions, every head set with part of the data is set against the reference with all of it, as the claims
    about data size do. What matters below all the data only leaves out the pairs at all the data.
    """
    top = max(grid.fractions)
    plan = [pair for pair in effects.planned(grid) if not confound.fractions or pair[0][1] != top]
    across = [(point, (grid.reference, top)) for point in effects.points(grid) if point[1] != top]
    return list(dict.fromkeys([*plan, *across] if grid.reference in grid.heads else plan))


def contrasts(record: SweepRecord, other: SweepRecord, confound: Confound) -> list[ContrastChange]:
    """Return how each contrast that both sweeps have finished changes with the setting.

    A cell that is one and the same in both sweeps, as those at all the data may be, is no part of the change.
    """
    here, there = (_cells(each) for each in (record, other))
    plan, rows = pairs(record.grid, confound), []
    for pair in plan:
        if not all(point in cells for cells in (here, there) for point in pair):
            continue
        other_cells = [point for point in pair if not here[point].values.equals(there[point].values)]
        parts = [comparisons.paired_sample(*(cells[point] for point in pair)) for cells in (here, there)]
        if not other_cells or not all(len(part.values) for part in parts):
            continue
        means = [intervals.crossed(part) for part in parts]
        if len(other_cells) == 1:
            sign = 1.0 if other_cells == [pair[0]] else -1.0
            parts = [replace(cells[other_cells[0]], sign=sign) for cells in (here, there)]
        change = intervals.crossed(parts[1], replace(parts[0], sign=-parts[0].sign))
        alone = [point[0] for cells in (here, there) for point in other_cells if _one_encoder(cells[point])]
        bounds = change.limits(1 - record.grid.rules.alpha / len(plan), record.grid.rules.allowance(alone))
        moved: Movement = "moved" if bounds[0] > 0 or bounds[1] < 0 else "open"
        name = effects.difference_label(*pair, record.grid)
        shown, there_shown = (mean.estimate() for mean in means)
        rows.append(ContrastChange(name, *pair, shown, there_shown, change.estimate(), moved, bounds))
    return rows


def _cells(record: SweepRecord) -> dict[Point, Sample]:
    curves = learning_curves.panel(record.table(), ACCURACY)
    return effects.samples(curves, effects.drive_scores(record, ACCURACY, curves))


def _one_encoder(cell: Sample) -> bool:
    return learning_curves.encoders(cell.values) == 1
