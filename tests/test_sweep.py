"""The whole way on the smoke profile: from an empty folder to the PDF, stopped and started again."""

import json
import os
import shutil
import signal
import sqlite3
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

import pytest

from study.tracking import Tracker

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parent.parent
SMALL = ("--profile", "smoke", "--policy_seeds", "3")
TWO = ("--heads", "[rec,full]")


def command(*words):
    return [sys.executable, "-m", "study.sweep", *words]


def sweep(folder, *words):
    return subprocess.run(command(*words), cwd=folder, capture_output=True, text=True, check=False, env=environment())


def environment():
    return os.environ | {"PYTHONPATH": str(ROOT)}


def status(folder, *words):
    done = sweep(folder, *words, "--dry-run", "--json")
    return Counter(cell["status"] for cell in json.loads(done.stdout)["cells"])


def runs(folder):
    """How many runs of cells there are, by status."""
    query = "select status from runs join tags using (run_uuid) where key = 'kind' and value = 'cell'"
    with sqlite3.connect(folder / "mlruns/mlflow.db") as database:
        return Counter(status for (status,) in database.execute(query))


def take(folder, to):
    """A working folder with the drives and frames of another, but nothing trained."""
    for name in ("sweeps", "data/episodes", "data/frames"):
        shutil.copytree(folder / name, to / name)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A working folder in which `heads` has run with two head sets."""
    made = tmp_path_factory.mktemp("sweep")
    shutil.copytree(ROOT / "sweeps", made / "sweeps")
    done = sweep(made, "heads", *SMALL, *TWO)
    assert done.returncode == 0, done.stderr
    return made


def test_a_sweep_ends_with_its_report(folder):
    assert (folder / "reports/heads.pdf").read_bytes().startswith(b"%PDF")
    assert (folder / "reports/heads/report.json").is_file()


def test_a_sweep_run_holds_the_data_card(folder):
    cards = {path.name for path in folder.glob("mlruns/artifacts/*/artifacts/data/*")}
    assert cards == {"card.json", "card.txt", "card.png"}


def test_the_same_command_again_trains_nothing(folder):
    before = runs(folder)
    done = sweep(folder, "heads", *SMALL, *TWO)
    assert done.returncode == 0
    assert "2 of 2 cells finished" in done.stderr
    assert runs(folder) == before


def test_datasize_reuses_the_cells_of_heads(folder):
    assert status(folder, "datasize", *SMALL, "--fractions", "[1.0,0.5]") == {"finished": 2, "waiting": 2}


def test_a_failed_cell_leaves_the_others_and_is_told(folder, tmp_path):
    take(folder, tmp_path)
    done = sweep(tmp_path, "heads", *SMALL, "--heads", "[rec,rec+pred]", "--encoder.lr", "1e30", "--no-report")
    assert done.returncode == 1
    assert "failed: rec 100% e0" in done.stderr
    assert "failed: rec+pred 100% e0" in done.stderr
    assert "epoch" in done.stderr


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGINT, signal.SIGTERM])
def test_a_stopped_sweep_goes_on_and_ends_like_one_that_was_not(folder, tmp_path, how):
    take(folder, tmp_path)
    process = subprocess.Popen(
        command("heads", *SMALL, *TWO), cwd=tmp_path, stderr=subprocess.PIPE, text=True, env=environment()
    )
    for line in process.stderr:
        if "encoder, epoch" in line or "starting" in line:
            break
    time.sleep(5)
    process.send_signal(how)
    process.stderr.read()
    assert process.wait(10) != 0

    done = sweep(tmp_path, "heads", *SMALL, *TWO)
    assert done.returncode == 0, done.stderr
    assert runs(tmp_path)["FINISHED"] == 2
    assert runs(tmp_path)["RUNNING"] == 0
    tables = [Tracker(f"sqlite:///{at}/mlruns/mlflow.db").read_sweep("heads").table() for at in (folder, tmp_path)]
    assert tables[0].equals(tables[1])
