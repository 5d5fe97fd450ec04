"""Sweeps that are killed, stopped, starved and fed with garbage end like one that was left alone."""

import os
import re
import shutil
import signal
import subprocess
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import pytest

from running import ROOT, Running, check_like, command, leftovers, store, working_folder

pytestmark = pytest.mark.slow

TINY = ("heads", "--profile", "tiny", "--policy_seeds", "2", "--threads", "1", "--ceiling", "false")
FOUR = (*TINY, "--workers", "2")
TWO = (*FOUR, "--heads", "[rec,full]")
QUIET_SECONDS = 20.0  # of the undisturbed run on two quiet cores
HINT = "Nothing that was finished is lost"


@dataclass(frozen=True)
class Quiet:
    """A working folder in which all four cells have run undisturbed, and how slow the machine is just now."""

    folder: Path
    pace: float  # 1 on two quiet cores, more on a busy machine


@pytest.fixture(scope="module")
def quiet(tmp_path_factory):
    folder = working_folder(tmp_path_factory.mktemp("quiet"))
    began = time.monotonic()
    run = Running(folder, *command(*FOUR))
    assert run.end() == 0, run.said
    assert len(store(folder).results()) == 4
    assert leftovers(folder) == []
    return Quiet(folder, max(1.0, (time.monotonic() - began) / QUIET_SECONDS))


def entries(folder, pattern):
    """Whether there is a file or folder of that pattern, hidden ones included."""
    return any(True for _ in folder.glob(pattern))


SIGNS = {  # of a stage: something is going on
    "start": lambda run: True,
    "record": lambda run: entries(run.folder, "data/episodes/*/*") and not entries(run.folder, "data/frames/*"),
    "render": lambda run: entries(run.folder, "data/frames/.*.building"),
    "cell": lambda run: run.of("cell"),
    "commit": lambda run: entries(run.folder, "data/cells/[!.]*"),
    "report": lambda run: "writing the report" in run.said,
}


# --- one machine, one fault at a time -------------------------------------------------------------------------------


def test_processes_that_stand_still_for_a_while_do_no_harm(quiet, tmp_path):
    """A child is stopped until another cell is finished, then the parent until a child has ended."""
    folder = working_folder(tmp_path, quiet.folder)
    run = Running(folder, *command(*FOUR))
    assert run.until(lambda: run.of("cell"))
    still = run.of("cell")[0]
    run.send(signal.SIGSTOP, still)
    assert run.until(lambda: store(folder).results())
    run.send(signal.SIGCONT, still)
    assert run.until(lambda: run.of("cell"))
    run.send(signal.SIGSTOP, run.process.pid)
    assert run.until(lambda: entries(folder, "data/cells/[!.]*") or not run.of("cell"))
    run.send(signal.SIGCONT, run.process.pid)
    assert run.end() == 0, run.said
    check_like(folder, quiet.folder)


def test_of_two_parents_started_at_once_one_works_and_one_is_told(quiet, tmp_path):
    folder = working_folder(tmp_path, quiet.folder)
    twins = [Running(folder, *command(*TWO)) for _ in range(2)]
    codes = [twin.end() for twin in twins]
    assert sorted(codes) == [0, 2]
    assert "another sweep runs in this folder" in twins[codes.index(2)].said
    check_like(folder, quiet.folder)


def test_damaged_files_are_told_and_made_again(quiet, tmp_path):
    """A frame, a checkpoint and a result that waits to be committed, damaged between two starts."""
    folder = working_folder(tmp_path, quiet.folder)
    (image,) = folder.glob("data/frames/*/encoder/images.npy")
    shutil.copytree(quiet.folder / "data/encoders", folder / "data/encoders")
    for key, at in store(quiet.folder).folders().items():
        shutil.copytree(at, folder / "data/cells" / key)
    damaged = [image, *folder.glob("data/encoders/*"), *folder.glob("data/cells/*/policies.safetensors")]
    assert len(damaged) == 9
    for path in damaged:
        content = bytearray(path.read_bytes())
        content[len(content) // 2] ^= 1
        path.write_bytes(content)
    run = Running(folder, *command(*FOUR))
    assert run.end() == 0, run.said
    assert "damaged frames" in run.said
    assert run.said.count("damaged checkpoint") == 4
    check_like(folder, quiet.folder)


CLOCK = """\
# The clock of a process, off by as many seconds as a file says just now.
import os, time
_time, _time_ns, _shift = time.time, time.time_ns, os.environ["SHIFT"]
def shift():
    with open(_shift) as stream:
        return float(stream.read())
time.time = lambda: _time() + shift()
time.time_ns = lambda: _time_ns() + int(shift() * 1e9)
"""


def test_a_clock_that_jumps_changes_nothing(quiet, tmp_path):
    """Five hours forth while a cell is trained, ten back while the next one is."""
    folder = working_folder(tmp_path / "sweep", quiet.folder)
    (tmp_path / "sitecustomize.py").write_text(CLOCK)
    shift = tmp_path / "shift"
    shift.write_text("0")
    path = os.pathsep.join([str(tmp_path), str(ROOT)])
    run = Running(folder, *command(*TWO, "--workers", "1"), PYTHONPATH=path, SHIFT=str(shift))
    for hours in (5, -5):
        assert run.until(lambda: run.of("cell"))
        first = run.of("cell")
        move(shift, hours)
        run.until(lambda first=first: not set(first) & set(run.of("cell")))
    assert run.end() == 0, run.said
    check_like(folder, quiet.folder)


def move(shift, hours):
    """Set the clock, in one step for whoever looks at it."""
    draft = shift.with_suffix(".draft")
    draft.write_text(str(hours * 3600))
    draft.replace(shift)


def test_a_stopped_sweep_ends_within_five_seconds_and_says_how_to_go_on(quiet, tmp_path):
    """Ctrl-C, which reaches all processes of a terminal, and a batch system's SIGTERM."""
    folder = working_folder(tmp_path, quiet.folder)
    long = ("--recording.duration", "3600", "--recording.warm_up", "0")  # drives that take minutes each
    for words, sign, how, whom in (
        ((*TWO, *long), lambda run: run.of("data"), signal.SIGINT, "all"),
        (TWO, SIGNS["cell"], signal.SIGTERM, "parent"),
        (TWO, SIGNS["cell"], signal.SIGINT, "all"),
    ):
        run = Running(folder, *command(*words))
        assert run.until(lambda run=run, sign=sign: sign(run)), run.said
        began = time.monotonic()
        run.send(how, *(run.family() if whom == "all" else [run.process.pid]))
        assert run.end() == 130
        assert time.monotonic() - began < 5 * quiet.pace
        assert HINT in run.said
        assert "Traceback" not in run.said
    run = Running(folder, *command(*TWO))
    assert run.end() == 0, run.said
    check_like(folder, quiet.folder)


# --- a full disk ----------------------------------------------------------------------------------------------------


class SmallDisk:
    """A tmpfs that can be filled and emptied while a command works on it."""

    def __init__(self, folder):
        self.folder, self.ballast = folder, folder / "ballast"
        folder.mkdir()
        mount = ["mount", "-t", "tmpfs", "-o", "size=256m", "study", str(folder)]
        if subprocess.run(mount, check=False, capture_output=True).returncode != 0:
            pytest.skip("mounting a small disk needs root")

    def fill(self):
        with suppress(OSError), self.ballast.open("ab", buffering=0) as stream:
            for size in (1 << 20, 1 << 12):
                while stream.write(bytes(size)) == size:
                    pass

    def empty(self):
        self.ballast.unlink(missing_ok=True)

    def remove(self):
        subprocess.run(["umount", "--lazy", str(self.folder)], check=True)


@pytest.fixture
def disk(tmp_path):
    made = SmallDisk(tmp_path / "disk")
    yield made
    made.remove()


def test_a_full_disk_is_told_at_every_stage_and_costs_nothing(quiet, disk, tmp_path):
    working_folder(disk.folder)
    for stage in ("record", "render", "cell", "commit"):
        run = Running(disk.folder, *command(*TWO), log=tmp_path / "log")
        assert run.until(lambda run=run, stage=stage: SIGNS[stage](run)), run.said
        disk.fill()
        assert run.end() in (1, 2)
        assert re.search("No space left|disk is full", run.said), run.said
        if stage in ("record", "render"):
            assert "Traceback" not in run.said
        disk.empty()
    run = Running(disk.folder, *command(*TWO), log=tmp_path / "log")
    assert run.end() == 0, run.said
    check_like(disk.folder, quiet.folder)
