"""The Dockerfile installs the lock, runs as a normal user and copies what exists. No container engine is needed."""

import fnmatch
import re
import shlex

import pytest

from tests.support.processes import ROOT

TEXT = (ROOT / "Dockerfile").read_text(encoding="utf-8").replace("\\\n", " ")
STEPS = [line.split(maxsplit=1) for line in TEXT.splitlines() if line and not line.startswith("#")]
IGNORED = (ROOT / ".dockerignore").read_text(encoding="utf-8").split()


def steps(*names):
    return [(name, words) for name, words in STEPS if name in names]


def sources():
    """Return what each COPY takes from the checkout."""
    return [source for _, words in steps("COPY") for source in shlex.split(words)[:-1] if not source.startswith("--")]


def test_it_ends_as_a_normal_user_who_owns_what_a_sweep_writes():
    users = [words for _, words in steps("USER")]
    assert users
    assert users[-1] not in {"root", "0"}
    assert all(f"--chown={users[-1]}" in words for _, words in steps("COPY"))
    volumes = shlex.split(re.sub(r"[\[\],]", " ", dict(steps("VOLUME"))["VOLUME"]))
    assert sorted(volumes) == ["/study/data", "/study/mlruns", "/study/reports"]
    before_user = TEXT.partition("USER ")[0]
    assert all(volume in before_user for volume in volumes)  # else root would own them
    assert f"chown -R {users[-1]}: /study" in before_user


def test_packages_are_those_of_the_lock_in_a_layer_before_the_code():
    names = [words for _, words in steps("COPY", "RUN")]
    install = next(index for index, words in enumerate(names) if "--requirement requirements.lock" in words)
    code = next(index for index, words in enumerate(names) if words.endswith(" study study"))
    assert install < code
    assert not any("pip install" in words for words in names[code:])


@pytest.mark.parametrize("source", sources())
def test_what_is_copied_exists_and_is_not_ignored(source):
    assert (ROOT / source).exists()
    assert not any(fnmatch.fnmatch(source, pattern) for pattern in IGNORED)


def test_code_examples_and_sweeps_are_copied():
    assert {"Makefile", "pyproject.toml", "requirements.lock", "study", "sweeps", "examples"} <= set(sources())


def test_results_data_and_history_stay_out():
    assert {"mlruns", "data", "reports", "results", ".git", ".venv"} <= set(IGNORED)


def test_its_command_is_the_readmes():
    command = re.findall(r'"([^"]+)"', dict(steps("CMD"))["CMD"])
    readme = re.search(r"make heads ARGS='--profile smoke'", (ROOT / "README.md").read_text(encoding="utf-8"))
    assert command == shlex.split(readme[0])


def test_the_given_commit_is_written_as_git_archive_writes_it():
    assert (ROOT / ".git_archival.txt").read_text(encoding="utf-8").startswith("node: ")
    assert 'echo "node: $COMMIT" > .git_archival.txt' in TEXT
