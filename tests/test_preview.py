"""The contact sheet and the film of one drive."""

import dataclasses

import numpy as np
import pytest
from PIL import Image

from study.birdview.renderer import Renderer
from study.config.settings import BirdviewSettings
from study.data.frames import open_frames, unpack_masks
from study.data.preview import choose_ego, label_text, sample, write_film, write_preview
from study.errors import BadInputError
from tests.support.drives import crossing_drive

VIEW = BirdviewSettings()


def test_both_files_are_pictures_and_the_same_each_time(small_store, small_drives):
    files = write_preview(open_frames(small_store), small_drives, small_store)
    first = [file.read_bytes() for file in files]
    assert [file.read_bytes() for file in write_preview(open_frames(small_store), small_drives, small_store)] == first
    assert [Image.open(file).format for file in files] == ["PNG", "GIF"]
    assert sorted(path.name for path in small_store.iterdir() if path.name.startswith(".")) == []


def test_a_store_whose_drives_are_gone_is_reported(small_store):
    with pytest.raises(BadInputError, match="build it again"):
        write_preview(open_frames(small_store), [], small_store)


def test_the_sheet_shows_training_frames_with_their_masks_and_labels(small_store):
    frames = open_frames(small_store).encoder
    shown = sample(frames, 0, count=5)
    train = frames.indices("train")
    for text, pictures in shown:
        rows = [row for row in train if (frames.images[row] == pictures[0]).all()]
        assert text in {label_text(frames, int(row)) for row in rows}
        assert any((unpack_masks(frames.masks[row]) * 255 == pictures[1:, ..., 0]).all() for row in rows)
    assert len(shown) == 5


def test_the_label_names_what_the_row_holds(small_store):
    frames = open_frames(small_store).encoder
    labels = frames.labels.copy()
    labels.loc[0, ["acceleration", "steering", "speed", "light", "light_distance", "lead_gap"]] = 0, -0.1, 5, 2, 12, 8
    text = label_text(dataclasses.replace(frames, labels=labels), 0)
    assert text == "command -1, steering -0.100\n5.0 m/s, red in 12 m, gap 8 m"
    labels["lead_gap"] = np.nan
    text = label_text(dataclasses.replace(frames, labels=labels), 0)
    assert text.endswith("red in 12 m"), "where nobody has written gaps, none is known"


def test_the_film_shows_the_egos_bird_view_in_real_time(tmp_path):
    episode = crossing_drive(steps=40)
    write_film(episode, VIEW, tmp_path / "a.gif")
    ego, steps = choose_ego(episode)
    with Image.open(tmp_path / "a.gif") as film:
        assert film.n_frames == len(steps) == 20
        assert film.info["duration"] == 200
        film.seek(10)
        shown = np.asarray(film.convert("RGB"))[2:256:4, 2:256:4].astype(int)
    (view,), _ = Renderer(episode, VIEW).render(np.array([[steps[10], ego]]))
    assert np.abs(shown - view).mean() < 4  # the film has one palette


def test_an_agent_that_may_not_be_ego_is_not_followed():
    episode = crossing_drive(steps=20)
    ego, _ = choose_ego(episode)
    others = tuple(dataclasses.replace(agent, ego=index != ego) for index, agent in enumerate(episode.agents))
    assert choose_ego(dataclasses.replace(episode, agents=others))[0] != ego
    nobody = tuple(dataclasses.replace(agent, ego=False) for agent in episode.agents)
    with pytest.raises(BadInputError, match="may be ego"):
        choose_ego(dataclasses.replace(episode, agents=nobody))


def test_a_drive_without_map_lights_and_routes_has_a_film(tmp_path):
    episode = crossing_drive(steps=20)
    bare = dataclasses.replace(
        episode,
        lanes=(),
        lights=(),
        light=np.full_like(episode.light, -1),
        light_state=episode.light_state[:, :0],
        routes=tuple(route[:0] for route in episode.routes),
    )
    write_film(bare, VIEW, tmp_path / "a.gif")
    with Image.open(tmp_path / "a.gif") as film:
        assert film.n_frames == 10
