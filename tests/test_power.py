"""Error rates of the verdicts over simulated studies of a known truth; benchmarks/power.py has the whole study."""

import dataclasses

import pytest
from scipy.stats import binom

from benchmarks.power import (
    FAST_ACCURACY,
    HEADS,
    NULLS,
    ONE_IS_NOT,
    POWERS,
    Truth,
    outcomes,
    rates,
    simulate,
    sized,
)
from study.analysis import claims
from study.config.grid import Rules
from study.statistics import convergence, learning_curves
from study.statistics.learning_curves import ACCURACY


@pytest.fixture(autouse=True)
def few_resamples(monkeypatch):
    monkeypatch.setattr(convergence, "DRAWS", 1000)


def too_many(table, level=0.05):
    """Return the claims that are reproduced more often than chance allows at that rate."""
    bound = binom.ppf(0.999, len(table), level)
    return {claim: int(count) for claim, count in (table == "reproduced").sum().items() if count > bound}


FAST = [name for name in NULLS if "heads" in name and "small" not in name]


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=() if name in FAST else pytest.mark.stress) for name in NULLS]
)
def test_what_is_not_there_is_reproduced_in_five_of_a_hundred_studies_at_most(name):
    grid, truth, wanted = NULLS[name]
    assert too_many(outcomes(grid, truth, 30, wanted)) == {}


@pytest.mark.stress
@pytest.mark.parametrize("name", NULLS)
def test_what_is_not_there_is_reproduced_seldom_over_many_studies(name):
    grid, truth, wanted = NULLS[name]
    assert too_many(outcomes(grid, truth, 500, wanted)) == {}


def test_a_baseline_that_is_fast_itself_does_not_make_speed():
    table = outcomes(sized(HEADS, 5, 3), Truth(curve=FAST_ACCURACY), 30, ("H4",))
    assert too_many(table) == {}


def test_without_drives_in_the_interval_the_rate_would_be_exceeded():
    """The simulation's own check: it finds a rule that takes the test drives as they are."""
    table = [
        claims.verdict(claims.CLAIMS["H3"], dataclasses.replace(simulate(grid, truth, seed), drives={})).outcome
        for grid, truth in ((sized(HEADS, 5, 3), Truth(gain=ONE_IS_NOT, encoder=dict.fromkeys(ONE_IS_NOT, 0.0015))),)
        for seed in range(150)
    ]
    assert table.count("reproduced") > binom.ppf(0.999, 150, 0.05)


def test_without_an_allowance_other_encoders_pass_for_effects():
    strict = sized(HEADS, 1, 15).model_copy(update={"rules": Rules(encoder_allowance=0.0)})
    truth = Truth(encoder=dict.fromkeys(ONE_IS_NOT, 0.02), drive=0.0005)
    table = outcomes(strict, truth, 60, ("H3",))
    assert rates(table)["H3"] > 0.1


def test_the_recommended_sweep_finds_a_point_a_rung():
    (name,) = (name for name in POWERS if name.startswith("+1 point a rung, 20 x 1, 64"))
    grid, truth, _ = POWERS[name]
    table = outcomes(grid, truth, 60, ("H2", "H3"))
    assert all((table == "reproduced").sum() >= binom.ppf(0.01, 60, 0.8))


def test_the_power_that_a_finding_states_is_the_rate_at_which_it_holds():
    grid, truth, _ = next(row for name, row in POWERS.items() if name.startswith("+1 point a rung, 15 x 1, 16"))
    findings = [claims.verdict(claims.CLAIMS["H3"], simulate(grid, truth, seed)).findings[0] for seed in range(200)]
    stated, held = (
        sum(values) / 200 for values in ((f.power for f in findings), (f.state == "holds" for f in findings))
    )
    assert abs(stated - held) < 0.1


def test_simulated_studies_have_the_spread_that_they_are_given():
    truth = Truth(gain={"full": 0.03}, tails=30.0)
    differences = []
    for seed in range(200):
        panel = simulate(sized(HEADS, 1, 15), truth, seed).panels[ACCURACY]
        full, rec = (learning_curves.final(panel[name, 1.0]).mean() for name in ("full", "rec"))
        differences.append(full - rec)
    expected = (0.0036**2 * 1.1 + 0.0029**2 + 0.0015**2) ** 0.5
    mean, spread = sum(differences) / 200, 0.0
    spread = (sum((value - mean) ** 2 for value in differences) / 199) ** 0.5
    assert mean == pytest.approx(0.03, abs=4 * expected / 200**0.5)
    assert spread == pytest.approx(expected, rel=0.2)
