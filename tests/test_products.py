"""Products on disk: what was written is read again, damage is noticed, and there is never half of one."""

import json
import shutil

import numpy as np
import pandas as pd
import pytest

from study.errors import BadInputError
from study.products import read_product, write_product

HEAD = {"facts": {"seconds": 1.5, "seeds": [3, 1]}, "name": "β"}
PARTS = {
    "weights": {"a": np.arange(12, dtype=np.float32).reshape(3, 4).T, "b": np.array([255], np.uint8)},
    "samples": {},
}
TABLE = pd.DataFrame({"epoch": [1, 2], "value": [0.1, 1 / 3], "split": ["train", "test"]})
FILES = ("head.json", "curves.parquet", "weights.safetensors", "samples.safetensors")


def write(folder, head=HEAD, parts=PARTS, table=TABLE):
    return write_product(folder, "head.json", head, parts, table)


def read(folder, parts=tuple(PARTS)):
    return read_product(folder, "head.json", parts)


@pytest.fixture
def folder(tmp_path):
    return write(tmp_path / "products" / "one")


def test_what_was_written_is_read_again(folder):
    head, parts, table = read(folder)
    assert {name: head[name] for name in HEAD} == HEAD
    assert parts.keys() == PARTS.keys()
    for part, arrays in PARTS.items():
        assert parts[part].keys() == arrays.keys()
        for name, array in arrays.items():
            assert parts[part][name].dtype == array.dtype
            np.testing.assert_array_equal(parts[part][name], array)
    pd.testing.assert_frame_equal(table, TABLE)


def test_the_same_product_is_the_same_bytes(folder, tmp_path):
    again = write(tmp_path / "again")
    assert {path.name for path in folder.iterdir()} == set(FILES)
    assert all((again / name).read_bytes() == (folder / name).read_bytes() for name in FILES)


@pytest.mark.parametrize("file", FILES)
@pytest.mark.parametrize("how", ["missing", "truncated", "one bit"])
def test_damage_to_any_file_is_noticed(folder, file, how):
    path = folder / file
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 128  # no ASCII any more, where it is the head
    if how == "missing":
        path.unlink()
    else:
        path.write_bytes(content if how == "one bit" else content[:-9])
    with pytest.raises(BadInputError, match="one is no complete product"):
        read(folder)


def test_files_of_two_products_do_not_make_one(folder, tmp_path):
    other = write(tmp_path / "other", parts=PARTS | {"weights": {"a": np.zeros(3)}})
    shutil.copy(other / "weights.safetensors", folder)
    with pytest.raises(BadInputError, match=r"weights\.safetensors does not match its digest"):
        read(folder)


@pytest.mark.parametrize("head", ["[]", "{}", '{"digests": []}', '{"digests": {"../head.json": "0"}}', "null"])
def test_a_foreign_head_is_refused(folder, head):
    (folder / "head.json").write_text(head)
    (folder / "weights.safetensors").unlink()
    with pytest.raises(BadInputError, match="is no complete product"):
        read(folder)


def test_a_product_without_digests_is_read(folder):
    head = json.loads((folder / "head.json").read_text())
    del head["digests"]
    (folder / "head.json").write_text(json.dumps(head))
    assert read(folder)[0] == HEAD


def test_a_folder_that_does_not_exist_is_refused(tmp_path):
    with pytest.raises(BadInputError, match="is no complete product"):
        read(tmp_path / "nothing")


def test_a_write_that_breaks_off_leaves_nothing_and_what_was_there_before(folder):
    before = {name: (folder / name).read_bytes() for name in FILES}
    for target in (folder, folder.with_name("new")):
        with pytest.raises(TypeError, match="not JSON serializable"):  # the head is the last file to be written
            write(target, head={"facts": object()})
    assert [path.name for path in folder.parent.iterdir()] == ["one"]
    assert {name: (folder / name).read_bytes() for name in FILES} == before


def test_a_product_replaces_an_older_one_with_all_that_belongs_to_it(folder):
    write(folder, parts={"other": {"c": np.ones(2)}})
    assert {path.name for path in folder.iterdir()} == {"head.json", "curves.parquet", "other.safetensors"}
    np.testing.assert_array_equal(read(folder, ("other",))[1]["other"]["c"], np.ones(2))
