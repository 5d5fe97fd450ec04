"""Estimates grow with the work, and read well."""

import pytest

from study.config import Cell, StudySettings
from study.stages import Cost, cell_cost, clock, data_cost, size, total


def changed(**groups):
    return StudySettings.model_validate(groups)


def test_more_heads_cost_more():
    costs = [cell_cost(StudySettings(), Cell(heads=heads), 15).seconds for heads in ("rec", "rec+plan", "full")]
    assert costs == sorted(set(costs))


def test_a_smaller_fraction_costs_less_unless_the_steps_are_held():
    half, whole = Cell(heads="rec", fraction=0.5), Cell(heads="rec")
    assert cell_cost(StudySettings(), half, 15).seconds < cell_cost(StudySettings(), whole, 15).seconds
    held = changed(encoder={"budget": "steps"})
    assert cell_cost(held, half, 15) == cell_cost(held, whole, 15)


def test_disk_holds_at_least_the_images():
    settings = StudySettings()
    frames = settings.frames.encoder + settings.frames.policy
    assert data_cost(settings).bytes > frames * 64 * 64 * 3


def test_costs_add_up():
    assert total([Cost(1, 2), Cost(3, 4)]) == Cost(4, 6)
    assert total([]) == Cost(0, 0)


@pytest.mark.parametrize(("seconds", "text"), [(7, "7 s"), (720, "12 min"), (3 * 3600 + 300, "3 h 05 min")])
def test_times_read_well(seconds, text):
    assert clock(seconds) == text


@pytest.mark.parametrize(("count", "text"), [(310e6, "310 MB"), (7e9, "7.0 GB")])
def test_sizes_read_well(count, text):
    assert size(count) == text
