"""Recorded drives: what an Episode of the town holds, and recording many of them."""

import hashlib
from pathlib import Path

import numpy as np
import pytest

from study.config.paper import ACCELERATIONS
from study.config.settings import DynamicsSettings, RecordingSettings, TownSettings
from study.data.prepare import POLICY_SEED
from study.engine.flows import run_flow
from study.episode.checks import check_episode
from study.episode.files import read_episode
from study.episode.schema import Episode
from study.errors import BadInputError
from study.sim.dynamics import LOOK
from study.sim.record import FORMAT_VERSION, record_episode, record_flow

TOWN = TownSettings(vehicles=30)
TINY = TownSettings(rows=3, columns=3, dropped_edges=0, vehicles=6)
AT_ONCE = DynamicsSettings()
SHORT = RecordingSettings(warm_up=1.0, duration=1.5)


@pytest.fixture(scope="module")
def episode() -> Episode:
    return record_episode(TOWN, AT_ONCE, RecordingSettings(warm_up=3.0, duration=20.0), 7)


def test_an_episode_of_the_town_is_valid_and_says_what_wrote_it(episode: Episode) -> None:
    check_episode(episode, "here")
    assert episode.rate_hz == 10
    assert episode.steps == 200
    assert episode.labels == "recorded"
    assert episode.source["writer"] == "study.sim"
    assert episode.source["format_version"] == FORMAT_VERSION
    assert episode.source["seed"] == 7
    assert episode.source["town_seed"] == 0
    assert TownSettings.model_validate(episode.source["town"]) == TOWN
    assert DynamicsSettings.model_validate(episode.source["dynamics"]) == AT_ONCE
    traffic = episode.source["traffic"]
    assert traffic["collided_vehicles"] == 0
    assert traffic["mean_speed"] == pytest.approx(float(episode.speed[episode.present].mean()), abs=0.01)
    assert 0 <= traffic["standing_longer_than_cycle"] < 0.1


def test_recording_again_gives_the_same_bits(episode: Episode) -> None:
    again = record_episode(TOWN, AT_ONCE, RecordingSettings(warm_up=3.0, duration=20.0), 7)
    for name in ("x", "y", "heading", "speed", "steering", "acceleration", "light", "light_state", "lead_gap"):
        assert getattr(again, name).tobytes() == getattr(episode, name).tobytes()
    assert [route.tobytes() for route in again.routes] == [route.tobytes() for route in episode.routes]


def test_a_longer_warm_up_only_shifts_the_drive(episode: Episode) -> None:
    later = record_episode(TOWN, AT_ONCE, RecordingSettings(warm_up=8.0, duration=5.0), 7)
    assert np.array_equal(later.x, episode.x[50:100])


def test_coordinates_are_right_handed_and_positive_steering_turns_left(episode: Episode) -> None:
    moving = episode.speed[:-1] > 3
    dx, dy = np.diff(episode.x, axis=0), np.diff(episode.y, axis=0)
    course = np.angle(np.exp(1j * (np.arctan2(dy, dx) - episode.heading[:-1])))
    assert np.abs(course[moving]).max() < 0.75  # a hard-turning car slips
    turned = np.angle(np.exp(1j * np.diff(episode.heading, axis=0)))
    hard = moving & (np.abs(episode.steering[:-1]) > 0.05)
    assert hard.sum() > 100
    assert (np.sign(turned[hard]) == np.sign(episode.steering[:-1][hard])).all()


def test_traffic_keeps_to_the_right(episode: Episode) -> None:
    lanes = [lane for lane in episode.lanes if not lane.junction and lane.left == "solid" and len(lane.centre) == 2]
    for lane in lanes:
        direction = lane.centre[1] - lane.centre[0]
        left = np.array([-direction[1], direction[0]]) / np.hypot(*direction)
        oncoming = lane.centre[::-1] + left * lane.width
        assert any(np.allclose(oncoming, other.centre, atol=1e-3) for other in lanes)


def test_commands_follow_from_the_state_of_their_own_step(episode: Episode) -> None:
    assert set(np.unique(episode.acceleration)) == set(ACCELERATIONS)
    change = np.diff(episode.speed, axis=0) * 10
    free = episode.speed[:-1] > 1
    brakes = episode.acceleration[:-1] == -1
    assert np.allclose(change[free & brakes], -5, atol=1e-3)
    assert (change[free & ~brakes] > 0).all()


def test_a_route_passes_where_its_vehicle_is_and_leads_fifty_metres_on(episode: Episode) -> None:
    for column, route in enumerate(episode.routes):
        line = route.astype(np.float64)
        s = np.concatenate([[0], np.cumsum(np.hypot(*np.diff(line, axis=0).T))])
        own = episode.route_s[:, column]
        assert own.min() >= 0
        assert s[-1] >= own.max() + 50
        x, y = np.interp(own, s, line[:, 0]), np.interp(own, s, line[:, 1])
        assert np.hypot(x - episode.x[:, column], y - episode.y[:, column]).max() < 0.6
        assert np.diff(own).min() > -0.05


def test_lights_ahead_are_at_their_distance_and_rule_those_who_stop(episode: Episode) -> None:
    steps, columns = np.nonzero(episode.light >= 0)
    assert len(steps) > 1000
    lines = np.array([light.stop_line.mean(axis=0) for light in episode.lights])
    ahead = lines[episode.light[steps, columns]]
    straight = np.hypot(ahead[:, 0] - episode.x[steps, columns], ahead[:, 1] - episode.y[steps, columns])
    distance = episode.light_distance[steps, columns]
    near = distance < 15  # no bends so near to a light
    assert np.abs(straight - distance)[near].max() < 0.5
    red = (episode.light_state[steps, episode.light[steps, columns]] == 2) & near
    assert (episode.acceleration[steps, columns][red] == -1).mean() > 0.9
    assert np.isnan(episode.light_distance[episode.light < 0]).all()


def test_free_way_ahead_ends_at_the_vehicle_in_front(episode: Episode) -> None:
    known = ~np.isnan(episode.lead_gap)
    assert 0.05 < known.mean() < 0.95
    assert episode.lead_gap[known].min() > 0.3
    assert episode.lead_gap[known].max() <= LOOK
    close = known & (episode.speed < 0.01) & (episode.lead_gap < 4)
    step, column = np.argwhere(close)[0]
    away = np.hypot(episode.x[step] - episode.x[step, column], episode.y[step] - episode.y[step, column])
    assert np.sort(away)[1] == pytest.approx(episode.lead_gap[step, column] + 5, abs=0.3)


def test_the_map_has_junctions_lights_over_its_lanes_and_every_kind_of_border(episode: Episode) -> None:
    assert any(lane.junction for lane in episode.lanes)
    assert {lane.left for lane in episode.lanes} | {lane.right for lane in episode.lanes} == {
        "none",
        "dashed",
        "solid",
        "curb",
    }
    lanes = {lane.id: lane for lane in episode.lanes}
    for light in episode.lights:
        assert light.lane is not None
        assert np.allclose(light.stop_line.mean(axis=0), lanes[light.lane].centre[-1], atol=1e-6)


def test_the_drive_of_a_seed_is_the_one_that_its_format_version_stands_for() -> None:
    """Change FORMAT_VERSIONS["episodes"] with this digest, or drives of old and new code pass for the same."""
    town = TownSettings(rows=3, columns=4, dropped_edges=1, vehicles=20)
    tiny = record_episode(
        town, DynamicsSettings(lag=0.4, wheel_lag=0.1), RecordingSettings(warm_up=1.0, duration=20.0), 1
    )  # long enough for lights, queues and crossings
    rounded = [np.round(getattr(tiny, name), 2) + 0.0 for name in ("x", "y", "speed", "acceleration")]
    digest = hashlib.sha256(b"".join(values.tobytes() for values in rounded)).hexdigest()
    assert (FORMAT_VERSION, digest[:16]) == (3, "12b4193808a19143")


def test_recordings_that_cannot_be_are_refused(tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match="shorter than one step"):
        record_episode(TINY, AT_ONCE, RecordingSettings(warm_up=0, duration=0.01), 0)
    with pytest.raises(
        BadInputError,
        match=r"stopping from 45 km/h with a lag of 3 s takes .* looks 30 m ahead; take a lag of at most",
    ):
        run_flow(
            record_flow(TownSettings(speed_limit=45.0, road_limits=()), DynamicsSettings(lag=3), SHORT, [0], tmp_path)
        )


def test_all_drives_are_in_one_town_unless_each_is_to_have_its_own() -> None:
    def drive(seed: int, recording: RecordingSettings = SHORT, *, per_drive: bool = False) -> Episode:
        return record_episode(TINY.model_copy(update={"per_drive": per_drive}), AT_ONCE, recording, seed)

    def town_of(episode: Episode) -> list[list[list[float]]]:
        return [lane.centre.tolist() for lane in episode.lanes]

    encoder, policy = drive(1), drive(1 + POLICY_SEED)
    assert town_of(encoder) == town_of(policy)
    assert not np.array_equal(encoder.x, policy.x)
    assert not np.array_equal(encoder.light_state, policy.light_state)
    assert town_of(encoder) != town_of(drive(1, SHORT.model_copy(update={"seed": 5})))
    assert town_of(drive(1, per_drive=True)) != town_of(drive(2, per_drive=True))


# --- many drives ----------------------------------------------------------------------------------------------------


def bytes_of(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def test_the_order_of_the_seeds_changes_no_drive(tmp_path: Path) -> None:
    one = run_flow(record_flow(TINY, AT_ONCE, SHORT, [3, 1, 2], tmp_path / "one"))
    two = run_flow(record_flow(TINY, AT_ONCE, SHORT, [2, 3, 1], tmp_path / "two"))
    assert [path.name for path in one] == ["00000003", "00000001", "00000002"]
    assert [path.name for path in two] == ["00000002", "00000003", "00000001"]
    assert bytes_of(tmp_path / "one") == bytes_of(tmp_path / "two")


def test_only_missing_drives_are_recorded_and_drafts_of_the_dead_are_swept(tmp_path: Path) -> None:
    folder = tmp_path / "drives"
    first = run_flow(record_flow(TINY, AT_ONCE, SHORT, [1, 2], folder))
    stamp = (first[0] / "episode.json").stat().st_mtime_ns
    content = bytes_of(first[0])
    draft = folder / ".00000009.abc"
    draft.mkdir()
    steps: list[tuple[str, int, int]] = []

    def progress(stage: str, done: int, total: int) -> None:
        steps.append((stage, done, total))
        (folder / ".00000003.def").mkdir(exist_ok=True)  # as a worker that is killed in this moment

    paths = run_flow(record_flow(TINY, AT_ONCE, SHORT, [1, 2, 3], folder), progress=progress)
    assert steps == [("record", 2, 3), ("record", 3, 3)]
    assert (first[0] / "episode.json").stat().st_mtime_ns == stamp
    assert bytes_of(first[0]) == content
    assert list(folder.glob(".*/")) == []
    assert read_episode(paths[2]).source["seed"] == 3
