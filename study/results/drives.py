"""The drives of a cell's policies in closed loop, as a table: one row for each policy and drive.

Columns: policy_seed (EXPERT: the expert itself in the same drive), place ("town": the study's, "unseen": another one
for each drive), drive (its seed; every cell has the same), ended, reason (see `study.driving.rollout`), way [m], which
the expert makes in that drive, and the scores of `study.driving.metrics.DriveScores`.
"""

from __future__ import annotations

import pandas as pd

EXPERT = -1
PLACES = ("town", "unseen")
WAY = "way"
FACTS = ("policy_seed", "place", "drive", WAY, "ended", "reason")  # columns that are no scores


def means(table: pd.DataFrame, place: str) -> pd.DataFrame:
    """Return each policy's mean scores over the drives of a place, indexed by policy seed; none for none there."""
    rows = table[(table["place"] == place) & (table["policy_seed"] != EXPERT)]
    return rows.drop(columns=[name for name in FACTS if name != "policy_seed"]).groupby("policy_seed").mean()
