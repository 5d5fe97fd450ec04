"""The main path of a cell: shares change nothing, finished stages are kept, and damage to them is mended."""

import dataclasses

import numpy as np
import pandas as pd
import pytest
import torch

from study.cell import flow, stages
from study.cell.flow import cell_flow, product_folders
from study.cell.job import CellJob
from study.config.baselines import BASELINES, CEILING
from study.config.files import load_profile
from study.config.grid import Cell
from study.config.keys import cell_key
from study.data.frames import open_frames
from study.engine.flows import run_flow
from study.errors import BadInputError
from study.results.cell_result import ARRAYS, CURVE_COLUMNS

SETTINGS = load_profile("smoke", {"encoder": {"epochs": 2, "batch": 16}, "policy": {"epochs": 5, "batch": 16}})
REC = Cell(heads="rec")
SEEDS = 3


@pytest.fixture
def new_job(small_store, small_drives, tmp_path):
    """Return a function that makes a job on the small frames, in a scratch folder of its own."""

    def make(cell=REC, settings=SETTINGS, **changes):
        key = cell_key(settings, cell, SEEDS, open_frames(small_store).key)
        job = CellJob(cell, key, settings, SEEDS, small_store, small_drives[0].parent, tmp_path / "scratch", "cpu")
        return dataclasses.replace(job, **changes)

    return make


def test_beside_an_apple_gpu_policies_are_trained_on_the_cpu_in_shares(new_job, monkeypatch):
    monkeypatch.setattr(flow, "SHARE_SECONDS", 1e-6)
    steps = cell_flow(new_job(device="mps", cell=Cell(heads=CEILING)), one_share=True)
    (latents,) = next(steps).tasks
    policies = steps.send(["latents"]).tasks
    assert latents.accelerated
    assert [task.accelerated for task in policies] == [False] * SEEDS
    assert {task.args[0].policy_device for task in policies} == {"cpu"}


def run(job, **how):
    """Return the result, the network, and the stages that reported progress."""
    stages = []
    result, network = run_flow(cell_flow(job, **how), progress=lambda stage, *_: stages.append(stage))
    return result, network, list(dict.fromkeys(stages))


def assert_same(one, other):
    assert (one.cell, one.key, one.settings) == (other.cell, other.key, other.settings)
    pd.testing.assert_frame_equal(one.curves, other.curves, check_exact=True)
    for part in ARRAYS:
        ours, theirs = getattr(one, part), getattr(other, part)
        assert ours.keys() == theirs.keys()
        for name, array in ours.items():
            assert array.dtype == theirs[name].dtype
            assert array.tobytes() == theirs[name].tobytes(), name


@pytest.fixture
def many_shares(monkeypatch):
    """Make every policy seed a share of its own."""
    monkeypatch.setattr(flow, "SHARE_SECONDS", 1e-9)


def test_policies_in_shares_give_the_result_of_one_share(new_job, tmp_path, many_shares):
    job_once, job_shared = new_job(scratch=tmp_path / "once"), new_job()
    once, network, _ = run(job_once, one_share=True)
    shared, again, stages = run(job_shared)
    assert len(product_folders(job_once)) == 1
    assert len(product_folders(job_shared)) == SEEDS
    assert stages == ["encoder", "latents", "policy", "result"]
    assert_same(once, shared)
    assert network
    assert again
    assert set(shared.curves.columns) == set(CURVE_COLUMNS)
    assert sorted(shared.curves["policy_seed"].unique()) == [-1, 0, 1, 2]


def test_products_of_finished_stages_are_not_made_again(new_job):
    job = new_job()
    first, _, _ = run(job)
    second, _, stages = run(job)
    assert stages == ["latents", "result"]
    assert_same(first, second)


def test_only_what_is_missing_or_damaged_is_made_again_and_is_what_it_was(new_job, many_shares):
    job = new_job()
    first, _, _ = run(job)
    weights = sorted(product_folders(job))[1] / "weights.safetensors"
    content = bytearray(weights.read_bytes())
    weights.write_bytes(content[:-1] + bytes([content[-1] ^ 1]))
    steps = []
    second, _ = run_flow(cell_flow(job), progress=lambda *how: steps.append(how))
    epochs = SETTINGS.policy.epochs
    assert next(how for how in steps if how[0] == "policy") == ("policy", 2, 3)
    assert [how for how in steps if how[0] == "policy"][-1] == ("policy", epochs, epochs)
    assert "encoder" not in {how[0] for how in steps}
    assert_same(first, second)
    assert weights.read_bytes() == content


@pytest.mark.parametrize("name", BASELINES)
def test_a_baseline_has_policies_but_neither_encoder_nor_network(name, new_job, small_drives):
    result, network, stages = run(new_job(Cell(heads=name), drives=small_drives[3].parent))
    assert stages == ["latents", "policy", "result"]
    assert (network, result.encoder, result.samples) == (b"", {}, {})
    assert set(result.curves["stage"]) == {"policy"}
    assert result.facts["seconds"]["encoder"] == 0
    assert np.isfinite(result.curves["value"]).all()
    assert result.predictions["z"].std() > 0


def test_policies_that_are_given_speeds_have_no_network_that_images_could_drive(new_job, small_drives):
    settings = SETTINGS.model_copy(update={"policy": SETTINGS.policy.model_copy(update={"inputs": "z+speed"})})
    for cell in (REC, Cell(heads=CEILING)):
        result, network, _ = run(new_job(cell, settings, drives=small_drives[3].parent))
        assert result.policies["steering_0_weight"].shape == (SEEDS, 74, 256)
        assert result.predictions["z"].shape[1] == 64
        assert network == b""
        speeds = result.policies["z_mean"][64:]  # on average, that of now is hardly another than that of 0.1 s ago
        assert speeds.min() > 0
        assert np.abs(np.diff(speeds)).max() < 1


def test_policies_on_a_share_learn_from_nested_parts_and_meet_the_same_test_frames(new_job):
    def ignore(*_):
        pass

    sets = []
    for share in (1.0, 0.6, 0.4):
        policy = SETTINGS.policy.model_copy(update={"share": share, "batch": 4})
        job = new_job(settings=SETTINGS.model_copy(update={"policy": policy}))
        sets.append(stages.encode_policy_set(job, stages.train_cell_encoder(job, ignore), ignore))
    trained = [{row.tobytes() for row in each.z_train} for each in sets]
    assert trained[0] > trained[1] > trained[2]
    assert [len(each.z_train) for each in sets] == [round(share * len(sets[0].z_train)) for share in (1, 0.6, 0.4)]
    for each in sets[1:]:
        assert each.z_test.tobytes() == sets[0].z_test.tobytes()


def test_facts_say_what_computed(new_job):
    result, _, _ = run(new_job(threads=1))
    facts = result.facts
    assert (facts["device"], facts["threads"]) == ("CPU", 1)
    for head in facts["heads"].values():
        assert 0 <= head["entropy"] < head["constant"]
    assert facts["frames"]["policy_train"] + facts["frames"]["policy_test"] == 40
    assert facts["seconds"]["cell"] == pytest.approx(
        sum(facts["seconds"][name] for name in ("encoder", "encode", "policies"))
    )
    assert facts["peak_bytes"] > 1e7
    assert facts["provenance"]["seeds"]["policies"] == list(range(SEEDS))


def test_frames_of_another_plan_are_refused(new_job):
    with pytest.raises(BadInputError, match="is not the frame store that rec 100% e0 was planned on"):
        run(new_job(key="0" * 16))


@pytest.mark.skipif(torch.cuda.is_available(), reason="a GPU is there")
@pytest.mark.parametrize("device", ["cuda", "cuda:0", "cuda:1"])
def test_a_gpu_that_does_not_exist_is_refused_and_never_replaced_by_the_cpu(new_job, device):
    with pytest.raises(BadInputError, match="choose from cpu"):
        run(new_job(device=device))


@pytest.mark.skipif(torch.cuda.is_available(), reason="a GPU is there")
def test_without_a_gpu_auto_is_the_cpu(new_job):
    assert run(new_job(device="auto"))[0].facts["device"] == "CPU"
