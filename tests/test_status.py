"""How far a sweep is, as others see it."""

import json
import os
import platform
import shutil

import pytest

from study.planning.plan import make_plan
from study.sweep.__main__ import main
from study.sweep.status import SILENT, cell_statuses, heard_again, seconds_left
from study.tracking.reader import Attempt
from study.tracking.tracker import Tracker
from tests.support.processes import ROOT, sweep

NOW = 1_800_000_000.0
PLAN = make_plan("heads", "laptop", {}, {})
FIRST, *OTHERS = PLAN.cells
GONE = 2**22 + 1  # no process has a number beyond pid_max


def attempt(status, quiet=0.0, host="elsewhere", **more):
    tags = {"host": host, "process": str(GONE), "alive": str(int((NOW - quiet) * 1000))} | more.pop("tags", {})
    return Attempt("r", status, int((NOW - 600) * 1000), tags, more)


def state(*attempts):
    return cell_statuses(PLAN, {FIRST: attempts}, NOW)[0]


def left(attempts):
    return seconds_left(PLAN, cell_statuses(PLAN, attempts, NOW), NOW, frames_ready=True)


@pytest.mark.parametrize(
    ("attempts", "expected"),
    [
        ([], "waiting"),
        ([attempt("FINISHED"), attempt("KILLED")], "finished"),
        ([attempt("FAILED"), attempt("RUNNING")], "running"),
        ([attempt("RUNNING"), attempt("FAILED")], "failed"),
        ([attempt("KILLED")], "waiting"),
        ([attempt("RUNNING", quiet=SILENT + 1)], "silent"),
    ],
)
def test_a_cell_is_what_its_attempts_say(attempts, expected):
    assert state(*attempts).state == expected


def test_a_running_cell_tells_where_since_when_and_how_far():
    cell_state = state(attempt("RUNNING", tags={"progress": "encoder 26/120", "device": "CPU"}))
    assert (cell_state.host, cell_state.process, cell_state.device) == ("elsewhere", str(GONE), "CPU")
    assert (cell_state.stage, cell_state.epoch, cell_state.epochs) == ("encoder", 3, 12)
    assert cell_state.since == NOW - 600


@pytest.mark.parametrize("difference", [-200.0, 200.0])
def test_a_clock_that_differs_by_minutes_makes_no_live_machine_silent(difference):
    def seen(at):
        return {FIRST: [attempt("RUNNING", quiet=difference - at)]}

    cells = cell_statuses(PLAN, heard_again(seen(0), seen(6), NOW), NOW)
    assert cells[0].state == "running"
    assert seconds_left(PLAN, cells, NOW - 1000, frames_ready=True) > 0
    still = cell_statuses(PLAN, heard_again(seen(0), seen(0), NOW), NOW)
    assert still[0].state == "silent"


def test_the_options_of_the_sweep_that_is_looked_at_are_accepted(tmp_path, capsys):
    words = ["--workers", "2", "--threads", "1", "--device", "cuda:7", "--cluster", "tls://far:8786", "--wait"]
    uri = f"sqlite:///{tmp_path}/none.db"
    assert main(["status", "heads", *words, "--retry-failed", "--no-report", "--tracking", uri]) == 0
    assert "0 of" in capsys.readouterr().out


def test_of_a_traceback_the_line_that_says_something_is_shown():
    message = "Traceback (most recent call last):\n  File ...\nValueError: no room\n"
    assert state(attempt("FAILED", tags={"reason": message})).reason == "ValueError: no room"
    assert state(attempt("FAILED", tags={"reason": "the loss is nan\nat step 3"})).reason == "the loss is nan"


def test_what_is_left_follows_what_was_measured_and_how_many_run():
    nothing = left({})
    slow = {FIRST: [attempt("FINISHED", **{"seconds/cell": 1e5})]}
    assert 0 < nothing < left(slow)
    running = {key: [attempt("RUNNING")] for key in OTHERS[:2]}
    assert left(running) == pytest.approx(nothing / 2)
    assert left({key: [attempt("FINISHED")] for key in PLAN.cells}) == 0


def test_where_nothing_was_tracked_all_cells_wait_and_nothing_is_made(tmp_path):
    (tmp_path / "sweeps").symlink_to(ROOT / "sweeps")
    done = sweep(tmp_path, "status", "heads")
    title, frames, *lines = done.stdout.splitlines()
    count = len(PLAN.cells)
    assert f"0 of {count} cells finished, {count} waiting" in title
    assert "not made yet" in frames
    assert [line.split()[-1] for line in lines] == ["waiting"] * count
    assert [path.name for path in tmp_path.iterdir()] == ["sweeps"]


def test_a_store_without_sweeps_is_left_as_it_is(tmp_path, empty_store, capsys):
    uri = f"sqlite:///{shutil.copy(empty_store, tmp_path)}"
    tracker = Tracker(uri, "another")
    assert main(["status", "heads", "--tracking", uri, "--json"]) == 0
    assert {cell["state"] for cell in json.loads(capsys.readouterr().out)["cells"]} == {"waiting"}
    assert tracker.client.get_experiment_by_name("study") is None

    tracker = Tracker(uri)
    sweep = tracker.open_sweep(PLAN.grid, PLAN.profile, PLAN.settings, PLAN.cells, {}, {})
    run = tracker.start_cell(sweep, PLAN.cells[FIRST], FIRST, PLAN.settings, PLAN.grid.policy_seeds)
    run.note(device="CPU")
    run.progress("policy", 7, 100)
    run.flush_live()
    assert main(["status", "heads", "--tracking", uri, "--json"]) == 0
    cell = json.loads(capsys.readouterr().out)["cells"][0]
    assert (cell["state"], cell["stage"], cell["epoch"], cell["device"]) == ("running", "policy", 7, "CPU")
    assert (cell["host"], cell["process"]) == (platform.node(), str(os.getpid()))
    tracker.interrupt(run)
