"""An Episode survives writing and reading; what is not one is refused with file, row and field."""

import dataclasses
import json

import numpy as np
import pandas as pd
import pytest

from study.episode.files import FILES, read_episode, write_episode
from study.episode.head import episode_digest
from study.episode.schema import Agent, Episode
from study.errors import BadInputError
from tests.support.drives import crossing_drive
from tests.support.spoil import spoil

STATES = ("x", "y", "heading", "speed", "steering", "acceleration", "light", "light_distance", "route_s", "lead_gap")


@pytest.fixture(scope="module")
def drive() -> Episode:
    """Return a drive in which agents come and go."""
    episode = crossing_drive(seed=1, cars=6, steps=40)
    present = episode.present.copy()
    present[:10, 0] = False
    present[25:, 3] = False
    return dataclasses.replace(episode, present=present)


@pytest.fixture
def folder(drive, tmp_path):
    write_episode(drive, tmp_path / "drive")
    return tmp_path / "drive"


def test_reading_gives_what_was_written(drive, folder):
    read = read_episode(folder)
    assert np.array_equal(read.present, drive.present)
    for name in STATES:
        written, got = getattr(drive, name)[drive.present], getattr(read, name)[drive.present]
        assert np.array_equal(written, got, equal_nan=name != "light"), name
    assert np.array_equal(read.light_state, drive.light_state)
    assert [agent.id for agent in read.agents] == [agent.id for agent in drive.agents]
    assert all(
        np.allclose(one.centre, other.centre, atol=1e-4) for one, other in zip(read.lanes, drive.lanes, strict=True)
    )
    assert all(np.array_equal(one, other) for one, other in zip(read.routes, drive.routes, strict=True))


def test_the_same_episode_has_the_same_digest(drive, tmp_path):
    assert (
        write_episode(drive, tmp_path / "a")
        == write_episode(drive, tmp_path / "b")
        == read_episode(tmp_path / "a").digest
    )


def test_writing_leaves_nothing_beside_the_episode(drive, tmp_path):
    write_episode(drive, tmp_path / "drive")
    write_episode(drive, tmp_path / "drive")
    assert [path.name for path in tmp_path.iterdir()] == ["drive"]


def test_an_episode_that_breaks_the_schema_is_not_written(drive, tmp_path):
    speed = drive.speed.copy()
    speed[12, 0] = np.nan
    with pytest.raises(BadInputError, match="speed"):
        write_episode(dataclasses.replace(drive, speed=speed), tmp_path / "drive")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("file", [*FILES, "episode.json"])
def test_a_missing_file_is_named(folder, file):
    (folder / file).unlink()
    with pytest.raises(BadInputError, match=file):
        read_episode(folder)


@pytest.mark.parametrize("file", [*FILES, "episode.json"])
def test_a_truncated_file_is_named(folder, file):
    path = folder / file
    path.write_bytes(path.read_bytes()[:-20])
    with pytest.raises(BadInputError, match=file):
        read_episode(folder)


def test_optional_columns_may_be_absent(folder):
    spoil(folder, "states.parquet", lambda table: table[["step", "agent", "x", "y", "heading", "speed"]])
    read = read_episode(folder)
    assert np.isnan(read.steering).all()
    assert (read.light == -1).all()


def test_rows_may_stand_in_any_order(drive, folder):
    spoil(folder, "states.parquet", lambda table: table.sort_values(["agent", "step"], ascending=False))
    read = read_episode(folder)
    assert np.array_equal(read.present, drive.present)
    assert np.array_equal(read.x[drive.present], drive.x[drive.present])


def put(field, row, value):
    """Return a change of one value of a table."""

    def change(table):
        table.loc[row, field] = value
        return table

    return change


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (put("x", 7, np.inf), ["row 7", "'x'", "finite"]),
        (put("heading", 3, np.nan), ["row 3", "'heading'"]),
        (put("agent", 5, 999), ["row 5", "'agent'", "999"]),
        (put("step", 9, 4000), ["row 9", "'step'", "4000"]),
        (put("light", 2, 77), ["'light'", "77"]),
        (put("acceleration", 11, 0.3), ["row 11", "'acceleration'", "0.3"]),
        (put("speed", 20, 300.0), ["row 20", "'speed'", "m/s"]),
        (lambda table: pd.concat([table.iloc[:1], table]), ["row 1", "stands twice"]),
        (lambda table: table.drop(columns="speed"), ["'speed'", "missing"]),
    ],
)
def test_wrong_states_are_refused_with_row_and_field(folder, change, words):
    spoil(folder, "states.parquet", change)
    with pytest.raises(BadInputError) as caught:
        read_episode(folder)
    assert all(word in str(caught.value) for word in ["states.parquet", *words]), caught.value


def test_a_drive_of_vehicles_is_written_as_version_1(folder):
    head = json.loads((folder / "episode.json").read_text())
    assert head["schema_version"] == 1
    assert {tuple(agent) for agent in head["agents"]} == {("id", "length", "width", "ego")}


def with_classes(drive, *kinds):
    agents = tuple(Agent(agent.id, 0.5, 0.5, kind=kind) for agent, kind in zip(drive.agents, kinds, strict=False))
    return dataclasses.replace(drive, agents=(*agents, *drive.agents[len(agents) :]))


def test_classes_are_kept_and_count_in_the_digest(drive, tmp_path):
    mixed = with_classes(drive, "pedestrian", "cyclist", "vehicle")
    digest = write_episode(mixed, tmp_path / "mixed")
    assert json.loads((tmp_path / "mixed/episode.json").read_text())["schema_version"] == 1.1
    read = read_episode(tmp_path / "mixed")
    assert read.agents == mixed.agents
    assert [agent.ego for agent in read.agents[:3]] == [False, False, True]
    assert read.digest == digest == episode_digest(tmp_path / "mixed")
    assert digest != write_episode(drive, tmp_path / "plain"), "or frames of the one would pass for those of the other"
    with pytest.raises(BadInputError, match="class of agent 100 is 'horse'; choose from vehicle, cyclist"):
        write_episode(with_classes(drive, "horse"), tmp_path / "horse")


def of_version(version, change):
    """Return a change of the head's version and of its first agent."""
    return lambda head: (head.update(schema_version=version), head["agents"][0].update(change))


def test_a_pedestrian_is_no_ego_unless_the_file_says_so(folder):
    spoil(folder, "episode.json", of_version(1.1, {"class": "pedestrian"}))
    spoil(folder, "episode.json", lambda head: [agent.pop("ego") for agent in head["agents"]])
    assert [agent.ego for agent in read_episode(folder).agents] == [False, *[True] * 5]
    spoil(folder, "episode.json", of_version(1.1, {"ego": True}))
    assert read_episode(folder).agents[0].ego


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda head: head.update(schema_version=2), ["schema_version", "2"]),
        (lambda head: head["agents"][1].update({"class": "cyclist"}), ["agents[1]", "class", "schema_version 1.1"]),
        (of_version(1.1, {"class": "horse"}), ["agents[0]", "'horse'", "one of vehicle, cyclist, pedestrian"]),
        (of_version(1.1, {"class": 3}), ["agents[0]", "class", "one of vehicle"]),
        (lambda head: head.update(rate_hz=0), ["rate_hz"]),
        (lambda head: head.update(labels="guessed"), ["labels", "guessed"]),
        (lambda head: head.pop("agents"), ["agents"]),
        (lambda head: head["agents"][0].update(length=-1), ["agent", "-1"]),
        (lambda head: head["agents"].append(head["agents"][0]), ["share an id"]),
    ],
)
def test_a_wrong_head_is_refused(folder, change, words):
    spoil(folder, "episode.json", change)
    with pytest.raises(BadInputError) as caught:
        read_episode(folder)
    assert all(word in str(caught.value) for word in words), caught.value


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda chart: chart["lanes"][0].update(left="wavy"), ["left", "wavy"]),
        (lambda chart: chart["lanes"][0].update(centre=[[0, 0]]), ["lanes[0]", "centre", "2 or more points"]),
        (lambda chart: chart["lights"][0].update(lane=12345), ["12345"]),
        (lambda chart: chart["lanes"][0].pop("width"), ["width"]),
    ],
)
def test_a_wrong_map_is_refused(folder, change, words):
    spoil(folder, "map.json", change)
    with pytest.raises(BadInputError) as caught:
        read_episode(folder)
    assert all(word in str(caught.value) for word in words), caught.value


def test_a_light_without_a_state_is_refused(folder):
    spoil(folder, "lights.parquet", lambda table: table.iloc[1:])
    with pytest.raises(BadInputError, match=r"lights\.parquet.*step 0"):
        read_episode(folder)


def test_a_folder_that_is_none_is_refused(tmp_path):
    with pytest.raises(BadInputError, match=r"is .* an Episode"):
        read_episode(tmp_path)


def test_a_light_with_two_states_in_a_step_is_refused(folder):
    spoil(folder, "lights.parquet", lambda table: pd.concat([table, table.iloc[:1]]))
    with pytest.raises(BadInputError, match=r"lights\.parquet, row \d+: light \d+ has two states in step 0"):
        read_episode(folder)
