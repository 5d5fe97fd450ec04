"""The data card: numbers, text and figure of a frame store and its drives."""

import json
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from study.birdview.renderer import MASK_BYTES
from study.config.settings import BirdviewSettings
from study.data.card import _others, _twins, card_files, card_text, make_card, nearest_frames, thumbnails, write_card
from study.data.frames import Frames, open_frames
from study.episode.files import read_episode
from study.figures.data_card import data_card, headline
from study.figures.fonts import fonts_for
from tests.support.spoil import spoil

VIEW = BirdviewSettings()


def pictures(count, seed=0):
    return np.random.default_rng(seed).integers(0, 256, (count, 64, 64, 3)).astype(np.uint8)


def test_the_traffic_is_that_of_the_drives(small_store, small_drives):
    episodes = [read_episode(path) for path in small_drives]
    said = make_card(open_frames(small_store), small_drives)["drives"]
    seconds = sum(episode.steps / 10 for episode in episodes)
    metres = sum(float(episode.speed[episode.present].sum()) / 10 for episode in episodes)
    assert said["used"] == said["here"] == said["seeds"] == 6
    assert said["towns"] == 1  # one crossing for all
    assert said["vehicles"] == 72
    assert said["hours"] == pytest.approx(seconds / 3600, abs=1e-4)
    assert said["vehicle_km"] == pytest.approx(metres / 1000, abs=0.006)


def test_the_same_store_gives_the_same_bytes(small_store, small_drives):
    files = write_card(open_frames(small_store), small_drives, small_store)
    first = [file.read_bytes() for file in files]
    assert [
        file.read_bytes() for file in write_card(open_frames(small_store), small_drives[::-1], small_store)
    ] == first
    assert sorted(path.name for path in (small_store / "card").iterdir()) == ["card.json", "card.png", "card.txt"]
    assert not list(small_store.glob(".card*"))


def test_a_card_that_exists_is_not_made_again(small_store, small_drives):
    files = card_files(open_frames(small_store), small_drives, small_store)
    before = [file.stat().st_mtime_ns for file in files]
    assert [
        file.stat().st_mtime_ns for file in card_files(open_frames(small_store), small_drives, small_store)
    ] == before


def test_a_store_whose_drives_are_gone_still_has_a_card(small_store, tmp_path):
    store = open_frames(small_store)
    card = make_card(store, [])
    assert card["drives"] == {"used": 6, "here": 0}
    assert "none of them here" in card_text(card)
    assert len(write_card(store, [], tmp_path)) == 3


def test_the_text_names_every_share_and_how_many_were_counted(small_store, small_drives):
    card = make_card(open_frames(small_store), small_drives)
    text = card_text(card)
    for words in ("standing", "light red", "command -1", "before selection", "other vehicles in view", "split: frame"):
        assert text.count(words) == 2  # once for each set
    assert f"n = {card['sets']['encoder']['agents_in_view']['frames']} frames" in text
    json.dumps(card, allow_nan=False)


def test_agents_in_view_are_those_whose_centre_is_painted(small_drives):
    """Counted again by hand: turned into the ego's frame with complex numbers."""
    episode = read_episode(small_drives[0])
    labels = pd.DataFrame({"step": [12, 40, 60], "agent": [100, 103, 107]})
    expected = []
    for step, agent in labels.itertuples(index=False):
        place = episode.x[step] + 1j * episode.y[step]
        ego = [item.id for item in episode.agents].index(agent)
        relative = (place - place[ego]) * np.exp(-1j * episode.heading[step, ego])
        expected.append(int(((np.abs(relative.imag) < 20) & (relative.real > -15) & (relative.real < 25)).sum()) - 1)
    assert _others(labels, small_drives[0], VIEW.model_dump()) == expected
    assert max(expected) > 0


def test_a_thumbnail_of_one_colour_is_its_grey():
    images = np.full((3, 64, 64, 3), 1, np.uint8) * np.array([0, 128, 255], np.uint8)[:, None, None, None]
    assert thumbnails(images, np.arange(3))[:, ::50].tolist() == [[0] * 6, [128] * 6, [255] * 6]


def test_the_nearest_frame_is_the_one_a_search_finds():
    small = thumbnails(pictures(80), np.arange(80))
    small[5] = small[60]
    distance, nearest = nearest_frames(small[:20], small[20:])
    gaps = np.sqrt(((small[:20, None].astype(float) - small[None, 20:]) ** 2).mean(axis=2))
    np.testing.assert_array_equal(nearest, gaps.argmin(axis=1))
    np.testing.assert_allclose(distance, gaps.min(axis=1), atol=1e-9)
    assert (distance[5], nearest[5]) == (0, 40)


def test_a_split_by_frame_finds_the_twins_that_a_split_by_drive_keeps_apart():
    """Five drives that stand still at ten places each: every picture is there eight times, in its drive alone."""
    images = np.repeat(pictures(50), 8, axis=0)
    labels = pd.DataFrame({"episode": np.repeat(np.arange(5), 80)})
    twins = _twins(Frames(images, np.zeros((400, 2, MASK_BYTES), np.uint8), labels), 0.2, 0)
    assert twins["episode"]["twins"] == twins["episode"]["same_drive"] == 0
    assert twins["frame"]["twins"] > 0.95
    assert twins["frame"]["same_drive"] > 0.95
    assert twins["frame"]["test"] == twins["episode"]["test"] == 80


def written_by(drives, writer, folder):
    """Return copies of drives by another writer; their frames are the same."""
    copies = [Path(shutil.copytree(drive, folder / drive.parent.name / drive.name)) for drive in drives]
    for copy in copies:
        spoil(copy, "episode.json", lambda head: head["source"].update(writer=writer))
    return copies


def test_a_writer_in_any_script_is_in_the_title_or_the_missing_characters_are_named(
    small_store, small_drives, tmp_path, capsys
):
    """DejaVu Sans has Georgian; nobody has a character of the private planes; dollars are no formula."""
    store = open_frames(small_store)
    for name, missing in (("ქართული $x_$\nlab", False), ("script \U00016b50", True)):
        drives = written_by(small_drives, name, tmp_path / str(missing))
        write_card(store, drives, tmp_path)
        assert f"written by {' '.join(name.split())}" in headline(make_card(store, drives))
        lacks = missing and fonts_for(name).missing  # a machine may have the font
        assert ("U+16B50" in capsys.readouterr().err) == bool(lacks)


def test_frames_of_a_single_drive_are_split_by_frame_only(small_store, small_drives):
    card = make_card(open_frames(small_store), small_drives)
    labels = pd.DataFrame({"episode": np.zeros(50, int)})
    twins = _twins(Frames(pictures(50), np.zeros((50, 2, MASK_BYTES), np.uint8), labels), 0.2, 0)
    assert "episode" not in twins
    assert twins["frame"]["test"] == 10
    for entry in card["sets"].values():
        entry["twins"] = twins
    assert card_text(card).count("all frames are of one drive") == 2
    data_card(card)
