import dataclasses

import numpy as np
import pytest
from scipy.stats import binom

from simulated import DATASIZE_GRID, HEADS_GRID, NULL, World, simulate
from study import claims, stats
from study.config import HEAD_SETS, Grid, Rules

EFFECTS = ("H2", "H3", "H4", "H5", "D2", "D3", "D4")  # claims that something differs


def outcomes(record):
    return {verdict.claim: verdict.outcome for verdict in claims.judge(record)}


@pytest.fixture(scope="module")
def heads():
    return {verdict.claim: verdict for verdict in claims.judge(simulate(HEADS_GRID))}


def test_true_claims_are_reproduced(heads):
    assert [heads[claim].outcome for claim in ("H1", "H2", "H3", "H4")] == ["reproduced"] * 4
    assert {"D1", "D2", "D3", "D4"} == {claim for claim, verdict in heads.items() if verdict.outcome == "not tested"}


def test_true_claims_about_data_size_are_reproduced():
    found = outcomes(simulate(DATASIZE_GRID, World(slower=0.0)))
    assert [found[claim] for claim in ("D1", "D2", "D3", "D4")] == ["reproduced"] * 4


def test_the_opposite_of_a_claim_is_not_reproduced():
    accuracy = dict(zip(HEAD_SETS, (0.88, 0.86, 0.84, 0.82), strict=True))
    record = simulate(HEADS_GRID, World(accuracy=accuracy, steering_effect=0.002))
    found = outcomes(record)
    assert [found[claim] for claim in ("H1", "H2", "H3", "H4")] == ["not reproduced"] * 4


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
    found = {v.claim: v for v in claims.judge(simulate(HEADS_GRID, World(epochs=12), unfinished=("rec+plan 100% e0",)))}
    assert found["H2"].outcome == "not tested"
    assert found["H2"].missing == ("rec+plan",)
    assert found["H4"].outcome != "not tested"  # needs rec and full only


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
    assert len(claims.planned(HEADS_GRID)) == 6
    contrasts = claims.planned(DATASIZE_GRID)
    assert (("full", 0.0625), ("rec", 1.0)) in contrasts
    assert len(contrasts) == 6


def test_comparisons_are_corrected_for_planned_contrasts_that_are_not_there_yet():
    record = simulate(HEADS_GRID, World(epochs=12), unfinished=("rec+plan 100% e0", "rec+pred 100% e0"))
    contrast = claims.compare(record, stats.ACCURACY, stats.panel(record.table(), stats.ACCURACY))
    assert [(item.first[0], item.second[0]) for item in contrast] == [("full", "rec")]
    assert contrast[0].p_holm == pytest.approx(6 * contrast[0].p)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("grid", "world", "draws"),
    [
        (HEADS_GRID, NULL, 25),
        (HEADS_GRID, dataclasses.replace(NULL, time=dict.fromkeys(HEAD_SETS, 8.0)), 25),
        (HEADS_GRID.model_copy(update={"encoder_seeds": 5, "policy_seeds": 3}), NULL, 10),
        (DATASIZE_GRID, NULL, 10),
    ],
    ids=["one encoder", "one encoder, fast", "five encoders", "fractions"],
)
def test_a_null_study_claims_no_effect(grid, world, draws, monkeypatch):
    """Copies of rec whose encoders differ by their seeds only: effects are claimed at most at the nominal rate."""
    monkeypatch.setattr(stats, "DRAWS", 500)
    claimed = np.zeros(len(EFFECTS))
    for seed in range(draws):
        found = outcomes(simulate(grid, world, seed=seed))
        claimed += [found[claim] == "reproduced" for claim in EFFECTS]
        assert found.get("H1") in ("reproduced", "not tested")
    assert claimed.max() <= binom.ppf(0.999, draws, grid.rules.alpha)
