"""The model of a report: `Report` holds every number that a report prints, and its fields are those of report.json.

A report.json may be anybody's, so it is checked on reading.
"""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

from study.analysis import confounds
from study.analysis.claims import OUTCOMES, Verdict
from study.analysis.metrics import Metric
from study.config.baselines import BASELINES, CEILING
from study.config.files import validated
from study.config.settings import Number, Settings
from study.errors import BadInputError
from study.statistics import learning_curves
from study.statistics.effects import Contrast, Interval
from study.statistics.intervals import Estimate
from study.statistics.learning_curves import Point

FORMAT_VERSION = 3  # 3: baselines beside the head sets


class Part(Settings, extra="ignore"):
    """A part of a report.json; what another version adds to it is ignored."""


class Failure(Part):
    """A failed cell with the last line of its error."""

    cell: str
    reason: str


class Sweep(Part):
    """Which sweep it is, and how much of it is finished."""

    name: str
    title: str
    simulator: str
    imported: bool = False
    profile: str
    design: Literal["A", "B"]
    encoder_seeds: int
    policy_seeds: int
    policy_epochs: int
    reference: str
    heads: tuple[str, ...]
    fractions: tuple[float, ...]
    planned: int
    finished: int
    unfinished: tuple[str, ...]
    failed: tuple[Failure, ...]


class Scale(Part):
    """How much an encoder is trained at one data fraction: here, and as the paper says.

    `frames`: of training, distinct ones; `images`: shown in all epochs; `steps` of the optimiser.
    """

    fraction: float
    frames: int
    images: int
    steps: int
    paper_frames: int
    paper_images: int
    paper_steps: int


class Spread(Part):
    """A final score over seeds and, where `drives` says so, test drives.

    `units` has the value of each sampling unit by its seed; `more`: the standard error that drives add to theirs.
    """

    mean: float
    sd: Number
    iqm: Number
    low: Number
    high: Number
    n: int
    kind: str
    units: dict[int, float]
    drives: int = 0
    more: float = 0.0


class OfCell(Part):
    """What is known of a cell or a baseline, by the name of its row."""

    cell: str
    heads: str
    fraction: float

    @property
    def point(self) -> Point:
        """Return head set and fraction."""
        return (self.heads, self.fraction)


class Score(OfCell):
    """What is known of a finished cell.

    `metrics`: final scores by name of the metric; `gain`: accuracy above the best trivial baseline; `share`: its part
    of the way from there to the ceiling; `confusion`: the share of each true class (row) that is given each class after
    the last epoch; `components`: standard deviations of accuracy between encoders, policies and epochs; `losses`: those
    of each head on each split after the last epoch, with the entropy of its test targets and the test loss of the
    constant picture (study.encoder.bounds), mean over encoders; `probes`: the share of each quantity's variance that a
    linear model reads off the latents, mean over encoders.
    """

    encoders: int
    n: int
    metrics: dict[str, Spread]
    gain: Number
    share: Number = math.nan
    confusion: tuple[tuple[Number, ...], ...]
    components: dict[str, Number]
    losses: dict[str, dict[str, Number]]
    probes: dict[str, Number]

    @property
    def accuracy(self) -> Spread:
        """Return the accuracy of acceleration, which most figures and claims are about."""
        return self.metrics[learning_curves.ACCURACY]


class DrivingScore(OfCell):
    """What the policies of a cell, or the expert, did at the wheel in one place.

    `policies`: how many drove, each the same `drives`; `metrics`: means over drives by name (driving.SCORES); `rates`:
    shares of drives (RATES); `per_km`: counts over the way of all drives (PER_KM); `ended`: the share of drives that
    each of ENDS has ended.
    """

    policies: int
    drives: int
    metrics: dict[str, Spread]
    rates: dict[str, Interval]
    per_km: dict[str, Number]
    ended: dict[str, float]


class DrivingPlace(Part):
    """Driving in one place: "town" or "unseen", in words `where`."""

    place: str
    where: str
    cells: tuple[DrivingScore, ...]
    baselines: tuple[DrivingScore, ...] = ()
    expert: DrivingScore | None = None

    @property
    def rows(self) -> tuple[DrivingScore, ...]:
        """Return head sets, baselines and expert, in the order of the tables."""
        return (*self.cells, *self.baselines, *([self.expert] if self.expert else ()))


class Driving(Part):
    """What policies did at the wheel. `contrasts`: of the driving score in the study's town.

    `correlations`: Spearman's, of accuracy and driving score, over "policies", "cells" and the cells that are "head
    sets", with the number of each in `counted`.
    """

    scores: tuple[Metric, ...]
    rates: tuple[Metric, ...]
    per_km: tuple[Metric, ...]
    ends: dict[str, str]
    places: tuple[DrivingPlace, ...]
    contrasts: tuple[Contrast, ...]
    correlations: dict[str, Number]
    counted: dict[str, int]

    @property
    def town(self) -> DrivingPlace:
        """Return driving in the study's town, or in the only place that there is."""
        return self.places[0]


class Convergence(OfCell):
    """How fast a cell reaches the reference's final accuracy."""

    target: float
    mean_curve: Interval
    median: Number
    share: float
    area: float
    n: int


class VariedSetting(Part):
    """A setting under both of its values; without contrasts where no sweep varies it."""

    setting: str
    about: str
    here: str
    there: str | None
    sweep: str
    floor: Number
    contrasts: tuple[confounds.ContrastChange, ...]

    @property
    def room(self) -> float:
        """Return the largest change that the bounds of the open contrasts leave possible."""
        return max((abs(end) for row in self.contrasts for end in row.bounds if row.state == "open"), default=math.nan)

    @property
    def flipped(self) -> list[str]:
        """Return the names of the contrasts whose sign differs between the two values."""
        return [row.name for row in self.contrasts if row.here.value * row.there.value < 0]


class Setting(Part):
    """A setting with its value as text, its meaning, and whether the value is the program's default."""

    group: str
    name: str
    value: str
    meaning: str
    default: bool


class Data(Part):
    """Frames, drives and labels of each set before and after balancing, as the frame store's manifest has them."""

    key: str | None
    sets: dict[str, dict[str, Any]]


class CellCost(Part):
    """Wall time [s] and memory [bytes] of a cell, and where it ran; `total` is the cell's time from start to end."""

    cell: str
    encoder: Number
    encode: Number
    policies: Number
    total: Number
    peak_bytes: int | None
    device: str | None
    precision: str | None
    threads: int | None
    frames: int | None


class Cost(Part):
    """Costs of the finished cells, and the estimated disk space of the sweep [bytes]."""

    cells: tuple[CellCost, ...]
    seconds: float
    disk: int
    peak_bytes: int | None


class Provenance(Part):
    """Where the numbers come from; `cell_commits` has several entries where cells come from different commits.

    `cell_times`: when the first and the last cell began, in UTC, of those whose results say so; `undated`: how many do
    not. `computed_on`: the machines of the cells, with Python and torch, where one is not the client's. `unknown`: why
    commit or dirty is None.
    """

    commit: str | None
    dirty: bool | None
    unknown: str | None = None
    lock: str | None
    python: str | None
    platform: str | None
    cpu: str | None
    cores: int | None
    diff_lines: int
    packages: dict[str, str]
    cell_commits: tuple[str, ...]
    cell_times: tuple[str, ...] = ()
    undated: int = 0
    computed_on: tuple[str, ...] = ()
    command: str
    keys: dict[str, str]


class Report(Part):
    """Every number of a sweep's report: NaN where there is none, infinite for an epoch that is never reached.

    `unread`: what of the sweep and of those that it is compared with could not be read; `characters`: what to tell
    readers of characters that no font has.
    """

    format_version: int = FORMAT_VERSION
    sweep: Sweep
    scale: tuple[Scale, ...] = ()
    metrics: tuple[Metric, ...]
    floor: dict[str, Number]
    scores: tuple[Score, ...]
    baselines: tuple[Score, ...] = ()
    comparisons: tuple[Contrast, ...]
    planned_contrasts: int
    convergence: tuple[Convergence, ...]
    confounds: tuple[VariedSetting, ...] = ()
    driving: Driving | None = None
    claims: tuple[Verdict, ...]
    rules: dict[str, float | dict[str, float] | dict[str, str] | None]
    settings: tuple[Setting, ...]
    parameters: dict[str, int]
    data: Data
    cost: Cost
    provenance: Provenance
    figures: tuple[str, ...] = ()
    unread: tuple[str, ...] = ()
    characters: str = ""

    @property
    def rules_are_younger(self) -> bool:
        """Return whether the rules were last changed on a later day than a cell was computed."""
        fixed = self.rules.get("fixed")
        times = self.provenance.cell_times
        return isinstance(fixed, dict) and bool(times) and str(fixed["date"]) > times[0][:10]

    @property
    def by_point(self) -> dict[Point, Score]:
        """Return the scores of head sets by name and fraction, then those of the baselines."""
        return {row.point: row for row in (*self.scores, *self.baselines)}

    @property
    def ceiling(self) -> Spread | None:
        """Return the accuracy of policies on the true state, where they were trained."""
        return next((row.accuracy for row in self.baselines if row.heads == CEILING), None)

    @property
    def trivial(self) -> Score | None:
        """Return the best baseline that has learned nothing from driving, where there is one."""
        rows = [row for row in self.baselines if (known := BASELINES.get(row.heads)) and known.trivial]
        return max(rows, key=lambda row: row.accuracy.mean, default=None)

    @property
    def outcomes(self) -> dict[str, list[str]]:
        """Return the names of the claims of each outcome that there is."""
        outcomes = {outcome: [row.claim for row in self.claims if row.outcome == outcome] for outcome in OUTCOMES}
        return {outcome: names for outcome, names in outcomes.items() if names}

    @property
    def accuracy_contrasts(self) -> list[Contrast]:
        """Return the contrasts in acceleration accuracy."""
        return [row for row in self.comparisons if row.metric == learning_curves.ACCURACY]

    def above_reference(self, point: Point) -> Estimate | None:
        """Return the difference in accuracy of a head set to the reference at the same fraction."""
        base = (self.sweep.reference, point[1])
        for row in self.accuracy_contrasts:
            if point != base and {row.first, row.second} == {point, base}:
                gain: Estimate = row.difference
                opposite = dataclasses.replace(gain, value=-gain.value, low=-gain.high, high=-gain.low)
                return gain if row.first == point else opposite
        return None

    def json(self) -> bytes:  # type: ignore[override] # pydantic's own is deprecated
        """Return the content of report.json: NaN is null, and infinity "never"."""
        text = json.dumps(_plain(self.model_dump()), indent=1, ensure_ascii=False, allow_nan=False)
        return text.encode(errors="replace")


def _plain(value: Any) -> Any:
    """Return a value with every number as JSON has it."""
    if isinstance(value, Mapping):
        return {str(name): _plain(item) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None if math.isnan(value) else "never"
    return value


def checked(content: object, source: str) -> Report:
    """Return the report in a report.json's content. Raises BadInputError naming the source and what is wrong."""
    if not isinstance(content, dict) or "format_version" not in content:
        raise BadInputError(f"{source} is no report of this program (no format_version); give one that it wrote")
    if content["format_version"] != FORMAT_VERSION:
        raise BadInputError(
            f"{source} has report format {content['format_version']}, this program reads {FORMAT_VERSION}; "
            "write it again with: python -m study.report NAME"
        )
    return validated(Report, content, f"{source} is not a complete report; run python -m study.report NAME again")


def read_report(path: Path) -> Report:
    """Return the report in a report.json, or in the folder that holds one. Raises BadInputError when it is none."""
    file = path / "report.json" if path.is_dir() else path
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
    except OSError as error:
        raise BadInputError(f"cannot read {file}: {error.strerror}") from error
    except (ValueError, RecursionError) as error:
        raise BadInputError(f"{file} is no JSON: {error}; write it again with python -m study.report NAME") from error
    return checked(content, str(file))
