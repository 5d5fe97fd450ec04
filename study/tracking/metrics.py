"""Turn a cell's result into MLflow's terms: curves as points with spread over the seeds, facts as metrics and tags.

Names of points are `<stage>/<split>/<metric>`, and `final/<metric>` for scores.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from study.results.cell_result import NO_SEED, CellResult
from study.statistics.intervals import t_limits
from study.statistics.learning_curves import final

CurvePoint = tuple[str, int, float]  # metric, epoch, value

COMMIT = "mlflow.source.git.commit"
ORIGIN = ("dirty", "diff_digest", "lock", "python", "platform", "cpu", "determinism", "seeds")  # tags from provenance


def final_scores(result: CellResult) -> pd.DataFrame:
    """Return the final scores on test frames (Sec. V-B): one row per policy seed, one column per metric."""
    rows = result.curves[(result.curves["split"] == "test") & (result.curves["stage"] == "policy")]
    return final(rows.pivot_table(index=["policy_seed", "metric"], columns="epoch", values="value")).unstack("metric")  # noqa: PD010


def bands(values: pd.DataFrame) -> dict[str, NDArray[np.float64]]:
    """Return mean, `/sd`, `/low` and `/high` over the seeds (rows) of each column; the ends are NaN for one seed."""
    low, high = t_limits(values.to_numpy(np.float64))
    mean, sd = values.mean(axis=0).to_numpy(np.float64), values.std(axis=0).to_numpy(np.float64)
    return {"": mean, "/sd": sd, "/low": low, "/high": high}


def cell_points(curves: pd.DataFrame) -> Iterator[CurvePoint]:
    """Yield the points of a cell run: the encoder's curves, and mean, sd and interval over the policy seeds."""
    encoder = curves["policy_seed"] == NO_SEED
    yield from points(curves[encoder])
    for names, rows in curves[~encoder].groupby(["stage", "split", "metric"], sort=False):
        by_seed = rows.pivot_table(index="policy_seed", columns="epoch", values="value", dropna=False)
        for ending, values in bands(by_seed).items():
            name = "/".join(map(str, names)) + ending
            for epoch, value in zip(by_seed.columns, values.tolist(), strict=True):
                if not ending or math.isfinite(value):
                    yield name, int(epoch), value


def points(curves: pd.DataFrame) -> Iterator[CurvePoint]:
    """Return name, epoch and value of each row."""
    names = curves["stage"] + "/" + curves["split"] + "/" + curves["metric"]
    return zip(names.tolist(), curves["epoch"].tolist(), curves["value"].tolist(), strict=True)


def flatten(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return nested mappings as one, with dotted names."""
    flat: dict[str, Any] = {}
    for name, value in values.items():
        flat |= flatten(value, f"{prefix}{name}.") if isinstance(value, Mapping) else {f"{prefix}{name}": value}
    return flat


def known(origin: Mapping[str, Any], name: str) -> str:
    """Return what provenance says of `commit` or `dirty`, or "unknown" with the reason."""
    value = origin.get(name)
    if value is None:
        return f"unknown: {origin['unknown']}" if origin.get("unknown") else "unknown"
    return str(value).lower() if isinstance(value, bool) else str(value)


def describe_facts(facts: Mapping[str, Any]) -> tuple[dict[str, float], dict[str, str]]:
    """Return a cell's facts as metrics such as `seconds/encoder`, and as tags."""
    origin = facts.get("provenance", {})
    words = {name: origin.get(name) for name in ORIGIN}
    if origin:
        words |= {COMMIT: known(origin, "commit"), "dirty": known(origin, "dirty")}
    numbers: dict[str, float] = {}
    for name, value in flatten({name: value for name, value in facts.items() if name != "provenance"}).items():
        if isinstance(value, int | float):
            numbers[name.replace(".", "/")] = float(value)
        else:
            words[name] = value
    texts = {name: json.dumps(value) if isinstance(value, Mapping) else str(value) for name, value in words.items()}
    return numbers, {name: text for name, text in texts.items() if words[name] is not None}
