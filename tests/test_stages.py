"""Estimates grow with the work, and read well."""

import pytest

from study.config.grid import Cell
from study.config.settings import StudySettings
from study.stages import (
    CELL_STAGES,
    DATA_STAGES,
    Cost,
    Work,
    cell_cost,
    data_cost,
    duration_text,
    share_done,
    size_text,
    total,
)


def changed(**groups):
    return StudySettings.model_validate(groups)


def test_more_heads_cost_more():
    costs = [cell_cost(StudySettings(), Cell(heads=heads), 15).seconds for heads in ("rec", "rec+plan", "full")]
    assert costs == sorted(set(costs))


def test_a_smaller_fraction_costs_less_unless_the_steps_are_held():
    half, all_data = Cell(heads="rec", fraction=0.5), Cell(heads="rec")
    assert cell_cost(StudySettings(), half, 15).seconds < cell_cost(StudySettings(), all_data, 15).seconds
    held = changed(encoder={"budget": "steps"})
    assert cell_cost(held, half, 15) == cell_cost(held, all_data, 15)


def test_disk_holds_at_least_the_images():
    settings = StudySettings()
    frames = settings.frames.encoder + settings.frames.policy
    assert data_cost(settings).bytes > frames * 64 * 64 * 3


def test_costs_add_up():
    assert total([Cost(1, 2), Cost(3, 4)]) == Cost(4, 6)
    assert total([]) == Cost(0, 0)


@pytest.mark.parametrize(("seconds", "text"), [(7, "7 s"), (720, "12 min"), (3 * 3600 + 300, "3 h 05 min")])
def test_times_read_well(seconds, text):
    assert duration_text(seconds) == text


@pytest.mark.parametrize(("count", "text"), [(310e6, "310 MB"), (7e9, "7.0 GB")])
def test_sizes_read_well(count, text):
    assert size_text(count) == text


@pytest.mark.parametrize("stages", [CELL_STAGES, DATA_STAGES], ids=["cell", "data"])
@pytest.mark.parametrize("heads", ["rec", "full", "state"])
def test_the_share_that_is_done_grows_from_nothing_to_all(stages, heads):
    work = Work(StudySettings(), Cell(heads=heads), 15)
    shares = [share_done(stages, work, stage, done) for stage in stages for done in (0.0, 0.5, 1.0)]
    assert shares[0] == 0
    assert shares[-1] == pytest.approx(1)
    assert shares == sorted(shares)
    for end, begin in zip(shares[2::3], shares[3::3], strict=False):
        assert end == pytest.approx(begin)  # one stage ends where the next begins


def test_a_cell_without_an_encoder_spends_no_time_on_one():
    work = Work(StudySettings(), Cell(heads="state"), 15)
    assert share_done(CELL_STAGES, work, CELL_STAGES[0], 1.0) == 0
