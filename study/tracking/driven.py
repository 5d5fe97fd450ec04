"""Drives of finished cells in MLflow: scores on the runs of the cell and of its policies, a table and films as files.

Metrics are `drive/<score>` for drives in the study's town and `drive_unseen/<score>` in others; on a cell's run with sd
and interval over its policies, as other scores are. The tag `drive_key` comes last: with it the cell has driven.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path

import pandas as pd
from mlflow.entities import Metric, RunTag

from study.atomic import scratch_folder
from study.results.drives import PLACES, means
from study.tracking.metrics import bands
from study.tracking.reader import DRIVE_KEY, DRIVES, PARENT
from study.tracking.tracker import Tracker


def commit_drives(tracker: Tracker, run_id: str, key: str, table: pd.DataFrame, films: Mapping[str, bytes]) -> None:
    """Log the drives of a finished cell to its run. Can be called again: nothing is doubled."""
    with tracker.experiment.guard(), scratch_folder() as name:
        folder = Path(name) / DRIVES.parent
        folder.mkdir()
        table.to_parquet(folder / DRIVES.name, index=False)
        for film, content in films.items():
            (folder / film).write_bytes(content)
        tracker.client.log_artifacts(run_id, str(folder), str(DRIVES.parent))
        started = tracker.client.get_run(run_id).info.start_time
        cell: dict[str, float] = {}
        policies: dict[int, dict[str, float]] = {}
        for place in PLACES:
            scores = means(table, place).add_prefix("drive/" if place == PLACES[0] else f"drive_{place}/")
            if scores.empty:
                continue
            for ending, values in bands(scores).items():
                cell |= dict(zip((f"{column}{ending}" for column in scores), values.tolist(), strict=True))
            for seed, row in zip(scores.index.tolist(), scores.to_dict("records"), strict=True):
                policies.setdefault(seed, {}).update({str(name): value for name, value in row.items()})
        for seed_run in tracker.experiment.search(f"tags.kind = 'seed' and tags.`{PARENT}` = '{run_id}'"):
            _log(tracker, seed_run.info.run_id, policies.get(int(seed_run.data.tags["policy_seed"]), {}), started)
        _log(tracker, run_id, cell, started)
        tracker.client.log_batch(run_id, tags=[RunTag(DRIVE_KEY, key)])


def _log(tracker: Tracker, run_id: str, numbers: Mapping[str, float], time: int) -> None:
    metrics = [Metric(name, float(f"{value:.6g}"), time, 0) for name, value in numbers.items() if math.isfinite(value)]
    tracker.client.log_batch(run_id, metrics=metrics)
