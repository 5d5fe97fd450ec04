"""What a sweep comes to."""

import shlex

import pytest
import torch

from study.errors import BadInputError
from study.sweep.__main__ import main
from tests.support.plans import plan_of

NO_APPLE = pytest.mark.skipif(torch.backends.mps.is_available(), reason="this machine has an Apple GPU")


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["--threads", "0"], "'--threads': 0 is not in the range x>=1"),
        (["--workers", "0"], "'--workers': 0 is not in the range x>=1"),
        (["--workers", "2", "--cluster", "tls://host:8786"], "leave one of them out"),
        (["--certificates", "here"], "--certificates goes with --cluster tls://"),
        (["--certificates", "here", "--cluster", "tcp://127.0.0.1:8786"], "--certificates goes with --cluster tls://"),
        (["--device", "cuda:99"], "choose from cpu"),
        pytest.param(["--device", "mps"], "'mps' is not on this machine; choose from cpu", marks=NO_APPLE),
        (["--dynamics.lag", "3"], "takes 37 m, and the autopilot looks 30 m ahead"),
    ],
)
def test_options_that_cannot_be_used_are_refused_before_anything_runs(words, says):
    with pytest.raises(BadInputError, match=says):
        main(["heads", *words, "--dry-run"])


def test_a_device_of_the_cluster_need_not_be_on_this_machine():
    assert main(["heads", "--device", "cuda:99", "--cluster", "tcp://127.0.0.1:8786", "--dry-run"]) == 0


def test_one_baseline_needs_no_brackets():
    assert plan_of(["heads", "--baselines", "state"]).cells == plan_of(["heads", "--baselines", "[state]"]).cells


def test_a_plans_command_makes_the_same_plan():
    words = ["heads", "--profile", "smoke", "--heads", "[rec,rec+plan]", "--baselines", "[]", "--encoder.epochs", "3"]
    words += ["--encoder.head_weights", "{plan: 5}", "--town.block", "[60, 90]"]
    plan = plan_of(words)
    program, again = shlex.split(plan.command)[:3], shlex.split(plan.command)[3:]
    assert program == ["python", "-m", "study.sweep"]
    assert plan_of(again) == plan
    assert plan != plan_of(words[:3])


def test_to_drive_behind_imported_drives_is_refused(tmp_path):
    with pytest.raises(BadInputError, match="no town to drive in"):
        plan_of(["heads", "--data", str(tmp_path), "--drive", "true"])
