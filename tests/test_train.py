"""Cells trained into a folder, on a machine without tracker, queue and simulator, and taken from there to MLflow."""

import fcntl
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest

from drives import crossing_drive
from study.command import Parser
from study.config import BadInputError, drive_name
from study.data import DATA, POLICY_SEED, drives_folder
from study.episode import write_episode
from study.plan import add_plan_options, given_plan
from study.result import load_results
from study.train import EXIT_AGAIN, EXIT_FAILED, main

ROOT = Path(__file__).parent.parent
PLAN = [
    *("heads", "--profile", "smoke", "--heads", "[rec,full]", "--policy_seeds", "2"),
    *("--recording.encoder_episodes", "2", "--recording.policy_episodes", "2"),
    *("--frames.encoder", "40", "--frames.policy", "40"),
    *("--encoder.batch", "16", "--encoder.epochs", "1", "--policy.batch", "16", "--policy.epochs", "5"),
]
# What the GPU machine lacks is gone for imports and for those who ask what is installed, in child processes, too.
REFUSAL = """
import importlib.metadata as metadata, sys
GONE = {"mlflow", "optuna", "highway_env", "gymnasium", "typst", "rich", "matplotlib", "sqlalchemy", "PIL", "pillow"}
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
    parser = Parser()
    add_plan_options(parser)
    return given_plan(parser.parse(words))


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    """A working folder with drives that were recorded elsewhere."""
    made = tmp_path_factory.mktemp("train")
    shutil.copytree(ROOT / "sweeps", made / "sweeps")
    before = Path.cwd()
    os.chdir(made)
    for seed in (0, 1, POLICY_SEED, POLICY_SEED + 1):
        write_episode(crossing_drive(seed), drives_folder(plan().settings, made / DATA) / drive_name(seed))
    yield made
    os.chdir(before)


@pytest.fixture(scope="module")
def results(home):
    """Results of a process that has no tracker, no queue and no simulator."""
    (home / "refusal").mkdir()
    (home / "refusal" / "sitecustomize.py").write_text(REFUSAL)
    done = subprocess.run(
        [sys.executable, "-m", "study.train", *PLAN, "--out", "results"],
        cwd=home,
        env=os.environ | {"PYTHONPATH": f"{home / 'refusal'}:{ROOT}"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return home / "results"


@pytest.mark.slow
def test_cells_are_trained_where_tracker_queue_and_simulator_are_missing(results):
    assert {result.key: result.cell for result in load_results(results)} == plan().cells


def test_a_cell_that_is_there_is_not_trained_again(results):
    before = {path: path.stat().st_mtime_ns for path in results.rglob("*")}
    assert main([*PLAN, "--out", str(results)]) == 0
    assert {path: path.stat().st_mtime_ns for path in results.rglob("*")} == before


def test_the_limit_ends_a_piece_and_says_that_cells_are_left(home, tmp_path):
    began = time.monotonic()
    words = [*PLAN, "--encoder.epochs", "1000000", "--out", str(tmp_path), "--limit-seconds", "5"]
    assert main(words) == EXIT_AGAIN
    assert 5 <= time.monotonic() - began < 60
    assert not list(tmp_path.glob("*/cell.json"))


def test_a_cell_that_another_process_trains_is_left_to_it(home, tmp_path, capsys):
    locks = [(tmp_path / f".{key}.lock").open("w") for key in plan().cells]
    for lock in locks:
        fcntl.flock(lock, fcntl.LOCK_EX)
    assert main([*PLAN, "--out", str(tmp_path)]) == EXIT_AGAIN
    assert capsys.readouterr().err.count("another process has taken it") == 2
    for lock in locks:
        lock.close()


def test_a_cell_that_fails_is_told_and_the_others_go_on(home, tmp_path, capsys):
    assert main([*PLAN, "--encoder.lr", "1e30", "--out", str(tmp_path)]) == EXIT_FAILED
    said = capsys.readouterr().err
    assert "failed: rec 100% e0" in said
    assert "failed: full 100% e0" in said


def test_drives_that_are_missing_without_a_simulator_are_told(home, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "study.sim.record", None)
    with pytest.raises(BadInputError, match=r"4 of 4 drives are missing.*study.data record"):
        main([*PLAN, "--recording.seed", "5", "--out", str(tmp_path)])


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--limit-seconds", "0"], "above 0"),
        (["--device", "cuda:99"], "choose from cpu"),
        (["--out", "/dev/null/results"], "cannot write"),
    ],
)
def test_what_cannot_be_used_is_told(home, tmp_path, words, said):
    with pytest.raises(BadInputError, match=said):
        main([*PLAN, "--out", str(tmp_path), *words])
