"""Results that were trained elsewhere come into MLflow whole, exactly once, and as what they are."""

import dataclasses
import json
import shutil

import numpy as np
import pytest

from study.errors import EXIT_INTERRUPTED, BadInputError
from study.planning.plan import make_plan
from study.results.cell_result import load_results
from study.sweep.__main__ import main
from study.sweep.offline_results import planned_results, take_in
from study.tracking.tracker import Tracker
from tests.support.processes import ROOT
from tests.support.run_database import run_database
from tests.support.synthetic_records import EPISODES, FRAMES, World, simulate_cell

PLAN = (
    "heads",
    "--profile",
    "smoke",
    "--heads",
    "[rec,full]",
    "--policy_seeds",
    "2",
    "--baselines",
    "[]",
    "--no-report",
)
DEVICE = "a GPU far away"


@pytest.fixture(scope="module")
def plan():
    return make_plan("heads", "smoke", {}, {"heads": ["rec", "full"], "policy_seeds": 2, "baselines": ()})


@pytest.fixture(scope="module")
def trained(plan, tmp_path_factory):
    """Return a folder as study.sweep train leaves it."""
    folder = tmp_path_factory.mktemp("trained")
    rng = np.random.default_rng(0)
    labels = (
        rng.integers(0, 3, FRAMES).astype(np.uint8),
        rng.uniform(-0.2, 0.2, FRAMES).astype(np.float32),
        np.sort(rng.integers(0, EPISODES, FRAMES)).astype(np.int32),
    )
    world = World(epochs=plan.settings.policy.epochs)
    for key, cell in plan.cells.items():
        result = simulate_cell(cell, key, plan.settings, world, 2, rng, labels)
        result.settings["frames_key"] = plan.frames.name
        result.facts["device"] = DEVICE
        result.save(folder / key)
    (folder / f"frames-{plan.frames.name}.json").write_text(json.dumps({"key": plan.frames.name, "sets": {}}))
    return folder


@pytest.fixture
def folder(trained, tmp_path):
    """Return a copy that a test may damage."""
    return shutil.copytree(trained, tmp_path / "results")


@pytest.fixture
def here(tmp_path, monkeypatch):
    """Enter an empty working folder."""
    shutil.copytree(ROOT / "sweeps", tmp_path / "sweeps")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_an_import_that_was_stopped_goes_on_and_commits_every_cell_once(here, plan, folder, monkeypatch, capsys):
    commit, left = Tracker.commit, [1]

    def stopped(self, *what):
        if not left:
            raise KeyboardInterrupt
        left.pop()
        return commit(self, *what)

    monkeypatch.setattr(Tracker, "commit", stopped)
    assert main(["import", *PLAN, str(folder)]) == EXIT_INTERRUPTED
    monkeypatch.setattr(Tracker, "commit", commit)
    assert run_database(here).cell_counts() == {"FINISHED": 1, "KILLED": 1}
    for _ in range(2):
        assert main(["import", *PLAN, str(folder)]) == 0
        assert run_database(here).cell_counts() == {"FINISHED": 2, "KILLED": 1}

    record = Tracker().reader.read_sweep("heads")
    assert record.complete
    assert record.data["key"] == plan.frames.name
    assert {result.facts["device"] for result in record.results.values()} == {DEVICE}
    assert {result.key: len(result.curves) for result in load_results(folder)} == {
        key: len(result.curves) for key, result in record.results.items()
    }
    assert sorted(path.name for path in folder.glob("*/")) == sorted(plan.cells)  # nothing is taken away


def test_what_is_missing_is_listed_and_not_trained(here, plan, folder, empty_store, capsys):
    (here / "mlruns").mkdir()
    shutil.copy(empty_store, here / "mlruns")
    missing, present = plan.cells
    shutil.rmtree(folder / missing)
    assert main(["import", *PLAN, str(folder)]) == 0
    said = capsys.readouterr().err
    assert f"missing: rec 100% e0 ({missing})" in said
    assert f"full 100% e0 ({present}): imported" in said
    assert run_database(here).cell_counts() == {"FINISHED": 1}
    assert not (here / "data").exists()


def damage(path):
    content = bytearray(path.read_bytes())
    content[-1] ^= 1
    path.write_bytes(content)


def edit(change):
    """Change a result whose files stay intact."""

    def spoil(folder):
        result = next(result for result in load_results(folder.parent) if result.key == folder.name)
        change(result).save(folder)

    return spoil


SPOILT = {
    "a flipped bit": (lambda folder: damage(folder / "encoder.safetensors"), "does not match its digest"),
    "a missing file": (lambda folder: (folder / "curves.parquet").unlink(), "is no complete product"),
    "another name": (lambda folder: folder.rename(folder.with_name("0" * 16)), "give the folder its own name"),
    "another cell": (
        edit(lambda result: dataclasses.replace(result, cell=result.cell.model_copy(update={"encoder_seed": 7}))),
        "another key",
    ),
    "other settings": (
        edit(lambda result: dataclasses.replace(result, settings=result.settings | {"policy_seeds": 3})),
        "another key",
    ),
    "a shorter curve": (
        edit(lambda result: dataclasses.replace(result, curves=result.curves[result.curves["epoch"] != 3])),
        "epochs, each once",
    ),
    "a point twice": (
        edit(lambda result: dataclasses.replace(result, curves=result.curves.iloc[[*range(len(result.curves)), -1]])),
        "epochs, each once",
    ),
    "a policy less": (
        edit(lambda result: dataclasses.replace(result, curves=result.curves[result.curves["policy_seed"] < 1])),
        "2 seeds",
    ),
    "a value that is no number": (
        edit(lambda result: dataclasses.replace(result, curves=result.curves.assign(value=np.inf))),
        "not finite",
    ),
    "fewer predictions": (
        edit(
            lambda result: dataclasses.replace(
                result, predictions=result.predictions | {"steering": result.predictions["steering"][:, 1:]}
            )
        ),
        "predictions of steering",
    ),
}


@pytest.mark.parametrize("how", SPOILT)
def test_a_spoilt_result_is_named_before_anything_is_committed(plan, folder, how):
    spoil, said = SPOILT[how]
    spoil(folder / list(plan.cells)[1])
    with pytest.raises(BadInputError, match=said):
        planned_results(plan, folder)


@pytest.mark.parametrize(
    ("name", "said"), [("nowhere", "no folder"), ("sweeps", "no cell results"), ("sweeps/heads.yaml", "no folder")]
)
def test_a_folder_without_results_is_reported(here, plan, name, said):
    with pytest.raises(BadInputError, match=said):
        main(["import", *PLAN, name])
    assert not list(here.glob("mlruns/*.db"))


def test_results_of_another_plan_alone_are_refused_by_name(folder):
    other = make_plan("heads", "smoke", {"policy": {"epochs": 7}}, {"policy_seeds": 2})
    with pytest.raises(BadInputError, match=r"rec 100% e0 \(\w+\).*none of them is planned in heads \(smoke\)"):
        planned_results(other, folder)


def test_a_manifest_of_other_frames_is_refused(here, plan, folder):
    (folder / f"frames-{plan.frames.name}.json").write_text('{"key": "another"}')
    with pytest.raises(BadInputError, match="manifest of other frames"):
        take_in(plan, folder, list(plan.cells), tracker=None)
