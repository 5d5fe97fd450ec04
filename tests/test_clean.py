"""Sweeps and cached data are deleted for good, and nothing that others use."""

import hashlib
import os
import re
import shutil
import signal
import sqlite3
import subprocess
import sys
import time
from contextlib import closing, suppress
from dataclasses import replace
from pathlib import Path

import optuna
import pytest

from study.config.keys import drive_key, encoder_key, recording_key
from study.config.workspace import Workspace
from study.data.in_use import shared_use
from study.engine.trials import Trials
from study.errors import BadInputError
from study.report.build import publish
from study.stages import size_text
from study.sweep import cached_data
from study.sweep.__main__ import main
from study.sweep.clean import Choice, clean
from study.sweep.locks import hold_store
from study.sweep.status import cell_statuses
from study.tracking.cleaning import Deletion
from study.tracking.experiment import SQLITE
from study.tracking.tracker import Tracker
from tests.support.plans import plan_of
from tests.support.processes import PATIENCE, sweep
from tests.support.run_database import RunDatabase
from tests.support.sweeps import TINY_SWEEP, working_folder
from tests.support.synthetic_records import World, simulate

SMALL = ("--policy_seeds", "2", "--baselines", "[]")
HEADS = ("heads", "--heads", "[rec,full]", *SMALL)
ENCODERS = ("heads-encoders", "--heads", "[rec]", "--encoder_seeds", "2", *SMALL)
TABLES = ("runs", "tags", "params", "metrics", "latest_metrics")


class Store:
    """A store and a data folder with two finished sweeps, of which `encoders` uses a cell that `heads` has trained."""

    def __init__(self, folder, empty_store):
        self.folder, self.workspace = folder, Workspace(folder / "data", folder / "mlruns", folder / "reports")
        self.workspace.mlruns.mkdir()
        shutil.copy(empty_store, self.workspace.mlruns / "mlflow.db")
        self.uri = f"{SQLITE}{folder}/mlruns/mlflow.db"
        self.database = RunDatabase(self.workspace.mlruns / "mlflow.db")
        self.tracker = Tracker(self.uri)
        self.heads, self.encoders = plan_of(HEADS), plan_of(ENCODERS)
        self.runs = {}
        for plan in (self.heads, self.encoders):
            self.finish(plan)
        self.drop(f"products/encoder-{16 * 'a'}")

    def finish(self, plan):
        """Run a sweep, with drawn results and the files that a real one leaves in the cache."""
        tracker, optuna_file = self.tracker, self.workspace.mlruns / "optuna.db"
        record = simulate(plan.grid, World(epochs=3))
        run = tracker.open_sweep(plan.grid, plan.profile, plan.settings, plan.cells, {"key": plan.frames.name}, {})
        done = tracker.reader.finished(list(plan.cells))
        for (key, cell), result in zip(plan.cells.items(), record.results.values(), strict=True):
            self.drop(f"products/encoder-{encoder_key(plan.settings, cell, plan.frames.name)}")
            if key not in done:
                cell_run = tracker.start_cell(run, cell, key, plan.settings, plan.grid.policy_seeds)
                tracker.commit(cell_run, replace(result, key=key), b"network")
        tracker.close_sweep(run, "FINISHED")
        Trials(optuna_file, plan.study_name, {key: cell.label for key, cell in plan.cells.items()}, [])
        self.drop(f"episodes/{recording_key(plan.settings)}/00000001")
        self.drop(f"frames/{plan.frames.name}")
        self.drop(f"products/drive-{drive_key(plan.settings)}-0")
        self.runs[plan.grid.name] = run

    def drop(self, name):
        file = self.workspace.data / name / "content"
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(b"x" * 9000)

    def clean(self, *names, show_only=False, **choice):
        return clean(
            Choice(names, **choice), self.uri, show_only=show_only, yes=True, wait=False, workspace=self.workspace
        )

    def content(self):
        return {
            path.relative_to(self.folder): hashlib.sha256(path.read_bytes()).hexdigest()
            for path in self.folder.rglob("*")
            if path.is_file()
        }

    def products(self):
        return {path.name for path in (self.workspace.data / "products").iterdir()}

    def encoder(self, plan, number):
        return f"encoder-{encoder_key(plan.settings, list(plan.cells.values())[number], plan.frames.name)}"

    def assert_heads_is_gone(self):
        """Fail unless rows, files and trials of `heads` are gone, and everything of `heads-encoders` is there."""
        planned = self.encoders.cells
        reader = self.tracker.reader
        assert reader.read_sweep("heads-encoders").complete
        with pytest.raises(BadInputError, match="no sweep 'heads'"):
            reader.read_sweep("heads")
        left = {run for (run,) in self.database.query("select run_uuid from runs")}
        assert len(left) == 1 + len(planned) * (1 + 2)
        for table in TABLES:
            assert {run for (run,) in self.database.query(f"select run_uuid from {table}")} <= left, table  # noqa: S608 - of TABLES
        models = self.database.query("select model_id, source_run_id from logged_models")
        assert len(models) == len(planned)
        assert {run for _, run in models} <= left
        artifacts = self.workspace.mlruns / "artifacts"
        assert {path.name for path in artifacts.iterdir()} <= left | {"models"}
        assert {path.name for path in (artifacts / "models").iterdir()} == {model for model, _ in models}
        storage = f"sqlite:///{self.workspace.mlruns}/optuna.db"
        assert optuna.get_all_study_names(storage) == [self.encoders.study_name]
        states = cell_statuses(self.encoders, reader.attempts(planned), time.time())
        assert {state.state for state in states} == {"finished"}


@pytest.fixture
def store(tmp_path, empty_store):
    """Return a store to delete in."""
    return Store(tmp_path, empty_store)


@pytest.fixture(scope="module")
def whole(tmp_path_factory, empty_store):
    """Return a store in which nothing is deleted."""
    return Store(tmp_path_factory.mktemp("whole"), empty_store)


def test_the_list_shows_sweeps_and_cache_and_writes_nothing(whole, capsys):
    before = whole.content()
    assert whole.clean() == 0
    lines = capsys.readouterr().out.splitlines()
    assert whole.content() == before
    assert [line.split()[:3] for line in lines[1:3]] == [
        ["heads", "(laptop)", whole.runs["heads"][:8]],
        ["heads-encoders", "(laptop)", whole.runs["heads-encoders"][:8]],
    ]
    assert all("finished" in line and "2 of 2 cells" in line for line in lines[1:3])
    users = {re.split(" {2,}", line.strip())[-1] for line in lines[4:]}
    both = "heads (laptop), heads-encoders (laptop)"
    assert users == {both, "heads (laptop)", "heads-encoders (laptop)", "used by none"}


def test_a_cleaned_sweep_is_gone_but_for_what_others_use(store, capsys):
    shared = next(iter(store.encoders.cells))
    assert shared in store.heads.cells
    before = store.content()
    assert store.clean("heads", show_only=True) == 0
    shown = capsys.readouterr().out
    assert store.content() == before
    assert "kept, since heads-encoders (laptop) uses them: rec 100% e0" in shown
    used = store.products()
    assert store.clean("heads") == 0
    store.assert_heads_is_gone()
    assert used - store.products() == {store.encoder(store.heads, 1)}
    assert (store.workspace.data / "frames" / store.heads.frames.name).is_dir()
    run = store.tracker.client.get_run(store.tracker.reader.finished([shared])[shared])
    assert run.data.tags["mlflow.parentRunId"] == store.runs["heads-encoders"]
    assert run.data.tags["sweep"] == "heads-encoders (laptop)"
    pdf, code = publish(store.tracker, "heads-encoders", "laptop", store.workspace.reports)
    assert pdf.is_file()
    assert code == 0
    store.finish(store.heads)  # a new sweep trains what is missing
    assert store.tracker.reader.read_sweep("heads").complete


def test_everything_can_go_and_frees_what_was_said(store, capsys):
    def taken():
        folders = store.workspace.mlruns / "artifacts", store.workspace.data
        return sum(path.lstat().st_blocks * 512 for each in folders for path in each.rglob("*") if path.is_file())

    before = taken()
    store.clean("heads", "heads-encoders", show_only=True)
    (said,) = re.findall(r"^frees (.*), and what the database holds", capsys.readouterr().out, re.MULTILINE)
    assert store.clean("heads", "heads-encoders") == 0
    assert said == size_text(before - taken())
    for table in (*TABLES, "logged_models"):
        assert store.database.query(f"select * from {table}") == []  # noqa: S608 - of TABLES
    assert store.products() == {f"encoder-{16 * 'a'}"}
    assert list((store.workspace.data / "frames").iterdir()) == []


@pytest.mark.stress
@pytest.mark.parametrize("interrupted", ["while the cache goes", "when the sweep is marked"])
def test_a_cleaning_that_was_cut_short_is_finished_by_the_next(store, interrupted, monkeypatch):
    place = (cached_data, "_delete") if interrupted == "while the cache goes" else (Deletion, "_collect")
    calls, whole = [], getattr(*place)

    def stop(*values):
        calls.append(1)
        if len(calls) == 2:
            raise KeyboardInterrupt
        whole(*values)

    with monkeypatch.context() as context, suppress(KeyboardInterrupt):
        context.setattr(*place, stop)
        store.clean("heads")
    assert len(calls) == 2
    assert store.clean("heads") == 0
    store.assert_heads_is_gone()
    assert store.encoder(store.heads, 1) not in store.products()
    assert not [name for name in store.products() if name.endswith(".removed")]


@pytest.mark.stress
def test_a_cleaning_that_was_killed_is_finished_by_the_next(store):
    words = ["clean", "heads", "--yes", "--tracking", store.uri]
    process = subprocess.Popen([sys.executable, "-m", "study.sweep", *words], cwd=store.folder, start_new_session=True)
    deadline = time.monotonic() + PATIENCE
    marked = "select * from runs where lifecycle_stage = 'deleted'"
    while not store.database.query(marked):  # seconds before `mlflow gc` has started, and removes them
        assert process.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.01)
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    assert store.database.query(marked)
    done = sweep(store.folder, *words)
    assert done.returncode == 0, done.stderr
    store.assert_heads_is_gone()


def test_unused_data_goes_on_request_alone(store, capsys):
    (store.workspace.data / "products/mine").mkdir()
    (store.folder / "elsewhere").mkdir()
    link = store.workspace.data / f"frames/{16 * 'b'}"
    link.symlink_to(store.folder / "elsewhere")
    before = store.products()
    assert store.clean(unused=True) == 0
    assert before - store.products() == {f"encoder-{16 * 'a'}"}
    assert (link / ".").is_dir()
    assert store.clean(unused=True) == 0
    assert capsys.readouterr().out.endswith("nothing to delete\n")


def test_sweeps_are_chosen_by_age_profile_and_run(whole, capsys):
    whole.tracker.client.set_tag(whole.runs["heads"], "opened", str(int((time.time() - 40 * 86400) * 1000)))

    def chosen(*names, **choice):
        whole.clean(*names, show_only=True, **choice)
        return [line.split()[0] for line in capsys.readouterr().out.splitlines() if "cells" in line]

    assert chosen(older_than=30) == ["heads"]
    assert chosen("heads-encoders", older_than=30) == []
    assert chosen(older_than=0) == ["heads", "heads-encoders"]
    assert chosen(whole.runs["heads-encoders"][:8]) == ["heads-encoders"]
    assert chosen("heads", profile="smoke") == []


def refused(store, match, *names, **choice):
    before = store.content()
    with pytest.raises(BadInputError, match=match):
        store.clean(*names, **choice)
    changed = {name for name in before if store.content().get(name) != before[name]}
    assert changed <= {Path("mlruns/sweep.json")}


def test_nothing_is_deleted_while_a_sweep_runs_on_the_store_or_in_the_folder(whole):
    with hold_store(whole.workspace, whole.uri, "sweep, heads", wait=False):
        refused(whole, rf"another sweep, heads \(process {os.getpid()}\), runs on this store", "heads-encoders")
    with shared_use(whole.workspace.data), shared_use(whole.workspace.data):
        refused(whole, "another command uses .*data", unused=True)
    # One that goes through a server on the same file holds another lock.
    whole.tracker.client.update_run(whole.runs["heads"], status="RUNNING")
    whole.tracker.client.set_tag(whole.runs["heads"], "process", "1")
    refused(whole, r"heads \(laptop\) runs now \(process 1 on .*\); stop it", "heads")
    refused(whole, r"heads \(laptop\) runs now", older_than=0)
    whole.tracker.client.set_terminated(whole.runs["heads"])


def test_deleted_experiments_of_others_are_not_removed_with_it(whole):
    other = whole.tracker.client.create_experiment("other")
    whole.tracker.client.delete_experiment(other)
    refused(whole, "experiment 'other' in .* is deleted, and mlflow gc", "heads")
    whole.tracker.client.restore_experiment(other)


def test_a_plan_that_cannot_be_read_protects_what_it_may_use(whole):
    folder = whole.workspace.mlruns / "artifacts" / whole.runs["heads-encoders"]
    folder.rename(whole.folder / "away")
    refused(whole, "plan.json of heads-encoders .* cannot be read", "heads")
    (whole.folder / "away").rename(folder)


def test_names_and_answers_are_checked(whole, tmp_path):
    refused(whole, "no sweep 'haeds' in this store; there are: heads, heads-encoders", "haeds")
    for words in ("heads",), ("--unused",):
        with pytest.raises(BadInputError, match="this is not a terminal, so nobody can confirm; look with --dry-run"):
            main(["clean", *words, "--tracking", whole.uri])
    with pytest.raises(BadInputError, match="no sweep 'heads' in this store; there are: none"):
        main(["clean", "heads", "--dry-run", "--tracking", f"{SQLITE}{tmp_path}/none.db"])


def test_what_lies_elsewhere_is_never_deleted(whole):
    mine = whole.folder / "mine" / "artifacts"
    mine.mkdir(parents=True)
    (mine / "thesis").touch()
    run = whole.tracker.reader.finished(list(whole.heads.cells))[list(whole.heads.cells)[1]]
    with closing(sqlite3.connect(whole.database.database)) as database:
        database.execute("update runs set artifact_uri = ? where run_uuid = ?", (str(mine), run))
        database.commit()
    refused(whole, "which is not its folder in", "heads")


@pytest.mark.stress
def test_after_a_cleaning_all_commands_work_on_the_rest(tmp_path):
    folder = working_folder(tmp_path)
    first = (*TINY_SWEEP, "--baselines", "[]", "--heads", "[rec,full]")
    second = ("heads-encoders", *TINY_SWEEP[1:], "--baselines", "[]", "--heads", "[rec]", "--encoder_seeds", "2")
    for words in (
        first,
        second,
        ("clean", "heads", "--yes"),
        ("status", *second),
        ("verify", *second, "--cell", "rec 100% e0"),
        first,
        ("clean", "--older-than", "0", "--unused", "--yes"),
        first,
    ):
        done = sweep(folder, *words)
        assert done.returncode == 0, f"{words}: {done.stdout}{done.stderr}"
        assert "Traceback" not in done.stderr
    report = [sys.executable, "-m", "study.report", "heads"]
    assert subprocess.run(report, cwd=folder, check=False).returncode == 0
