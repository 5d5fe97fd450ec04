"""Cells trained into a folder, where MLflow, Optuna, Dask and simulator are missing, and taken from there to MLflow."""

import fcntl
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest

from study.data.__main__ import main as record_drives
from study.errors import EXIT_AGAIN, EXIT_FAILED, BadInputError
from study.results.cell_result import load_results
from study.sweep import __main__
from study.tracking.tracker import Tracker
from tests.support.plans import plan_of
from tests.support.processes import ROOT

SWEEP = ["heads", "--heads", "[rec,full]", "--policy_seeds", "2"]
DRIVES = [
    *("--profile", "smoke", "--town.vehicles", "30", "--recording.warm_up", "1", "--recording.duration", "4"),
    *("--recording.encoder_episodes", "2", "--recording.policy_episodes", "2"),
]
SETTINGS = [
    *DRIVES,
    *("--frames.encoder", "40", "--frames.policy", "40"),
    *("--encoder.batch", "16", "--encoder.epochs", "1", "--policy.batch", "16", "--policy.epochs", "5"),
]
PLAN = [*SWEEP, *SETTINGS]
# What the GPU machine lacks is gone for imports and for those who ask what is installed, in child processes, too.
REFUSAL = """
import importlib.metadata as metadata, sys
GONE = {"mlflow", "optuna", "dask", "distributed", "highway_env", "gymnasium", "typst", "rich", "matplotlib"}
GONE |= {"sqlalchemy", "PIL", "pillow"}
class Refusal:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in GONE:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
sys.meta_path.insert(0, Refusal())
installed = metadata.Distribution.from_name
def from_name(name):
    if name in GONE:
        raise metadata.PackageNotFoundError(name)
    return installed(name)
metadata.Distribution.from_name = from_name
"""


def plan(words=PLAN):
    return plan_of(words)


def main(words):
    return __main__.main(["train", *words])


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    """Enter a working folder with drives."""
    folder, before = tmp_path_factory.mktemp("home"), Path.cwd()
    shutil.copytree(ROOT / "sweeps", folder / "sweeps")
    os.chdir(folder)
    assert record_drives(["record", *DRIVES]) == 0
    yield folder
    os.chdir(before)


def test_the_limit_ends_a_piece_and_says_that_cells_are_left(home, tmp_path):
    began = time.monotonic()
    words = [*PLAN, "--encoder.epochs", "1000000", "--out", str(tmp_path), "--limit-seconds", "8"]
    completed = subprocess.run(
        [sys.executable, "-m", "study.sweep", "train", *words], capture_output=True, text=True, check=False
    )
    assert completed.returncode == EXIT_AGAIN, completed.stderr
    assert 8 <= time.monotonic() - began < 90
    assert "Traceback" not in completed.stderr
    assert not list(tmp_path.glob("*/cell.json"))


def test_a_cell_that_another_process_trains_is_left_to_it(home, tmp_path, capsys):
    locks = [(tmp_path / f".{key}.lock").open("w") for key in plan().cells]
    for lock in locks:
        fcntl.flock(lock, fcntl.LOCK_EX)
    assert main([*PLAN, "--out", str(tmp_path)]) == EXIT_AGAIN
    assert capsys.readouterr().err.count("another process has taken it") == len(locks)
    for lock in locks:
        lock.close()


def test_a_cell_that_fails_is_reported_and_the_others_go_on(home, tmp_path, capsys):
    assert main([*PLAN, "--encoder.lr", "1e30", "--threads", "2", "--out", str(tmp_path)]) == EXIT_FAILED
    message = capsys.readouterr().err
    assert "failed: rec 100% e0" in message
    assert "failed: full 100% e0" in message


def test_drives_that_are_missing_without_a_simulator_are_reported(home, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "study.sim.record", None)
    with pytest.raises(BadInputError, match=r"4 of 4 drives are missing.*study.data record"):
        main([*PLAN, "--recording.seed", "5", "--out", str(tmp_path)])


def test_a_library_that_is_missing_is_reported_before_the_data_is_made(home, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "lightning", None)
    with pytest.raises(BadInputError, match="lightning is not installed here; bring its wheel along"):
        main([*PLAN, "--frames.seed", "5", "--out", str(tmp_path)])


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--limit-seconds", "0"], "not in the range x>0"),
        (["--device", "cuda:99"], "choose from cpu"),
        (["--out", "/dev/null/results"], "cannot write"),
    ],
)
def test_unusable_input_is_reported(home, tmp_path, words, message):
    with pytest.raises(BadInputError, match=message):
        main([*PLAN, "--out", str(tmp_path), *words])


# --- on another machine ---------------------------------------------------------------------------------------------


def script(code, *words, cwd=None, **environment):
    """Run a step of benchmarks/paper_scale.sh, of the code in a folder, and return what it says."""
    completed = subprocess.run(
        ["bash", str(code / "benchmarks" / "paper_scale.sh"), *words],
        cwd=cwd,
        env=os.environ | {"PYTHON": sys.executable, **environment},
        capture_output=True,
        text=True,
        check=False,
    )
    assert completed.returncode == 0, completed.stderr
    return completed.stderr


@pytest.fixture(scope="module")
def packed(tmp_path_factory):
    """Pack what travels to the GPU machine: the last commit's code, and drives."""
    folder = tmp_path_factory.mktemp("train") / "packed"
    script(ROOT, "pack", str(folder), *SETTINGS, SWEEP=" ".join(SWEEP), WHEELS="")
    return folder


@pytest.fixture(scope="module")
def results(packed):
    """Return results of processes without tracker and simulator, whose only engine is their own process."""
    refusal = packed.with_name("refusal")
    refusal.mkdir()
    (refusal / "sitecustomize.py").write_text(REFUSAL)
    script(packed, "train", PYTHONPATH=str(refusal))
    return packed / "results"


@pytest.mark.stress
def test_cells_are_trained_where_tracker_dask_and_simulator_are_missing(results):
    assert {result.key: result.cell for result in load_results(results)} == plan().cells


@pytest.mark.stress
def test_cells_come_back_into_mlflow_and_the_report_with_the_commit_that_trained_them(packed, results):
    output = script(ROOT, "import", str(packed), cwd=packed)
    assert output.count(": imported") == len(plan().cells)
    assert (packed / "reports/heads.pdf").read_bytes().startswith(b"%PDF")
    commit = subprocess.run(["git", "-C", str(ROOT), "rev-parse", "HEAD"], capture_output=True, text=True, check=True)
    record = Tracker(f"sqlite:///{packed}/mlruns/mlflow.db").reader.read_sweep("heads")
    assert {result.facts["provenance"]["commit"] for result in record.results.values()} == {commit.stdout.strip()}


@pytest.mark.stress
def test_a_finished_cell_is_not_trained_again(packed, results, monkeypatch):
    monkeypatch.chdir(packed)
    before = {path: path.stat().st_mtime_ns for path in results.rglob("*")}
    assert main([*PLAN, "--out", str(results)]) == 0
    assert {path: path.stat().st_mtime_ns for path in results.rglob("*")} == before
