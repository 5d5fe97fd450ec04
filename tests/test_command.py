"""The command line: errors are one line and exit code 2, and nothing heavy is loaded to answer --help."""

import json
import signal
import subprocess
import sys

import pytest

from study.command import EXIT_INTERRUPTED, check_stopped, stoppable, unbroken

HEAVY = ("torch", "lightning", "mlflow", "optuna", "matplotlib", "highway_env", "cv2", "pandas", "distributed")


def sweep(*words, cwd=None):
    return subprocess.run(
        [sys.executable, "-m", "study.sweep", *words], capture_output=True, text=True, check=False, cwd=cwd
    )


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["heds"], "choose from datasize, datasize-budget-steps"),
        (["heads", "--profile", "desktop"], "choose from laptop, paper, smoke"),
        (["heads", "--encoder.epohcs", "5"], "did you mean --encoder.epochs?"),
        (["heads", "--encoder.epochs", "five"], "encoder.epochs"),
        (["heads", "--heads", "[rec,rec+plam]"], "choose from rec, rec+pred, rec+plan, full"),
        (["heads", "--heads", "[rec"], "not valid YAML"),
        (["heads", "--fractions", "0"], "greater than 0"),
        (["heads", "--workers", "0"], "1 or more"),
        (["heads", "--json"], "--dry-run"),
        (["heads", "--qeue=postgresql://me:secret@host/db"], "--qeue=postgresql://***@host/db"),
        ([], "NAME"),
    ],
)
def test_bad_input_is_one_clear_error_and_exit_code_2(words, expected):
    done = sweep(*words)
    assert done.returncode == 2
    assert expected in done.stderr
    assert "secret" not in done.stderr
    assert "Traceback" not in done.stderr


def test_dry_run_speaks_json():
    done = sweep("heads", "--dry-run", "--json", "--profile", "smoke", "--heads", "full", "--encoder_seeds", "2")
    facts = json.loads(done.stdout)
    assert set(facts) == {
        "sweep",
        "profile",
        "cells",
        "policy_seeds",
        "parameters",
        "frames",
        "seconds",
        "bytes",
    }
    assert [(cell["heads"], cell["encoder_seed"], cell["status"]) for cell in facts["cells"]] == [
        ("full", 0, "waiting"),
        ("full", 1, "waiting"),
        ("state", 0, "waiting"),
    ]
    assert facts["seconds"] > 0 < facts["bytes"]


@pytest.mark.parametrize("words", [["--help"], ["heads", "--dry-run"]])
def test_help_and_dry_run_load_nothing_heavy(words):
    code = (
        "import sys; from study.sweep import main\n"
        f"try: main({words!r})\n"
        "except SystemExit: pass\n"
        f"print([name for name in {HEAVY!r} if name in sys.modules], file=sys.stderr)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stderr.strip() == "[]"


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_stop_waits_for_what_must_not_break(number, capsys):
    done, before = [], signal.getsignal(number)

    def work():
        with unbroken():
            with unbroken():
                signal.raise_signal(number)
            done.append("whole")
        done.append("more")
        return 0

    assert stoppable(work, "this again") == EXIT_INTERRUPTED
    assert done == ["whole"]
    assert "To go on: this again" in capsys.readouterr().err
    assert signal.getsignal(number) is before


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_a_stop_that_python_dropped_comes_again():
    class Finaliser:
        def __del__(self):
            signal.raise_signal(signal.SIGINT)

    def work():
        Finaliser()
        check_stopped()
        return 0

    assert stoppable(work, "") == EXIT_INTERRUPTED
    check_stopped()  # is over then
