"""What cannot be read in a store is named and left out, and everything else is reported."""

import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from study.config.grid import Grid
from study.document.markdown import markdown
from study.errors import BadInputError
from study.report.__main__ import main
from study.report.build import complete_cells, publish
from study.report.model import read_report
from study.report.summary import summarise
from study.report.text import document
from study.tracking.experiment import SQLITE, UnreadableError
from study.tracking.tracker import Tracker
from tests.support.synthetic_records import World, simulate

PAIR = Grid(name="pair", title="T", heads=("rec", "full"), policy_seeds=3, baselines=())
PLAN_FILES = ("plan.json", "data.json", "provenance.json", "uncommitted.diff")


def commit(tracker, record, prefix=""):
    """Commit a record, its keys with a prefix; returns its sweep's run."""
    planned = {prefix + key[len(prefix) :]: cell for key, cell in record.planned.items()}
    run = tracker.open_sweep(record.grid, "laptop", record.settings, planned, record.data, record.provenance)
    for (key, cell), result in zip(planned.items(), record.results.values(), strict=True):
        attempt = tracker.start_cell(run, cell, key, record.settings, record.grid.policy_seeds)
        tracker.commit(attempt, replace(result, key=key))
    tracker.close_sweep(run, "FINISHED")
    return run


def artifacts(tracker, run):
    return Path(tracker.client.get_run(run).info.artifact_uri)


@pytest.fixture(scope="module")
def finished(empty_store, tmp_path_factory):
    """Return the folder of a store with a finished sweep and one that varies its split by frame."""
    folder = tmp_path_factory.mktemp("finished")
    tracker = Tracker(f"{SQLITE}{shutil.copy(empty_store, folder)}")
    record = simulate(PAIR, World(epochs=6))
    frames = record.settings.frames.model_copy(update={"split": "frame"})
    varied = simulate(
        PAIR.model_copy(update={"name": "varied"}),
        World(epochs=6),
        seed=1,
        settings=record.settings.model_copy(update={"frames": frames}),
    )
    return tracker, commit(tracker, varied, "v"), commit(tracker, record)


@pytest.fixture
def store(finished):
    """Return tracker, the varied sweep's run and the other's; what a test does to their artifacts is undone."""
    tracker, *runs = finished
    folder = artifacts(tracker, runs[0]).parent.parent
    shutil.copytree(folder, folder.with_name("kept"))
    yield finished
    shutil.rmtree(folder)
    folder.with_name("kept").rename(folder)


def test_a_sweep_to_compare_with_that_cannot_be_read_is_named_and_the_report_is_written(store, tmp_path, capsys):
    tracker, varied, _ = store
    assert set(complete_cells(tracker.reader, "pair", None).variants) == {"frames.split"}
    shutil.rmtree(artifacts(tracker, varied))
    assert publish(tracker, "pair", None, tmp_path)[1] == 0  # nothing of the sweep itself is lost
    report = read_report(tmp_path / "pair")
    assert [varied in line for line in report.unread] == [True]
    assert varied in capsys.readouterr().err
    assert report.scores
    assert "Left out, since it cannot be read" in markdown(document(report))


def test_a_result_without_which_nothing_can_be_compared_is_named(store):
    tracker, varied, _ = store
    run = next(iter(tracker.reader.finished(tracker.reader.read_sweep_run(varied).planned).values()))
    shutil.rmtree(artifacts(tracker, run) / "result")
    record = complete_cells(tracker.reader, "pair", None)
    assert record.variants == {}  # no pair of head sets is left
    assert [run in line for line in record.unread] == [True]


@pytest.mark.parametrize("content", [b"{", b"[1]", b'{"format_version": 1}', b"\xff\xfe", b"null"])
def test_a_plan_of_any_content_breaks_no_other_report(store, content):
    tracker, varied, _ = store
    (artifacts(tracker, varied) / "plan.json").write_bytes(content)
    record = complete_cells(tracker.reader, "pair", None)
    assert len(record.results) == 2
    assert record.variants == {}
    with pytest.raises(BadInputError, match=varied):
        complete_cells(tracker.reader, "varied", None)


def test_a_run_that_was_killed_before_its_plan_was_stored_leaves_the_earlier_sweep_of_its_name(store):
    tracker, _, run = store
    tags = {"kind": "sweep", "sweep": "pair", "profile": "laptop", "opened": "9" * 13}
    killed = tracker.client.create_run(tracker.experiment.id, None, tags, "pair (laptop)").info.run_id
    record = tracker.reader.read_sweep("pair")
    assert record.run_id == run
    assert [killed in line for line in record.unread] == [True]
    tracker.client.delete_run(killed)
    assert tracker.reader.read_sweep("pair").unread == ()


@pytest.mark.parametrize("name", PLAN_FILES)
def test_each_missing_file_of_the_only_sweep_is_named(store, name):
    tracker, _, run = store
    (artifacts(tracker, run) / name).unlink()
    if name in PLAN_FILES[:2]:
        with pytest.raises(UnreadableError, match=rf"{name} of run {run}.*[Rr]un the sweep again"):
            tracker.reader.read_sweep("pair")
    else:
        record = tracker.reader.read_sweep("pair")
        assert len(record.results) == 2
        assert [name in line for line in record.unread] == [True]


def test_all_that_is_missing_is_listed_at_once(store, tmp_path):
    tracker, _, run = store
    for name in PLAN_FILES:
        (artifacts(tracker, run) / name).unlink()
    with pytest.raises(UnreadableError, match=rf"{', '.join(PLAN_FILES)} of run {run}"):
        tracker.reader.read_sweep("pair")
    result = simulate(PAIR, World(epochs=6)).results.popitem()[1]
    folder = result.save(tmp_path / "result")
    for name in ("curves.parquet", "encoder.safetensors"):
        (folder / name).unlink()
    with pytest.raises(BadInputError, match=r"curves\.parquet, encoder\.safetensors missing"):
        result.load(folder)


def test_a_cell_whose_result_is_gone_is_named_and_the_others_are_reported(store):
    tracker, _, _ = store
    key, gone = next(iter(tracker.reader.read_sweep("pair").planned.items()))
    cell_run = tracker.reader.finished([key])[key]
    shutil.rmtree(artifacts(tracker, cell_run))
    report = summarise(complete_cells(tracker.reader, "pair", None))
    assert [failure.cell for failure in report.sweep.failed] == [gone.label]
    assert [cell_run in line for line in report.unread] == [True]
    assert len(report.scores) == 1


@pytest.mark.parametrize("words", [["pair"], ["pair", "--format", "md"], ["compare", "pair", "pair"]])
def test_the_exit_code_is_1_when_a_finished_result_cannot_be_read_and_its_cell_is_named(
    store, words, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    tracker, _, _ = store
    uri = tracker.experiment.uri
    key, gone = next(iter(tracker.reader.read_sweep("pair").planned.items()))
    cell_run = tracker.reader.finished([key])[key]
    assert main([*words, "--tracking", uri]) == 0
    assert "left out" not in capsys.readouterr().err
    shutil.rmtree(artifacts(tracker, cell_run))
    assert main([*words, "--tracking", uri]) == 1
    assert f"left out of the report: {gone.label}: cell run {cell_run}" in capsys.readouterr().err


def test_a_sweep_whose_plan_is_removed_meanwhile_can_be_closed(store):
    tracker, varied, _ = store
    shutil.rmtree(artifacts(tracker, varied))
    tracker.close_sweep(varied, "FINISHED")


def test_a_sweep_of_which_every_cell_has_failed_has_a_report_with_the_reasons(store, tmp_path):
    tracker, _, _ = store
    record = simulate(PAIR.model_copy(update={"name": "doomed"}), World(epochs=6))
    planned = {f"d{key[1:]}": cell for key, cell in record.planned.items()}
    run = tracker.open_sweep(record.grid, "laptop", record.settings, planned, record.data, record.provenance)
    for key, cell in planned.items():
        attempt = tracker.start_cell(run, cell, key, record.settings, 3)
        tracker.fail(attempt, "the loss of epoch 3 is nan", permanent=True)
    tracker.close_sweep(run, "FAILED")
    assert publish(tracker, "doomed", None, tmp_path)[0].read_bytes().startswith(b"%PDF")
    failed = read_report(tmp_path / "doomed").sweep.failed
    assert [failure.reason for failure in failed] == ["the loss of epoch 3 is nan"] * 2
