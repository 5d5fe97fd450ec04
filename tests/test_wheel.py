"""What is concluded from drives: scores over policies and drives, rates over drives, and the claims that are ours."""

import dataclasses

import numpy as np
import pandas as pd
import pytest

from study.analysis import claims, driving
from study.analysis.claims import CLAIMS, Evidence
from study.config.grid import Rules
from study.config.heads import HEAD_SETS
from study.results.drives import EXPERT
from study.statistics import effects, intervals
from study.statistics.drives import DriveScores
from study.statistics.intervals import Sample
from study.statistics.learning_curves import ACCURACY, DRIVING
from tests.support.synthetic_drives import Wheel, with_drives
from tests.support.synthetic_records import HEADS_GRID, World, simulate

FAST = World(epochs=6)
OURS = ("C1", "C2", "C3")
STRICT = HEADS_GRID.model_copy(update={"rules": Rules(driving_allowance=0.0)})


@pytest.fixture(scope="module")
def still():
    """Return a record whose cells have not driven."""
    return simulate(HEADS_GRID, FAST)


@pytest.fixture(scope="module")
def record(still):
    return with_drives(still)


def verdicts(record):
    return {verdict.claim: verdict for verdict in claims.judge(record) if verdict.claim in OURS}


def replaced(record, change):
    """Return the record with the drives of every cell changed."""
    return dataclasses.replace(record, drives={key: change(rows.copy()) for key, rows in record.drives.items()})


# --- claims ---------------------------------------------------------------------------------------------------------


def test_claims_of_ours_are_reproduced_where_driving_is_as_they_say(record):
    found = verdicts(record)
    assert [found[name].outcome for name in OURS] == ["reproduced"] * 3
    assert {verdict.section for verdict in found.values()} == {"ours"}
    (finding,) = found["C1"].findings
    assert finding.unit == "score"
    assert finding.estimate.value == pytest.approx(45, abs=4)
    assert finding.estimate.kind == "t, over policy seeds and 20 held-out drives, crossed"
    assert len(found["C3"].findings) == 6


def test_claims_of_ours_are_not_reproduced_where_driving_is_the_opposite(still):
    worse = dict(zip(HEAD_SETS, (75.0, 60.0, 45.0, 30.0), strict=True))
    found = verdicts(with_drives(still, Wheel(score=worse)))
    assert [found[name].outcome for name in OURS] == ["not reproduced"] * 3


def test_the_order_is_that_of_the_accuracy_of_this_sweep():
    """Where rec is the most accurate, the order of driving that C3 asks for begins with rec."""
    accuracy = dict(zip(HEAD_SETS, (0.9, 0.85, 0.8, 0.75), strict=True))
    driving_too = dict(zip(HEAD_SETS, (75.0, 60.0, 45.0, 30.0), strict=True))
    reverse = simulate(HEADS_GRID, dataclasses.replace(FAST, accuracy=accuracy, time=dict.fromkeys(HEAD_SETS, 1.0)))
    verdict = verdicts(with_drives(reverse, Wheel(score=driving_too)))["C3"]
    assert verdict.outcome == "reproduced"
    assert verdict.findings[0].what.startswith("rec ")


def test_one_encoder_a_cell_leaves_a_small_difference_open(still):
    small = Wheel(score=dict(zip(HEAD_SETS, (30.0, 33.0, 36.0, 34.5), strict=True)), drive_sd=1.0, both_sd=1.0)
    assert verdicts(with_drives(still, small))["C1"].outcome in {"inconclusive", "cannot be tested at this size"}
    strict = dataclasses.replace(still, grid=STRICT)
    assert verdicts(with_drives(strict, small))["C1"].outcome == "reproduced"


def test_without_drives_claims_about_driving_say_how_to_test_them(still):
    found = verdicts(still)
    assert {verdict.outcome for verdict in found.values()} == {"not tested"}
    assert {verdict.reason for verdict in found.values()} == {
        "Its policies have not driven (--drive true; imported drives have no town)."
    }


def test_a_cell_that_has_not_driven_is_named(still):
    found = verdicts(with_drives(still, without=("rec+plan",)))
    assert found["C1"].outcome == "reproduced"
    assert found["C2"].outcome == "not tested"
    assert found["C2"].missing == ("rec+plan",)
    assert "Not driven: rec+plan" in found["C2"].reason


def studies(rng, count, encoders, policies, drives, gain=0.0):
    """Yield what the rules look at in simulated studies of two head sets: encoders, policies and drives all vary."""
    index = pd.MultiIndex.from_product([range(encoders), range(policies)], names=["encoder_seed", "policy_seed"])
    grid = STRICT.model_copy(update={"encoder_seeds": encoders, "policy_seeds": policies, "heads": ("rec", "full")})
    for _ in range(count):
        panels, by_drive = {}, {}
        both = rng.normal(0, 8, drives)
        for heads in ("rec", "full"):
            own = np.repeat(rng.normal(0, 4, encoders), policies) + rng.normal(0, 4, encoders * policies)
            table = 50 + gain * (heads == "full") + own[:, None] + both + rng.normal(0, 3, drives)
            table = table + rng.normal(0, 10, table.shape)
            scores = pd.DataFrame(table, index)
            panels[heads, 1.0] = scores.mean(axis=1).to_frame(1)
            by_drive[heads, 1.0] = DriveScores(scores, np.ones(drives))
        yield Evidence(grid, {ACCURACY: panels, DRIVING: panels}, 0.004, {DRIVING: by_drive})


def test_no_difference_is_called_one_no_more_often_than_the_rule_allows():
    """A claim's error rate is alpha; 400 studies without any difference may exceed it by three standard errors."""
    rng = np.random.default_rng(0)
    count = 400
    found = [claims.verdict(CLAIMS["C1"], evidence).outcome for evidence in studies(rng, count, 5, 3, 20)]
    assert found.count("reproduced") / count <= 0.05 + 3 * np.sqrt(0.05 * 0.95 / count)
    found = [claims.verdict(CLAIMS["C1"], evidence).outcome for evidence in studies(rng, 50, 5, 3, 20, gain=20.0)]
    assert found.count("reproduced") / 50 > 0.9  # and the rule can find one


# --- scores ---------------------------------------------------------------------------------------------------------


def test_scores_are_means_over_drives_with_policies_and_drives_as_samples(record):
    curves, drives = driving.panel(record)
    assert list(curves) == [*((name, 1.0) for name in HEAD_SETS), *((name, 1.0) for name in HEADS_GRID.baselines)]
    scores = drives["full", 1.0]
    assert scores.scores.shape == (15, 20)
    assert curves["full", 1.0].iloc[:, -1].mean() == pytest.approx(scores.scores.to_numpy().mean())
    mean = intervals.crossed(Sample(curves["full", 1.0].iloc[:, -1], scores))
    assert (mean.units, mean.drives) == (15, 20)
    assert drives["state", 1.0].scores.shape == (5, 20)
    assert len(driving.panel(record, driving.UNSEEN)[1]["full", 1.0].frames) == 10


def test_contrasts_are_paired_by_policy_and_drive(record):
    curves, drives = driving.panel(record)
    contrasts = effects.paired_contrasts(record, DRIVING, curves, drives)
    assert len(contrasts) == 6
    (full,) = (row for row in contrasts if (row.first[0], row.second[0]) == ("full", "rec"))
    assert full.allowance == Rules().driving_allowance > 0
    assert full.drives == 20
    assert full.p_holm >= full.p
    assert full.simultaneous[0] < full.difference.low


def test_drives_that_some_policy_lacks_are_left_out_of_all(record):
    key = next(key for key, cell in record.planned.items() if cell.heads == "rec")
    rows = record.drives[key]
    less = rows[~((rows["policy_seed"] == 3) & (rows["drive"] == 2_000_001))]
    scores = driving.panel(dataclasses.replace(record, drives=record.drives | {key: less}))[1]
    assert {table.scores.shape[1] for table in scores.values()} == {19}
    assert all(2_000_001 not in table.scores.columns for table in scores.values())


def test_one_drive_gives_an_interval_over_policies_alone(still):
    one = with_drives(still, Wheel(drives=1, unseen=0))
    verdict = verdicts(one)["C1"]
    assert "test drives as they are" in verdict.findings[0].estimate.kind
    assert driving.drives_at(one, driving.UNSEEN).empty


def test_a_drive_that_failed_without_a_score_counts_as_nothing_driven(record):
    numbers = [name for name in next(iter(record.drives.values())).columns if name in {"driving_score", "success"}]

    def fail(rows):
        place = (rows["policy_seed"] == 0) & (rows["drive"] == 2_000_001)
        rows.loc[place, "ended"] = "failure"
        rows.loc[place, numbers] = np.nan
        return rows

    failed = replaced(record, fail)
    scores = driving.panel(failed)[1]["full", 1.0].scores
    assert scores.shape == (15, 20)
    assert scores.loc[(0, 0), 2_000_001] == 0
    rows = driving.by_cell(driving.drives_at(failed, driving.TOWN))["full", 1.0]
    assert driving.ends(rows)["failure"] == pytest.approx(1 / 300)


def test_rates_count_drives_and_not_policies_times_drives(record):
    rows = driving.by_cell(driving.drives_at(record, driving.TOWN))["full", 1.0]
    rates = driving.rates(rows)
    assert {rate.n for rate in rates.values()} == {20}
    assert rates["success"].value == pytest.approx(rows["success"].mean())
    assert rates["red_light"].value == pytest.approx((rows["red_lights"] > 0).mean())
    assert rates["success"].high - rates["success"].low > 0.3  # 300 drives would say 0.1


def test_shares_of_what_ended_the_drives_add_up(record):
    for rows in driving.by_cell(driving.drives_at(record, driving.TOWN)).values():
        assert sum(driving.ends(rows).values()) == pytest.approx(1)


def test_collisions_are_counted_over_the_way_of_all_drives(record):
    rows = driving.by_cell(driving.drives_at(record, driving.TOWN))["rec", 1.0]
    found = driving.per_km(rows)
    assert found["at_fault_per_km"] + found["others_per_km"] == pytest.approx(
        rows["collision"].sum() / rows["distance"].sum()
    )
    assert np.isnan(driving.per_km(rows.assign(distance=0.0))["at_fault_per_km"])


def test_the_expert_is_beside_the_policies_and_not_among_them(record):
    assert len(driving.expert_drives(record, driving.TOWN)) == 20
    assert EXPERT not in set(driving.drives_at(record, driving.TOWN)["policy_seed"])


def test_accuracy_and_driving_are_of_the_same_policies(record):
    both = driving.accuracy_and_driving(record)
    assert len(both) == 4 * 15 + 5 * (len(HEADS_GRID.baselines) + 2)  # three untrained encoders
    own = both[both["heads"].isin(HEAD_SETS)]
    assert driving.rank_correlation(own["accuracy"], own["score"]) > 0.5
    assert np.isnan(driving.rank_correlation(own["accuracy"][:2], own["score"][:2]))


# --- the tidy table -------------------------------------------------------------------------------------------------


def test_the_tidy_table_has_the_mean_over_drives_of_every_policy_and_nothing_of_the_expert(record, still):
    table = record.table(baselines=True)
    rows = table[table["stage"] == "drive"]
    assert set(rows["split"]) == {"town", "unseen"}
    assert set(rows["epoch"]) == {record.settings.policy.epochs}
    assert rows["policy_seed"].min() == 0
    one = rows[(rows["heads"] == "full") & (rows["split"] == "town") & (rows["metric"] == DRIVING)]
    expected = driving.panel(record)[0]["full", 1.0].iloc[:, -1]
    assert one["value"].to_numpy() == pytest.approx(expected.to_numpy())
    rest = table[table["stage"] != "drive"].reset_index(drop=True)
    pd.testing.assert_frame_equal(rest, still.table(baselines=True))
