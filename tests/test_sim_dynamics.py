"""How vehicles answer commands, and that the autopilot allows for it."""

import numpy as np
import pytest

from study.config.paper import ACCELERATIONS
from study.config.settings import DynamicsSettings, TownSettings
from study.errors import BadInputError
from study.sim.dynamics import BRAKE, DT, follow_command, stopping_distance
from study.sim.env import make_traffic

LIMITS = (30.0, 40.0, 50.0)


def test_a_value_follows_its_command_by_the_exact_exponential() -> None:
    value = np.zeros(1)
    for _ in range(4):
        value = follow_command(value, np.ones(1), 0.4)
    assert value == pytest.approx(1 - np.exp(-1))


def test_without_a_lag_the_command_acts_at_once_to_the_last_bit() -> None:
    value, command = np.random.default_rng(0).normal(size=(2, 100))
    assert np.array_equal(follow_command(value, command, 0.0), command)


@pytest.mark.parametrize("lag", [0.0, 0.2, 0.4, 0.6])
@pytest.mark.parametrize("force", [-5.0, 0.0, 2.0])
@pytest.mark.parametrize("speed", [3.0, 8.0, 14.0])
def test_the_way_to_a_stop_is_what_braking_takes(lag: float, force: float, speed: float) -> None:
    expected = stopping_distance(np.array([speed]), np.array([force]), lag)[0]
    dt, way, acting = 1e-3, 0.0, force
    while speed > 0:
        acting = -BRAKE if lag == 0 else acting + (-BRAKE - acting) * -np.expm1(-dt / lag)
        way, speed = way + speed * dt, speed + acting * dt
    assert expected == pytest.approx(way, abs=0.05)


def test_a_standing_vehicle_never_moves_backwards_and_starts_without_an_old_brake() -> None:
    road = make_traffic(TownSettings(vehicles=1), 0, DynamicsSettings(lag=0.5))
    speeds = []
    for level in [0] * 40 + [2] * 10:
        road.commands = {0: (ACCELERATIONS[level], 0.0)}
        road.act()
        road.step(DT)
        speeds.append(road.vehicles[0].speed)
    assert min(speeds) > -1e-9
    assert speeds[39] == pytest.approx(0, abs=1e-9)
    assert 0 < speeds[40] < 0.1  # a small part of 2.5 m/s2 in the first step
    assert (np.diff(speeds[40:]) > 0).all()


def test_a_wheel_lags_behind_its_label() -> None:
    road = make_traffic(TownSettings(vehicles=1), 0, DynamicsSettings(wheel_lag=0.2, steering_unit=1.0))
    angles = []
    for _ in range(8):
        road.commands = {0: (ACCELERATIONS[1], 0.1)}
        road.act()
        angles.append(-road.wheel[0])
        road.step(DT)
    assert angles[0] == pytest.approx(0.1 * (1 - np.exp(-0.5)))
    assert angles[-1] == pytest.approx(0.1, rel=0.05)


@pytest.mark.parametrize("hold", [0.0, 0.5])
@pytest.mark.parametrize(
    ("lag", "wheel_lag", "limits"), [(0.2, 0.1, ()), (0.4, 0.0, LIMITS), (0.6, 0.0, ()), (0.6, 0.2, LIMITS)]
)
def test_traffic_flows_without_collisions_whatever_the_lag(
    lag: float, wheel_lag: float, limits: tuple[float, ...], hold: float
) -> None:
    settings = TownSettings(brake_hold=hold, road_limits=limits, per_drive=hold == 0)
    road = make_traffic(settings, 4, DynamicsSettings(lag=lag, wheel_lag=wheel_lag))
    speeds, aside = [], 0.0
    for _ in range(300):
        road.act()
        road.step(DT)
        speeds.append(road.pose()[3])
        aside = max(aside, np.abs(road.fleet.lateral).max())
    assert road.collided == 0
    assert np.mean(speeds[100:]) > 4
    assert aside < 0.75  # half of what a lane is wider than a vehicle


@pytest.mark.parametrize("steering_unit", [1.22, 2.4])
def test_the_unit_of_steering_changes_labels_but_not_drives(steering_unit: float) -> None:
    road = make_traffic(TownSettings(vehicles=20), 1, DynamicsSettings(steering_unit=steering_unit))
    other = make_traffic(TownSettings(vehicles=20), 1, DynamicsSettings(steering_unit=1.0))
    for _ in range(100):
        for town in (road, other):
            town.act()
            town.step(DT)
    assert np.allclose(road.decisions.steering * steering_unit, other.decisions.steering, atol=1e-6)
    assert np.allclose(road.pose(), other.pose(), atol=1e-6)


@pytest.mark.parametrize(
    ("town", "dynamics", "message"),
    [
        ({}, {"lag": 2.0}, "from 40 km/h with a lag of 2 s takes 31 m.* take a lag of at most 1.8 s"),
        ({"road_limits": LIMITS}, {"lag": 0.8}, "from 50 km/h .* looks 30 m ahead; .* or limits of at most 4"),
        ({"road_limits": [90]}, {}, "from 90 km/h .* ahead; take limits of at most 60 km/h"),
        ({}, {"wheel_lag": 0.5}, "dynamics.wheel_lag: with 0.5 s, vehicles leave their lanes"),
    ],
)
def test_vehicles_that_could_not_stop_or_turn_are_refused(
    town: dict[str, object], dynamics: dict[str, float], message: str
) -> None:
    with pytest.raises(BadInputError, match=message):
        make_traffic(TownSettings(**town), 0, DynamicsSettings(**dynamics))
