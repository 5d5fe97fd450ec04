"""The true state: what the expert decides by, read from the frames' labels and the drives they came from."""

import hashlib

import numpy as np
import pandas as pd
import pytest

from study.config.keys import FORMAT_VERSIONS
from study.config.settings import BirdviewSettings, FramesSettings
from study.data.past_speeds import past_speeds
from study.data.selection import candidates
from study.data.true_state import scaled_state, state_scale, stored_state
from study.episode.files import read_episode
from study.episode.head import episode_digest
from study.errors import BadInputError
from tests.support.drives import write_drives

COUNT = 3


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("drives")
    write_drives(folder, COUNT)
    return folder


@pytest.fixture(scope="module")
def labels(folder):
    """Return candidate moments of all drives; the last drive is for testing."""
    settings = FramesSettings(spacing=0.3), BirdviewSettings()
    parts = [candidates(path, number, "policy", *settings) for number, path in enumerate(sorted(folder.iterdir()))]
    table = pd.concat([pd.DataFrame(part) for part in parts], ignore_index=True)
    return table.assign(train=table["episode"] < COUNT - 1)


@pytest.fixture(scope="module")
def sources(folder):
    return [{"name": path.name, "digest": episode_digest(path)} for path in sorted(folder.iterdir())]


def true_state(labels, sources, folder):
    columns = stored_state(labels, sources, folder)
    return scaled_state(columns, state_scale(columns, labels["train"].to_numpy()))


@pytest.fixture(scope="module")
def state(labels, sources, folder):
    return true_state(labels, sources, folder)


def linear(state, target):
    """Return R2 of the best linear model of all frames."""
    inside = np.column_stack([state, np.ones(len(state))]).astype(np.float64)
    error = target - inside @ np.linalg.lstsq(inside, target, rcond=None)[0]
    return 1 - (error**2).sum() / ((target - target.mean()) ** 2).sum()


def test_what_the_expert_decides_by_can_be_read_off(state, labels, sources, folder):
    episodes = [read_episode(folder / source["name"]) for source in sources]
    targets = {
        "speed": labels["speed"],
        "speed a second ago": [
            episodes[row.episode].speed[row.step - 10, row.agent - 100] for row in labels.itertuples()
        ],
        "red": labels["light"] == 2,
        "gap": labels["lead_gap"].fillna(40.0).clip(upper=40.0),
        "line": labels["light_distance"].fillna(40.0).clip(upper=40.0),
    }
    assert (state.shape, state.dtype) == ((len(labels), 64), np.float32)
    for name, target in targets.items():
        assert linear(state, np.asarray(target, np.float64)) > 0.99, name


def test_no_number_of_a_test_frame_is_used_for_scaling(state, labels, sources, folder):
    other = labels.assign(speed=labels["speed"].where(labels["train"], 3.0))
    train = labels["train"].to_numpy()
    assert np.array_equal(true_state(other, sources, folder)[train], state[train])


def test_past_speeds_are_those_of_the_drives_and_begin_with_the_label(labels, sources, folder):
    """A step before the drive began counts as unchanged."""
    episodes = [read_episode(folder / source["name"]) for source in sources]
    speeds = past_speeds(labels, sources, folder, range(10))
    np.testing.assert_allclose(speeds[:, 0], labels["speed"], rtol=1e-6)
    expected = [
        episodes[row.episode].speed[row.step - 9, row.agent - 100] if row.step >= 9 else row.speed
        for row in labels.itertuples()
    ]
    np.testing.assert_allclose(speeds[:, 9], expected, rtol=1e-6)


def test_other_drives_than_the_frames_were_made_from_are_refused(labels, sources, folder, tmp_path):
    for wrong in ([source | {"digest": "0"} for source in sources], [source | {"name": "gone"} for source in sources]):
        with pytest.raises(BadInputError, match="state of --baselines"):
            true_state(labels, wrong, folder)
    with pytest.raises(BadInputError, match="state of --baselines"):
        true_state(labels, sources, tmp_path)


def test_the_same_labels_and_drives_give_the_known_state(state):
    """Code that changes the state must raise FORMAT_VERSIONS["baseline"], and then this digest."""
    digest = hashlib.sha256(state.round(3).tobytes()).hexdigest()[:16]
    assert (FORMAT_VERSIONS["baseline"], digest) == (1, "e70fcb2f5c841dca")
