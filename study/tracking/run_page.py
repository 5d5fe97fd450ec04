"""What MLflow's pages show of an experiment: a word on what is there, a view of all cells, and what each of them is."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from study.config.grid import Cell
from study.config.heads import CEILING, HEAD_SETS

NOTE = "mlflow.note.content"
KEY = "cells"  # of the view: the pages open with it at ?viewStateShareKey=cells
COLUMNS = {  # with their widths in pixels
    "params.`heads`": 90,
    "params.`fraction`": 80,
    "params.`encoder_seed`": 110,
    "params.`policy_seeds`": 110,
    "tags.`state`": 80,
    "metrics.`final/acceleration_accuracy`": 200,
    "metrics.`final/acceleration_accuracy/sd`": 210,
    "metrics.`final/steering_loss`": 160,
    "metrics.`floor`": 80,
    "tags.`sweep`": 110,
}
CHARTS = "policy/test/(steering_loss|acceleration_accuracy)$"  # of the many there are; a regular expression


def welcome(experiment: str, there: Mapping[str, str]) -> dict[str, str]:
    """Tags of an experiment, by its number and the tags it has; a note that somebody has edited stays."""
    tags = {f"mlflow.sharedViewState.{KEY}": json.dumps(_view())}
    if NOTE not in there:
        link = f"#/experiments/{experiment}/runs?viewStateShareKey={KEY}&workflowType=machine_learning"
        tags[NOTE] = (
            f"[All cells with their scores]({link}); the second of the three buttons there draws their curves. "
            "In the list of runs each sweep unfolds to its cells, each cell to its policy seeds."
        )
    return tags


def about(cell: Cell, policy_seeds: int) -> str:
    """A cell run's description."""
    trained = f"{policy_seeds} policies on the true state, without encoder"
    if cell.heads != CEILING:
        heads = " + ".join(HEAD_SETS[cell.heads])
        trained = (
            f"An encoder trained with the heads {heads} on {cell.fraction * 100:g} % of the data (encoder seed "
            f"{cell.encoder_seed}), and {policy_seeds} policies on its frozen latent; model `driver` is all of them as "
            "one network"
        )
    return (
        f"{trained}. Curves `policy/...` are means over "
        "the policies; `/sd`, `/low`, `/high` are their standard deviation and the 95 % interval of that mean. "
        "`final/...` is the mean of the last five epochs on test frames, `floor` the accuracy of always saying the "
        "commonest class."
    )


def _view() -> dict[str, Any]:
    return {
        "searchFilter": "tags.kind = 'cell' and attributes.status != 'KILLED'",
        "orderByKey": "params.`heads`",  # any order but by date: MLflow then lists cells, not sweeps to unfold
        "orderByAsc": True,
        "startTime": "ALL",
        "lifecycleFilter": "Active",
        "datasetsFilter": [],
        "selectedColumns": list(COLUMNS),
        "columnOrder": list(COLUMNS),
        "columnWidths": COLUMNS,
        "runsHiddenMode": "SHOW_ALL",  # MLflow draws ten runs otherwise, and the others are missed
        "chartsSearchFilter": CHARTS,
    }
