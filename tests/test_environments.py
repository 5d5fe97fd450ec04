"""The environments for policies: what they show is what the study's policies see, and other libraries accept them."""

import subprocess
import sys
import warnings
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from safetensors.numpy import save_file

from study.birdview.renderer import Renderer
from study.config.settings import DrivingSettings, RecordingSettings, StudySettings, TownSettings
from study.encoder.latents import encode
from study.encoder.networks import untrained_encoder
from study.environments import BirdviewTownEnv, latent_town
from study.errors import BadInputError

SETTINGS = StudySettings(
    town=TownSettings(rows=3, columns=3, dropped_edges=0, vehicles=12),
    recording=RecordingSettings(warm_up=1.0),
    driving=DrivingSettings(duration=3.0),
)
BIRDVIEW, LATENT = (f"study.sim.register:study/{name}Town-v0" for name in ("Birdview", "Latent"))
GO = (2, np.zeros(1, np.float32))


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("cell") / "encoder.safetensors"
    save_file({name: value.numpy() for name, value in untrained_encoder(1).state_dict().items()}, path)
    return path


def made(name: str, weights: Path, **options: object) -> gymnasium.Env:
    cell = {"cell": weights} if name == LATENT else {}
    return gymnasium.make(name, settings=SETTINGS, render_mode="rgb_array", **cell, **options)


@pytest.mark.parametrize("name", [BIRDVIEW, LATENT])
@pytest.mark.parametrize("continuous", [False, True])
def test_gymnasiums_check_passes_without_a_warning(name: str, continuous: bool, weights: Path) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", ".*observation space m..imum value is .?infinity")  # z has no bounds
        warnings.filterwarnings("ignore", ".*different from the unwrapped version")
        check_env(made(name, weights, continuous=continuous).unwrapped)


@pytest.mark.parametrize("name", [BIRDVIEW, LATENT])
def test_stable_baselines_check_passes_without_a_warning(name: str, weights: Path) -> None:
    checker = pytest.importorskip("stable_baselines3.common.env_checker")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        checker.check_env(made(name, weights, continuous=True).unwrapped)


def test_stable_baselines_learns_in_it(weights: Path) -> None:
    ppo = pytest.importorskip("stable_baselines3").PPO
    env = made(LATENT, weights, continuous=True)
    model = ppo("MlpPolicy", env, n_steps=32, batch_size=16, n_epochs=1, seed=0).learn(64)
    assert env.action_space.contains(model.predict(env.reset(seed=1)[0])[0])


def test_no_import_of_ours_is_needed(tmp_path: Path) -> None:
    code = (
        "import gymnasium, sys; before = [n for n in sys.modules if n.startswith('study')]\n"
        f"env = gymnasium.make({BIRDVIEW!r}, settings={{'town': {{'vehicles': 5}}}})\n"
        "print(before, env.reset(seed=0)[0].shape)"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[] (64, 64, 3)"


@pytest.mark.parametrize("name", [BIRDVIEW, LATENT])
def test_the_same_seed_and_actions_give_the_same_bits(name: str, weights: Path) -> None:
    def drive(seed: int | None, env: gymnasium.Env) -> list[bytes]:
        seen = [env.reset(seed=seed)[0].tobytes()]
        for number in range(12):
            observation, reward, *_ = env.step((number % 3, np.array([0.02 * number], np.float32)))
            seen.append(observation.tobytes() + np.float64(reward).tobytes())
        return seen

    one, other = made(name, weights), made(name, weights)
    assert drive(5, one) == drive(5, other) == drive(5, one)
    assert drive(6, one) != drive(5, one)
    assert drive(None, one) != drive(None, one)  # the next drives, drawn from the seed given last


def test_it_shows_bit_for_bit_what_the_recorded_drive_renders_to() -> None:
    env = BirdviewTownEnv(SETTINGS)
    seen, ended = [env.reset(seed=7)[0]], False
    while not ended:
        observation, _, terminated, truncated, info = env.step(GO)
        ended = terminated or truncated
        seen.append(observation)
    assert (info["ended"], terminated, truncated) == ("time", False, True)
    assert (seen[-1] == seen[-2]).all()
    episode = env.ride.episode("test", 0)
    column = [agent.id for agent in episode.agents].index(episode.source["drive"]["ego"])
    steps = np.arange(env.ride.lead_in, episode.steps)
    images, _ = Renderer(episode, SETTINGS.birdview).render(np.stack([steps, np.full(len(steps), column)], axis=1))
    assert (images == np.array(seen[:-1])).all()
    with pytest.raises(BadInputError, match="call reset"):
        env.step(GO)


def test_the_latent_is_that_of_the_encoder(weights: Path) -> None:
    z, _ = latent_town(weights, settings=SETTINGS).reset(seed=3)
    image, _ = BirdviewTownEnv(SETTINGS).reset(seed=3)
    state = {name: value.numpy() for name, value in untrained_encoder(1).state_dict().items()}
    assert np.allclose(z, encode(state, image[None], np.array([0]))[0], atol=1e-5)
    assert (z.shape, z.dtype) == ((64,), np.float32)


def test_a_vector_of_actions_means_the_same_commands() -> None:
    exact = DrivingSettings(duration=3.0, crop=0.25)  # shares of it are floats without rounding
    settings = SETTINGS.model_copy(update={"driving": exact})
    one, other = BirdviewTownEnv(settings), BirdviewTownEnv(settings, continuous=True)
    for env in (one, other):
        env.reset(seed=4)
    for level, steering in ((0, 0.25), (1, -0.125), (2, 0.0)):
        seen = one.step((level, np.array([steering], np.float32)))[0]
        assert (seen == other.step(np.array([steering / 0.25, level * 0.9 - 0.9]))[0]).all()


def test_an_action_that_is_none_and_a_collision_end_the_drive() -> None:
    env = BirdviewTownEnv(SETTINGS)
    env.reset(seed=1)
    _, reward, terminated, _, info = env.step((1, np.array([np.nan], np.float32)))
    assert (reward, terminated, info["ended"]) == (-1, True, "failure")
    assert "steering nan" in info["reason"]
    env.reset(seed=1)
    terminated = False
    while not terminated:
        *_, terminated, truncated, info = env.step((2, np.array([0.2], np.float32)))
        assert not truncated
    assert info["ended"] in {"off route", "collision"}


def test_the_picture_shows_the_town_and_what_the_ego_sees() -> None:
    env = BirdviewTownEnv(SETTINGS, render_mode="rgb_array")
    image, _ = env.reset(seed=2)
    for _ in range(5):
        picture = env.render()
        assert (picture[2:256:4, 258:512:4] == image).all()
        assert len(np.unique(picture[:256, :256].reshape(-1, 3), axis=0)) > 4
        image, *_ = env.step(GO)


def test_bad_input_is_one_clear_error(weights: Path, tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match=r"no finished cell|nothing was tracked"):
        latent_town("0" * 16)
    (tmp_path / "a.safetensors").write_bytes(b"no weights")
    with pytest.raises(BadInputError, match="holds no weights"):
        latent_town(tmp_path / "a.safetensors")
    with pytest.raises(BadInputError, match="call reset first"):
        BirdviewTownEnv(SETTINGS).step(GO)
    with pytest.raises(BadInputError, match="vehicles do not fit"):
        BirdviewTownEnv({"town": {"vehicles": 5000}}).reset(seed=0)
