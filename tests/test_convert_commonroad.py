"""CommonRoad scenarios as Episodes, of files that commonroad-io writes where it is installed."""

import numpy as np
import pytest

from study.convert.commonroad import convert
from study.episode.files import read_episode
from study.episode.schema import GREEN, RED, YELLOW
from study.errors import BadInputError
from study.intake.importing import check_drives

pytest.importorskip("commonroad", reason="commonroad-io is not installed")
STEPS = 80


@pytest.fixture
def scenario(tmp_path):
    """Return a file of commonroad-io: lanes, a light, a car, a lorry, a walker, a bicycle and a parked car."""
    from commonroad.common.common_lanelet import LaneletType, LineMarking
    from commonroad.common.writer.file_writer_interface import OverwriteExistingFile
    from commonroad.common.writer.file_writer_xml import XMLFileWriter
    from commonroad.geometry.obstacle_shapes.rect_obstacle_shape import RectObstacleShape
    from commonroad.planning.planning_problem import PlanningProblemSet
    from commonroad.prediction.prediction import TrajectoryPrediction
    from commonroad.scenario.lanelet import Lanelet
    from commonroad.scenario.obstacle import DynamicObstacle, ObstacleType, StaticObstacle
    from commonroad.scenario.scenario import Scenario
    from commonroad.scenario.state import CustomState, InitialState
    from commonroad.scenario.traffic_light import (
        TrafficLight,
        TrafficLightCycle,
        TrafficLightCycleElement,
        TrafficLightState,
    )
    from commonroad.scenario.trajectory import Trajectory

    def lanelet(number, y, start, end, **options):
        x = np.linspace(start, end, 6)
        sides = [np.stack([x, np.full(6, y + side)], axis=1) for side in (1.5, 0, -1.5)]
        return Lanelet(*sides, lanelet_id=number, **options)

    right = {"adjacent_left": 2, "adjacent_left_same_direction": True, "traffic_lights": {9}, "successor": [3]}
    left = {"adjacent_right": 1, "adjacent_right_same_direction": True, "lanelet_type": {LaneletType.URBAN}}
    made = Scenario(0.1)
    made.add_objects(
        [
            lanelet(1, 0.0, 0, 50, line_marking_left_vertices=LineMarking.DASHED, **right),
            lanelet(2, 3.0, 0, 50, line_marking_right_vertices=LineMarking.DASHED, **left),
            lanelet(3, 0.0, 50, 120, predecessor=[1], lanelet_type={LaneletType.INTERSECTION}),
        ]
    )
    cycle = [(TrafficLightState.GREEN, 30), (TrafficLightState.YELLOW, 10), (TrafficLightState.RED, 20)]
    elements = [TrafficLightCycleElement(*element) for element in cycle]
    made.add_objects(TrafficLight(9, np.array([50.0, -2.0]), TrafficLightCycle(elements, time_offset=5)), {1})

    def vehicle(number, kind, length, first, y, speed):
        shape = RectObstacleShape(width=1.8, length=length)
        states = [
            {"time_step": k, "position": np.array([first + speed * k / 10, y]), "orientation": 0.0, "velocity": speed}
            for k in range(STEPS)
        ]
        initial = InitialState(**states[0], acceleration=0.0, yaw_rate=0.0, slip_angle=0.0)
        trajectory = Trajectory(1, [CustomState(**state) for state in states[1:]])
        return DynamicObstacle(number, kind, shape, initial, TrajectoryPrediction(trajectory, shape))

    made.add_objects(
        [
            vehicle(21, ObstacleType.CAR, 4.5, 10.0, 0.0, 8.0),
            vehicle(22, ObstacleType.TRUCK, 9.0, 5.0, 3.0, 5.0),
            vehicle(23, ObstacleType.PEDESTRIAN, 0.5, 5.0, -3.0, 1.0),
            vehicle(25, ObstacleType.BICYCLE, 1.8, 25.0, 0.0, 4.0),
            StaticObstacle(
                24,
                ObstacleType.PARKED_VEHICLE,
                RectObstacleShape(width=1.8, length=4.0),
                InitialState(time_step=0, position=np.array([30.0, -3.0]), orientation=0.1, velocity=0.0),
            ),
        ]
    )
    path = tmp_path / "DEU_Test-1_1_T-1.xml"
    writer = XMLFileWriter(made, PlanningProblemSet(), "tests", "none", "none", set())
    writer.write_to_file(str(path), OverwriteExistingFile.ALWAYS)
    return path


def test_a_scenario_is_an_episode_without_findings(scenario, tmp_path):
    convert([scenario], tmp_path / "out", 60.0)
    assert [str(finding) for finding in check_drives(tmp_path / "out")] == []
    drive = read_episode(tmp_path / "out" / scenario.stem)
    assert (drive.rate_hz, drive.steps, drive.labels) == (10.0, STEPS, "none")
    assert [(item.id, item.length, item.ego, item.kind) for item in drive.agents] == [
        (21, 4.5, True, "vehicle"),
        (22, 9.0, False, "vehicle"),
        (23, 0.5, False, "pedestrian"),
        (25, 1.8, False, "cyclist"),
        (24, 4.0, False, "vehicle"),
    ]
    assert [len(route) > 0 for route in drive.routes] == [True, True, False, True, True]
    assert drive.x[:, 0] == pytest.approx(10 + 0.8 * np.arange(STEPS), abs=1e-3)
    assert drive.heading[0] == pytest.approx([0, 0, 0, 0, 0.1], abs=1e-3)


def test_lanelets_and_lights_keep_their_meaning(scenario, tmp_path):
    convert([scenario], tmp_path / "out", 60.0)
    drive = read_episode(tmp_path / "out" / scenario.stem)
    assert [(lane.left, lane.right, lane.width, lane.junction) for lane in drive.lanes] == [
        ("dashed", "curb", 3.0, False),
        ("curb", "dashed", 3.0, False),
        ("none", "none", 3.0, True),
    ]
    states = drive.light_state[[4, 5, 34, 35, 44, 45, 64, 65], 0].tolist()
    assert states == [RED, GREEN, GREEN, YELLOW, YELLOW, RED, RED, GREEN]
    assert drive.lights[0].stop_line.tolist() == [[50, 1.5], [50, -1.5]]
    before = drive.x[:, 0] < 50.01
    assert drive.light_distance[before, 0] == pytest.approx(50 - drive.x[before, 0], abs=0.01)
    assert (drive.light[~before, 0] == -1).all()
    assert drive.routes[0][[0, -1]].tolist() == [[0, 0], [120, 0]]


BAD = {
    "another version": ('commonRoadVersion="2020a"', 'commonRoadVersion="2018b"', "'commonRoadVersion' is '2018b'"),
    "a step that is no number": (
        'timeStepSize="0.1"',
        'timeStepSize="often"',
        "'timeStepSize': 'often' is not a number",
    ),
    "a step of 2 s": ('timeStepSize="0.1"', 'timeStepSize="2.0"', "too few"),
    "a missing field": ("<orientation>", "<other>", "cannot read it|'orientation' is missing"),
    "half a file": ("</commonRoad>", "", "no valid XML"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_input_is_one_error_and_writes_nothing(name, scenario, tmp_path):
    old, new, message = BAD[name]
    text = scenario.read_text()
    assert old in text
    text = text.replace(old, new)
    scenario.write_text(text.replace(old.replace("<", "</"), new.replace("<", "</")) if new.startswith("<") else text)
    with pytest.raises(BadInputError, match=message):
        convert([scenario], tmp_path / "out", 60.0)
    assert not (tmp_path / "out").exists()
