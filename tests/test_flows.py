"""Flows of stages: in which order their tasks run, what becomes of failures, and what a listener hears."""

import os
import platform
from collections import deque
from pathlib import Path

import pandas as pd
import pytest
import torch

from study.engine import room
from study.engine.flows import TRIES, FlowFailedError, run_flow
from study.engine.tasks import perform
from study.errors import BadInputError, TrainingDivergedError
from study.stages import ENCODER, LATENTS, POLICY, Batch, Task
from tests.support.listeners import run_and_record

RETRIED = [OSError("the disk is away"), MemoryError(), RuntimeError("CUDA out of memory. Tried to allocate 2 GiB")]
GIVEN_UP = [BadInputError("no such device"), TrainingDivergedError("loss is nan"), ValueError("shapes differ")]


class Machine:
    """Stands for an engine with any number of slots and GPUs: each call of `wait` runs one task in this process.

    `last_first`: the task that was submitted last ends first. Submitted tasks count as running, and a cancelled one
    still ends, as it may on a cluster.
    """

    def __init__(self, slots=1, gpus=0, *, last_first=False):
        self._slots, self._gpus, self._last_first = slots, gpus, last_first
        self._running = deque()
        self.most = {"plain": 0, "accelerated": 0, "all": 0}

    def slots(self):
        return self._slots

    def gpus(self):
        return self._gpus

    def submit(self, number, task):
        self._running.append((number, task))
        accelerated = sum(task.accelerated for _, task in self._running)
        now = {"plain": len(self._running) - accelerated, "accelerated": accelerated, "all": len(self._running)}
        self.most = {kind: max(most, now[kind]) for kind, most in self.most.items()}

    def cancel(self, numbers):
        pass

    def wait(self, seconds, hear):
        number, task = self._running.pop() if self._last_first else self._running.popleft()
        return [(number, perform(task, lambda *values: hear(number, *values)))]


def run(flows, engine=None):
    return run_and_record(engine or Machine(), flows)


def note(diary, word):
    diary.append(word)
    return word


def raising(error, calls, after=TRIES):
    """Fail `after` times, then succeed."""
    calls.append(1)
    if len(calls) <= after:
        raise error
    return "done"


def tasks(function, *argument_lists, **options):
    return [Task(ENCODER, function, arguments, **options) for arguments in argument_lists]


def steps(diary, name, *counts):
    """Make a flow whose batches have that many tasks each; the tasks record themselves in a diary."""
    results = []
    for number, count in enumerate(counts):
        results += yield Batch(tasks(note, *((diary, f"{name}{number}{index}") for index in range(count))))
    return results


# --- order ----------------------------------------------------------------------------------------------------------


def test_a_flow_on_one_slot_ends_before_the_next_begins():
    diary = []
    run({name: steps(diary, name, 2, 1) for name in "ab"})
    assert diary == ["a00", "a01", "a10", "b00", "b01", "b10"]


def test_what_an_earlier_flow_asks_for_runs_before_what_a_later_one_waits_for():
    diary = []
    run({name: steps(diary, name, 1, 3) for name in "ab"}, Machine(slots=2))
    assert diary == ["a00", "b00", "a10", "a11", "a12", "b10", "b11", "b12"]


def test_later_flows_begin_only_where_there_is_room():
    begun = []

    def flow(name):
        begun.append(name)
        return (yield Batch(tasks("".join, (begun,), (begun,))))

    events = run({name: flow(name) for name in "abc"}, Machine(slots=2))
    assert events.products == {"a": ["a", "ab"], "b": ["ab", "abc"], "c": ["abc", "abc"]}


@pytest.mark.parametrize("last_first", [False, True])
def test_results_come_back_in_the_order_of_the_tasks(last_first):
    events = run({"a": steps([], "a", 4, 2)}, Machine(slots=4, last_first=last_first))
    assert events.products == {"a": ["a00", "a01", "a02", "a03", "a10", "a11"]}


def test_each_result_is_kept_when_it_comes_and_not_when_all_are_there():
    diary = []

    def flow():
        tasks = [Task(ENCODER, note, (diary, word)) for word in ("first", "second")]
        return (yield Batch(tasks, receive=lambda index, word: diary.append(f"kept {index} {word}")))

    events = run({"a": flow()})
    assert diary == ["first", "kept 0 first", "second", "kept 1 second"]
    assert events.products == {"a": ["first", "second"]}


def test_a_result_that_cannot_be_kept_is_a_failure():
    def refuse(_, word):
        raise BadInputError(f"no place for {word}")

    def flow():
        yield Batch([Task(ENCODER, note, ([], "it"))], receive=refuse)

    assert run({"a": flow()}).failures["a"].reason == "no place for it"


@pytest.mark.parametrize("counts", [(), (0,), (0, 0), (0, 2), (1, 0), (1, 0, 0, 1)])
def test_an_empty_batch_gives_no_results_and_the_flow_goes_on(counts):
    expected = [f"a{number}{index}" for number, count in enumerate(counts) for index in range(count)]
    assert run({"a": steps([], "a", *counts)}).products == {"a": expected}


def test_where_no_worker_has_come_yet_a_task_waits_for_the_first():
    engine = Machine(slots=0)
    assert run({"a": steps([], "a", 2), "b": steps([], "b", 1)}, engine).products == {"a": ["a00", "a01"], "b": ["b00"]}
    assert engine.most["all"] == 1


# --- GPUs -----------------------------------------------------------------------------------------------------------


def mixed(count):
    """Make a flow of accelerated tasks and as many plain ones, all at once."""
    arguments = [([], "task")] * count
    yield Batch([*tasks(note, *arguments, accelerated=True), *tasks(note, *arguments)])


@pytest.mark.parametrize(("slots", "gpus"), [(1, 1), (2, 1), (1, 2), (4, 2)])
def test_accelerated_tasks_take_the_gpus_and_plain_ones_the_slots_both_at_once(slots, gpus):
    engine = Machine(slots, gpus)
    assert len(run({"a": mixed(6), "b": mixed(6)}, engine).products) == 2
    assert engine.most["accelerated"] == gpus
    assert engine.most["plain"] == slots
    assert engine.most["all"] == slots + gpus


def test_without_gpus_all_tasks_share_the_slots():
    engine = Machine(slots=2)
    assert len(run({"a": mixed(6), "b": mixed(6)}, engine).products) == 2
    assert engine.most == {"plain": 2, "accelerated": 2, "all": 2}


# --- failures -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("error", RETRIED, ids=lambda error: type(error).__name__)
def test_a_failure_that_may_pass_is_given_up_after_the_last_try(error):
    calls = []
    events = run({"a": iter_batch(tasks(raising, (error, calls)))})
    assert (len(calls), len(events.retries)) == (TRIES, TRIES - 1)
    assert events.failures["a"].transient
    assert type(error).__name__ in events.failures["a"].reason
    assert events.products == {}


@pytest.mark.parametrize("error", RETRIED, ids=lambda error: type(error).__name__)
def test_a_failure_that_passes_leaves_the_result(error):
    calls = []
    events = run({"a": iter_batch(tasks(raising, (error, calls, TRIES - 1)))})
    assert (events.products, events.failures) == ({"a": ["done"]}, {})
    assert len(calls) == TRIES


@pytest.mark.parametrize("error", GIVEN_UP, ids=lambda error: type(error).__name__)
def test_a_failure_that_would_come_again_is_not_tried_again(error):
    calls = []
    events = run({"a": iter_batch(tasks(raising, (error, calls)))})
    assert (len(calls), events.retries) == (1, [])
    assert not events.failures["a"].transient
    assert str(error) in events.failures["a"].reason
    assert ("Traceback" in events.failures["a"].reason) == (not events.failures["a"].expected)


def to_parquet():
    pd.DataFrame({"a": [1]}).to_parquet("/dev/full")


def behind_another():
    try:
        Path("/dev/full").write_bytes(b"x")
    except OSError as error:
        raise BadInputError("the file cannot be used") from error


FULL_DISK = {  # whoever writes has an error of its own
    "bytes": lambda: Path("/dev/full").write_bytes(b"x"),
    "a small archive of torch": lambda: torch.save({"a": torch.zeros(10)}, "/dev/full"),
    "a large archive of torch": lambda: torch.save({"a": torch.zeros(10**6)}, "/dev/full"),
    "a table": to_parquet,
    "behind another error": behind_another,
}


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="a full disk is /dev/full on Linux")
@pytest.mark.parametrize("write", FULL_DISK.values(), ids=FULL_DISK.keys())
@pytest.mark.parametrize("between", [False, True])
def test_a_full_disk_is_a_failure_that_may_pass_whoever_writes(write, between, monkeypatch):
    monkeypatch.setattr(room, "PAUSES", (0.0, 0.0))

    def flow():
        yield from steps([], "x", 1)
        write()

    events = run({"a": flow() if between else iter_batch([Task(ENCODER, write, ())]), "b": steps([], "b", 1)})
    assert events.products.keys() == {"b"}
    assert len(events.retries) == (0 if between else 1)
    assert events.failures["a"].transient
    assert "Traceback" not in events.failures["a"].reason


def test_an_error_of_this_program_between_stages_is_no_failure_of_a_cell():
    def flow():
        yield from steps([], "x", 1)
        raise RuntimeError("a fault")

    with pytest.raises(RuntimeError, match="a fault"):
        run({"a": flow()})


def test_the_tries_of_one_task_are_not_counted_for_another():
    calls = [[], []]
    both = tasks(raising, *((OSError("away"), each, TRIES - 1) for each in calls))
    assert run({"a": iter_batch(both)}).products == {"a": ["done", "done"]}


def iter_batch(listed):
    return (yield Batch(listed))


def test_a_flow_that_fails_leaves_the_others_and_runs_none_of_its_own_tasks():
    diary, closed = [], []

    def broken():
        try:
            yield Batch([*tasks(raising, (ValueError("no"), [])), *tasks(note, *((diary, "broken"),) * 5)])
        finally:
            closed.append(True)

    events = run({"a": steps(diary, "a", 1, 1), "broken": broken(), "b": steps(diary, "b", 1)})
    assert events.products == {"a": ["a00", "a10"], "b": ["b00"]}
    assert events.failures.keys() == {"broken"}
    assert diary == ["a00", "a10", "b00"]
    assert closed == [True]


def test_what_still_ran_when_its_flow_failed_changes_nothing():
    """On a cluster a task cannot be called back; here its result comes after its flow's end."""
    failing = [*tasks(raising, (ValueError("no"), [])), *tasks(note, ([], "late"))]
    events = run({"broken": iter_batch(failing), "b": steps([], "b", 1)}, Machine(slots=3))
    assert (events.products, events.failures.keys()) == ({"b": ["b00"]}, {"broken"})


@pytest.mark.parametrize(
    ("error", "transient", "says"),
    [
        (OSError("the share is away"), True, "the share is away"),
        (PermissionError(13, "Permission denied", "results"), True, "cannot write results: Permission denied"),
        (BadInputError("too few frames"), False, "too few frames"),
        (TrainingDivergedError("loss is nan"), False, "loss is nan"),
    ],
    ids=lambda value: type(value).__name__ if isinstance(value, Exception) else "",
)
@pytest.mark.parametrize("batches", [0, 1])
def test_an_error_between_the_stages_of_a_flow_fails_that_flow_only(error, transient, says, batches):
    def flow():
        yield from steps([], "x", *[1] * batches)
        raise error

    events = run({"a": steps([], "a", 1), "broken": flow(), "b": steps([], "b", 1)})
    assert events.products.keys() == {"a", "b"}
    failure = events.failures["broken"]
    assert failure.transient == transient
    assert says in failure.reason


def test_one_flow_gives_its_product_or_raises():
    assert run_flow(steps([], "a", 2)) == ["a00", "a01"]
    with pytest.raises(BadInputError, match="no such device"):
        run_flow(iter_batch(tasks(raising, (BadInputError("no such device"), []))))
    with pytest.raises(FlowFailedError, match=r"Traceback[\s\S]*ValueError: shapes differ"):
        run_flow(iter_batch(tasks(raising, (ValueError("shapes differ"), []))))


# --- what a listener hears ------------------------------------------------------------------------------------------


def say(events, report):
    for event in events:
        report(*event)


def reporting(*event_lists, weights=None):
    weights = weights or [1] * len(event_lists)
    return [
        Task(POLICY, say, (events,), weight, reports=True) for events, weight in zip(event_lists, weights, strict=True)
    ]


def test_every_start_is_reported_with_host_and_process():
    assert run({"a": steps([], "a", 2)}).starts == [("a", platform.node(), os.getpid())] * 2


def test_logged_means_are_over_the_weights_of_the_tasks():
    first = [("log", 1, {"loss": 0.0, "accuracy": 1.0})]
    second = [("log", 1, {"loss": 4.0, "accuracy": 0.0})]
    events = run({"a": iter_batch(reporting(first, second, weights=[1, 3]))})
    assert events.logs == [("a", "policy", 1, {"loss": 3.0, "accuracy": 0.25})]


def test_an_epoch_is_reported_when_all_tasks_have_reported_it_and_no_sooner():
    ahead = [("log", epoch, {"loss": 1.0}) for epoch in (1, 2, 3)]
    behind = [("log", epoch, {"loss": 3.0}) for epoch in (1, 2)]
    events = run({"a": iter_batch(reporting(ahead, behind)), "b": iter_batch(reporting(behind))})
    assert [(name, epoch, metrics["loss"]) for name, _, epoch, metrics in events.logs] == [
        ("a", 1, 2.0),
        ("a", 2, 2.0),
        ("b", 1, 3.0),
        ("b", 2, 3.0),
    ]


def test_epochs_of_one_stage_are_not_mixed_with_those_of_the_next():
    def flow():
        yield Batch(reporting([("log", 1, {"loss": 1.0})], []))  # its second task reports nothing
        yield Batch(reporting([("log", 1, {"loss": 5.0})]))

    assert [metrics for *_, metrics in run({"a": flow()}).logs] == [{"loss": 5.0}]


def test_progress_counts_the_weights_and_what_was_done_before():
    parts = [Task(LATENTS, note, ([], "part"), weight) for weight in (10, 30)]

    def flow():
        yield Batch(parts, before=60)

    assert run({"a": flow()}).steps == [("latents", 60, 100), ("latents", 70, 100), ("latents", 100, 100)]


def test_progress_that_tasks_report_is_reported_in_their_own_steps():
    halves = [("progress", 5, 20), ("progress", 20, 20)]
    steps = run({"a": iter_batch(reporting(halves, halves, weights=[3, 1]))}).steps
    assert steps[1:] == [("policy", part, 20) for part in (3, 15, 15, 16, 20, 20)]


def test_run_flow_tells_progress_by_stage():
    steps = []
    run_flow(iter_batch(reporting([("progress", 1, 2)])), progress=lambda *how: steps.append(how))
    assert steps == [("policy", 0, 1), ("policy", 1, 2), ("policy", 2, 2)]
