"""The autopilot: its commands, the lights, and who goes first."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
import pytest

from study.config.paper import ACCELERATIONS
from study.config.settings import DynamicsSettings, TownSettings
from study.episode.schema import GREEN, RED
from study.sim.dynamics import DT
from study.sim.env import Traffic, make_traffic
from study.sim.geometry import LENGTH


@dataclass
class Drive:
    """Holds what the vehicles of a town did, [steps, vehicles] each."""

    acceleration: np.ndarray
    steering: np.ndarray
    speed: np.ndarray
    lateral: np.ndarray
    agent: np.ndarray
    road: Traffic
    ran_red: int


def drive(seed: int, steps: int, **settings: object) -> Drive:
    road = make_traffic(TownSettings(**settings), seed)
    rows, ran_red, before = [], 0, None
    for _ in range(steps):
        speed, agents = road.pose()[3], list(road.agents)
        road.act()
        front = road.fleet.s + LENGTH / 2 - road.fleet.move_start
        light = road.light_states[road.fleet.move_signal[road.fleet.move]]
        if before is not None:
            over = (front > 0) & (before[0] <= 0) & (before[1] == road.fleet.move) & (before[2] == agents)
            ran_red += int((over & (light == RED)).sum())
        before = (front, road.fleet.move.copy(), np.array(agents))
        decisions = road.decisions
        rows.append((decisions.acceleration, decisions.steering, speed, road.fleet.lateral.copy(), np.array(agents)))
        road.step(DT)
    return Drive(*(np.array(values) for values in zip(*rows, strict=True)), road, ran_red)


@pytest.fixture(scope="module")
def town() -> Drive:
    return drive(0, 900)


def test_acceleration_is_always_one_of_the_three_commands_and_each_is_common(town: Drive) -> None:
    shares = [(town.acceleration == command)[town.speed > 0.5].mean() for command in ACCELERATIONS]
    assert sum(shares) == pytest.approx(1)
    assert min(shares) > 0.1


def test_nearly_all_steering_labels_are_within_the_papers_crop(town: Drive) -> None:
    assert (np.abs(town.steering) <= 0.25).mean() >= 0.9
    assert (np.abs(town.steering) * DynamicsSettings().steering_unit / 2.4 <= 0.25).mean() >= 0.99
    assert np.quantile(np.abs(town.steering), 0.9) > 0.1  # and they do use that range


def test_standing_cars_keep_their_wheels_calm(town: Drive) -> None:
    still = (town.speed[1:] < 0.01) & (town.speed[:-1] < 0.01) & (town.agent[1:] == town.agent[:-1])
    assert still.sum() > 1000
    assert np.abs(np.diff(town.steering, axis=0)[still]).max() < 0.02


def test_vehicles_stay_on_their_planned_way(town: Drive) -> None:
    assert np.abs(town.lateral).max() < 0.6


def test_the_limit_is_kept_and_cars_come_near_it(town: Drive) -> None:
    limit = 40 / 3.6
    assert limit - 0.5 < town.speed.max() < limit + 0.3


def test_a_brake_is_held_for_as_long_as_it_should() -> None:
    town = drive(0, 300, brake_hold=0.5, vehicles=40)
    brakes = (town.acceleration == -1).astype(int)
    for column in brakes.T:
        edges = np.diff(column)
        starts, ends = np.flatnonzero(edges == 1), np.flatnonzero(edges == -1)
        ends = ends[ends > starts[0]] if len(starts) else ends[:0]
        assert ((ends - starts[: len(ends)]) >= 5).all()


def test_without_a_hold_the_brake_may_be_shorter() -> None:
    free = drive(0, 200, brake_hold=0.0, vehicles=40)
    single = (free.acceleration[1:-1] == -1) & (free.acceleration[:-2] != -1) & (free.acceleration[2:] != -1)
    assert single.any()


def test_no_vehicle_crosses_a_stop_line_at_red(town: Drive) -> None:
    assert town.ran_red == 0


def test_traffic_flows_without_collisions(town: Drive) -> None:
    assert town.road.collided == 0
    assert town.speed.mean() > 3


# --- who goes first -------------------------------------------------------------------------------------------------


def crossing_pair(road: Traffic) -> tuple[int, int]:
    """Return a turn that yields and the oncoming straight movement that it crosses."""
    town = road.town
    for a, turn in enumerate(town.movements):
        for b, other in enumerate(town.movements):
            meet = town.opposing[a, b] and not np.isnan(town.enter[a, b])
            room = min(town.strips[m.entry].piece.length for m in (turn, other)) > 30
            if turn.turn == town.yielding and other.turn == "straight" and meet and room:
                return a, b
    raise AssertionError("no such pair in this town")


def send(road: Traffic, slot: int, movement: int, distance: float, speed: float) -> None:
    """Put a vehicle before a stop line, on its way over a given movement."""
    entry = road.town.movements[movement].entry
    piece = road.town.strips[entry].piece
    assert road.town.phases[road.town.movements[movement].node]  # else no light tells it from other ways
    road.fleet.place(slot, entry, piece.length - distance)
    while road.fleet.move[slot] != movement:  # routes are drawn
        road.fleet.place(slot, entry, piece.length - distance)
    x, y, heading = piece.at(np.array([piece.length - distance]))
    vehicle = road.vehicles[slot]
    vehicle.position[:] = x[0], y[0]
    vehicle.heading, vehicle.speed = float(heading[0]), speed
    road.fleet.follow(*road.pose()[:2])


def until_green(road: Traffic, movement: int) -> None:
    signal = road.fleet.move_signal[movement]
    while road.lights.states(road.time)[signal] == GREEN:
        road.steps += 1
    while road.lights.states(road.time)[signal] != GREEN:
        road.steps += 1


@pytest.mark.parametrize("side", ["right", "left"])
def test_a_turn_across_oncoming_traffic_lets_it_pass_and_then_goes(side: Literal["right", "left"]) -> None:
    road = make_traffic(TownSettings(vehicles=2, green=20.0, traffic=side), 0)
    turn, straight = crossing_pair(road)
    send(road, 0, turn, 15.0, 6.0)
    send(road, 1, straight, 25.0, 9.0)
    until_green(road, turn)
    done: dict[int, int] = {}
    braked = False
    for step in range(250):
        road.act()
        braked |= 0 not in done and road.vehicles[0].speed < 0.5
        road.step(DT)
        for slot, movement in ((0, turn), (1, straight)):
            passed = road.fleet.move[slot] != movement
            done.setdefault(slot, step) if passed else None
        if len(done) == 2:
            break
    assert braked
    assert done[1] < done[0]
    assert road.collided == 0


@pytest.mark.parametrize("side", ["right", "left"])
def test_a_turn_with_nobody_oncoming_does_not_wait(side: Literal["right", "left"]) -> None:
    road = make_traffic(TownSettings(vehicles=2, green=20.0, traffic=side), 0)
    turn, _ = crossing_pair(road)
    send(road, 0, turn, 15.0, 6.0)
    node = road.town.movements[turn].node
    far = next(k for k, m in enumerate(road.town.movements) if road.town.phases[m.node] and m.node != node)
    send(road, 1, far, 20.0, 0.0)
    until_green(road, turn)
    for _ in range(60):
        road.act()
        road.step(DT)
        if road.fleet.move[0] != turn:
            break
        assert road.vehicles[0].speed > 3
    assert road.fleet.move[0] != turn


def test_cross_traffic_waits_for_a_vehicle_left_inside_the_junction() -> None:
    road = make_traffic(TownSettings(vehicles=2, green=20.0), 0)
    town = road.town
    inside, waiting = next(
        (a, b)
        for a, one in enumerate(town.movements)
        for b, other in enumerate(town.movements)
        if one.turn == other.turn == "straight" and not town.opposing[a, b] and not np.isnan(town.enter[a, b])
    )
    send(road, 0, inside, 0.0, 0.0)
    start = town.strips[town.movements[inside].strips[0]].piece
    x, y, _ = start.at(np.array([town.enter[inside, waiting]]))
    road.vehicles[0].position[:] = x[0], y[0]
    road.fleet.s[0] += town.enter[inside, waiting]
    send(road, 1, waiting, 12.0, 0.0)
    until_green(road, waiting)
    road.commands = {0: (-1.0, 0.0)}  # broken down
    for _ in range(80):
        road.act()
        road.step(DT)
    assert road.vehicles[1].speed < 0.1
    assert road.fleet.s[1] + LENGTH / 2 <= road.fleet.move_start[1]
    road.commands = {}
    for _ in range(80):
        road.act()
        road.step(DT)
    assert road.fleet.s[1] > road.fleet.move_start[1]
    assert road.collided == 0


def test_no_vehicle_enters_a_junction_that_has_no_room_behind_it() -> None:
    road = make_traffic(TownSettings(vehicles=12, green=20.0), 0)
    town = road.town
    way = next(
        k
        for k, m in enumerate(town.movements)
        if m.turn == "straight" and town.phases[m.node] and town.phases[town.movements[town.ways[m.exit][0]].node]
    )
    exit_ = town.movements[way].exit
    queue = list(range(1, 1 + int(town.strips[exit_].piece.length // 7)))
    for place, slot in enumerate(queue):  # bumper to bumper, down to the stop line before
        send(road, slot, town.ways[exit_][0], 3.0 + 7.0 * place, 0.0)
    send(road, 0, way, 10.0, 0.0)
    until_green(road, way)
    road.commands = dict.fromkeys(queue, (-1.0, 0.0))
    for _ in range(100):
        road.act()
        road.step(DT)
    assert road.vehicles[0].speed < 0.1
    assert road.fleet.s[0] + LENGTH / 2 <= road.fleet.move_start[0]


def test_a_vehicle_that_was_denied_its_green_goes_first_into_the_same_street() -> None:
    road = make_traffic(TownSettings(vehicles=2), 0)
    moves = road.town.movements
    denied, greedy = next(
        (a, b)
        for a, one in enumerate(moves)
        for b, other in enumerate(moves)
        if one.exit == other.exit and (one.arm - other.arm) % 2 and road.town.phases[one.node]
    )
    send(road, 0, denied, 5.0, 0.0)
    send(road, 1, greedy, 5.0, 0.0)
    until_green(road, greedy)
    road.fleet.denied[0] = 0
    entered: list[int] = []
    for _ in range(400):
        road.act()
        road.step(DT)
        for slot in (0, 1):
            if slot not in entered and road.fleet.s[slot] > road.fleet.move_start[slot]:
                entered.append(slot)
        if len(entered) == 2:
            break
    assert entered == [0, 1]


def test_a_vehicle_may_enter_the_last_street_of_its_plan() -> None:
    """In this town a vehicle does so: plans end at the lights, and a street may be longer than the way looked at."""
    assert drive(22, 340, per_drive=True).speed.shape == (340, 100)
