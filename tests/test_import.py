"""Other people's drives: what is wrong is named by file, agent, step and field, whatever it is, and can be left out."""

import json
import math
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from benchmarks.motorway import import_memory, write_motorway
from study.birdview.renderer import valid_moments
from study.config.files import load_profile
from study.config.keys import content_key
from study.config.settings import FramesSettings
from study.data.__main__ import main
from study.episode.files import read_episode, write_episode
from study.episode.findings import Findings
from study.episode.rows import episode_rows
from study.errors import BadInputError
from study.intake.imported import Drive, Imported, open_import
from study.intake.importing import check_drives, import_drives
from study.intake.motion import motion_faults
from study.randomness import rng as rng_of
from study.sim.record import record_episode
from tests.support.drives import crossing_drive, write_drives
from tests.support.spoil import spoil

HEAD, CHART, STATES, LIGHTS, ROUTES = "episode.json", "map.json", "states.parquet", "lights.parquet", "routes.parquet"


@pytest.fixture(scope="module")
def clean(tmp_path_factory):
    folder = tmp_path_factory.mktemp("clean") / "log"
    write_drives(folder, 2, cars=4, steps=60)
    return folder


@pytest.fixture
def log(clean, tmp_path):
    shutil.copytree(clean, tmp_path / "log")
    return tmp_path / "log"


def refusal(log, file, change):
    """Return the error about drive-001 when one of its files is changed; nothing is written then."""
    spoil(log / "drive-001", file, change)
    with pytest.raises(BadInputError) as caught:
        import_drives(log, log.parent / "out")
    assert not (log.parent / "out").exists()
    return str(caught.value)


def of_agent(agent, first=0, last=math.inf, **values):
    """Return a change of an agent's rows from one step to another; a value may be a function of the old ones."""

    def change(table):
        rows = (table["agent"] == agent) & (table["step"] >= first) & (table["step"] <= last)
        for name, value in values.items():
            old = table.loc[rows, name]
            table.loc[rows, name] = (value(old) if callable(value) else old * 0 + value).astype(np.float32)
        return table

    return change


def first_lane(**fields):
    return lambda chart: chart["lanes"][0].update(fields)


def first_light(**fields):
    return lambda chart: chart["lights"][0].update(fields)


# --- our own ----------------------------------------------------------------------------------------------------------


def test_the_bytes_of_our_own_drives_are_what_they_were(tmp_path):
    settings = load_profile("smoke", {"town": {"vehicles": 12}, "recording": {"warm_up": 2, "duration": 4}})
    town = record_episode(settings.town, settings.dynamics, settings.recording, 3)
    assert write_episode(town, tmp_path / "town").startswith("b93753e455ed74e3")
    crossing = write_drives(tmp_path / "log", 1, cars=4, steps=60)[0]
    assert read_episode(crossing).digest.startswith("d6136c426e2a03d1")
    imported = import_drives(tmp_path / "log", tmp_path / "out")
    assert imported.drives[0].digest.startswith("d6136c426e2a03d1")


def test_drives_of_our_own_have_no_findings(tmp_path):
    write_drives(tmp_path / "log", 3, cars=12)
    settings = load_profile("smoke", {"town": {"vehicles": 30}, "recording": {"warm_up": 4, "duration": 20}})
    for seed in range(3):
        town = record_episode(settings.town, settings.dynamics, settings.recording, seed)
        write_episode(town, tmp_path / "log" / f"town-{seed}")
    assert list(check_drives(tmp_path / "log")) == []


def test_measured_drives_are_noisy_and_pass():
    """Positions to 0.2 m, speeds to 0.4 m/s, headings to 0.04 rad, independent at each step."""
    noise = np.random.default_rng(0)
    for seed in range(3):
        drive = crossing_drive(seed)
        rows = episode_rows(drive)
        for name, spread in {"x": 0.2, "y": 0.2, "speed": 0.4, "heading": 0.04}.items():
            rows[name] = (rows[name] + noise.normal(0, spread, len(rows[name]))).astype(np.float32)
        findings = Findings(Path("drive"))
        assert not motion_faults(rows, 10.0, drive.agents, findings).any()
        assert findings.errors == []


# --- points -----------------------------------------------------------------------------------------------------------


def test_heights_of_a_map_are_left_out_and_said(log):
    plain = read_episode(log / "drive-001").lanes

    def raise_lanes(chart):
        for lane in chart["lanes"]:
            lane["centre"] = [[x, y, 5.0] for x, y in lane["centre"]]

    spoil(log / "drive-001", CHART, raise_lanes)
    lanes = read_episode(log / "drive-001").lanes
    assert all(np.array_equal(one.centre, other.centre) for one, other in zip(lanes, plain, strict=True))
    assert any("three coordinates" in str(finding) and finding.warning for finding in check_drives(log))


@pytest.mark.parametrize(
    "centre",
    [[0, 0, 10, 0, 20, 0], [[0, 0], [1, 1, 1]], [[0, 0, 0, 0], [1, 1, 1, 1]], [[0, 0], [None, 1]], [[0, "1"], [1, 1]]],
)
def test_points_that_are_none_are_refused_not_reshaped(log, centre):
    assert "map.json: field 'lanes[0] (lane 2).centre" in refusal(log, CHART, first_lane(centre=centre))


# --- motion -----------------------------------------------------------------------------------------------------------


def list_twice(table):
    return pd.concat([table[table.agent != 103], table[table.agent == 100].assign(agent=103)])


MOTION = {
    "steering in degrees": (of_agent(101, steering=20), "row 1, field 'steering' (step 0, agent 101)", "any wheel", 60),
    "backwards": (of_agent(101, heading=lambda old: old + np.pi), "field 'heading' (step 0, agent 101)", "motion", 60),
    "compass": (
        of_agent(101, heading=lambda old: np.pi / 2 - old),
        "field 'heading' (step 0, agent 101)",
        "motion",
        60,
    ),
    "km/h": (of_agent(101, speed=lambda old: old * 3.6), "field 'speed' (step 0, agent 101)", "m/s", 60),
    "rows of -1": (
        of_agent(101, 20, 30, x=-1, y=-1, heading=-1, speed=-1),
        "field 'x' (step 20, agent 101)",
        "missing state",
        11,
    ),
    "rows of 0": (of_agent(101, 20, 30, x=0, y=0, heading=0, speed=0), "field 'x' (step 20, agent 101)", "jump", 11),
    "one row elsewhere": (of_agent(101, 20, 20, x=50), "field 'x' (step 20, agent 101)", "jump", 1),
    "one speed": (of_agent(101, 20, 20, speed=60), "field 'speed'", "speed", None),
    "one heading": (
        of_agent(101, 20, 20, heading=lambda old: old + 3),
        "field 'heading' (step 20, agent 101)",
        "",
        None,
    ),
    "listed twice": (list_twice, "(step 0, agent 103)", "where agent 100 stands", 60),
}


@pytest.mark.parametrize("fault", MOTION)
def test_motion_that_no_vehicle_makes_is_refused_agent_by_agent(log, fault):
    change, place, reason, count = MOTION[fault]
    message = refusal(log, STATES, change)
    assert "drive-001/states.parquet" in message
    assert place in message
    assert reason in message
    assert count in (None, 1) or f"[{count} rows of agent" in message


def test_pedestrians_may_step_aside_turn_on_the_spot_and_walk_hand_in_hand(log):
    """What is refused of a vehicle, see MOTION."""
    for number in (1, 3):
        spoil(
            log / "drive-001",
            "episode.json",
            lambda head, at=number: head["agents"][at].update({"class": "pedestrian"}),
        )
    spoil(log / "drive-001", "episode.json", lambda head: head.update(schema_version=1.1))
    for change in (list_twice, MOTION["backwards"][0], MOTION["one heading"][0]):
        spoil(log / "drive-001", STATES, change)
    spoil(log / "drive-001", STATES, lambda table: table.assign(steering=table.steering.where(table.agent != 101)))
    assert [str(finding) for finding in check_drives(log)] == []


def test_steering_to_the_other_side_is_refused(log):
    message = refusal(log, STATES, lambda table: table.assign(steering=-table.steering))
    assert "field 'steering'" in message
    assert "left is positive" in message


def bends(factor, length=4.6):
    """Return a change: each agent drives curves of 30 to 300 m; steering is the wheel angle [rad], times a factor."""

    def change(table):
        parts = []
        for number, part in table.groupby("agent"):
            time = np.arange(len(part)) / 10
            speed = 12.0
            bend = np.sin(time * (0.8 + 0.1 * (number % 5))) / 30  # [1/m]
            heading = np.concatenate([[0.0], np.cumsum(bend[:-1] * speed / 10)])
            heading -= heading.mean() + np.pi / 2 * (number % 4)
            at = [np.concatenate([[0.0], np.cumsum(way(heading[:-1]) * speed / 10)]) for way in (np.cos, np.sin)]
            parts.append(
                part.assign(
                    x=part.x.iloc[0] + at[0],
                    y=part.y.iloc[0] + at[1],
                    heading=heading,
                    speed=speed,
                    steering=np.arctan(length * bend) * factor,
                )
            )
        return pd.concat(parts).astype(table.dtypes)

    return change


def steering_findings(log, change):
    spoil(log / "drive-001", STATES, change)
    return [finding for finding in check_drives(log) if "'steering'" in str(finding)]


@pytest.mark.parametrize("wheelbase", [2.8, 4.8])  # of cars, and of simulators that take the length for it
def test_steering_in_radians_is_a_warning_with_the_share_of_values(log, wheelbase):
    assert steering_findings(log, bends(1 / 1.22, wheelbase)) == []
    (finding,) = steering_findings(log, bends(1.0, wheelbase))
    assert finding.warning
    share = int(re.search(r"(\d+)% of the values in bends, and 4 of 4 agents, look like .* radians", str(finding))[1])
    assert share > 60


def test_steering_in_degrees_is_refused_agent_by_agent_however_small_the_values_are(log):
    def gentle(table):
        changed = bends(180 / np.pi)(table)
        return changed.assign(steering=(changed.steering / 16).astype(np.float32))  # below 1

    findings = steering_findings(log, gentle)
    assert [
        f"(step 0, agent {agent})" in str(finding) for agent, finding in zip(range(100, 104), findings, strict=True)
    ]
    assert all("is in another unit" in str(finding) and finding.count == 60 for finding in findings)


def test_one_bad_agent_among_many_is_found(tmp_path):
    write_drives(tmp_path / "log", 1, cars=24)
    spoil(tmp_path / "log/drive-000", STATES, of_agent(117, speed=lambda old: old * 3.6))
    findings = [str(finding) for finding in check_drives(tmp_path / "log")]
    assert len(findings) == 1
    assert "agent 117" in findings[0]


# --- places -----------------------------------------------------------------------------------------------------------


def shifted_lanes(x, y):
    def change(chart):
        for lane in chart["lanes"]:
            lane["centre"] = [[px + x, py + y] for px, py in lane["centre"]]
        for light in chart["lights"]:
            light["stop_line"] = [[px + x, py + y] for px, py in light["stop_line"]]

    return change


def test_a_map_left_in_utm_is_refused_once_for_all_lanes(log):
    message = refusal(log, CHART, shifted_lanes(500_000, 5_400_000))
    assert "lanes[0] (lane 2).centre[0][0]" in message
    assert "[20 lanes]" in message


def test_a_map_elsewhere_is_refused_with_where_both_are(log):
    message = refusal(log, CHART, shifted_lanes(3000, 0))
    assert "is not near a lane, as 100.0% of all rows, and 4 of 4 agents never are" in message
    assert "lanes lie between (2870" in message


def test_few_agents_near_a_lane_are_a_warning_with_the_share(tmp_path):
    write_drives(tmp_path / "log", 1, cars=16)
    spoil(tmp_path / "log/drive-000", CHART, shifted_lanes(0, 60))
    (finding,) = check_drives(tmp_path / "log")
    assert finding.warning
    assert "% of all rows" in str(finding)
    assert import_drives(tmp_path / "log", tmp_path / "out").drives


def shifted_lines(count, x=300):
    """Move the first stop lines away."""

    def change(chart):
        for light in chart["lights"][:count]:
            light["stop_line"] = [[px + x, py] for px, py in light["stop_line"]]

    return change


def test_a_stop_line_far_from_its_lane_is_a_warning_and_all_of_them_an_error(log):
    spoil(log / "drive-001", CHART, shifted_lines(1))
    (finding,) = check_drives(log)
    assert finding.warning
    assert "(light 0)" in str(finding)
    assert "1 of 4 lights (25%)" in str(finding)
    assert "4 of 4 lights (100%)" in refusal(log, CHART, shifted_lines(4))


def test_a_stop_line_beside_another_lane_than_it_names_is_a_warning(log):
    def change(chart):
        lane = chart["lanes"][0]
        chart["lanes"].append(lane | {"id": 99, "centre": [[x + 90, y + 90] for x, y in lane["centre"]]})
        chart["lights"][0]["lane"] = 99

    spoil(log / "drive-001", CHART, change)
    (finding,) = check_drives(log)
    assert "is not near its lane 99" in str(finding)
    spoil(log / "drive-001", CHART, lambda chart: chart["lights"][0].update(lane=None))
    assert list(check_drives(log)) == []


def test_routes_elsewhere_are_refused(log):
    assert "nowhere near it" in refusal(log, ROUTES, lambda table: table.assign(x=table.x + 5000))


# --- fields -----------------------------------------------------------------------------------------------------------

NAN, INFINITE = math.nan, math.inf
FIELDS = {
    "agents[0].id": [(HEAD, lambda head, value=value: head["agents"][0].update(id=value)) for value in ("a", 1.5, [1])],
    "ego": [(HEAD, lambda head, value=value: head["agents"][0].update(ego=value)) for value in ("false", None, 1)],
    "length": [(HEAD, lambda head, value=value: head["agents"][0].update(length=value)) for value in (NAN, None, -1)],
    "rate_hz": [(HEAD, lambda head, value=value: head.update(rate_hz=value)) for value in (INFINITE, NAN, "10", None)],
    "steps": [(HEAD, lambda head, value=value: head.update(steps=value)) for value in (60.5, NAN, [60])],
    "source.deep[1].score": [(HEAD, lambda head: head["source"].update(deep=[1, {"score": NAN}]))],
    "lanes[0].id": [(CHART, first_lane(id=value)) for value in ([1], "x", None, NAN, 2**40)],
    "speed_limit": [(CHART, first_lane(speed_limit=value)) for value in (NAN, "fast", [1], -3)],
    "width": [(CHART, first_lane(width=value)) for value in (None, INFINITE, "3.5")],
    "left": [(CHART, first_lane(left=value)) for value in (["solid"], None, 1)],
    "junction": [(CHART, first_lane(junction=value)) for value in ("no", None, 2)],
    "lane'": [(CHART, first_light(lane=value)) for value in ([10], "10", 999, NAN)],
    "stop_line": [(CHART, first_light(stop_line=value)) for value in (None, [[0, 0]], [[0, NAN], [1, 1]])],
    "lights": [(CHART, lambda chart: chart.update(lights={"a": 1}))],
    "lanes[0]": [(CHART, lambda chart: chart["lanes"].__setitem__(0, "lane"))],
    "agent": [
        (STATES, lambda table: table.assign(agent="a")),
        (STATES, lambda table: table.assign(agent=table.agent + 0.5)),
    ],
    "x": [(STATES, lambda table: table.assign(x=[[1.0]] * len(table)))],
    "state": [(LIGHTS, lambda table: table.assign(state=7)), (LIGHTS, lambda table: table.assign(state="red"))],
    "light": [(LIGHTS, lambda table: table.assign(light=77))],
}


@pytest.mark.parametrize(
    ("field", "file", "change"), [(field, *case) for field, cases in FIELDS.items() for case in cases]
)
def test_a_field_of_the_wrong_type_is_one_error_with_file_and_field(log, field, file, change):
    message = refusal(log, file, change)
    assert f"drive-001/{file}" in message
    assert field in message.split("'")[1] + "'"
    assert "\n" not in message


def test_what_may_be_null_may_be_null(log):
    spoil(log / "drive-001", CHART, first_lane(speed_limit=None))
    spoil(log / "drive-001", CHART, first_light(lane=None))
    assert list(check_drives(log)) == []


def test_rows_in_the_order_of_tracks_are_sorted(log):
    expected = import_drives(log, log.parent / "one").drives[1].digest
    spoil(log / "drive-001", STATES, lambda table: table.sort_values(["agent", "step"]))
    import_drives(log, log.parent / "two")
    one, two = (read_episode(log.parent / name / "drive-001") for name in ("one", "two"))
    assert np.array_equal(one.x, two.x, equal_nan=True)
    assert one.digest == expected


# --- words ------------------------------------------------------------------------------------------------------------


def test_a_drive_in_which_no_agent_may_be_ego_is_refused(log):
    message = refusal(log, HEAD, lambda head: [agent.update(ego=False) for agent in head["agents"]])
    assert "none of the 4 agents may be ego" in message


def test_the_same_drive_twice_is_refused_and_both_are_named(log):
    shutil.copytree(log / "drive-000", log / "copy")
    with pytest.raises(BadInputError, match=r"drive-000.*the same|copy.*the same") as caught:
        import_drives(log, log.parent / "out")
    assert "copy" in str(caught.value)
    assert "drive-000" in str(caught.value)


def test_a_missing_optional_column_is_said(log):
    spoil(log / "drive-001", STATES, lambda table: table.drop(columns=["light", "lead_gap"]))
    (finding,) = check_drives(log)
    assert finding.warning
    assert "no column light, lead_gap" in str(finding)


# --- all findings, and what is left without them --------------------------------------------------------------------


def many_faults(log):
    spoil(log / "drive-001", CHART, first_lane(width=None))
    spoil(log / "drive-001", STATES, of_agent(101, 20, 30, x=0, y=0, heading=0, speed=0))
    spoil(log / "drive-001", STATES, of_agent(102, steering=30))
    spoil(log / "drive-001", STATES, of_agent(100, 5, 6, x=np.inf))


def test_check_prints_all_findings_and_imports_nothing(log, capsys, monkeypatch):
    monkeypatch.chdir(log.parent)
    many_faults(log)
    assert main(["import", "log", "--check"]) == 2
    text = capsys.readouterr().out
    for words in (
        "lanes[0] (lane 2).width",
        "(step 20, agent 101)",
        "(step 0, agent 102)",
        "(step 5, agent 100)",
        "4 findings",
    ):
        assert words in text
    assert [path.name for path in log.parent.iterdir()] == ["log"]


def test_drop_bad_leaves_out_what_is_bad_and_says_how_much(log, capsys, monkeypatch):
    monkeypatch.chdir(log.parent)
    before = read_episode(log / "drive-001")
    many_faults(log)
    assert main(["import", "log", "--out", "out", "--drop-bad"]) == 0
    assert "13 of 240 rows (5.4%) and 60 values in others (4 findings" in capsys.readouterr().err
    after = read_episode(log.parent / "out/drive-001")
    assert len(after.lanes) == len(before.lanes) - 1
    assert [column.sum() for column in after.present.T] == [58, 49, 60, 60]
    assert np.isfinite(after.x[after.present]).all()
    assert after.source["left_out"] == {"rows": 13, "values": 60, "findings": 4}
    assert np.abs(after.steering[:, 2]).max() < 1


@pytest.mark.parametrize("fault", MOTION)
def test_what_is_left_after_drop_bad_has_no_findings(log, fault):
    spoil(log / "drive-001", STATES, MOTION[fault][0])
    import_drives(log, log.parent / "out", drop_bad=True)
    assert [finding for finding in check_drives(log.parent / "out") if not finding.warning] == []


def test_a_drive_that_cannot_be_read_is_left_out_by_drop_bad(log):
    (log / "drive-001" / STATES).write_bytes(b"no table")
    heard = []
    imported = import_drives(log, log.parent / "out", drop_bad=True, tell=heard.append)
    assert [drive.name for drive in imported.drives] == ["drive-000"]
    assert "all of it" in heard[0]


# --- memory -----------------------------------------------------------------------------------------------------------


def test_a_long_recording_is_cut_into_parts_that_hold_what_it_holds(tmp_path, monkeypatch):
    monkeypatch.setattr("study.episode.recording.MOST_CELLS", 20_000)
    write_motorway(tmp_path / "log/motorway", steps=3000, agents=60, alive=6)
    imported = import_drives(tmp_path / "log", tmp_path / "out")
    parts = [read_episode(tmp_path / "out" / drive.name) for drive in imported.drives]
    assert len(parts) > 1
    assert all(part.steps * len(part.agents) <= 20_000 for part in parts)
    table = pd.read_parquet(tmp_path / "log/motorway" / STATES)
    assert sum(part.present.sum() for part in parts) == pytest.approx(len(table) / 2.5, rel=0.02)
    assert {agent.id for part in parts for agent in part.agents} == set(range(60))
    assert all(len(valid_moments(part, load_profile("smoke").birdview)) for part in parts)


@pytest.mark.parametrize("seed", range(8))
def test_parts_of_one_recording_serve_one_set(seed):
    """Any number of recordings of any number of parts; those that were not cut are assigned as they ever were."""
    rng = np.random.default_rng(seed)
    parts = rng.integers(1, 7, rng.integers(4, 9))
    drives = tuple(
        Drive(f"log{number}-part-{part:03d}", f"{number} {part}", 1, 1, 1.0, 0, 0, f"log{number}")
        for number, count in enumerate(parts)
        for part in range(count)
    )
    imported = Imported(Path("imported"), drives)
    frames = FramesSettings(seed=seed)
    encoder, policy = imported.assign(frames)
    assert sorted(path.name for path in (*encoder, *policy)) == sorted(drive.name for drive in drives)
    logs = [{path.name.partition("-")[0] for path in paths} for paths in (encoder, policy)]
    assert not logs[0] & logs[1]
    assert min(map(len, logs)) >= 2
    single = Imported(Path("imported"), tuple(replace(drive, recording=drive.name) for drive in drives))
    order = rng_of(seed, "imported drives").permutation(len(drives))
    count = min(max(round(len(drives) * frames.encoder / (frames.encoder + frames.policy)), 2), len(drives) - 2)
    assert [path.name for path in single.assign(frames)[0]] == sorted(drives[place].name for place in order[:count])
    assert single.key != imported.key
    assert single.key == content_key("imported", sorted((drive.name, drive.digest) for drive in drives), (), 1)


def test_parts_are_remembered_and_an_import_that_lacks_them_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr("study.episode.recording.MOST_CELLS", 20_000)
    write_motorway(tmp_path / "log/motorway", steps=3000, agents=60, alive=6)
    write_drives(tmp_path / "log", 1, cars=4, steps=60)
    imported = import_drives(tmp_path / "log", tmp_path / "out")
    assert open_import(tmp_path / "out") == imported
    assert set(imported.recordings.values()) == {"motorway"}
    assert "drive-000" not in imported.recordings
    with pytest.raises(BadInputError, match=r"has 2 recordings .parts of one stay together"):
        imported.assign(FramesSettings())
    content = json.loads((tmp_path / "out/import.json").read_text())
    for drive in content["drives"]:
        del drive["recording"]
    (tmp_path / "out/import.json").write_text(json.dumps(content))
    with pytest.raises(BadInputError, match="import again"):
        open_import(tmp_path / "out")


@pytest.mark.stress
def test_a_whole_motorway_recording_takes_less_than_a_gigabyte(tmp_path):
    write_motorway(tmp_path / "log/motorway")
    _, memory = import_memory(tmp_path / "log", tmp_path / "out")
    assert memory < 1e9
    assert len(json.loads((tmp_path / "out/import.json").read_text())["drives"]) > 4
