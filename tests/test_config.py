"""Settings refuse what they do not know; keys change exactly with what they stand for."""

import dataclasses
import itertools

import pytest

from study.config.baselines import BASELINES
from study.config.files import load_grid, load_profile
from study.config.grid import Cell
from study.config.heads import HEAD_SETS
from study.config.keys import cell_key, encoder_key, frames_key, recording_key
from study.config.paper import parameter_counts
from study.config.settings import StudySettings
from study.errors import BadInputError


def changed(**groups):
    return StudySettings.model_validate(groups)


def test_parameter_counts_are_the_papers():
    assert parameter_counts() == {"encoder": 461_024, "rec": 474_403, "pred": 473_377, "plan": 473_377}


@pytest.mark.parametrize("profile", ["smoke", "laptop", "paper"])
def test_every_profile_loads(profile):
    assert load_profile(profile).encoder.epochs >= 1


def test_the_paper_profile_has_the_papers_numbers():
    paper = load_profile("paper")
    assert (paper.frames.encoder, paper.frames.policy) == (500_000, 80_000)
    assert (paper.encoder.batch, paper.encoder.epochs, paper.encoder.lr) == (2048, 200, 5e-3)
    assert (paper.policy.batch, paper.policy.epochs, paper.policy.lr) == (2048, 100, 5e-4)


def test_heads_sweep_covers_all_head_sets():
    assert load_grid("heads").heads == tuple(HEAD_SETS)


def test_datasize_shares_its_full_data_cells_and_the_baselines_with_heads():
    settings = load_profile("laptop")
    keys = [
        {cell_key(settings, cell, grid.policy_seeds, frames_key(settings)) for cell in grid.cells()}
        for grid in (load_grid("heads"), load_grid("datasize"))
    ]
    baselines = sum(baseline.seeds for baseline in BASELINES.values())
    assert len(keys[0] & keys[1]) == 2 + baselines


def test_encoder_seeds_multiply_the_cells():
    one, three = (load_grid("heads", {"baselines": (), "encoder_seeds": count}).cells() for count in (1, 3))
    assert len(three) == 3 * len(one)


def test_baselines_are_further_cells_and_leave_the_others_as_they_are():
    settings = load_profile("laptop")
    with_, one, without = (
        [cell_key(settings, cell, 15, "frames") for cell in load_grid("heads", {"baselines": names}).cells()]
        for names in (tuple(BASELINES), ("state",), ())
    )
    assert with_[:4] == one[:4] == without
    assert with_[-1:] == one[4:]


def test_an_unknown_baseline_is_refused_with_those_there_are():
    with pytest.raises(BadInputError, match=r"unknown baseline 'ceiling'; choose from untrained, .*or \[\] for none"):
        load_grid("heads", {"baselines": ["ceiling"]})


def test_the_true_state_depends_on_frames_and_policies_but_on_no_encoder():
    cell, one = load_grid("heads").cells()[-1], StudySettings()
    assert encoder_key(one, cell, "f") == encoder_key(changed(encoder={"epochs": 99}), cell, "f")
    assert encoder_key(one, cell, "f") != encoder_key(one, cell, "g")
    assert cell_key(one, cell, 15, "f") != cell_key(changed(policy={"lr": 0.1}), cell, 15, "f")


def test_keys_tell_all_cells_of_a_grid_apart():
    settings = load_profile("laptop")
    cells = load_grid("datasize", {"encoder_seeds": 2}).cells()
    assert len({cell_key(settings, cell, 15, "frames") for cell in cells}) == len(cells)


def test_a_key_does_not_depend_on_the_order_of_settings():
    one = changed(encoder={"epochs": 3, "batch": 8})
    other = changed(encoder={"batch": 8, "epochs": 3})
    assert encoder_key(one, Cell(heads="rec"), "f") == encoder_key(other, Cell(heads="rec"), "f")


def test_a_new_render_spec_keeps_the_drives_and_changes_the_frames():
    one, other = StudySettings(), changed(birdview={"light_range": 20})
    assert recording_key(one) == recording_key(other)
    assert frames_key(one) != frames_key(other)


def test_more_drives_keep_existing_drives():
    assert recording_key(StudySettings()) == recording_key(changed(recording={"encoder_episodes": 99}))


def test_how_vehicles_answer_and_the_one_town_are_part_of_the_drives():
    one = recording_key(StudySettings())
    assert one != recording_key(changed(dynamics={"lag": 0.4}))
    assert one != recording_key(changed(recording={"seed": 1}))  # the town is drawn from it


def test_the_first_seed_does_not_matter_where_each_drive_has_a_town_of_its_own():
    keys = {recording_key(changed(town={"per_drive": True}, recording={"seed": seed})) for seed in (0, 1)}
    assert len(keys) == 1


def test_policy_settings_leave_the_encoder_as_it_is():
    cell, one, other = Cell(heads="full"), StudySettings(), changed(policy={"lr": 0.1})
    assert encoder_key(one, cell, "f") == encoder_key(other, cell, "f")
    assert cell_key(one, cell, 15, "f") != cell_key(other, cell, 15, "f")


def test_the_weight_of_an_absent_head_changes_nothing():
    one, other = StudySettings(), changed(encoder={"head_weights": {"rec": 1, "pred": 5, "plan": 1}})
    assert encoder_key(one, Cell(heads="rec"), "f") == encoder_key(other, Cell(heads="rec"), "f")
    assert encoder_key(one, Cell(heads="full"), "f") != encoder_key(other, Cell(heads="full"), "f")


def test_a_sweep_file_may_give_one_profile_settings_of_its_own():
    assert load_grid("datasize", profile="laptop").settings == {"encoder": {"batch": 32}}
    assert load_grid("datasize", profile="paper").settings == {}
    assert load_grid("datasize-budget-steps", profile="laptop").settings == {
        "encoder": {"batch": 32, "budget": "steps"}
    }


def test_sums_and_means_of_a_heads_loss_are_two_encoders():
    one, other = StudySettings(), changed(encoder={"loss": "mean"})
    assert one.encoder.loss == "sum"
    assert encoder_key(one, Cell(heads="rec+plan"), "f") != encoder_key(other, Cell(heads="rec+plan"), "f")


def test_the_budget_matters_below_the_full_data_only():
    one, other = StudySettings(), changed(encoder={"budget": "steps"})
    keys = [
        {encoder_key(settings, Cell(heads="rec", fraction=fraction), "f") for settings in (one, other)}
        for fraction in (1.0, 0.5)
    ]
    assert [len(each) for each in keys] == [1, 2]


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        ({"heads": ["rec+plam"]}, ["rec+plam", "rec+plan"]),
        ({"fractions": [0]}, ["fractions", "0"]),
        ({"fractions": [1.5]}, ["fractions", "1.5"]),
        ({"heads": ["rec", "rec"]}, ["twice"]),
        ({"policy_seeds": 0}, ["policy_seeds"]),
        ({"colour": "red"}, ["unknown setting", "colour"]),
    ],
)
def test_a_wrong_grid_is_explained(overrides, words):
    with pytest.raises(BadInputError) as caught:
        load_grid("heads", overrides)
    assert all(word in str(caught.value) for word in words)


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        ({"encoder": {"epochs": "many"}}, ["encoder.epochs", "many"]),
        ({"encoder": {"epohcs": 3}}, ["unknown setting", "encoder.epohcs"]),
        ({"frames": {"split": "town"}}, ["frames.split", "episode", "town"]),
        ({"encoder": {"head_weights": {"depth": 1}}}, ["depth", "rec, pred, plan"]),
        ({"town": {"block": [90, 60]}}, ["block"]),
    ],
)
def test_wrong_settings_are_explained(overrides, words):
    with pytest.raises(BadInputError) as caught:
        load_profile("smoke", overrides)
    assert all(word in str(caught.value) for word in words)


def test_a_rule_is_one_number_or_one_for_each_profile(tmp_path):
    file = tmp_path / "own.yaml"
    file.write_text("title: T\nheads: [rec]\nrules: {alpha: 0.1, encoder_allowance: {smoke: 0.2, laptop: 0.02}}\n")
    rules_by_profile = {
        name: load_grid("own", folder=tmp_path, profile=name).rules for name in ("smoke", "laptop", "mine")
    }
    assert {name: rules.allowance(["rec", "rec"]) for name, rules in rules_by_profile.items()} == {
        "smoke": 0.2,
        "laptop": 0.02,
        "mine": 0.2,  # not named: the largest
    }
    assert {rules.alpha for rules in rules_by_profile.values()} == {0.1}


def test_an_allowance_is_one_number_or_one_for_each_head_set(tmp_path):
    file = tmp_path / "own.yaml"
    for text, expected in (
        ("{rec: 0.01, full: 0.02}", {"rec": 0.01, "full": 0.02}),
        ("{laptop: {rec: 0.01, full: 0.02}, smoke: {rec: 0.3}}", {"rec": 0.01, "full": 0.02}),
        ("{smoke: {rec: 0.3}, paper: {rec: 0.01, full: 0.4}}", {"rec": 0.3, "full": 0.4}),  # not named: the largest
    ):
        file.write_text(f"title: T\nheads: [rec]\nrules: {{encoder_allowance: {text}}}\n")
        assert load_grid("own", folder=tmp_path).rules.encoder_allowance == expected


@pytest.mark.parametrize("allowance", ["{}", "{smoke: much}", "{smoke: -1, laptop: -2}", "many"])
def test_a_wrong_rule_is_explained(tmp_path, allowance):
    (tmp_path / "own.yaml").write_text(f"title: T\nheads: [rec]\nrules: {{encoder_allowance: {allowance}}}\n")
    with pytest.raises(BadInputError, match=r"rules\.encoder_allowance"):
        load_grid("own", folder=tmp_path)


def test_unknown_names_list_the_known_ones():
    with pytest.raises(BadInputError, match="choose from datasize, datasize-budget-steps"):
        load_grid("head")
    with pytest.raises(BadInputError, match="choose from desktop, laptop, paper, smoke"):
        load_profile("tablet")


def test_a_head_set_with_an_unknown_head_is_one_clear_error(monkeypatch):
    monkeypatch.setitem(HEAD_SETS, "full", dataclasses.replace(HEAD_SETS["full"], heads=("rec", "standng")))
    with pytest.raises(BadInputError, match=r"unknown head 'standng'; choose from rec, pred, plan"):
        load_grid("heads")


@pytest.mark.parametrize("text", ["heads: [rec", "- a\n- b", "\x00", "just words"])
def test_a_broken_sweep_file_is_named(tmp_path, text):
    (tmp_path / "own.yaml").write_text(text)
    with pytest.raises(BadInputError, match=r"own\.yaml"):
        load_grid("own", folder=tmp_path)


def test_labels_tell_cells_apart():
    labels = [
        Cell(heads=heads, fraction=fraction, encoder_seed=seed).label
        for heads, fraction, seed in itertools.product(HEAD_SETS, (1.0, 0.0625), (0, 1))
    ]
    assert len(set(labels)) == len(labels)
