"""Every number of a report, from a sweep's record."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping
from typing import Literal

import numpy as np
import pandas as pd

from study.analysis import claims, confounds, convergence, effects, intervals, learning_curves, predictions
from study.analysis.learning_curves import Panel, Point
from study.config.heads import CEILING, HEAD_SETS
from study.config.paper import ACCELERATIONS, parameter_counts
from study.report.model import (
    CellCost,
    Components,
    Confound,
    Convergence,
    Cost,
    Data,
    EncoderLosses,
    Failure,
    Probe,
    Provenance,
    Report,
    Score,
    Setting,
    Spread,
    Sweep,
)
from study.results.cell_result import CellResult
from study.results.sweep_record import SweepRecord
from study.stages import cell_cost, data_cost, total

SHOWN_PACKAGES = ("torch", "lightning", "highway-env", "gymnasium", "numpy", "scipy", "mlflow", "optuna", "typst")
SIMULATOR = "a town of our own on highway-env, in the place of CARLA's Town03"
METRICS = {"accuracy": learning_curves.ACCURACY, "steering": learning_curves.STEERING, "balanced": "balanced_accuracy"}
NEAR = 30.0  # [m] a lead vehicle farther away may be outside the image


def summarise(record: SweepRecord) -> Report:
    """Return the report of a sweep, over its finished cells."""
    grid, table = record.grid, record.table()
    panels = {name: learning_curves.panel(table, metric) for name, metric in METRICS.items()}
    accuracy = panels["accuracy"]
    cells = {point: effects.label(point, grid) for point in _points(record)}
    finished = {point: cell for point, cell in cells.items() if point in accuracy}
    base = accuracy.get((grid.baseline, max(grid.fractions)))
    verdicts = [
        verdict
        for verdict in claims.judge(record)
        if verdict.claim in grid.claims or (not grid.claims and (verdict.findings or verdict.missing))
    ]
    floor, ceiling = _floor(record), _ceiling(record)
    return Report(
        sweep=_sweep(record, "A" if learning_curves.design(accuracy.values()) == "A" else "B"),
        floor=floor,
        ceiling=ceiling,
        scores=tuple(
            _score(record, point, cell, panels, floor["accuracy"], ceiling) for point, cell in finished.items()
        ),
        comparisons=tuple(
            contrast
            for name in ("accuracy", "steering")
            for contrast in effects.compare(record, METRICS[name], panels[name])
        ),
        planned_contrasts=len(effects.planned(grid)),
        convergence=tuple(
            _convergence(point, cell, accuracy[point], base) for point, cell in finished.items() if base is not None
        ),
        confounds=tuple(_confounds(record)),
        components=tuple(
            Components(cell=cell, **intervals.variance_components(accuracy[point])) for point, cell in finished.items()
        ),
        encoders=tuple(_encoders(table, cells)),
        probes=tuple(_probes(record, cells)),
        claims=tuple(verdicts),
        rules=grid.rules.model_dump(mode="json"),
        settings=tuple(_settings(record)),
        parameters=parameter_counts(),
        data=_data(record),
        cost=_cost(record),
        provenance=_provenance(record),
        outcomes={
            outcome: tuple(verdict.claim for verdict in verdicts if verdict.outcome == outcome)
            for outcome in claims.OUTCOMES
        },
    )


def _points(record: SweepRecord) -> list[Point]:
    """Return head sets and fractions of the plan: most data first, head sets in the order of the study."""
    heads = [name for name in HEAD_SETS if name in record.grid.heads]
    return [(name, fraction) for fraction in sorted(record.grid.fractions, reverse=True) for name in heads]


def _sweep(record: SweepRecord, design: Literal["A", "B"]) -> Sweep:
    grid, writers = record.grid, record.data.get("writers", [])
    missing = {key: cell.label for key, cell in record.planned.items() if key not in record.results}
    reasons = {key: record.failed[key].strip() for key in missing if key in record.failed}
    return Sweep(
        name=grid.name,
        title=grid.title,
        simulator=f"imported drives, written by {', '.join(writers)}" if writers else SIMULATOR,
        imported=bool(writers),
        profile=record.profile,
        design=design,
        encoder_seeds=grid.encoder_seeds,
        policy_seeds=grid.policy_seeds,
        policy_epochs=record.settings.policy.epochs,
        baseline=grid.baseline,
        heads=tuple(name for name in HEAD_SETS if name in grid.heads),
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
    """Return what no learning at all gives on the test frames."""
    for key, cell in record.planned.items():
        if key in record.results:
            steering = claims.steering_floor(record, (cell.heads, cell.fraction))
            return {"accuracy": record.results[key].facts["floor"], "steering": steering}
    return {"accuracy": math.nan, "steering": math.nan}


def _ceiling(record: SweepRecord) -> Spread | None:
    """Return the accuracy of policies that are given the true state, where they were trained."""
    if record.ceiling is None:
        return None
    table = record.table(ceiling=True)
    (curves,) = learning_curves.panel(table[table["heads"] == CEILING], learning_curves.ACCURACY).values()
    return _spread(curves)


def _spread(curves: pd.DataFrame) -> Spread:
    final = learning_curves.final(curves)
    interval = intervals.mean_interval(final)
    return Spread(
        mean=interval.value,
        sd=float(final.std(ddof=1)) if len(final) > 1 else math.nan,
        iqm=float(intervals.interquartile_mean(final.to_numpy())),
        low=interval.low,
        high=interval.high,
        n=interval.n,
        kind=interval.kind,
        units=learning_curves.by_seed(final).to_dict(),
    )


def _score(
    record: SweepRecord, point: Point, cell: str, panels: Mapping[str, Panel], floor: float, ceiling: Spread | None
) -> Score:
    results = effects.results_at(record, point)
    guesses = [(item.predictions["acceleration"], item.predictions["acceleration_label"]) for item in results]
    recall = np.concatenate([predictions.confusion(guess, label) for guess, label in guesses]).mean(axis=0)
    scores = {name: _spread(curves[point]) for name, curves in panels.items() if point in curves}
    gain = scores["accuracy"].mean - floor
    return Score(
        cell=cell,
        heads=point[0],
        fraction=point[1],
        encoders=learning_curves.encoders(panels["accuracy"][point]),
        n=len(panels["accuracy"][point]),
        accuracy=scores["accuracy"],
        steering=scores["steering"],
        balanced=scores.get("balanced"),
        gain=gain,
        share=gain / (ceiling.mean - floor) if ceiling and ceiling.mean > floor else math.nan,
        macro_f1=float(np.concatenate([predictions.macro_f1(guess, label) for guess, label in guesses]).mean()),
        confusion=recall.tolist(),
        classes=ACCELERATIONS,
    )


def _convergence(point: Point, cell: str, curves: pd.DataFrame, base: pd.DataFrame) -> Convergence:
    target = float(learning_curves.final(base).mean())
    by_seed = convergence.reach_by_seed(curves, target)
    return Convergence(
        cell=cell,
        fraction=point[1],
        heads=point[0],
        target=target,
        mean_curve=convergence.epochs_to_reach(curves, base),
        median=by_seed.median,
        share=by_seed.share,
        area=by_seed.area,
        n=len(curves),
    )


def _confounds(record: SweepRecord) -> Iterator[Confound]:
    """Yield each setting that may confound the sweep's contrasts, with the sweep that varies it where there is one."""
    for confound in confounds.concerned(record):
        other = record.variants.get(confound.setting)
        yield Confound(
            setting=confound.setting,
            about=confound.about,
            here=confounds.value(record.settings, confound.setting),
            there=confounds.value(other.settings, confound.setting) if other else None,
            sweep=other.grid.name if other else confound.sweep,
            floor=_floor(other)["accuracy"] if other else math.nan,
            contrasts=tuple(confounds.contrasts(record, other, confound)) if other else (),
        )


def _encoders(table: pd.DataFrame, cells: Mapping[Point, str]) -> Iterator[EncoderLosses]:
    rows = table[table["stage"] == "encoder"]
    for (heads, fraction), cell in cells.items():
        own = rows[(rows["heads"] == heads) & (rows["fraction"] == fraction)]
        if own.empty:
            continue
        last = own[own["epoch"] == own["epoch"].max()].groupby(["metric", "split"])["value"].mean()
        losses = {
            head: {split: last.get((f"loss_{head}", split), math.nan) for split in ("train", "test")}
            for head in HEAD_SETS[heads].heads
        }
        yield EncoderLosses(cell=cell, encoders=own["encoder_seed"].nunique(), losses=losses)


def _probes(record: SweepRecord, cells: Mapping[Point, str]) -> Iterator[Probe]:
    for point, cell in cells.items():
        probes = [_probe(result) for result in effects.results_at(record, point)]
        if probes and all(probes):
            means = {name: float(np.mean([probe[name] for probe in probes])) for name in probes[0]}
            yield Probe(cell=cell, encoders=len(probes), **means)


def _probe(result: CellResult) -> dict[str, float]:
    """Return R2 of each probed quantity; nothing for a result of a version that did not keep them."""
    own = result.predictions
    if not {"speed", "light", "lead_gap"} <= set(own):
        return {}
    gap = own["lead_gap"].astype(np.float64)
    targets = {
        "speed": own["speed"],
        "stop": own["light"] > 0,
        "gap": np.where(gap <= NEAR, gap, np.nan),
        "steering": own["steering_label"],
        "brake": own["acceleration_label"] == 0,
    }
    return {name: predictions.probe(own["z"], np.asarray(v, np.float64), own["episode"]) for name, v in targets.items()}


def _settings(record: SweepRecord) -> Iterator[Setting]:
    for group, model in record.settings:
        shown = model.model_dump(mode="json")
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
    for own in sets.values():
        if isinstance(own["test_drives"], list):
            own["test_drives"] = len(own["test_drives"])
    return Data(key=record.data.get("key"), sets=sets)


def _cost(record: SweepRecord) -> Cost:
    estimates = [cell_cost(record.settings, cell, record.grid.policy_seeds) for cell in record.planned.values()]
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
                whole=seconds.get("cell"),
                **{name: facts.get(name) for name in ("peak_bytes", "device", "precision", "threads")},
                frames=facts.get("frames", {}).get("encoder_train"),
            )
        )
    return Cost(
        cells=tuple(cells),
        seconds=sum(0.0 if math.isnan(row.whole) else row.whole for row in cells),
        disk=total([data_cost(record.settings, recorded="writers" not in record.data), *estimates]).bytes,
        peak_bytes=max((row.peak_bytes or 0 for row in cells), default=None),
    )


def _provenance(record: SweepRecord) -> Provenance:
    own = record.provenance
    packages = own.get("packages", {})
    commits = {result.facts.get("provenance", {}).get("commit") for result in record.results.values()}
    return Provenance(
        **{name: own.get(name) for name in ("commit", "dirty", "lock", "python", "platform", "cpu", "cores")},
        diff_lines=len(str(own.get("diff") or "").splitlines()),
        packages={name: packages[name] for name in SHOWN_PACKAGES if name in packages},
        cell_commits=tuple(sorted(str(commit) for commit in commits if commit)),
        command=own.get("command", f"python -m study.sweep {record.grid.name} --profile {record.profile}"),
        keys={cell.label: key for key, cell in record.planned.items()},
    )
