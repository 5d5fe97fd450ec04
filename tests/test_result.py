"""A cell's result survives saving and loading, and a broken one is refused."""

import dataclasses

import numpy as np
import pandas as pd
import pytest

from study.errors import BadInputError
from study.results.cell_result import ARRAYS, TABLE_COLUMNS, CellResult
from tests.support.synthetic_records import simulate


@pytest.fixture(scope="module")
def record():
    return simulate()


@pytest.fixture
def folder(record, tmp_path):
    next(iter(record.results.values())).save(tmp_path / "cell")
    return tmp_path / "cell"


def test_loading_gives_what_was_saved(record, folder):
    saved, loaded = next(iter(record.results.values())), CellResult.load(folder)
    assert (loaded.cell, loaded.key, loaded.settings, loaded.facts) == (
        saved.cell,
        saved.key,
        saved.settings,
        saved.facts,
    )
    pd.testing.assert_frame_equal(loaded.curves, saved.curves)
    for part in ARRAYS:
        ours, theirs = getattr(saved, part), getattr(loaded, part)
        assert set(ours) == set(theirs)
        assert all(
            np.array_equal(ours[name], theirs[name], equal_nan=True) for name in ours if ours[name].dtype.kind == "f"
        )


@pytest.mark.parametrize("file", ["cell.json", "curves.parquet", *(f"{part}.safetensors" for part in ARRAYS)])
@pytest.mark.parametrize("how", ["missing", "truncated"])
def test_an_incomplete_result_is_refused(folder, file, how):
    path = folder / file
    if how == "missing":
        path.unlink()
    else:
        path.write_bytes(path.read_bytes()[:-9])
    with pytest.raises(BadInputError, match=r"is no complete product: .*; run the cell again"):
        CellResult.load(folder)


def test_the_table_holds_finished_cells_only(record):
    key = next(iter(record.planned))
    part = dataclasses.replace(record, results={key: record.results[key]})
    table = part.table()
    assert list(table.columns) == list(TABLE_COLUMNS)
    assert set(table["heads"]) == {record.planned[key].heads}
    assert not part.complete
    assert record.complete


def test_a_sweep_without_results_has_an_empty_table(record):
    table = dataclasses.replace(record, results={}).table()
    assert list(table.columns) == list(TABLE_COLUMNS)
    assert len(table) == 0
