"""A cell computed again: what counts as equal, and what is said when it is not."""

import dataclasses

import numpy as np
import pytest

from study.errors import BadInputError
from study.sweep.verify import changes, choose, differences, judge, report
from tests.support.synthetic_records import simulate

RECORD = simulate()
RESULT = next(iter(RECORD.results.values()))
ORIGIN = {"cpu": "A", "commit": "c" * 40, "diff": "", "packages": {"torch": "2.13.0", "zope": "1"}}
TOLD = RESULT.facts | {"provenance": ORIGIN}


def copy(result=RESULT, **new):
    arrays = {part: dict(getattr(result, part)) for part in ("encoder", "policies", "samples", "predictions")}
    return dataclasses.replace(result, curves=result.curves.copy(), **(arrays | {"facts": TOLD} | new))


def with_accuracy(shift):
    again = copy()
    rows = again.curves["metric"] == "acceleration_accuracy"
    again.curves.loc[rows, "value"] += shift
    return again


def test_a_copy_is_equal():
    assert differences(RESULT, copy()) == []


def test_one_bit_is_a_difference():
    again = copy()
    name, weights = next((name, array) for name, array in again.encoder.items() if array.dtype == np.float32)
    changed = weights.copy()
    changed.flat[0] = np.nextafter(changed.flat[0], np.float32(9))
    again.encoder[name] = changed
    (difference,) = differences(RESULT, again)
    assert (difference.name, difference.values) == (f"encoder: {name}", 1)
    assert 0 < difference.largest < 1e-5


def test_what_is_missing_or_of_another_shape_is_a_difference():
    again = copy()
    again.predictions["steering"] = again.predictions["steering"][:-1]
    del again.predictions["episode"]
    assert {difference.name for difference in differences(RESULT, again)} == {
        "predictions: steering",
        "predictions: episode",
    }


def test_conditions_that_were_not_recorded_are_no_change():
    assert changes({"threads": 2}, TOLD | {"threads": 2}) == []
    assert changes(TOLD, TOLD | {"provenance": ORIGIN | {"packages": {"torch": "2.13.0", "zope": "2"}}}) == []


def test_changed_conditions_are_named():
    now = TOLD | {"threads": 7, "provenance": ORIGIN | {"cpu": "B", "diff": "+A", "packages": {"torch": "3"}}}
    text = "; ".join(changes(TOLD, now))
    for words in ("threads: 2 then, 7 now", "cpu: A then, B now", "torch: 2.13.0 then, 3 now", "uncommitted changes"):
        assert words in text


def test_another_result_under_the_same_conditions_is_an_error(capsys):
    assert report(copy(), copy(), 0.01) == 0
    assert "equal" in capsys.readouterr().out
    assert report(copy(), with_accuracy(1e-9), 0.01) == 1
    assert "should have been equal" in capsys.readouterr().out


def test_another_result_on_another_processor_is_judged_by_a_stated_tolerance(capsys):
    elsewhere = {"facts": TOLD | {"provenance": ORIGIN | {"cpu": "B"}}}
    allowed = judge(RESULT, RESULT, 0.01).allowed
    assert report(copy(), copy(with_accuracy(0.9 * allowed), **elsewhere), 0.01) == 0
    assert f"within {allowed:.4f}" in capsys.readouterr().out
    assert report(copy(), copy(with_accuracy(1.1 * allowed), **elsewhere), 0.01) == 1
    assert "NOT within" in capsys.readouterr().out


def test_a_seed_names_a_cell_and_a_label_too():
    cells = RECORD.planned
    assert choose(cells, None, 5) == choose(dict(reversed(cells.items())), None, 5)
    assert len({choose(cells, None, seed) for seed in range(40)}) == len(cells)
    key, cell = list(cells.items())[2]
    assert choose(cells, cell.label, 0) == choose(cells, key, 0) == key
    with pytest.raises(BadInputError, match="finished cell 'reck'; choose from rec 100% e0"):
        choose(cells, "reck", 0)
