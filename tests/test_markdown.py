import math
import re
from dataclasses import replace

import pytest
from pypdf import PdfReader

from study.config.grid import Grid
from study.config.settings import StudySettings
from study.document.markdown import markdown
from study.report.build import build_report
from study.report.rounding import between, epochs, fixed, percent, points
from study.report.summary import summarise
from study.report.text import document
from tests.support.synthetic_records import DATASIZE_GRID, HEADS_GRID, World, simulate


@pytest.fixture(scope="module")
def report():
    return summarise(simulate(HEADS_GRID, World(epochs=12)))


def written(report):
    return markdown(document(report))


def part(text, title):
    """Return the text below a heading, up to the next."""
    return re.split(r"^#+ ", text.partition(f"# {title}\n")[2], maxsplit=1, flags=re.MULTILINE)[0]


def test_the_tables_hold_the_numbers_of_the_report(report):
    text = written(report)
    for score in report.scores:
        assert f"| {score.cell} | 15 | {percent(score.accuracy.mean, 2)} | {percent(score.accuracy.sd, 2)} |" in text
    for claim in report.claims:
        assert re.search(rf"^\| \*\*{claim.claim}\*\* \|.*\*\*{claim.outcome}\*\*", text, flags=re.MULTILINE)
        for finding in claim.findings:
            assert f"| {finding.state} |" in text
    rows = re.findall(r"^\| \S+ \N{MINUS SIGN} \S+ \|", part(text, "Differences between cells"), flags=re.MULTILINE)
    assert len(rows) == len(report.comparisons) / 2 == 6
    assert report.provenance.commit in text


def cells(text, start):
    """Return the cells of the first row that starts so."""
    line = next(line for line in text.splitlines() if line.startswith(f"| {start} |"))
    return [cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1]]


def test_baselines_have_rows_and_scores_their_share_of_the_way_from_the_best_trivial_one_to_the_ceiling(report):
    text = part(written(report), "Final scores")
    floor, top, at = report.trivial.accuracy.mean, report.ceiling, cells(text, "Cell").index("share")
    assert cells(text, "*true state*")[1:3] == [str(top.n), f"{100 * top.mean:.2f}"]
    assert cells(text, "*true state*")[at] == "100"
    assert cells(text, f"*{report.trivial.cell}*")[at] == "0"
    for score in report.scores:
        gained = (score.accuracy.mean - floor) / (top.mean - floor)
        assert cells(text, score.cell)[at] == percent(gained, 0)


def test_without_baselines_they_are_not_mentioned():
    text = written(summarise(simulate(HEADS_GRID.model_copy(update={"baselines": ()}), World(epochs=6))))
    assert "| Cell | n | accuracy" in text
    assert "eiling" not in text
    assert "aseline" not in part(text, "Final scores")


def test_confounds_that_were_run_are_shown_under_both_values(report):
    assert "`frames.split`: " not in written(report)
    record = simulate(HEADS_GRID, World(epochs=6))
    other = simulate(HEADS_GRID, World(epochs=6), seed=1, settings=StudySettings(frames={"split": "frame"}))
    own = summarise(replace(record, variants={"frames.split": other}))
    text = part(written(own), "`frames.split`: episode here, frame in `heads`")
    (row,) = [row for row in own.confounds if row.contrasts]
    assert len(row.contrasts) == 6
    for contrast in row.contrasts:
        line = cells(text, contrast.name)
        assert line[1:3] == ["15", points(contrast.here.value)]
        assert line[4:6] == ["15", points(contrast.there.value)]
        assert line[7] == points(contrast.change.value)
        assert line[-1] == contrast.state
        assert len(line) == len(cells(text, "Contrast"))


def test_every_row_of_a_table_has_the_columns_of_its_head(report):
    for block in re.findall(r"(?:^\|.*\n)+", written(report), flags=re.MULTILINE):
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
    text = written(summarise(simulate(grid, World(epochs=6), unfinished=unfinished)))
    assert ("Incomplete" in text) == bool(unfinished)
    assert re.findall(r"\b(?:None|nan|inf)\b", text) == []


def test_numbers_keep_their_sign_and_their_words():
    assert fixed(-0.0001, 2) == "0.00"
    assert fixed(-0.0123, 2, 100, sign=True) == "\N{MINUS SIGN}1.23"
    assert fixed(0.01, 1, 100, sign=True) == "+1.0"
    assert fixed(math.inf, 0) == "never"
    assert fixed(None, 3) == fixed(math.nan, 3) == "\N{EM DASH}"
    assert between(math.nan, math.nan, epochs) == "\N{EM DASH}"
    assert between(math.inf, math.inf, epochs) == "never"
    assert between(6, math.inf, epochs) == "6 to never"


def test_words_from_outside_stay_words_in_both_renderings(tmp_path):
    grid = Grid(name="two", title="A | <b>b</b> *c* `d` #e _f_ \\ $g$", heads=("rec",), policy_seeds=2)
    record = simulate(grid, World(epochs=6))
    assert "## A \\| \\<b>b\\</b> \\*c\\* \\`d\\` \\#e \\_f\\_ \\\\ $g$" in written(summarise(record))
    assert grid.title in " ".join(PdfReader(build_report(record, tmp_path)).pages[0].extract_text().split())
