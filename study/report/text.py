"""The document of a report, from its text in `report.md.jinja`."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

from jinja2 import Environment, StrictUndefined

from study.analysis.claims import Verdict
from study.report import rounding
from study.report.document import Block, Inline, Picture, bold, code, parse, plain
from study.report.model import Report
from study.report.rounding import LOSS, NOTHING, UNITS, percent

TEMPLATE = Path(__file__).with_name("report.md.jinja")
ROUNDINGS = ("clock", "epochs", "fixed", "gigabytes", "interval", "kinds", "loss", "percent", "points", "probability")


def document(report: Report) -> list[Block]:
    """Return the document of a report. Its figures are the files `figures/<name>.svg`."""
    # Not HTML: `plain` escapes what expressions give.
    environment = Environment(finalize=plain, undefined=StrictUndefined, autoescape=False)  # noqa: S701
    environment.filters |= {name: getattr(rounding, name) for name in (*ROUNDINGS, "whole")}
    environment.filters |= {"code": code, "bold": bold, "key_numbers": key_numbers}
    environment.globals |= {name: getattr(rounding, name) for name in ("LOSS", "UNITS", "between", *ROUNDINGS)}
    template = environment.from_string(TEMPLATE.read_text(encoding="utf-8"))
    pictures: dict[str, list[Picture]] = {}
    for item in report.figures:
        picture = Picture(f"figures/{item.name}.svg", plain(item.caption), plain(item.alt))
        pictures.setdefault(item.place, []).append(picture)
    return list(parse(template.render(report=report, **_lists(report)), pictures))


def _lists(report: Report) -> dict[str, Any]:
    """Return what the text lists: sentences' enumerations, settings by name, and the labels of each set of frames."""
    sweep = report.sweep
    ends = [row for row in report.scores if row.fraction in (sweep.fractions[0], sweep.fractions[-1])]
    over = (f"{row.n} policies on {'one encoder' if row.encoders == 1 else f'{row.encoders} encoders'}" for row in ends)
    drives = (str(row.episodes.n) for row in report.accuracy_contrasts if row.episodes)
    unseen = (
        f"{code(row.setting)}, by {code(f'python -m study.sweep {row.sweep} --profile {sweep.profile}')}"
        for row in report.confounds
        if not row.contrasts
    )
    scores = (f"{row.cell} {percent(row.accuracy.mean)} % (sd {percent(row.accuracy.sd, 2)})" for row in ends)
    outcomes = (f"{len(names)} {outcome} ({', '.join(names)})" for outcome, names in report.outcomes.items() if names)
    return {
        "hundredths": partial(percent, digits=2),
        "fractions": ", ".join(f"{round(100 * fraction, 2):g} %" for fraction in sweep.fractions),
        "outcomes": "; ".join(outcomes),
        "ends_over": " or ".join(dict.fromkeys(over)),
        "ends": "; ".join(scores),
        "drives": " or ".join(dict.fromkeys(drives)),
        "unseen": Inline("; ".join(unseen)),
        "setting": {f"{row.group}.{row.name}": row.value for row in report.settings},
        "labels": [
            (name, "chosen" if kind == "all" else kind, labels)
            for name, own in report.data.sets.items()
            for kind, labels in {"candidates": own["candidates"], **(own["chosen"] or {})}.items()
            if labels and labels["frames"]
        ],
    }


def key_numbers(claim: Verdict) -> str:
    """Return the numbers of a claim's findings, or why there are none; of many, the least and the greatest."""
    if not claim.findings:
        return claim.reason
    unit = UNITS[claim.findings[0].unit]
    values = [unit.show(finding.estimate.value) for finding in claim.findings]
    if len(values) > 5 and not {NOTHING, "never"} & set(values):
        ordered = sorted(claim.findings, key=lambda finding: finding.estimate.value)
        return unit.phrase.format(" to ".join(unit.show(ordered[place].estimate.value) for place in (0, -1)))
    listed = ", ".join(values)
    return unit.phrase.format(f"({listed})" if LOSS in unit.phrase and len(values) > 1 else listed)
