"""What policies do at the wheel: scores by drive, rates, and what ends drives.

The policies of every cell drive the same held-out drives, each once. So drives are crossed with policies, as test
drives are, and the number of independent drives is theirs, whatever the number of policies. To show a further score,
add its record to `SCORES`, `RATES` or `PER_KM`. How each is measured: `study.driving.metrics.DriveScores`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal

import numpy as np
import pandas as pd
from scipy import stats as scipy_stats

from study.analysis.metrics import Metric
from study.results.drives import EXPERT, FACTS
from study.results.sweep_record import SweepRecord
from study.statistics import learning_curves
from study.statistics.drives import DriveScores
from study.statistics.intervals import Estimate
from study.statistics.learning_curves import ACCURACY, DRIVING, Panel, Point
from study.statistics.proportions import wilson_interval

TOWN, UNSEEN = "town", "unseen"
PLACES = {TOWN: "the study's town", UNSEEN: "towns that nothing was recorded in"}
FAILURE = "failure"

SCORES: dict[str, Metric] = {  # a mean over drives
    metric.name: metric
    for metric in (
        Metric(
            name=DRIVING,
            title="driving score",
            digits=1,
            about="Driving score, 0 to 100: route completion times a penalty for each infraction, 0.50 for hitting a "
            "pedestrian, 0.60 for a vehicle, 0.65 for leaving the road, 0.70 for a red light (CARLA leaderboard 1.0).",
        ),
        Metric(
            name="route_completion",
            title="route",
            unit="%",
            factor=100,
            digits=1,
            about="Route: way made along the planned route, as a share of the expert's way in the same drive (nuPlan).",
        ),
        Metric(name="mean_speed", title="speed", unit="m/s", digits=2, about="Speed: mean over the drive."),
        Metric(
            name="comfort",
            title="comfort",
            unit="%",
            factor=100,
            digits=1,
            about="Comfort: share of the time within nuPlan's bounds of acceleration, jerk and yaw, to be read beside "
            "the expert's own.",
        ),
        Metric(
            name="steering_rate",
            title="oscillation",
            unit="1/s",
            digits=3,
            better="lower",
            about="Oscillation: root mean square of the change of the steering label (Tampuu et al. 2023).",
        ),
    )
}

Counted = Callable[[pd.DataFrame], "pd.Series[Any]"]
_RATES: dict[str, Counted] = {  # whether a drive counts, as 0 or 1
    "success": lambda rows: rows["success"],
    "at_fault": lambda rows: rows["at_fault"],
    "red_light": lambda rows: (rows["red_lights"] > 0).astype(np.float64),
    "off_route": lambda rows: rows["off_route"],
    "blocked": lambda rows: rows["blocked"],
}
_PER_KM: dict[str, Counted] = {  # what is counted over the way of all drives
    "at_fault_per_km": lambda rows: rows["at_fault"],
    "others_per_km": lambda rows: rows["collision"] - rows["at_fault"],
    "red_lights_per_km": lambda rows: rows["red_lights"],
    "layout_per_km": lambda rows: rows["layout"],
}


def _rate(name: str, title: str, about: str, better: Literal["higher", "lower"] = "lower") -> Metric:
    return Metric(name=name, title=title, unit="%", factor=100, digits=0, better=better, about=about)


def _per_km(name: str, title: str, about: str = "") -> Metric:
    return Metric(name=name, title=title, unit="1/km", digits=2, better="lower", about=about)


RATES: dict[str, Metric] = {
    metric.name: metric
    for metric in (
        _rate("success", "success", "Success: driven for the whole time without any infraction.", "higher"),
        _rate("at_fault", "at fault", "At fault: the drive ended in a collision that is the ego's (nuPlan's rule)."),
        _rate("red_light", "red light", "Red light: at least one was run."),
        _rate("off_route", "off route", "Off route: ended more than 4 m from the planned path."),
        _rate("blocked", "blocked", "Blocked: ended after standing for 10 s where the expert would have gone."),
    )
}
PER_KM: dict[str, Metric] = {
    metric.name: metric
    for metric in (
        _per_km("at_fault_per_km", "at fault", "Collisions at fault and others,"),
        _per_km("others_per_km", "others"),
        _per_km("red_lights_per_km", "red lights", "red lights run,"),
        _per_km("layout_per_km", "layout", "and layout: a corner more than 0.3 m beyond the road."),
    )
}
ENDS = {  # what ends a drive -> in words, from the best to the worst
    "time": "drove to the end",
    "others": "collision, not at fault",
    "at fault": "collision, at fault",
    "off route": "off route",
    "blocked": "blocked",
    FAILURE: "no command",
}


def drives_at(record: SweepRecord, place: str) -> pd.DataFrame:
    """Return the drives of the policies at a place, of those drives that all policies of all cells have driven.

    A drive that failed before it had a score counts as 0. Where no drive is common to all, all are returned.
    """
    table = record.drive_table
    rows = table[(table["place"] == place) & (table["policy_seed"] != EXPERT)]
    numbers = [name for name in rows.columns if rows[name].dtype.kind == "f" and name not in {"fraction", *FACTS}]
    failed = rows["ended"] == FAILURE
    rows = rows.assign(**{name: rows[name].mask(failed, rows[name].fillna(0.0)) for name in numbers})
    rows = rows.dropna(subset=numbers)
    policies = rows.groupby(["heads", "fraction", "encoder_seed", "policy_seed"]).ngroups
    counts = rows["drive"].value_counts()
    common = counts.index[counts == policies]
    return rows[rows["drive"].isin(common)] if len(common) else rows


def expert_drives(record: SweepRecord, place: str) -> pd.DataFrame:
    """Return the expert's own drives at a place, each once, of those that the policies have driven."""
    table, own = record.drive_table, drives_at(record, place)["drive"]
    rows = table[(table["place"] == place) & (table["policy_seed"] == EXPERT) & table["drive"].isin(own)]
    return rows.drop_duplicates("drive")


def by_cell(rows: pd.DataFrame) -> dict[Point, pd.DataFrame]:
    """Return the drives of each head set or baseline and fraction."""
    groups = rows.groupby(["heads", "fraction"], sort=False)
    return {(str(heads), float(str(fraction))): group for (heads, fraction), group in groups}


def scores_by_drive(rows: pd.DataFrame, metric: str) -> DriveScores:
    """Return one cell's scores by policy and drive; every drive has the same weight."""
    wide = rows.set_index(["encoder_seed", "policy_seed", "drive"])[metric].unstack("drive")  # noqa: PD010 - each once
    wide = wide.dropna(axis="columns").astype(np.float64).sort_index().sort_index(axis=1)
    return DriveScores(wide, np.ones(wide.shape[1]), "held-out drives")


def panel(record: SweepRecord, place: str = TOWN, metric: str = DRIVING) -> tuple[Panel, dict[Point, DriveScores]]:
    """Return a score of head sets as curves of one epoch, the last, and the same by drive; baselines are included."""
    drives = {point: scores_by_drive(rows, metric) for point, rows in by_cell(drives_at(record, place)).items()}
    drives = {point: scores for point, scores in drives.items() if scores.scores.size}
    epoch = record.settings.policy.epochs
    return {point: scores.scores.mean(axis=1).to_frame(epoch) for point, scores in drives.items()}, drives


def rates(rows: pd.DataFrame) -> dict[str, Estimate]:
    """Return shares of drives with Wilson's intervals over drives: policies drive the same ones."""
    drives = rows["drive"].nunique()
    return {name: wilson_interval(drives * float(count(rows).mean()), drives) for name, count in _RATES.items()}


def per_km(rows: pd.DataFrame) -> dict[str, float]:
    """Return how often what is counted happens over the way of all drives [1/km]; NaN without any way."""
    way = float(rows["distance"].sum())
    return {name: float(count(rows).sum()) / way if way else float("nan") for name, count in _PER_KM.items()}


def ends(rows: pd.DataFrame) -> dict[str, float]:
    """Return the share of the drives that each of `ENDS` has ended."""
    collision = np.where(rows["at_fault"] > 0, "at fault", "others")
    ended = rows["ended"].where(rows["ended"] != "collision", pd.Series(collision, rows.index))
    return {end: float((ended == end).mean()) for end in ENDS}


def accuracy_and_driving(record: SweepRecord) -> pd.DataFrame:
    """Return, for each policy that drove in the study's town, its final accuracy beside its driving score.

    Columns heads, fraction, encoder_seed, policy_seed, accuracy, score; head sets first, then baselines.
    """
    accuracy = learning_curves.panel(record.table(baselines=True), ACCURACY)
    parts = []
    for point, curve in panel(record)[0].items():
        if point in accuracy:
            both = {"accuracy": learning_curves.final(accuracy[point]), "score": curve.iloc[:, -1]}
            parts.append(pd.DataFrame(both).dropna().reset_index().assign(heads=point[0], fraction=point[1]))
    columns = ["heads", "fraction", "encoder_seed", "policy_seed", "accuracy", "score"]
    return pd.concat(parts, ignore_index=True)[columns] if parts else pd.DataFrame(columns=columns)


def rank_correlation(first: pd.Series, second: pd.Series) -> float:
    """Return Spearman's rank correlation; NaN for fewer than three pairs, or where one does not vary."""
    if len(first) < 3 or first.nunique() < 2 or second.nunique() < 2:
        return float("nan")
    return float(scipy_stats.spearmanr(first.to_numpy(np.float64), second.to_numpy(np.float64)).statistic)
