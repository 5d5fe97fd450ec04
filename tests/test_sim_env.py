"""TownEnv as a gymnasium environment, and its look-ups against highway-env's own."""

import warnings

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from highway_env.road.road import RoadNetwork

from study.config.paper import ACCELERATIONS
from study.config.settings import DynamicsSettings, TownSettings
from study.errors import BadInputError
from study.sim.autopilot import REACH
from study.sim.dynamics import DT
from study.sim.env import EGO, TownEnv, Traffic, make_traffic

SMALL = TownSettings(rows=3, columns=3, dropped_edges=0, vehicles=12)


def test_gymnasiums_own_check_passes_without_a_warning() -> None:
    env = gym.make("study.sim.register:study/Town-v0", config={"town": SMALL})
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env.unwrapped, skip_render_check=True)


def test_same_seed_same_drive_and_another_seed_another() -> None:
    def drive(seed: int) -> np.ndarray:
        env = TownEnv({"town": SMALL, "seed": seed})
        for _ in range(50):
            env.step(None)
        return np.array(env.road.pose())

    assert np.array_equal(drive(1), drive(1))
    assert not np.array_equal(drive(1), drive(2))


def test_a_seed_given_to_reset_decides_like_one_in_the_settings() -> None:
    env = TownEnv({"town": SMALL})
    first, _ = env.reset(seed=5)
    assert np.array_equal(first, TownEnv({"town": SMALL, "seed": 5}).reset()[0])
    assert not np.array_equal(first, env.reset()[0])  # nobody asked for the same town again


def test_the_ego_obeys_its_action_and_the_autopilot_drives_without_one() -> None:
    env = TownEnv({"town": SMALL, "seed": 2})
    for _ in range(10):
        env.step((0, np.array([0.1], np.float32)))
    assert env.vehicle.speed == pytest.approx(0, abs=1e-9)
    assert env.road.decisions.steering[EGO] == pytest.approx(0.1)
    speeds = []
    for _ in range(60):
        *_, terminated, _, _ = env.step(None)
        assert not terminated
        speeds.append(env.vehicle.speed)
    assert max(speeds) > 3


def test_positive_steering_turns_left() -> None:
    env = TownEnv({"town": SMALL, "seed": 2})
    before = env.vehicle.heading
    env.step((1, np.array([0.2], np.float32)))
    assert env.vehicle.heading < before  # highway-env's y points down, so its headings grow to the right


def test_leaving_the_way_ends_the_episode() -> None:
    env = TownEnv({"town": SMALL, "seed": 3})
    steps, terminated = 0, False
    while not terminated:
        *_, terminated, _, _ = env.step((2, np.array([0.15], np.float32)))
        steps += 1
    assert 5 < steps < 100
    assert abs(env.road.fleet.lateral[EGO]) > 4


def test_a_crash_costs_and_ends_the_episode() -> None:
    env = TownEnv({"town": TownSettings(vehicles=100), "seed": 0})
    env.road.vehicles[1].position = env.vehicle.position + 4 * env.vehicle.direction
    _, reward, terminated, _, _ = env.step((2, np.zeros(1, np.float32)))
    assert reward == -1
    assert terminated


def test_settings_may_be_given_as_plain_values() -> None:
    env = TownEnv({"town": SMALL.model_dump(), "dynamics": {"steering_unit": 0.5}, "seed": 2})
    assert env.action_space[1].high == pytest.approx(np.pi / 3 / 0.5)
    env.step((1, np.array([0.2], np.float32)))
    assert env.road.wheel[EGO] == pytest.approx(-0.1)


def test_towns_without_room_for_the_vehicles_are_refused() -> None:
    with pytest.raises(BadInputError, match="take at most"):
        make_traffic(TownSettings(rows=3, columns=3, dropped_edges=0, vehicles=5000), 0)


def test_a_crashed_vehicle_is_replaced_by_a_new_one_elsewhere() -> None:
    road = make_traffic(TownSettings(vehicles=30), 0)
    road.vehicles[1].position = road.vehicles[0].position + 4 * road.vehicles[0].direction
    there = road.vehicles[0].position.copy()
    road.act()
    road.step(DT)
    assert road.crashed == [0, 1]
    assert road.collided == 2
    assert sorted(road.agents) == [*range(2, 30), 30, 31]
    assert np.hypot(*(road.vehicles[0].position - there)) > 10


# --- against highway-env's own look-ups -----------------------------------------------------------------------------


@pytest.fixture(scope="module")
def both() -> tuple[Traffic, Traffic]:
    settings = TownSettings(vehicles=24)
    return make_traffic(settings, 0), make_traffic(settings, 0, fast=False)


def test_the_closest_lane_is_highway_envs_anywhere(both: tuple[Traffic, Traffic]) -> None:
    fast, _ = both
    rng = np.random.default_rng(0)
    network = fast.network
    low, high = network.start.min(axis=0) - 60, network.start.max(axis=0) + 60
    anywhere = rng.uniform(low, high, (60, 2))
    on_lanes = [  # at their ends above all
        lane.position(s, 0) + rng.choice([0.0, 0.3], 2) * rng.standard_normal(2)
        for lane in network.lanes[::5]
        for s in (0.0, lane.length / 3, lane.length)
    ]
    positions = np.concatenate([anywhere, on_lanes])
    headings = rng.choice([0, 0.5, 1, 1.5], len(positions)) * np.pi + rng.choice([0, 0.2]) * rng.standard_normal()
    expected = [
        RoadNetwork.get_closest_lane_index(network, position, heading)
        for position, heading in zip(positions, headings, strict=True)
    ]
    assert [network.indices[k] for k in network.closest_lanes(positions, headings)] == expected
    assert network.get_closest_lane_index(positions[0], headings[0]) == expected[0]


def test_vehicles_near_each_other_are_the_same(both: tuple[Traffic, Traffic]) -> None:
    fast, stock = both
    pose = fast.pose()
    for one, other in zip(fast.pairs_within(REACH, pose), stock.pairs_within(REACH, pose), strict=True):
        assert np.array_equal(one, other)


def test_drives_with_highway_envs_own_look_ups_are_equal_bit_for_bit() -> None:
    settings, dynamics = (
        TownSettings(vehicles=20, per_drive=True, road_limits=()),
        DynamicsSettings(lag=0.3, wheel_lag=0.1),
    )
    fast, stock = (make_traffic(settings, 3, dynamics, fast=fast) for fast in (True, False))
    for step in range(60):
        for road in (fast, stock):
            road.commands = {0: (ACCELERATIONS[2], 0.0)}  # straight on, off its lane sooner or later
            if step == 20:  # collisions are a part of it
                road.vehicles[1].position = road.vehicles[2].position + 6 * road.vehicles[2].direction
            road.act()
            road.step(DT)
        assert all(np.array_equal(one, other) for one, other in zip(fast.pose(), stock.pose(), strict=True))
        assert [v.lane_index for v in fast.vehicles] == [v.lane_index for v in stock.vehicles]
        assert fast.agents == stock.agents
    assert fast.collided == stock.collided > 0
