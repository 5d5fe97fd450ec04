"""What a sweep comes to."""

import shlex

import pytest

from study.config import BadInputError
from study.plan import given_plan, thread_hint
from study.provenance import cores
from study.sweep import main, parser


def test_threads_do_not_depend_on_the_number_of_workers():
    """The bytes of a result depend on its threads, and must not depend on how many cells are trained at a time."""
    one, four = (parser().parse(["heads", "--workers", workers]) for workers in ("1", "4"))
    assert one.threads == four.threads <= cores()


def test_too_many_threads_are_told_with_what_to_do():
    assert "--threads 1" in thread_hint(4, 2, 2)
    assert "--threads 3" in thread_hint(2, 4, 7)
    assert thread_hint(4, 2, 8) == thread_hint(4, 1, 2) == ""


def test_a_cell_needs_a_thread():
    with pytest.raises(BadInputError, match="--threads is 0"):
        main(["heads", "--threads", "0", "--dry-run"])


def test_a_plans_command_makes_the_same_plan():
    words = ["heads", "--profile", "smoke", "--heads", "[rec,rec+plan]", "--ceiling", "false", "--encoder.epochs", "3"]
    words += ["--encoder.head_weights", "{plan: 5}", "--town.block", "[60, 90]"]
    plan = given_plan(parser().parse(words))
    program, again = shlex.split(plan.command)[:3], shlex.split(plan.command)[3:]
    assert program == ["python", "-m", "study.sweep"]
    assert given_plan(parser().parse(again)) == plan
    assert plan != given_plan(parser().parse(words[:3]))
