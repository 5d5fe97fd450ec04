"""Confounds: settings that could make or unmake a difference between head sets, shown under both of their values.

A confound is seen where a second sweep of the same profile differs from this one in that setting alone. Such sweeps
have files of their own (`sweeps/heads-split-frame.yaml`), so that they never take the place of the one they vary.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from study.analysis import comparisons, effects, intervals, learning_curves
from study.analysis.effects import Interval
from study.analysis.learning_curves import Point
from study.config.settings import StudySettings
from study.results.sweep_record import SweepRecord


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
        "CARLA to the letter. A difference that is there with the hold alone is one of labels that can be learned.",
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

KIND = "Welch's t, over policy or encoder seeds"
Movement = Literal["moved", "open"]


@dataclass(frozen=True)
class ContrastChange:
    """A difference in final accuracy under this sweep's setting and under the other, and what it changes by.

    `state`: "moved" where the change's interval, widened by the allowance for other encoders, excludes 0.
    """

    name: str
    first: Point
    second: Point
    here: Interval
    there: Interval
    change: Interval
    state: Movement


def concerned(record: SweepRecord) -> list[Confound]:
    """Return the confounds that this kind of sweep has."""
    several = len(record.grid.fractions) > 1
    return [confound for confound in CONFOUNDS if confound.fractions == several]


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


def contrasts(record: SweepRecord, other: SweepRecord, confound: Confound) -> list[ContrastChange]:
    """Return every head set against the baseline, at each fraction, that both sweeps have finished."""
    panels = [learning_curves.panel(each.table(), learning_curves.ACCURACY) for each in (record, other)]
    rows = []
    for pair in effects.planned(record.grid):
        second, first = sorted(pair, key=lambda point: point[0] != record.grid.baseline)
        if second[0] != record.grid.baseline or first[1] != second[1] or (confound.fractions and first[1] == 1):
            continue
        if not all(point in panel for panel in panels for point in (first, second)):
            continue
        here, there = (
            comparisons.paired(learning_curves.final(panel[first]), learning_curves.final(panel[second]))
            for panel in panels
        )
        if not len(here) or not len(there):
            continue
        change = comparisons.welch(learning_curves.by_encoder(there), learning_curves.by_encoder(here), KIND)
        one_encoder = learning_curves.design([panel[point] for panel in panels for point in (first, second)]) == "A"
        more = record.grid.rules.encoder_allowance if one_encoder else 0.0
        moved = change.low - more > 0 or change.high + more < 0
        rows.append(
            ContrastChange(
                effects.difference_label(first, second, record.grid),
                first,
                second,
                intervals.mean_interval(here),
                intervals.mean_interval(there),
                change,
                "moved" if moved else "open",
            )
        )
    return rows
