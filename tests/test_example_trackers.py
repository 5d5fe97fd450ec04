"""A sweep's curves are the same in TensorBoard as in MLflow, after the sweep and while it runs."""

import itertools
import shutil

import numpy as np
import pytest
from mlflow.tracking import MlflowClient

from examples.follow_sweep import follow
from study.tracking.tracker import Tracker
from tests.support.synthetic_records import HEADS_GRID, World, simulate

REASON = "the extra 'tensorboard' is not installed"


def mirrored(folder):
    """Return what TensorBoard shows of a run: tag -> steps and values."""
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    events = EventAccumulator(str(folder), size_guidance={"scalars": 0}).Reload()
    return {tag: [(point.step, point.value) for point in events.Scalars(tag)] for tag in events.Tags()["scalars"]}


@pytest.mark.parametrize("times", [1, 2], ids=["once", "again into the same folder"])
def test_tensorboard_shows_every_point_of_a_real_sweep_once(times, undisturbed, tmp_path):
    pytest.importorskip("tensorboard", reason=REASON)
    from examples.tensorboard_mirror import main

    store = f"sqlite:///{undisturbed.folder}/mlruns/mlflow.db"
    for _ in range(times):
        assert main(["heads", "--tracking", store, "--out", str(tmp_path)]) == 0
    client = MlflowClient(store)
    experiment = client.get_experiment_by_name("study").experiment_id
    runs = client.search_runs([experiment], "tags.kind = 'cell'")
    assert sorted(path.name for path in (tmp_path / "heads (tiny)").iterdir()) == sorted(
        run.info.run_name for run in runs
    )
    for run in runs:
        shown = mirrored(tmp_path / "heads (tiny)" / run.info.run_name)
        assert shown.keys() == run.data.metrics.keys() >= {"policy/test/steering_loss", "encoder/test/loss_rec"}
        for tag, points in shown.items():
            history = sorted((point.step, point.value) for point in client.get_metric_history(run.info.run_id, tag))
            np.testing.assert_allclose(points, history, rtol=1e-6)  # events hold float32


def test_a_sweep_is_followed_to_its_end_and_each_point_comes_once(empty_store, tmp_path):
    store = f"sqlite:///{shutil.copy(empty_store, tmp_path)}"
    record = simulate(HEADS_GRID.model_copy(update={"policy_seeds": 2, "baselines": ()}), World(epochs=2))
    tracker = Tracker(store)
    sweep = tracker.open_sweep(
        record.grid, record.profile, record.settings, record.planned, record.data, record.provenance
    )
    key, cell = next(iter(record.planned.items()))
    cell_run = tracker.start_cell(sweep, cell, key, record.settings, 2)
    heard = []
    news = follow("heads", store, seconds=0.01)
    for epoch in range(3):
        cell_run.log("encoder", epoch, {"test/loss_rec": 1 / (1 + epoch)})
        cell_run.flush()
        heard.append(next(news))
    tracker.close_sweep(sweep, "FINISHED")
    heard += news
    assert {run.info.run_id for run, _ in heard} == {cell_run.run_id}
    points = list(itertools.chain.from_iterable(points for _, points in heard))
    assert [(point.key, point.step, point.value) for point in points] == [
        ("encoder/test/loss_rec", epoch, 1 / (1 + epoch)) for epoch in range(3)
    ]
