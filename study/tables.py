"""The document of a report: `report.md.jinja` has its words, and here are the rows of its tables."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

from jinja2 import Environment, StrictUndefined

from study import rounding
from study.claims import Verdict
from study.document import Block, Inline, Picture, Row, bold, code, italic, parse, plain
from study.report_model import Confound, Report, Spread
from study.rounding import (
    LOSS,
    NOTHING,
    UNITS,
    between,
    clock,
    epochs,
    fixed,
    gigabytes,
    interval,
    loss,
    percent,
    points,
    probability,
    whole,
)

TEMPLATE = Path(__file__).with_name("report.md.jinja")
FILTERS = {
    name: getattr(rounding, name) for name in ("clock", "fixed", "gigabytes", "kinds", "loss", "percent", "whole")
}


def document(report: Report) -> list[Block]:
    """Return the document of a report. Its figures are the files `figures/<name>.svg`."""
    # Not HTML: `plain` escapes what expressions give.
    environment = Environment(finalize=plain, undefined=StrictUndefined, autoescape=False)  # noqa: S701
    environment.filters |= FILTERS | {"code": code, "bold": bold}
    text = environment.from_string(TEMPLATE.read_text(encoding="utf-8")).render(
        report=report, LOSS=LOSS, UNITS=UNITS, **_words(report)
    )
    rows = {name: list(make(report)) for name, make in ROWS.items()}
    rows |= {f"claim {claim.claim}": list(_findings(claim)) for claim in report.claims}
    rows |= {f"confound {confound.setting}": list(_both_values(confound)) for confound in report.confounds}
    pictures: dict[str, list[Picture]] = {}
    for item in report.figures:
        picture = Picture(f"figures/{item.name}.svg", plain(item.caption), plain(item.alt))
        pictures.setdefault(item.place, []).append(picture)
    return list(parse(text, rows, pictures))


def _words(report: Report) -> dict[str, object]:
    """Return what sentences of the text list."""
    sweep = report.sweep
    ends = [row for row in report.scores if row.fraction in (sweep.fractions[0], sweep.fractions[-1])]
    over = (f"{row.n} policies on {'one encoder' if row.encoders == 1 else f'{row.encoders} encoders'}" for row in ends)
    drives = (str(row.episodes.n) for row in report.accuracy_contrasts if row.episodes)
    unseen = (
        f"{code(row.setting)}, by {code(f'python -m study.sweep {row.sweep} --profile {sweep.profile}')}"
        for row in report.confounds
        if not row.contrasts
    )
    return {
        "fractions": ", ".join(f"{round(100 * fraction, 2):g} %" for fraction in sweep.fractions),
        "outcomes": "; ".join(
            f"{len(names)} {outcome} ({', '.join(names)})" for outcome, names in report.outcomes.items() if names
        ),
        "ends_over": " or ".join(dict.fromkeys(over)),
        "ends": "; ".join(
            f"{row.cell} {percent(row.accuracy.mean)} % (sd {percent(row.accuracy.sd, 2)})" for row in ends
        ),
        "drives": " or ".join(dict.fromkeys(drives)),
        "unseen": Inline("; ".join(unseen)),
        "setting": {f"{row.group}.{row.name}": row.value for row in report.settings},
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
    return unit.phrase.format(f"({listed})" if "·" in unit.phrase and len(values) > 1 else listed)


# --- rows -----------------------------------------------------------------------------------------------------------


def _verdicts(report: Report) -> Iterator[Row]:
    for claim in report.claims:
        yield bold(claim.claim), claim.text, bold(claim.outcome), key_numbers(claim)


def _scores(report: Report) -> Iterator[Row]:
    floor = report.floor["accuracy"]
    for row in report.scores:
        steering = (loss(row.steering.mean), loss(row.steering.sd), interval(row.steering, loss))
        yield row.cell, *_accuracy(row.accuracy, row.gain, row.share), *steering
    if report.ceiling:
        top = _accuracy(report.ceiling, report.ceiling.mean - floor, 1.0)
        yield italic("ceiling (true state)"), *top, NOTHING, NOTHING, NOTHING
    lowest = ("", percent(floor), "", "", "", percent(0.0), percent(0.0, 0), loss(report.floor["steering"]), "", "")
    yield italic("floor (commonest class)"), *lowest


def _accuracy(score: Spread, gain: float, share: float) -> Row:
    ends = interval(score, lambda end: percent(end, 2))
    return (
        score.n,
        *(percent(score.mean), percent(score.sd, 2), ends, percent(score.iqm)),
        *(percent(gain), percent(share, 0)),
    )


def _classes(report: Report) -> Iterator[Row]:
    for row in report.scores:
        balanced = (percent(row.balanced.mean), percent(row.balanced.sd, 2)) if row.balanced else (NOTHING, NOTHING)
        recalls = (percent(given[index]) for index, given in enumerate(row.confusion))
        yield row.cell, row.n, *balanced, fixed(row.macro_f1, 3), *recalls


def _contrasts(report: Report) -> Iterator[Row]:
    for row in report.accuracy_contrasts:
        difference = (row.difference.n, points(row.difference.value), interval(row.difference, points))
        tests = (probability(row.p), probability(row.p_holm), fixed(row.improvement), percent(row.detectable, 2))
        yield row.name, *difference, *tests, interval(row.episodes, points)


def _hierarchical(report: Report) -> Iterator[Row]:
    for row in report.accuracy_contrasts:
        if found := row.hierarchical:
            yield row.name, found.n, points(found.value), interval(found, points)


def _convergence(report: Report) -> Iterator[Row]:
    for row in report.convergence:
        curve = (epochs(row.mean_curve.value), interval(row.mean_curve, epochs))
        yield row.cell, row.n, *curve, epochs(row.median), percent(row.share, 0), percent(row.area)


def _components(report: Report) -> Iterator[Row]:
    for row in report.components:
        yield row.cell, percent(row.encoder, 2), percent(row.policy, 2), percent(row.epoch, 2)


def _encoders(report: Report) -> Iterator[Row]:
    for row in report.encoders:
        losses = (row.losses.get(head) for head in ("rec", "pred", "plan"))
        shown = (f"{fixed(own['train'], 4)} / {fixed(own['test'], 4)}" if own else NOTHING for own in losses)
        yield row.cell, row.encoders, *shown


def _probes(report: Report) -> Iterator[Row]:
    for row in report.probes:
        yield row.cell, row.encoders, *map(fixed, (row.speed, row.stop, row.gap, row.steering, row.brake))


def _both_values(confound: Confound) -> Iterator[Row]:
    for row in confound.contrasts:
        here, there, change = ((points(own.value), interval(own, points)) for own in (row.here, row.there, row.change))
        yield row.name, row.here.n, *here, row.there.n, *there, *change, row.state


def _findings(claim: Verdict) -> Iterator[Row]:
    for row in claim.findings:
        show, found = UNITS[row.unit].show, row.estimate
        decides = between(*row.decides, show)
        yield (
            row.what,
            found.n,
            show(found.value),
            interval(found, show),
            decides,
            row.needs,
            probability(row.p),
            row.state,
        )


def _settings(report: Report) -> Iterator[Row]:
    for row in report.settings:
        yield code(f"{row.group}.{row.name}"), code(row.value) if row.default else bold(code(row.value)), row.meaning


def _data(report: Report) -> Iterator[Row]:
    for name, own in report.data.sets.items():
        for kind, labels in {"candidates": own["candidates"], **(own["chosen"] or {})}.items():
            if not labels:
                continue
            n, steering = max(labels["frames"], 1), labels["steering"]
            yield (
                f"{name}, {'chosen' if kind == 'all' else kind}",
                labels["drives"],
                whole(labels["frames"]),
                " · ".join(percent(count / n, 0) for count in labels["acceleration"]),
                percent(steering[len(steering) // 2] / n),
                percent(labels["steering_beyond_crop"], 2),
                percent(labels["standing"] / n),
                percent(labels["majority_accuracy"]),
            )


def _cost(report: Report) -> Iterator[Row]:
    for row in report.cost.cells:
        times = map(clock, (row.encoder, row.encode, row.policies, row.whole))
        device = ", ".join(filter(None, (row.device, row.precision, f"{row.threads} threads" if row.threads else "")))
        yield row.cell, whole(row.frames), *times, gigabytes(row.peak_bytes), device or NOTHING


def _provenance(report: Report) -> Iterator[Row]:
    own = report.provenance
    changes = f", with {own.diff_lines} lines of uncommitted changes (kept in the sweep's run)" if own.dirty else ""
    yield "Commit", Inline(f"{code(own.commit) if own.commit else 'unknown'}{changes}")
    if len(own.cell_commits) > 1:
        yield "Cells' commits", Inline(", ".join(code(commit[:10]) for commit in own.cell_commits))
    yield "Lock file", Inline(f"{code(own.lock[:16])} (sha256)") if own.lock else "none"
    yield "Machine", f"{own.cpu}, {own.cores} cores; {own.platform}"
    packages = ", ".join(f"{name} {version}" for name, version in own.packages.items())
    yield "Python and packages", f"Python {own.python}; {packages}"
    yield "Cell keys", Inline(", ".join(f"{plain(name)}: {code(key)}" for name, key in own.keys.items()))


def _steps(report: Report) -> Iterator[Row]:
    sweep = report.sweep
    if sweep.name in ("heads", "datasize"):
        yield code(f"make {sweep.name}"), "profile laptop, from nothing to this report"
    yield code(report.provenance.command), "this sweep; finished cells are not run again"
    again = f"python -m study.report {sweep.name} --profile {sweep.profile}"
    yield code(again), "this report again, from MLflow alone"


ROWS: dict[str, Callable[[Report], Iterable[Row]]] = {
    "verdicts": _verdicts,
    "scores": _scores,
    "classes": _classes,
    "contrasts": _contrasts,
    "hierarchical": _hierarchical,
    "convergence": _convergence,
    "components": _components,
    "encoders": _encoders,
    "probes": _probes,
    "settings": _settings,
    "data": _data,
    "cost": _cost,
    "provenance": _provenance,
    "steps": _steps,
}
