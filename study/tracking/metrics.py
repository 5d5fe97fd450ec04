"""A cell in MLflow's terms: its curves as points with mean, spread and interval over the seeds, its facts as columns.

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

Point = tuple[str, int, float]  # metric, epoch, value
Numbers = NDArray[np.float64]

COMMIT = "mlflow.source.git.commit"


def scores_of(result: CellResult) -> pd.DataFrame:
    """Return the final scores on test frames (Sec. V-B): one row per policy seed, one column per metric."""
    from study.analysis.learning_curves import final  # noqa: PLC0415 - scipy, which reading what is finished does not need

    rows = result.curves[(result.curves["split"] == "test") & (result.curves["stage"] == "policy")]
    return final(rows.pivot_table(index=["policy_seed", "metric"], columns="epoch", values="value")).unstack("metric")  # noqa: PD010


def bands(values: pd.DataFrame) -> dict[str, Numbers]:
    """Return mean, `/sd`, `/low` and `/high` over the seeds (rows) of each column; the ends are NaN for one seed."""
    from study.analysis.intervals import t_limits  # noqa: PLC0415 - as above

    low, high = t_limits(values.to_numpy(np.float64))
    mean, sd = values.mean(axis=0).to_numpy(np.float64), values.std(axis=0).to_numpy(np.float64)
    return {"": mean, "/sd": sd, "/low": low, "/high": high}


def cell_points(curves: pd.DataFrame) -> Iterator[Point]:
    """Points of a cell run: the encoder's curves, and mean, sd and interval over the policy seeds."""
    own = curves["policy_seed"] == NO_SEED
    yield from points(curves[own])
    for names, rows in curves[~own].groupby(["stage", "split", "metric"], sort=False):
        wide = rows.pivot_table(index="policy_seed", columns="epoch", values="value", dropna=False)
        for ending, values in bands(wide).items():
            name = "/".join(str(part) for part in names) + ending
            for epoch, value in zip(wide.columns, values.tolist(), strict=True):
                if not ending or math.isfinite(value):
                    yield name, int(epoch), value


def points(curves: pd.DataFrame) -> Iterator[Point]:
    """Name, epoch and value of each row."""
    names = curves["stage"] + "/" + curves["split"] + "/" + curves["metric"]
    return zip(names.tolist(), curves["epoch"].tolist(), curves["value"].tolist(), strict=True)


def flatten(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested mappings as one, with dotted names."""
    flat: dict[str, Any] = {}
    for name, value in values.items():
        flat |= flatten(value, f"{prefix}{name}.") if isinstance(value, Mapping) else {f"{prefix}{name}": value}
    return flat


def facts_of(facts: Mapping[str, Any]) -> tuple[dict[str, float], dict[str, str]]:
    """What a cell says of itself: numbers as metrics such as `seconds/encoder`, words as tags."""
    numbers: dict[str, float] = {}
    words: dict[str, str] = {}
    origin = facts.get("provenance", {})
    if origin.get("commit"):
        words[COMMIT] = str(origin["commit"])
    for name in ("dirty", "diff_digest", "lock", "python", "platform", "cpu"):
        if origin.get(name) is not None:
            words[name] = str(origin[name])
    for name in ("determinism", "seeds"):
        if name in origin:
            words[name] = json.dumps(origin[name])
    for name, value in flatten({name: value for name, value in facts.items() if name != "provenance"}).items():
        if isinstance(value, int | float) and not isinstance(value, bool):
            numbers[name.replace(".", "/")] = float(value)
        else:
            words[name] = value if isinstance(value, str) else json.dumps(value)
    return numbers, words
