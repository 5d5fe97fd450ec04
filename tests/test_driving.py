"""Driving: rollouts of actors in held-out drives, and what is scored of them."""

import dataclasses
import hashlib

import numpy as np
import pytest

from study.analysis.comfort import comfortable
from study.birdview.renderer import Image, Renderer
from study.config.paper import ACCELERATIONS, STEERING_CROP
from study.config.settings import BirdviewSettings, DrivingSettings, RecordingSettings, StudySettings, TownSettings
from study.data.prepare import POLICY_SEED
from study.driving.actors import (
    Expert,
    ExportedActor,
    FunctionActor,
    PolicyActor,
    image_encoder,
)
from study.driving.driver import Driver
from study.driving.drives import Drive, held_out_drives
from study.driving.faults import at_fault, collision_kind
from study.driving.metrics import DriveScores, collisions_per_km, progress, score_drive
from study.driving.observations import Observation
from study.driving.ride import BLOCKED
from study.driving.rollout import ActorError, rollout
from study.driving.surface import beyond_lanes, off_road
from study.encoder.networks import untrained_encoder
from study.episode.checks import check_episode
from study.episode.schema import GREEN, RED, YELLOW, Episode, Lane
from study.errors import BadInputError
from study.policy.latents import normalisation
from study.policy.networks import slots
from study.randomness import rng
from study.statistics.proportions import wilson_interval

SETTINGS = StudySettings(
    town=TownSettings(rows=3, columns=3, dropped_edges=0, vehicles=20), recording=RecordingSettings(warm_up=3.0)
)
DRIVE = Drive(2_000_001, 0, 12.0)
POLICIES = 3


def lasting(seconds: float) -> StudySettings:
    return SETTINGS.model_copy(update={"driving": DrivingSettings(duration=seconds)})


def still(seen: Observation) -> tuple[float, int]:
    return 0.0, 0


def blind(seen: Observation) -> tuple[float, int]:
    return 0.0, 2


def random_policies() -> dict[str, np.ndarray]:
    draw = rng(5, "test policies")
    weights = {
        slot.key: (draw.normal(size=(POLICIES, *slot.shape)) * 0.3).astype(np.float32)
        for name in ("steering", "acceleration")
        for slot in slots(name)
    }
    return weights | normalisation(draw.normal(size=(50, 64)).astype(np.float32), "zscore")


@pytest.fixture(scope="module")
def encoder() -> dict[str, np.ndarray]:
    return {name: value.numpy() for name, value in untrained_encoder(1).state_dict().items()}


@pytest.fixture(scope="module")
def policies(encoder: dict[str, np.ndarray]) -> PolicyActor:
    return PolicyActor("cell", image_encoder(encoder), random_policies())


def drive_of(episode: Episode) -> dict:
    facts: dict = episode.source["drive"]
    return facts


def ego_column(episode: Episode) -> int:
    return [agent.id for agent in episode.agents].index(drive_of(episode)["ego"])


def digest(episode: Episode) -> str:
    parts = [value.tobytes() for value in vars(episode).values() if isinstance(value, np.ndarray)]
    parts += [route.tobytes() for route in episode.routes]
    return hashlib.sha256(b"".join(parts) + repr(episode.source).encode()).hexdigest()


# --- what is seen and done --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("render", [256, 96])
def test_what_an_actor_sees_is_bit_for_bit_what_the_recorded_drive_renders_to(render: int) -> None:
    seen: list[Image] = []

    def weave(observation: Observation) -> tuple[float, int]:
        seen.append(observation.image.copy())
        return 0.1 * np.sin(len(seen) / 5), 1 if observation.speeds[0] > 3 else 2

    settings = SETTINGS.model_copy(update={"birdview": BirdviewSettings(render=render)})
    (episode,) = rollout(DRIVE, FunctionActor(weave), settings)
    first, ego = drive_of(episode)["first_step"], ego_column(episode)
    steps = np.arange(first, episode.steps)
    assert len(seen) == len(steps) > 20
    images, _ = Renderer(episode, settings.birdview).render(np.stack([steps, np.full(len(steps), ego)], axis=1))
    assert (images == np.array(seen)).all()
    assert len(np.unique(images[:, 40, 32], axis=0)) > 0
    assert not (images[0] == images[-1]).all()


def test_commands_are_cropped_and_recorded_and_their_speeds_are_seen() -> None:
    seen: list[Observation] = []

    def hard(observation: Observation) -> tuple[float, int]:
        seen.append(observation)
        return (-1.0 if len(seen) % 2 else 0.1), 1

    (episode,) = rollout(dataclasses.replace(DRIVE, duration=1.5), FunctionActor(hard), SETTINGS)
    check_episode(episode, "here")
    first, ego = drive_of(episode)["first_step"], ego_column(episode)
    assert episode.steering[first : first + 2, ego].tolist() == [np.float32(-SETTINGS.driving.crop), np.float32(0.1)]
    assert (episode.acceleration[first:, ego] == ACCELERATIONS[1]).all()
    assert (seen[3].speeds == episode.speed[first + 3 - np.arange(10), ego]).all()
    assert (seen[3].steering, seen[3].level) == (np.float32(-SETTINGS.driving.crop), 1)


def test_policies_of_a_cell_drive_side_by_side_in_towns_that_are_alike_until_they_act(policies: PolicyActor) -> None:
    episodes = rollout(dataclasses.replace(DRIVE, duration=3.0), policies, SETTINGS)
    assert len(episodes) == POLICIES
    first = drive_of(episodes[0])["first_step"]
    ego = ego_column(episodes[0])
    for number, episode in enumerate(episodes):
        assert drive_of(episode)["driver"] == number
        assert (episode.x[: first + 1] == episodes[0].x[: first + 1]).all()
    commands = {tuple(episode.steering[first : first + 5, ego].tolist()) for episode in episodes}
    assert len(commands) == POLICIES


def test_an_exported_network_drives_as_the_weights_do(policies: PolicyActor, encoder: dict[str, np.ndarray]) -> None:
    exported = ExportedActor("cell", Driver(encoder, random_policies()).eval(), POLICIES)
    drive = dataclasses.replace(DRIVE, duration=1.0)
    for one, other in zip(rollout(drive, policies, SETTINGS), rollout(drive, exported, SETTINGS), strict=True):
        ego = ego_column(one)
        assert np.allclose(one.steering[:, ego], other.steering[:, ego], atol=1e-4)
        assert (one.acceleration[:, ego] == other.acceleration[:, ego]).all()


def test_the_same_drive_gives_the_same_bytes_and_another_seed_another_drive(policies: PolicyActor) -> None:
    drive = dataclasses.replace(DRIVE, duration=2.0)
    once, again = (list(map(digest, rollout(drive, policies, SETTINGS))) for _ in range(2))
    assert once == again
    assert digest(rollout(dataclasses.replace(drive, seed=7), Expert(), SETTINGS)[0]) != digest(
        rollout(drive, Expert(), SETTINGS)[0]
    )


def test_the_way_of_the_ego_is_drawn_by_the_seed_whoever_drives() -> None:
    expert, other = (rollout(DRIVE, actor, SETTINGS)[0] for actor in (Expert(), FunctionActor(blind)))
    assert drive_of(expert)["ego"] == drive_of(other)["ego"]
    one, two = expert.routes[ego_column(expert)], other.routes[ego_column(other)]
    shared = min(len(one), len(two))
    assert (one[:shared] == two[:shared]).all()


def test_held_out_drives_are_none_of_the_recorded_ones() -> None:
    recording = SETTINGS.recording
    recorded = {recording.seed + k for k in range(recording.encoder_episodes)}
    recorded |= {recording.seed + POLICY_SEED + k for k in range(recording.policy_episodes)}
    here, unseen = (held_out_drives(SETTINGS, 20, unseen_towns=unseen) for unseen in (False, True))
    assert len({drive.seed for drive in (*here, *unseen)} | recorded) == 40 + len(recorded)
    assert {drive.town_seed for drive in here} == {recording.seed}
    assert len({drive.town_seed for drive in unseen}) == 20
    assert recording.seed not in {drive.town_seed for drive in unseen}


# --- scores -----------------------------------------------------------------------------------------------------------


def scores_of(actor: FunctionActor | Expert, drive: Drive, settings: StudySettings = SETTINGS) -> DriveScores:
    (expert,) = rollout(drive, Expert(), settings)
    (episode,) = rollout(drive, actor, settings)
    return score_drive(episode, progress(expert))


@pytest.mark.parametrize("unseen_towns", [False, True])
def test_the_expert_drives_without_fault(unseen_towns: bool) -> None:
    for drive in held_out_drives(lasting(25.0), 2, unseen_towns=unseen_towns):
        scores = scores_of(Expert(), drive)
        assert scores.route_completion == 1
        assert scores.driving_score == 100
        assert scores.success == 1
        assert scores.time == pytest.approx(25)
        assert scores.distance > 0.03
        assert 0.5 < scores.comfort <= 1


def test_one_policy_drives_as_it_does_among_the_others(policies: PolicyActor) -> None:
    among = rollout(DRIVE, policies, SETTINGS)
    for driver in (0, 2):
        (alone,) = rollout(DRIVE, policies, SETTINGS, only=[driver])
        assert drive_of(alone) == drive_of(among[driver])
        for name in ("x", "y", "steering", "acceleration"):
            np.testing.assert_array_equal(getattr(alone, name), getattr(among[driver], name))


def test_a_still_actor_is_blocked() -> None:
    scores = scores_of(FunctionActor(still), dataclasses.replace(DRIVE, duration=60.0))
    assert scores.blocked == 1
    assert scores.success == 0
    assert scores.driving_score < 20
    assert scores.time >= BLOCKED


def test_a_blind_actor_at_full_throttle_collides_or_runs_reds_or_leaves_its_way() -> None:
    drives = held_out_drives(lasting(30.0), 4)
    scores = [scores_of(FunctionActor(blind), drive) for drive in drives]
    assert not any(score.success for score in scores)
    assert sum(score.collision + score.red_lights for score in scores) > 0
    for score in scores:
        assert score.driving_score <= 100 * score.route_completion * 0.6**score.collision * 0.7**score.red_lights + 1e-9


def test_the_crop_of_the_paper_is_too_narrow_for_our_turns_and_a_wider_one_is_not() -> None:
    drive = Drive(2_000_000, 0, 20.0)
    settings = SETTINGS.model_copy(update={"town": TownSettings()})
    narrow, wide = (
        rollout(drive, Expert(cropped=True), settings.model_copy(update={"driving": DrivingSettings(crop=crop)}))[0]
        for crop in (STEERING_CROP, DrivingSettings().crop)
    )
    assert drive_of(narrow)["ended"] == "off route"
    assert drive_of(wide)["ended"] == "time"


def test_a_red_light_is_run_when_the_bumper_crosses_its_line() -> None:
    (episode,) = rollout(dataclasses.replace(DRIVE, duration=2.0), Expert(), SETTINGS)
    ego, first = ego_column(episode), drive_of(episode)["first_step"]
    steps = episode.steps - first
    light, distance = episode.light.copy(), episode.light_distance.copy()
    light[first:, ego], distance[first:, ego] = 0, 6.0 - np.arange(steps)  # across after the fourth step
    for state, count in ((RED, 1), (YELLOW, 0), (GREEN, 0)):
        states = np.full_like(episode.light_state, RED if state != RED else GREEN)
        states[first + 4, 0] = state
        run = dataclasses.replace(episode, light=light, light_distance=distance, light_state=states)
        assert score_drive(run, progress(episode)).red_lights == count
        assert score_drive(run, progress(episode)).driving_score == pytest.approx(70 if count else 100)


STREET = (Lane(0, np.array([[-50.0, 0.0], [50.0, 0.0]]), 3.5), Lane(1, np.array([[-50.0, 3.5], [50.0, 3.5]]), 3.5))


def test_points_off_the_road_are_those_that_are_beyond_every_lane() -> None:
    (episode,) = rollout(dataclasses.replace(DRIVE, duration=0.1), Expert(), SETTINGS)
    draw = rng(0, "test points")
    for spread in (5.0, 500.0):
        points = episode.lanes[0].centre[0] + draw.normal(size=(700, 2)) * spread
        expected = (beyond_lanes(points, episode.lanes) > 0.3).all(axis=1)
        assert (off_road(points, episode.lanes, 0.3) == expected).all()
        assert 0 < expected.sum() < len(points)


@pytest.mark.parametrize(
    ("ego", "other", "kind", "fault"),
    [
        ((0, 0, 0, 0), (4.5, 0, 0, 3), "stopped ego", False),
        ((0, 0, 0, 5), (4.9, 0, 0, 0), "stopped other", True),
        ((0, 0, 0, 5), (-4.9, 0, 0, 9), "rear", False),
        ((0, 0, 0, 9), (4.9, 0, 0, 5), "front", True),
        ((0, 0, 0, 9), (5.2, 0, 0, 2), "front", True),  # boxes that meet in the next step
        ((0, 0, 0, 5), (-1, 1.9, 0, 5), "lateral", False),  # the ego is within its lane
        ((0, 1.7, 0, 5), (-1, 3.6, 0, 5), "lateral", True),  # and here on its line
    ],
)
def test_faults_follow_the_rule_of_nuplan(ego: tuple, other: tuple, kind: str, fault: bool) -> None:  # noqa: FBT001
    poses = np.array(ego, float), np.array(other, float)
    assert collision_kind(*poses) == kind
    assert at_fault(*poses, STREET) == fault


def test_collisions_per_km_are_those_of_all_drives_over_their_way() -> None:
    quiet = scores_of(Expert(), dataclasses.replace(DRIVE, duration=3.0))
    crash = dataclasses.replace(quiet, collision=1.0, at_fault=1.0, distance=0.5)
    hit = dataclasses.replace(quiet, collision=1.0, distance=0.5)
    assert collisions_per_km([crash, hit, hit], at_fault=True) == pytest.approx(1 / 1.5)
    assert collisions_per_km([crash, hit, hit], at_fault=False) == pytest.approx(2 / 1.5)
    assert np.isnan(collisions_per_km([], at_fault=True))


def test_comfort_has_bounds_on_braking_and_turning() -> None:
    time = np.arange(60) / 10
    straight = np.zeros(60)
    assert comfortable(5 + time, straight, 10.0).all()
    assert not comfortable(np.maximum(20 - 5 * time, 0), straight, 10.0).all()
    assert not comfortable(np.full(60, 8.0), 1.2 * time, 10.0).any()
    assert comfortable(np.array([3.0]), np.array([0.0]), 10.0).all()


def test_rates_have_wilson_intervals() -> None:
    none, some = wilson_interval(0, 20), wilson_interval(5, 20)
    assert (none.value, none.low) == (0, pytest.approx(0))
    assert none.high == pytest.approx(0.1611, abs=1e-4)
    assert some.low < some.value == 0.25 < some.high
    assert some.n == 20
    assert np.isnan(wilson_interval(0, 0).value)


# --- faults -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("command", [(np.nan, 1), (0.0, -1), (0.0, 3), (0.0, np.nan), (np.inf, 1)])
def test_a_command_that_is_none_ends_the_drive_as_a_failure_with_the_reason(command: tuple[float, int]) -> None:
    calls: list[int] = []

    def fails(seen: Observation) -> tuple[float, int]:
        calls.append(1)
        return command if len(calls) > 5 else (0.0, 1)

    (episode,) = rollout(DRIVE, FunctionActor(fails), SETTINGS)
    assert drive_of(episode)["ended"] == "failure"
    assert "0.5 s into drive 2000001" in drive_of(episode)["reason"]
    assert f"{command[0]:g}" in drive_of(episode)["reason"]
    scores = score_drive(episode, 50.0)
    assert scores.failed == 1
    assert scores.success == 0
    check_episode(episode, "here")


def test_one_policy_with_nan_weights_does_not_end_the_drives_of_the_others(encoder: dict[str, np.ndarray]) -> None:
    weights = random_policies()
    weights["acceleration_0_weight"][1] = np.nan
    actor = PolicyActor("cell", image_encoder(encoder), weights)
    episodes = rollout(dataclasses.replace(DRIVE, duration=1.0), actor, SETTINGS)
    failed = [drive_of(episode)["ended"] == "failure" for episode in episodes]
    assert failed == [False, True, False]
    healthy = rollout(
        dataclasses.replace(DRIVE, duration=1.0),
        PolicyActor("cell", image_encoder(encoder), random_policies()),
        SETTINGS,
    )
    assert digest(episodes[0]) == digest(healthy[0])


def test_an_actor_that_raises_says_where() -> None:
    calls: list[int] = []

    def raises(seen: Observation) -> tuple[float, int]:
        calls.append(1)
        return (0.0, 1) if len(calls) < 4 else (0.0, {}["missing"])

    with pytest.raises(ActorError, match=r"'mine' raised KeyError: 'missing'; at 0.3 s of drive 2000001"):
        rollout(DRIVE, FunctionActor(raises, "mine"), SETTINGS)


def test_a_town_that_cannot_be_made_says_why() -> None:
    settings = SETTINGS.model_copy(update={"town": TownSettings(vehicles=5000)})
    with pytest.raises(BadInputError, match="vehicles do not fit"):
        rollout(DRIVE, Expert(), settings)
    with pytest.raises(BadInputError, match="shorter than one step"):
        rollout(dataclasses.replace(DRIVE, duration=0.01), Expert(), SETTINGS)


def test_commands_of_the_wrong_kind_are_refused_before_a_drive() -> None:
    weights = random_policies() | {"z_mean": np.zeros(70, np.float32)}
    with pytest.raises(BadInputError, match="take 70 numbers"):
        PolicyActor("cell", lambda seen: np.zeros((1, 64), np.float32), weights)
