"""The data stage: from nothing to a frame store, once."""

import shutil
import sys
from types import SimpleNamespace

import pytest

from study.config.files import load_profile
from study.data.__main__ import main
from study.data.frames import open_frames
from study.data.prepare import data_flow, frames_folder
from study.engine.flows import run_flow
from study.engine.local import local_engine
from study.errors import BadInputError
from study.stages import data_cost
from tests.support.processes import ROOT

TINY = {
    "town": {"vehicles": 30},
    "recording": {"warm_up": 1, "duration": 4, "encoder_episodes": 2, "policy_episodes": 2},
    "frames": {"encoder": 20, "policy": 20},
}


@pytest.fixture(scope="module")
def settings():
    return load_profile("smoke", TINY)


@pytest.fixture(scope="module")
def root(settings, tmp_path_factory):
    folder = tmp_path_factory.mktemp("data")
    run_flow(data_flow(settings, folder))
    return folder


def test_the_two_sets_come_from_different_drives(settings, root):
    store = open_frames(frames_folder(settings, root), check=True)
    sources = [{source["name"] for source in store.manifest["sources"][name]} for name in ("encoder", "policy")]
    assert not sources[0] & sources[1]
    assert [len(found) for found in sources] == [2, 2]


def contents(folder):
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize("workers", [2, pytest.param(4, marks=pytest.mark.stress)])
def test_drives_and_frames_are_the_same_bytes_with_any_number_of_workers(settings, root, tmp_path, workers):
    """Recording, choosing and rendering by Dask's workers, against this process alone."""
    with local_engine(workers, tmp_path / "scratch") as engine:
        folder = run_flow(data_flow(settings, tmp_path / "data"), engine)
    here = frames_folder(settings, root)
    assert open_frames(folder, check=True).manifest["digest"] == open_frames(here).manifest["digest"]
    assert contents(tmp_path / "data") == contents(root)


def test_existing_data_is_not_made_again(settings, root):
    steps = []
    run_flow(data_flow(settings, root), progress=lambda *what: steps.append(what))
    assert steps == []


def test_progress_reaches_the_end(settings, tmp_path):
    steps = []
    run_flow(data_flow(settings, tmp_path), progress=lambda *what: steps.append(what))
    assert [stage for stage, done, total in steps if done == total] == ["record", "select", "render"]


def test_drives_that_exist_need_no_simulator(settings, root, tmp_path, monkeypatch):
    shutil.copytree(root / "episodes", tmp_path / "episodes")
    monkeypatch.setitem(sys.modules, "study.sim.record", None)
    again = open_frames(run_flow(data_flow(settings, tmp_path)))
    assert again.manifest == open_frames(frames_folder(settings, root)).manifest


def test_a_damaged_store_is_reported_and_rebuilt(settings, root, tmp_path, capsys):
    shutil.copytree(root, tmp_path / "data")
    images = frames_folder(settings, tmp_path / "data") / "encoder" / "images.npy"
    content = images.read_bytes()
    images.write_bytes(content[:-1] + bytes([content[-1] ^ 255]))
    run_flow(data_flow(settings, tmp_path / "data"))
    assert "images.npy" in capsys.readouterr().err
    assert images.read_bytes() == content


def test_a_full_disk_is_reported_before_anything_is_made(settings, tmp_path, monkeypatch):
    monkeypatch.setattr("study.data.prepare.shutil.disk_usage", lambda _: SimpleNamespace(free=1000))
    with pytest.raises(BadInputError, match="free"):
        run_flow(data_flow(settings, tmp_path))
    assert list(tmp_path.iterdir()) == []


def test_room_that_a_killed_build_has_taken_is_not_asked_for_again(settings, root, tmp_path, monkeypatch):
    shutil.copytree(root / "episodes", tmp_path / "episodes")
    free = data_cost(settings).bytes - 10_000
    monkeypatch.setattr("study.data.prepare.shutil.disk_usage", lambda _: SimpleNamespace(free=free))
    assert (run_flow(data_flow(settings, tmp_path)) / "manifest.json").is_file()


def test_a_folder_that_cannot_be_made_is_reported(settings, tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(BadInputError, match="cannot write"):
        run_flow(data_flow(settings, tmp_path / "file" / "data"))


def test_imported_drives_have_a_card_and_a_preview_too(root, tmp_path, monkeypatch, capsys):
    shutil.copytree(ROOT / "sweeps", tmp_path / "sweeps")
    monkeypatch.chdir(tmp_path)
    episodes = next((root / "episodes").iterdir())
    assert main(["import", str(episodes), "--out", "mine"]) == 0
    small = ("--frames.encoder", "20", "--frames.policy", "20", "--workers", "1")
    assert main(["card", "--profile", "smoke", "--data", "mine", *small]) == 0
    assert "4 episodes" in capsys.readouterr().out
    assert main(["preview", "--profile", "smoke", "--data", "mine", *small]) == 0
    assert len(list(tmp_path.glob("data/frames/*/preview/*"))) > 1
    assert not (tmp_path / "data/episodes").exists()
