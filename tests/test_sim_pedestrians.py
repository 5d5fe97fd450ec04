"""Pedestrians of the town: where and when they walk, and that traffic lets them pass and flows."""

import numpy as np
import pytest

from study.birdview.renderer import Renderer, valid_moments
from study.config.keys import recording_key
from study.config.settings import DynamicsSettings, RecordingSettings, StudySettings, TownSettings
from study.driving.drives import Drive
from study.driving.metrics import score_drive
from study.driving.ride import Ride
from study.driving.surface import off_road
from study.episode.files import read_episode, write_episode
from study.episode.schema import PEDESTRIAN, RED, Episode
from study.intake.adapt import adapt
from study.intake.importing import check_drives
from study.sim.dynamics import DT
from study.sim.env import Traffic, make_traffic
from study.sim.pedestrians import SIZE
from study.sim.record import record_episode

TOWN = TownSettings(rows=4, columns=4, dropped_edges=1, vehicles=60, pedestrians=80)
WITHOUT = TOWN.model_copy(update={"pedestrians": 0})
RECORDING = RecordingSettings(warm_up=5.0, duration=60.0)
LAGGING = DynamicsSettings(lag=0.4, wheel_lag=0.1)


@pytest.fixture(scope="module", params=[DynamicsSettings(), LAGGING], ids=["at once", "lagging"])
def episode(request: pytest.FixtureRequest) -> Episode:
    return record_episode(TOWN, request.param, RECORDING, 3)


def walkers(episode: Episode) -> list[int]:
    return [column for column, agent in enumerate(episode.agents) if agent.kind == PEDESTRIAN]


def test_they_are_in_the_recorded_drive_and_never_ego(episode: Episode) -> None:
    columns = walkers(episode)
    assert len(columns) == 80
    assert episode.present[:, columns].all()
    assert {(agent.length, agent.ego) for agent in episode.agents if agent.kind == PEDESTRIAN} == {(SIZE, False)}
    assert not np.isin(valid_moments(episode, StudySettings().birdview)[:, 1], columns).any()
    assert np.diff(episode.x[:, columns], axis=0) == pytest.approx(
        (np.cos(episode.heading) * episode.speed)[1:, columns] * DT, abs=0.3
    )


def test_no_vehicle_touches_a_pedestrian_and_none_collides(episode: Episode) -> None:
    """Boxes are held against boxes, by points of the pedestrian's that are 0.1 m apart."""
    columns, at = walkers(episode), np.linspace(-SIZE / 2, SIZE / 2, 6)
    assert episode.source["traffic"]["collided_vehicles"] == 0
    for vehicle in set(range(len(episode.agents))) - set(columns):
        dx, dy = (values[:, columns] - values[:, [vehicle]] for values in (episode.x, episode.y))
        near = episode.present[:, [vehicle]] & (np.hypot(dx, dy) < 4)
        step, walker = np.nonzero(near)
        turn = episode.heading[step, vehicle]
        for along, across in ((a, b) for a in at for b in at):
            x, y = dx[near] + along, dy[near] + across
            ahead, aside = x * np.cos(turn) + y * np.sin(turn), y * np.cos(turn) - x * np.sin(turn)
            assert not ((np.abs(ahead) < 2.5) & (np.abs(aside) < 1.0)).any(), walker


def drive(road: Traffic, seconds: float) -> list[float]:
    speeds = []
    for _ in range(round(seconds / DT)):
        road.act()
        road.step(DT)
        speeds.append(float(road.pose()[3].mean()))
    return speeds


def test_they_cross_only_while_the_light_of_the_arm_is_red_and_many_do() -> None:
    road = make_traffic(TOWN, 5)
    people = road.pedestrians
    assert people is not None
    crossed = 0
    for _ in range(600):
        drive(road, DT)
        on = (people.walks.crossing[people.way] >= 0) & ~people.waiting
        lights = road.lights.states(road.time)[people.walks.signal[people.walks.crossing[people.way[on]]]]
        assert (lights == RED).all()
        crossed += int(on.sum())
    assert crossed > 600


@pytest.mark.parametrize("seed", [1, 2])
def test_traffic_flows_nearly_as_without_them(seed: int) -> None:
    road = make_traffic(TOWN, seed)
    with_them, without = drive(road, 120), drive(make_traffic(WITHOUT, seed), 120)
    assert road.collided == 0
    assert np.mean(with_them) > 0.85 * np.mean(without)
    assert np.mean(with_them[-300:]) > 0.8 * np.mean(without[-300:]), "it gets no slower with time"


def test_off_crossings_they_keep_off_the_road(episode: Episode) -> None:
    """A pedestrian is on the road only where it crosses it: within the width of a crossing behind a stop line."""
    columns = walkers(episode)
    points = np.stack([episode.x[::20, columns], episode.y[::20, columns]], axis=-1).reshape(-1, 2).astype(np.float64)
    road = points[~off_road(points, episode.lanes, 0.0)]
    lines = np.array([light.stop_line for light in episode.lights])
    ends = {tuple(np.round(lane.centre[-1], 2)): lane for lane in episode.lanes if not lane.junction}
    ahead = np.array([np.diff(ends[tuple(np.round(line.mean(axis=0), 2))].centre[-2:], axis=0)[0] for line in lines])
    ahead /= np.hypot(*ahead.T)[:, None]
    beyond = ((road[:, None] - lines.mean(axis=1)) * ahead).sum(-1)
    aside = np.hypot(*(road[:, None] - lines.mean(axis=1) - beyond[..., None] * ahead).transpose(2, 0, 1))
    assert len(road) > 50
    assert ((beyond > 1.0) & (beyond < 2.5) & (aside < 15)).any(axis=1).all()


def test_a_turning_vehicle_waits_for_who_is_on_the_crossing_behind_its_turn() -> None:
    road = make_traffic(TownSettings(vehicles=1, pedestrians=1, green=20.0), 0)
    people = road.pedestrians
    assert people is not None
    walks, fleet = people.walks, road.fleet
    turns = [k for k, move in enumerate(road.town.movements) if move.turn == "right" and walks.of_move[1, k] >= 0]
    turn = turns[0]
    crossing = int(walks.of_move[1, turn])
    fleet.place(0, road.town.movements[turn].entry, 5.0)
    while fleet.move[0] != turn:
        fleet.place(0, road.town.movements[turn].entry, 5.0)
    fleet.s[0] = fleet.move_start[0] - 10
    people.way[0] = int(np.flatnonzero(walks.crossing == crossing)[0])
    people.waiting[0], people.progress[0] = False, 0.0
    gap = float(people.gaps(fleet)[0])
    assert gap == pytest.approx(10 + fleet.move_length[turn] - 2.5 - 2.5, abs=0.01)  # half its length, the near edge
    people.progress[0] = walks.length[people.way[0]] - 0.1
    assert people.gaps(fleet)[0] == np.inf, "who has passed the lane is in nobody's way"


def test_a_drive_with_them_imports_without_findings_and_is_read_as_written(episode: Episode, tmp_path: object) -> None:
    folder = tmp_path / "log" / episode.id  # type: ignore[operator]
    write_episode(episode, folder)
    assert [str(finding) for finding in check_drives(folder.parent)] == []
    assert read_episode(folder).agents == episode.agents
    assert adapt(episode, "here").egos == len(episode.agents) - 80


def test_the_same_seed_gives_the_same_bits_and_pedestrians_change_neither_town_nor_lights() -> None:
    short = RecordingSettings(warm_up=1.0, duration=10.0)
    first, again, without = (record_episode(town, DynamicsSettings(), short, 3) for town in (TOWN, TOWN, WITHOUT))
    assert np.array_equal(first.x, again.x)
    assert np.array_equal(first.light_state, without.light_state)
    assert [lane.centre.tolist() for lane in first.lanes] == [lane.centre.tolist() for lane in without.lanes]


def test_without_them_keys_and_recorded_settings_are_as_before() -> None:
    """The key was that of these settings before the town had pedestrians."""
    assert "pedestrians" not in TownSettings().model_dump(mode="json")
    assert TownSettings.model_validate(TOWN.model_dump(mode="json")) == TOWN
    assert recording_key(StudySettings()) == "9cfa46b66134d2cc"
    assert recording_key(StudySettings(town=TownSettings(pedestrians=1))) != recording_key(StudySettings())


def test_where_the_red_is_too_short_to_cross_they_walk_along_kerbs() -> None:
    road = make_traffic(TOWN.model_copy(update={"green": 1.0, "vehicles": 10}), 0)
    people = road.pedestrians
    assert people is not None
    drive(road, 60)
    assert (people.walks.crossing[people.way] == -1).all()
    assert not people.waiting.any()


# --- at the wheel ---------------------------------------------------------------------------------------------------

SETTINGS = StudySettings(town=TOWN, recording=RecordingSettings(warm_up=3.0))


def test_the_expert_drives_among_them_and_sees_what_is_recorded() -> None:
    ride = Ride(Drive(2_000_001, 0, 12.0), SETTINGS)
    views = {}
    while not ride.ended:
        ride.observe()
        views[ride.recorder.step] = ride.view()
        ride.copy().follow()
        ride.follow()
    episode = ride.episode("expert", 0)
    assert ride.ended == "time"
    column = [agent.id for agent in episode.agents].index(ride.agent)
    images, _ = Renderer(episode, SETTINGS.birdview, ()).render(np.array([(step, column) for step in views]))
    assert all((image == view).all() for image, view in zip(images, views.values(), strict=True))


def test_who_drives_on_hits_one_and_is_fined_half() -> None:
    """The pedestrian stands in the ego's way, as none of the town's does."""
    ride = Ride(Drive(2_000_001, 0, 12.0), SETTINGS)
    people = ride.road.pedestrians
    assert people is not None
    people.waiting[0] = True
    while not ride.ended:
        vehicle = ride.road.vehicles[ride.slot]
        ahead = vehicle.position + 4 * np.array([np.cos(vehicle.heading), np.sin(vehicle.heading)])
        if people.progress[0] == 0 or np.hypot(*(people.places()[0] - ahead)) > 5:
            people.aside[0] += ahead - people.places()[0]
        ride.observe()
        ride.act(0.0, 2)
    assert ride.ended == "collision"
    episode = ride.episode("blind", 0)
    facts = episode.source["drive"]["collision"]
    assert facts["agent"] == ride.road.walkers[0]
    scores = score_drive(episode, 1000.0)
    assert scores.at_fault == 1
    assert scores.driving_score == pytest.approx(100 * scores.route_completion * 0.5 * 0.65**scores.layout)
