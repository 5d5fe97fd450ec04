"""Two sweeps side by side: what they differ in, their scores with differences, orders of head sets, verdicts.

Whatever made them: two commits, two simulators, two profiles, two stores. All of it comes from their report.json, which
may be anybody's, so it is checked on reading.
"""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Literal, NamedTuple

from study import stats
from study.claims import MINUS
from study.config import HEAD_SETS, BadInputError, Cell, Settings, validated
from study.markdown import LOSS, NOTHING, SHARE_WORDS, between, code, fixed, found, plain, rows
from study.stats import Estimate
from study.summary import FORMAT_VERSION

Number = float | Literal["never"] | None


class Measure(NamedTuple):
    """A score: its name in a report.json, how tables print it, and the guess that makes its floor."""

    name: str
    title: str
    digits: int
    factor: float
    guess: str


MEASURES = (
    Measure("accuracy", "accuracy [%]", 2, 100.0, "commonest class"),
    Measure("steering", f"steering [{LOSS}]", 3, 1e3, "best constant command"),
)


class Part(Settings, extra="ignore", allow_inf_nan=False):
    """What a comparison needs of a part of a report.json."""


class SweepPart(Part):
    """Which sweep it is."""

    name: str
    title: str
    simulator: str
    profile: str
    design: Literal["A", "B"]
    encoder_seeds: int
    policy_seeds: int
    policy_epochs: int
    baseline: str
    planned: int
    finished: int


class SpreadPart(Part):
    """A score: its mean, its interval's kind, and the value of each sampling unit by seed."""

    mean: float
    low: float | None
    high: float | None
    n: int
    kind: str
    units: dict[int, float]


class ScorePart(Part):
    """Scores of a head set and fraction; `share` of the possible gain, where the report has a ceiling."""

    cell: str
    heads: str
    fraction: float
    accuracy: SpreadPart
    steering: SpreadPart
    share: float | None = None


class EstimatePart(Part):
    """A number with its interval."""

    value: Number
    low: Number
    high: Number
    n: int


class DifferencePart(Part):
    """A difference between scores, with its interval."""

    value: float
    low: float | None
    high: float | None
    kind: str

    def turned(self) -> DifferencePart:
        """The other way round."""
        low, high = (None if end is None else -end for end in (self.high, self.low))
        return self.model_copy(update={"value": -self.value, "low": low, "high": high})


class ContrastPart(Part):
    """A difference between two cells of one sweep."""

    metric: str
    first: tuple[str, float]
    second: tuple[str, float]
    difference: DifferencePart
    simultaneous: tuple[Number, Number]


class ConvergencePart(Part):
    """How fast a cell learns."""

    heads: str
    fraction: float
    mean_curve: EstimatePart
    share: float
    area: float


class FindingPart(Part):
    """A number that a verdict rests on."""

    what: str
    unit: Literal["points", "loss", "epochs", "ratio"]
    estimate: EstimatePart
    state: str


class ClaimPart(Part):
    """A verdict."""

    claim: str
    outcome: str
    reason: str
    findings: tuple[FindingPart, ...]


class SettingPart(Part):
    """A setting with its value as text."""

    group: str
    name: str
    value: str


class DataPart(Part):
    """The frames."""

    key: str | None
    sets: dict[str, dict[str, Any]]


class ProvenancePart(Part):
    """Where the numbers come from."""

    commit: str | None
    dirty: bool | None
    lock: str | None
    python: str | None
    platform: str | None
    cpu: str | None
    packages: dict[str, str]
    keys: dict[str, str]


class Report(Part):
    """What a comparison needs of a report.json."""

    sweep: SweepPart
    floor: dict[str, Number]
    ceiling: SpreadPart | None = None
    scores: tuple[ScorePart, ...]
    comparisons: tuple[ContrastPart, ...]
    convergence: tuple[ConvergencePart, ...]
    claims: tuple[ClaimPart, ...]
    rules: dict[str, float]
    settings: tuple[SettingPart, ...]
    data: DataPart
    provenance: ProvenancePart

    @property
    def points(self) -> list[stats.Point]:
        """Head sets and fractions that have a score."""
        return [(row.heads, row.fraction) for row in self.scores]

    def above_baseline(self, point: stats.Point) -> DifferencePart | None:
        """The difference in accuracy of a head set to the baseline at the same fraction."""
        base = (self.sweep.baseline, point[1])
        for row in self.comparisons:
            if row.metric == stats.ACCURACY and point != base and {row.first, row.second} == {point, base}:
                return row.difference if row.first == point else row.difference.turned()
        return None


def checked(content: object, source: str) -> Report:
    """The report in a report.json's content. Raises BadInputError naming the source and what is wrong."""
    if not isinstance(content, dict) or "format_version" not in content:
        raise BadInputError(f"{source} is no report of this program (no format_version); give one that it wrote")
    if content["format_version"] != FORMAT_VERSION:
        raise BadInputError(
            f"{source} has report format {content['format_version']}, this program reads {FORMAT_VERSION}; "
            "write it again with: python -m study.report NAME"
        )
    return validated(Report, content, f"{source} is no whole report, write it again with python -m study.report NAME")


def read_report(path: Path) -> Report:
    """The report in a report.json, or in the folder that holds one. Raises BadInputError when it is none."""
    file = path / "report.json" if path.is_dir() else path
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
    except OSError as error:
        raise BadInputError(f"cannot read {file}: {error.strerror}") from error
    except (ValueError, RecursionError) as error:
        raise BadInputError(f"{file} is no JSON: {error}; write it again with python -m study.report NAME") from error
    return checked(content, str(file))


# --- the text -------------------------------------------------------------------------------------------------------


def compare(first: Report, second: Report, names: tuple[str, str], picture: str = "") -> str:
    """Two reports side by side as Markdown; `names` say where each comes from, `picture` is shown with the scores."""
    parts = [
        f"## {plain(first.sweep.title)}: two sweeps side by side",
        f"First: {code(names[0])}. Second: {code(names[1])}. Differences are second {MINUS} first.",
        "### What differs",
        _differing(first, second),
        "### Final scores",
        picture,
        *_scores(first, second),
        "### Order of head sets by accuracy",
        _orders(first, second),
        _convergence(first, second),
        "### Verdicts",
        _verdicts(first, second),
    ]
    return "\n\n".join(part for part in parts if part) + "\n"


def _differing(first: Report, second: Report) -> str:
    """What differs in sweep, data, provenance, rules and settings; what does not is named in a line."""
    sides = [dict(_facts(report)) for report in (first, second)]
    names = list(dict.fromkeys([*sides[0], *sides[1]]))
    other = [name for name in names if sides[0].get(name) != sides[1].get(name)]
    body = [[plain(name), *(code(side[name]) if name in side else NOTHING for side in sides)] for name in other]
    groups = {name: name.partition(" ")[0] for name in names}
    same = [group for group in dict.fromkeys(groups.values()) if all(groups[name] != group for name in other)]
    told = f"Nothing differs in: {', '.join(same)}." if same else ""
    return "\n\n".join(part for part in (rows(["", "first", "second"], body, left=3), told) if part)


def _facts(report: Report) -> Iterator[tuple[str, str]]:
    """Name and value of everything that two sweeps may differ in; a name's first word is its group."""
    for name, value in report.sweep.model_dump(exclude={"title", "planned", "finished"}).items():
        yield f"sweep {name}", str(value)
    yield "sweep cells", ", ".join(row.cell for row in report.scores)
    yield "sweep finished", f"{report.sweep.finished} of {report.sweep.planned}"
    own = report.provenance
    yield "commit", f"{own.commit or 'unknown'}{' with uncommitted changes' * bool(own.dirty)}"
    yield "data key", str(report.data.key)
    for name, content in report.data.sets.items():
        for count in ("frames", "drives", "test_drives"):
            yield f"data {name} {count}", str(content.get(count))
    for name, value in report.floor.items():
        yield f"floor {name}", fixed(value, 6)
    yield "versions lock", str(own.lock)
    yield "versions python", str(own.python)
    for name, version in own.packages.items():
        yield f"versions {name}", version
    yield "machine platform", str(own.platform)
    yield "machine cpu", str(own.cpu)
    for name, value in report.rules.items():
        yield f"rules {name}", f"{value:g}"
    for setting in report.settings:
        yield f"settings {setting.group}.{setting.name}", setting.value


# --- scores ---------------------------------------------------------------------------------------------------------


def labels(first: Report, second: Report) -> dict[stats.Point, str]:
    """Head sets and fractions that either has a score of, most data first, with names that tell them apart."""
    order = {heads: place for place, heads in enumerate(HEAD_SETS)}
    points = sorted(
        {*first.points, *second.points}, key=lambda point: (-point[1], order.get(point[0], len(order)), point[0])
    )
    several = len({fraction for _, fraction in points}) > 1
    return {(heads, part): f"{heads} at {100 * part:g} %" if several else heads for heads, part in points}


def _scores(first: Report, second: Report) -> Iterator[str]:
    names, ceilings = labels(first, second), (first.ceiling, second.ceiling)
    both = [point for point in names if point in first.points and point in second.points]
    kinds: list[str] = []
    tables = [_measured(first, second, both, measure, kinds) for measure in MEASURES]
    if not both:
        yield "No head set and fraction is finished in both."
    if kinds:
        yield f"{_about(first, second, kinds)} {SHARE_WORDS}" if all(ceilings) else _about(first, second, kinds)
    told = [f"{plain(names[point])} ({words})" for point in both if (words := _shared(first, second, point))]
    if told:
        yield f"Cells of the same key in both: {', '.join(told)}."
    yield from tables
    for name, one, other in (("first", first, second), ("second", second, first)):
        alone = [plain(names[point]) for point in names if point in one.points and point not in other.points]
        if alone:
            yield f"Only in the {name}: {', '.join(alone)}."


def _measured(first: Report, second: Report, both: Sequence[stats.Point], measure: Measure, kinds: list[str]) -> str:
    """The table of a measure, with its ceiling and floor; adds the kinds of its intervals to `kinds`."""
    sides, names, show = (
        (first, second),
        labels(first, second),
        partial(fixed, digits=measure.digits, factor=measure.factor),
    )
    ceilings = [report.ceiling for report in sides if measure.name == "accuracy"]
    body, shares = [], []
    for point in both:
        scores = [_score(report, point) for report in sides]
        shares.append([score.share for score in scores])
        body.append([plain(names[point]), *_beside([getattr(score, measure.name) for score in scores], show, kinds)])
    if any(ceilings):
        shares.append([1.0, 1.0])
        body.append(["*ceiling (true state)*", *_beside(ceilings, show, kinds)])
    floors = [report.floor.get(measure.name) for report in sides]
    if floors != [None, None]:
        shares.append([0.0, 0.0])
        body.append([f"*floor ({measure.guess})*", *map(show, floors), NOTHING, NOTHING])
    header = [measure.title, "first (n)", "second (n)", "difference", "95 %"]
    if ceilings and all(ceilings):
        header += ["share of gain, first [%]", "share of gain, second [%]"]
        body = [[*row, *(fixed(share, 0, 100) for share in own)] for row, own in zip(body, shares, strict=True)]
    return rows(header, body)


def _beside(sides: Sequence[SpreadPart | None], show: Callable[..., str], kinds: list[str]) -> list[str]:
    """Two scores with n, and their difference with its interval, whose kind is added to `kinds`."""
    cells = [f"{show(side.mean)} ({side.n})" if side else NOTHING for side in sides]
    first, second = sides
    if not first or not second:
        return [*cells, NOTHING, NOTHING]
    made = difference(first, second)
    kinds.append(made.kind)
    low, high = (None if math.isnan(end) else end for end in (made.low, made.high))
    return [*cells, show(made.value, sign=True), between(show(low, sign=True), show(high, sign=True))]


def difference(first: SpreadPart, second: SpreadPart) -> Estimate:
    """Second minus first, with a 95 % interval over their sampling units.

    Paired by seed where both have the same seeds: seed k starts from the same initial weights whatever the data, which
    binds steering losses together (r = 0.8 between cells of the laptop profile) and accuracies not (r = 0.0). Pairs are
    right either way and cost little where nothing is shared. Otherwise two separate samples (Welch's t).
    """
    if first.kind == second.kind and set(first.units) == set(second.units):
        return stats.paired_t([second.units[seed] - value for seed, value in first.units.items()])
    return stats.welch(list(second.units.values()), list(first.units.values()))


def _about(first: Report, second: Report, kinds: Sequence[str]) -> str:
    """What the intervals are over."""
    text = (
        "Mean of the last five epochs on test drives; n are policies on one encoder, or encoders where there are "
        f"several. Interval: {'; '.join(dict.fromkeys(kinds))}."
    )
    if "A" in (first.sweep.design, second.sweep.design):
        allowance = max(report.rules.get("encoder_allowance", 0.0) for report in (first, second))
        text += (
            " With one encoder a cell it says nothing about other encoders, which by the sweep files' rules may differ "
            f"by {fixed(allowance, 1, 100)} points through their seeds alone."
        )
    return text


def _score(report: Report, point: stats.Point) -> ScorePart:
    return next(row for row in report.scores if (row.heads, row.fraction) == point)


def _shared(first: Report, second: Report, point: stats.Point) -> str:
    """Whether a point's cells have the same keys in both, and whether it is one result or two runs."""
    mine, theirs = (_keys(report, point) for report in (first, second))
    if not mine or mine != theirs:
        return ""
    equal = all(
        getattr(_score(first, point), metric) == getattr(_score(second, point), metric)
        for metric in ("accuracy", "steering")
    )
    return "the same result" if equal else "same settings, run twice"


def _keys(report: Report, point: stats.Point) -> list[str]:
    cells = [Cell(heads=point[0], fraction=point[1], encoder_seed=k).label for k in range(report.sweep.encoder_seeds)]
    return [report.provenance.keys[label] for label in cells if label in report.provenance.keys]


# --- orders, convergence, verdicts ----------------------------------------------------------------------------------


def _orders(first: Report, second: Report) -> str:
    fractions = sorted({fraction for report in (first, second) for _, fraction in report.points}, reverse=True)
    body = []
    for fraction in fractions:
        one, other = (_order(report, fraction) for report in (first, second))
        means = [[name for name, _ in order] for order in (one, other)]
        common = [[name for name in names if all(name in side for side in means)] for names in means]
        verdict = NOTHING if len(common[0]) < 2 else "the same" if common[0] == common[1] else "**another**"
        body.append([f"{100 * fraction:g} %", *(_chain(order) for order in (one, other)), verdict])
    table = rows(["fraction", "first", "second", "order"], body, left=4)
    return table and (
        "`>`: above the next by the simultaneous interval of their paired difference; `~`: not so. Order: of the head "
        f"sets that both have.\n\n{table}"
    )


def _order(report: Report, fraction: float) -> list[tuple[str, str]]:
    """Head sets from the best down, each with the sign towards the next."""
    at = sorted((row for row in report.scores if row.fraction == fraction), key=lambda row: -row.accuracy.mean)
    signs = [_sign(report, (up.heads, fraction), (down.heads, fraction)) for up, down in itertools.pairwise(at)]
    return list(itertools.zip_longest((row.heads for row in at), signs, fillvalue=""))


def _sign(report: Report, up: stats.Point, down: stats.Point) -> str:
    for contrast in report.comparisons:
        if contrast.metric == stats.ACCURACY and {contrast.first, contrast.second} == {up, down}:
            low, high = contrast.simultaneous
            if isinstance(low, float) and isinstance(high, float):
                return ">" if (low > 0 if contrast.first == up else high < 0) else "~"
    return "~"


def _chain(order: Sequence[tuple[str, str]]) -> str:
    return " ".join(f"{plain(name)} {sign}".strip() for name, sign in order) or NOTHING


def _convergence(first: Report, second: Report) -> str:
    sides = [{(row.heads, row.fraction): row for row in report.convergence} for report in (first, second)]
    body, names = [], labels(first, second)
    for point in sides[0]:
        if point in sides[1]:
            both = [side[point] for side in sides]
            body.append(
                [
                    plain(names[point]),
                    *(
                        f"{fixed(row.mean_curve.value, 0)} "
                        f"({between(fixed(row.mean_curve.low, 0), fixed(row.mean_curve.high, 0))})"
                        for row in both
                    ),
                    *(fixed(row.share, 0, 100) for row in both),
                    *(fixed(row.area, 2, 100) for row in both),
                ]
            )
    header = ["Cell", "epochs, first", "epochs, second", "share, first", "share, second", "area, first", "area, second"]
    table = rows(header, body)
    return table and (
        "### Convergence\n\nEpochs until the mean curve reaches the baseline's final accuracy of its own sweep (95 %), "
        f"share of the seeds that do [%], mean accuracy over all epochs [%].\n\n{table}"
    )


def _verdicts(first: Report, second: Report) -> str:
    sides = [{claim.claim: claim for claim in report.claims} for report in (first, second)]
    body, changed = [], []
    for name in dict.fromkeys([*sides[0], *sides[1]]):
        both = [side.get(name) for side in sides]
        outcomes = [claim.outcome if claim else None for claim in both]
        if None not in outcomes and outcomes[0] != outcomes[1]:
            changed.append(name)
        body.append([f"**{plain(name)}**" if name in changed else plain(name), *(_verdict(claim) for claim in both)])
    told = f"Verdicts that changed: {', '.join(map(plain, changed)) or 'none'}."
    return f"{told}\n\n{rows(['Claim', 'first', 'second'], body, left=3)}" if body else ""


def _verdict(claim: ClaimPart | None) -> str:
    if claim is None:
        return NOTHING
    findings = [found(item.model_dump()) for item in claim.findings] or [plain(claim.reason)]
    return "<br>".join([f"**{plain(claim.outcome)}**", *findings])
