"""Drives of Eclipse SUMO as Episodes: of files in its formats, and of the real program where it is installed."""

import subprocess
from pathlib import Path

import numpy as np
import pytest
from pypdf import PdfReader

from study.convert.sumo import convert
from study.convert.sumo_net import read_net
from study.convert.sumo_trace import read_fcd
from study.data.__main__ import main
from study.episode.files import read_episode
from study.episode.schema import GREEN, RED, YELLOW
from study.errors import BadInputError
from study.intake.importing import check_drives, import_drives
from tests.support.processes import sweep
from tests.support.sumo import NET, SPEED, write_fcd, write_net
from tests.support.sweeps import working_folder


@pytest.fixture
def drive(tmp_path):
    """Return the one drive of the hand-made net."""
    convert([write_net(tmp_path)], tmp_path / "out", 60.0, fcd=[write_fcd(tmp_path)])
    return read_episode(tmp_path / "out/fcd")


def test_what_is_converted_has_no_findings(drive, tmp_path):
    assert list(check_drives(tmp_path / "out")) == []
    assert (drive.rate_hz, drive.steps, drive.labels) == (10.0, 200, "none")
    assert [(agent.length, agent.width, agent.ego) for agent in drive.agents] == [(5.0, 1.8, True)] * 2


def test_positions_are_centres_and_angles_are_radians(drive):
    assert drive.x[0] == pytest.approx([37.5, 17.5])  # half a length behind the front bumper
    assert drive.heading[0] == pytest.approx([0, 0], abs=1e-6)  # east is 90 degrees on a compass
    assert drive.speed[0] == pytest.approx([SPEED, SPEED])


def test_a_sudden_change_of_lane_is_spread(drive):
    y = drive.y[:, 1]
    assert np.abs(np.diff(y)).max() < 0.25
    assert (y[0], y[-1]) == pytest.approx((1.6, 4.8), abs=1e-3)
    assert 0.1 < drive.heading[:, 1].max() < 0.3


def test_lanes_have_borders_and_walks_are_left_out(drive):
    assert [(lane.left, lane.right, lane.width) for lane in drive.lanes if not lane.junction] == [
        ("dashed", "curb", 3.2),
        ("curb", "dashed", 3.5),
        ("dashed", "curb", 3.2),
        ("curb", "dashed", 3.2),
    ]
    assert sum(lane.junction for lane in drive.lanes) == 2


def test_lights_follow_the_static_program_and_govern_the_route(drive):
    assert [drive.light_state[step, 0] for step in (0, 5, 19, 20, 59, 60, 109, 110, 119, 120)] == [
        *(GREEN, GREEN, YELLOW, RED, RED, GREEN, GREEN, YELLOW, YELLOW, RED)
    ]
    before = drive.x[:, 0] < 105
    assert (drive.light[before, 0] == 0).all()
    assert drive.light_distance[before, 0] == pytest.approx(105 - drive.x[before, 0], abs=0.01)
    assert (drive.light[~before, 0] == -1).all()
    assert drive.light[0, 1] == 1, "the lane from which it leaves the edge has the light of its route"
    assert drive.lights[1].stop_line.tolist() == [[105, 3.05], [105, 6.55]]


def test_other_rates_are_resampled(tmp_path, drive):
    net = write_net(tmp_path)
    convert([net], tmp_path / "slow", 60.0, fcd=[write_fcd(tmp_path, period=0.25)])
    slow = read_episode(tmp_path / "slow/fcd")
    assert slow.rate_hz == 10.0
    assert slow.x[:190, 0] == pytest.approx(drive.x[:190, 0], abs=0.05)
    with pytest.raises(BadInputError, match="too few"):
        convert([net], tmp_path / "slower", 60.0, fcd=[write_fcd(tmp_path, period=1.0)])
    assert not (tmp_path / "slower").exists()


def test_a_long_recording_is_cut(tmp_path):
    convert([write_net(tmp_path)], tmp_path / "out", 5.0, fcd=[write_fcd(tmp_path)])
    parts = [read_episode(path) for path in sorted((tmp_path / "out").iterdir())]
    assert [part.steps for part in parts] == [50] * 4
    assert parts[1].light_state[10, 0] == GREEN
    imported = import_drives(tmp_path / "out", tmp_path / "imported")
    assert {drive.recording for drive in imported.drives} == {"fcd"}, "they share vehicles, so they stay together"


def test_types_and_routes_come_from_the_demand(tmp_path):
    demand = tmp_path / "demand.rou.xml"
    demand.write_text(
        '<routes><vType id="van" length="6.1" vClass="delivery"/>'
        '<vehicle id="a" type="van" depart="0"><route edges="in out"/></vehicle></routes>'
    )
    fcd = write_fcd(tmp_path, change=("DEFAULT_VEHTYPE", "van"))
    cut = fcd.read_text().split('<timestep time="5.00">')[0] + "</fcd-export>"  # both are before the light
    fcd.write_text(cut)
    convert([write_net(tmp_path)], tmp_path / "out", 60.0, fcd=[fcd], routes=[demand])
    drive = read_episode(tmp_path / "out/fcd")
    assert [(agent.length, agent.width, agent.ego) for agent in drive.agents] == [(6.1, 2.16, False), (5.0, 1.8, True)]
    assert drive.routes[0][-1].tolist() == [220.0, pytest.approx(1.6)]
    assert drive.routes[1][-1].tolist() == [105.0, pytest.approx(1.6)], "without a plan, a way ends where it was seen"


def test_persons_on_foot_are_pedestrians(tmp_path):
    """One walks over the road, with the id of a vehicle; another sits in it, and is left out."""
    fcd = write_fcd(tmp_path)
    rows = fcd.read_text().split("</timestep>")
    for step in range(len(rows) - 1):
        place = f'x="150" y="{-5 + 0.12 * step:.2f}" angle="0" speed="1.2" type="DEFAULT_PEDTYPE"'
        inside = place.replace("/>", "") + ' vehicle="a"'
        rows[step] += f'<person id="a" {place}/><person id="c" {inside}/>'
    fcd.write_text("</timestep>".join(rows))
    convert([write_net(tmp_path)], tmp_path / "out", 60.0, fcd=[fcd])
    assert [str(finding) for finding in check_drives(tmp_path / "out")] == []
    drive = read_episode(tmp_path / "out/fcd")
    assert [(agent.kind, agent.ego) for agent in drive.agents] == [*[("vehicle", True)] * 2, ("pedestrian", False)]
    assert drive.y[:, 2] == pytest.approx(-5.1 + 0.12 * np.arange(drive.steps), abs=0.01)
    assert drive.heading[:, 2] == pytest.approx(np.pi / 2)
    assert len(drive.routes[2]) == 0


def test_recorded_states_of_lights_come_first(tmp_path):
    states = tmp_path / "tls.xml"
    states.write_text(
        '<tlsStates><tlsState time="0.00" id="J" state="Gr"/><tlsState time="1.50" id="J" state="yG"/></tlsStates>'
    )
    net = NET.replace('type="static"', 'type="actuated"')
    fcd = write_fcd(tmp_path)
    with pytest.raises(BadInputError, match="--tls-states"):
        convert([write_net(tmp_path, net)], tmp_path / "out", 60.0, fcd=[fcd])
    convert([write_net(tmp_path, net)], tmp_path / "out", 60.0, fcd=[fcd], tls_states=states)
    drive = read_episode(tmp_path / "out/fcd")
    assert drive.light_state[[0, 14, 15]].tolist() == [[GREEN, RED], [GREEN, RED], [YELLOW, GREEN]]


def test_a_left_hand_net_has_its_curbs_on_the_left(tmp_path):
    net = read_net(write_net(tmp_path, NET.replace("<net ", '<net lefthand="true" ')))
    assert [lane.left for lane in net.lanes if not lane.junction] == ["curb", "dashed"] * 2


# --- bad input ------------------------------------------------------------------------------------------------------

BAD = {
    "a net without lights": (
        "net",
        NET[NET.index("<tlLogic") : NET.index("<connection")],
        "",
        "'tlLogic'.*no traffic lights",
    ),
    "a tlLogic that is missing": ("net", 'tl="J" linkIndex="1"', 'tl="K" linkIndex="1"', "'tl'.*no tlLogic 'K'"),
    "a shape of words": ("net", 'shape="0,1.6 105,1.6"', 'shape="here there"', "'lane' in_0, field 'shape'"),
    "half a net": ("net", "</net>", "", "no valid XML"),
    "another document": ("net", "net", "routes", "root element is 'routes'"),
    "FCD of another net": (
        "fcd",
        'lane="in_0"',
        'lane="gneE1_0"',
        "'vehicle' a at 0 s, field 'lane'.*no lane 'gneE1_0'",
    ),
    "a time that is no number": ("fcd", 'time="0.10"', 'time="soon"', "field 'time': 'soon' is not a number"),
    "a speed that is none": ("fcd", 'speed="8.00"', 'speed="nan"', "'vehicle' a, field 'speed': 'nan'"),
    "a missing column": ("fcd", 'angle="90.00" ', "", "'vehicle' a has no attribute 'angle'"),
    "uneven times": ("fcd", 'time="0.10"', 'time="0.14"', "field 'time'"),
    "a type of unknown size": ("fcd", "DEFAULT_VEHTYPE", "tank", "size of 'tank' is unknown.*--routes"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_input_is_one_error_and_writes_nothing(name, tmp_path):
    which, old, new, message = BAD[name]
    net = write_net(tmp_path, NET.replace(old, new) if which == "net" else NET)
    fcd = write_fcd(tmp_path, change=(old, new) if which == "fcd" else ("", ""))
    before = set(tmp_path.iterdir())
    with pytest.raises(BadInputError, match=message) as error:
        convert([net], tmp_path / "out", 60.0, fcd=[fcd])
    assert str(net if which == "net" else fcd) in str(error.value)
    assert set(tmp_path.iterdir()) == before


def test_positions_of_another_net_are_noticed(tmp_path):
    fcd = write_fcd(tmp_path)
    fcd.write_text(fcd.read_text().replace('x="', 'x="7'))
    with pytest.raises(BadInputError, match=r"fields 'x' and 'y'.*another net"):
        convert([write_net(tmp_path)], tmp_path / "out", 60.0, fcd=[fcd])


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["x.net.xml", "--cut", "abc"], "--cut"),
        (["x.net.xml", "--cut", "nan"], "--cut"),
        (["x.net.xml", "--fcd", "y.xml"], "cannot read x.net.xml"),
        (["x.net.xml"], "--fcd"),
        (["x.sumocfg", "--fcd", "y.xml"], "--fcd needs"),
        (["x.sumocfg"], "cannot read x.sumocfg"),
    ],
)
def test_wrong_words_are_bad_input(words, message, tmp_path):
    with pytest.raises(BadInputError, match=message):
        main(["convert", "sumo", *words, "--out", str(tmp_path / "out")])


def test_the_command_writes_a_new_folder_only(tmp_path, capsys):
    words = [
        "convert",
        "sumo",
        str(write_net(tmp_path)),
        "--fcd",
        str(write_fcd(tmp_path)),
        "--out",
        str(tmp_path / "out"),
    ]
    assert main(words) == 0
    made = tmp_path / "out"
    assert capsys.readouterr().out.splitlines() == [
        "fcd: 20.0 s, 2 agents, 2 may be ego",
        str(made),
        f"next: python -m study.data import {made}",
    ]
    with pytest.raises(BadInputError, match="holds something"):
        main(words)


# --- the real program -----------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def scenario(tmp_path_factory):
    """Return a folder with a net of netgenerate, vehicles on all its ways, and what SUMO says of them at 10 Hz."""
    sumo = pytest.importorskip("sumo", reason="the extra 'sumo' is not installed")
    folder, programs = tmp_path_factory.mktemp("sumo"), Path(sumo.__file__).parent / "bin"

    def run(name, *words):
        subprocess.run([programs / name, *words], cwd=folder, check=True, capture_output=True)

    lights = ("--tls.guess", "true", "--tls.default-type", "static", "--no-turnarounds", "true")
    walks = ("--sidewalks.guess", "--crossings.guess")
    run(
        "netgenerate",
        "--grid",
        "--grid.number",
        "2",
        "--grid.attach-length",
        "100",
        "-L",
        "2",
        *lights,
        *walks,
        "-o",
        "g.net.xml",
    )
    net = folder / "g.net.xml"
    net.write_text(net.read_text().replace('offset="0"', 'offset="17"'))
    ways = [("left0A0", "B0right0"), ("right1B1", "A1left1"), ("top0A1", "A0bottom0"), ("bottom1B0", "A1top0")]
    kinds = '<vType id="car" sigma="0.5"/><vType id="bike" vClass="bicycle"/><vType id="lorry" vClass="truck"/>'
    flows = [
        f'<flow id="{kind}{number}" type="{kind}" begin="0" end="90" period="{period}" from="{start}" to="{end}" '
        'departLane="random" departSpeed="max"/>'
        for number, (start, end) in enumerate(ways)
        for kind, period in (("car", 4), ("lorry", 30), ("bike", 40))
    ]
    walkers = [
        f'<personFlow id="walk{number}" begin="0" end="90" period="9"><walk from="{start}" to="{end}"/></personFlow>'
        for number, (start, end) in enumerate(ways)
    ]
    rider = '<person id="rider" depart="50"><ride from="left0A0" to="B0right0" lines="car0.3"/></person>'
    (folder / "g.rou.xml").write_text(f"<routes>{kinds}{''.join(flows + walkers)}{rider}</routes>")
    files = '<net-file value="g.net.xml"/><route-files value="g.rou.xml"/>'
    (folder / "g.sumocfg").write_text(f"<configuration><input>{files}</input></configuration>")
    events = "".join(
        f'<timedEvent type="SaveTLSStates" source="{tl}" dest="tls.xml"/>' for tl in ("A0", "A1", "B0", "B1")
    )
    (folder / "add.xml").write_text(f"<additional>{events}</additional>")
    run("sumo", "-c", "g.sumocfg", "--step-length", "0.1", "--fcd-output", "fcd.xml", "-a", "add.xml", "-e", "90")
    return folder


def test_static_programs_tell_what_sumo_says(scenario):
    net = read_net(scenario / "g.net.xml")
    fcd, demand = scenario / "fcd.xml", [scenario / "g.rou.xml"]
    computed, recorded = (read_fcd(fcd, net, demand, path).states for path in (None, scenario / "tls.xml"))
    for tl, states in recorded.items():
        assert len(set(states)) == 6, "with and without the crossings' green"
        assert np.mean([one == other for one, other in zip(computed[tl], states, strict=True)]) > 0.99


@pytest.fixture(scope="module")
def runs(scenario, tmp_path_factory):
    """Return drives of the scenario, run twice, and of its FCD output."""
    pytest.importorskip("traci", reason="the extra 'sumo' is not installed")
    out = tmp_path_factory.mktemp("converted")
    convert([scenario / "g.sumocfg"], out / "run", 60.0, drives=2, warm_up=30.0, seconds=40.0)
    convert([scenario / "g.net.xml"], out / "fcd", 100.0, fcd=[scenario / "fcd.xml"], routes=[scenario / "g.rou.xml"])
    return out


def test_drives_of_sumo_have_no_findings(runs):
    assert [str(finding) for finding in check_drives(runs)] == []


def test_vehicles_of_sumo_stop_at_red_lights_on_their_lanes(runs):
    drive = read_episode(runs / "run/g-000")
    there = drive.present & (drive.light >= 0) & (drive.speed < 0.1) & (drive.light_distance < 5)
    step, agent = np.nonzero(there)
    assert len(step) > 100
    assert (drive.light_state[step, drive.light[there]] == RED).mean() > 0.95
    lengths = np.array([item.length for item in drive.agents])
    gap = drive.light_distance[there] - lengths[agent] / 2  # of the front bumper
    assert np.quantile(gap, [0.1, 0.9]) == pytest.approx([1.0, 1.0], abs=0.5)  # SUMO's own distance from a line
    assert {(item.length, item.ego, item.kind) for item in drive.agents} == {
        *((5.0, True, "vehicle"), (7.1, False, "vehicle")),
        *((1.6, False, "cyclist"), (0.215, False, "pedestrian")),
    }
    drives = drive.present & np.array([item.kind != "pedestrian" for item in drive.agents])
    assert np.isfinite(drive.route_s[drives]).mean() > 0.99


def test_persons_of_sumo_walk_and_wait(runs):
    for name in ("run/g-000", "fcd/fcd"):
        drive = read_episode(runs / name)
        walks = drive.present & np.array([item.kind == "pedestrian" for item in drive.agents])
        assert walks.any(axis=0).sum() > 5
        assert drive.speed[walks].max() < 3
        assert 0.5 < np.median(drive.speed[walks]) < 2


def test_another_seed_is_another_drive_and_the_same_is_the_same(runs, scenario, tmp_path):
    convert([scenario / "g.sumocfg"], tmp_path / "again", 60.0, warm_up=30.0, seconds=40.0)
    first, second, again = (read_episode(p) for p in (runs / "run/g-000", runs / "run/g-001", tmp_path / "again/g-000"))
    assert np.array_equal(first.x, again.x, equal_nan=True)
    assert first.x.shape != second.x.shape or not np.array_equal(first.x, second.x, equal_nan=True)


def test_a_scenario_that_sumo_refuses_is_bad_input(scenario, tmp_path):
    (tmp_path / "bad.sumocfg").write_text(
        f'<configuration><input><net-file value="{scenario}/g.net.xml"/><route-files value="no.rou.xml"/></input>'
        "</configuration>"
    )
    with pytest.raises(BadInputError, match=r"SUMO cannot run it .*no.rou.xml"):
        convert([tmp_path / "bad.sumocfg"], tmp_path / "out", 60.0)
    assert not (tmp_path / "out").exists()


@pytest.mark.stress
def test_a_converted_scenario_ends_in_a_report(scenario, tmp_path):
    working_folder(tmp_path)
    seen = ("--drives", "6", "--warm-up", "30", "--seconds", "40")
    main(["convert", "sumo", str(scenario / "g.sumocfg"), *seen, "--out", str(tmp_path / "drives")])
    main(["import", str(tmp_path / "drives"), "--out", str(tmp_path / "mine")])
    completed = sweep(tmp_path, "heads", "--profile", "smoke", "--data", "mine")
    assert completed.returncode == 0, completed.stderr
    text = "".join(page.extract_text() for page in PdfReader(tmp_path / "reports/heads.pdf").pages)
    assert "study convert sumo" in text
