"""Every number of a report, from a sweep's record."""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Iterator, Mapping
from typing import Any, Literal

import numpy as np
import pandas as pd

from study.analysis import claims, confounds, metrics, predictions
from study.analysis.metrics import METRICS, Metric
from study.config.baselines import BASELINES, CEILING
from study.config.heads import HEADS, heads_of
from study.config.paper import parameter_counts
from study.products import Arrays
from study.report.driving import summarise_driving
from study.report.model import (
    CellCost,
    Convergence,
    Cost,
    Data,
    Failure,
    Provenance,
    Report,
    Score,
    Setting,
    Spread,
    Sweep,
    VariedSetting,
)
from study.report.scale import training_scale
from study.report.spread import spread
from study.results.cell_result import CellResult
from study.results.sweep_record import SweepRecord
from study.stages import RESULT_BYTES, data_cost
from study.statistics import comparisons, convergence, effects, intervals, learning_curves
from study.statistics.drives import by_drive
from study.statistics.intervals import Crossed, Sample
from study.statistics.learning_curves import ACCURACY, STEERING, Point

SHOWN_PACKAGES = ("torch", "lightning", "highway-env", "gymnasium", "numpy", "scipy", "mlflow", "optuna", "typst")
SIMULATOR = "a town of our own on highway-env, in the place of CARLA's Town03"
ORIGIN = ("commit", "dirty", "unknown")
NEAR = 30.0  # [m] a lead vehicle farther away may be outside the image


def summarise(record: SweepRecord) -> Report:
    """Return the report of a sweep, over its finished cells."""
    grid = record.grid
    panels = {name: learning_curves.panel(record.table(), name) for name in (ACCURACY, STEERING)}
    accuracy = panels[ACCURACY]
    finished = {point: accuracy[point] for point in effects.points(grid) if point in accuracy}
    reference = (grid.reference, max(grid.fractions))
    base, cells = accuracy.get(reference), effects.samples(accuracy, effects.drive_scores(record, ACCURACY, accuracy))
    floor, counts = _floor(record), parameter_counts()
    beside, ends = _baselines(record)
    contrasts = (effects.paired_contrasts(record, name, panel) for name, panel in panels.items())
    return Report(
        sweep=_sweep(record, "A" if learning_curves.design(accuracy.values()) == "A" else "B"),
        scale=training_scale(record),
        metrics=tuple(METRICS.values()),
        floor=floor,
        scores=tuple(
            _score(record, point, effects.label(point, grid), curves, ends) for point, curves in finished.items()
        ),
        baselines=beside,
        comparisons=tuple(itertools.chain.from_iterable(contrasts)),
        planned_contrasts=len(effects.planned(grid)),
        convergence=tuple(
            _convergence(
                point,
                effects.label(point, grid),
                curves,
                base,
                comparisons.difference(cells[point], cells[reference]),
            )
            for point, curves in finished.items()
            if base is not None
        ),
        confounds=tuple(_confounds(record)),
        driving=summarise_driving(record),
        claims=tuple(
            verdict
            for verdict in claims.judge(record)
            if verdict.claim in grid.claims or (not grid.claims and (verdict.findings or verdict.missing))
        ),
        rules=grid.rules.model_dump(mode="json"),
        settings=tuple(_settings(record)),
        parameters={name: counts[name] for name in ("encoder", *heads_of(grid.heads))},
        data=_data(record),
        cost=_cost(record),
        provenance=_provenance(record),
        unread=record.unread,
    )


def _sweep(record: SweepRecord, design: Literal["A", "B"]) -> Sweep:
    grid, writers = record.grid, record.data.get("writers", [])
    missing = {key: cell.label for key, cell in record.planned.items() if key not in record.results}
    reasons = {key: record.failed[key].strip() for key in missing if key in record.failed}
    return Sweep(
        **grid.model_dump(include={"name", "title", "encoder_seeds", "policy_seeds", "reference"}),
        simulator=f"imported drives, written by {', '.join(writers)}" if writers else SIMULATOR,
        imported=bool(writers),
        profile=record.profile,
        design=design,
        policy_epochs=record.settings.policy.epochs,
        heads=tuple(effects.ordered(grid.heads)),
        fractions=tuple(sorted(grid.fractions, reverse=True)),
        planned=len(record.planned),
        finished=len(record.planned) - len(missing),
        unfinished=tuple(label for key, label in missing.items() if key not in reasons),
        failed=tuple(
            Failure(cell=missing[key], reason=(reason.splitlines() or [""])[-1][:300])
            for key, reason in reasons.items()
        ),
    )


def _floor(record: SweepRecord) -> dict[str, float]:
    """Return what the best answer that ignores the input scores on the test frames, by metric."""
    for key, cell in record.planned.items():
        if key in record.results:
            steering = claims.steering_floor(record, (cell.heads, cell.fraction))
            return {ACCURACY: record.results[key].facts["floor"], STEERING: steering}
    return {ACCURACY: math.nan, STEERING: math.nan}


def _baselines(record: SweepRecord) -> tuple[tuple[Score, ...], tuple[float, float]]:
    """Return the baselines' scores, and the accuracies of the best trivial one and of the ceiling, NaN for none."""
    curves = learning_curves.panel(record.table(baselines=True), ACCURACY)
    finished = {point: frame for point, frame in curves.items() if point[0] in BASELINES}
    means = {name: float(learning_curves.final(frame).mean()) for (name, _), frame in finished.items()}
    trivial = [mean for name, mean in means.items() if BASELINES[name].trivial]
    ends = max(trivial, default=math.nan), means.get(CEILING, math.nan)
    words = {point: BASELINES[point[0]].word for point in finished}
    return tuple(_score(record, point, words[point], frame, ends) for point, frame in finished.items()), ends


def _spread(results: list[CellResult], metric: Metric) -> Spread | None:
    """Return a metric over the policies of some results and, where it is known by drive, over test drives."""
    scores = metrics.scores(results, metric)
    return None if scores.empty else spread(Sample(scores, by_drive(results, metric.name)))


def _score(record: SweepRecord, point: Point, cell: str, curves: pd.DataFrame, ends: tuple[float, float]) -> Score:
    """Return what is known of a cell; `ends`: accuracies of the best trivial baseline and of the ceiling."""
    results = effects.results_at(record, point)
    recall = [
        predictions.confusion(result.predictions["acceleration"], result.predictions["acceleration_label"])
        for result in results
    ]
    spreads = {name: _spread(results, metric) for name, metric in METRICS.items()}
    scores = {name: spread for name, spread in spreads.items() if spread}
    gain, room = scores[ACCURACY].mean - ends[0], ends[1] - ends[0]
    return Score(
        cell=cell,
        heads=point[0],
        fraction=point[1],
        encoders=len(results),
        n=len(curves),
        metrics=scores,
        gain=gain,
        share=gain / room if room > 0 else math.nan,
        confusion=np.concatenate(recall).mean(axis=0).tolist(),
        components=intervals.variance_components(curves),
        losses=_losses(results),
        probes=_probes(results),
    )


def _convergence(point: Point, cell: str, curves: pd.DataFrame, base: pd.DataFrame, difference: Crossed) -> Convergence:
    target = float(learning_curves.final(base).mean())
    by_seed = convergence.reach_by_seed(curves, target)
    return Convergence(
        cell=cell,
        fraction=point[1],
        heads=point[0],
        target=target,
        mean_curve=convergence.epochs_to_reach(curves, base, difference),
        median=by_seed.median,
        share=by_seed.share,
        area=by_seed.area,
        n=len(curves),
    )


def _confounds(record: SweepRecord) -> Iterator[VariedSetting]:
    """Yield each setting that may confound the sweep's contrasts, with the sweep that varies it where there is one."""
    for confound in confounds.concerned(record):
        other = record.variants.get(confound.setting)
        yield VariedSetting(
            setting=confound.setting,
            about=confound.about,
            here=confounds.value(record.settings, confound.setting),
            there=confounds.value(other.settings, confound.setting) if other else None,
            sweep=other.grid.name if other else confound.sweep,
            floor=_floor(other)[ACCURACY] if other else math.nan,
            contrasts=tuple(confounds.contrasts(record, other, confound)) if other else (),
        )


def _losses(results: list[CellResult]) -> dict[str, dict[str, float]]:
    """Return the loss of each head on each split after the last epoch, and its bounds, mean over encoders."""
    curves = pd.concat([result.curves for result in results])
    rows = curves[(curves["stage"] == "encoder") & curves["metric"].str.startswith("loss_")]
    last = rows[rows["epoch"] == rows["epoch"].max()].groupby(["metric", "split"])["value"].mean()
    heads = sorted({name.removeprefix("loss_") for name, _ in last.index} - {"kl"})
    bounds = [result.facts.get("heads", {}) for result in results]
    return {
        head: {split: float(last.get((f"loss_{head}", split), math.nan)) for split in ("train", "test")}
        | {
            name: float(np.mean([each.get(head, {}).get(name, math.nan) for each in bounds]))
            for name in ("entropy", "constant")
        }
        for head in sorted(heads, key=[*HEADS, *heads].index)
    }


def _probes(results: list[CellResult]) -> dict[str, float]:
    """Return R2 of each probed quantity, mean over encoders; nothing for results of a version that kept too little."""
    if not all({"speed", "light", "lead_gap"} <= set(result.predictions) for result in results):
        return {}
    probes = pd.DataFrame([_probe(result.predictions) for result in results])
    return {str(name): float(mean) for name, mean in probes.mean(skipna=False).items()}


def _probe(arrays: Arrays) -> dict[str, float]:
    gap = arrays["lead_gap"].astype(np.float64)
    known = arrays["speed"], arrays["light"] > 0, arrays["steering_label"], arrays["acceleration_label"] == 0
    near = np.where(gap <= NEAR, gap, np.nan)[:, None]  # known in fewer frames
    speed, stop, steering, brake = predictions.probe(arrays["z"], np.column_stack(known), arrays["episode"])
    (free,) = predictions.probe(arrays["z"], near, arrays["episode"])
    return {"speed": speed, "stop": stop, "gap": free, "steering": steering, "brake": brake}


def _settings(record: SweepRecord) -> Iterator[Setting]:
    for group, model in record.settings:
        shown = dict(model) | model.model_dump(mode="json")  # which may leave out what is at its default
        for name, info in type(model).model_fields.items():
            yield Setting(
                group=group,
                name=name,
                value=shown[name] if isinstance(shown[name], str) else json.dumps(shown[name]),
                meaning=info.description or "",
                default=getattr(model, name) == info.get_default(call_default_factory=True),
            )


def _data(record: SweepRecord) -> Data:
    sources = record.data.get("sources", {})
    fields = ("test_drives", "frames", "train", "test", "candidates", "chosen")
    sets = {
        name: {"drives": len(sources.get(name, ())), **{field: content.get(field) for field in fields}}
        for name, content in record.data.get("sets", {}).items()
    }
    for content in sets.values():
        if isinstance(content["test_drives"], list):
            content["test_drives"] = len(content["test_drives"])
    return Data(key=record.data.get("key"), sets=sets)


def _cost(record: SweepRecord) -> Cost:
    cells = []
    for key, cell in record.planned.items():
        if key not in record.results:
            continue
        facts = record.results[key].facts
        seconds = facts.get("seconds", {})
        cells.append(
            CellCost(
                cell=cell.label,
                **{stage: seconds.get(stage) for stage in ("encoder", "encode", "policies")},
                total=seconds.get("cell"),
                **{name: facts.get(name) for name in ("peak_bytes", "device", "precision", "threads")},
                frames=facts.get("frames", {}).get("encoder_train"),
            )
        )
    return Cost(
        cells=tuple(cells),
        seconds=sum(0.0 if math.isnan(row.total) else row.total for row in cells),
        disk=data_cost(record.settings, recorded="writers" not in record.data).bytes
        + RESULT_BYTES * len(record.planned),
        peak_bytes=max((row.peak_bytes or 0 for row in cells), default=None),
    )


def _provenance(record: SweepRecord) -> Provenance:
    origin = record.provenance
    packages = origin.get("packages", {})
    origins = [result.facts.get("provenance", {}) for result in record.results.values()]
    commits = {each.get("commit") for each in origins}
    times = sorted(each["time"] for each in origins if each.get("time"))
    devices = [result.facts.get("device") for result in record.results.values()]
    machines = {_machine(each, device) for each, device in zip(origins, devices, strict=True) if each.get("cpu")}
    return Provenance(
        **{
            name: origin.get(name)
            for name in ("commit", "dirty", "unknown", "lock", "python", "platform", "cpu", "cores")
        },
        diff_lines=len(str(origin.get("diff") or "").splitlines()),
        packages={name: packages[name] for name in SHOWN_PACKAGES if name in packages},
        cell_commits=tuple(sorted(str(commit) for commit in commits if commit)),
        cell_times=(times[0], times[-1]) if times else (),
        undated=len(origins) - len(times),
        computed_on=tuple(sorted(machines)) if machines - {_machine(origin, "CPU")} else (),
        command=origin.get("command", f"python -m study.sweep {record.grid.name} --profile {record.profile}"),
        keys={cell.label: key for key, cell in record.planned.items()},
    )


def _machine(origin: Mapping[str, Any], device: str | None) -> str:
    """Return what computed, for people: processor, GPU where it has one, system, Python and torch."""
    gpu = "" if device in {None, "CPU"} else f", {device}"
    torch = f", torch {version}" if (version := origin.get("packages", {}).get("torch")) else ""
    where = f"{origin.get('cpu')}, {origin.get('cores')} cores{gpu}; {origin.get('platform')}"
    return f"{where}; Python {origin.get('python')}{torch}"
