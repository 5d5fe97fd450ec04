"""Baselines: what policies are given in the place of a latent."""

from dataclasses import replace

import numpy as np
import pytest

from study.baselines.commands import last_command
from study.baselines.images import FITTED, image_components, trail, trail_components, untrained
from study.baselines.inputs import BaselineInputs
from study.baselines.supervised import supervised_latents
from study.config.settings import BirdviewSettings, EncoderSettings, StudySettings
from study.data.frames import open_frames
from study.encoder.autoencoder import MultiHeadAutoencoder
from study.encoder.latents import encode
from study.errors import BadInputError, TrainingDivergedError


@pytest.fixture(scope="module")
def inputs(small_store, small_drives):
    return BaselineInputs(open_frames(small_store), small_drives[0].parent, StudySettings(), 0, "cpu", lambda *_: None)


def test_an_untrained_encoder_is_the_one_that_training_starts_from(inputs):
    start = MultiHeadAutoencoder("rec", EncoderSettings(), 0).encoder.state_dict()
    images = inputs.store.policy.images
    expected = encode({name: value.numpy() for name, value in start.items()}, images, np.arange(len(images)))
    assert np.array_equal(untrained(inputs), expected)
    assert not np.array_equal(untrained(replace(inputs, seed=1)), expected)


def test_components_are_those_of_the_encoder_sets_training_images(inputs):
    """Against numpy's decomposition: the same numbers up to their signs."""
    encoder, policy = inputs.store.encoder, inputs.store.policy
    train = encoder.images[encoder.indices("train")].reshape(-1, 64 * 64 * 3).astype(np.float64)
    assert len(train) < FITTED
    _, _, axes = np.linalg.svd(train - train.mean(axis=0), full_matrices=False)
    flat = policy.images.reshape(len(policy), -1) - train.mean(axis=0)
    z = image_components(inputs)
    np.testing.assert_allclose(np.abs(z[:, :8]), np.abs(flat @ axes[:8].T), rtol=1e-2, atol=5)


def test_the_trail_is_what_is_bluer_than_anything_else_near_the_ego():
    images = np.zeros((1, 64, 64, 3), np.uint8)
    images[0, 40, 32] = (20, 30, 250)
    images[0, 41, 32] = (250, 250, 0)  # another vehicle
    images[0, 3, 32] = (0, 0, 250)  # too far ahead
    blue = trail(images).reshape(48, 64)
    assert blue[40 - 16, 32] == 220
    assert np.count_nonzero(blue) == 1


def test_frames_without_a_trail_are_refused_by_name(inputs):
    plain = inputs.settings.model_copy(update={"birdview": BirdviewSettings(history=0)})
    with pytest.raises(BadInputError, match=r"trail-pca: these frames show no trail .*--baselines"):
        trail_components(replace(inputs, settings=plain))


def test_the_last_command_is_the_label_of_one_step_ago(inputs):
    labels, z = inputs.store.policy.labels, last_command(inputs)
    assert np.array_equal(z[:, 0], labels["last_steering"])
    assert np.array_equal(z[:, 1:4].argmax(axis=1), labels["last_acceleration"])
    assert not z[:, 4:].any()


def test_a_supervised_network_learns_and_repeats_itself(inputs):
    seen = []
    first = supervised_latents(replace(inputs, progress=lambda *how: seen.append(how)))
    assert np.array_equal(first, supervised_latents(inputs))
    assert seen[-1][0] == seen[-1][1]
    assert not np.allclose(first, untrained(inputs), atol=0.1)


def test_a_supervised_network_that_diverges_says_so(inputs):
    wild = inputs.settings.model_copy(update={"encoder": EncoderSettings(lr=1e30)})
    with pytest.raises(TrainingDivergedError, match=r"supervised.*lower --encoder\.lr"):
        supervised_latents(replace(inputs, settings=wild))
