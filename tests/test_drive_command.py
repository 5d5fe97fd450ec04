"""study.sweep drive: who drives where, what is printed, and what is refused."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from study.errors import BadInputError
from study.policy.draws import initial_weights
from study.policy.latents import normalisation
from study.sweep.__main__ import main
from study.sweep.drive import one_policy
from tests.support.processes import sweep
from tests.support.sweeps import TINY_PROFILE, TINY_SWEEP, UndisturbedSweep, working_folder
from tests.support.synthetic_records import simulate

MINE = """
def slow(seen):
    return 0.0, 2 if seen.speeds[0] < 3 else 1

def broken(seen):
    return seen.nothing

nothing = 1
"""
SHORT = ("--profile", "tiny", "--duration", "2")


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    working_folder(tmp_path)
    (tmp_path / "mine.py").write_text(MINE)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_a_users_function_drives_and_its_scores_stand_beside_the_experts(folder, capsys):
    assert main(["drive", "heads", *SHORT, "--actor", "mine.py:slow", "--out", "films/a.gif"]) == 0
    printed = capsys.readouterr()
    for words in ("slow", "expert", "driving score", "0 to 100", "m/s", "2.0 s of 2 s driven", "films/a.gif"):
        assert words in printed.out
    assert "slow drives" in printed.err
    assert (folder / "films/a.gif").read_bytes().startswith(b"GIF89a")
    assert [path.name for path in (folder / "films").iterdir()] == ["a.gif"]


def test_the_expert_drives_in_an_unseen_town(folder, capsys):
    assert main(["drive", "heads", *SHORT, "--actor", "expert", "--town", "1"]) == 0
    assert "drove to the end, 2.0 s of 2 s driven" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["--actor", "no.py:drive"], "there is no file no.py"),
        (["--actor", "mine.py:fast"], "has no function fast; it has slow, broken"),
        (["--actor", "mine.py:nothing"], "has no function nothing"),
        (["--actor", "mine.py"], "give FILE.py:function"),
        (["--actor", "broken.py:drive"], r"broken.py raised NameError: .*line 1\)"),
        (["--actor", "mine.py:broken"], r"raised AttributeError: .*at 0.0 s of drive 2000000 \(.*mine.py, line 6\)"),
        (["--actor", "expert", "--out", "a.avi"], "unknown kind of film '.avi'; choose from .mp4, .webm, .gif"),
        (["--actor", "expert", "--cell", "rec"], "name who drives"),
        (["--actor", "expert", "--drive", "1", "--town", "1"], "leave one of them out"),
        ([], "name who drives"),
        (["--cell", "rec 100% e0"], "no cell of heads .tiny. is finished"),
        (["--actor", "expert", "--duration", "0"], "--duration"),
    ],
)
def test_bad_input_is_one_clear_error(folder, words, expected):
    (folder / "broken.py").write_text("missing\n")
    with pytest.raises(BadInputError, match=expected):
        main(["drive", "heads", *SHORT, *words])


def test_bad_input_ends_with_exit_code_2(folder):
    done = sweep(folder, "drive", "heads", *SHORT, "--actor", "no.py:drive")
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == "error: actor 'no.py:drive': there is no file no.py\n"


def test_a_policy_of_a_finished_cell_drives(undisturbed: UndisturbedSweep, monkeypatch, tmp_path, capsys):
    monkeypatch.chdir(undisturbed.folder)
    assert TINY_PROFILE in (undisturbed.folder / "sweeps/profiles/tiny.yaml").read_text()
    out = tmp_path / "a.mp4"
    words = ["drive", *TINY_SWEEP, "--baselines", "[]", "--duration", "2"]
    assert main([*words, "--cell", "rec+plan 100% e0", "--seed", "1", "--out", str(out)]) == 0
    assert "rec+plan 100% e0, policy 1" in capsys.readouterr().out
    assert out.stat().st_size > 1000
    with pytest.raises(BadInputError, match="unknown finished cell 'reck'; choose from rec 100% e0"):
        main([*words, "--cell", "reck"])
    with pytest.raises(BadInputError, match="unknown policy seed of rec 100% e0 '9'; choose from 0, 1"):
        main([*words, "--cell", "rec 100% e0", "--seed", "9"])


def test_one_policy_is_taken_from_among_the_others():
    draws = [dict(initial_weights(seed)) for seed in range(3)]
    policies = {name: np.stack([each[name].numpy() for each in draws]) for name in draws[0]}
    z = np.random.default_rng(0).normal(size=(20, 64)).astype(np.float32)
    result = replace(next(iter(simulate().results.values())), policies=policies | normalisation(z, "zscore"))
    one = one_policy(result, 2).policies
    assert {name: len(value) for name, value in one.items() if name[:2] != "z_"} == dict.fromkeys(draws[0], 1)
    assert (one["steering_0_weight"][0] == policies["steering_0_weight"][2]).all()
    assert (one["z_mean"] == result.policies["z_mean"]).all()
