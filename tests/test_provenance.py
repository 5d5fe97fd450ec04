"""Provenance of a result."""

import getpass
import json
import os
import platform
import shutil
import subprocess

import pytest

from study.compute.provenance import DIFF_LIMIT, ROOT, cores, provenance


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
    assert (facts["dirty"], facts["diff"], facts["diff_digest"]) == (False, "", None)
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
    assert (facts["commit"], facts["lock"], facts["diff"]) == (None, None, "")
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
    assert provenance(copy)["commit"] == provenance(checkout)["commit"]


def test_a_checkout_around_the_code_is_not_its_own(checkout):
    (checkout / "study" / "a.py").write_text("A = 2\n")
    facts = provenance(checkout / "study")
    assert (facts["commit"], facts["dirty"]) == (None, False)


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
