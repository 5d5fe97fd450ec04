"""Workers with their own working folders, as on separate machines, share one sweep through PostgreSQL and MLflow."""

import os
import shutil
import signal
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest

from study.config import BadInputError
from study.sweep import main as sweep
from study.tracking import Tracker
from study.worker import main

ROOT = Path(__file__).parent.parent
PLAN = [
    *("heads", "--profile", "smoke", "--heads", "[rec,rec+plan,full]", "--policy_seeds", "2"),
    *("--recording.encoder_episodes", "2", "--recording.policy_episodes", "2"),
    *("--frames.encoder", "40", "--frames.policy", "40"),
    *("--encoder.batch", "16", "--policy.batch", "16", "--policy.epochs", "5"),
]
CELLS = 4  # three head sets and the ceiling


def start(module, folder, *words, **environment):
    """The command in a working folder, its output in `folder`/log."""
    if not (folder / "sweeps").exists():
        shutil.copytree(ROOT / "sweeps", folder / "sweeps")
    with (folder / "log").open("w") as log:
        return subprocess.Popen(
            [sys.executable, "-m", module, *PLAN, *words],
            cwd=folder,
            env=os.environ | {"PYTHONPATH": str(ROOT)} | environment,
            stdout=log,
            stderr=log,
        )


def said(folder):
    return (folder / "log").read_text()


def wait_for(folder, words, process):
    while words not in said(folder):
        assert process.poll() is None, said(folder)
        try:
            process.wait(0.1)
        except subprocess.TimeoutExpired:
            continue


@pytest.fixture
def home(tmp_path, monkeypatch):
    shutil.copytree(ROOT / "sweeps", tmp_path / "sweeps")
    monkeypatch.chdir(tmp_path)


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
def test_three_workers_one_of_them_killed_give_the_table_of_one_machine(postgres, tracking_server, tmp_path):
    alone, *folders = (tmp_path / name for name in ("alone", "killed", "second", "third", "lead"))
    for folder in (alone, *folders):
        folder.mkdir()
    quiet = start("study.sweep", alone, "--no-report")
    assert quiet.wait() == 0, said(alone)
    killed, second, third, lead = folders
    for folder in (killed, second, lead):  # the third makes its own frames
        shutil.copytree(alone / "data/episodes", folder / "data/episodes")
        shutil.copytree(alone / "data/frames", folder / "data/frames")

    own = {"STUDY_QUEUE": postgres.uri()}
    words = ("--tracking", tracking_server.uri, "--grace", "6")
    victim = start("study.worker", killed, *words, **own)
    wait_for(killed, "starting", victim)
    others = {second: start("study.worker", second, *words, **own), third: start("study.worker", third, *words, **own)}
    others[lead] = start("study.sweep", lead, *words, "--workers", "0", **own)
    wait_for(second, "starting", others[second])
    victim.send_signal(signal.SIGKILL)
    for folder, process in others.items():
        assert process.wait() == 0, said(folder)

    tracker = Tracker(tracking_server.uri)
    record = tracker.read_sweep("heads")
    assert record.complete
    assert record.table().equals(Tracker(f"sqlite:///{alone}/mlruns/mlflow.db").read_sweep("heads").table())
    statuses = [attempt.status for tries in tracker.attempts(list(record.planned)).values() for attempt in tries]
    assert Counter(status for status in statuses if status != "KILLED") == {"FINISHED": CELLS}
    assert (lead / "reports/heads.pdf").is_file()
    assert "there already" in said(second)
    assert "made here from their key" in said(third)
    for folder in (second, third):  # one that came too late for a cell has no such folders
        assert [*folder.glob("data/cells/*"), *folder.glob("data/tmp/*")] == []
    for path in tmp_path.rglob("*"):
        assert not path.is_file() or postgres.password.encode() not in path.read_bytes(), path
