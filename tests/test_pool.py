"""Many tasks in child processes that may be killed."""

import os
import signal
import time

import pytest

from study.config import BadInputError
from study.pool import Pool


def square(folder, number, deadly):
    """Leaves a mark for each try; a deadly task survives from its third try on."""
    tries = folder / str(number)
    with tries.open("a") as stream:
        stream.write("x")
    if deadly and len(tries.read_text()) < 3:
        os.kill(os.getpid(), signal.SIGKILL)
    return number**2


def die():
    os.kill(os.getpid(), signal.SIGKILL)


def sleep_or_interrupt(folder, interrupts):
    if not interrupts:
        (folder / str(os.getpid())).touch()
        time.sleep(600)
    while not list(folder.iterdir()):
        time.sleep(0.01)
    os.kill(os.getppid(), signal.SIGINT)


def run(folder):
    with Pool(2) as pool:
        list(pool.results(sleep_or_interrupt, [(folder, False), (folder, True)]))


def test_a_killed_child_is_replaced_and_its_task_done_again(tmp_path):
    with Pool(2) as pool:
        results = dict(pool.results(square, [(tmp_path, number, number == 3) for number in range(6)]))
    assert results == {number: number**2 for number in range(6)}


def test_children_that_are_killed_on_and_on_are_told():
    with Pool(2) as pool, pytest.raises(BadInputError, match="killed"):
        list(pool.results(die, [()]))


def test_an_error_of_a_task_is_raised():
    with Pool(2) as pool, pytest.raises(ZeroDivisionError):
        list(pool.results(divmod, [(1, 0)]))


def test_an_interrupt_does_not_wait_for_running_tasks(tmp_path):
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path)
    (child,) = tmp_path.iterdir()
    with pytest.raises(ProcessLookupError):
        os.kill(int(child.name), 0)
