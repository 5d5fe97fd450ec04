"""A trained cell as one network in a file, and as an MLflow model."""

import io
import json
import subprocess
import sys
import zipfile
from dataclasses import replace
from pathlib import Path

import mlflow.pytorch
import numpy as np
import pytest
import torch
from mlflow.models import Model

from study.driving.driver import export_driver
from study.encoder.inputs import to_float
from study.encoder.latents import encode
from study.encoder.networks import Encoder
from study.policy.draws import initial_weights
from study.policy.latents import normalisation
from study.policy.networks import predict
from study.tracking.model import write_model
from tests.support.synthetic_records import HEADS_GRID, World, simulate

SEEDS = 3


def trained(how="zscore", seeds=SEEDS):
    """Return a cell's result with weights of real networks."""
    grid = HEADS_GRID.model_copy(update={"policy_seeds": seeds, "heads": ("full",)})
    result = next(iter(simulate(grid, World(epochs=6)).results.values()))
    torch.manual_seed(0)
    encoder = {name: value.numpy() for name, value in Encoder().state_dict().items()}
    drawn = [dict(initial_weights(seed)) for seed in range(seeds)]
    policies = {name: np.stack([each[name].numpy() for each in drawn]) for name in drawn[0]}
    z = encode(encoder, result.samples["input"], np.arange(len(result.samples["input"])))
    return replace(result, encoder=encoder, policies=policies | normalisation(z, how))


def said(result, count):
    """Return the policies' answers to the first sample images, computed as in training."""
    return predict(result.policies, encode(result.encoder, result.samples["input"], np.arange(count)))


@pytest.fixture(scope="module")
def result():
    return trained()


@pytest.fixture(scope="module")
def network(result):
    return export_driver(result)


@pytest.fixture(scope="module")
def file(network, tmp_path_factory):
    path = tmp_path_factory.mktemp("export") / "network.pt2"
    path.write_bytes(network)
    return path


@pytest.fixture(scope="module")
def model(result, network, tmp_path_factory):
    folder = tmp_path_factory.mktemp("model") / "driver"
    write_model(folder, result, network)
    return folder


def assert_says_the_same(driver, result, count):
    images = to_float(torch.from_numpy(result.samples["input"][:count]))
    answer = driver(images)
    steering, acceleration = said(result, count)
    np.testing.assert_allclose(answer["steering"].detach().numpy(), steering, atol=1e-5)
    np.testing.assert_allclose(answer["acceleration"].detach().numpy(), acceleration, atol=1e-5)


def test_mlflow_loads_a_network_that_says_what_the_policies_say(result, model, monkeypatch):
    monkeypatch.setenv("MLFLOW_ALLOW_PICKLE_DESERIALIZATION", "false")
    driver = mlflow.pytorch.load_model(str(model))
    for count in (1, 2, 7):  # batches of any size
        assert_says_the_same(driver, result, count)


def test_a_latent_of_unit_length_is_exported_as_such():
    result = trained(how="l2", seeds=1)
    assert_says_the_same(torch.export.load(io.BytesIO(export_driver(result))).module(), result, 3)


def test_the_network_runs_with_torch_alone(file, tmp_path):
    code = (
        f"import sys, torch; driver = torch.export.load({str(file)!r}).module();"
        "print(tuple(driver(torch.zeros(4, 3, 64, 64))['acceleration'].shape), 'study' in sys.modules)"
    )
    completed = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=True)
    assert completed.stdout.strip() == f"({SEEDS}, 4, 3) False"


def test_no_weight_is_pickled(file):
    """The example input alone is torch's own pickle, which MLflow reads as tensors only."""
    with zipfile.ZipFile(file) as archive:
        names = [name for name in archive.namelist() if archive.read(name)[:2] == b"PK"]
        weights = json.loads(archive.read(next(n for n in archive.namelist() if n.endswith("weights_config.json"))))
    assert [Path(name).parent.name for name in names] == ["sample_inputs"]
    assert not any(entry["use_pickle"] for entry in weights["config"].values())


def test_a_model_that_carries_code_is_refused(model, tmp_path, monkeypatch):
    monkeypatch.setenv("MLFLOW_ALLOW_PICKLE_DESERIALIZATION", "false")
    evil = tmp_path / "driver"
    subprocess.run(["cp", "-r", model, evil], check=True)
    with zipfile.ZipFile(evil / "data" / "model.pt2", "a") as archive:
        torch.save(print, tmp_path / "code.pt")
        archive.write(tmp_path / "code.pt", "network/data/constants/custom_obj_0")
    with pytest.raises(mlflow.MlflowException, match="pickle"):
        mlflow.pytorch.load_model(str(evil))


def test_the_model_has_its_signature_and_an_example_that_fits(result, model):
    there = Model.load(str(model))
    assert there.signature.inputs.inputs[0].shape == (-1, 3, 64, 64)
    assert [spec.name for spec in there.signature.outputs] == ["steering", "acceleration"]
    assert [spec.shape for spec in there.signature.outputs] == [(SEEDS, -1), (SEEDS, -1, 3)]
    example = there.load_input_example(str(model))
    assert example.dtype == np.float32
    np.testing.assert_allclose(example, result.samples["input"][:1].transpose(0, 3, 1, 2) / 255, atol=6e-5)
    answer = mlflow.pytorch.load_model(str(model))(torch.from_numpy(example))
    assert {name: value.shape for name, value in answer.items()} == {"steering": (3, 1), "acceleration": (3, 1, 3)}


def test_the_network_drives_without_what_has_trained_it(file, tmp_path):
    """The process holds none of the modules that train, and the drive is that of the weights."""
    code = f"""
import sys, numpy as np, torch
from study.config.settings import RecordingSettings, StudySettings, TownSettings
from study.driving.actors import ExportedActor
from study.driving.drives import Drive
from study.driving.rollout import rollout
town = TownSettings(rows=3, columns=3, dropped_edges=0, vehicles=8)
settings = StudySettings(town=town, recording=RecordingSettings(warm_up=1.0))
actor = ExportedActor("exported", torch.export.load({str(file)!r}).module(), {SEEDS})
episodes = rollout(Drive(2_000_001, 0, 2.0), actor, settings)
assert len(episodes) == {SEEDS}
for episode in episodes:
    facts = episode.source["drive"]
    assert facts["ended"] != "failure" and episode.steps > facts["first_step"]
training = ("lightning", "study.encoder.training", "study.policy.training", "mlflow")
print([name for name in training if name in sys.modules])
"""
    completed = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert (completed.returncode, completed.stdout.strip()) == (0, "[]"), completed.stderr
