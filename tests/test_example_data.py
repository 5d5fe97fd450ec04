"""Drives that another program wrote from the text of the format go all the way to the report."""

import re
import subprocess
import sys
from pathlib import Path

import pytest
from pypdf import PdfReader

from study.data.__main__ import main as import_drives
from tests.support.processes import ROOT
from tests.support.sweeps import TINY_SWEEP, sweep_here, working_folder

EXAMPLE = ROOT / "examples/foreign_data.py"


def test_the_example_imports_nothing_of_the_program() -> None:
    assert not re.search(r"^\s*(from|import) study", EXAMPLE.read_text(), re.MULTILINE)


def test_foreign_drives_end_in_a_report(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    working_folder(tmp_path)
    subprocess.run([sys.executable, EXAMPLE, "ring"], cwd=tmp_path, check=True, capture_output=True)
    monkeypatch.chdir(tmp_path)
    assert import_drives(["import", "ring", "--out", "mine"]) == 0
    words = (*TINY_SWEEP, "--heads", "[rec,full]", "--baselines", "[trail-pca,state]")
    assert sweep_here(tmp_path, monkeypatch, *words, "--data", "mine") == 0
    text = "".join(page.extract_text() for page in PdfReader(tmp_path / "reports/heads.pdf").pages)
    assert "foreign_data.py" in text
