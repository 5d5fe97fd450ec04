"""Optuna says which cell is next: each of the plan's once and in order, whatever an earlier process has left."""

import signal
import subprocess
import sys
from collections import Counter

import optuna
import pytest

from study.engine.trials import PARAMETER, Trials
from study.errors import BadInputError

LABELS = {"k1": "rec 100% e0", "k2": "full 100% e0", "k3": "full 100% e1"}
STUDY = "heads laptop 0123"


@pytest.fixture
def file(tmp_path):
    return tmp_path / "store" / "optuna.db"


def start(file, order=tuple(LABELS), labels=LABELS):
    return Trials(file, STUDY, labels, order)


def listed(file):
    """Return all trials that Optuna knows."""
    return optuna.load_study(study_name=STUDY, storage=f"sqlite:///{file}").get_trials()


def states(file):
    return Counter(trial.state.name for trial in listed(file))


def drain(trials):
    keys = []
    while (key := trials.ask()) is not None:
        keys.append(key)
        trials.finish(key, 0.5)
    return keys


@pytest.mark.parametrize("order", [("k1", "k2", "k3"), ("k3", "k1", "k2"), ("k2",)])
def test_cells_come_in_the_given_order_each_once(file, order):
    assert drain(start(file, order)) == list(order)
    assert states(file) == {"COMPLETE": len(order)}


def test_several_cells_may_be_open_at_a_time(file):
    trials = start(file)
    assert [trials.ask() for _ in range(4)] == ["k1", "k2", "k3", None]
    trials.finish("k2", 0.25)
    trials.fail("k1", "loss is nan at postgresql://me:secret@host/db")
    trials.finish("k3", 0.75)
    assert {trial.params[PARAMETER]: (trial.state.name, trial.value) for trial in listed(file)} == {
        "rec 100% e0 k1": ("FAIL", None),
        "full 100% e0 k2": ("COMPLETE", 0.25),
        "full 100% e1 k3": ("COMPLETE", 0.75),
    }
    (failed,) = (trial for trial in listed(file) if trial.state.name == "FAIL")
    assert failed.user_attrs["reason"] == "loss is nan at postgresql://***@host/db"


def test_where_nothing_is_left_nothing_is_made_up(file):
    trials = start(file, order=())
    assert [trials.ask(), trials.ask()] == [None, None]
    assert listed(file) == []
    trials = start(file, ["k1"])
    assert drain(trials) == ["k1"]
    assert trials.ask() is None
    assert states(file) == {"COMPLETE": 1}


KILLED = """
import os, signal, sys
from pathlib import Path
from study.engine.trials import Trials
trials = Trials(Path(sys.argv[1]), sys.argv[2], {"k1": "rec 100% e0", "k2": "full 100% e0", "k3": "full 100% e1"},
                ["k1", "k2", "k3"])
assert trials.ask() == "k1"
os.kill(os.getpid(), signal.SIGKILL)
"""


def test_what_a_killed_process_left_is_closed_by_the_next(file):
    completed = subprocess.run([sys.executable, "-c", KILLED, file, STUDY], check=False)
    assert completed.returncode == -signal.SIGKILL
    assert states(file) == {"RUNNING": 1, "WAITING": 2}
    trials = start(file, ["k3", "k1"])
    assert states(file) == {"FAIL": 1, "PRUNED": 2, "WAITING": 2}
    assert drain(trials) == ["k3", "k1"]
    assert states(file) == {"FAIL": 1, "PRUNED": 2, "COMPLETE": 2}


def test_a_stop_leaves_nothing_open_and_the_next_start_goes_on(file):
    trials = start(file)
    trials.finish(trials.ask(), 0.5)
    trials.ask()
    trials.stop()
    assert states(file) == {"COMPLETE": 1, "FAIL": 1, "PRUNED": 1}
    assert drain(start(file, ["k2", "k3"])) == ["k2", "k3"]


def test_two_plans_in_one_file_leave_each_other_alone(file):
    first = start(file)
    other = Trials(file, "datasize laptop 4567", {"k9": "rec 50% e0"}, ["k9"])
    assert first.ask() == "k1"
    assert other.ask() == "k9"
    other.stop()
    assert states(file) == {"RUNNING": 1, "WAITING": 2}


def test_a_file_that_is_no_database_is_one_clear_error_and_stays_as_it_is(file):
    file.parent.mkdir()
    file.write_text("no database " * 100)
    with pytest.raises(BadInputError, match=r"optuna\.db, where Optuna keeps .* cannot be used: .*not a database"):
        start(file)
    assert file.read_text() == "no database " * 100


def test_a_folder_that_cannot_be_made_is_one_clear_error(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(BadInputError, match=r"cannot be used: .*move the file away"):
        start(tmp_path / "file" / "optuna.db")


def test_a_file_that_is_damaged_meanwhile_is_one_clear_error(file):
    trials = start(file)
    file.write_bytes(b"no database " * 10_000)
    for action in (trials.ask, trials.stop):
        with pytest.raises(BadInputError, match="cannot be used"):
            action()
