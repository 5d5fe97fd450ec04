"""What killed processes leave in the data folder is swept by whoever is alone there."""

import tempfile
from pathlib import Path

import pytest

from study.scratch import temporary_files, using


@pytest.fixture
def data(tmp_path):
    """A data folder after a kill: drafts, a temporary file, a result not yet committed, and what carries a key."""
    for name in ("cells/.k1.draft/k1", "cells/k1", "cells/k2", "frames/f", "tmp/upload"):
        (tmp_path / name).mkdir(parents=True)
    (tmp_path / "encoders").mkdir()
    for name in ("cells/k1/cell.json", "encoders/.e1.draft", "encoders/e1"):
        (tmp_path / name).write_text("x")
    return tmp_path


def there(data):
    return {str(path.relative_to(data)) for path in data.glob("*/*")}


def committed(keys):
    return {"k1"} & set(keys)


def test_drafts_temporary_files_and_committed_results_go_and_the_rest_stays(data):
    with using(data, committed):
        assert there(data) == {"cells/k2", "frames/f", "encoders/e1"}


def test_what_others_may_be_writing_stays(data):
    with using(data, committed):
        (data / "cells/.k2.draft").mkdir()
        with using(data, committed):
            assert "cells/.k2.draft" in there(data)
        assert "cells/.k2.draft" in there(data)
    assert "cells/.k2.draft" not in there(data)


def test_temporary_files_lie_where_they_are_found_again(data):
    before = tempfile.gettempdir()
    with using(data, committed):
        with temporary_files(data):
            left = Path(tempfile.mkdtemp())
        assert left.parent == data / "tmp"
        assert tempfile.gettempdir() == before
    assert not left.exists()
