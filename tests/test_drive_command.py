"""study.sweep drive: who drives where, what is printed, and what is refused."""

from pathlib import Path

import pytest

from study.errors import BadInputError
from study.sweep.__main__ import main
from tests.support.processes import sweep
from tests.support.sweeps import TINY_PROFILE, TINY_SWEEP, UndisturbedSweep, working_folder

MINE = """
def slow(seen):
    return 0.0, 2 if seen.speeds[0] < 3 else 1

def broken(seen):
    return seen.nothing

nothing = 1
"""
SHORT = ("--profile", "tiny", "--driving.duration", "2")


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
        (["--actor", "expert", "--traffic", "1", "--town", "1"], "leave one of them out"),
        ([], "name who drives"),
        (["--cell", "rec 100% e0"], "no cell of heads .tiny. is finished"),
        (["--actor", "expert", "--driving.duration", "0"], "driving.duration"),
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
    words = ["drive", *TINY_SWEEP, "--baselines", "[]", "--driving.duration", "2"]
    assert main([*words, "--cell", "rec+plan 100% e0", "--seed", "1", "--out", str(out)]) == 0
    assert "rec+plan 100% e0, policy 1" in capsys.readouterr().out
    assert out.stat().st_size > 1000
    assert main([*words, "--cell", "rec+plan", "--seed", "1"]) == 0
    with pytest.raises(BadInputError, match="unknown finished cell 'reck'; choose from rec 100% e0"):
        main([*words, "--cell", "reck"])
    with pytest.raises(BadInputError, match="unknown policy seed of rec 100% e0 '9'; choose from 0, 1"):
        main([*words, "--cell", "rec 100% e0", "--seed", "9"])
