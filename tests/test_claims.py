import dataclasses

import numpy as np
import pytest

from study.analysis import claims, learned
from study.config.grid import Grid, Rules
from study.config.heads import HEAD_SETS
from study.config.settings import StudySettings
from study.statistics import drives, effects, learning_curves
from study.statistics.learning_curves import ACCURACY, KEYFRAME, STEERING
from tests.support.synthetic_records import DATASIZE_GRID, HEADS_GRID, World, simulate

LONG = StudySettings.model_validate({"encoder": {"epochs": 120}})  # 1,200 steps at the smallest fraction
CANNOT = "cannot be tested at this size"
RUNGS = World(accuracy=dict(zip(HEAD_SETS, (0.80, 0.82, 0.845, 0.87), strict=True)))


def outcomes(record):
    return {verdict.claim: verdict.outcome for verdict in claims.judge(record)}


@pytest.fixture(scope="module")
def heads():
    return {verdict.claim: verdict for verdict in claims.judge(simulate(HEADS_GRID))}


def test_true_claims_are_reproduced(heads):
    assert [heads[claim].outcome for claim in ("H0", "H1", "H2", "H3", "H4")] == ["reproduced"] * 5
    assert {"D1", "D2", "D3", "D4", "C1", "C2", "C3"} == {
        claim for claim, verdict in heads.items() if verdict.outcome == "not tested"
    }


def test_true_claims_about_data_size_are_reproduced():
    grid = DATASIZE_GRID.model_copy(update={"rules": Rules(steering_allowance=0.1)})
    by_claim = outcomes(simulate(grid, World(slower=0.0), settings=LONG))
    assert [by_claim[claim] for claim in ("D1", "D2", "D3", "D4")] == ["reproduced"] * 4


def test_the_opposite_of_a_claim_is_not_reproduced():
    accuracy = dict(zip(HEAD_SETS, (0.90, 0.86, 0.82, 0.78), strict=True))
    record = simulate(HEADS_GRID, World(accuracy=accuracy, steering_effect=0.002))
    by_claim = outcomes(record)
    assert [by_claim[claim] for claim in ("H0", "H1", "H2", "H3", "H4")] == ["not reproduced"] * 5


def test_the_largest_variance_is_found_when_it_is_far_the_largest():
    spread = {"rec": 0.06, "rec+pred": 0.01, "rec+plan": 0.01, "full": 0.01}
    assert outcomes(simulate(HEADS_GRID, World(spread=spread)))["H5"] == "reproduced"
    spread = {"rec": 0.01, "rec+pred": 0.01, "rec+plan": 0.01, "full": 0.2}
    time = dict.fromkeys(HEAD_SETS, 20.0)
    assert outcomes(simulate(HEADS_GRID, World(spread=spread, time=time)))["H5"] == "not reproduced"


def test_one_encoder_leaves_a_small_difference_open_that_many_encoders_settle():
    one = simulate(HEADS_GRID, RUNGS)
    many = simulate(HEADS_GRID.model_copy(update={"encoder_seeds": 5, "policy_seeds": 3}), RUNGS)
    first, second = (next(v for v in claims.judge(r) if v.claim == "H3") for r in (one, many))
    assert first.findings[0].estimate.low > 0  # the policies alone would say yes
    assert first.outcome == CANNOT
    assert "with a power of 0 % at most" in first.reason
    assert second.outcome == "reproduced"
    assert second.findings[0].estimate.n == 5


def test_speed_is_no_evidence_where_the_baseline_is_as_fast():
    time = dict.fromkeys(HEAD_SETS, 4.0)
    accuracy = dict.fromkeys(HEAD_SETS, 0.85) | {"full": 0.86}
    verdict = next(
        v for v in claims.judge(simulate(HEADS_GRID, World(time=time, accuracy=accuracy))) if v.claim == "H4"
    )
    assert verdict.findings[0].estimate.high < 30
    assert verdict.outcome == CANNOT


def test_claims_with_unfinished_cells_are_not_tested_and_name_them():
    verdicts = {
        v.claim: v for v in claims.judge(simulate(HEADS_GRID, World(epochs=12), unfinished=("rec+plan 100% e0",)))
    }
    assert verdicts["H2"].outcome == "not tested"
    assert verdicts["H2"].missing == ("rec+plan",)
    assert verdicts["H4"].outcome != "not tested"  # needs rec and full only


def test_one_policy_is_no_evidence():
    record = simulate(Grid(name="one", title="T", heads=tuple(HEAD_SETS), policy_seeds=1), World(epochs=12))
    assert {outcomes(record)[claim] for claim in ("H0", "H1", "H2", "H3", "H5")} == {CANNOT}


def test_margins_come_from_the_sweep_file():
    strict = HEADS_GRID.model_copy(update={"rules": Rules(encoder_allowance=0.0)})
    patient = HEADS_GRID.model_copy(update={"rules": Rules(least_power=0.0)})
    assert outcomes(simulate(strict, RUNGS))["H3"] == "reproduced"
    assert outcomes(simulate(HEADS_GRID, RUNGS))["H3"] == CANNOT
    assert outcomes(simulate(patient, RUNGS))["H3"] == "inconclusive"


def test_every_verdict_has_its_rule_and_every_finding_its_n(heads):
    assert list(heads) == list(claims.CLAIMS)
    for verdict in heads.values():
        assert verdict.rule
        assert verdict.reason
        for finding in verdict.findings:
            assert finding.estimate.n == 15
            assert "policy seeds" in finding.estimate.kind or "over seeds" in finding.estimate.kind
            assert finding.unit == "ratio" or "15 test drives" in finding.estimate.kind


def test_planned_contrasts_of_the_paper():
    assert len(effects.planned(HEADS_GRID)) == 6
    contrasts = effects.planned(DATASIZE_GRID)
    assert (("full", 0.0625), ("rec", 1.0)) in contrasts
    assert len(contrasts) == 6


def test_comparisons_are_corrected_for_planned_contrasts_that_are_not_there_yet():
    record = simulate(HEADS_GRID, World(epochs=12), unfinished=("rec+plan 100% e0", "rec+pred 100% e0"))
    contrast = effects.paired_contrasts(
        record, learning_curves.ACCURACY, learning_curves.panel(record.table(), learning_curves.ACCURACY)
    )
    assert [(item.first[0], item.second[0]) for item in contrast] == [("full", "rec")]
    assert contrast[0].p_holm == pytest.approx(6 * contrast[0].p)


# --- steering -------------------------------------------------------------------------------------------------------


def test_good_steering_is_an_absolute_standard_and_equality_to_rec_stands_beside_it():
    floor = 0.1 * claims.steering_floor(simulate(HEADS_GRID, World(epochs=12)), ("rec", 1.0))
    settled = World(epochs=20, time=dict.fromkeys(HEAD_SETS, 1.0))
    for steering, effect, outcome, beside in (
        (0.4 * floor, 0.0, "reproduced", "holds"),
        (2.0 * floor, 0.0, "not reproduced", "holds"),  # all alike, and all bad
        (0.2 * floor, 0.3 * floor, "reproduced", "fails"),
    ):
        world = dataclasses.replace(settled, steering=steering, steering_effect=effect)
        verdict = next(v for v in claims.judge(simulate(HEADS_GRID, world)) if v.claim == "H1")
        assert verdict.outcome == outcome
        assert [finding.what for finding in verdict.deciding] == [f"loss of {name}" for name in HEAD_SETS]
        assert {finding.state for finding in verdict.findings if finding.beside} == {beside}


# --- keyframes ------------------------------------------------------------------------------------------------------


def evidence_of(record):
    """Return what the rules look at, with keyframes as another metric."""
    panels = {metric: learning_curves.panel(record.table(), metric) for metric in (ACCURACY, STEERING)}
    by_drive = {metric: effects.drive_scores(record, metric, panel) for metric, panel in panels.items()}
    return claims.Evidence(record.grid, panels, 0.004, by_drive)


def test_the_same_difference_on_keyframes_is_evidence_beside_and_decides_nothing():
    plain = evidence_of(simulate(HEADS_GRID))
    turned = {point: 1 - curves for point, curves in plain.panels[ACCURACY].items()}  # on keyframes, all is reversed
    also = dataclasses.replace(plain, panels={**plain.panels, KEYFRAME: turned})
    for name in ("H0", "H2", "H3"):
        without, with_keyframes = (claims.verdict(claims.CLAIMS[name], evidence) for evidence in (plain, also))
        beside = [finding for finding in with_keyframes.findings if finding.beside]
        assert with_keyframes.outcome == without.outcome == "reproduced"
        assert with_keyframes.deciding == without.findings
        assert [finding.what for finding in beside] == [f"{finding.what}, keyframes" for finding in without.findings]
        assert {finding.state for finding in beside} == {"fails"}


def test_keyframes_are_scored_by_drive():
    record = simulate(HEADS_GRID, World(epochs=12))
    (result, *_) = record.results.values()
    key = np.arange(len(result.predictions["episode"])) % 3 == 0
    marked = dataclasses.replace(result, predictions=result.predictions | {"keyframe": key})
    scores = drives.by_drive([marked], KEYFRAME)
    right = result.predictions["acceleration"] == result.predictions["acceleration_label"]
    assert scores.frames.sum() == key.sum()
    assert (scores.scores.to_numpy() @ scores.weights).tolist() == pytest.approx(right[:, key].mean(axis=1).tolist())
    arrays = {name: array for name, array in result.predictions.items() if name != "keyframe"}
    assert drives.by_drive([dataclasses.replace(result, predictions=arrays)], KEYFRAME) is None


# --- encoders that have not learned ---------------------------------------------------------------------------------


def test_claims_about_little_data_are_not_tested_on_encoders_that_were_hardly_trained():
    verdicts = {v.claim: v for v in claims.judge(simulate(DATASIZE_GRID, World(epochs=12)))}
    assert {verdicts[claim].outcome for claim in ("D1", "D2", "D3", "D4")} == {"not tested at this scale"}
    assert "full at 6.25 %: 150 steps of its encoder, fewer than 400" in verdicts["D3"].reason


def with_facts(record, **facts):
    results = {
        key: dataclasses.replace(result, facts={**result.facts, **facts}) for key, result in record.results.items()
    }
    return dataclasses.replace(record, results=results)


def test_an_encoder_has_learned_when_each_head_is_well_below_a_constant_picture():
    record = simulate(DATASIZE_GRID, World(epochs=12), settings=LONG)
    assert learned.unlearned(record, effects.points(DATASIZE_GRID)) == {}
    ends = {head: {"entropy": 0.03, "constant": 0.055 if head == "pred" else 0.45} for head in ("rec", "pred", "plan")}
    doubts = learned.unlearned(with_facts(record, heads=ends), effects.points(DATASIZE_GRID))
    assert {heads for heads, _ in doubts} == {"full"}
    assert "test loss of pred 0.0500, a constant picture's is 0.0550" in doubts["full", 1.0]


def test_results_that_keep_too_little_count_as_unknown():
    record = with_facts(simulate(DATASIZE_GRID, World(epochs=12), settings=LONG), heads=None)
    verdict = next(v for v in claims.judge(record) if v.claim == "D2")
    assert verdict.outcome == "not tested at this scale"
    assert "unknown" in verdict.reason


# --- allowances -----------------------------------------------------------------------------------------------------


def test_allowances_are_by_head_set_and_add_up_by_their_squares():
    rules = Rules(encoder_allowance={"rec": 0.006, "full": 0.008})
    assert rules.allowance(["rec", "rec"]) == pytest.approx(0.006)
    assert rules.allowance(["rec", "full"]) == pytest.approx((0.5 * (0.006**2 + 0.008**2)) ** 0.5)
    assert rules.allowance(["rec", "full"] * 2) == pytest.approx(2**0.5 * rules.allowance(["rec", "full"]))
    assert rules.allowance(["own", "own"]) == 0.008  # not named: the largest
    assert Rules(encoder_allowance=0.02).allowance(["rec", "full"]) == pytest.approx(0.02)
    assert rules.allowance([]) == 0
