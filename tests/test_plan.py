"""What a sweep comes to."""

import shlex

import pytest

from study.compute.provenance import cores
from study.errors import BadInputError
from study.sweep.__main__ import main, parser
from study.sweep.plan import given_plan


def test_threads_do_not_depend_on_the_number_of_workers():
    """The bytes of a result depend on its threads, and must not depend on how many cells are trained at a time."""
    one, four = (parser().parse(["heads", "--workers", workers]) for workers in ("1", "4"))
    assert one.threads == four.threads <= cores()


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["--threads", "0"], "--threads is 0"),
        (["--workers", "0"], "--workers is 0"),
        (["--workers", "2", "--cluster", "tls://host:8786"], "leave one of them out"),
        (["--certificates", "here"], "--certificates goes with --cluster tls://"),
        (["--certificates", "here", "--cluster", "tcp://127.0.0.1:8786"], "--certificates goes with --cluster tls://"),
        (["--device", "cuda:99"], "choose from cpu"),
    ],
)
def test_options_that_cannot_be_used_are_refused_before_anything_runs(words, says):
    with pytest.raises(BadInputError, match=says):
        main(["heads", *words, "--dry-run"])


def test_a_device_of_the_cluster_need_not_be_on_this_machine():
    assert main(["heads", "--device", "cuda:99", "--cluster", "tcp://127.0.0.1:8786", "--dry-run"]) == 0


def test_a_plans_command_makes_the_same_plan():
    words = ["heads", "--profile", "smoke", "--heads", "[rec,rec+plan]", "--ceiling", "false", "--encoder.epochs", "3"]
    words += ["--encoder.head_weights", "{plan: 5}", "--town.block", "[60, 90]"]
    plan = given_plan(parser().parse(words))
    program, again = shlex.split(plan.command)[:3], shlex.split(plan.command)[3:]
    assert program == ["python", "-m", "study.sweep"]
    assert given_plan(parser().parse(again)) == plan
    assert plan != given_plan(parser().parse(words[:3]))
