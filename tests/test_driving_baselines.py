"""Baselines at the wheel: what drivers are given is what policies were trained on."""

import dataclasses
import pkgutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from examples.speed_baseline import BASELINES as OWN
from study.baselines import supervised
from study.baselines.inputs import BaselineInputs
from study.birdview.renderer import Renderer
from study.cell.flow import cell_flow
from study.cell.job import CellJob
from study.config.baselines import BASELINES, SUPERVISED, Baseline
from study.config.files import load_profile
from study.config.grid import Cell
from study.config.keys import cell_key
from study.config.settings import FramesSettings, RecordingSettings, StudySettings, TownSettings
from study.data.frames import FrameStore, open_frames
from study.data.selection import LABELS, candidates
from study.driving.actors import Commands, Expert
from study.driving.cell_actor import cell_actor
from study.driving.drives import Drive
from study.driving.observations import Encode, Observations
from study.driving.rollout import rollout
from study.engine.flows import run_flow
from study.episode.files import read_episode, write_episode
from study.episode.head import episode_digest
from study.episode.schema import Episode
from study.errors import BadInputError

TOWN = TownSettings(rows=3, columns=3, dropped_edges=0, vehicles=20)
SETTINGS = StudySettings(town=TOWN, recording=RecordingSettings(warm_up=3.0))
DRIVE = Drive(2_000_001, 0, 4.0)
RECORDS = (*BASELINES.values(), *OWN)


class Watcher:
    """Leaves the ego to the expert, and keeps what a policy would be given."""

    name, drivers = "watcher", 1

    def __init__(self, encode: Encode, *, sees: bool) -> None:
        self.encode, self.sees = encode, sees
        self.given: list[np.ndarray] = []

    def commands(self, seen: Observations) -> Commands | None:
        self.given.append(self.encode(seen))
        return None


@pytest.fixture(scope="module")
def driven() -> Episode:
    return rollout(DRIVE, Expert(), SETTINGS)[0]


@pytest.fixture(scope="module")
def inputs(small_store: Path, small_drives: list[Path]) -> BaselineInputs:
    return BaselineInputs(open_frames(small_store), small_drives[-1].parent, SETTINGS, 0, "cpu", lambda *_: None)


@pytest.fixture(scope="module")
def stored(driven: Episode, inputs: BaselineInputs, tmp_path_factory: pytest.TempPathFactory) -> BaselineInputs:
    """Return the same inputs with further test frames: every step of the expert's drive, recorded and rendered."""
    folder = tmp_path_factory.mktemp("driven")
    for drive in inputs.drives.iterdir():
        (folder / drive.name).symlink_to(drive)
    write_episode(driven, folder / driven.id)
    facts, store = driven.source["drive"], inputs.store
    number = len(store.manifest["sources"]["policy"])
    birdview = SETTINGS.birdview.model_copy(update={"future": 1})
    columns = candidates(folder / driven.id, number, "policy", FramesSettings(spacing=0.1), birdview)
    labels = pd.DataFrame(columns).query("agent == @facts['ego'] and step >= @facts['first_step']").assign(train=False)
    labels = labels.astype(LABELS)
    column = [agent.id for agent in driven.agents].index(facts["ego"])
    moments = np.stack([labels["step"].to_numpy(), np.full(len(labels), column)], axis=1)
    images, masks = Renderer(read_episode(folder / driven.id), SETTINGS.birdview).render(moments)
    policy = dataclasses.replace(
        store.policy,
        images=np.concatenate([store.policy.images, images]),
        masks=np.concatenate([store.policy.masks, masks]),
        labels=pd.concat([store.policy.labels, labels], ignore_index=True),
    )
    sources = {**store.manifest["sources"]}
    sources["policy"] = [*sources["policy"], {"name": driven.id, "digest": episode_digest(folder / driven.id)}]
    longer = FrameStore(store.encoder, policy, store.manifest | {"sources": sources}, store.key)
    return dataclasses.replace(inputs, store=longer, drives=folder)


@pytest.mark.parametrize("baseline", RECORDS, ids=lambda record: record.name)
def test_drivers_are_given_what_policies_were_trained_on(
    baseline: Baseline, inputs: BaselineInputs, stored: BaselineInputs, tmp_path: Path
) -> None:
    inputs = dataclasses.replace(inputs, folder=tmp_path / "learned")
    watcher = Watcher(pkgutil.resolve_name(baseline.driving)(inputs), sees=baseline.sees)
    rollout(DRIVE, watcher, SETTINGS)
    live = np.concatenate(watcher.given)
    trained = pkgutil.resolve_name(baseline.inputs)(dataclasses.replace(stored, folder=inputs.folder))
    frames = trained[len(inputs.store.policy) :]
    assert len(frames) >= len(live) - 1 > 30
    scale = np.abs(frames).max()
    np.testing.assert_allclose(live[: len(frames)], frames, rtol=1e-5, atol=1e-5 * scale)
    assert len(np.unique(frames, axis=0)) > 1
    if not baseline.sees:
        assert (live[: len(frames)] == frames).all()


# --- cells ------------------------------------------------------------------------------------------------------------

SMALL = load_profile("smoke", {"encoder": {"epochs": 1, "batch": 16}, "policy": {"epochs": 5, "batch": 16}})
SEEDS = 2


@pytest.fixture
def new_job(small_store: Path, small_drives: list[Path], tmp_path: Path) -> Callable[..., CellJob]:
    def make(name: str, settings: StudySettings = SMALL) -> CellJob:
        cell = Cell(heads=name)
        key = cell_key(settings, cell, SEEDS, open_frames(small_store).key)
        drives = small_drives[-1].parent
        return CellJob(cell, key, settings, SEEDS, small_store, drives, tmp_path, "cpu")

    return make


@pytest.mark.parametrize(("name", "given"), [(name, "z") for name in ("rec", *BASELINES)] + [("state", "z+speed")])
def test_the_policies_of_every_cell_drive(name: str, given: str, new_job: Callable[..., CellJob]) -> None:
    policy = SMALL.policy.model_copy(update={"inputs": given})
    job = new_job(name, SMALL.model_copy(update={"policy": policy}))
    result, _ = run_flow(cell_flow(job))
    actor = cell_actor(result, job.frames, job.drives, job.products)
    episodes = rollout(dataclasses.replace(DRIVE, duration=0.5), actor, SETTINGS)
    assert len(episodes) == SEEDS
    assert {episode.source["drive"]["actor"] for episode in episodes} == {job.cell.label}
    assert not any(episode.source["drive"]["reason"] for episode in episodes)


def test_what_a_baseline_has_learned_is_kept_for_driving_and_learned_again_when_lost(
    new_job: Callable[..., CellJob], monkeypatch: pytest.MonkeyPatch
) -> None:
    job = new_job(SUPERVISED)
    result, _ = run_flow(cell_flow(job))
    trained = []
    train = supervised._train
    monkeypatch.setattr(supervised, "_train", lambda inputs: trained.append(1) or train(inputs))
    (kept,) = job.products.glob("baseline-*")
    before = (kept / "weights.safetensors").read_bytes()
    cell_actor(result, job.frames, job.drives, job.products)
    assert not trained
    (kept / "weights.safetensors").write_bytes(before[:-1])
    cell_actor(result, job.frames, job.drives, job.products)
    assert len(trained) == 1
    assert (kept / "weights.safetensors").read_bytes() == before


def test_a_baseline_without_a_driving_function_says_that_it_cannot_drive(
    new_job: Callable[..., CellJob], monkeypatch: pytest.MonkeyPatch
) -> None:
    job = new_job("last-command")
    result, _ = run_flow(cell_flow(job))
    monkeypatch.setitem(BASELINES, "last-command", dataclasses.replace(BASELINES["last-command"], driving=""))
    with pytest.raises(BadInputError, match=r"'last-command' cannot drive.*--baselines"):
        cell_actor(result, job.frames, job.drives, job.products)
