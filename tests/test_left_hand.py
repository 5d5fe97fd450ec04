"""Left-hand traffic: the town, its drives and what is made of them are the mirror image of right-hand traffic's."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from study.birdview.renderer import Renderer, valid_moments
from study.config.files import load_profile
from study.config.keys import recording_key
from study.config.settings import DynamicsSettings, RecordingSettings, StudySettings, TownSettings
from study.data.frames import FrameStore, open_frames
from study.data.prepare import data_flow, frames_folder
from study.driving.actors import Actor, Expert, FunctionActor
from study.driving.drives import Drive
from study.driving.metrics import progress, score_drive
from study.driving.rollout import rollout
from study.engine.flows import run_flow
from study.environments import BirdviewTownEnv
from study.episode.checks import check_episode
from study.episode.schema import Episode
from study.randomness import rng
from study.sim.env import TownEnv
from study.sim.geometry import LANE_WIDTH
from study.sim.record import record_episode
from study.sim.town import draw_town

TOWN = {"rows": 3, "columns": 4, "dropped_edges": 1, "vehicles": 20}
SIDES = ("right", "left")
SAME = ("present", "x", "speed", "acceleration", "light", "light_distance", "light_state", "route_s", "lead_gap")
RECORDING = RecordingSettings(warm_up=1.0, duration=12.0)


def town_of(side: str, **settings: object) -> TownSettings:
    return TownSettings.model_validate(TOWN | settings | {"traffic": side})


def drives(seed: int, dynamics: DynamicsSettings = DynamicsSettings(), **town: object) -> list[Episode]:  # noqa: B008
    return [record_episode(town_of(side, **town), dynamics, RECORDING, seed) for side in SIDES]


@pytest.fixture(scope="module")
def pair() -> list[Episode]:
    return drives(1)


def assert_mirrored(right: Episode, left: Episode) -> None:
    for name in SAME:
        assert np.array_equal(
            getattr(right, name), getattr(left, name), equal_nan=name in {"light_distance", "lead_gap"}
        )
    assert np.array_equal(right.y, -left.y)
    assert np.array_equal(right.steering, -left.steering)
    turned = np.angle(np.exp(1j * (right.heading.astype(np.float64) + left.heading)))
    assert np.abs(turned).max() < 1e-6  # [rad] an angle's float32


@pytest.mark.parametrize("seed", [1, 2])
@pytest.mark.parametrize("dynamics", [DynamicsSettings(), DynamicsSettings(lag=0.4, wheel_lag=0.1)])
@pytest.mark.parametrize("per_drive", [False, True])
def test_a_drive_is_the_mirror_image_of_the_same_seeds(seed: int, dynamics: DynamicsSettings, per_drive: bool) -> None:
    right, left = drives(seed, dynamics, per_drive=per_drive)
    check_episode(left, "here")
    assert_mirrored(right, left)
    assert np.abs(right.steering).max() > 0.2
    for one, other in zip(right.routes, left.routes, strict=True):
        assert np.array_equal(one * [1, -1], other)
    for lane, other_lane in zip(right.lanes, left.lanes, strict=True):
        assert np.array_equal(lane.centre * [1, -1], other_lane.centre)
        assert (lane.left, lane.right, lane.speed_limit) == (other_lane.right, other_lane.left, other_lane.speed_limit)
    for light, other_light in zip(right.lights, left.lights, strict=True):
        assert np.array_equal(light.stop_line * [1, -1], other_light.stop_line)


def test_traffic_keeps_to_its_side_and_the_setting_is_recorded(pair: list[Episode]) -> None:
    for episode, side, border, sign in zip(pair, SIDES, ("left", "right"), (1, -1), strict=True):
        assert TownSettings.model_validate(episode.source["town"]).traffic == side
        straight = [lane for lane in episode.lanes if not lane.junction and len(lane.centre) == 2]
        assert {getattr(lane, border) for lane in straight} == {"solid", "dashed"}
        for lane in [lane for lane in straight if getattr(lane, border) == "solid"]:
            direction = lane.centre[1] - lane.centre[0]
            aside = sign * np.array([-direction[1], direction[0]]) / np.hypot(*direction)
            oncoming = lane.centre[::-1] + aside * LANE_WIDTH
            assert any(np.allclose(oncoming, other.centre, atol=1e-3) for other in straight)


@pytest.mark.parametrize("side", SIDES)
def test_turns_are_named_by_where_they_lead_and_those_across_oncoming_traffic_yield(side: str) -> None:
    town = draw_town(town_of(side), rng(3, "test town"))
    bends = {"left": -1, "straight": 0, "right": 1}  # headings grow to the right
    for way in town.movements:
        start, end = (town.strips[number].piece.heading for number in (way.entry, way.exit))
        assert round(np.sin(end - start)) == bends[way.turn]
        arm = [[1, 0], [0, 1], [-1, 0], [0, -1]][way.arm]
        assert np.allclose([-np.cos(start), -np.sin(start)], arm, atol=1e-9)
    meet = town.opposing & ~np.isnan(town.enter)
    assert meet.any()
    crosses = np.array([way.turn == town.yielding for way in town.movements])
    assert (crosses[:, None] ^ crosses[None])[meet].all()
    assert town.yielding == {"right": "left", "left": "right"}[side]


def test_what_was_made_before_the_setting_keeps_its_key() -> None:
    assert recording_key(StudySettings()) == "9cfa46b66134d2cc"
    assert "traffic" not in TownSettings(traffic="right").model_dump()
    left = StudySettings(town=TownSettings(traffic="left"))
    assert recording_key(left) != recording_key(StudySettings())
    assert StudySettings.model_validate(left.model_dump(mode="json")) == left


# --- bird views and frames ------------------------------------------------------------------------------------------


def assert_pictures_mirrored(right: np.ndarray, left: np.ndarray) -> None:
    """Edges are painted hard, at four pixels for one, so what is painted lies a quarter of a pixel aside at most."""
    away = np.abs(right.astype(int) - left[:, :, ::-1].astype(int)).max(axis=-1)
    assert (away > 32).mean() < 0.03  # of all pixels; 0.022 when this was written
    assert (away > 64).mean() < 1e-4
    plain = np.abs(right.astype(int) - left.astype(int)).max(axis=-1)
    assert (plain > 64).mean() > 0.05  # not mirrored, they are other pictures


def test_bird_views_and_masks_are_mirrored(pair: list[Episode]) -> None:
    settings = StudySettings().birdview
    moments = valid_moments(pair[0], settings)[::29]
    (right, masks), (left, other) = (Renderer(episode, settings).render(moments) for episode in pair)
    assert len(right) > 40
    assert_pictures_mirrored(right, left)
    one, two = (np.unpackbits(each, axis=2).reshape(len(each), -1, 64, 64) for each in (masks, other))
    assert (one != two[..., ::-1]).mean() < 1e-4
    assert one.mean() > 0.005


@pytest.fixture(scope="module")
def stores(tmp_path_factory: pytest.TempPathFactory) -> list[FrameStore]:
    opened = []
    for side in SIDES:
        recording = {"warm_up": 1, "duration": 6, "encoder_episodes": 2, "policy_episodes": 2}
        town = TOWN | {"traffic": side}
        settings = load_profile(
            "smoke", {"town": town, "recording": recording, "frames": {"encoder": 40, "policy": 80}}
        )
        root: Path = tmp_path_factory.mktemp(side)
        run_flow(data_flow(settings, root))
        opened.append(open_frames(frames_folder(settings, root), check=True))
    return opened


@pytest.mark.parametrize("name", ["encoder", "policy"])
def test_frames_are_the_same_moments_with_mirrored_steering(name: str, stores: list[FrameStore]) -> None:
    right, left = (getattr(store, name) for store in stores)
    same = ["episode", "agent", "step", "train", "acceleration", "speed", "light", "light_distance", "lead_gap"]
    same += [
        "standing",
        "last_acceleration",
        "keyframe",
        "weight",
    ]  # not limit: at a stop line, two lanes are equally near
    assert right.labels[same].equals(left.labels[same])
    for column in ("steering", "last_steering"):
        assert np.array_equal(right.labels[column], -left.labels[column])
    chosen = [store.manifest["sets"][name]["chosen"]["all"]["steering"] for store in stores]
    assert chosen[0] == chosen[1][::-1]
    assert_pictures_mirrored(right.images[:], left.images[:])


# --- driving --------------------------------------------------------------------------------------------------------


def weave(sign: int) -> FunctionActor:
    return FunctionActor(lambda seen: (sign * (0.01 + 0.1 * np.sin(float(seen.speeds[0]))), 2))


@pytest.mark.parametrize("make", [lambda _: Expert(), lambda _: Expert(cropped=True), weave])
@pytest.mark.parametrize("seed", [2_000_001, 2_000_003])
def test_a_mirrored_driver_scores_the_same(make: Callable[[int], Actor], seed: int) -> None:
    ends, scores = [], []
    for side, sign in zip(SIDES, (1, -1), strict=True):
        settings = StudySettings(town=town_of(side), recording=RecordingSettings(warm_up=3.0))
        (episode,) = rollout(Drive(seed, 0, 8.0), make(sign), settings)
        ends.append(episode)
        scores.append(score_drive(episode, 60.0))
    assert_mirrored(*ends)
    assert scores[0] == scores[1]
    assert progress(ends[0]) > 5


def test_highway_envs_observation_and_picture_are_mirrored() -> None:
    envs = [
        TownEnv({"town": town_of(side), "seed": 2, "offscreen_rendering": True}, render_mode="rgb_array")
        for side in SIDES
    ]
    signs = np.array([1, 1, -1, -1, -1, -1, -1, 1, 1, 1])
    for step in range(60):
        steering = 0.05 * np.sin(step)
        right, left = (
            env.step((2, np.array([sign * steering], np.float32))) for env, sign in zip(envs, (1, -1), strict=True)
        )
        assert right[0] == pytest.approx(left[0] * signs, abs=1e-6)
        assert right[1:4] == left[1:4]
    above, below = (env.render().astype(int) for env in envs)  # y points down
    away = np.abs(above - below[::-1]).max(axis=-1)
    assert (above != above[0, 0]).any(axis=-1).mean() > 0.005
    assert (away > 64).mean() < 0.002  # lines one pixel wide, which fall on the next one here and there
    assert (np.abs(above - below).max(axis=-1) > 64).mean() > 0.005


def test_the_environment_for_policies_takes_the_setting_and_shows_the_mirror_image() -> None:
    seen = []
    for side, sign in zip(SIDES, (1, -1), strict=True):
        env = BirdviewTownEnv({"town": TOWN | {"traffic": side}, "recording": {"warm_up": 1}})
        env.reset(seed=4)
        views = [env.step((2, np.array([sign * 0.02], np.float32)))[0] for _ in range(8)]
        seen.append(np.stack(views))
    assert_pictures_mirrored(*seen)
