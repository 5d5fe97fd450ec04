"""The grid of a sweep file: which cells a study has, and the rules of its claims."""

from __future__ import annotations

import datetime as dt
import math
from collections.abc import Iterable
from typing import Annotated, Any, Self

from pydantic import AliasChoices, BeforeValidator, Field, model_validator

from study.config.baselines import BASELINES, Baseline
from study.config.heads import HEAD_SETS, heads_of
from study.config.modules import load_modules
from study.config.settings import Count, NotNegative, Positive, Settings, Share
from study.errors import BadInputError

Fraction = Annotated[float, Field(gt=0, le=1)]
Listed = BeforeValidator(lambda value: value if isinstance(value, list | tuple) else (value,))
OneOrMore = Listed, Field(min_length=1)
EVERY = "every head set"  # the name under which one number stands for all


class Fixed(Settings):
    """When a sweep file's rules were last changed: the day, and the commit that holds them."""

    date: dt.date
    commit: str


ByHeads = Annotated[
    dict[str, NotNegative],
    BeforeValidator(lambda value: {EVERY: value} if isinstance(value, int | float) else value),
    Field(min_length=1),
]


class Rules(Settings):
    """When a claim counts as reproduced, decided before the run (docs/paper.md; used by `study.analysis.claims`).

    A sweep file gives each rule a number, or one for each profile: `{smoke: 0.1, laptop: 0.015}`; a profile that is not
    named takes the largest. `encoder_allowance` may be one for each head set instead of a number.

    The allowances stand for what a study of one encoder a cell cannot see; a run of several (`heads-encoders`) checks
    them. With s the sd over encoders of one head set (the report's variance components), two encoders differ by
    sqrt(2) s, and the largest of a claim's three contrasts by up to 3.4 s at 0.05 (of one: 2.8 s). So
    `encoder_allowance` is 3.4 s of final accuracy, `steering_allowance` 3.4 s of the final steering loss as a share of
    it, and `spread_factor` at least exp(3.4 s) with s that of the log of the variance over P policies, whose square is
    smaller than what is found by 2 / (P - 1), the part of chance: this needs P = 10 or more. benchmarks/README.md has
    what was found.
    """

    alpha: Annotated[float, Field(gt=0, lt=0.5)] = Field(0.05, description="error rate of a claim's contrasts together")
    accuracy_margin: NotNegative = Field(0.005, description="smallest difference in accuracy that matters")
    effect: Positive = Field(0.01, description="true difference in accuracy for which a finding's power is stated")
    encoder_allowance: ByHeads = Field(
        default_factory=lambda: {"rec": 0.006, "rec+pred": 0.008, "rec+plan": 0.025, "full": 0.011},
        description="what two encoders of a head set may differ in accuracy by their seeds alone; added to both ends "
        "of an interval when there is one encoder for each cell; head sets that are not named take the largest",
    )
    steering_good: Share = Field(
        0.1, description="steering is good below this loss, as a share of the best constant command's"
    )
    steering_margin: NotNegative = Field(
        0.25, description="largest difference in steering loss that is none, as a share of the reference's own loss"
    )
    steering_allowance: NotNegative = Field(
        0.17, description="what two encoders may differ in steering loss by their seeds alone, as a share of it"
    )
    reach_slack: Share = Field(0.1, description="how much later than the text says, as a share of all epochs")
    spread_factor: Annotated[float, Field(ge=1)] = Field(
        1.5,
        description="what two encoders may differ in the variance of their policies, with one encoder for each cell",
    )
    spread_ratio: Annotated[float, Field(gt=1)] = Field(
        4.0, description="true ratio of variances for which a finding's power is stated"
    )
    least_power: Share = Field(0.2, description="an open claim with less power than this cannot be tested at this size")
    least_steps: Count = Field(
        400,
        description="optimiser steps below which an encoder has not learned: at 240 the plan head of `laptop` still "
        "leaves 41 % of what can be reduced, at 480 28 % (sweeps/datasize.yaml)",
    )
    learned_share: Share = Field(
        0.25, description="share of the way from a constant picture's loss to the least possible that a head must make"
    )
    driving_margin: NotNegative = Field(
        2.0, description="smallest difference in driving score (0 to 100) that matters; of claims that are ours"
    )
    driving_effect: Positive = Field(
        10.0, description="true difference in driving score for which a finding's power is stated"
    )
    driving_allowance: NotNegative = Field(
        7.0, description="what two encoders may differ in driving score by their seeds alone, with one for each cell"
    )
    fixed: Fixed | None = Field(None, description="when these rules were last changed, and the commit that holds them")

    def allowance(self, heads: Iterable[str]) -> float:
        """Return what a contrast of cells with one encoder each may owe to their seeds, given the cells' head sets.

        Allowances are 2.4 sqrt(2) s of a head set, independent of each other, so they add up by their squares: two
        cells of one head set give its allowance, the four of a change of a difference sqrt(2) times as much.
        """
        most = max(self.encoder_allowance.values())
        return math.sqrt(sum(self.encoder_allowance.get(name, most) ** 2 for name in heads) / 2)


class Grid(Settings):
    """A sweep file: the cells of a study and what is read off them."""

    name: str
    title: str = Field(description="headline of the report")
    modules: tuple[str, ...] = Field(
        (),
        validation_alias=AliasChoices("modules", "head_modules"),  # as stores of older sweeps have it
        description="Python modules with further heads, head sets and baselines",
    )
    heads: Annotated[tuple[str, ...], *OneOrMore] = Field(description="head sets")
    fractions: Annotated[tuple[Fraction, ...], *OneOrMore] = Field(
        (1.0,), description="data fractions in (0, 1] (Sec. V-B)"
    )
    encoder_seeds: Count = Field(1, description="encoders for each head set and fraction")
    policy_seeds: Count = Field(15, description="policies on each encoder (Sec. V-A: 15)")
    reference: str = Field("rec", description="head set that the others are compared with")
    baselines: Annotated[tuple[str, ...], Listed] = Field(
        tuple(BASELINES), description="cells without a head set to compare with (docs/reading-a-report.md); [] for none"
    )
    drive: bool = Field(default=False, description="policies drive in closed loop, too (docs/drive.md)")
    claims: tuple[str, ...] = Field(
        (), description="claims of the paper, and of ours, that this sweep tests (docs/paper.md)"
    )
    rules: Rules = Field(Rules(), description="when a claim counts as reproduced")
    settings: dict[str, Any] = Field(default_factory=dict, description="settings that differ from every profile's")

    @model_validator(mode="after")
    def _known(self) -> Self:
        load_modules(self.modules)
        for heads in (*self.heads, self.reference):
            if heads not in HEAD_SETS:
                raise ValueError(f"unknown head set '{heads}'; choose from {', '.join(HEAD_SETS)}")
        try:
            heads_of(self.heads)
        except BadInputError as error:
            raise ValueError(f"a head set in study/config/heads.py has an {error}") from error
        for name in self.baselines:
            if name not in BASELINES:
                raise ValueError(f"unknown baseline '{name}'; choose from {', '.join(BASELINES)}, or [] for none")
        for name in ("heads", "fractions", "baselines"):
            values = getattr(self, name)
            if len(set(values)) != len(values):
                raise ValueError(f"{name}: {list(values)} names one twice")
        return self

    def cells(self) -> list[Cell]:
        """Return the cells in the order to run: one encoder seed of everything first, the baselines last."""
        return [
            *(
                Cell(heads=heads, fraction=fraction, encoder_seed=seed)
                for seed in range(self.encoder_seeds)
                for fraction in self.fractions
                for heads in self.heads
            ),
            *(
                Cell(heads=name, encoder_seed=seed)
                for name in BASELINES
                if name in self.baselines
                for seed in range(BASELINES[name].seeds)
            ),
        ]


class Cell(Settings):
    """One point of the grid: an encoder, and the policies on it.

    `heads` names a head set or a baseline; a baseline has no encoder with heads.
    """

    heads: str
    fraction: Fraction = 1.0
    encoder_seed: Annotated[int, Field(ge=0)] = 0

    @property
    def baseline(self) -> Baseline | None:
        """Return the record of the baseline that this cell is, if it is one."""
        return BASELINES.get(self.heads)

    @property
    def label(self) -> str:
        """Return a name for people, e.g. `rec+plan 100% e0`."""
        if self.baseline:
            return self.heads + f" e{self.encoder_seed}" * (self.baseline.seeds > 1)
        return f"{self.heads} {self.fraction * 100:g}% e{self.encoder_seed}"
