"""Tags that shape MLflow's pages: what an experiment and a cell run say of themselves, a view of all cells, colours."""

from __future__ import annotations

import json
from collections.abc import Mapping

from study.config.grid import Cell
from study.config.heads import HEAD_SETS

NOTE = "mlflow.note.content"
COLOUR = "mlflow.runColor"
VIEW = "cells"  # the pages open with it at ?viewStateShareKey=cells
COLUMNS = {  # of the view, with their widths in pixels
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
VIEW_STATE = {
    "searchFilter": "tags.kind = 'cell' and attributes.status != 'KILLED'",
    "orderByKey": "params.`heads`",  # ordered by date, MLflow would list sweeps to unfold instead of cells
    "orderByAsc": True,
    "startTime": "ALL",
    "lifecycleFilter": "Active",
    "datasetsFilter": [],
    "selectedColumns": list(COLUMNS),
    "columnOrder": list(COLUMNS),
    "columnWidths": COLUMNS,
    "runsHiddenMode": "SHOW_ALL",  # the default draws ten runs only
    "chartsSearchFilter": "policy/test/(steering_loss|acceleration_accuracy)$",  # a regular expression
}


def experiment_tags(experiment: str, existing: Mapping[str, str]) -> dict[str, str]:
    """Return the tags of an experiment with this id and these tags; a note that somebody has edited stays."""
    tags = {f"mlflow.sharedViewState.{VIEW}": json.dumps(VIEW_STATE)}
    if NOTE not in existing:
        link = f"#/experiments/{experiment}/runs?viewStateShareKey={VIEW}&workflowType=machine_learning"
        tags[NOTE] = (
            f"[All cells with their scores]({link}); the second of the three buttons there draws their curves. "
            "In the list of runs each sweep unfolds to its cells, each cell to its policy seeds."
        )
    return tags


def cell_tags(cell: Cell, policy_seeds: int) -> dict[str, str]:
    """Return a cell run's description, and the colour of its head set or baseline in the figures."""
    head_set = HEAD_SETS.get(cell.heads)
    shown = head_set or cell.baseline
    if cell.baseline:
        training = f"{policy_seeds} policies that are given {cell.baseline.about}"
    else:
        heads = " + ".join(head_set.heads) if head_set else cell.heads
        training = (
            f"An encoder trained with the heads {heads} on {cell.fraction * 100:g} % of the data "
            f"(encoder seed {cell.encoder_seed}), and {policy_seeds} policies on its frozen latent; model `driver` is "
            "all of them as one network"
        )
    note = (
        f"{training}. Curves `policy/...` are means over the policies; `/sd`, `/low`, `/high` are their standard "
        "deviation and the 95 % interval of that mean. `final/...` is the mean of the last five epochs on test "
        "frames, `floor` the accuracy of always saying the commonest class."
    )
    return {NOTE: note, **({COLOUR: shown.colour} if shown else {})}
