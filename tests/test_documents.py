"""The documents: their commands work, their links lead somewhere, and what they name exists.

Each page's code blocks are tried in a newcomer's working folder:

- YAML whose first line is `# PATH` is written to PATH; Python is run.
- `python -m study.sweep NAME` is run with `--dry-run`, `study.data import` as it stands. The options of every other
  command of the study are parsed, and a sweep's plan is made.
- `make TARGET` is run with make's own `--dry-run`. `cp` and blocks of shell tools alone are run.
- Commands with the profile `smoke` and blocks below `<!-- test: stress -->` are run to their end by `make stress`.
- Blocks below `<!-- test: skip, REASON -->` are not run. Anything else is an error.
"""

from __future__ import annotations

import importlib
import os
import re
import runpy
import shlex
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from unittest.mock import patch

import pytest
from markdown.extensions.toc import slugify
from mkdocs.commands.build import build
from mkdocs.config import load_config

from study.config.baselines import BASELINES
from study.config.heads import HEAD_SETS, HEADS
from study.config.settings import StudySettings
from study.errors import BadInputError
from tests.support.processes import ROOT

PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
LINKED = [*PAGES, ROOT / "CHANGELOG.md", ROOT / "benchmarks/README.md"]
LANGUAGES = {"bash", "python", "yaml", "text"}
SHELL_TOOLS = {"mkdir", "cd", "cp", "openssl"}
BLOCK = re.compile(r"(?:^<!-- test: ([^\n]*?) -->\n)?^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
MARK = re.compile(r"stress|skip, \w.*")


@dataclass(frozen=True)
class Block:
    """A code block of a page; `mark` is what the comment above it says to the tests."""

    place: str
    mark: str
    language: str
    code: str

    def commands(self) -> list[list[str]]:
        """Return the words of each command."""
        lines = self.code.replace("\\\n", " ").splitlines()
        return [words for line in lines if (words := shlex.split(line, comments=True))]


def blocks(page: Path) -> list[Block]:
    text = page.read_text(encoding="utf-8")
    name = page.relative_to(ROOT)
    return [
        Block(f"{name}:{text.count(chr(10), 0, found.start()) + 1}", found[1] or "", found[2], found[3])
        for found in BLOCK.finditer(text)
    ]


def name_of(page: Path) -> str:
    return str(page.relative_to(ROOT))


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Enter a working folder with the repository's files that commands read, and a stand-in for Slurm."""
    for name in ("sweeps", "examples"):
        shutil.copytree(ROOT / name, tmp_path / name)
    (tmp_path / "reports").mkdir()
    (tmp_path / "reports/reference").symlink_to(ROOT / "reports/reference")
    submit = tmp_path / "bin/sbatch"
    submit.parent.mkdir()
    submit.write_text("#!/bin/sh\n")
    submit.chmod(0o755)
    monkeypatch.setenv("PATH", f"{submit.parent}:{os.environ['PATH']}")
    monkeypatch.chdir(tmp_path)
    with patch.dict(HEADS), patch.dict(HEAD_SETS), patch.dict(BASELINES):  # a sweep file may add to them
        yield tmp_path


def write_file(block: Block, folder: Path) -> None:
    """Write a YAML block to the file that its first line names."""
    path = folder / block.code.splitlines()[0].removeprefix("# ")
    assert path.suffix == ".yaml", f"{block.place}: the first line does not name a file"
    path.write_text(block.code, encoding="utf-8")


def run_python(block: Block, folder: Path) -> None:
    file = folder / "block.py"
    file.write_text(block.code, encoding="utf-8")
    runpy.run_path(str(file))


class ParsedError(Exception):
    """Ends a command as soon as its options are parsed and its plan is made."""


def run_study(module: str, words: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """Run a study command as far as this costs nothing."""
    main = importlib.import_module(f"{module}.__main__").main
    if (module, words[0]) == ("study.data", "import"):
        assert main(words) == 0
        return
    if module == "study.sweep" and words[0] not in {"status", "verify", "drive", "train", "import", "clean"}:
        assert main([*words, *["--dry-run"] * ("--dry-run" not in words)]) == 0
        return

    def stop(_):
        raise ParsedError

    with monkeypatch.context() as context:
        context.setattr(f"{module}.__main__.resolve_name", stop)
        with pytest.raises(ParsedError):
            main(words)


def run_commands(block: Block, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Run the commands of a block by the rules at the head of this module."""
    commands = block.commands()
    if all(words[0] in SHELL_TOOLS for words in commands):
        subprocess.run(["bash", "-eu", "-c", block.code], cwd=folder, check=True, capture_output=True)
        return
    for words in commands:
        if words[0] == "make":
            subprocess.run(["make", "--dry-run", *words[1:]], cwd=ROOT, check=True, capture_output=True)
        elif words[0] == "cp":
            subprocess.run(words, cwd=folder, check=True, capture_output=True)
        else:
            assert words[:2] == ["python", "-m"], f"{block.place}: no rule runs '{words[0]}'; mark the block"
            assert words[2].startswith("study."), f"{block.place}: no rule runs '{words[2]}'; mark the block"
            run_study(words[2], words[3:], monkeypatch)


# --- the tests ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_every_block_has_a_language_and_a_mark_that_is_known(page):
    found = blocks(page)
    assert page.read_text(encoding="utf-8").count("```") == 2 * len(found)
    assert page.read_text(encoding="utf-8").count("<!-- test:") == sum(bool(block.mark) for block in found)
    for block in found:
        assert block.language in LANGUAGES, block.place
        assert not block.mark or MARK.fullmatch(block.mark), block.place


@pytest.mark.parametrize("page", [page for page in PAGES if blocks(page)], ids=name_of)
def test_the_blocks_of_a_page_run(page, folder, monkeypatch):
    waiting = [block for block in blocks(page) if not block.mark]
    if shutil.which("openssl") is None and any("openssl" in block.code for block in waiting):
        pytest.skip("needs openssl")
    for block in waiting:  # files first: a page may show its commands before what they need
        if block.language == "yaml":
            write_file(block, folder)
        elif block.language == "python":
            run_python(block, folder)
    for block in waiting:
        if block.language == "bash":
            run_commands(block, folder, monkeypatch)


@pytest.mark.parametrize(
    ("code", "error"),
    [
        ("python -m study.sweep heads --encoder.epohcs 5", BadInputError),
        ("python -m study.report heads --figures both.svg", BadInputError),
        ("python -m study.sweep verify heads --fractions '[2]'", BadInputError),
        ("make haeds", subprocess.CalledProcessError),
        ("mkdir a/b", subprocess.CalledProcessError),
        ("curl https://example.org", AssertionError),
    ],
)
def test_a_command_that_does_not_work_is_noticed(code, error, folder, monkeypatch):
    with pytest.raises(error):
        run_commands(Block("here", "", "bash", code), folder, monkeypatch)


@pytest.mark.stress
def test_what_the_pages_do_with_the_smoke_profile_works(folder):
    found = [block for page in PAGES for block in blocks(page)]
    for block in found:
        if block.language == "yaml":
            write_file(block, folder)
    shell = [block for block in found if block.language == "bash"]
    commands = [words for block in shell for words in block.commands()]
    run = [words for block in shell if not block.mark.startswith("skip") for words in block.commands()]
    smoke = [words for words in run if "smoke" in words]
    assert len(smoke) >= 4
    for words in [words for words in commands if words[0] == "cp"]:
        subprocess.run(words, cwd=folder, check=True)
    for words in smoke:
        done = subprocess.run([sys.executable, *words[1:]], cwd=folder, capture_output=True, text=True, check=False)
        assert done.returncode == 0, f"{shlex.join(words)}\n{done.stderr}"
    assert (folder / "reports/heads.pdf").read_bytes().startswith(b"%PDF")
    for block in found:
        if block.mark == "stress":
            run_python(block, folder)


def anchors(page: Path) -> set[str]:
    headings = re.findall(r"^#+ (.+)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    return {slugify(heading, "-") for heading in headings}


@pytest.mark.parametrize("page", LINKED, ids=name_of)
def test_relative_links_lead_to_a_file_and_to_a_heading(page):
    text = re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    targets = re.findall(r"\]\(([^)\s]+)\)", text) + re.findall(r'src="([^"]+)"', text)
    for target in targets:
        if target.startswith(("http://", "https://")):
            continue
        file, _, anchor = target.partition("#")
        path = page.parent / file if file else page
        assert path.exists(), target
        assert not anchor or anchor in anchors(path), target


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_files_and_settings_that_a_page_names_exist(page):
    text = page.read_text(encoding="utf-8")
    for name in re.findall(r"`((?:study|tests|sweeps|docs|benchmarks|examples|reports/reference)/[\w./-]*)`", text):
        assert (ROOT / name).exists() or name == "sweeps/NAME.yaml", name
    groups = StudySettings.model_fields
    for group, setting in re.findall(rf"`({'|'.join(groups)})\.(\w+)`", text):
        assert setting in groups[group].annotation.model_fields, f"{group}.{setting}"


def test_the_readme_is_short():
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) <= 120


def test_the_site_builds_without_a_warning(tmp_path):
    config = load_config(str(ROOT / "mkdocs.yml"), site_dir=str(tmp_path), strict=True)
    build(config)  # raises Abort after warnings
    assert (tmp_path / "index.html").is_file()
