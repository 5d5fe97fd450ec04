"""Films of drives: every step in real time, what the policy saw, and how the drive ended."""

import dataclasses
import io
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from study.birdview.film import HOLD, film, pictures
from study.birdview.renderer import Renderer
from study.birdview.scene import SIDE, WORDS, Scene
from study.config.settings import RecordingSettings, StudySettings, TownSettings
from study.driving.actors import Expert, FunctionActor
from study.driving.drives import Drive
from study.driving.rollout import rollout
from study.episode.schema import Episode
from study.errors import BadInputError

SETTINGS = StudySettings(
    town=TownSettings(rows=3, columns=3, dropped_edges=0, vehicles=20), recording=RecordingSettings(warm_up=1.0)
)
VIEW = SETTINGS.birdview
DRIVE = Drive(2_000_001, 0, 3.0)


@pytest.fixture(scope="module")
def episode() -> Episode:
    return rollout(DRIVE, Expert(), SETTINGS)[0]


def ego_of(episode: Episode) -> int:
    return [agent.id for agent in episode.agents].index(episode.source["drive"]["ego"])


def test_a_film_shows_every_step_and_holds_its_end(episode: Episode) -> None:
    shown = list(pictures(episode, VIEW))
    assert len(shown) == 30 + HOLD * 10
    assert {picture.shape for picture in shown} == {(SIDE + WORDS, 2 * SIDE, 3)}
    assert (shown[-1] == shown[30]).all()


def test_the_right_half_is_what_the_policy_saw(episode: Episode) -> None:
    first = episode.source["drive"]["first_step"]
    moments = np.array([[first + 12, ego_of(episode)]])
    (view,), _ = Renderer(episode, VIEW).render(moments)
    assert (list(pictures(episode, VIEW))[12][2:SIDE:4, SIDE + 2 :: 4] == view).all()


@pytest.mark.parametrize(("suffix", "rate"), [(".mp4", 10), (".webm", 10), (".GIF", 5)])
def test_a_film_plays_in_real_time(episode: Episode, suffix: str, rate: int, tmp_path: Path) -> None:
    content = film(episode, VIEW, suffix, 80.0)
    if suffix == ".GIF":
        with Image.open(io.BytesIO(content)) as gif:
            times = []
            for number in range(gif.n_frames):
                gif.seek(number)
                times.append(gif.info["duration"])
        assert times[:15] == [200] * 15
        assert sum(times) == 200 * 16 + 1000 * HOLD  # equal pictures may be one that is shown longer
        return
    path = tmp_path / f"film{suffix}"
    path.write_bytes(content)
    reader = cv2.VideoCapture(str(path))
    frames = []
    while (read := reader.read())[0]:
        frames.append(read[1][..., ::-1].astype(int))
    assert (reader.get(cv2.CAP_PROP_FPS), len(frames)) == (rate, 50)
    assert np.abs(frames[20] - list(pictures(episode, VIEW))[20]).mean() < 12


def test_a_crash_a_failure_and_a_drive_without_a_step_have_films() -> None:
    failing = FunctionActor(lambda seen: (np.nan, 1))
    (failed,) = rollout(DRIVE, failing, SETTINGS)
    assert failed.steps == failed.source["drive"]["first_step"]
    assert len(list(pictures(failed, VIEW))) == 1 + HOLD * 10
    facts = failed.source["drive"]
    column = ego_of(failed)
    pose = [float(values[-1, column]) for values in (failed.x, failed.y, failed.heading, failed.speed)]
    collision = {"ended": "collision", "collision": {"ego": pose, "other": [pose[0] + 3, *pose[1:]], "agent": 0}}
    crashed = dataclasses.replace(failed, source={"drive": facts | collision})
    first, *_, last = pictures(crashed, VIEW)
    assert (first[:SIDE, :SIDE] != last[:SIDE, :SIDE]).any()
    assert (first[:SIDE, SIDE:] == last[:SIDE, SIDE:]).all()


def test_the_bar_shows_the_side_and_the_size_of_the_steering(episode: Episode) -> None:
    step, ego = episode.steps - 1, ego_of(episode)
    view = np.zeros((64, 64, 3), np.uint8)
    filled = {}
    for steering in (0.25, 0.1, -0.1):
        wheel = episode.steering.copy()
        wheel[step, ego] = steering
        scene = Scene(dataclasses.replace(episode, steering=wheel), ego, 0.25)
        row = scene.frame(step, view)[SIDE + 16, 284:440].astype(int)
        columns = np.flatnonzero(np.ptp(row, axis=1) > 40) + 284
        filled[steering] = columns.min(), columns.max()
    assert filled[0.25][0] < filled[0.1][0] < filled[0.1][1] <= 362 <= filled[-0.1][0] < filled[-0.1][1]


def test_the_town_stands_still_until_the_ego_is_far_from_its_middle(episode: Episode) -> None:
    scene = Scene(episode, ego_of(episode), 0.25)
    scene.town(10)
    before = scene._middle.copy()
    scene.town(11)
    assert (scene._middle == before).all()


def test_another_suffix_is_refused(episode: Episode) -> None:
    with pytest.raises(BadInputError, match=r"unknown kind of film '.avi'; choose from .mp4, .webm, .gif"):
        film(episode, VIEW, ".avi")
