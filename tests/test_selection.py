"""Selection: spacing, split and balance of the frames."""

import numpy as np
import pytest

from study.config.paper import ACCELERATIONS
from study.config.settings import BirdviewSettings, FramesSettings
from study.data.selection import LABELS, STANDING, candidates, choose, histograms, rake
from study.episode.files import read_episode
from study.errors import BadInputError
from tests.support.drives import write_drives

VIEW = BirdviewSettings()
TEN = [f"drive {number}" for number in range(10)]  # each a recording of its own
STEERING = np.array([0.1, 0.1, 0.1, 0.4, 0.1, 0.1, 0.1])
CLASSES = np.full(3, 1 / 3)
STAND = np.array([0.92, 0.08])


@pytest.fixture(scope="module")
def drives(tmp_path_factory):
    return write_drives(tmp_path_factory.mktemp("drives"), 10)


@pytest.fixture(scope="module")
def pool(drives):
    """Return candidates of ten drives for the policy set, half a second apart."""
    return pool_of(drives, FramesSettings(spacing=0.5))


def pool_of(drives, settings, name="policy"):
    tables = [candidates(path, number, name, settings, VIEW) for number, path in enumerate(drives)]
    return {key: np.concatenate([table[key] for table in tables]) for key in LABELS}


@pytest.mark.parametrize(("spacing", "steps"), [(0.1, 1), (0.75, 8), (2.0, 20)])
def test_two_frames_of_a_vehicle_lie_apart(drives, spacing, steps):
    columns = pool_of(drives[:2], FramesSettings(spacing=spacing))
    vehicle = columns["episode"] * 1000 + columns["agent"]
    gaps = np.concatenate([np.diff(columns["step"][vehicle == one]) for one in np.unique(vehicle)])
    assert gaps.min() == steps


def test_labels_are_those_of_the_episode(drives, pool):
    episode = read_episode(drives[3])
    ids = [agent.id for agent in episode.agents]
    rows = np.flatnonzero(pool["episode"] == 3)
    assert len(rows) > 50
    for row in rows[::7]:
        at = (pool["step"][row], ids.index(pool["agent"][row]))
        assert (-1.0, 0.5, 1.0)[pool["acceleration"][row]] == episode.acceleration[at]
        for name in ("steering", "speed", "light_distance", "lead_gap"):
            np.testing.assert_equal(pool[name][row], getattr(episode, name)[at])
        near = episode.light[at] >= 0 and episode.light_distance[at] <= 27
        assert pool["light"][row] == (episode.light_state[at[0], episode.light[at]] if near else 0)
        assert pool["standing"][row] == (episode.speed[at] < STANDING)


def test_standing_moments_are_thinned_for_the_encoder_set_only(drives):
    shares = {
        (name, weight): pool_of(drives, FramesSettings(spacing=0.2, standing_weight=weight), name)["standing"].sum()
        for name in ("encoder", "policy")
        for weight in (0.0, 0.3, 1.0)
    }
    assert shares["encoder", 0.0] == 0
    assert 0.2 < shares["encoder", 0.3] / shares["encoder", 1.0] < 0.4
    assert shares["policy", 0.0] == shares["policy", 1.0] > 0


def test_drives_are_split_before_frames(pool):
    """Exact sizes, and no drive on both sides."""
    rows, decided, test_drives = choose(pool, "encoder", 200, TEN, FramesSettings())
    train = decided["train"]
    assert len(np.unique(rows)) == 200
    assert train.sum() == 160
    assert len(test_drives) == 2
    np.testing.assert_array_equal(np.unique(pool["episode"][rows[~train]]), test_drives)
    assert not set(pool["episode"][rows[train]]) & set(test_drives)


@pytest.mark.parametrize("seed", range(12))
def test_parts_of_one_recording_are_never_on_both_sides(seed):
    """Any number of recordings, cut into any number of parts, in any order: as near the share as whole ones can be."""
    rng = np.random.default_rng(seed)
    sizes = rng.integers(1, 6, rng.integers(2, 9))
    recordings = rng.permutation(np.repeat([f"log {number}" for number in range(len(sizes))], sizes)).tolist()
    drives = np.repeat(np.arange(len(recordings)), 40)
    columns = {"episode": drives, "step": np.arange(len(drives))}
    wanted = len(drives) // 5
    rows, decided, test_drives = choose(columns, "encoder", wanted, recordings, FramesSettings(seed=seed))
    sides = [{recordings[drive] for drive in drives[rows[side]]} for side in (decided["train"], ~decided["train"])]
    assert all(sides)
    assert not sides[0] & sides[1]
    assert {drive for drive in range(len(recordings)) if recordings[drive] in sides[1]} == set(test_drives)
    assert abs(len(test_drives) - 0.2 * len(recordings)) <= sizes.max()


def test_drives_of_a_single_recording_cannot_be_split(pool):
    with pytest.raises(BadInputError, match=r"of 1 recording.*frames\.split frame"):
        choose(pool, "encoder", 100, ["log"] * 10, FramesSettings())


def test_the_literal_split_mixes_frames_of_a_drive(pool):
    rows, decided, test_drives = choose(pool, "encoder", 200, TEN, FramesSettings(split="frame"))
    train = decided["train"]
    assert (len(rows), train.sum(), test_drives) == (200, 160, [])
    assert set(pool["episode"][rows[~train]]) <= set(pool["episode"][rows[train]])


def test_seeds_choose_differently_and_repeatably(pool):
    first, again, other = (choose(pool, "encoder", 200, TEN, FramesSettings(seed=seed))[0] for seed in (0, 0, 1))
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, other)


def test_the_policy_set_has_the_shares_it_should_have(pool):
    """Each split by itself: the drives have enough of everything at this size."""
    before = histograms(pool, np.ones(len(pool["step"]), bool))
    assert abs(before["standing"] / before["frames"] - 0.08) > 0.1  # else the test could not fail
    rows, decided, _ = choose(pool, "policy", 250, TEN, FramesSettings())
    train = decided["train"]
    for part, number in ((rows[train], 200), (rows[~train], 50)):
        after = histograms({key: values[part] for key, values in pool.items()}, np.ones(len(part), bool))
        assert after["frames"] == number
        np.testing.assert_allclose(np.array(after["steering"]) / number, STEERING, atol=0.04)
        np.testing.assert_allclose(np.array(after["acceleration"]) / number, CLASSES, atol=0.04)
        assert after["standing"] / number == pytest.approx(0.08, abs=0.03)
        assert after["majority_accuracy"] == pytest.approx(1 / 3, abs=0.04)


def test_weighted_policy_frames_are_distributed_as_the_moments_they_were_chosen_from(pool):
    """Only where raking leaves some frame of every kind: weights cannot speak for kinds that are gone."""
    rows, decided, test_drives = choose(pool, "policy", 250, TEN, FramesSettings())
    for part, inside in ((decided["train"], False), (~decided["train"], True)):
        weight, here = decided["weight"][part], np.isin(pool["episode"], test_drives) == inside
        assert weight.mean() == pytest.approx(1, abs=1e-5)
        for name in ("standing", "acceleration"):
            chosen = pool[name][rows[part]]
            for value in np.unique(pool[name]):
                share = (weight * (chosen == value)).sum() / weight.sum()
                assert share == pytest.approx((pool[name][here] == value).mean(), abs=0.05)


def test_a_keyframe_is_a_moment_whose_class_has_just_changed(drives):
    path = drives[0]
    table = candidates(path, 0, "policy", FramesSettings(spacing=0.1), VIEW)
    episode = read_episode(path)
    place = {agent.id: index for index, agent in enumerate(episode.agents)}
    assert 0.05 < table["keyframe"].mean() < 0.95
    for step, agent, keyframe, last, steering in zip(
        *(table[name] for name in ("step", "agent", "keyframe", "last_acceleration", "last_steering")), strict=True
    ):
        commands = episode.acceleration[:, place[agent]]
        assert keyframe == (commands[step - 5 : step] != commands[step]).any()
        assert ACCELERATIONS[last] == commands[step - 1]
        assert steering == episode.steering[step - 1, place[agent]]


def test_balancing_on_steering_alone_leaves_the_rest(pool):
    """The control of the paper's words: steering is raked, classes follow the drives."""
    rows, _, _ = choose(pool, "policy", 250, TEN, FramesSettings(balance="steering"))
    after = histograms({key: values[rows] for key, values in pool.items()}, np.ones(250, bool))
    np.testing.assert_allclose(np.array(after["steering"]) / 250, STEERING, atol=0.03)
    assert after["acceleration"][0] / 250 > 0.45
    rows, _, _ = choose(pool, "policy", 250, TEN, FramesSettings(balance="none"))
    natural = histograms({key: values[rows] for key, values in pool.items()}, np.ones(250, bool))
    before = histograms(pool, np.ones(len(pool["step"]), bool))
    np.testing.assert_allclose(
        np.array(natural["steering"]) / 250, np.array(before["steering"]) / before["frames"], atol=0.09
    )


@pytest.mark.parametrize(("name", "setting"), [("encoder", "recording.encoder_episodes"), ("policy", "frames.policy")])
def test_too_few_candidates_are_refused_with_the_setting_to_change(pool, name, setting):
    with pytest.raises(BadInputError, match=rf"{name} set needs 8000 training frames and its drives give .*{setting}"):
        choose(pool, name, 10_000, TEN, FramesSettings())


def margins(counts, axis):
    return counts.sum(axis=tuple(other for other in range(counts.ndim) if other != axis)) / counts.sum()


def test_raking_meets_margins_that_can_be_met():
    available = np.random.default_rng(0).integers(400, 5000, (7, 3, 2))
    counts = rake(available, {0: STEERING, 1: CLASSES, 2: STAND}, 3000, 20.0)
    assert counts.sum() == 3000
    assert (counts <= available).all()
    for axis, shares in enumerate((STEERING, CLASSES, STAND)):
        np.testing.assert_allclose(margins(counts, axis), shares, atol=0.01)


@pytest.mark.parametrize("seed", range(8))
def test_raking_never_takes_more_than_there_is(seed):
    """Whatever is scarce or missing, the number is met, and the margins come nearer than without raking."""
    rng = np.random.default_rng(seed)
    available = rng.integers(0, 300, (7, 3, 2)) * (rng.random((7, 3, 2)) < 0.6)
    total = int(available.sum() * 0.7)
    counts = rake(available, {0: STEERING, 1: CLASSES}, total, 20.0)
    assert counts.sum() == total
    assert ((counts >= 0) & (counts <= available)).all()
    far = {name: np.abs(margins(table, 1) - CLASSES).sum() for name, table in (("raked", counts), ("raw", available))}
    assert far["raked"] <= far["raw"] + 0.01


def test_weights_are_capped():
    """A rare cell gives at most `cap` times its share, although it has more."""
    available = np.array([10_000, 100])
    counts = rake(available, {0: np.array([0.5, 0.5])}, 150, 4.0)
    assert counts[1] == np.ceil(4 * 150 * 100 / 10_100)
    assert rake(available, {0: np.array([0.5, 0.5])}, 150, 100.0)[1] == 75


def test_a_cap_below_one_is_refused():
    with pytest.raises(BadInputError, match="weight_cap"):
        rake(np.full((7, 3, 2), 100), {0: STEERING}, 3000, 0.5)
