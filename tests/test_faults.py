"""Sweeps that are killed, stopped, starved and fed with garbage end like one that was left alone."""

import os
import random
import re
import shutil
import signal
import subprocess
import time
from collections import Counter
from contextlib import suppress

import pytest

from tests.support.processes import ROOT, CommandProcess, sweep_command
from tests.support.run_database import RunDatabase, run_database
from tests.support.servers import TrackingServer
from tests.support.sweeps import FOUR_CELLS, assert_same_outcome, working_folder

pytestmark = pytest.mark.stress

TWO = (*FOUR_CELLS, "--heads", "[rec,full]")
HINT = "Nothing that was finished is lost"


# --- the storm ------------------------------------------------------------------------------------------------------


def entries(folder, pattern):
    """Return whether a file or folder matches the pattern, hidden ones included."""
    return any(True for _ in folder.glob(pattern))


def has_cells(run):
    """Return whether a cell has started."""
    return run_database(run.folder).cell_counts()["RUNNING"] > 0


SIGNS = {  # of a stage: something of it is going on
    "start": lambda run: True,
    "engine": lambda run: run.pids("worker"),
    "record": lambda run: entries(run.folder, "data/episodes/*/*") and not entries(run.folder, "data/frames/*"),
    "render": lambda run: entries(run.folder, "data/frames/.*.building"),
    "encoder": lambda run: run.pids("worker") and has_cells(run),
    "policy": lambda run: run.pids("worker") and entries(run.folder, "data/products/encoder-*") and has_cells(run),
    "commit": lambda run: entries(run.folder, "data/products/policies-*"),
    "report": lambda run: "writing the report" in run.output,
}
LENGTH = {"start": 2.0, "engine": 2.0, "record": 1.0, "render": 0.6, "report": 2.0}  # [s] after the sign; else 0.8
BLOWS = (  # stage, who is killed, how often; in the order in which a sweep gets there
    (("start", "client", 2), ("engine", "worker", 4), ("engine", "client", 2)),
    (("record", "client", 2), ("record", "worker", 3)),
    (("render", "client", 2), ("render", "worker", 3)),
    (("encoder", "worker", 6), ("encoder", "client", 3), ("policy", "worker", 6), ("policy", "client", 3)),
    (("commit", "client", 3), ("commit", "worker", 2)),
    (("report", "client", 2),),
)
STORM = 40  # kills at least
LATER = {"record": "data/frames/*/manifest.json", "render": "data/frames/*/manifest.json"}  # the stage is over


def test_a_storm_of_kills_changes_nothing(undisturbed, tmp_path):  # noqa: C901 - one story
    """SIGKILL at random moments of every stage, to the client and to workers."""
    rng = random.Random("storm")
    folder = working_folder(tmp_path)
    kills, finished_before, run = Counter(), set(), None
    for phase in BLOWS:
        blows = [(stage, role) for stage, role, times in phase for _ in range(times)]
        rng.shuffle(blows)
        while blows:
            stage, role = blows[-1]
            if run is None or not run.running:
                run = CommandProcess(
                    folder, *sweep_command(*FOUR_CELLS), *([] if stage == "report" else ["--no-report"])
                )

            def over(stage=stage):
                return stage in LATER and entries(folder, LATER[stage])

            def sign(run=run, stage=stage, over=over):
                return over() or SIGNS[stage](run)

            if not run.wait_for(sign):
                if run.wait() == 0 and stage != "report":  # every cell is finished: nothing is left to be hit there
                    for path in ("mlruns/mlflow.db", "data/products", "data/encoders"):
                        remove(folder / path)
                    finished_before = set()
                continue
            if over():
                for path in folder.glob("data/frames/*"):
                    remove(path)
                run.send(signal.SIGKILL, *run.roles())
                run.wait()
                if stage == "record":
                    remove(folder / "data/episodes")
                continue
            time.sleep(rng.uniform(0, LENGTH.get(stage, 0.8)))
            if sent := run.send(signal.SIGKILL, *run.pids(role)[:1]):
                kills[f"{stage}: {role}"] += sent
                blows.pop()
            if role == "client":
                run.wait()
                finished = set(run_database(folder).result_folders())
                assert finished_before <= finished, "a finished cell was lost"
                finished_before = finished
    if run is not None:
        run.wait()
    run = CommandProcess(folder, *sweep_command(*FOUR_CELLS))
    assert run.wait() == 0, run.output
    print("kills", dict(kills), "runs of cells", dict(run_database(folder).cell_counts()))
    assert kills.total() >= STORM
    assert_same_outcome(folder, undisturbed.folder)


def remove(path):
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


# --- one fault at a time --------------------------------------------------------------------------------------------


def test_a_client_that_stands_still_for_a_while_does_no_harm(undisturbed, tmp_path):
    folder = undisturbed.copy(tmp_path)
    run = CommandProcess(folder, *sweep_command(*TWO))
    assert run.wait_for(lambda: has_cells(run)), run.output
    run.send(signal.SIGSTOP, run.process.pid)
    time.sleep(15)
    run.send(signal.SIGCONT, run.process.pid)
    assert run.wait() == 0, run.output
    assert_same_outcome(folder, undisturbed.folder)


def test_of_two_clients_started_at_once_one_works_and_one_is_refused(undisturbed, tmp_path):
    folder = undisturbed.copy(tmp_path)
    twins = [CommandProcess(folder, *sweep_command(*TWO), log=tmp_path / f"log{number}") for number in range(2)]
    codes = [twin.wait() for twin in twins]
    assert sorted(codes) == [0, 2]
    assert "another sweep" in twins[codes.index(2)].output
    assert_same_outcome(folder, undisturbed.folder)


def test_a_second_client_waits_with_the_option(undisturbed, tmp_path):
    folder = undisturbed.copy(tmp_path)
    twins = [
        CommandProcess(folder, *sweep_command(*TWO), "--wait", log=tmp_path / f"log{number}") for number in range(2)
    ]
    assert [twin.wait() for twin in twins] == [0, 0]
    assert sum("waiting for another sweep" in twin.output for twin in twins) == 1
    assert_same_outcome(folder, undisturbed.folder)


POISON = """\
# A cell that kills whoever trains its encoder.
import importlib.util, os, signal, sys
class Finder:
    def find_spec(self, name, path=None, target=None):
        if name != "study.encoder.training":
            return None
        sys.meta_path.remove(self)
        spec = importlib.util.find_spec(name)
        execute = spec.loader.exec_module
        def exec_module(module):
            execute(module)
            train = module.train_encoder
            def train_encoder(frames, heads, *rest, **named):
                if heads == "rec+pred":
                    os.kill(os.getpid(), signal.SIGKILL)
                return train(frames, heads, *rest, **named)
            module.train_encoder = train_encoder
        spec.loader.exec_module = exec_module
        return spec
sys.meta_path.insert(0, Finder())
"""


def test_a_cell_that_kills_its_worker_is_given_up_and_the_others_finish(undisturbed, tmp_path):
    folder = undisturbed.copy(tmp_path / "sweep")
    (tmp_path / "sitecustomize.py").write_text(POISON)
    path = os.pathsep.join([str(tmp_path), str(ROOT)])
    run = CommandProcess(folder, *sweep_command(*FOUR_CELLS), "--no-report", PYTHONPATH=path)
    code = run.wait()
    assert code == 1, run.output
    assert "failed: rec+pred 100% e0" in run.output
    assert "killed 3 times" in run.output
    assert len(run_database(folder).digests()) == 3
    run = CommandProcess(folder, *sweep_command(*FOUR_CELLS))  # without the poison, the same command trains it
    assert run.wait() == 0, run.output
    assert_same_outcome(folder, undisturbed.folder)


def test_damaged_files_are_reported_and_rebuilt(undisturbed, tmp_path):
    """A frame, a checkpoint and a kept product, damaged between two starts."""
    folder = undisturbed.copy(tmp_path)
    (image,) = folder.glob("data/frames/*/encoder/images.npy")
    for name in ("encoders", "products"):
        shutil.copytree(undisturbed.folder / "data" / name, folder / "data" / name)
    damaged = [image, *folder.glob("data/encoders/*"), *folder.glob("data/products/*/weights.safetensors")]
    assert len(damaged) == 9
    for path in damaged:
        content = bytearray(path.read_bytes())
        content[len(content) // 2] ^= 1
        path.write_bytes(content)
    run = CommandProcess(folder, *sweep_command(*FOUR_CELLS))
    assert run.wait() == 0, run.output
    assert "damaged frames" in run.output
    assert run.output.count("damaged checkpoint") == 4
    assert_same_outcome(folder, undisturbed.folder)


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


def test_a_clock_that_is_set_forward_or_back_changes_no_result(undisturbed, tmp_path):
    """Five hours forward while a cell is trained, then ten back, which Dask does not survive."""
    folder = undisturbed.copy(tmp_path / "sweep")
    (tmp_path / "sitecustomize.py").write_text(CLOCK)
    shift = tmp_path / "shift"
    shift.write_text("0")
    path = os.pathsep.join([str(tmp_path), str(ROOT)])
    run = CommandProcess(folder, *sweep_command(*TWO, "--workers", "1"), PYTHONPATH=path, SHIFT=str(shift))
    assert run.wait_for(lambda: has_cells(run)), run.output
    move(shift, 5)
    assert run.wait_for(lambda: run_database(folder).digests()), run.output
    move(shift, -5)
    assert run.wait() == 2, run.output
    assert "clock was set back by" in run.output
    assert "Traceback" not in run.output
    run = CommandProcess(folder, *sweep_command(*TWO, "--workers", "1"), PYTHONPATH=path, SHIFT=str(shift))
    assert run.wait() == 0, run.output
    assert_same_outcome(folder, undisturbed.folder)


def move(shift, hours):
    """Set the clock, atomically for its readers."""
    draft = shift.with_suffix(".draft")
    draft.write_text(str(hours * 3600))
    draft.replace(shift)


def recording(run):
    """Return whether drives were being recorded, in this run or an earlier one."""
    return entries(run.folder, "data/episodes/*/.lock")


def test_a_stopped_sweep_ends_within_five_seconds_and_says_how_to_go_on(undisturbed, tmp_path):
    """Ctrl-C, which reaches all processes of a terminal, and a batch system's SIGTERM, at any moment from the start."""
    folder = undisturbed.copy(tmp_path)
    rng = random.Random("stop")
    drives = ("--recording.duration", "3600", "--recording.warm_up", "0")  # drives that take minutes each
    epochs = ("--encoder.epochs", "3000")
    for words, sign, how, whom in (
        ((*TWO, *drives), lambda run: "cells finished" in run.output, signal.SIGINT, "all"),
        ((*TWO, *drives), lambda run: run.pids("worker"), signal.SIGINT, "all"),
        ((*TWO, *drives), lambda run: recording(run) and "cells finished" in run.output, signal.SIGTERM, "client"),
        ((*TWO, *epochs), has_cells, signal.SIGTERM, "client"),
        ((*TWO, *epochs), has_cells, signal.SIGINT, "all"),
        ((*TWO, *epochs), lambda run: run.pids("worker"), signal.SIGINT, "all"),
    ):
        run = CommandProcess(folder, *sweep_command(*words))
        assert run.wait_for(lambda run=run, sign=sign: sign(run)), run.output
        time.sleep(rng.uniform(0, 1))
        began = time.monotonic()
        run.send(how, *(run.roles() if whom == "all" else [run.process.pid]))
        assert run.wait() == 130, run.output
        assert time.monotonic() - began < 5 * undisturbed.slowdown
        assert HINT in run.output
        assert "Traceback" not in run.output
        assert "leaked" not in run.output
    run = CommandProcess(folder, *sweep_command(*TWO))
    assert run.wait() == 0, run.output
    assert_same_outcome(folder, undisturbed.folder)


def test_a_tracking_server_that_is_away_for_a_while_costs_nothing(undisturbed, tmp_path):
    folder = undisturbed.copy(tmp_path / "sweep")
    server = TrackingServer(tmp_path / "server", f"sqlite:///{tmp_path}/server.db")
    try:
        run = CommandProcess(folder, *sweep_command(*TWO), "--tracking", server.uri)
        database = RunDatabase(tmp_path / "server.db", tmp_path / "server/files")
        assert run.wait_for(lambda: database.cell_counts()["RUNNING"]), run.output
        server.stop()
        time.sleep(20)
        server.start()
        assert run.wait() == 0, run.output
        assert_same_outcome(folder, undisturbed.folder, database)
    finally:
        server.stop()


# --- a full disk ----------------------------------------------------------------------------------------------------


FULL = re.compile("No space left|disk is full|make room|are needed; waiting")


class SmallDisk:
    """Mounts a tmpfs that can be filled and emptied while a command works on it."""

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
    small_disk = SmallDisk(tmp_path / "disk")
    yield small_disk
    small_disk.remove()


def test_a_full_disk_is_reported_at_every_stage_and_costs_nothing(undisturbed, disk, tmp_path):
    working_folder(disk.folder)
    for stage in ("record", "render", "encoder", "commit"):
        for name in ("data", "mlruns", "reports"):  # the last one may have gone on to its end
            shutil.rmtree(disk.folder / name, ignore_errors=True)
        run = CommandProcess(disk.folder, *sweep_command(*TWO), log=tmp_path / "log")
        assert run.wait_for(lambda run=run, stage=stage: SIGNS[stage](run)), run.output
        disk.fill()
        run.wait_for(lambda run=run: FULL.search(run.output))
        assert FULL.search(run.output), run.output
        disk.empty()
        assert run.wait() in (0, 1, 2), run.output  # those that waited go on
        if stage in ("record", "render"):
            assert "Traceback" not in run.output
    run = CommandProcess(disk.folder, *sweep_command(*TWO), log=tmp_path / "log")
    assert run.wait() == 0, run.output
    assert_same_outcome(disk.folder, undisturbed.folder)
