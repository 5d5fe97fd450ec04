"""One sweep at a time writes to a database, whatever folder it works in and however it names the file."""

import os

import pytest

from study.config.workspace import HERE, Workspace
from study.errors import BadInputError
from study.sweep.locks import hold_store


@pytest.mark.parametrize("name", ["the same", "a link to the file", "a link to its folder", "relative", "with options"])
def test_two_working_folders_on_one_database_hold_one_lock(name, tmp_path):
    store = tmp_path / "store"
    store.mkdir()
    (tmp_path / "other").mkdir()
    (tmp_path / "other/mlflow.db").symlink_to(store / "mlflow.db")
    (tmp_path / "link").symlink_to(store)
    uri = f"sqlite:///{store}/mlflow.db"
    names = {
        "the same": uri,
        "a link to the file": f"sqlite:///{tmp_path}/other/mlflow.db",
        "a link to its folder": f"sqlite:///{tmp_path}/link/mlflow.db",
        "relative": f"sqlite:///{os.path.relpath(store)}/mlflow.db",
        "with options": f"{uri}?timeout=60",
    }
    elsewhere = Workspace(data=tmp_path / "data", mlruns=tmp_path / "mlruns")
    with hold_store(HERE, uri, "sweep, heads", wait=False):
        refused = pytest.raises(BadInputError, match=rf"another sweep, heads \(process {os.getpid()}\), runs on this")
        with refused, hold_store(elsewhere, names[name], "clean", wait=False):
            pass
