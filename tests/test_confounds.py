"""A confound is a sweep that differs in one setting alone; its differences stand beside those that it may explain."""

from dataclasses import replace

import numpy as np
import pytest

from study.analysis.confounds import CONFOUNDS, concerned, contrasts, varied
from study.config.files import load_grid
from study.config.settings import StudySettings
from study.document.markdown import markdown
from study.planning.plan import make_plan
from study.report.build import build_report
from study.report.summary import summarise
from study.report.text import document
from study.statistics import comparisons
from study.statistics.effects import planned
from tests.support.synthetic_records import DATASIZE_GRID, HEADS_GRID, World, simulate

SPLIT = CONFOUNDS[0]
FAST = World(epochs=8)
PAIR = HEADS_GRID.model_copy(update={"heads": ("rec", "full")})


def changed(**groups):
    return StudySettings.model_validate(groups)


def with_variant(record, **more):
    """Add a variant of the same kind whose frames are split differently."""
    other = simulate(seed=1, settings=changed(frames={"split": "frame"}), **more)
    grid = other.grid.model_copy(update={"name": "heads-split-frame"})
    return replace(record, variants={SPLIT.setting: replace(other, grid=grid)})


def test_settings_that_differ_in_one_confound_alone_are_recognised():
    plain = StudySettings()
    assert varied(plain, changed(frames={"split": "frame"})) is SPLIT
    assert varied(changed(frames={"split": "frame"}), plain) is SPLIT
    assert varied(plain, plain) is None
    assert varied(plain, changed(frames={"split": "frame"}, encoder={"epochs": 3})) is None
    assert varied(plain, changed(encoder={"lr": 3})) is None


@pytest.mark.parametrize("confound", CONFOUNDS, ids=lambda confound: confound.setting)
@pytest.mark.parametrize("profile", ["smoke", "laptop", "desktop", "paper"])
def test_the_file_of_a_confound_varies_it_and_nothing_else(confound, profile):
    main = "datasize" if confound.fractions else "heads"
    one, other = (make_plan(name, profile, {}, {}) for name in (main, confound.sweep))
    assert varied(one.settings, other.settings) is confound
    assert set(other.grid.fractions) <= set(one.grid.fractions)
    assert other.grid.policy_seeds == one.grid.policy_seeds
    shared = set(one.cells) & set(other.cells)
    assert len(shared) == (2 if confound.fractions else 0)  # at all the data, fractions of what makes no difference


def test_the_command_line_goes_before_a_sweeps_own_settings():
    plan = make_plan("heads-split-frame", "smoke", {"frames": {"split": "episode"}}, {})
    assert plan.settings.frames.split == "episode"


def test_a_difference_that_a_setting_makes_is_seen_and_one_that_it_does_not_is_not():
    record = simulate(HEADS_GRID, FAST)
    lifted = replace(FAST, accuracy=FAST.accuracy | {"full": FAST.accuracy["full"] - 0.10})
    for world, states in ((FAST, {"open"}), (lifted, {"open", "moved"})):
        other = simulate(HEADS_GRID, world, seed=1)
        rows = contrasts(record, other, SPLIT)
        assert [(row.first, row.second) for row in rows] == planned(HEADS_GRID)  # all pairs of head sets
        assert {row.state for row in rows} == states
        assert all("full" in (row.first[0], row.second[0]) for row in rows if row.state == "moved")
        assert all((row.state == "moved") == (row.bounds[0] > 0 or row.bounds[1] < 0) for row in rows)


def test_what_matters_below_all_the_data_is_shown_there_and_across_fractions():
    budget = next(confound for confound in CONFOUNDS if confound.setting == "encoder.budget")
    rows = contrasts(simulate(DATASIZE_GRID, FAST), simulate(DATASIZE_GRID, FAST, seed=1), budget)
    assert {row.first[1] for row in rows} == {0.5, 0.25, 0.125, 0.0625}
    pairs = {(row.first, row.second) for row in rows}
    assert len(pairs) == len(rows) == 12
    for fraction in (0.5, 0.25, 0.125, 0.0625):
        assert (("full", fraction), ("rec", fraction)) in pairs
        assert {(("full", fraction), ("rec", 1.0)), (("rec", fraction), ("rec", 1.0))} <= pairs


def test_a_cell_that_is_the_same_in_both_sweeps_is_no_part_of_the_change():
    record, other = (simulate(DATASIZE_GRID, FAST, seed=seed) for seed in (0, 1))
    alike = {key: result for key, result in record.results.items() if result.cell.fraction == 1}
    budget = next(confound for confound in CONFOUNDS if confound.setting == "encoder.budget")
    apart, shared = (
        {row.name: row for row in contrasts(record, each, budget)}
        for each in (other, replace(other, results=other.results | alike))
    )
    name = next(name for name, row in shared.items() if row.second == ("rec", 1.0))
    width = [row.bounds[1] - row.bounds[0] for row in (apart[name], shared[name])]
    assert width[1] < width[0]  # two encoders are concerned, not four
    assert contrasts(record, record, budget) == []


def test_welchs_interval_covers_a_true_difference():
    rng = np.random.default_rng(0)
    intervals = [comparisons.apart(rng.normal(0.3, 1, 15), rng.normal(0, 2, 8)) for _ in range(800)]
    assert 0.93 < np.mean([each.low < 0.3 < each.high for each in intervals]) < 0.97


def test_nothing_is_cleared_for_want_of_proof():
    text = markdown(document(summarise(with_variant(simulate(PAIR, FAST), grid=PAIR, world=FAST))))
    assert "No change is shown, and none is excluded" in text
    assert "nothing here makes" not in text


def test_a_sweep_without_variants_lists_how_to_run_each(tmp_path):
    rows = summarise(simulate(HEADS_GRID, FAST)).confounds
    assert [row.sweep for row in rows] == [confound.sweep for confound in concerned(simulate())]
    assert all(row.contrasts == () for row in rows)
    for row in rows:
        load_grid(row.sweep)


def test_a_report_shows_the_differences_under_both_values(tmp_path):
    pdf = build_report(with_variant(simulate(PAIR, FAST), grid=PAIR, world=FAST), tmp_path)
    from pypdf import PdfReader

    text = " ".join(" ".join(page.extract_text().split()) for page in PdfReader(pdf).pages)
    assert "frames.split: episode here, frame in heads-split-frame" in text
    assert "python -m study.sweep heads-brake-hold-0" in text
    assert "python -m study.sweep heads-split-frame" not in text.split("Provenance")[0]
    assert (tmp_path / "heads" / "figures" / "confound_frames_split.svg").is_file()
