"""The metrics of policies on test frames: what each measures, and how a report shows it.

To add a metric, write a function that returns one value for each policy of a cell, and add its record to `METRICS`.
Tables, comparisons and report.json derive from it. A metric that has a curve is called as it is there and in MLflow.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import numpy as np
import pandas as pd
from pydantic import Field

from study.analysis import predictions
from study.config.paper import ACCELERATIONS
from study.config.settings import Settings
from study.results.cell_result import CellResult
from study.statistics import learning_curves
from study.statistics.learning_curves import ACCURACY, KEYFRAME, LAST, STEERING, Array

Values = Callable[[CellResult], Array]  # one value for each policy, [S]; empty where the result does not have them


class Metric(Settings, extra="ignore"):
    """A score of a policy on test frames.

    Numbers are shown as `factor * value` with `digits`, in `unit`. `guess` names the best answer that ignores the
    input, where a report gives its score as the floor. `about` is a sentence for a table's caption.
    """

    name: str
    title: str
    unit: str = ""
    factor: float = 1.0
    digits: int = 3
    better: Literal["higher", "lower"] = "higher"
    guess: str = ""
    about: str = ""
    values: Values = Field(lambda _: np.empty(0), exclude=True, repr=False)  # not in report.json


def scores(results: list[CellResult], metric: Metric) -> pd.Series:
    """Return the metric of every policy of some results, by encoder and policy seed."""
    parts = []
    for result in results:
        values = metric.values(result)
        seeds = sorted(set(result.curves.loc[result.curves["stage"] == "policy", "policy_seed"]))[: len(values)]
        index = pd.MultiIndex.from_product([[result.cell.encoder_seed], seeds], names=["encoder_seed", "policy_seed"])
        parts.append(pd.Series(values, index, dtype=np.float64))
    return pd.concat(parts).sort_index()


def late(name: str) -> Values:
    """Return the function that gives a curve's final score: its mean over the last epochs on test frames (Sec. V-B)."""

    def values(result: CellResult) -> Array:
        curves = result.curves
        rows = curves[(curves["metric"] == name) & (curves["split"] == "test") & (curves["stage"] == "policy")]
        wide = rows.set_index(["policy_seed", "epoch"])["value"].unstack("epoch")  # noqa: PD010 - no value is there twice
        return learning_curves.final(wide.astype(np.float64).sort_index().sort_index(axis=1)).to_numpy()

    return values


def _macro_f1(result: CellResult) -> Array:
    return predictions.macro_f1(result.predictions["acceleration"], result.predictions["acceleration_label"])


def _recall(index: int) -> Values:
    """Return the function that gives the share of a class's frames that are given that class."""

    def values(result: CellResult) -> Array:
        frames = result.predictions["acceleration_label"] == index
        right = result.predictions["acceleration"][:, frames] == index
        return np.asarray(right.sum(axis=1) / max(frames.sum(), 1))

    return values


METRICS: dict[str, Metric] = {
    metric.name: metric
    for metric in (
        Metric(
            name=ACCURACY,
            title="accuracy",
            unit="%",
            factor=100,
            digits=2,
            guess="commonest class",
            about=f"Accuracy: share of frames whose acceleration class is right, mean of the last {LAST} epochs.",
            values=late(ACCURACY),
        ),
        Metric(
            name=STEERING,
            title="steering",
            unit="10⁻³",
            factor=1e3,
            better="lower",
            guess="best constant command",
            about=f"Steering: smooth L1 loss, mean of the last {LAST} epochs.",
            values=late(STEERING),
        ),
        Metric(
            name=KEYFRAME,
            title="keyframes",
            unit="%",
            factor=100,
            digits=2,
            about="Keyframes: accuracy on frames whose class has changed within 0.5 s, where copying the last command "
            f"fails, last {LAST} epochs.",
            values=late(KEYFRAME),
        ),
        Metric(
            name="natural_accuracy",
            title="natural",
            unit="%",
            factor=100,
            digits=2,
            about="Natural: accuracy and steering loss with frames weighted to the distribution in driving, before "
            f"balancing, last {LAST} epochs.",
            values=late("natural_accuracy"),
        ),
        Metric(
            name="natural_steering_loss",
            title="natural steering",
            unit="10⁻³",
            factor=1e3,
            better="lower",
            values=late("natural_steering_loss"),
        ),
        Metric(
            name="balanced_accuracy",
            title="balanced",
            unit="%",
            factor=100,
            digits=2,
            about=f"Balanced accuracy: mean of the classes' recalls, last {LAST} epochs.",
            values=late("balanced_accuracy"),
        ),
        Metric(name="macro_f1", title="macro-F1", about="Macro-F1: after the last epoch.", values=_macro_f1),
        *(
            Metric(
                name=f"recall_{index}",
                title=f"recall {value:g}".replace("-", "\N{MINUS SIGN}"),
                unit="%",
                factor=100,
                digits=2,
                about="Recall of each class of throttle \N{MINUS SIGN} brake: after the last epoch." * (index == 0),
                values=_recall(index),
            )
            for index, value in enumerate(ACCELERATIONS)
        ),
    )
}
