"""A full disk is waited for; temporary files that are swept away are made again, or named."""

import shutil
import sqlite3
import tempfile
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch

from study.atomic import atomic_folder, scratch_folder, write_atomic
from study.engine import room
from study.engine.room import TRIES, with_room
from study.errors import BadInputError, write_failure
from study.products import read_product, write_product
from study.stages import ENCODER, Batch, Task
from study.tracking import experiment
from tests.support.listeners import run_and_record
from tests.test_flows import Machine

FULL = OSError(28, "No space left on device", "data/products/one")
TABLE = pd.DataFrame({"a": [1]})


class Disk:
    """Has as many free bytes as the list says, look by look, and notes the pauses before."""

    def __init__(self, monkeypatch, *free):
        self.looks, self.pauses = list(free), []
        monkeypatch.setattr(room, "_free", lambda _: self.looks[0])
        monkeypatch.setattr(room, "_sleep", self.sleep)

    def sleep(self, seconds):
        self.pauses.append(seconds)
        if len(self.looks) > 1:
            self.looks.pop(0)


def failing(times, calls, error=FULL):
    """Fail `times` times, then succeed."""
    calls.append(1)
    if len(calls) <= times:
        raise error
    return "done"


def test_a_write_is_tried_again_once_there_is_room_and_not_before(monkeypatch):
    disk, calls = Disk(monkeypatch, 0, 0, 0, 0, room.ROOM), []
    assert with_room(lambda: failing(1, calls)) == "done"
    assert len(calls) == 2
    assert disk.pauses == [1, 2, 4, 8]


def test_pauses_grow_to_a_minute_and_end_with_the_patience(monkeypatch):
    disk, calls = Disk(monkeypatch, 0), []
    with pytest.raises(OSError, match="No space left"):
        with_room(lambda: failing(9, calls))
    assert len(calls) == 1
    assert max(disk.pauses) == 60
    assert sum(disk.pauses) == room.PATIENCE
    assert disk.pauses[:-1] == sorted(disk.pauses[:-1])


def test_a_write_that_fails_where_room_is_free_is_given_up_after_a_few_tries(monkeypatch):
    disk, calls = Disk(monkeypatch, 10**12), []
    with pytest.raises(OSError, match="No space left"):
        with_room(lambda: failing(9, calls))
    assert len(calls) == TRIES
    assert len(disk.pauses) == TRIES - 1


def test_another_error_is_not_waited_for(monkeypatch):
    disk, calls = Disk(monkeypatch, 0), []
    with pytest.raises(ValueError, match="no"):
        with_room(lambda: failing(1, calls, ValueError("no")))
    assert disk.pauses == []


def test_stderr_is_told_once_what_is_waited_for(monkeypatch, capsys):
    Disk(monkeypatch, 5_000_000, 5_000_000, 5_000_000, room.ROOM)
    calls = []
    with_room(lambda: failing(1, calls))
    said = capsys.readouterr().err
    assert said == ("no room to write in data/products/one: 5 MB free, 48 MB are needed; waiting up to 30 min for it\n")


def test_a_copy_waits_for_room_where_it_goes_and_a_store_has_a_disk_of_its_own(monkeypatch, capsys, tmp_path):
    copying = OSError(28, "No space left on device", "data/here", None, "mlruns/there")
    masked = BadInputError(f"the tracking store gave no usable answer: {copying}")
    for error, place in ((copying, "mlruns/there"), (masked, str(tmp_path))):
        full, calls = {place}, []
        monkeypatch.setattr(room, "_free", lambda at, full=full: 0 if at in full else 10**12)
        monkeypatch.setattr(room, "_sleep", lambda _, full=full: full.clear())
        assert with_room(lambda calls=calls, error=error: failing(1, calls, error), into=tmp_path) == "done"
        assert f"no room to write in {place}: " in capsys.readouterr().err


def test_cells_that_wait_for_the_same_room_are_told_once_and_finish(monkeypatch):
    Disk(monkeypatch, *[0] * 5, room.ROOM)

    def flow(calls):
        return (yield Batch([Task(ENCODER, failing, (1, calls))]))

    events = run_and_record(Machine(), {"a": flow([]), "b": flow([])})
    assert events.products == {"a": ["done"], "b": ["done"]}
    assert len(events.retries) == 2  # the first has ended before the second waits
    assert "are needed" in events.retries[0]


def test_a_cell_for_which_no_room_came_has_failed_for_a_reason_that_may_pass(monkeypatch):
    Disk(monkeypatch, 0)
    calls = []

    def flow():
        return (yield Batch([Task(ENCODER, failing, (9, calls))]))

    failure = run_and_record(Machine(), {"a": flow()}).failures["a"]
    assert failure.transient
    assert failure.reason.startswith("cannot write data/products/one: No space left on device")
    assert len(calls) == 1


# --- swept folders ----------------------------------------------------------------------------------------------------


def sweep(folder):
    """Remove what lies in a folder, as cleaners of temporary files do."""
    for path in folder.iterdir():
        shutil.rmtree(path)


def test_a_product_whose_draft_is_swept_is_written_again(tmp_path, monkeypatch):
    swept = []
    write = pd.DataFrame.to_parquet

    def to_parquet(table, path, **options):
        if not swept:
            swept.append(1)
            sweep(tmp_path)
        write(table, path, **options)

    monkeypatch.setattr(pd.DataFrame, "to_parquet", to_parquet)
    write_product(tmp_path / "product", "head.json", {}, {"weights": {"a": np.ones(3)}}, TABLE)
    assert swept
    assert read_product(tmp_path / "product", "head.json", ("weights",))[1]["weights"]["a"].sum() == 3


WRITERS = {
    "bytes": lambda draft: (draft / "file").write_bytes(b"x"),
    "a table": lambda draft: TABLE.to_parquet(draft / "file"),
    "an archive of torch": lambda draft: torch.save({"a": torch.zeros(3)}, draft / "file"),
    "nothing": lambda draft: None,
}


@pytest.mark.parametrize("write", WRITERS.values(), ids=WRITERS.keys())
def test_a_draft_that_is_swept_is_one_clear_error_whoever_writes(write, tmp_path):
    def work():
        with atomic_folder(tmp_path / "product") as draft:
            sweep(tmp_path)
            write(draft)

    with pytest.raises((OSError, RuntimeError)) as caught:
        work()
    assert "was removed while it was in use" in write_failure(caught.value)
    assert not (tmp_path / "product").exists()


def test_a_file_whose_folder_is_swept_is_written_again(tmp_path, monkeypatch):
    replace, swept = Path.replace, []

    def after_the_sweep(draft, target):
        if not swept:
            swept.append(1)
            sweep(tmp_path)
        return replace(draft, target)

    monkeypatch.setattr(Path, "replace", after_the_sweep)
    write_atomic(tmp_path / "deep/file", b"content")
    assert swept
    assert (tmp_path / "deep/file").read_bytes() == b"content"


def test_temporary_files_have_a_folder_again_after_a_sweep(tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "data/tmp"))
    with scratch_folder() as name:
        sweep(tmp_path)
    with scratch_folder() as name:
        assert Path(name).parent == tmp_path / "data/tmp"


def test_a_store_for_which_no_room_is_left_asks_for_room(tmp_path, monkeypatch):
    def create(_):
        raise sqlite3.OperationalError("database or disk is full")

    monkeypatch.setattr(experiment, "create_database", create)
    with pytest.raises(BadInputError, match="disk is full; make room or give another --tracking"):
        experiment.open_experiment(f"{experiment.SQLITE}{tmp_path / 'mlflow.db'}", "study")
