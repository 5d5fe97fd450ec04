import json
import re

import pytest

from study.config.grid import Grid
from study.document.markdown import markdown
from study.errors import BadInputError
from study.report.comparison import compare, difference
from study.report.model import checked, read_report
from study.report.rounding import percent
from study.report.summary import summarise
from tests.support.processes import ROOT
from tests.support.synthetic_drives import Wheel, with_drives
from tests.support.synthetic_records import HEADS_GRID, World, simulate

SMALL = Grid(name="small", title="Small | <b>study</b>", heads=("rec", "full"), policy_seeds=4, claims=("H4",))
FAST = World(epochs=12)


def made(record):
    """Return the content of a report.json."""
    return json.loads(summarise(record).json())


def compared(first, second, names):
    return markdown(compare(first, second, names))


@pytest.fixture(scope="module")
def content():
    return made(simulate(SMALL, FAST))


@pytest.fixture(scope="module")
def pair():
    """Return two commits' sweeps on the same frames: in the second, full is worse than rec."""
    accuracy = {"rec": 0.835, "rec+pred": 0.847, "rec+plan": 0.862, "full": 0.60}
    other = made(simulate(HEADS_GRID, World(epochs=12, accuracy=accuracy), seed=1))
    other["provenance"] |= {"commit": "fedcba98" * 5}
    other["rules"] |= {"accuracy_margin": 0.02}
    return checked(made(simulate(HEADS_GRID, FAST)), "a"), checked(other, "b")


@pytest.fixture(scope="module")
def text(pair):
    return compared(*pair, ("old", "new"))


def row(text, *starts):
    """Return the cells of the first row that starts so."""
    line = next(line for line in text.splitlines() if line.startswith("| " + " | ".join(starts)))
    return [cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1]]


def test_a_comparison_shows_what_differs_and_only_that(text):
    assert row(text, "commit")[1:] == ["`0123456789abcdef0123456789abcdef01234567`", f"`{'fedcba98' * 5}`"]
    assert row(text, "rules accuracy\\_margin")[1:] == ["`0.005`", "`0.02`"]
    assert "encoder.lr" not in text
    assert re.search(r"Nothing differs in: .*data.*settings", text)


def test_scores_stand_side_by_side_with_the_difference_and_its_interval(pair, text):
    first, second = (next(score for score in one.scores if score.heads == "full") for one in pair)
    cells = row(text, "full")
    shift = second.accuracy.mean - first.accuracy.mean
    assert cells[1] == f"{100 * first.accuracy.mean:.2f} (15)"
    assert cells[3] == f"\N{MINUS SIGN}{-100 * shift:.2f}"
    gap = difference(first.accuracy, second.accuracy)
    assert gap.low < shift < gap.high < 0


def test_the_share_of_the_possible_gain_stands_beside_with_floor_and_ceiling(pair, text):
    shares = [next(score for score in one.scores if score.heads == "full").share for one in pair]
    assert row(text, "accuracy [%]")[5:] == ["share of gain, first [%]", "share of gain, second [%]"]
    assert row(text, "full")[5:] == [percent(share, 0) for share in shares]
    assert row(text, "true state")[1:3] == [f"{100 * one.ceiling.mean:.2f} (15)" for one in pair]
    assert row(text, "true state")[5:] == ["100", "100"]
    assert row(text, "*floor (commonest class)*")[1:3] == [
        f"{100 * one.floor['acceleration_accuracy']:.2f}" for one in pair
    ]
    assert row(text, "*floor (best constant command)*")[1:3] == [
        f"{1e3 * one.floor['steering_loss']:.3f}" for one in pair
    ]


def test_a_report_without_baselines_is_compared_without_shares(content):
    old = {name: value for name, value in content.items() if name != "baselines"}
    old["scores"] = [{name: value for name, value in score.items() if name != "share"} for score in old["scores"]]
    complete, before = checked(content, "new"), checked(old, "old")
    text = compared(complete, before, ("new", "old"))
    assert "share of gain" not in text
    assert "Only in the first: untrained encoder," in text
    assert "ceiling" not in compared(before, before, ("old", "old"))


def test_rows_have_as_many_cells_as_their_heads(pair, text, content):
    for one in (text, compared(pair[0], checked(content, "part"), ("whole", "part"))):
        for block in re.findall(r"(?:^\|.*\n)+", one, flags=re.MULTILINE):
            assert len({len(re.findall(r"(?<!\\)\|", line)) for line in block.splitlines()}) == 1


def test_the_difference_to_the_baseline_has_the_same_sign_whichever_head_set_that_is(content):
    one = checked(content, "a")
    other = checked(made(simulate(SMALL.model_copy(update={"reference": "full"}), FAST)), "b")
    above, below = one.above_reference(("full", 1.0)), other.above_reference(("rec", 1.0))
    assert 0 < above.low < above.value < above.high
    assert (below.low, below.value, below.high) == (-above.high, -above.value, -above.low)
    assert one.above_reference(("rec", 1.0)) is None
    assert one.above_reference(("full", 0.5)) is None


def test_an_order_that_changed_and_verdicts_that_changed_are_named(text):
    order = row(text, "100 %")
    assert order[1] == "full > rec+plan > rec+pred > rec"
    assert order[2].endswith("> full")
    assert order[3] == "**another**"
    assert re.search(r"Verdicts that changed: .*H2", text)
    assert row(text, "**H2**")[2].startswith("**not reproduced**")


def test_the_same_seeds_are_paired_and_others_are_two_samples(pair):
    first, second = (one.scores[0].accuracy for one in pair)
    assert "paired" in difference(first, second).kind
    shifted = second.model_copy(update={"units": {seed + 1: value for seed, value in second.units.items()}})
    assert "Welch" in difference(first, shifted).kind
    over_encoders = second.model_copy(update={"kind": "t, over encoder seeds"})
    assert "Welch" in difference(first, over_encoders).kind


def test_test_drives_widen_the_interval_of_a_difference(pair):
    first, second = (one.scores[0].accuracy for one in pair)
    without = [side.model_copy(update={"drives": 0}) for side in (first, second)]
    wide, narrow = difference(first, second), difference(*without)
    assert wide.value == narrow.value
    assert wide.high - wide.low > narrow.high - narrow.low
    assert "test drives" in wide.kind


def test_a_sweep_beside_itself_differs_in_nothing(pair):
    text = compared(pair[0], pair[0], ("x", "x"))
    assert "rec (the same result), rec+pred (the same result)" in text
    assert row(text, "full")[3:5] == ["0.00", "0.00 to 0.00"]
    assert "Verdicts that changed: none" in text
    assert "commit" in re.search(r"Nothing differs in: (.*)\.", text).group(1)


def test_cells_of_one_sweep_only_are_named(content):
    complete = checked(made(simulate(HEADS_GRID, FAST)), "whole")
    text = compared(checked(content, "part"), complete, ("part", "whole"))
    assert "Only in the second: rec+pred, rec+plan." in text
    assert row(text, "100 %")[3] == "the same"


def test_cells_at_different_fractions_are_distinguished(content):
    half = checked(made(simulate(SMALL.model_copy(update={"fractions": (0.5,)}), FAST)), "half")
    text = compared(checked(content, "all"), half, ("all", "half"))
    assert "Only in the first: rec at 100 %, full at 100 %." in text
    assert "Only in the second: rec at 50 %, full at 50 %." in text
    assert row(text, "true state")[3] != "\N{EM DASH}"
    assert "### Convergence" not in text


def test_two_sweeps_without_a_common_cell_are_reported(content):
    grid = SMALL.model_copy(update={"heads": ("rec+plan",), "baselines": ()})
    text = compared(checked(content, "a"), checked(made(simulate(grid, FAST)), "b"), ("a", "b"))
    assert "No head set and fraction is finished in both" in text
    empty = simulate(SMALL, FAST, unfinished=[cell.label for cell in SMALL.cells()])
    assert "No head set" in compared(checked(made(empty), "a"), checked(content, "b"), ("a", "b"))


def test_words_of_a_report_stay_words(content):
    content = content | {"claims": [content["claims"][0] | {"reason": "a | b\n<script>", "findings": []}]}
    one = checked(content, "a")
    text = compared(one, one, ("a|b", "`c`"))
    assert "Small \\| \\<b>study\\</b>" in text
    assert "a \\| b \\<script>" in text
    assert "`a b`" in text


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"format_version": 99}, "report format 99"),
        ({"scores": [{"cell": "rec"}]}, "scores.0.heads"),
        ({"rules": {"alpha": "many"}}, "rules.alpha"),
        ({"sweep": None}, "sweep"),
        ({"scores": None}, "scores"),
    ],
)
def test_a_report_that_is_incomplete_is_refused_by_name(content, change, message, tmp_path):
    (tmp_path / "report.json").write_text(json.dumps(content | change))
    with pytest.raises(BadInputError, match=rf"report\.json.*{message}"):
        read_report(tmp_path)


@pytest.mark.parametrize(
    ("text", "message"),
    [("{", "is no JSON"), ("[]", "no report of this program"), ("{}", "format_version"), ("[" * 100_000, "is no JSON")],
)
def test_a_file_that_is_no_report_is_refused(text, message, tmp_path):
    file = tmp_path / "other.json"
    file.write_text(text)
    with pytest.raises(BadInputError, match=message):
        read_report(file)


@pytest.mark.parametrize("folder", sorted((ROOT / "reports/reference").glob("*/")), ids=lambda folder: folder.name)
def test_a_committed_report_is_read_and_written_again_without_a_loss(folder):
    """What reports have had since then may come to it."""
    assert holds(json.loads(read_report(folder).json()), json.loads((folder / "report.json").read_text()))


def holds(content, part):
    """Return whether some content of JSON has every value of a part of it."""
    if isinstance(part, dict):
        return all(name in content and holds(content[name], value) for name, value in part.items())
    if isinstance(part, list):
        return len(content) == len(part) and all(map(holds, content, part))
    return content == part


def test_sweeps_that_both_drove_are_compared_at_the_wheel():
    still = simulate(SMALL, FAST)
    sides = [checked(made(with_drives(still, Wheel(score=score))), "a") for score in ({"full": 40.0}, {"full": 70.0})]
    text = compared(*sides, ("old", "new"))
    part = text.split("At the wheel")[1].split("Order of head sets")[0]
    assert "20 in the first and 20 in the\nsecond" in part or "20 in the first and 20 in the second" in part
    change = float(row(part, "full")[3].removeprefix("+"))
    assert change == pytest.approx(30, abs=4)
    assert row(part, "expert")[1:4] == ["98.0 (20)", "98.0 (20)", "0.0"]
    assert "At the wheel" not in compared(sides[0], checked(made(still), "b"), ("old", "new"))
