"""Drives that another program wrote from the text of the format go all the way to the report."""

import re
import subprocess
import sys
from pathlib import Path

from pypdf import PdfReader

from tests.support.processes import ROOT, sweep
from tests.support.sweeps import working_folder

EXAMPLE = ROOT / "examples/foreign_data.py"


def test_the_example_imports_nothing_of_the_program() -> None:
    assert not re.search(r"^\s*(from|import) study", EXAMPLE.read_text(), re.MULTILINE)


def test_foreign_drives_end_in_a_report(tmp_path: Path) -> None:
    working_folder(tmp_path)
    for command in ([str(EXAMPLE), "ring"], ["-m", "study.data", "import", "ring", "--out", "mine"]):
        subprocess.run([sys.executable, *command], cwd=tmp_path, check=True, capture_output=True)
    words = ("heads", "--profile", "tiny", "--policy_seeds", "2", "--heads", "[rec,full]", "--workers", "1")
    words += ("--baselines", "[trail-pca,state]")
    completed = sweep(tmp_path, *words, "--data", "mine")
    assert completed.returncode == 0, completed.stderr
    text = "".join(page.extract_text() for page in PdfReader(tmp_path / "reports/heads.pdf").pages)
    assert "foreign_data.py" in text
