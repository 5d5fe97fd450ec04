"""Workers with their own working folders, as on separate machines, share one sweep through PostgreSQL and MLflow."""

import signal
import sys
from collections import Counter

import pytest

from running import ONE_THREAD, Running, working_folder
from study.config import BadInputError
from study.sweep import main as sweep
from study.tracking import Tracker
from study.worker import main

HEADS = ("rec", "rec+plan", "full")
PLAN = [*ONE_THREAD, "--heads", f"[{','.join(HEADS)}]"]
CELLS = 4  # three head sets and the ceiling


@pytest.fixture
def home(tmp_path, monkeypatch):
    monkeypatch.chdir(working_folder(tmp_path))


@pytest.mark.parametrize(
    ("words", "wrong"),
    [
        ([], "shared queue"),
        (["--queue", "postgresql://me:secret@host/db"], "--tracking http://host:port"),
        (["--queue", "postgresql://me:secret@host/db", "--workers", "0"], "1 or more"),
        (["--queue", "postgresql://me:secret@host/db", "--grace", "0"], "2 s or more"),
        (["--queue", "mysql://me:secret@host/db"], "postgresql://user@host/database"),
    ],
)
def test_what_a_worker_cannot_use_is_told_without_credentials(home, words, wrong):
    with pytest.raises(BadInputError, match=wrong) as caught:
        main([*PLAN, *words])
    assert "secret" not in str(caught.value)


def test_a_sweep_without_workers_needs_a_shared_queue(home):
    with pytest.raises(BadInputError, match="--workers is 0"):
        sweep([*PLAN, "--workers", "0"])


def test_a_queue_in_the_environment_is_used(home, monkeypatch):
    monkeypatch.setenv("STUDY_QUEUE", "postgresql://me:secret@host/db")
    with pytest.raises(BadInputError, match="--tracking http://host:port") as caught:
        main(PLAN)
    assert "secret" not in str(caught.value)


@pytest.mark.slow
def test_three_workers_one_of_them_killed_give_the_table_of_one_machine(quiet, postgres, tracking_server, tmp_path):
    killed, second, lead = (quiet.copy(tmp_path / name) for name in ("killed", "second", "lead"))
    third = working_folder(tmp_path / "third")  # makes its own frames

    words = (*PLAN, "--tracking", tracking_server.uri, "--grace", "6")
    queue = {"STUDY_QUEUE": postgres.uri()}

    def start(module, folder, *more):
        return Running(folder, sys.executable, "-m", module, *words, *more, **queue)

    victim = start("study.worker", killed)
    assert victim.until(lambda: "starting" in victim.said), victim.said
    victim.send(signal.SIGSTOP, victim.process.pid)  # so that cells are left for the others, however fast it is
    others = [start("study.worker", second), start("study.worker", third)]
    others.append(start("study.sweep", lead, "--workers", "0"))
    assert others[0].until(lambda: "starting" in others[0].said), others[0].said
    victim.send(signal.SIGKILL, victim.process.pid)
    victim.end()
    for run in others:
        assert run.end() == 0, run.said

    tracker = Tracker(tracking_server.uri)
    record = tracker.read_sweep("heads")
    assert record.complete
    alone = Tracker(f"sqlite:///{quiet.folder}/mlruns/mlflow.db").read_sweep("heads").table()
    expected = alone[alone["heads"].isin(HEADS)].reset_index(drop=True)
    assert record.table().reset_index(drop=True).equals(expected)
    statuses = [attempt.status for tries in tracker.attempts(list(record.planned)).values() for attempt in tries]
    assert Counter(status for status in statuses if status != "KILLED") == {"FINISHED": CELLS}
    assert (lead / "reports/heads.pdf").is_file()
    assert "there already" in others[0].said
    assert "made here from their key" in others[1].said
    for folder in (second, third):  # one that came too late for a cell has no such folders
        assert [*folder.glob("data/cells/*"), *folder.glob("data/tmp/*")] == []
    for path in tmp_path.rglob("*"):
        assert not path.is_file() or postgres.password.encode() not in path.read_bytes(), path
