"""MLflow as the store of results, on real stores."""

import http.server
import json
import os
import platform
import shutil
import socket
import sqlite3
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from mlflow.artifacts import download_artifacts

from study.config.grid import Cell, Grid
from study.config.settings import StudySettings
from study.errors import BadInputError, masked
from study.results.cell_result import ARRAYS, CellResult
from study.tracking.experiment import SQLITE, TrackerLostError, UnreadableError, check_place
from study.tracking.reader import Reader
from study.tracking.tracker import Tracker
from tests.support.servers import TrackingServer, free_port

EPOCHS, SEEDS = 6, 3
SETTINGS = StudySettings()
DATA = {"key": "f" * 16, "frames": {"encoder": 100, "policy": 50}}
ORIGIN = {"commit": "c" * 40, "dirty": True, "diff": "+A = 2\n", "packages": {"numpy": "2"}, "cores": 2}
GRID = Grid(
    name="heads", title="Effect of different heads", heads=("rec", "full"), policy_seeds=SEEDS, baselines=("state",)
)


def make_result(cell, key, seed=0):
    rng = np.random.default_rng(seed)
    rows = [
        (k, "policy", split, epoch, metric, rng.random())
        for k in range(SEEDS)
        for metric in ("acceleration_accuracy", "steering_loss")
        for split in ("train", "test")
        for epoch in range(1, EPOCHS + 1)
    ]
    rows += [(-1, "encoder", split, epoch, "loss", rng.random()) for split in ("train", "test") for epoch in (1, 2)]
    return CellResult(
        cell=cell,
        key=key,
        settings={"policy_seeds": SEEDS},
        curves=pd.DataFrame(rows, columns=["policy_seed", "stage", "split", "epoch", "metric", "value"]),
        encoder={"w": rng.random((4, 3), dtype=np.float32)},
        policies={"steering_2_bias": rng.random((SEEDS, 1), dtype=np.float32)},
        samples={"input": rng.integers(0, 255, (2, 64, 64, 3), dtype=np.uint8)},
        predictions={"acceleration": rng.integers(0, 3, (SEEDS, 7), dtype=np.uint8)},
        facts={
            "floor": 0.34,
            "frames": {"policy_test": 7},
            "heads": {"rec": {"entropy": 0.2, "constant": 0.33}},
            "seconds": {"encoder": 1.5},
            "device": "cpu",
            "provenance": {"commit": "c" * 40, "dirty": False, "diff": "", "packages": {}},
        },
    )


def cells(prefix, grid=GRID):
    return {f"{prefix}-{number}": cell for number, cell in enumerate(grid.cells())}


@pytest.fixture(scope="module")
def uri(empty_store, tmp_path_factory):
    folder = tmp_path_factory.mktemp("store")
    shutil.copy(empty_store, folder)
    before = Path.cwd()
    os.chdir(folder)  # MLflow makes a folder of its own where it is
    yield f"{SQLITE}{folder}/mlflow.db"
    os.chdir(before)


@pytest.fixture
def tracker(uri, request):
    """Return a tracker with an experiment of its own in the shared store."""
    return Tracker(uri, experiment=request.node.name)


def open_sweep(tracker, planned, grid=GRID, profile="laptop", settings=SETTINGS):
    return tracker.open_sweep(grid, profile, settings, planned, DATA, ORIGIN)


def start(tracker, sweep, planned, key):
    return tracker.start_cell(sweep, planned[key], key, SETTINGS, SEEDS)


def train(tracker, sweep, planned, key, seed=0):
    return tracker.commit(start(tracker, sweep, planned, key), make_result(planned[key], key, seed))


def children(tracker, run_id):
    return [
        run
        for run in tracker.experiment.search(f"tags.`mlflow.parentRunId` = '{run_id}'")
        if run.data.tags["kind"] == "seed"
    ]


def status(tracker, run_id):
    return tracker.client.get_run(run_id).info.status


def curve(tracker, run_id, name):
    return {(point.step, point.value) for point in tracker.client.get_metric_history(run_id, name)}


def assert_no_point_twice(tracker, run_id):
    for name in tracker.client.get_run(run_id).data.metrics:
        steps = [point.step for point in tracker.client.get_metric_history(run_id, name)]
        assert len(steps) == len(set(steps)), name


def assert_same_result(left, right):
    assert (left.cell, left.key, left.settings, left.facts) == (right.cell, right.key, right.settings, right.facts)
    pd.testing.assert_frame_equal(left.curves, right.curves)
    for part in ARRAYS:
        ours, theirs = getattr(left, part), getattr(right, part)
        assert ours.keys() == theirs.keys()
        for name in ours:
            np.testing.assert_array_equal(ours[name], theirs[name])


# --- a cell ---------------------------------------------------------------------------------------------------------


def test_a_committed_result_comes_back_as_it_was(tracker):
    planned = cells("back")
    run_id = train(tracker, open_sweep(tracker, planned), planned, "back-0")
    assert_same_result(tracker.reader.load_result(run_id), make_result(planned["back-0"], "back-0"))


def test_a_cell_is_finished_by_its_commit_only(tracker):
    planned = cells("only")
    sweep = open_sweep(tracker, planned)
    run = start(tracker, sweep, planned, "only-0")
    assert tracker.reader.finished(planned) == {}
    assert tracker.commit(run, make_result(planned["only-0"], "only-0")) == run.run_id
    assert tracker.reader.finished(planned) == {"only-0": run.run_id}
    assert tracker.reader.finished(["other"]) == {}


def test_live_points_appear_while_training_and_are_there_once_at_the_end(tracker):
    planned = cells("live")
    run = start(tracker, open_sweep(tracker, planned), planned, "live-0")
    result = make_result(planned["live-0"], "live-0")
    loss = result.curves[(result.curves["metric"] == "loss") & (result.curves["split"] == "test")]
    for value, epoch in zip(loss["value"], loss["epoch"], strict=True):
        run.log("encoder", epoch, {"test/loss": value})
        run.log("encoder", epoch, {"test/loss": value + 1e-9})  # a resumed worker says it again, nearly the same
    expected = set(zip(loss["epoch"], loss["value"], strict=True))
    run.flush_live()
    assert curve(tracker, run.run_id, "encoder/test/loss") == expected
    tracker.commit(run, result)
    assert curve(tracker, run.run_id, "encoder/test/loss") == expected
    assert_no_point_twice(tracker, run.run_id)


def test_the_cell_run_holds_mean_sd_and_interval_over_its_seeds(tracker):
    planned = cells("band")
    run_id = train(tracker, open_sweep(tracker, planned), planned, "band-0")
    curves = make_result(planned["band-0"], "band-0").curves
    own = curves[(curves["metric"] == "steering_loss") & (curves["split"] == "test")]
    wide = own.pivot_table(index="epoch", columns="policy_seed", values="value")
    name = "policy/test/steering_loss"
    mean, sd, low, high = (dict(curve(tracker, run_id, name + end)) for end in ("", "/sd", "/low", "/high"))
    assert mean == pytest.approx(wide.mean(axis=1).to_dict())
    assert sd == pytest.approx(wide.std(axis=1).to_dict())
    half = 4.302653 / np.sqrt(SEEDS)  # Student's t for two degrees of freedom
    for epoch in range(1, EPOCHS + 1):
        assert high[epoch] - mean[epoch] == pytest.approx(half * sd[epoch], rel=1e-5)
        assert mean[epoch] - low[epoch] == pytest.approx(half * sd[epoch], rel=1e-5)


def test_one_seed_has_a_mean_and_no_interval(tracker):
    planned = cells("one")
    run = start(tracker, open_sweep(tracker, planned), planned, "one-0")
    result = make_result(planned["one-0"], "one-0")
    alone = CellResult(**{**vars(result), "curves": result.curves[result.curves["policy_seed"] <= 0]})
    metrics = tracker.client.get_run(tracker.commit(run, alone)).data.metrics
    assert "policy/test/steering_loss" in metrics
    assert not any(name.endswith(("/sd", "/low", "/high")) for name in metrics)


def test_every_seed_has_a_finished_run_with_its_own_curves(tracker):
    planned = cells("seed")
    run_id = train(tracker, open_sweep(tracker, planned), planned, "seed-0")
    seeds = children(tracker, run_id)
    curves = make_result(planned["seed-0"], "seed-0").curves
    assert sorted(run.info.run_name for run in seeds) == ["policy 00", "policy 01", "policy 02"]
    for run in seeds:
        assert run.info.status == "FINISHED"
        own = curves[
            (curves["policy_seed"] == int(run.data.tags["policy_seed"]))
            & (curves["metric"] == "acceleration_accuracy")
            & (curves["split"] == "train")
        ]
        points = curve(tracker, run.info.run_id, "policy/train/acceleration_accuracy")
        assert points == set(zip(own["epoch"], own["value"], strict=True))


def test_the_final_score_is_the_mean_of_the_last_five_test_epochs(tracker):
    planned = cells("final")
    run_id = train(tracker, open_sweep(tracker, planned), planned, "final-0")
    curves = make_result(planned["final-0"], "final-0").curves
    late = curves[(curves["split"] == "test") & (curves["epoch"] > EPOCHS - 5)]
    expected = late[late["metric"] == "acceleration_accuracy"]["value"].mean()
    assert tracker.client.get_run(run_id).data.metrics["final/acceleration_accuracy"] == pytest.approx(expected)


def test_a_list_of_runs_reads_well(tracker):
    """Names for people; head set, fraction, seeds, floor, timings and origin as columns."""
    planned = cells("list")
    sweep = tracker.client.get_run(open_sweep(tracker, planned))
    assert sweep.info.run_name == "heads (laptop)"
    assert sweep.data.params["encoder.epochs"] == str(SETTINGS.encoder.epochs)
    assert sweep.inputs.dataset_inputs[0].dataset.digest == DATA["key"]
    run = tracker.client.get_run(train(tracker, sweep.info.run_id, planned, "list-1"))
    assert run.info.run_name == "full 100% e0"
    shown = {"heads": "full", "fraction": "1.0", "encoder_seed": "0", "policy_seeds": str(SEEDS)}
    assert shown.items() <= run.data.params.items()
    assert run.data.metrics["floor"] == 0.34
    assert run.data.metrics["seconds/encoder"] == 1.5
    assert (run.data.metrics["heads/rec/entropy"], run.data.metrics["heads/rec/constant"]) == (0.2, 0.33)
    assert run.data.tags["mlflow.source.git.commit"] == "c" * 40
    assert run.data.tags["device"] == "cpu"
    assert run.data.tags["mlflow.runColor"] == "#D55E00"
    assert run.inputs.dataset_inputs[0].dataset.digest == DATA["key"]
    assert "mlflow.user" not in run.data.tags


def test_the_view_of_all_cells_shows_existing_columns(tracker):
    planned = cells("view")
    run = tracker.client.get_run(train(tracker, open_sweep(tracker, planned), planned, "view-0"))
    view = json.loads(tracker.client.get_experiment(tracker.experiment.id).tags["mlflow.sharedViewState.cells"])
    columns = {f"{kind}.`{name}`" for kind in ("params", "metrics", "tags") for name in getattr(run.data, kind)}
    assert set(view["selectedColumns"]) <= columns
    assert [found.info.run_id for found in tracker.experiment.search(view["searchFilter"])] == [run.info.run_id]


def test_a_result_of_another_cell_is_refused(tracker):
    planned = cells("other")
    run = start(tracker, open_sweep(tracker, planned), planned, "other-0")
    with pytest.raises(ValueError, match="other-1"):
        tracker.commit(run, make_result(planned["other-1"], "other-1"))


# --- models ---------------------------------------------------------------------------------------------------------


@pytest.fixture
def network():
    """Return bytes in place of an exported network; the tracker does not look inside."""
    return b"a graph and its weights"


def models(tracker):
    return list(tracker.client.search_logged_models([tracker.experiment.id]))


def network_at(tracker, address):
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MLFLOW_TRACKING_URI", tracker.client.tracking_uri)
        return Path(download_artifacts(address)) / "data" / "model.pt2"


def test_a_committed_cell_has_its_model_with_its_scores(tracker, network):
    planned = cells("model")
    sweep = open_sweep(tracker, planned)
    run_id = tracker.commit(
        start(tracker, sweep, planned, "model-1"), make_result(planned["model-1"], "model-1"), network
    )
    (model,) = models(tracker)
    assert (model.source_run_id, str(model.status)) == (run_id, "READY")
    assert model.params == {"heads": "full", "fraction": "1.0", "encoder_seed": "0", "policy_seeds": str(SEEDS)}
    assert "final/acceleration_accuracy" in {metric.key for metric in model.metrics}
    run = tracker.client.get_run(run_id)
    assert [output.model_id for output in run.outputs.model_outputs] == [model.model_id]
    for address in (f"runs:/{run_id}/driver", f"models:/{model.model_id}"):
        assert network_at(tracker, address).read_bytes() == network


def test_an_attempt_that_was_killed_leaves_no_model(tracker):
    planned = cells("pending")
    sweep = open_sweep(tracker, planned)
    killed = start(tracker, sweep, planned, "pending-0")
    tracker.client.create_logged_model(tracker.experiment.id, "driver", killed.run_id)  # where the upload was cut off
    start(tracker, sweep, planned, "pending-0")
    assert models(tracker) == []


# --- attempts -------------------------------------------------------------------------------------------------------


def test_a_new_attempt_closes_what_a_killed_one_left(tracker):
    planned = cells("again")
    sweep = open_sweep(tracker, planned)
    killed = start(tracker, sweep, planned, "again-0")
    half = tracker._create_run("policy 00", {"kind": "seed", "mlflow.parentRunId": killed.run_id})
    run = start(tracker, sweep, planned, "again-0")
    assert (status(tracker, killed.run_id), status(tracker, half)) == ("KILLED", "KILLED")
    assert tracker.client.get_run(killed.run_id).data.tags["superseded_by"] == run.run_id
    tracker.commit(run, make_result(planned["again-0"], "again-0"))
    assert tracker.reader.finished(planned) == {"again-0": run.run_id}
    names = {run.info.run_name for run in tracker.experiment.search("tags.kind = 'cell'")}
    assert names == {"rec 100% e0", "rec 100% e0 (attempt 1)"}


def test_of_two_finished_attempts_the_first_counts(tracker):
    """A worker stopped beyond its time comes back and commits; the one in its place comes second."""
    planned = cells("late")
    sweep = open_sweep(tracker, planned)
    first, second = (start(tracker, sweep, planned, "late-0") for _ in range(2))
    result = make_result(planned["late-0"], "late-0")
    assert tracker.commit(first, result) == first.run_id
    assert tracker.commit(second, result) == first.run_id
    assert tracker.reader.finished(planned) == {"late-0": first.run_id}
    assert status(tracker, second.run_id) == "KILLED"


def test_a_commit_that_broke_off_is_repeated_without_doubling(tracker, network):
    planned = cells("twice")
    run = start(tracker, open_sweep(tracker, planned), planned, "twice-0")
    result = make_result(planned["twice-0"], "twice-0")
    run.log("encoder", 1, {"train/loss": 0.5})
    tracker.commit(run, result, network)
    tracker.client.update_run(run.run_id, status="RUNNING")  # as if it had been cut before the last step
    assert tracker.commit(run, result, network) == run.run_id
    assert len(children(tracker, run.run_id)) == SEEDS
    assert len(models(tracker)) == 1
    assert len(tracker.client.get_run(run.run_id).outputs.model_outputs) == 1
    for each in (run.run_id, *(seed.info.run_id for seed in children(tracker, run.run_id))):
        assert_no_point_twice(tracker, each)


def test_a_failed_cell_is_listed_with_its_reason_until_it_is_finished(tracker):
    planned = cells("fail")
    sweep = open_sweep(tracker, planned)
    run = start(tracker, sweep, planned, "fail-0")
    tracker.fail(run, "loss is nan at postgresql://me:secret@host/db\n" + "x" * 20_000)
    assert status(tracker, run.run_id) == "FAILED"
    reason = tracker.reader.read_sweep("heads").failed["fail-0"]
    assert "loss is nan" in reason
    assert "secret" not in reason
    train(tracker, sweep, planned, "fail-0")
    assert tracker.reader.read_sweep("heads").failed == {}


def test_a_cell_that_failed_for_good_is_given_up_until_it_is_tried_again(tracker):
    planned = cells("permanent")
    sweep = open_sweep(tracker, planned)
    tracker.fail(start(tracker, sweep, planned, "permanent-0"), "no room", permanent=False)
    assert tracker.reader.given_up(planned) == {}
    tracker.fail(start(tracker, sweep, planned, "permanent-0"), "loss is nan", permanent=True)
    assert tracker.reader.given_up(planned) == {"permanent-0": "loss is nan"}
    again = start(tracker, sweep, planned, "permanent-0")  # as --retry-failed does
    assert tracker.reader.given_up(planned) == {}
    tracker.interrupt(again)
    assert tracker.reader.given_up(planned) == {}


def test_uncommitted_changes_are_kept_with_the_cell_that_they_made(tracker):
    planned = cells("diff")
    run = start(tracker, open_sweep(tracker, planned), planned, "diff-0")
    result = make_result(planned["diff-0"], "diff-0")
    result.facts["provenance"] |= {"diff": "+A = 2\n", "diff_digest": "d" * 64, "seeds": {"encoder": 0}}
    tracker.commit(run, result)
    assert tracker.experiment.read_text(run.run_id, "uncommitted.diff") == "+A = 2\n"
    tags = tracker.client.get_run(run.run_id).data.tags
    assert (tags["diff_digest"], json.loads(tags["seeds"])) == ("d" * 64, {"encoder": 0})


def test_an_interrupted_cell_does_not_stay_running(tracker):
    planned = cells("stop")
    run = start(tracker, open_sweep(tracker, planned), planned, "stop-0")
    tracker.interrupt(run)
    assert status(tracker, run.run_id) == "KILLED"


# --- sweeps ---------------------------------------------------------------------------------------------------------


def test_a_sweep_is_read_back_from_the_store_alone(tracker, uri):
    planned = dict(reversed(cells("read").items()))  # the order of the plan is kept, not that of the keys
    sweep = open_sweep(tracker, planned)
    for number, key in enumerate(planned):
        train(tracker, sweep, planned, key, seed=number)
    tracker.close_sweep(sweep, "FINISHED")
    record = Tracker(uri, experiment="test_a_sweep_is_read_back_from_the_store_alone").reader.read_sweep(
        "heads", "laptop"
    )
    assert (record.grid, record.profile, record.settings) == (GRID, "laptop", SETTINGS)
    assert list(record.planned.items()) == list(planned.items())
    assert record.complete
    assert record.data == DATA
    assert record.provenance == ORIGIN
    assert list(record.table()["heads"].unique()) == ["full", "rec"]
    assert tracker.client.get_run(sweep).data.tags["cells"] == "3 of 3 finished"


def test_the_same_plan_takes_the_same_run_up_again(tracker):
    planned = cells("same")
    sweep = open_sweep(tracker, planned)
    tracker.close_sweep(sweep, "KILLED")
    assert open_sweep(tracker, planned) == sweep
    assert status(tracker, sweep) == "RUNNING"
    other = SETTINGS.model_copy(update={"policy": SETTINGS.policy.model_copy(update={"epochs": 7})})
    assert open_sweep(tracker, planned, settings=other) != sweep


def test_the_latest_opened_sweep_of_a_name_is_read(tracker):
    first, second = cells("first"), cells("second")
    open_sweep(tracker, first)
    open_sweep(tracker, second)
    assert tracker.reader.read_sweep("heads").planned == second
    open_sweep(tracker, first)
    assert tracker.reader.read_sweep("heads").planned == first
    open_sweep(tracker, second, profile="smoke")
    assert tracker.reader.read_sweep("heads", "laptop").planned == first
    assert tracker.reader.read_sweep("heads").profile == "smoke"


def test_an_earlier_sweep_of_a_name_is_read_by_its_run_id(tracker):
    first, second = cells("first"), cells("second")
    run_id = open_sweep(tracker, first)
    open_sweep(tracker, second)
    for name in (run_id, run_id[:6]):
        assert tracker.reader.read_sweep(name).planned == first
    assert tracker.reader.read_sweep("heads (laptop)").planned == second
    with pytest.raises(BadInputError, match="no sweep"):
        tracker.reader.read_sweep(run_id[:5])  # too short to be sure


def test_an_unknown_sweep_names_the_known_ones(tracker):
    open_sweep(tracker, cells("known"))
    with pytest.raises(BadInputError, match=r"no sweep 'haeds'.*heads \(laptop\)"):
        tracker.reader.read_sweep("haeds")
    with pytest.raises(BadInputError, match=r"heads \(smoke\)"):
        tracker.reader.read_sweep("heads", "smoke")


def test_cells_of_another_sweep_are_found_and_the_reuse_is_shown(tracker):
    planned = cells("reuse")
    train(tracker, open_sweep(tracker, planned), planned, "reuse-0")
    grid = Grid(name="datasize", title="Data", heads=("rec",), fractions=(1.0, 0.5), policy_seeds=SEEDS)
    wider = {"reuse-0": planned["reuse-0"], "half": Cell(heads="rec", fraction=0.5)}
    sweep = open_sweep(tracker, wider, grid=grid)
    assert tracker.client.get_run(sweep).data.tags["reused"] == "rec 100% e0 from heads (laptop)"
    record = tracker.reader.read_sweep("datasize")
    assert set(record.results) == {"reuse-0"}
    assert not record.complete


def test_a_sweep_taken_up_after_its_frames_were_deleted_keeps_their_manifest(tracker):
    planned = cells("gone")
    open_sweep(tracker, planned)
    tracker.open_sweep(GRID, "laptop", SETTINGS, planned, {}, ORIGIN)
    assert tracker.reader.read_sweep("heads").data == DATA


def test_what_a_killed_sweep_left_running_is_closed_by_the_next(tracker):
    planned, others = cells("killed"), cells("next")
    sweep = open_sweep(tracker, planned)
    run = start(tracker, sweep, planned, "killed-0")
    after = open_sweep(tracker, others)
    assert (status(tracker, sweep), status(tracker, run.run_id), status(tracker, after)) == (*["KILLED"] * 2, "RUNNING")


def test_a_sweep_that_lives_in_another_process_or_on_another_machine_is_left_alone(tracker):
    """One that goes through a server on the same file holds another lock."""
    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as other:
        now = str(time.time_ns() // 1_000_000 - 200_000)  # its clock is three minutes behind
        lives = {"one": {"host": platform.node(), "process": str(other.pid)}, "two": {"host": "far", "process": "1"}}
        runs = {}
        for name, tags in lives.items():
            planned = cells(name)
            sweep = open_sweep(tracker, planned, profile=name)
            run = start(tracker, sweep, planned, f"{name}-0").run_id
            for key, value in (tags | {"alive": now}).items():
                tracker.client.set_tag(sweep, key, value)
                tracker.client.set_tag(run, key, value)
            runs[name] = sweep, run
            assert {status(tracker, run) for pair in runs.values() for run in pair} == {"RUNNING"}
        other.communicate(b"\n")
    tracker.client.set_tag(runs["two"][1], "alive", "1000")
    open_sweep(tracker, cells("three"))
    assert {status(tracker, run) for pair in runs.values() for run in pair} == {"KILLED"}


def test_closing_a_sweep_leaves_nothing_running(tracker):
    planned = cells("close")
    sweep = open_sweep(tracker, planned)
    run = start(tracker, sweep, planned, "close-0")
    tracker.close_sweep(sweep, "KILLED")
    assert (status(tracker, run.run_id), status(tracker, sweep)) == ("KILLED", "KILLED")


def test_settings_of_any_length_are_logged(tracker):
    grid = Grid(name="long", title="t" * 9000, heads=("rec",), claims=tuple(f"H{n}" for n in range(3000)))
    sweep = open_sweep(tracker, cells("long", grid), grid=grid)
    assert len(tracker.client.get_run(sweep).data.params["claims"]) < 6000
    assert tracker.reader.read_sweep("long").grid == grid


def test_files_are_added_to_a_run(tracker, tmp_path):
    sweep = open_sweep(tracker, cells("files"))
    (tmp_path / "heads.pdf").write_bytes(b"%PDF")
    tracker.log_files(sweep, [tmp_path / "heads.pdf"], "report")
    assert [file.path for file in tracker.client.list_artifacts(sweep, "report")] == ["report/heads.pdf"]


# --- stores that cannot be used -------------------------------------------------------------------------------------


@pytest.mark.parametrize("damage", ["cut", "missing", "swapped"])
def test_a_finished_cell_without_its_complete_result_is_left_out_and_named(tracker, damage):
    planned = cells(damage)
    sweep = open_sweep(tracker, planned)
    run_id = train(tracker, sweep, planned, f"{damage}-0")
    folder = Path(tracker.client.get_run(run_id).info.artifact_uri) / "result"
    if damage == "cut":
        os.truncate(folder / "policies.safetensors", 20)
    elif damage == "missing":
        (folder / "curves.parquet").unlink()
    else:
        other = Path(tracker.client.get_run(train(tracker, sweep, planned, f"{damage}-1")).info.artifact_uri)
        shutil.copy(other / "result" / "cell.json", folder)
    with pytest.raises(UnreadableError, match=rf"{run_id}.*run the sweep again"):
        tracker.reader.load_result(run_id)
    record = tracker.reader.read_sweep("heads")
    assert f"{damage}-0" not in record.results
    assert "cannot be read" in record.failed[f"{damage}-0"]
    assert run_id in record.unread[0]


def test_a_moved_store_is_refused_until_its_old_place_is_a_link(tmp_path, empty_store):
    old, new = tmp_path / "old", tmp_path / "new place #1"
    old.mkdir()
    shutil.copy(empty_store, old)
    planned = cells("moved")
    first = Tracker(f"{SQLITE}{old}/mlflow.db")
    run_id = train(first, open_sweep(first, planned), planned, "moved-0")
    shutil.move(old, new)
    uri = f"{SQLITE}{new}/mlflow.db"
    for use in (Tracker, Reader.look):
        with pytest.raises(BadInputError, match=rf"moved or copied.*ln -s {new}/artifacts {old}/artifacts"):
            use(uri)
    old.mkdir()
    (old / "artifacts").symlink_to(new / "artifacts")
    assert_same_result(Tracker(uri).reader.load_result(run_id), make_result(planned["moved-0"], "moved-0"))


@pytest.mark.parametrize(
    ("uri", "location", "usable"),
    [
        ("postgresql://me:secret@db.far:5432/x", None, False),
        ("postgresql://me:secret@db.far/x", "/nowhere/of/the/first/machine", False),
        ("postgresql://me:secret@db.far/x", "file:///nowhere/of/the/first/machine", False),
        ("postgresql:///x?host=db.far", None, False),
        ("postgresql://db.far/x", "s3://bucket/folder", True),
        ("postgresql://db.far/x", "mlflow-artifacts:/1", True),
        ("postgresql://db.far/x", "SHARED", True),
        ("postgresql://db.far/x", "file://SHARED", True),
        ("postgresql://localhost/x", None, True),
        ("postgresql://127.0.0.1:5432/x", "/nowhere", True),
        ("postgresql:///x?host=/var/run/postgresql", None, True),
        ("http://db.far:5000", None, True),
        (f"{SQLITE}mlruns/mlflow.db", None, True),
    ],
)
def test_a_database_of_another_host_needs_a_place_for_artifacts_that_all_machines_reach(
    uri, location, usable, tmp_path
):
    location = location and location.replace("SHARED", str(tmp_path))
    if usable:
        check_place(uri, "study", location)
    else:
        with pytest.raises(BadInputError, match=r"database on db\.far.*mlflow server.*experiments create") as error:
            check_place(uri, "study", location)
        assert "secret" not in str(error.value)


@pytest.mark.parametrize("name", ['quote\'s "both"', "a?b", "50%25"])
def test_a_folder_whose_name_mlflow_would_misread_is_refused_and_nothing_is_made(name, tmp_path, monkeypatch):
    (tmp_path / name).mkdir()
    monkeypatch.chdir(tmp_path / name)
    with pytest.raises(BadInputError, match="work in a folder without"):
        Tracker(f"{SQLITE}mlruns/mlflow.db")
    assert [path.name for path in tmp_path.rglob("*")] == [name]


@pytest.mark.parametrize("name", ["with blank", "hash #1", "ünïcödé 漢字", "quote's", "plus+and&"])
def test_a_folder_of_any_other_name_holds_results(name, tmp_path, empty_store):
    (tmp_path / name).mkdir()
    shutil.copy(empty_store, tmp_path / name)
    tracker = Tracker(f"{SQLITE}{tmp_path / name}/mlflow.db")
    planned = cells("odd")
    run = train(tracker, open_sweep(tracker, planned), planned, "odd-0")
    assert tracker.reader.load_result(run).key == "odd-0"
    assert {path.name for path in tmp_path.iterdir()} == {name}


def test_artifacts_that_are_kept_elsewhere_on_purpose_stay_there(uri, tmp_path):
    Tracker(uri).client.create_experiment("elsewhere", str(tmp_path / "artifacts"))
    planned = cells("elsewhere")
    for key in planned:
        tracker = Tracker(uri, experiment="elsewhere")  # opened anew
        train(tracker, open_sweep(tracker, planned), planned, key)
    assert tracker.reader.read_sweep("heads").complete
    assert (tmp_path / "artifacts").is_dir()


def test_a_database_whose_making_was_cut_short_is_made_again(tmp_path):
    (tmp_path / ".mlflow.db.draft").mkdir()
    (tmp_path / ".mlflow.db.draft" / "mlflow.db").write_bytes(b"half")
    Tracker(f"{SQLITE}{tmp_path}/mlflow.db")
    assert not (tmp_path / ".mlflow.db.draft").exists()


def test_a_file_that_is_no_database_is_refused(tmp_path):
    (tmp_path / "mlflow.db").write_text("no database " * 100)
    with pytest.raises(BadInputError, match=r"mlflow\.db cannot be used.*--tracking"):
        Tracker(f"{SQLITE}{tmp_path}/mlflow.db")


def test_a_database_of_another_program_is_refused_and_left_as_it_was(tmp_path):
    path = tmp_path / "queue.db"
    with sqlite3.connect(path) as database:
        database.execute("CREATE TABLE trials (id INTEGER)")
    before = path.read_bytes()
    with pytest.raises(BadInputError, match="not MLflow's"):
        Tracker(f"{SQLITE}{path}")
    assert path.read_bytes() == before


@pytest.mark.parametrize("uri", ["mlruns", "file:///tmp/mlruns", "ftp://me:secret@host", "sqlite://", "sqlite:///"])
def test_a_uri_of_another_kind_is_refused(uri):
    with pytest.raises(BadInputError, match=r"cannot be used; give") as caught:
        Tracker(uri)
    assert "secret" not in str(caught.value)


@pytest.fixture
def port():
    return free_port()


def test_a_server_that_does_not_exist_is_one_quick_clear_error(port):
    started = time.monotonic()
    with pytest.raises(TrackerLostError, match=rf"http://\*\*\*@127.0.0.1:{port} does not answer") as caught:
        Tracker(f"http://me:secret@127.0.0.1:{port}")
    assert time.monotonic() - started < 5
    assert "secret" not in str(caught.value)


def test_a_server_that_never_answers_is_given_up(port, monkeypatch):
    monkeypatch.setattr("study.tracking.experiment.PROBE", 0.5)
    with socket.create_server(("127.0.0.1", port)):
        started = time.monotonic()
        with pytest.raises(TrackerLostError, match="does not answer"):
            Tracker(f"http://127.0.0.1:{port}")
        assert time.monotonic() - started < 5


def test_a_server_of_another_kind_is_one_clear_error(port, tmp_path):
    class Quiet(http.server.BaseHTTPRequestHandler):
        def do_GET(self):
            self.send_error(404)

        def log_message(self, *args):
            pass

    server = http.server.ThreadingHTTPServer(("127.0.0.1", port), Quiet)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        with pytest.raises(BadInputError, match="gave no usable answer"):
            Tracker(f"http://127.0.0.1:{port}")
    finally:
        server.shutdown()
        server.server_close()


def test_credentials_are_hidden():
    text = "at postgresql://me:p%40ss@db:5432/x and http://token@host/y, not http://host/z@1"
    assert masked(text) == "at postgresql://***@db:5432/x and http://***@host/y, not http://host/z@1"


def test_a_normal_use_prints_nothing(uri):
    code = f"from study.tracking.tracker import Tracker; print(Tracker({uri!r}).reader.finished(['x']), end='')"
    completed = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert (completed.stdout, completed.stderr) == ("{}", "")


# --- a server -------------------------------------------------------------------------------------------------------


@pytest.fixture
def tracking_server(tmp_path, empty_store):
    (tmp_path / "tracking").mkdir()
    shutil.copy(empty_store, tmp_path / "tracking")
    server = TrackingServer(tmp_path / "tracking")
    yield server
    server.stop()


@pytest.mark.stress
def test_a_server_lost_in_the_middle_is_one_clear_error_and_nothing_is_doubled_after(tracking_server, monkeypatch):
    monkeypatch.setenv("MLFLOW_HTTP_REQUEST_MAX_RETRIES", "1")
    tracker = Tracker(tracking_server.uri)
    planned = cells("server")
    sweep = open_sweep(tracker, planned)
    train(tracker, sweep, planned, "server-0")
    run = start(tracker, sweep, planned, "server-1")
    result = make_result(planned["server-1"], "server-1")
    run.log("encoder", 1, {"train/loss": 0.5})
    tracking_server.stop()
    started = time.monotonic()
    with pytest.raises(TrackerLostError, match=rf"{tracking_server.uri} gave no usable answer"):
        tracker.commit(run, result)
    tracker.interrupt(run)
    assert time.monotonic() - started < 20
    tracking_server.start()
    assert tracker.commit(run, result) == run.run_id
    assert_no_point_twice(tracker, run.run_id)
    record = tracker.reader.read_sweep("heads")
    assert set(record.results) == {"server-0", "server-1"}
    assert_same_result(record.results["server-1"], result)
