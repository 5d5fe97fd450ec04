"""The command line: errors are one line and exit code 2, and nothing heavy is loaded to answer --help."""

import json
import os
import signal
import subprocess
import sys
import time

import pytest

from study.config.baselines import BASELINES
from study.console.interrupts import STOP_SECONDS, check_stopped, stoppable
from study.console.options import run
from study.data.__main__ import main as data
from study.errors import EXIT_AGAIN, EXIT_BAD_INPUT, EXIT_INTERRUPTED, BadInputError
from study.report.__main__ import main as report
from tests.support.processes import sweep
from tests.support.sweeps import working_folder

HEAVY = ("torch", "lightning", "mlflow", "optuna", "matplotlib", "highway_env", "cv2", "pandas", "distributed")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Return a newcomer's working folder: sweep files and nothing else."""
    return working_folder(tmp_path_factory.mktemp("command"))


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["heds"], "choose from datasize, datasize-budget-steps"),
        (["heads", "--profile", "huge"], "choose from desktop, laptop, paper, smoke, tiny"),
        (["heads", "--encoder.epohcs", "5"], "--encoder.epochs"),
        (["heads", "--encoder.epochs", "five"], "encoder.epochs"),
        (["heads", "--heads", "[rec,rec+plam]"], "choose from rec, rec+pred, rec+plan, full"),
        (["heads", "--heads", "[rec"], "not valid YAML"),
        (["heads", "--fractions", "0"], "greater than 0"),
        (["heads", "--workers", "0"], "x>=1"),
        (["heads", "--json"], "--dry-run"),
        (["heads", "--threads", "0"], "x>=1"),
        (["heads", "--device", "cuda:7"], "not on this machine"),
        (["heads", "--trakcing=postgresql://me:secret@host/db"], "--tracking"),
        (["heads", "--cluster", "tcp://10.0.0.1:8786"], "not encrypted"),
        (["heads", "--cluster", "tls://127.0.0.1:8786"], "--certificates"),
        (["heads", "--cluster", "somewhere"], "tls://host:8786"),
        (["heads", "--cluster", "tcp://127.0.0.1:1", "--workers", "2"], "leave one of them out"),
        (["heads", "--dry-run", "--tracking=postgresql://me:secret@host/db"], "postgresql://***@host/db"),
        (["verify", "heads", "--retry-failed"], "it goes with python -m study.sweep: leave it out here"),
        (
            ["verify", "heads", "--threads", "2"],
            "it goes with python -m study.sweep, python -m study.sweep train: leave",
        ),
        (["verify", "heads", "--workers", "2"], "no cell of heads"),
        (
            ["status", "heads", "--cell", "x"],
            "python -m study.sweep verify, python -m study.sweep drive: leave it out here",
        ),
        (["train", "heads", "--out", "out", "--tracking", "x"], "it goes with python -m study.sweep, "),
        ([], "NAME"),
    ],
)
def test_bad_input_is_one_clear_error_exit_code_2_and_leaves_nothing(folder, words, expected):
    completed = sweep(folder, *words)
    assert completed.returncode == 2
    assert expected in completed.stderr
    assert "secret" not in completed.stderr
    assert "Traceback" not in completed.stderr
    assert {path.name for path in folder.iterdir()} == {"sweeps"}


@pytest.mark.parametrize(
    "words", [["--workers", "2"], ["--encoder.epochs", "5"], ["--retry-failed"], ["--device", "cpu"]]
)
def test_a_report_says_where_options_of_a_run_go(words):
    for command in (["heads", *words], ["compare", "heads", "heads", *words]):
        with pytest.raises(BadInputError, match=r"No such option.*go with python -m study.sweep: a report takes"):
            report(command)


def test_a_misspelt_option_is_told_the_right_one():
    with pytest.raises(BadInputError, match=r"Did you mean.*--format"):
        report(["heads", "--formt", "md"])


def test_an_option_of_another_data_command_is_named():
    with pytest.raises(BadInputError, match=r"it goes with python -m study\.data import: leave it out here"):
        data(["card", "--drop-bad"])


def test_dry_run_speaks_json(folder):
    completed = sweep(
        folder, "heads", "--dry-run", "--json", "--profile", "smoke", "--heads", "full", "--encoder_seeds", "2"
    )
    facts = json.loads(completed.stdout)
    assert set(facts) == {
        "sweep",
        "profile",
        "cells",
        "to_drive",
        "policy_seeds",
        "parameters",
        "frames",
        "seconds",
        "bytes",
    }
    assert [(cell["heads"], cell["encoder_seed"], cell["status"]) for cell in facts["cells"]] == [
        ("full", 0, "waiting"),
        ("full", 1, "waiting"),
        *((name, seed, "waiting") for name, record in BASELINES.items() for seed in range(record.seeds)),
    ]
    assert facts["seconds"] > 0 < facts["bytes"]


@pytest.mark.parametrize("words", [["--help"], ["heads", "--dry-run"]])
def test_help_and_dry_run_load_nothing_heavy(folder, words):
    code = (
        "import sys; from study.sweep.__main__ import main\n"
        f"try: main({words!r})\n"
        "except SystemExit: pass\n"
        f"print([name for name in {HEAVY!r} if name in sys.modules], file=sys.stderr)"
    )
    completed = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=folder)
    assert completed.stderr.strip() == "[]"


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_stop_waits_until_the_work_asks_for_it(number, capsys):
    done, before = [], signal.getsignal(number)

    def work():
        signal.raise_signal(number)
        done.append("whole")
        check_stopped()
        done.append("more")
        return 0

    assert stoppable(work, "this again") == EXIT_INTERRUPTED
    assert done == ["whole"]
    assert "To go on: this again" in capsys.readouterr().err
    assert signal.getsignal(number) is before
    check_stopped()  # the stop is over with the command that it stopped


def test_a_time_limit_ends_the_work_with_a_code_of_its_own():
    def work():
        signal.raise_signal(signal.SIGALRM)
        check_stopped()
        return 0

    assert stoppable(work, "") == EXIT_AGAIN


def test_work_that_does_not_ask_is_left_where_it_is():
    code = (
        "import signal, time; from study.console.interrupts import stoppable\n"
        "def work():\n"
        "    signal.raise_signal(signal.SIGINT)\n"
        "    time.sleep(60)\n"
        "stoppable(work, 'this again')"
    )
    began = time.monotonic()
    completed = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert completed.returncode == EXIT_INTERRUPTED
    assert "To go on: this again" in completed.stderr
    assert "Traceback" not in completed.stderr
    assert STOP_SECONDS <= time.monotonic() - began < 30


@pytest.mark.parametrize("encoding", ["ascii", "latin-1", "cp1252", "utf-8"])
def test_what_the_output_cannot_show_is_a_substitute(encoding):
    """A title in another script, and the name of a file that is no text at all."""
    code = (
        "import sys; from study.console.options import run; from study.errors import BadInputError\n"
        "def main(words):\n"
        "    print('95 % — 漢字 \\udcff'); raise BadInputError('no file 漢字 \\udcff')\n"
        "run(main)"
    )
    environment = os.environ | {"PYTHONIOENCODING": encoding}
    completed = subprocess.run([sys.executable, "-c", code], capture_output=True, check=False, env=environment)
    assert completed.returncode == EXIT_BAD_INPUT
    assert completed.stdout.startswith(b"95 % ")
    assert completed.stderr.startswith(b"error: no file ")
    assert b"Traceback" not in completed.stderr
    assert ("漢" in completed.stdout.decode(encoding)) == (encoding == "utf-8")


@pytest.mark.parametrize(
    "error",
    [
        PermissionError(13, "Permission denied", "/cache"),
        OSError(30, "Read-only file system", "reports"),
        OSError(36, "File name too long", "x" * 20),
        NotADirectoryError(20, "Not a directory", "data/tmp"),
        FileNotFoundError(2, "No usable temporary directory found in ['/tmp']"),
    ],
    ids=lambda error: error.strerror,
)
def test_a_folder_that_cannot_be_written_is_one_clear_error(error, capsys):
    def main(words):
        raise error

    with pytest.raises(SystemExit) as end:
        run(main)
    assert end.value.code == EXIT_BAD_INPUT
    assert "error: cannot write" in (message := capsys.readouterr().err)
    assert "give the same command again" in message


def test_a_fault_of_this_program_keeps_its_traceback():
    def main(words):
        raise FileNotFoundError(2, "No such file or directory", "x")

    with pytest.raises(FileNotFoundError):
        run(main)


def test_a_home_that_cannot_be_written_and_a_cache_that_is_swept_cost_nothing(tmp_path):
    (tmp_path / "home").touch()
    code = (
        "import shutil; from study.console.options import run\n"
        "def main(words):\n"
        "    import matplotlib; from study.figures.fonts import fonts_for\n"
        "    shutil.rmtree(matplotlib.get_configdir()); print(len(fonts_for('Ω').files)); return 0\n"
        "run(main)"
    )
    environment = {name: value for name, value in os.environ.items() if not name.startswith(("XDG_", "MPL"))}
    environment |= {"HOME": str(tmp_path / "home"), "TMPDIR": str(tmp_path)}
    completed = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False, env=environment
    )
    assert (completed.returncode, completed.stdout) == (0, "1\n"), completed.stderr
    assert "Traceback" not in completed.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["home"]
