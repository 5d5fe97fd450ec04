"""The stage that drives: what a finished sweep has of it, resuming, and cells that cannot."""

import dataclasses
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from study.cell.driving import drive_expert, drive_policies
from study.cell.flow import drive_flow, driven_folders, expert_flow
from study.cell.job import CellJob
from study.config.keys import drive_key
from study.config.settings import StudySettings
from study.driving.drives import planned_drives
from study.engine.flows import run_flow
from study.planning.plan import Plan, cell_jobs, make_plan
from study.results.cell_result import CellResult
from study.results.drives import EXPERT, WAY, means
from study.stages import Flow
from study.tracking.driven import commit_drives
from study.tracking.reader import Reader
from study.tracking.tracker import Tracker
from tests.support.sweeps import FOUR_CELLS, UndisturbedSweep, sweep_here


@pytest.fixture(scope="module")
def reader(undisturbed: UndisturbedSweep) -> Reader:
    return Reader.look(f"sqlite:///{undisturbed.folder}/mlruns/mlflow.db")


@pytest.fixture(scope="module")
def plan(undisturbed: UndisturbedSweep) -> Plan:
    workspace = dataclasses.replace(make_plan("heads", "smoke", {}, {}).workspace)
    folder = undisturbed.folder
    here = dataclasses.replace(
        workspace, data=folder / "data", mlruns=folder / "mlruns", reports=folder / "reports", sweeps=folder / "sweeps"
    )
    return make_plan("heads", "tiny", {}, {"policy_seeds": 2, "baselines": []}, workspace=here)


@pytest.fixture(scope="module")
def key(plan: Plan) -> str:
    return next(iter(plan.cells))


@pytest.fixture(scope="module")
def result(plan: Plan, reader: Reader, key: str) -> CellResult:
    return reader.load_result(reader.finished([key])[key])


def job_of(plan: Plan, key: str, scratch: Path) -> CellJob:
    return dataclasses.replace(cell_jobs(plan, "cpu", 1)[key], scratch=scratch)


def drive(settings: StudySettings, job: CellJob, result: CellResult) -> Flow[pd.DataFrame]:
    drives = planned_drives(settings)
    expert = yield from expert_flow(settings, drives, job.products)
    table, films = yield from drive_flow(job, result, drives, expert)
    assert films.keys() == {"best.gif", "median.gif", "worst.gif"}
    assert all(content.startswith(b"GIF8") for content in films.values())
    return table


def test_every_policy_and_the_expert_drive_every_drive(plan: Plan, reader: Reader) -> None:
    driven = reader.driven(plan.settings, list(plan.cells))
    assert driven.keys() == plan.cells.keys()
    seeds = {drive.seed for _, drive in planned_drives(plan.settings)}
    experts = []
    for run in driven.values():
        table = reader.load_drives(run)
        assert set(table["policy_seed"]) == {EXPERT, 0, 1}
        assert all(set(rows["drive"]) == seeds for _, rows in table.groupby("policy_seed"))
        assert len(table) == 3 * len(seeds)
        assert table["route_completion"].between(0, 1).all()
        experts.append(table[table["policy_seed"] == EXPERT])
    for expert in experts:
        assert (expert["driving_score"] == 100).all()
        pd.testing.assert_frame_equal(expert, experts[0])


def test_runs_of_cells_and_policies_hold_the_means(plan: Plan, reader: Reader, key: str) -> None:
    run = reader.finished_runs([key])[key]
    scores = means(reader.load_drives(run.info.run_id), "town")
    metrics = run.data.metrics
    assert metrics["drive/driving_score"] == pytest.approx(scores["driving_score"].mean(), rel=1e-5)
    assert metrics["drive/driving_score/sd"] == pytest.approx(scores["driving_score"].std(), rel=1e-4)
    children = reader.experiment.search(f"tags.`mlflow.parentRunId` = '{run.info.run_id}'")
    assert len(children) == 2
    for child in children:
        expected = scores.loc[int(child.data.tags["policy_seed"]), "driving_score"]
        assert child.data.metrics["drive/driving_score"] == pytest.approx(expected, rel=1e-5)


def test_driving_again_gives_the_same_bits_and_takes_up_what_is_there(
    plan: Plan, reader: Reader, result: CellResult, key: str, tmp_path: Path
) -> None:
    job = job_of(plan, key, tmp_path)
    again = run_flow(drive(plan.settings, job, result))
    pd.testing.assert_frame_equal(again, reader.load_drives(reader.finished([key])[key]), check_exact=True)
    folders = driven_folders(job)
    assert folders
    times = {path: path.stat().st_mtime_ns for folder in folders for path in folder.iterdir()}
    pd.testing.assert_frame_equal(run_flow(drive(plan.settings, job, result)), again, check_exact=True)
    assert times == {path: path.stat().st_mtime_ns for folder in folders for path in folder.iterdir()}


def test_a_share_that_is_damaged_is_driven_again(plan: Plan, result: CellResult, key: str, tmp_path: Path) -> None:
    job = job_of(plan, key, tmp_path)
    first = run_flow(drive(plan.settings, job, result))
    (driven_folders(job)[0] / "curves.parquet").write_bytes(b"no table")
    pd.testing.assert_frame_equal(run_flow(drive(plan.settings, job, result)), first, check_exact=True)


def test_a_policy_of_nan_ends_its_drives_as_failures_and_the_others_drive_on(
    plan: Plan, result: CellResult, key: str, tmp_path: Path
) -> None:
    weights = {name: value.copy() for name, value in result.policies.items()}
    weights["steering_2_bias"][1] = np.nan
    drives = planned_drives(plan.settings)
    ways = drive_expert(plan.settings, drives).curves.set_index("drive")[WAY].to_dict()
    spoiled = dataclasses.replace(result, policies=weights)
    table = drive_policies(job_of(plan, key, tmp_path), spoiled, drives, ways, lambda *_: None).curves
    assert (table[table["policy_seed"] == 1]["ended"] == "failure").all()
    assert table[table["policy_seed"] == 1]["reason"].str.contains("steering nan").all()
    assert (table[table["policy_seed"] == 0]["ended"] != "failure").all()


def test_the_key_holds_what_changes_a_drive_and_nothing_else() -> None:
    settings = StudySettings()
    base = drive_key(settings, "cell")
    for group, name, value in (("driving", "crop", 0.25), ("driving", "drives", 3), ("town", "vehicles", 9)):
        part = getattr(settings, group).model_copy(update={name: value})
        changed = settings.model_copy(update={group: part})
        assert drive_key(changed, "cell") != base
        assert (drive_key(changed) == drive_key(settings)) == (name == "crop")
    assert drive_key(settings, "another") != base
    frames = settings.frames.model_copy(update={"policy": 99})
    assert drive_key(settings.model_copy(update={"frames": frames}), "cell") == base


def test_without_a_town_or_told_not_to_nobody_drives(plan: Plan) -> None:
    assert plan.drivers == list(plan.cells)
    grid = plan.grid.model_copy(update={"drive": False})
    assert dataclasses.replace(plan, grid=grid).drivers == []


def test_committing_twice_doubles_nothing(plan: Plan, reader: Reader, key: str, undisturbed: UndisturbedSweep) -> None:
    run = reader.finished([key])[key]
    table = reader.load_drives(run)
    tracker = Tracker(f"sqlite:///{undisturbed.folder}/mlruns/mlflow.db")
    before = tracker.client.get_metric_history(run, "drive/driving_score")
    commit_drives(tracker, run, drive_key(plan.settings, key), table, {})
    assert tracker.client.get_metric_history(run, "drive/driving_score") == before


def test_a_finished_sweep_drives_when_it_is_told_to(
    undisturbed: UndisturbedSweep, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = undisturbed.copy(tmp_path / "work")
    words = (*FOUR_CELLS, "--heads", "rec", "--no-report")
    assert sweep_here(folder, monkeypatch, *words, "--drive", "false") == 0
    assert "driving" not in capsys.readouterr().err
    assert sweep_here(folder, monkeypatch, *words, "--dry-run") == 0
    assert "1 of 1 cells to drive" in capsys.readouterr().out
    assert sweep_here(folder, monkeypatch, *words) == 0
    told = capsys.readouterr().err
    assert "encoder" not in told
    assert "driving: 0 of 1 cells" in told
    assert sweep_here(folder, monkeypatch, "status", *FOUR_CELLS, "--heads", "rec") == 0
    status = capsys.readouterr().out
    assert "1 of 1 cells finished" in status
    assert "have driven" not in status
