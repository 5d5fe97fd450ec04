"""What somebody deletes in MLflow while a sweep runs costs neither a result nor the other cells."""

import shutil
from dataclasses import replace

import pytest

from study.engine.tasks import Failure
from study.planning.options import RunOptions
from study.planning.plan import plan_display
from study.sweep.committing import Committing
from study.tracking.experiment import SQLITE, DeletedError
from study.tracking.tracker import Tracker
from tests.support.plans import plan_of
from tests.support.synthetic_records import World, simulate

WORDS = ("heads", "--heads", "[rec,full]", "--policy_seeds", "3", "--baselines", "[]")


class Sweep:
    """A sweep of two cells that has begun both; `finish` commits a cell's result."""

    def __init__(self, folder):
        self.plan = plan_of(WORDS)
        options = RunOptions(f"{SQLITE}{folder}/mlflow.db")
        self.tracker = Tracker(options.tracking)
        self.client = self.tracker.client
        record = simulate(self.plan.grid, World(epochs=6))
        self.results = dict(zip(self.plan.cells, record.results.values(), strict=True))
        self.run = self.tracker.open_sweep(
            self.plan.grid, self.plan.profile, self.plan.settings, self.plan.cells, record.data, {}
        )
        keys = list(self.plan.cells)
        display = plan_display(self.plan, keys)
        self.cells = Committing(self.plan, options, self.tracker, self.run, keys, display, accelerated=False)
        self.first, self.second = (self.cells.next_flow()[0] for _ in keys)
        self.left = keys
        for key in keys:
            self.cells.started(key, "here", 1)

    def run_of(self, key):
        return self.tracker.reader.attempts([key])[key][-1].run_id

    def finish(self, key):
        self.left = [other for other in self.left if other != key]
        self.cells.finished(key, (replace(self.results[key], key=key), b""))

    def end(self):
        """Finish what is left; fails unless both cells are there, whole, and nothing is left running."""
        for key in self.left:
            self.finish(key)
        assert self.cells.close() == {}
        assert self.tracker.reader.read_sweep("heads").complete
        assert self.tracker.experiment.search("attributes.status = 'RUNNING'") == []


@pytest.fixture
def sweep(tmp_path, empty_store):
    shutil.copy(empty_store, tmp_path)
    return Sweep(tmp_path)


@pytest.mark.parametrize("when", ["while it trains", "when it is committed"])
def test_a_cell_whose_run_is_deleted_goes_on_in_a_new_one_and_the_user_is_told(sweep, when, capsys):
    gone = sweep.run_of(sweep.first)
    sweep.client.delete_run(gone)
    if when == "while it trains":
        sweep.cells.tick()
        assert sweep.run_of(sweep.first) != gone
    sweep.end()
    assert sweep.run_of(sweep.first) != gone
    assert sweep.client.get_run(gone).info.lifecycle_stage == "deleted"
    assert f"run {gone}" in capsys.readouterr().err


def test_a_cell_that_fails_after_its_run_was_deleted_is_listed(sweep):
    sweep.client.delete_run(sweep.run_of(sweep.first))
    sweep.cells.failed(sweep.first, Failure("loss is nan", transient=False))
    sweep.finish(sweep.second)
    assert sweep.cells.close() == {sweep.first: "loss is nan"}
    assert sweep.tracker.reader.given_up([sweep.first]) == {sweep.first: "loss is nan"}


@pytest.mark.parametrize("finished", [False, True])
def test_a_sweep_whose_run_is_deleted_is_restored(sweep, finished, capsys):
    if finished:
        sweep.finish(sweep.first)
        sweep.finish(sweep.second)
    sweep.client.delete_run(sweep.run)
    sweep.end()
    assert "restored" in capsys.readouterr().err


@pytest.mark.parametrize("begun", ["both", "one"])
def test_a_deleted_experiment_is_restored_and_told(sweep, begun, capsys):
    if begun == "one":
        sweep.finish(sweep.first)
    sweep.client.delete_experiment(sweep.tracker.experiment.id)
    sweep.end()
    assert "deleted" in capsys.readouterr().err


def test_a_sweep_that_was_removed_for_good_ends_with_a_clear_error(sweep):
    from mlflow.store.tracking.sqlalchemy_store import SqlAlchemyStore

    sweep.client.delete_run(sweep.run)
    SqlAlchemyStore(sweep.tracker.experiment.uri, "/nowhere")._hard_delete_run(sweep.run)
    with pytest.raises(DeletedError, match="somebody has deleted"):
        sweep.end()
