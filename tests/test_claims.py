import dataclasses

import pytest
from scipy.stats import binom

from study.analysis import claims, comparisons, convergence, effects, intervals, learning_curves
from study.config.grid import Grid, Rules
from study.config.heads import HEAD_SETS
from tests.support.synthetic_records import DATASIZE_GRID, HEADS_GRID, Null, World, simulate


def outcomes(record):
    return {verdict.claim: verdict.outcome for verdict in claims.judge(record)}


@pytest.fixture(scope="module")
def heads():
    return {verdict.claim: verdict for verdict in claims.judge(simulate(HEADS_GRID))}


def test_true_claims_are_reproduced(heads):
    assert [heads[claim].outcome for claim in ("H1", "H2", "H3", "H4")] == ["reproduced"] * 4
    assert {"D1", "D2", "D3", "D4"} == {claim for claim, verdict in heads.items() if verdict.outcome == "not tested"}


def test_true_claims_about_data_size_are_reproduced():
    by_claim = outcomes(simulate(DATASIZE_GRID, World(slower=0.0)))
    assert [by_claim[claim] for claim in ("D1", "D2", "D3", "D4")] == ["reproduced"] * 4


def test_the_opposite_of_a_claim_is_not_reproduced():
    accuracy = dict(zip(HEAD_SETS, (0.88, 0.86, 0.84, 0.82), strict=True))
    record = simulate(HEADS_GRID, World(accuracy=accuracy, steering_effect=0.002))
    by_claim = outcomes(record)
    assert [by_claim[claim] for claim in ("H1", "H2", "H3", "H4")] == ["not reproduced"] * 4


def test_the_largest_variance_is_found_when_it_is_far_the_largest():
    spread = {"rec": 0.06, "rec+pred": 0.01, "rec+plan": 0.01, "full": 0.01}
    assert outcomes(simulate(HEADS_GRID, World(spread=spread)))["H5"] == "reproduced"
    spread = {"rec": 0.01, "rec+pred": 0.01, "rec+plan": 0.01, "full": 0.2}
    time = dict.fromkeys(HEAD_SETS, 20.0)
    assert outcomes(simulate(HEADS_GRID, World(spread=spread, time=time)))["H5"] == "not reproduced"


def test_one_encoder_leaves_a_small_difference_open_that_many_encoders_settle():
    accuracy = dict(zip(HEAD_SETS, (0.83, 0.84, 0.847, 0.854), strict=True))
    one = simulate(HEADS_GRID, World(accuracy=accuracy))
    many = simulate(HEADS_GRID.model_copy(update={"encoder_seeds": 5, "policy_seeds": 3}), World(accuracy=accuracy))
    first, second = (next(v for v in claims.judge(r) if v.claim == "H3") for r in (one, many))
    assert first.findings[0].estimate.low > 0  # the policies alone would say yes
    assert first.outcome == "inconclusive"
    assert second.outcome == "reproduced"
    assert second.findings[0].estimate.n == 5


def test_speed_is_no_evidence_where_the_baseline_is_as_fast():
    time = dict.fromkeys(HEAD_SETS, 4.0)
    accuracy = dict.fromkeys(HEAD_SETS, 0.85) | {"full": 0.853}
    verdict = next(
        v for v in claims.judge(simulate(HEADS_GRID, World(time=time, accuracy=accuracy))) if v.claim == "H4"
    )
    assert verdict.findings[0].estimate.high < 30
    assert verdict.outcome == "inconclusive"


def test_claims_with_unfinished_cells_are_not_tested_and_name_them():
    verdicts = {
        v.claim: v for v in claims.judge(simulate(HEADS_GRID, World(epochs=12), unfinished=("rec+plan 100% e0",)))
    }
    assert verdicts["H2"].outcome == "not tested"
    assert verdicts["H2"].missing == ("rec+plan",)
    assert verdicts["H4"].outcome != "not tested"  # needs rec and full only


def test_one_policy_is_no_evidence():
    record = simulate(Grid(name="one", title="T", heads=tuple(HEAD_SETS), policy_seeds=1), World(epochs=12))
    assert {outcomes(record)[claim] for claim in ("H1", "H2", "H3", "H5")} == {"inconclusive"}


def test_margins_come_from_the_sweep_file():
    world = World(accuracy=dict(zip(HEAD_SETS, (0.83, 0.84, 0.847, 0.854), strict=True)))
    strict = HEADS_GRID.model_copy(update={"rules": Rules(encoder_allowance=0.0)})
    assert outcomes(simulate(strict, world))["H3"] == "reproduced"
    assert outcomes(simulate(HEADS_GRID, world))["H3"] == "inconclusive"


def test_every_verdict_has_its_rule_and_every_finding_its_n(heads):
    assert list(heads) == list(claims.CLAIMS)
    for verdict in heads.values():
        assert verdict.rule
        assert verdict.reason
        for finding in verdict.findings:
            assert finding.estimate.n == 15
            assert "policy seeds" in finding.estimate.kind or "over seeds" in finding.estimate.kind


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


FREE = Rules(encoder_allowance=0.0, spread_factor=1.0)  # nothing but the intervals' own levels
FIVE = HEADS_GRID.model_copy(update={"encoder_seeds": 5, "policy_seeds": 3})
OTHER_ENCODERS = Null(encoder=0.004, encoder_steering=0.07, spread=0.1)  # as five encoders each of the laptop profile


def claims_an_effect(verdict):
    """Return whether some finding excludes that there is no effect, in either direction."""
    nothing = {"points": 0.0, "ratio": 1.0}
    for finding in verdict.findings:
        low, high = finding.decides
        if finding.unit in nothing and not low <= nothing[finding.unit] <= high:
            return True
        if finding.state == {"epochs": "holds", "loss": "fails"}.get(finding.unit):
            return True
    return False


@pytest.mark.parametrize(
    ("grid", "null", "draws"),
    [
        pytest.param(HEADS_GRID.model_copy(update={"rules": FREE}), Null(), 150, marks=pytest.mark.stress),
        (HEADS_GRID, OTHER_ENCODERS, 80),
        pytest.param(FIVE, OTHER_ENCODERS, 150, marks=pytest.mark.stress),
        (FIVE, dataclasses.replace(OTHER_ENCODERS, fast=True), 60),
        (DATASIZE_GRID.model_copy(update={"rules": FREE}), Null(), 40),
    ],
    ids=["one encoder, no allowance", "one encoder", "five encoders", "five encoders, fast", "fractions, no allowance"],
)
def test_a_null_study_claims_no_effect(grid, null, draws, monkeypatch):
    """Copies of rec with the spread of real curves: effects are claimed at most at the nominal rate, for each claim."""
    for module in (intervals, comparisons, convergence):
        monkeypatch.setattr(module, "DRAWS", 1000)
    counts = dict.fromkeys(claims.CLAIMS, 0)
    for seed in range(draws):
        for verdict in claims.weigh(null.evidence(grid, seed)):
            counts[verdict.claim] += claims_an_effect(verdict)
    bound = binom.ppf(0.999, draws, grid.rules.alpha)
    assert {claim: count for claim, count in counts.items() if count > bound} == {}
    if grid.rules == FREE:  # the rates are the nominal ones: the intervals are no longer than they need to be
        exact = ("H2", "H3") if "H2" in grid.claims else ("D2", "D3")
        assert sum(counts[claim] for claim in exact) > binom.ppf(0.001, 2 * draws, grid.rules.alpha) / 2


def test_a_difference_that_encoders_alone_make_is_found_by_the_rate():
    """The null study's own check: without an allowance, one encoder each, other encoders pass for effects."""
    grid = HEADS_GRID.model_copy(update={"rules": FREE})
    claimed = [
        claims_an_effect(next(v for v in claims.weigh(OTHER_ENCODERS.evidence(grid, seed)) if v.claim == "H3"))
        for seed in range(10)
    ]
    assert sum(claimed) > 5
