"""Provenance of a result."""

import getpass
import json
import os
import platform
import shutil
import subprocess
from dataclasses import replace

import pytest

from study.compute.provenance import DIFF_LIMIT, ROOT, cores, provenance, warn_of_unknown_origin
from study.config.grid import Grid
from study.document.blocks import plain
from study.document.markdown import markdown
from study.report.summary import summarise
from study.report.text import document
from study.tracking.metrics import known
from tests.support.synthetic_records import World, simulate

RECORD = simulate(Grid(name="pair", title="T", heads=("rec", "full"), policy_seeds=3, baselines=()), World(epochs=6))


def git(folder, *words):
    identity = ["-c", "user.name=t", "-c", "user.email=t@example.org"]
    return subprocess.run(["git", "-C", str(folder), *identity, *words], check=True, capture_output=True, text=True)


@pytest.fixture
def checkout(tmp_path):
    (tmp_path / "study").mkdir()
    (tmp_path / "study" / "a.py").write_text("A = 1\n")
    (tmp_path / "requirements.lock").write_text("numpy==2.2\n")
    git(tmp_path, "init", "-q")
    git(tmp_path, "add", ".")
    git(tmp_path, "commit", "-qm", "first")
    return tmp_path


def test_a_clean_checkout_is_its_commit(checkout):
    facts = provenance(checkout)
    assert facts["commit"] == git(checkout, "rev-parse", "HEAD").stdout.strip()
    assert (facts["dirty"], facts["unknown"], facts["diff"], facts["diff_digest"]) == (False, None, "", None)
    assert len(facts["lock"]) == 64


def test_changes_and_new_source_files_are_in_the_diff_and_the_index_stays(checkout):
    (checkout / "study" / "a.py").write_text("A = 2\n")
    (checkout / "study" / "b.py").write_text("B = 3\n")
    before = git(checkout, "status", "--porcelain").stdout
    facts = provenance(checkout)
    assert facts["dirty"]
    assert "+A = 2" in facts["diff"]
    assert "+B = 3" in facts["diff"]
    assert len(facts["diff_digest"]) == 64
    assert git(checkout, "status", "--porcelain").stdout == before


def test_new_files_elsewhere_stay_private(checkout):
    """A file of passwords beside the code is nobody's business."""
    (checkout / ".env").write_text("PASSWORD=hunter2\n")
    assert "hunter2" not in provenance(checkout)["diff"]


def test_a_huge_diff_is_cut_and_says_so(checkout):
    (checkout / "study" / "a.py").write_text("x\n" * DIFF_LIMIT)
    diff = provenance(checkout)["diff"]
    assert len(diff) < DIFF_LIMIT + 100
    assert diff.rstrip().endswith("bytes in all]")


def test_outside_a_checkout_the_rest_is_known(tmp_path):
    facts = provenance(tmp_path)
    assert (facts["commit"], facts["dirty"], facts["lock"], facts["diff"]) == (None, None, None, "")
    assert facts["unknown"] == "the code is no git checkout"
    assert facts["packages"]["numpy"]
    assert facts["cores"] >= 1


def test_a_copy_made_by_git_archive_knows_its_commit(checkout, tmp_path_factory):
    for name in (".git_archival.txt", ".gitattributes"):
        shutil.copy(ROOT / name, checkout)
    git(checkout, "add", ".")
    git(checkout, "commit", "-qm", "second")
    copy = tmp_path_factory.mktemp("copy")
    git(checkout, "archive", "--output", str(copy / "code.tar"), "HEAD")
    shutil.unpack_archive(copy / "code.tar", copy)
    facts = provenance(copy)
    assert facts["commit"] == provenance(checkout)["commit"]
    assert facts["dirty"] is None  # it may have been changed since


def test_a_checkout_around_the_code_is_not_its_own(checkout):
    (checkout / "study" / "a.py").write_text("A = 2\n")
    facts = provenance(checkout / "study")
    assert (facts["commit"], facts["dirty"]) == (None, None)
    assert "not its own" in facts["unknown"]


FAKES = {  # what stands in the place of git -> the reason
    "missing": (None, "git is not installed"),
    "of another user": ("echo \"fatal: detected dubious ownership in repository at '/home/me'\" >&2; exit 128", "safe"),
    "damaged": ("echo 'fatal: bad object in /home/me/.git/objects' >&2; exit 128", "bad object in ..."),
    "silent": ("exit 1", "git refused: no reason"),
}


@pytest.mark.parametrize(("script", "reason"), FAKES.values(), ids=FAKES.keys())
def test_where_git_does_not_tell_commit_and_changes_are_unknown_with_the_reason(
    script, reason, checkout, tmp_path_factory, monkeypatch, capsys
):
    programs = tmp_path_factory.mktemp("programs")
    if script:
        (programs / "git").write_text(f"#!/bin/sh\n{script}\n")
        (programs / "git").chmod(0o755)
    monkeypatch.setenv("PATH", str(programs))
    facts = provenance(checkout)
    assert (facts["commit"], facts["dirty"], facts["diff"]) == (None, None, "")
    assert reason in facts["unknown"]
    assert "/home" not in facts["unknown"]
    warn_of_unknown_origin(provenance(checkout))
    assert "warning: the commit is unknown" in capsys.readouterr().err
    assert known(facts, "commit") == known(facts, "dirty") == f"unknown: {facts['unknown']}"
    text = markdown(document(summarise(replace(RECORD, provenance=RECORD.provenance | facts))))
    assert text.count(str(plain(facts["unknown"]))) == 2
    assert "Commit unknown" in text


def test_a_known_commit_is_told_without_a_warning(checkout, capsys):
    warn_of_unknown_origin(provenance(checkout))
    assert capsys.readouterr().err == ""
    facts = provenance(checkout)
    assert (known(facts, "commit"), known(facts, "dirty")) == (facts["commit"], "false")
    text = markdown(document(summarise(replace(RECORD, provenance=RECORD.provenance | facts))))
    assert "unknown" not in text.partition("## Summary")[0]


def test_no_user_or_host_name_is_recorded(checkout):
    text = json.dumps({name: value for name, value in provenance(checkout).items() if name != "packages"})
    assert platform.node() not in text
    assert getpass.getuser() not in text
    assert str(checkout) not in text


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="processes have no core mask here")
def test_a_process_counts_the_cores_that_it_was_given():
    allowed = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(allowed)})
    try:
        assert cores() == provenance()["cores"] == 1
    finally:
        os.sched_setaffinity(0, allowed)


def test_of_two_versions_of_a_package_the_imported_one_is_recorded(tmp_path, monkeypatch):
    """As with PYTHONPATH before the packages of a machine."""
    for folder, version in (("first", "2.0"), ("second", "1.0")):
        info = tmp_path / folder / f"some_thing-{version}.dist-info"
        info.mkdir(parents=True)
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: some_thing\nVersion: {version}\n")
    monkeypatch.syspath_prepend(tmp_path / "second")
    monkeypatch.syspath_prepend(tmp_path / "first")
    assert provenance(tmp_path)["packages"]["some-thing"] == "2.0"
