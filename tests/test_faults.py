"""Sweeps that are killed, stopped, starved and fed with garbage end like one that was left alone."""

import os
import random
import re
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from contextlib import suppress
from typing import ClassVar

import pytest

from running import FOUR, ROOT, Running, Store, check_like, command, leftovers, store, working_folder
from servers import TrackingServer

pytestmark = pytest.mark.slow

TWO = (*FOUR, "--heads", "[rec,full]")
EIGHT = (*FOUR, "--encoder_seeds", "2")
HINT = "Nothing that was finished is lost"


# --- the storm ------------------------------------------------------------------------------------------------------


def entries(folder, pattern):
    """Whether there is a file or folder of that pattern, hidden ones included."""
    return any(True for _ in folder.glob(pattern))


def made(run, pattern):
    """Whether children make data now, and something of that pattern is there."""
    return run.of("data") and entries(run.folder, pattern)


SIGNS = {  # of a stage: something is going on
    "start": lambda run: True,
    "record": lambda run: made(run, "data/episodes/*/*") and not entries(run.folder, "data/frames/*"),
    "render": lambda run: made(run, "data/frames/.*.building"),
    "cell": lambda run: run.of("cell"),
    "commit": lambda run: "cells finished" in run.said and entries(run.folder, "data/cells/[!.]*"),
    "report": lambda run: "writing the report" in run.said,
}


def gone_by(run, stage):
    """Whether the data came too fast to be hit: cells run, which are to be hit in their turn."""
    return stage in {"record", "render"} and run.of("cell")


LENGTH = {"start": 3.0, "record": 1.0, "render": 0.6, "cell": 0.8, "commit": 0.4, "report": 2.0}  # [s] after the sign
STORM = 30  # kills at least
BLOWS = (  # stage, who is killed, how often; in the order in which a sweep gets there
    (("start", "parent", 1), ("record", "parent", 1), ("record", "data", 2)),
    (("render", "parent", 1), ("render", "data", 2)),
    (
        ("start", "parent", 1),
        ("cell", "cell", 12),
        ("cell", "server", 2),
        ("cell", "parent", 2),
    ),
    (("commit", "parent", 2),),
    (("report", "parent", 1),),
)


def test_a_storm_of_kills_changes_nothing(quiet, tmp_path):
    """SIGKILL at random moments of every stage, to the parent and to each kind of child."""
    rng = random.Random("storm")
    folder = working_folder(tmp_path)
    run = Running(folder, *command(*FOUR), "--no-report")
    kills, kept = Counter(), set()
    for phase in BLOWS:
        blows = [(stage, role) for stage, role, times in phase for _ in range(times)]
        rng.shuffle(blows)
        while blows:
            stage, role = blows[-1]
            if not run.running:
                run = Running(folder, *command(*FOUR), *([] if stage == "report" else ["--no-report"]))
            if not run.until(lambda run=run, stage=stage: SIGNS[stage](run) or gone_by(run, stage)):
                if run.end() == 0 and stage != "report":  # nothing is left that could be hit there
                    break
                continue
            if gone_by(run, stage):
                break
            time.sleep(rng.uniform(0, LENGTH[stage]))
            if sent := run.send(signal.SIGKILL, *run.of(role)):
                kills[f"{stage}: {role}"] += sent
                blows.pop()
            if role == "parent":
                run.end()
                found = set(store(folder).folders())
                assert kept <= found, "a finished cell was lost"
                kept = found
            if stage == "report" and not blows and kills.total() < STORM:
                blows.append((stage, role))
    run.end()
    run = Running(folder, *command(*FOUR))
    assert run.end() == 0, run.said
    print("kills", dict(kills), "runs of cells", dict(store(folder).cells()))
    assert kills.total() >= STORM
    check_like(folder, quiet.folder)


# --- one machine, one fault at a time -------------------------------------------------------------------------------


def test_processes_that_stand_still_for_a_while_do_no_harm(quiet, tmp_path):
    """A child is stopped until another cell is finished, then the parent until a child has ended."""
    folder = quiet.copy(tmp_path)
    run = Running(folder, *command(*TWO))
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
    folder = quiet.copy(tmp_path)
    twins = [Running(folder, *command(*TWO)) for _ in range(2)]
    codes = [twin.end() for twin in twins]
    assert sorted(codes) == [0, 2]
    assert "another sweep runs in this folder" in twins[codes.index(2)].said
    check_like(folder, quiet.folder)


def test_damaged_files_are_told_and_made_again(quiet, tmp_path):
    """A frame, a checkpoint and a result that waits to be committed, damaged between two starts."""
    folder = quiet.copy(tmp_path)
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
    folder = quiet.copy(tmp_path / "sweep")
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
    folder = quiet.copy(tmp_path)
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


# --- many machines --------------------------------------------------------------------------------------------------


class Lab:
    """Two sweeps started at once and a worker, each with a working folder of its own, around one queue and server."""

    modules: ClassVar = {"one": "study.sweep", "two": "study.sweep", "three": "study.worker"}

    def __init__(self, folder, quiet, *words):
        self.where = {name: quiet.copy(folder / name) for name in self.modules}
        self._words, self._rng = words, random.Random("lab")
        self.kills = Counter()
        self.crew = {name: self._begin(name) for name in self.modules}

    def _begin(self, name):
        return Running(self.where[name], sys.executable, "-m", self.modules[name], *EIGHT, *self._words)

    def begin_again(self, name):
        self.crew[name].end()
        self.crew[name] = self._begin(name)

    def await_cell(self, name):
        assert self.crew[name].until(lambda: self.crew[name].of("cell")), self.crew[name].said

    def kill(self, name, role):
        """Kill a child, or a sweep's or worker's process."""
        self.kills[f"{self.modules[name]}: {role}"] += self.crew[name].send(signal.SIGKILL, *self.crew[name].of(role))

    def hit(self, name, role):
        """The same soon after a cell was begun."""
        self.await_cell(name)
        time.sleep(self._rng.uniform(0, LENGTH["cell"]))
        self.kill(name, role)


def test_a_shared_queue_survives_kills_stops_and_lost_servers(quiet, postgres, tmp_path):
    alone = shutil.copytree(quiet.folder, tmp_path / "alone")  # four of the eight are there
    undisturbed = Running(alone, *command(*EIGHT))
    queue, database = postgres.uri(), postgres.uri()
    server = TrackingServer(tmp_path / "server", database)
    kept = Store(database, tmp_path / "server/files")
    grace = str(round(3 + 2 * quiet.pace))
    lab = Lab(tmp_path, quiet, "--queue", queue, "--tracking", server.uri, "--grace", grace, "--workers", "1")
    try:
        lab.hit("one", "cell")
        lab.hit("two", "cell")
        lab.await_cell("three")
        postgres.stop()
        lab.kill("three", "cell")
        server.stop()
        time.sleep(2)
        postgres.start()
        server.start()

        # One that has a cell stands still until the others have finished all.
        lab.await_cell("two")
        family = list(lab.crew["two"].family())
        lab.crew["two"].send(signal.SIGSTOP, *family)
        finished = set()
        for name in ("one", "three"):
            lab.hit(name, "parent")
            lab.begin_again(name)
            assert finished <= set(kept.folders()), "a finished cell was lost"
            finished = set(kept.folders())
        if any(lab.crew[name].end() for name in ("one", "three")):
            # Three of the kills have hit the same cell, which is then given up, and told; the same command takes it up.
            assert "the process that ran it is gone" in lab.crew["one"].said
            lab.begin_again("one")
        assert lab.crew["one"].end() == 0, lab.crew["one"].said
        assert len(kept.folders()) == 8
        lab.crew["two"].send(signal.SIGCONT, *family)
        assert lab.crew["two"].end() == 0, lab.crew["two"].said

        assert undisturbed.end() == 0, undisturbed.said
        print("kills", dict(lab.kills), "runs of cells", dict(kept.cells()))
        assert lab.kills.total() >= 4
        for name in ("one", "two"):
            check_like(lab.where[name], alone, kept)
        assert leftovers(lab.where["three"]) == []
        assert not any(postgres.password in path.read_text() for path in tmp_path.glob("*/log"))
    finally:
        server.stop()
        for run in (undisturbed, *lab.crew.values()):
            run.send(signal.SIGKILL, *run.family())
