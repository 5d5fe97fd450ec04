"""Follow the curves of a sweep in MLflow's store, for any other tracker. See docs/trackers.md."""

from __future__ import annotations

import time
from collections.abc import Iterator

from mlflow.entities import Metric, Run

from study.tracking.reader import Reader


def follow(
    name: str, tracking: str, *, profile: str | None = None, seconds: float | None = None
) -> Iterator[tuple[Run, list[Metric]]]:
    """Yield each attempt at a cell of the latest sweep of that name, with the points that are new since the last time.

    A point has `key`, `step` (the epoch), `value` and `timestamp` [ms]; those of one key come in the order of steps.
    With `seconds` the store is read again every so often until the sweep ends; without, once. Raises BadInputError when
    there is no such sweep, or when the store stops answering.
    """
    reader = Reader.existing(tracking)
    experiment, client = reader.experiment, reader.experiment.client
    sweep_run = reader.sweeps_of(name, profile)[0]
    planned = experiment.read_json(sweep_run, "plan.json")[
        "planned"
    ]  # other sweeps may have finished some of its cells
    latest: dict[str, dict[str, float]] = {}
    seen: dict[str, set[tuple[str, int]]] = {}
    while True:
        with experiment.guard():
            ended = client.get_run(sweep_run).info.status != "RUNNING"  # asked first: what it wrote last is read below
            for run in experiment.search("tags.kind = 'cell'"):
                run_id = run.info.run_id
                if run.data.tags.get("cell_key") in planned and run.data.metrics != latest.get(run_id):
                    latest[run_id] = run.data.metrics
                    points = [point for key in latest[run_id] for point in client.get_metric_history(run_id, key)]
                    points = [point for point in points if (point.key, point.step) not in seen.get(run_id, ())]
                    seen.setdefault(run_id, set()).update((point.key, point.step) for point in points)
                    yield run, sorted(points, key=lambda point: (point.key, point.step))
        if ended or seconds is None:
            return
        time.sleep(seconds)
