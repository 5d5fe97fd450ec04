"""Recordings in the CSV layouts of highD and inD as Episodes, of small tables made here: the data sets are not free."""

import numpy as np
import pandas as pd
import pytest

from study.convert.highd import convert
from study.convert.lanelet2 import utm
from study.data.__main__ import main
from study.episode.files import read_episode
from study.errors import BadInputError
from study.intake.importing import check_drives

FRAMES, RATE = 150, 25.0
SECONDS = np.arange(FRAMES) / RATE
ORIGIN = 294_000.0, 5_629_000.0  # of the made inD, in UTM zone 32 [m]


@pytest.fixture
def highd(tmp_path):
    """Return a recording of a car that drives left on the upper lanes, and a lorry right on the lower ones."""
    down = {"frame": np.arange(1, FRAMES + 1)}
    car = down | {"id": 1, "x": 300 - 30 * SECONDS, "y": 9.1, "width": 4.8, "height": 2.0, "xVelocity": -30.0}
    lorry = down | {"id": 2, "x": 10 + 20 * SECONDS, "y": 20.0 + 0.5 * SECONDS, "width": 12.0, "height": 2.5}
    tables = [pd.DataFrame(car | {"yVelocity": 0.0}), pd.DataFrame(lorry | {"xVelocity": 20.0, "yVelocity": 0.5})]
    pd.concat(tables).to_csv(tmp_path / "01_tracks.csv", index=False)
    meta = {
        "id": [1, 2],
        "width": [4.8, 12.0],
        "height": [2.0, 2.5],
        "class": ["Car", "Truck"],
        "drivingDirection": [1, 2],
    }
    pd.DataFrame(meta).to_csv(tmp_path / "01_tracksMeta.csv", index=False)
    marks = {"upperLaneMarkings": ["8.0;12.0;16.0"], "lowerLaneMarkings": ["18.0;22.0;26.0"]}
    recording = {"id": [1], "frameRate": [25], "speedLimit": [36.11]} | marks
    pd.DataFrame(recording).to_csv(tmp_path / "01_recordingMeta.csv", index=False)
    return tmp_path / "01_tracks.csv"


@pytest.fixture
def ind(tmp_path):
    """Return a recording of a car that drives north, one that reverses, a pedestrian who walks aside, and a bicycle."""
    column = {"frame": np.arange(FRAMES), "trackLifetime": np.arange(FRAMES)}
    north = {"trackId": 0, "xCenter": 50.0, "yCenter": -60 + 10 * SECONDS, "heading": 90.0, "xVelocity": 0.0}
    back = {"trackId": 1, "xCenter": 80 - 2 * SECONDS, "yCenter": -50.0, "heading": 0.0, "xVelocity": -2.0}
    walk = {"trackId": 2, "xCenter": 60.0, "yCenter": -50.0 + SECONDS, "heading": 0.0, "xVelocity": 0.0}
    ride = {"trackId": 3, "xCenter": 70.0, "yCenter": -80.0 + 4 * SECONDS, "heading": 90.0, "xVelocity": 0.0}
    speeds = (10.0, 0.0, 1.0, 4.0)
    tables = [
        pd.DataFrame(column | row | {"yVelocity": vy})
        for row, vy in zip((north, back, walk, ride), speeds, strict=True)
    ]
    pd.concat(tables).to_csv(tmp_path / "07_tracks.csv", index=False)
    sizes = {"trackId": [0, 1, 2, 3], "width": [1.9, 2.0, 0.0, 0.0], "length": [4.4, 5.5, 0.0, 0.0]}
    names = ["car", "van", "pedestrian", "bicycle"]
    pd.DataFrame(sizes | {"class": names}).to_csv(tmp_path / "07_tracksMeta.csv", index=False)
    recording = {"recordingId": [7], "frameRate": [25.0], "speedLimit": [13.9]}
    recording |= {"xUtmOrigin": [ORIGIN[0]], "yUtmOrigin": [ORIGIN[1]]}
    pd.DataFrame(recording).to_csv(tmp_path / "07_recordingMeta.csv", index=False)
    return tmp_path / "07_tracks.csv"


def test_highd_is_an_episode_without_findings(highd, tmp_path):
    convert([highd], tmp_path / "out", 60.0)
    assert [str(finding) for finding in check_drives(tmp_path / "out")] == []
    drive = read_episode(tmp_path / "out/01")
    assert (drive.rate_hz, drive.steps, drive.labels) == (10.0, 60, "none")
    assert [(item.length, item.width, item.ego) for item in drive.agents] == [(4.8, 2.0, True), (12.0, 2.5, False)]
    seconds = np.arange(60) / 10
    assert drive.x[:, 0] == pytest.approx(302.4 - 30 * seconds, abs=1e-3)  # the centre of the box
    assert drive.y[0] == pytest.approx([-10.1, -21.25])  # y points up
    assert np.abs(drive.heading[:, 0]) == pytest.approx(np.pi)
    assert drive.heading[:, 1] == pytest.approx(np.arctan2(-0.5, 20), abs=1e-5)
    assert drive.speed[0] == pytest.approx([30.0, np.hypot(20, 0.5)])


def test_lanes_of_highd_lie_between_its_markings(highd, tmp_path):
    convert([highd], tmp_path / "out", 60.0)
    drive = read_episode(tmp_path / "out/01")
    lanes = [(lane.centre[0, 1], np.sign(np.diff(lane.centre[:, 0])[0]), lane.left, lane.right) for lane in drive.lanes]
    assert lanes == [
        (-10.0, -1, "dashed", "curb"),
        (-14.0, -1, "curb", "dashed"),
        (-20.0, 1, "curb", "dashed"),
        (-24.0, 1, "dashed", "curb"),
    ]
    assert {lane.speed_limit for lane in drive.lanes} == {36.11}
    assert (np.diff(drive.route_s[:, 0]) > 2.9).all()


def test_ind_is_an_episode_without_findings(ind, tmp_path):
    assert main(["convert", "highd", str(ind.parent), "--out", str(tmp_path / "out")]) == 0
    assert [str(finding) for finding in check_drives(tmp_path / "out")] == []
    drive = read_episode(tmp_path / "out/07")
    assert [(item.length, item.width, item.ego, item.kind) for item in drive.agents] == [
        (4.4, 1.9, True, "vehicle"),
        (5.5, 2.0, True, "vehicle"),
        (0.5, 0.5, False, "pedestrian"),  # the table has no sizes of these
        (1.8, 0.65, False, "cyclist"),
    ]
    assert drive.lanes == ()
    assert drive.y[:, 0] == pytest.approx(-60 + np.arange(60), abs=1e-3)
    assert drive.heading[0] == pytest.approx([np.pi / 2, 0, 0, np.pi / 2])
    assert drive.speed[0] == pytest.approx([10.0, -2.0, 1.0, 4.0])


def degrees(x, y):
    """Return latitude and longitude of a place near the recording's origin, by Newton's method on `utm`."""
    at = np.array([50.77, 6.08])
    for _ in range(20):
        here = utm(at[:1], at[1:])[0]
        slope = [(utm(at[:1] + da, at[1:] + do)[0] - here) / 1e-5 for da, do in ((1e-5, 0), (0, 1e-5))]
        at = at + np.linalg.solve(np.array(slope).T, np.array([x, y]) + ORIGIN - here)
    return at


def test_a_lanelet2_map_gives_lanes_and_routes(ind, tmp_path):
    corners = {1: (48.0, -80.0), 2: (48.0, 40.0), 3: (52.0, 40.0), 4: (52.0, -80.0)}
    nodes = "".join(
        f'<node id="{key}" lat="{(at := degrees(*xy))[0]:.10f}" lon="{at[1]:.10f}"/>' for key, xy in corners.items()
    )
    ways = (
        '<way id="11"><nd ref="1"/><nd ref="2"/><tag k="type" v="line_thin"/><tag k="subtype" v="dashed"/></way>'
        '<way id="12"><nd ref="3"/><nd ref="4"/><tag k="type" v="curbstone"/></way>'  # drawn the other way
    )
    lanelet = (
        '<relation id="21"><member type="way" ref="11" role="left"/><member type="way" ref="12" role="right"/>'
        '<tag k="type" v="lanelet"/><tag k="subtype" v="road"/><tag k="speed_limit" v="30"/></relation>'
    )
    (tmp_path / "map.osm").write_text(f"<osm>{nodes}{ways}{lanelet}</osm>")
    convert([ind], tmp_path / "out", 60.0, maps=[tmp_path / "map.osm"])
    findings = list(check_drives(tmp_path / "out"))
    assert all(finding.warning for finding in findings), "the one that reverses is beside this small map"
    drive = read_episode(tmp_path / "out/07")
    lane = drive.lanes[0]
    assert lane.centre[[0, -1]] == pytest.approx(np.array([[50.0, -80.0], [50.0, 40.0]]), abs=0.01)
    assert (lane.width, lane.left, lane.right, lane.speed_limit) == pytest.approx(
        (4.0, "dashed", "curb", 30 / 3.6), abs=0.01
    )
    assert drive.route_s[:, 0] == pytest.approx(20 + np.arange(60), abs=0.05)


def test_utm_is_that_of_a_known_place():
    assert utm(np.array([43.642567]), np.array([-79.387139]))[0] == pytest.approx((630_084, 4_833_438), abs=1.0)


BAD = {
    "a missing column": ("01_tracks.csv", "xVelocity", "speedX", "column 'xVelocity' is missing"),
    "a place that is no number": ("01_tracks.csv", "9.1", "near", "line 2, field 'y': 'near' is not a number"),
    "a rate that is no number": ("01_recordingMeta.csv", "25", "film", "field 'frameRate': 'film' is not a number"),
    "a rate of zero": ("01_recordingMeta.csv", "25", "0", "'frameRate' is 0"),
    "markings that are no numbers": ("01_recordingMeta.csv", "8.0;", "left;", "field 'upperLaneMarkings'"),
    "a track without size": ("01_tracksMeta.csv", "2,12.0", "3,12.0", "no row of track 2"),
    "an empty file": ("01_tracks.csv", None, "", "cannot read"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_input_is_one_error_and_writes_nothing(name, highd, tmp_path):
    file, old, new, message = BAD[name]
    text = (tmp_path / file).read_text()
    (tmp_path / file).write_text("" if old is None else text.replace(old, new, 1))
    with pytest.raises(BadInputError, match=message) as error:
        convert([highd], tmp_path / "out", 60.0)
    assert str(tmp_path / file) in str(error.value)
    assert not (tmp_path / "out").exists()


def test_missing_files_and_wrong_maps_are_bad_input(highd, tmp_path):
    with pytest.raises(BadInputError, match="leave --map out"):
        convert([highd], tmp_path / "out", 60.0, maps=[tmp_path / "map.osm"])
    with pytest.raises(BadInputError, match=r"no XX_tracks\.csv"):
        convert([tmp_path / "01_recordingMeta.csv"], tmp_path / "out", 60.0)
    (tmp_path / "01_tracksMeta.csv").unlink()
    with pytest.raises(BadInputError, match=r"01_tracksMeta\.csv"):
        convert([highd], tmp_path / "out", 60.0)
