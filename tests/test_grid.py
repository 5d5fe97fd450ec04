"""The queue hands out every wanted cell once, whatever happened before, on SQLite and on PostgreSQL alike."""

import socket
import subprocess
import sys
import threading
import time
import urllib.request
from pathlib import Path

import optuna
import pytest

from servers import LOOPBACK, free_port
from study.config import BadInputError, Cell
from study.grid import TRIES, Queue, QueueLostError

CELLS = {"k1": Cell(heads="rec"), "k2": Cell(heads="full"), "k3": Cell(heads="full", encoder_seed=1_000_001)}
GRACE = 2


@pytest.fixture
def local(tmp_path):
    return f"sqlite:///{tmp_path}/queue.db"


@pytest.fixture(params=["sqlite", "postgresql"])
def storage(request):
    return request.getfixturevalue("local" if request.param == "sqlite" else "database")


def planned(storage, keys=tuple(CELLS), **how):
    queue = Queue("q", CELLS, storage, GRACE)
    queue.plan(keys, **how)
    return queue


def drain(queue):
    keys = []
    while ticket := queue.take():
        keys.append(ticket.key)
        queue.done(ticket, 0.5)
    return keys


def states(storage):
    """How many trials there are, by state."""
    trials = optuna.load_study(study_name="q", storage=storage).get_trials()
    return sorted(trial.state.name for trial in trials)


def test_each_planned_cell_is_handed_out_once(storage):
    queue = planned(storage)
    assert drain(queue) == list(CELLS)
    assert queue.take() is None


def test_planning_twice_does_not_double_a_cell(storage):
    planned(storage)
    assert sorted(drain(planned(storage))) == list(CELLS)


def test_what_another_sweep_has_finished_is_not_handed_out(storage):
    planned(storage)
    assert drain(planned(storage, ["k2"])) == ["k2"]


def test_a_cell_that_failed_in_passing_waits_again_and_is_given_up_after_the_last_try(storage):
    queue = planned(storage, ["k1"])
    for left in reversed(range(TRIES)):
        assert queue.failed == {}
        assert queue.fail(queue.take(), "no room", passing=True) == bool(left)
        queue.plan(["k1"])
    assert queue.failed == {"k1": "no room"}
    assert queue.take() is None


def test_what_was_given_up_after_all_tries_is_tried_again_by_the_next_start(storage):
    queue = planned(storage, ["k1"])
    for _ in range(TRIES):
        queue.fail(queue.take(), "no room", passing=True)
        queue.plan(["k1"])
    assert planned(storage, ["k1"]).take() is None  # a worker that joins does not start anew
    assert drain(planned(storage, ["k1"], restart=True)) == ["k1"]


def test_a_hopeless_cell_is_listed_until_it_is_asked_for(storage):
    queue = planned(storage, ["k1"])
    assert not queue.fail(queue.take(), "loss is not finite", passing=False)
    again = planned(storage, ["k1"], restart=True)
    assert again.failed == {"k1": "loss is not finite"}
    assert again.take() is None
    asked = planned(storage, ["k1"], restart=True, retry_failed=True)
    assert asked.failed == {}
    assert drain(asked) == ["k1"]


def test_stopping_on_purpose_costs_no_try(storage):
    queue = planned(storage, ["k1"])
    for _ in range(2 * TRIES):
        queue.stopped(queue.take())
        queue.plan(["k1"])
    assert drain(queue) == ["k1"]


def test_a_finished_cell_whose_result_was_deleted_waits_again(storage):
    assert drain(planned(storage, ["k1"])) == ["k1"]
    assert drain(planned(storage, ["k1"])) == ["k1"]


def test_reasons_hold_no_credentials(storage):
    queue = planned(storage, ["k1"])
    queue.fail(queue.take(), "no answer from postgresql://me:secret@host/db?password=secret", passing=False)
    queue.plan(["k1"])
    assert "secret" not in queue.failed["k1"]


# --- one machine ----------------------------------------------------------------------------------------------------


def test_a_cell_that_a_killed_process_held_waits_again(local):
    planned(local).take()
    assert sorted(drain(planned(local))) == list(CELLS)


def test_planning_again_leaves_the_cells_that_run_here(local):
    queue = planned(local)
    ticket = queue.take()
    queue.plan(list(CELLS))
    assert queue.hold(ticket) is ticket
    assert ticket.key not in drain(queue)


def test_a_foreign_file_is_refused(tmp_path):
    path = tmp_path / "queue.db"
    path.write_text("this is no database, and it is long enough to look like one" * 20)
    with pytest.raises(BadInputError, match=r"queue\.db"):
        Queue("q", CELLS, f"sqlite:///{path}")


def test_a_queue_of_another_kind_is_refused():
    with pytest.raises(BadInputError, match="postgresql://user@host/database") as caught:
        Queue("q", CELLS, "mysql://me:secret@host/db")
    assert "secret" not in str(caught.value)


# --- many machines --------------------------------------------------------------------------------------------------


def test_queues_opened_at_once_on_an_empty_database_share_the_cells(database):
    taken, troubles = [], []
    start = threading.Barrier(4)

    def work():
        try:
            start.wait()
            queue = planned(database)
            while ticket := queue.take():  # and held: of what is done already, MLflow tells
                taken.append(ticket.key)
        except Exception as error:  # noqa: BLE001 - shown below
            troubles.append(error)

    threads = [threading.Thread(target=work) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert troubles == []
    assert sorted(taken) == list(CELLS)


def test_of_two_trials_of_a_cell_one_is_handed_out(database):
    one, two = planned(database, ["k1"]), Queue("q", CELLS, database, GRACE)
    two._enqueue("k1", 1)  # as a process does that has looked before the other enqueued
    assert states(database) == ["WAITING", "WAITING"]
    assert one.take() is not None
    assert two.take() is None
    assert states(database) == ["PRUNED", "RUNNING"]


def test_a_dead_workers_cell_waits_again_after_the_grace_period_and_the_try_counts(database):
    dead, other = planned(database, ["k1"]), planned(database, ["k1"])
    assert dead.take().attempt == 1
    dead.close()  # no heartbeat any more
    other.plan(["k1"])
    assert other.take() is None
    time.sleep(GRACE + 0.7)
    other.plan(["k1"])
    assert other.take().attempt == 2


def test_a_living_workers_cell_stays_its_own(database):
    living, other = planned(database, ["k1"]), planned(database, ["k1"])
    ticket = living.take()
    time.sleep(GRACE + 0.7)
    other.plan(["k1"])
    assert other.take() is None
    assert living.hold(ticket) is ticket


def test_a_worker_that_was_away_too_long_takes_its_cell_up_again_or_lets_it_go(database):
    away, other = planned(database, ["k1"]), planned(database, ["k1"])
    ticket = away.take()
    away.close()
    time.sleep(GRACE + 0.7)
    other.plan(["k1"])
    again = away.hold(ticket)
    assert again is not None
    assert again.number != ticket.number
    time.sleep(GRACE + 0.7)
    other.plan(["k1"])
    taken = other.take()
    assert away.hold(again) is None
    away.done(again, 0.1)  # too late, and without harm
    assert other.hold(taken) is taken


def test_a_server_that_was_restarted_is_used_again(postgres, database):
    queue = planned(database)
    first = queue.take()
    postgres.stop()
    try:
        with pytest.raises(QueueLostError, match="gave no usable answer") as caught:
            queue.take()
        assert postgres.password not in str(caught.value)
    finally:
        postgres.start()
    queue.done(first, 0.5)
    assert [first.key, *drain(queue)] == list(CELLS)


def test_a_wrong_password_is_one_clear_error_without_it(postgres, database):
    with pytest.raises(BadInputError, match="password authentication failed") as caught:
        Queue("q", CELLS, database.replace(postgres.password, "wrong-secret"))
    assert "wrong-secret" not in str(caught.value)


def test_the_password_may_come_from_the_environment(postgres, database, monkeypatch):
    monkeypatch.setenv("PGPASSWORD", postgres.password)
    assert drain(planned(database.replace(f":{postgres.password}", ""), ["k1"])) == ["k1"]


@pytest.mark.slow
def test_optuna_dashboard_opens_on_the_queue(storage, tmp_path):
    queue = planned(storage)
    queue.done(queue.take(), 0.5)
    port = free_port()
    words = ["optuna_dashboard", storage, "--host", LOOPBACK, "--port", str(port)]
    process = subprocess.Popen(
        [Path(sys.executable).with_name("optuna-dashboard"), *words[1:]],
        cwd=tmp_path,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        assert '"study_name": "q"' in _page(port, process)
    finally:
        process.terminate()
        process.wait(20)


def _page(port, process):
    while process.poll() is None:
        try:
            with socket.create_connection((LOOPBACK, port), 1):
                break
        except OSError:
            time.sleep(0.2)
    with urllib.request.urlopen(f"http://{LOOPBACK}:{port}/api/studies", timeout=60) as answer:
        return answer.read().decode()
