"""highway-env's own scenes as Episodes: a second writer of the format, whose drives can be studied."""

import dataclasses
from itertools import pairwise

import numpy as np
import pytest

from examples.highway_scenes import SCENES, SHORTEST, record_scene
from study.birdview.renderer import Renderer, valid_moments
from study.config.files import load_profile
from study.episode.checks import check_episode
from study.intake.adapt import adapt


@pytest.fixture(scope="module")
def drives():
    return {name: record_scene(name, 1) for name in SCENES}


@pytest.mark.parametrize("name", SCENES)
def test_a_scene_is_an_episode_of_its_own_rate(drives, name):
    episode = drives[name]
    check_episode(episode, name)
    assert (episode.rate_hz, episode.labels, episode.lights) == (15.0, "none", ())
    assert episode.steps >= SHORTEST * episode.rate_hz
    assert episode.present.any(axis=0).all()


@pytest.mark.parametrize("name", SCENES)
def test_vehicles_are_on_the_road(drives, name):
    episode = drives[name]
    centre = np.concatenate([_dense(lane.centre) for lane in episode.lanes])
    there = episode.present
    points = np.stack([episode.x[there], episode.y[there]], axis=1)[::7]
    nearest = np.sqrt(((points[:, None] - centre) ** 2).sum(axis=2).min(axis=1))
    assert np.quantile(nearest, 0.99) < 3


def _dense(line):
    """Return points of a polyline, at most about a metre apart."""
    parts = [np.linspace(a, b, int(np.hypot(*(b - a))) + 2) for a, b in pairwise(line)]
    return np.concatenate(parts)


@pytest.mark.parametrize("name", SCENES)
def test_adapted_scenes_give_frames(drives, name):
    settings = load_profile("smoke").birdview
    adapted = adapt(drives[name], name)
    assert (adapted.episode.labels, adapted.skipped) == ("derived", 0)
    moments = valid_moments(adapted.episode, settings)
    images, masks = Renderer(adapted.episode, settings).render(moments[:: len(moments) // 5])
    assert images.any(axis=(1, 2, 3)).all()
    assert masks[:, 1].any(axis=1).all()


def test_a_scene_is_a_function_of_its_seed_alone(drives):
    again = record_scene("merge", 1)  # after the intersection, which changes the drivers' class
    assert np.array_equal(again.x, drives["merge"].x, equal_nan=True)
    assert not np.array_equal(record_scene("merge", 2).x[:90], again.x[:90], equal_nan=True)
    assert dataclasses.asdict(again)["source"] == drives["merge"].source
