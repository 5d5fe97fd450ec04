"""The documents of a report and of a comparison, from their texts in the `.md.jinja` files."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import cache, partial
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined

from study.analysis.claims import Verdict
from study.analysis.metrics import Metric
from study.config.baselines import BASELINES
from study.config.heads import HEAD_SETS, HEADS
from study.document.blocks import Block, Inline, bold, code, italic, parse, plain, table
from study.report import driving, rounding
from study.report.model import Report, Score, Spread
from study.report.rounding import LOSS, NOTHING, UNITS, interval, percent, show, thousands
from study.statistics.learning_curves import KEYFRAME

FURTHER_COLUMNS = 5  # metrics that a page has room for, each with its standard deviation
ROUNDINGS = (
    "duration",
    "epochs",
    "fixed",
    "gigabytes",
    "interval",
    "kinds",
    "percent",
    "points",
    "probability",
    "scores",
)


@cache
def _environment() -> Environment:
    """Return what reads the templates, each once. They are not HTML: `plain` escapes what expressions give."""
    environment = Environment(
        loader=FileSystemLoader(Path(__file__).parent),
        finalize=plain,
        undefined=StrictUndefined,
        autoescape=False,  # noqa: S701
    )
    environment.filters |= {name: getattr(rounding, name) for name in (*ROUNDINGS, "thousands")}
    environment.filters |= {"code": code, "bold": bold, "inline": Inline, "counts": counts, "key_numbers": key_numbers}
    environment.globals |= {name: getattr(rounding, name) for name in ("UNITS", "between", *ROUNDINGS)}
    return environment


def render(template: str, pictures: dict[str, str], **values: object) -> list[Block]:
    """Return the document that a template makes of some values. `pictures`: the file of each figure that there is."""
    return list(parse(_environment().get_template(template).render(**values), pictures))


def document(report: Report) -> list[Block]:
    """Return the document of a report. Its figures are the files `figures/NAME.svg`."""
    return render(
        "report.md.jinja", {name: f"figures/{name}.svg" for name in report.figures}, report=report, **_lists(report)
    )


def _driving(report: Report) -> dict[str, Any]:
    """Return the tables of driving, what their columns mean, and scores in a sentence; nothing where nothing drove."""
    part = report.driving
    if not part:
        return {}
    return {
        **driving.driving_words(part),
        "about": driving.about(part),
        "scores": driving.score_table(part, part.town),
        "rates": driving.rate_table(part, part.town),
        "per_km": driving.per_km_table(part, part.town),
        "elsewhere": [(place, driving.short_table(part, place)) for place in part.places[1:]],
    }


def _lists(report: Report) -> dict[str, Any]:
    """Return what the text lists: sentences' enumerations, tables by metric, settings by name, labels of each set."""
    sweep = report.sweep
    ends = [row for row in report.scores if row.fraction in (sweep.fractions[0], sweep.fractions[-1])]
    over = (f"{row.n} policies on {'one encoder' if row.encoders == 1 else f'{row.encoders} encoders'}" for row in ends)
    run = f"--profile {sweep.profile}{' --data DIR' if sweep.imported else ''}"
    unseen = (
        f"{code(row.setting)}, by {code(f'python -m study.sweep {row.sweep} {run}')}"
        for row in report.confounds
        if not row.contrasts
    )
    main = [metric for metric in report.metrics if metric.guess]
    further = [metric for metric in report.metrics if not metric.guess]
    squared = [head for head in report.parameters if head in HEADS and HEADS[head].loss == "squared-error"]
    return {
        "head_sets": ", ".join(
            f"{name} ({HEAD_SETS[name].word})" if name in HEAD_SETS else name for name in sweep.heads
        ),
        "head_parameters": ", ".join(
            f"{thousands(count)} ({head})" for head, count in report.parameters.items() if head != "encoder"
        ),
        "squared": f" (squared error for {', '.join(squared)})" if squared else "",
        "wheel": _driving(report),
        "hundredths": partial(percent, digits=2),
        "fractions": ", ".join(f"{round(100 * fraction, 2):g} %" for fraction in sweep.fractions),
        "outcomes": "; ".join(f"{len(names)} {word} ({', '.join(names)})" for word, names in report.outcomes.items()),
        "ends_over": " or ".join(dict.fromkeys(over)),
        "ends": "; ".join(f"{row.cell} {percent(row.accuracy.mean)} % ({percent(row.accuracy.sd, 2)})" for row in ends),
        "keyframes": "; ".join(
            f"{row.cell} {percent(row.metrics[KEYFRAME].mean)} %" for row in ends if KEYFRAME in row.metrics
        ),
        "about": {name: baseline.about for name, baseline in BASELINES.items()},
        "unseen": "; ".join(unseen),
        "main": {"about": _about(main), "table": main_scores(report, main)},
        "further": [
            {"about": _about(part), "table": further_scores(report, part)}
            for start in range(0, len(further), FURTHER_COLUMNS)
            for part in (further[start : start + FURTHER_COLUMNS],)
        ],
        "setting": {f"{row.group}.{row.name}": row.value for row in report.settings},
        "labels": [
            (name, "chosen" if kind == "all" else kind, labels)
            for name, content in report.data.sets.items()
            for kind, labels in {"candidates": content["candidates"], **(content["chosen"] or {})}.items()
            if labels and labels["frames"]
        ],
    }


def _about(metrics: Iterable[Metric]) -> str:
    return " ".join(filter(None, (metric.about for metric in metrics)))


def title(metric: Metric) -> Inline:
    """Return a metric's column title, with its unit."""
    return Inline(f"{plain(metric.title)} [{plain(metric.unit)}]" if metric.unit else plain(metric.title))


def main_scores(report: Report, metrics: Sequence[Metric]) -> Inline:
    """Return the table of the metrics that have a floor: head sets, baselines, and the floor's row."""
    header, floor = ["Cell", "n"], [italic("floor"), ""]
    scores = (*report.scores, *report.baselines)
    rows: list[list[object]] = [[_name(report, row), row.n] for row in scores]
    for index, metric in enumerate(metrics):
        header += [title(metric), "sd", "interval"]
        floor += [show(metric, report.floor.get(metric.name)), "", ""]
        for row, score in zip(rows, scores, strict=True):
            row.extend(_spread_cells(metric, score.metrics.get(metric.name)))
        if not index:  # accuracy: of its gain above the best trivial baseline, how much it is and could be
            header += ["IQM", "gain", "share"]
            floor += ["", "", ""]
            for row, score in zip(rows, scores, strict=True):
                row.extend([percent(score.accuracy.iqm, 2), percent(score.gain), percent(score.share, 0)])
    return table(header, [*rows, floor])


def _name(report: Report, score: Score) -> object:
    """Return the name of a table's row; baselines are told from head sets by italics."""
    return italic(score.cell) if score in report.baselines else score.cell


def _spread_cells(metric: Metric, spread: Spread | None) -> list[str]:
    """Return mean, standard deviation and interval of a score."""
    if spread is None:
        return [NOTHING] * 3
    return [show(metric, spread.mean), show(metric, spread.sd), interval(spread, partial(show, metric))]


def further_scores(report: Report, metrics: Sequence[Metric]) -> Inline:
    """Return the table of some other metrics."""
    rows = [
        [_name(report, score), score.n, *(_mean_and_sd(metric, score.metrics.get(metric.name)) for metric in metrics)]
        for score in (*report.scores, *report.baselines)
    ]
    return table(["Cell", "n", *map(title, metrics)], rows)


def _mean_and_sd(metric: Metric, spread: Spread | None) -> str:
    return f"{show(metric, spread.mean)} ({show(metric, spread.sd)})" if spread else NOTHING


def counts(numbers: Iterable[int]) -> str:
    """Return each of some numbers once."""
    return " or ".join(map(str, sorted(set(numbers))))


def key_numbers(claim: Verdict) -> str:
    """Return the numbers of a claim's findings, or why there are none; of many, the least and the greatest."""
    if not claim.findings:
        return claim.reason
    unit = UNITS[claim.findings[0].unit]
    values = [unit.show(finding.estimate.value) for finding in claim.deciding]
    if len(values) > 5 and not {NOTHING, "never"} & set(values):
        ordered = sorted(claim.deciding, key=lambda finding: finding.estimate.value)
        return unit.phrase.format(" to ".join(unit.show(ordered[place].estimate.value) for place in (0, -1)))
    listed = ", ".join(values)
    return unit.phrase.format(f"({listed})" if LOSS in unit.phrase and len(values) > 1 else listed)
