"""Every number of a report, from a sweep's record, as one plain value: what the PDF prints is in here and no more."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd

from study import claims, confounds, stats
from study.config import ACCELERATIONS, CEILING, HEAD_SETS, parameter_counts
from study.result import CellResult, SweepRecord
from study.stages import cell_cost, data_cost, total
from study.stats import Estimate, Panel, Point

FORMAT_VERSION = 1
SHOWN_PACKAGES = ("torch", "lightning", "highway-env", "gymnasium", "numpy", "scipy", "mlflow", "optuna", "typst")
SIMULATOR = "a town of our own on highway-env, in the place of CARLA's Town03"
METRICS = {"accuracy": stats.ACCURACY, "steering": stats.STEERING, "balanced": "balanced_accuracy"}
NEAR = 30.0  # [m] a lead vehicle farther away may be outside the image

Numbers = dict[str, Any]


def numbers(record: SweepRecord) -> Numbers:
    """Every number of the report as plain values: NaN is None, an epoch that is never reached is "never"."""
    grid, table = record.grid, record.table()
    panels = {name: stats.panel(table, metric) for name, metric in METRICS.items()}
    accuracy, steering = panels["accuracy"], panels["steering"]
    points = [point for point in _points(record) if point in accuracy]
    base = (grid.baseline, max(grid.fractions))
    verdicts = [
        verdict
        for verdict in claims.judge(record)
        if verdict.claim in grid.claims or (not grid.claims and (verdict.findings or verdict.missing))
    ]
    floor, ceiling = _floors(record), _ceiling(record)
    made: Numbers = {
        "format_version": FORMAT_VERSION,
        "sweep": _sweep(record, stats.design(accuracy.values())),
        "floor": floor,
        "ceiling": ceiling,
        "scores": [_score(record, point, panels, floor["accuracy"], ceiling) for point in points],
        "comparisons": [
            _contrast(record, contrast)
            for metric, curves in ((stats.ACCURACY, accuracy), (stats.STEERING, steering))
            for contrast in claims.compare(record, metric, curves)
        ],
        "planned_contrasts": len(claims.planned(grid)),
        "convergence": [
            _convergence(record, point, accuracy[point], accuracy[base]) for point in points if base in accuracy
        ],
        "confounds": _confounds(record),
        "components": [
            {"cell": claims.label(point, grid), **stats.variance_components(accuracy[point])} for point in points
        ],
        "encoders": _encoders(record, table),
        "probes": _probes(record),
        "claims": verdicts,
        "rules": grid.rules.model_dump(mode="json"),
        "settings": _settings(record),
        "parameters": parameter_counts(),
        "data": _data(record),
        "cost": _cost(record),
        "provenance": _provenance(record),
    }
    made["outcomes"] = {
        outcome: [verdict.claim for verdict in verdicts if verdict.outcome == outcome] for outcome in claims.OUTCOMES
    }
    plain: Numbers = _plain(made)
    return plain


def _plain(value: Any) -> Any:
    """Values of JSON."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: _plain(getattr(value, field.name)) for field in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {str(name): _plain(item) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if hasattr(value, "item"):  # numpy's scalars
        value = value.item()
    if isinstance(value, float):
        return None if math.isnan(value) else value if math.isfinite(value) else "never"
    return value


def _points(record: SweepRecord) -> list[Point]:
    """Head sets and fractions of the plan: most data first, head sets in the order of the study."""
    heads = [name for name in HEAD_SETS if name in record.grid.heads]
    return [(name, fraction) for fraction in sorted(record.grid.fractions, reverse=True) for name in heads]


def _sweep(record: SweepRecord, design: str) -> Numbers:
    grid = record.grid
    writers = record.data.get("writers", [])
    unfinished = [
        cell for key, cell in record.planned.items() if key not in record.results and key not in record.failed
    ]
    return {
        "name": grid.name,
        "title": grid.title,
        "simulator": f"imported drives, written by {', '.join(writers)}" if writers else SIMULATOR,
        "imported": bool(writers),
        "profile": record.profile,
        "design": design,
        "encoder_seeds": grid.encoder_seeds,
        "policy_seeds": grid.policy_seeds,
        "policy_epochs": record.settings.policy.epochs,
        "baseline": grid.baseline,
        "heads": [name for name in HEAD_SETS if name in grid.heads],
        "fractions": sorted(grid.fractions, reverse=True),
        "planned": len(record.planned),
        "finished": sum(key in record.results for key in record.planned),
        "unfinished": [cell.label for cell in unfinished],
        "failed": [
            {
                "cell": record.planned[key].label,
                "reason": reason.strip().splitlines()[-1][:300] if reason.strip() else "",
            }
            for key, reason in record.failed.items()
            if key in record.planned and key not in record.results
        ],
    }


def _floors(record: SweepRecord) -> Numbers:
    """What no learning at all gives on the test frames."""
    for key, cell in record.planned.items():
        if key in record.results:
            steering = claims.steering_floor(record, (cell.heads, cell.fraction))
            return {"accuracy": record.results[key].facts["floor"], "steering": steering}
    return {"accuracy": math.nan, "steering": math.nan}


def _ceiling(record: SweepRecord) -> Numbers | None:
    """Accuracy of policies that are given the true state, where they were trained."""
    if record.ceiling is None:
        return None
    table = record.table(ceiling=True)
    (curves,) = stats.panel(table[table["heads"] == CEILING], stats.ACCURACY).values()
    return _spread(curves)


def _score(
    record: SweepRecord, point: Point, panels: Mapping[str, Panel], floor: float, ceiling: Numbers | None
) -> Numbers:
    results = claims.results_at(record, point)
    guesses = [(item.predictions["acceleration"], item.predictions["acceleration_label"]) for item in results]
    recall = np.concatenate([stats.confusion(guess, label) for guess, label in guesses]).mean(axis=0)
    accuracy = panels["accuracy"][point]
    scored = {name: _spread(curves[point]) for name, curves in panels.items() if point in curves}
    gain = scored["accuracy"]["mean"] - floor
    return {
        "cell": claims.label(point, record.grid),
        "heads": point[0],
        "fraction": point[1],
        "encoders": stats.encoders(accuracy),
        "n": len(accuracy),
        **scored,
        "gain": gain,
        "share": gain / (ceiling["mean"] - floor) if ceiling and ceiling["mean"] > floor else math.nan,
        "macro_f1": float(np.concatenate([stats.macro_f1(guess, label) for guess, label in guesses]).mean()),
        "confusion": recall.tolist(),
        "classes": list(ACCELERATIONS),
    }


def _spread(curves: pd.DataFrame) -> Numbers:
    final = stats.final(curves)
    found = stats.mean_interval(final)
    middle = float(stats.interquartile_mean(final.to_numpy()))
    sd = float(final.std(ddof=1)) if len(final) > 1 else math.nan
    return {"mean": found.value, "sd": sd, "iqm": middle, **_interval(found), "units": stats.by_seed(final).to_dict()}


def _interval(found: Estimate) -> Numbers:
    return {"low": found.low, "high": found.high, "n": found.n, "kind": found.kind}


def _contrast(record: SweepRecord, contrast: claims.Contrast) -> Numbers:
    return {"name": _difference(record, contrast.first, contrast.second), **dataclasses.asdict(contrast)}


def _confounds(record: SweepRecord) -> list[Numbers]:
    """Contrasts under both values of each setting that may confound them; without any where no sweep varies it."""
    rows = []
    for confound in confounds.concerned(record):
        other = record.variants.get(confound.setting)
        found = confounds.contrasts(record, other, confound) if other else []
        rows.append(
            {
                "setting": confound.setting,
                "about": confound.about,
                "here": confounds.value(record.settings, confound.setting),
                "there": confounds.value(other.settings, confound.setting) if other else None,
                "sweep": other.grid.name if other else confound.sweep,
                "floor": _floors(other)["accuracy"] if other else None,
                "contrasts": [
                    {"name": _difference(record, row.first, row.second), **dataclasses.asdict(row)} for row in found
                ],
            }
        )
    return rows


def _difference(record: SweepRecord, first: Point, second: Point) -> str:
    return f" {claims.MINUS} ".join(claims.label(point, record.grid) for point in (first, second))


def _convergence(record: SweepRecord, point: Point, curves: pd.DataFrame, base: pd.DataFrame) -> Numbers:
    target = float(stats.final(base).mean())
    by_seed = stats.reach_by_seed(curves, target)
    return {
        "cell": claims.label(point, record.grid),
        "fraction": point[1],
        "heads": point[0],
        "target": target,
        "mean_curve": stats.epochs_to_reach(curves, base),
        "median": by_seed.median,
        "share": by_seed.share,
        "area": by_seed.area,
        "n": len(curves),
    }


def _encoders(record: SweepRecord, table: pd.DataFrame) -> list[Numbers]:
    """Losses of the encoders' heads after the last epoch, mean over encoder seeds."""
    rows = table[table["stage"] == "encoder"]
    made = []
    for heads, fraction in _points(record):
        own = rows[(rows["heads"] == heads) & (rows["fraction"] == fraction)]
        if own.empty:
            continue
        last = own[own["epoch"] == own["epoch"].max()].groupby(["metric", "split"])["value"].mean()
        losses = {
            head: {split: last.get((f"loss_{head}", split), math.nan) for split in ("train", "test")}
            for head in HEAD_SETS[heads]
        }
        count = own["encoder_seed"].nunique()
        made.append({"cell": claims.label((heads, fraction), record.grid), "encoders": count, "losses": losses})
    return made


def _probes(record: SweepRecord) -> list[Numbers]:
    """What a linear model reads off the latents of the policy set's test frames, mean over encoders."""
    rows = []
    for point in _points(record):
        found = [_probed(result) for result in claims.results_at(record, point)]
        if found and all(found):
            means = {name: float(np.mean([one[name] for one in found])) for name in found[0]}
            rows.append({"cell": claims.label(point, record.grid), "encoders": len(found), **means})
    return rows


def _probed(result: CellResult) -> dict[str, float]:
    """R2 of each probed quantity; empty for a result of a version that did not keep them."""
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
    return {name: stats.probe(own["z"], np.asarray(v, np.float64), own["episode"]) for name, v in targets.items()}


def _settings(record: SweepRecord) -> list[Numbers]:
    """Every setting with its meaning and whether it differs from the program's default."""
    rows = []
    for group, model in record.settings:
        for name, info in type(model).model_fields.items():
            value = getattr(model, name)
            shown = model.model_dump(mode="json")[name]
            rows.append(
                {
                    "group": group,
                    "name": name,
                    "value": shown if isinstance(shown, str) else json.dumps(shown),
                    "meaning": info.description or "",
                    "default": value == info.get_default(call_default_factory=True),
                }
            )
    return rows


def _data(record: SweepRecord) -> Numbers:
    """Of the manifest: frames, drives, labels before and after balancing."""
    sets = record.data.get("sets", {})
    return {
        "key": record.data.get("key"),
        "sets": {
            name: {
                "drives": len(record.data.get("sources", {}).get(name, ())),
                "test_drives": _count(content.get("test_drives")),
                **{field: content.get(field) for field in ("frames", "train", "test")},
                "candidates": content.get("candidates"),
                "chosen": content.get("chosen"),
            }
            for name, content in sets.items()
        },
    }


def _count(value: Any) -> Any:
    return len(value) if isinstance(value, list) else value


def _cost(record: SweepRecord) -> Numbers:
    costs = [cell_cost(record.settings, cell, record.grid.policy_seeds) for cell in record.planned.values()]
    rows = []
    for key, cell in record.planned.items():
        if key not in record.results:
            continue
        facts = record.results[key].facts
        seconds = facts.get("seconds", {})
        rows.append(
            {
                "cell": cell.label,
                **{stage: seconds.get(stage) for stage in ("encoder", "encode", "policies")},
                "whole": seconds.get("cell"),
                "peak_bytes": facts.get("peak_bytes"),
                **{name: facts.get(name) for name in ("device", "precision", "threads")},
                "frames": facts.get("frames", {}).get("encoder_train"),
            }
        )
    return {
        "cells": rows,
        "seconds": sum(row["whole"] or 0.0 for row in rows),
        "disk": total([data_cost(record.settings, recorded="writers" not in record.data), *costs]).bytes,
        "peak_bytes": max((row["peak_bytes"] or 0 for row in rows), default=None),
    }


def _provenance(record: SweepRecord) -> Numbers:
    """Of the sweep, and whether all its cells come from the same commit."""
    own = record.provenance
    packages = own.get("packages", {})
    commits = {
        str(found["commit"])
        for result in record.results.values()
        if (found := result.facts.get("provenance", {})).get("commit")
    }
    return {
        **{name: own.get(name) for name in ("commit", "dirty", "lock", "python", "platform", "cpu", "cores")},
        "diff_lines": len(str(own.get("diff") or "").splitlines()),
        "packages": {name: packages[name] for name in SHOWN_PACKAGES if name in packages},
        "cell_commits": sorted(commits),
        "command": own.get("command", f"python -m study.sweep {record.grid.name} --profile {record.profile}"),
        "keys": {cell.label: key for key, cell in record.planned.items()},
    }
