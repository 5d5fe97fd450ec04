"""The whole way on the smoke profile: from an empty folder to the PDF."""

import json
import os
import re
import shutil
import sqlite3
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest

from study.tracking import Tracker

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parent.parent
SMALL = ("--profile", "smoke", "--policy_seeds", "3")
TWO = ("--heads", "[rec,full]")
LESS = ("--ceiling", "false")


def command(*words):
    """A sweep with one thread for each cell, which is not slow on a busy machine either."""
    return [sys.executable, "-m", "study.sweep", *words, "--threads", "1"]


def ask(folder, *words):
    words = [sys.executable, "-m", "study.sweep", *words]
    return subprocess.run(words, cwd=folder, capture_output=True, text=True, check=False, env=environment())


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


def table(folder):
    return Tracker(f"sqlite:///{folder}/mlruns/mlflow.db").read_sweep("heads").table()


def take(folder, to):
    """A working folder with the drives and frames of another, but nothing trained."""
    for name in ("sweeps", "data/episodes", "data/frames"):
        shutil.copytree(folder / name, to / name)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A working folder in which `heads` has run with two head sets and the ceiling."""
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
    assert "3 of 3 cells finished" in done.stderr
    assert runs(folder) == before


def test_datasize_reuses_the_cells_of_heads(folder):
    assert status(folder, "datasize", *SMALL, "--fractions", "[1.0,0.5]") == {"finished": 3, "waiting": 2}


def test_a_failed_cell_leaves_the_others_is_told_and_runs_again_when_asked_for(folder, tmp_path):
    take(folder, tmp_path)
    words = ("heads", *SMALL, "--heads", "[rec,rec+pred]", "--encoder.lr", "1e30", *LESS, "--no-report")
    for more, tries in ((), 2), ((), 2), (("--retry-failed",), 4):
        done = sweep(tmp_path, *words, *more)
        assert done.returncode == 1
        assert "failed: rec 100% e0" in done.stderr
        assert "failed: rec+pred 100% e0" in done.stderr
        assert "epoch" in done.stderr
        assert " --retry-failed\n" in done.stderr
        assert runs(tmp_path) == {"FAILED": tries}


def test_four_workers_give_the_table_of_one(folder, tmp_path):
    take(folder, tmp_path)
    done = sweep(tmp_path, "heads", *SMALL, *TWO, "--workers", "4", "--no-report")
    assert done.returncode == 0, done.stderr
    assert table(tmp_path).to_csv() == table(folder).to_csv()


def test_a_finished_cell_computed_again_has_the_same_bytes(folder):
    before = runs(folder), {path.name for path in (folder / "data").iterdir()}
    done = ask(folder, "verify", "heads", *SMALL, *TWO)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "equal: curves, weights, samples and predictions, byte for byte" in done.stdout
    assert (runs(folder), {path.name for path in (folder / "data").iterdir()}) == before


def test_a_result_tells_what_made_it(folder):
    tracker = Tracker(f"sqlite:///{folder}/mlruns/mlflow.db")
    told = next(iter(tracker.read_sweep("heads").results.values())).facts
    assert told["threads"] == 1
    assert told["provenance"]["determinism"].keys() >= {"deterministic_algorithms", "cudnn_benchmark", "matmul_tf32"}
    assert told["provenance"]["seeds"]["policies"] == [0, 1, 2]


def test_encoders_that_differ_by_their_seed_alone_show_no_effect(folder, tmp_path):
    """The real null study: four encoders of rec pose as the four head sets, in each of the 24 orders."""
    take(folder, tmp_path)
    words = ("heads", "--profile", "smoke", "--heads", "[rec]", "--encoder_seeds", "4", *LESS, "--no-report")
    done = sweep(tmp_path, *words)
    assert done.returncode == 0, done.stderr
    words = [sys.executable, ROOT / "benchmarks/null_study.py", "heads", "--profile", "smoke"]
    told = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, check=True, env=environment()).stdout
    outcomes = set(re.findall(r"^(H\d) ([a-z ]+): \d+$", told, re.MULTILINE))
    assert {claim for claim, _ in outcomes} == {"H1", "H2", "H3", "H4", "H5"}
    assert {claim for claim, outcome in outcomes if outcome == "reproduced"} <= {"H1"}  # which says: no effect
