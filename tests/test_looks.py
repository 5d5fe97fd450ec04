"""A look at a store writes nothing, whatever the store is."""

import hashlib
import shutil
import socket
import sqlite3
from contextlib import closing
from pathlib import Path

import pytest

from study.errors import BadInputError
from study.report import __main__ as report
from study.sweep import __main__ as sweep
from study.tracking import schema
from study.tracking.experiment import SQLITE, TrackerLostError, find_experiment
from study.tracking.schema import _versions, has_tables
from study.tracking.tracker import Tracker

LOOKS = [
    (sweep, ["status", "heads"]),
    (sweep, ["heads", "--dry-run"]),
    (report, ["heads", "--format", "md"]),
    (report, ["compare", "heads", "heads"]),
]
looks = pytest.mark.parametrize(
    ("module", "words"), LOOKS, ids=lambda value: "" if value in (sweep, report) else value[0]
)


def content(folder):
    return {path: hashlib.sha256(path.read_bytes()).hexdigest() for path in folder.rglob("*") if path.is_file()}


def look(module, words, uri):
    return module.main([*words, "--tracking", uri])


def change(database, *statements):
    with closing(sqlite3.connect(database)) as connection:
        for statement in statements:
            connection.execute(statement)
        connection.commit()


@pytest.fixture
def database(empty_store, tmp_path):
    return Path(shutil.copy(empty_store, tmp_path))


OLDER = {
    "an earlier version": ["update alembic_version set version_num = 'b7e2c1a4d9f3'"],
    "a table less": ["update alembic_version set version_num = 'b7e2c1a4d9f3'", "drop table webhooks"],
    "no version": ["drop table alembic_version"],
}


@looks
@pytest.mark.parametrize("statements", OLDER.values(), ids=OLDER.keys())
def test_an_older_database_is_named_with_the_way_to_upgrade_it_and_left_as_it_is(statements, module, words, database):
    change(database, *statements)
    before = content(database.parent)
    with pytest.raises(BadInputError, match=r"older MLflow.*copy it first \(cp .*mlflow db upgrade sqlite:///"):
        look(module, words, f"{SQLITE}{database}")
    assert content(database.parent) == before


def test_a_sweep_does_not_migrate_an_older_database_either(database):
    change(database, *OLDER["a table less"])
    before = content(database.parent)
    with pytest.raises(BadInputError, match="copy it first"):
        Tracker(f"{SQLITE}{database}")
    assert content(database.parent) == before


def test_a_database_of_a_newer_mlflow_is_named(database):
    change(database, "update alembic_version set version_num = 'fffffffffff0'")
    with pytest.raises(BadInputError, match="newer MLflow"):
        look(*LOOKS[0], f"{SQLITE}{database}")


@looks
def test_a_look_writes_nothing_where_nothing_is_and_where_something_is(module, words, database, tmp_path, capsys):
    for uri in (f"{SQLITE}{tmp_path}/none/mlflow.db", f"{SQLITE}{database}"):
        before = content(tmp_path)
        if module is sweep:
            assert look(module, words, uri) == 0
        else:
            with pytest.raises(BadInputError, match="nothing was tracked"):
                look(module, words, uri)
        assert content(tmp_path) == before
        assert not (tmp_path / "none").exists()


def test_an_empty_database_of_another_host_has_no_tables_yet(tmp_path):
    """SQLite stands for PostgreSQL: both are asked in the same words."""
    assert has_tables(f"sqlite:///{tmp_path}/empty.db", "shown", None) is False
    assert len(_versions()) > 10


@pytest.mark.parametrize("asked", ["", "?connect_timeout=2"])
def test_a_database_that_does_not_answer_is_not_waited_for_in_silence(asked, monkeypatch):
    pytest.importorskip("psycopg")
    if not asked:
        monkeypatch.setitem(schema.CONNECT, "connect_timeout", 2)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        uri = f"postgresql+psycopg://127.0.0.1:{silent.getsockname()[1]}/mlflow{asked}"
        with pytest.raises(TrackerLostError, match=r"timeout expired.*start it, or choose another with --tracking"):
            find_experiment(uri, "study")
