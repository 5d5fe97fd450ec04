"""A fifth head and a baseline, added without a change to the program, go from their records to the report."""

import json
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from pypdf import PdfReader

from study.birdview.renderer import Renderer, valid_moments
from study.config.grid import Grid
from study.config.heads import HEAD_SETS, HEADS
from study.config.modules import REGISTRIES
from study.config.settings import BirdviewSettings
from study.data.frames import unpack_masks
from study.errors import BadInputError
from tests.support.drives import crossing_drive
from tests.support.processes import ROOT
from tests.support.sweeps import TINY_SWEEP, sweep_here, working_folder

TARGET = "examples.light_head:lights_ahead"


def test_a_further_mask_leaves_the_papers_as_they_are() -> None:
    episode, settings = crossing_drive(0), BirdviewSettings()
    moments = valid_moments(episode, settings)[::5]
    images, masks = Renderer(episode, settings).render(moments)
    same_images, more_masks = Renderer(episode, settings, ["pred", "plan", TARGET]).render(moments)
    np.testing.assert_array_equal(images, same_images)
    np.testing.assert_array_equal(masks, more_masks[:, :2])
    assert 0 < unpack_masks(more_masks)[:, 2].mean() < 0.1


@pytest.fixture
def _own_registries() -> Iterator[None]:
    """Take the example's records out again."""
    before = {name: dict(records) for name, records in REGISTRIES.items()}
    yield
    for name, records in before.items():
        REGISTRIES[name].clear()
        REGISTRIES[name].update(records)


@pytest.mark.usefixtures("_own_registries")
def test_a_sweep_with_the_example_ends_with_its_report(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    working_folder(tmp_path)
    shutil.copy(ROOT / "examples/light.yaml", tmp_path / "sweeps")
    words = ("light", *TINY_SWEEP[1:], "--baselines", "[speed]", "--heads", "[rec,rec+light]")
    assert sweep_here(tmp_path, monkeypatch, *words) == 0
    report = [
        sys.executable,
        "-m",
        "study.report",
        "light",
        "--format",
        "md",
    ]
    again = subprocess.run(report, cwd=tmp_path, check=True, capture_output=True, text=True)
    assert "rec+light (reconstruction and traffic lights)" in again.stdout
    (manifest,) = (json.loads(path.read_text()) for path in tmp_path.glob("data/frames/*/manifest.json"))
    assert manifest["sets"]["encoder"]["arrays"]["masks"]["shape"] == [40, 3, 512]
    curves = pd.read_parquet(tmp_path / "reports/light/curves.parquet")
    metrics = curves[curves["stage"] == "encoder"].groupby("heads")["metric"].unique()
    assert set(metrics["rec+light"]) == {"loss", "loss_rec", "loss_light"}
    text = " ".join(" ".join(page.extract_text() for page in PdfReader(tmp_path / "reports/light.pdf").pages).split())
    assert "rec+light (reconstruction and traffic lights)" in text  # the words of the record
    assert "(light)" in text  # its learnable numbers
    assert "speed alone, the ego" in text  # a baseline of a module, too
    assert "(pred)," not in text  # not those of heads that this sweep does not train


@pytest.mark.parametrize(
    ("modules", "says"),
    [
        (["no_such_module"], "no_such_module.* cannot be used"),
        (["study.errors"], "needs one of HEADS, HEAD_SETS, BASELINES"),
    ],
)
def test_a_module_without_records_is_refused(modules: list[str], says: str) -> None:
    with pytest.raises(BadInputError, match=says):
        Grid.model_validate({"name": "x", "title": "X", "heads": ["rec"], "modules": modules})


def test_the_program_itself_has_the_papers_heads() -> None:
    assert list(HEADS) == ["rec", "pred", "plan"]
    assert list(HEAD_SETS) == ["rec", "rec+pred", "rec+plan", "full"]
