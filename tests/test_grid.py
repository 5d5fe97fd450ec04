"""The queue hands out every wanted cell once, whatever happened before."""

import pytest

from study.config import BadInputError, Cell
from study.grid import Queue

CELLS = {"k1": Cell(heads="rec"), "k2": Cell(heads="full"), "k3": Cell(heads="full", encoder_seed=1_000_001)}


@pytest.fixture
def storage(tmp_path):
    return f"sqlite:///{tmp_path}/queue.db"


def drain(queue):
    keys = []
    while ticket := queue.take():
        keys.append(ticket.key)
        queue.done(ticket, 0.5)
    return keys


def test_each_planned_cell_is_handed_out_once(storage):
    queue = Queue("q", CELLS, storage)
    queue.plan(list(CELLS))
    assert drain(queue) == list(CELLS)
    assert queue.take() is None


def test_planning_twice_does_not_double_a_cell(storage):
    for _ in range(2):
        queue = Queue("q", CELLS, storage)
        queue.plan(list(CELLS))
    assert sorted(drain(queue)) == list(CELLS)


def test_a_cell_that_a_killed_process_held_waits_again(storage):
    queue = Queue("q", CELLS, storage)
    queue.plan(list(CELLS))
    held = queue.take().key
    again = Queue("q", CELLS, storage)
    again.plan(list(CELLS))
    assert held in drain(again)


def test_what_another_sweep_has_finished_is_not_handed_out(storage):
    Queue("q", CELLS, storage).plan(list(CELLS))
    queue = Queue("q", CELLS, storage)
    queue.plan(["k2"])
    assert drain(queue) == ["k2"]


def test_a_cell_put_back_is_handed_out_again(storage):
    queue = Queue("q", CELLS, storage)
    queue.plan(["k1"])
    queue.again(queue.take(), "lost connection")
    assert drain(queue) == ["k1"]


def test_a_failed_cell_waits_again_when_it_is_wanted_again(storage):
    queue = Queue("q", CELLS, storage)
    queue.plan(["k1"])
    queue.failed(queue.take(), "no room")
    assert queue.take() is None
    queue.plan(["k1"])
    assert drain(queue) == ["k1"]


def test_a_foreign_file_is_refused(tmp_path):
    path = tmp_path / "queue.db"
    path.write_text("this is no database, and it is long enough to look like one" * 20)
    with pytest.raises(BadInputError, match=r"queue\.db"):
        Queue("q", CELLS, f"sqlite:///{path}")
