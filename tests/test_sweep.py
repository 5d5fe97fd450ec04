"""A sweep of the smoke profile, from an empty folder to the PDF."""

import json
import re
import shutil
import subprocess
import sys
from collections import Counter

import pytest

from study.tracking.tracker import Tracker
from tests.support.processes import ROOT, sweep
from tests.support.run_database import run_database
from tests.support.sweeps import FOUR_CELLS, TINY_SWEEP, working_folder

SMOKE = ("--profile", "smoke", "--threads", "1")
SMALL = (*SMOKE, "--policy_seeds", "3", "--baselines", "[state]")
TWO = ("--heads", "[rec,full]")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Return a working folder in which `heads` has run with two head sets and the ceiling."""
    working = working_folder(tmp_path_factory.mktemp("sweep"))
    completed = sweep(working, "heads", *SMALL, *TWO)
    assert completed.returncode == 0, completed.stderr
    return working


def table(folder):
    return Tracker(f"sqlite:///{folder}/mlruns/mlflow.db").reader.read_sweep("heads").table()


def test_a_sweep_ends_with_its_report(folder):
    assert (folder / "reports/heads.pdf").read_bytes().startswith(b"%PDF")
    assert (folder / "reports/heads/report.json").is_file()


def test_a_sweep_run_holds_the_data_card(folder):
    cards = {path.name for path in folder.glob("mlruns/artifacts/*/artifacts/data/*")}
    assert cards == {"card.json", "card.txt", "card.png"}


def test_the_same_command_again_trains_nothing(folder):
    before = run_database(folder).cell_counts()
    completed = sweep(folder, "heads", *SMALL, *TWO, "--no-report")
    assert completed.returncode == 0
    assert "3 of 3 cells finished" in completed.stderr
    assert run_database(folder).cell_counts() == before


def test_datasize_reuses_the_cells_of_heads(folder):
    same = ("--encoder.batch", "32")  # datasize has a batch of its own, for the encoders of little data
    completed = sweep(folder, "datasize", *SMALL, *same, "--fractions", "[1.0,0.5]", "--dry-run", "--json")
    states = Counter(cell["status"] for cell in json.loads(completed.stdout)["cells"])
    assert states == {"finished": 3, "waiting": 2}


@pytest.mark.stress
def test_a_failed_cell_is_reported_leaves_the_others_alone_and_runs_again_on_request(undisturbed, tmp_path):
    undisturbed.copy(tmp_path)
    words = (*FOUR_CELLS, "--heads", "[rec,rec+pred]", "--encoder.lr", "1e30")
    for more, tries in ((), 2), (("--no-report",), 2), (("--no-report", "--retry-failed"), 4):
        completed = sweep(tmp_path, *words, *more)
        assert completed.returncode == 1
        assert "failed: rec 100% e0" in completed.stderr
        assert "failed: rec+pred 100% e0" in completed.stderr
        assert "epoch" in completed.stderr
        assert " --retry-failed\n" in completed.stderr
        assert "Traceback" not in completed.stderr
        assert run_database(tmp_path).cell_counts() == {"FAILED": tries}
    assert (tmp_path / "reports/heads.pdf").is_file()


@pytest.mark.stress
@pytest.mark.parametrize("workers", ["1", "2", "4"])
def test_any_number_of_workers_gives_the_table_of_a_single_process(undisturbed, tmp_path, workers):
    undisturbed.copy(tmp_path)
    completed = sweep(tmp_path, *FOUR_CELLS, "--workers", workers, "--no-report")
    assert completed.returncode == 0, completed.stderr
    assert table(tmp_path).to_csv() == table(undisturbed.folder).to_csv()


@pytest.mark.stress
def test_a_finished_cell_computed_again_has_the_same_bytes(undisturbed):
    def kept():
        return run_database(undisturbed.folder).cell_counts(), {
            path.name for path in (undisturbed.folder / "data").iterdir()
        }

    before = kept()
    completed = sweep(undisturbed.folder, "verify", *TINY_SWEEP, "--baselines", "[]")
    assert completed.returncode == 0, completed.stdout + completed.stderr
    assert "equal: curves, weights, samples and predictions, byte for byte" in completed.stdout
    assert kept() == before


def test_a_result_records_its_origin(folder):
    tracker = Tracker(f"sqlite:///{folder}/mlruns/mlflow.db")
    facts = next(iter(tracker.reader.read_sweep("heads").results.values())).facts
    assert facts["threads"] == 1
    assert facts["provenance"]["determinism"].keys() >= {"deterministic_algorithms", "cudnn_benchmark", "matmul_tf32"}
    assert facts["provenance"]["seeds"]["policies"] == [0, 1, 2]


@pytest.mark.stress
def test_encoders_that_differ_by_their_seed_alone_show_no_effect(folder, tmp_path):
    """The real null study: four encoders of rec pose as the four head sets, in each of the 24 orders."""
    for name in ("sweeps", "data/episodes", "data/frames"):
        shutil.copytree(folder / name, tmp_path / name)
    words = ("heads", *SMOKE, "--heads", "[rec]", "--encoder_seeds", "4", "--baselines", "[]", "--no-report")
    completed = sweep(tmp_path, *words, "--workers", "2")
    assert completed.returncode == 0, completed.stderr
    words = [sys.executable, ROOT / "benchmarks/null_study.py", "heads", "--profile", "smoke"]
    output = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, check=True).stdout
    outcomes = set(re.findall(r"^(H\d) ([a-z ]+): \d+$", output, re.MULTILINE))
    assert {claim for claim, _ in outcomes} == {"H0", "H1", "H2", "H3", "H4", "H5"}
    assert {claim for claim, outcome in outcomes if outcome == "reproduced"} <= {"H1"}  # which compares nothing
