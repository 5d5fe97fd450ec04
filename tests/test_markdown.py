import re
from dataclasses import replace

import pytest

from simulated import DATASIZE_GRID, HEADS_GRID, World, simulate
from study.config import Grid, StudySettings
from study.markdown import fixed, written
from study.summary import numbers


@pytest.fixture(scope="module")
def made():
    return numbers(simulate(HEADS_GRID, World(epochs=12)))


def test_the_tables_hold_the_numbers_of_the_json(made):
    text = written(made)
    for score in made["scores"]:
        accuracy = score["accuracy"]
        assert f"| {score['cell']} | 15 | {100 * accuracy['mean']:.1f} | {100 * accuracy['sd']:.2f} |" in text
    for claim in made["claims"]:
        assert re.search(rf"^\| {claim['claim']} \|.*\*\*{claim['outcome']}\*\*", text, flags=re.MULTILINE)
    assert len(made["comparisons"]) / 2 == len(re.findall(r"^\| \S+ \N{MINUS SIGN} \S+ \|", text, flags=re.MULTILINE))
    assert made["provenance"]["commit"] in text


def cells(text, start):
    """Cells of the first row that starts so."""
    line = next(line for line in text.splitlines() if line.startswith(f"| {start} |"))
    return [cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1]]


def test_the_ceiling_has_a_row_and_scores_their_share_of_the_way_to_it(made):
    text = written(made)
    top, at = made["ceiling"], cells(text, "Cell").index("share of gain [%]")
    assert cells(text, "*ceiling (true state)*")[1:3] == [str(top["n"]), f"{100 * top['mean']:.1f}"]
    assert cells(text, "*ceiling (true state)*")[at] == "100"
    for score in made["scores"]:
        gained = (score["accuracy"]["mean"] - made["floor"]["accuracy"]) / (top["mean"] - made["floor"]["accuracy"])
        assert cells(text, score["cell"])[at] == f"{100 * gained:.0f}"


def test_without_a_ceiling_there_is_no_word_of_it():
    text = written(numbers(simulate(HEADS_GRID.model_copy(update={"ceiling": False}), World(epochs=6))))
    assert "| Cell | n | accuracy" in text
    assert "eiling" not in text
    assert "share of gain" not in text


def test_confounds_that_were_run_are_shown_under_both_values(made):
    assert "Confounds" not in written(made)
    record = simulate(HEADS_GRID, World(epochs=6))
    other = simulate(HEADS_GRID, World(epochs=6), seed=1, settings=StudySettings(frames={"split": "frame"}))
    own = numbers(replace(record, variants={"frames.split": other}))
    found = written(own)
    assert "Confounds" in found
    (row,) = [row for row in own["confounds"] if row["contrasts"]]
    listed = [line for line in found.splitlines() if line.startswith("| `frames.split` | episode | frame |")]
    assert len(listed) == len(row["contrasts"]) == 3
    for line, contrast in zip(listed, row["contrasts"], strict=True):
        assert f"| {contrast['name']} | 15, 15 | {fixed(contrast['here']['value'], 2, 100, sign=True)} |" in line
        assert f"| {fixed(contrast['change']['value'], 2, 100, sign=True)} |" in line
        assert line.endswith(f"| {contrast['state']} |")
        assert line.count("|") == 1 + len(cells(found, "Setting"))


def test_every_row_of_a_table_has_the_columns_of_its_head(made):
    for block in re.findall(r"(?:^\|.*\n)+", written(made), flags=re.MULTILINE):
        assert len({len(re.findall(r"(?<!\\)\|", line)) for line in block.splitlines()}) == 1


@pytest.mark.parametrize(
    ("grid", "unfinished"),
    [
        (Grid(name="one", title="One seed", heads=("rec", "full"), policy_seeds=1), ()),
        (Grid(name="b", title="Design B", heads=("rec", "full"), encoder_seeds=3, policy_seeds=2), ("full 100% e1",)),
        (DATASIZE_GRID, ("rec 100% e0",)),
        (Grid(name="none", title="Nothing yet", heads=("full",)), ("full 100% e0",)),
    ],
    ids=lambda item: getattr(item, "name", None),
)
def test_other_grids_and_unfinished_sweeps_have_tables_too(grid, unfinished):
    text = written(numbers(simulate(grid, World(epochs=6), unfinished=unfinished)))
    assert ("Incomplete" in text) == bool(unfinished)
    assert "None" not in text
    assert "nan" not in text


def test_numbers_keep_their_sign_and_their_words():
    assert fixed(-0.0001, 2) == "0.00"
    assert fixed(-0.0123, 2, 100, sign=True) == "\N{MINUS SIGN}1.23"
    assert fixed(0.01, 1, 100, sign=True) == "+1.0"
    assert fixed("never", 0) == "never"
    assert fixed(None, 3) == "\N{EM DASH}"
