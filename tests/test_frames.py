"""Frame store: what is in it, how it is built whatever happens, and how it refuses what is not whole."""

import itertools
import json
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from study.config.keys import FORMAT_VERSIONS
from study.config.settings import BirdviewSettings, FramesSettings
from study.data.build import frames_flow
from study.data.frames import epoch_order, open_frames, unpack_masks
from study.data.selection import LABELS
from study.engine.flows import run_flow
from study.engine.local import local_engine
from study.episode.files import read_episode
from study.episode.head import episode_digest
from study.errors import BadInputError
from tests.support.drives import bird_view, write_drives

FRAMES = FramesSettings(encoder=120, policy=60, spacing=0.5)
VIEW = BirdviewSettings()


@pytest.fixture(scope="module")
def drives(tmp_path_factory):
    paths = write_drives(tmp_path_factory.mktemp("drives"), 10)
    return paths[:5], paths[5:]


@pytest.fixture(scope="module")
def built(drives, tmp_path_factory):
    folder = tmp_path_factory.mktemp("stores") / "store"
    run_flow(frames_flow(FRAMES, VIEW, *drives, folder))
    return folder


@pytest.fixture
def store(built, tmp_path):
    """Return a copy that a test may damage."""
    return Path(shutil.copytree(built, tmp_path / "store"))


def test_frames_are_the_rendered_moments_of_their_labels(built, drives):
    """Every seventh row of both sets against the Episode it names."""
    frame_store = open_frames(built, check=True)
    for frames, paths in ((frame_store.encoder, drives[0]), (frame_store.policy, drives[1])):
        assert list(frames.labels.columns) == list(LABELS)
        for row in range(0, len(frames), 7):
            label = frames.labels.iloc[row]
            episode = read_episode(paths[label["episode"]])
            agent = [agent.id for agent in episode.agents].index(label["agent"])
            image, pred, plan = bird_view(episode, label["step"], agent, VIEW)
            np.testing.assert_array_equal(frames.images[row], image)
            np.testing.assert_array_equal(unpack_masks(frames.masks[row : row + 1])[0], [pred, plan])


def test_the_manifest_tells_what_the_store_is(built, drives):
    manifest = open_frames(built).manifest
    assert manifest["settings"]["frames"]["encoder"] == 120
    assert [source["digest"] for source in manifest["sources"]["policy"]] == [
        episode_digest(path) for path in drives[1]
    ]
    for name, number in (("encoder", 120), ("policy", 60)):
        entry = manifest["sets"][name]
        assert (entry["frames"], entry["train"], entry["test"]) == (number, number * 0.8, number * 0.2)
        assert entry["arrays"]["images"] == {"shape": [number, 64, 64, 3], "dtype": "uint8"}
        assert entry["candidates"]["frames"] > sum(entry["chosen"]["all"]["steering"]) == number
        assert 0 <= entry["chosen"]["test"]["steering_beyond_crop"] < entry["chosen"]["test"]["majority_accuracy"] <= 1


def test_workers_do_not_change_the_store(built, drives, tmp_path):
    with local_engine(2, tmp_path / "scratch") as engine:
        run_flow(frames_flow(FRAMES, VIEW, *drives, tmp_path / "stores" / "two"), engine)
    for file in sorted(path.relative_to(built) for path in built.rglob("*") if path.is_file()):
        assert (tmp_path / "stores" / "two" / file).read_bytes() == (built / file).read_bytes(), file
    assert sorted(path.name for path in (tmp_path / "stores").iterdir()) == [".lock", "two"]


def test_a_second_build_does_nothing(built, drives):
    before = {path: path.stat().st_mtime_ns for path in built.rglob("*")}
    run_flow(frames_flow(FRAMES, VIEW, *drives, built), progress=lambda *_: pytest.fail("something was done"))
    assert {path: path.stat().st_mtime_ns for path in built.rglob("*")} == before


def test_a_key_may_be_given(drives, tmp_path):
    run_flow(frames_flow(FRAMES, VIEW, *drives, tmp_path / "store", key="abc"))
    assert open_frames(tmp_path / "store").key == "abc"


KILLED = """
import os, signal, sys
from contextlib import nullcontext
from pathlib import Path
from study.config.settings import BirdviewSettings, FramesSettings
from study.engine.local import local_engine
from study.engine.flows import run_flow
from study.data.build import frames_flow

def progress(stage, done, total):
    if stage == sys.argv[2] and done >= int(sys.argv[3]):
        os.kill(os.getpid(), signal.SIGKILL)

if __name__ == "__main__":
    folder, workers, paths = Path(sys.argv[1]), int(sys.argv[4]), [Path(path) for path in sys.argv[5:]]
    frames = FramesSettings(encoder=120, policy=60, spacing=0.5)
    with local_engine(workers, folder.parent / "scratch") if workers > 1 else nullcontext() as engine:
        run_flow(frames_flow(frames, BirdviewSettings(), paths[:5], paths[5:], folder), engine, progress)
"""


def start(script, folder, stage, done, workers, drives):
    arguments = [str(folder), stage, str(done), str(workers), *map(str, (*drives[0], *drives[1]))]
    return subprocess.Popen([sys.executable, str(script), *arguments])


@pytest.mark.stress
@pytest.mark.parametrize(("stage", "done", "workers"), [("select", 4, 1), ("render", 1, 1), ("render", 100, 2)])
def test_a_killed_build_goes_on_and_ends_the_same(built, drives, tmp_path, stage, done, workers):
    """Killed for real; what is rendered is not rendered again; a note that is not whole is no harm."""
    script = tmp_path / "killed.py"
    script.write_text(KILLED)
    folder = tmp_path / "stores" / "store"
    assert start(script, folder, stage, done, workers, drives).wait(timeout=120) == -signal.SIGKILL
    assert not folder.exists()
    if stage == "render":
        (folder.with_name(".store.building") / "parts" / "encoder-000000000.draft").write_text('{"start": 0, "ro')
    steps = []
    run_flow(frames_flow(FRAMES, VIEW, *drives, folder), progress=lambda *what: steps.append(what))
    if stage == "render":
        assert steps[0][0] == "render"
        assert steps[0][1] >= done
    assert open_frames(folder, check=True).manifest == open_frames(built).manifest


@pytest.mark.stress
def test_an_unfinished_build_of_other_settings_is_not_taken_up(drives, tmp_path):
    script = tmp_path / "killed.py"
    script.write_text(KILLED)
    start(script, tmp_path / "store", "render", 100, 1, drives).wait(timeout=120)
    run_flow(frames_flow(FRAMES.model_copy(update={"seed": 1}), VIEW, *drives, tmp_path / "store"))
    frame_store = open_frames(tmp_path / "store", check=True)
    assert frame_store.manifest["settings"]["frames"]["seed"] == 1


@pytest.mark.stress
def test_two_builds_at_once_make_one_store(built, drives, tmp_path):
    script = tmp_path / "build.py"
    script.write_text(KILLED)
    both = [start(script, tmp_path / "store", "never", 0, 1, drives) for _ in range(2)]
    assert [process.wait(timeout=120) for process in both] == [0, 0]
    assert open_frames(tmp_path / "store", check=True).manifest == open_frames(built).manifest


def test_no_drive_serves_both_sets(drives, tmp_path):
    with pytest.raises(BadInputError, match="drive-004 serves the encoder set and again the policy set"):
        run_flow(frames_flow(FRAMES, VIEW, drives[0], [*drives[1], drives[0][4]], tmp_path / "store"))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("settings", "says"),
    [
        ({"encoder": 10**10}, "its drives give"),
        ({"policy": 5000}, "policy set needs 4000 training frames and its drives give"),
    ],
)
def test_what_cannot_be_met_is_refused(drives, tmp_path, settings, says):
    """Nothing is left that looks like a store."""
    with pytest.raises(BadInputError, match=says):
        run_flow(frames_flow(FRAMES.model_copy(update=settings), VIEW, *drives, tmp_path / "store"))
    assert not (tmp_path / "store").exists()


def test_a_folder_that_cannot_be_written_is_one_clear_error(drives, tmp_path):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(BadInputError, match="cannot write"):
        run_flow(frames_flow(FRAMES, VIEW, *drives, tmp_path / "file" / "store"))


def test_a_folder_of_other_frames_is_left_alone(store, drives):
    with pytest.raises(BadInputError, match="other settings or drives"):
        run_flow(frames_flow(FRAMES.model_copy(update={"seed": 5}), VIEW, *drives, store))
    open_frames(store, check=True)


def test_a_broken_drive_is_named(drives, tmp_path):
    broken = Path(shutil.copytree(drives[0][0], tmp_path / "broken"))
    (broken / "states.parquet").write_bytes(b"PAR1")
    with pytest.raises(BadInputError, match=r"states\.parquet does not match"):
        run_flow(frames_flow(FRAMES, VIEW, [broken, *drives[0][1:]], drives[1], tmp_path / "store"))


def cut(path):
    os.truncate(path, path.stat().st_size - 1000)


def flip(path):
    content = bytearray(path.read_bytes())
    content[-5000] ^= 1
    path.write_bytes(content)


def edit(**values):
    def change(path):
        manifest = json.loads(path.read_text())
        path.write_text(json.dumps(manifest | values))

    return change


def fewer(path):
    manifest = json.loads(path.read_text())
    manifest["sets"]["policy"]["frames"] -= 1
    path.write_text(json.dumps(manifest))


@pytest.mark.parametrize(
    ("file", "change", "says"),
    [
        ("manifest.json", Path.unlink, "is .* a frame store"),
        ("manifest.json", cut, "truncated or foreign"),
        ("manifest.json", lambda path: path.write_text("[]"), "truncated or foreign"),
        ("manifest.json", edit(schema_version=9), "schema_version is 9"),
        ("manifest.json", edit(sets={}), "lacks what a manifest holds"),
        ("manifest.json", fewer, r"the manifest says \(59, 64, 64, 3\)"),
        ("encoder/images.npy", cut, "no complete array"),
        ("encoder/images.npy", lambda path: path.write_bytes(b"foreign"), "no complete array"),
        ("policy/masks.npy", Path.unlink, "no complete array"),
        ("policy/masks.npy", lambda path: np.save(path, np.zeros((60, 512), np.uint8)), "the manifest says"),
        ("policy/labels.parquet", flip, "does not match its digest"),
        ("policy/labels.parquet", Path.unlink, "holds no labels"),
    ],
)
def test_a_store_that_is_incomplete_is_refused(store, file, change, says):
    change(store / file)
    with pytest.raises(BadInputError, match=says):
        open_frames(store)


@pytest.mark.parametrize("file", ["encoder/images.npy", "policy/masks.npy"])
def test_a_changed_byte_is_found_when_asked_for(store, file):
    flip(store / file)
    with pytest.raises(BadInputError, match=r"rows \d+ to \d+, does not match its digest"):
        open_frames(store, check=True)


@pytest.mark.parametrize("unit", ["frame", "drive"])
def test_smaller_fractions_lie_within_larger_ones(built, unit):
    frames = open_frames(built).encoder
    train = frames.indices("train")
    assert len(train) == 96
    parts = [frames.subset(fraction, unit, seed=3) for fraction in (1.0, 0.5, 0.25)]
    np.testing.assert_array_equal(parts[0], train)
    for large, small in itertools.pairwise(parts):
        assert set(small) < set(large)
        assert (np.diff(small) > 0).all()
    if unit == "frame":
        assert [len(part) for part in parts] == [96, 48, 24]
    else:
        drives = frames.labels["episode"].to_numpy()
        for part in parts:
            np.testing.assert_array_equal(part, train[np.isin(drives[train], drives[part])])
    assert not np.array_equal(frames.subset(0.5, unit, seed=3), frames.subset(0.5, unit, seed=4))


@pytest.mark.parametrize(("fraction", "says"), [(0.0, "above 0"), (1.5, "at most 1"), (0.001, "none at all")])
def test_a_fraction_that_makes_no_sense_is_refused(built, fraction, says):
    with pytest.raises(BadInputError, match=says):
        open_frames(built).encoder.subset(fraction, "frame", 0)


def test_an_epochs_order_follows_from_seed_and_epoch(built):
    indices = open_frames(built).encoder.indices("train")
    order = epoch_order(indices, 1, 2)
    np.testing.assert_array_equal(np.sort(order), indices)
    np.testing.assert_array_equal(order, epoch_order(indices, 1, 2))
    assert not np.array_equal(order, epoch_order(indices, 1, 3))
    assert not np.array_equal(order, epoch_order(indices, 2, 2))


def test_the_frames_are_those_of_the_format_version(built):
    """Code that changes the frames must raise FORMAT_VERSIONS["frames"], and then this digest."""
    assert (FORMAT_VERSIONS["frames"], open_frames(built).manifest["digest"]) == (3, "9cec91394ac5661d")
