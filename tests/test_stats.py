import dataclasses
import itertools
import math

import numpy as np
import pandas as pd
import pytest
import scipy.special
import statsmodels.api as sm
from scipy import stats as scipy_stats
from sklearn import linear_model, preprocessing
from statsmodels.stats.weightstats import DescrStatsW

from benchmarks.power import Truth
from benchmarks.power import simulate as simulate_study
from study import randomness
from study.analysis import predictions
from study.results.cell_result import TABLE_COLUMNS
from study.statistics import comparisons, convergence, intervals, learning_curves
from study.statistics.drives import DriveScores
from study.tracking.metrics import final_scores
from tests.support.synthetic_records import DATASIZE_GRID, HEADS_GRID, World, simulate

PAIR = HEADS_GRID.model_copy(update={"heads": ("rec", "full")})
DIFFERENCES = np.array([0.4, -0.1, 0.9, 0.3, 1.4, -0.6, 0.8, 0.2])
CALM = Truth(encoder=dict.fromkeys(HEADS_GRID.heads, 0.0), drive=0.0, tails=1e6)  # no spread but the policies'


@pytest.fixture(scope="module")
def record():
    return simulate(HEADS_GRID)


def frame(values, encoders=1):
    """Return a panel's frame of [seeds, epochs], the seeds shared out over encoders."""
    values = np.asarray(values, float)
    index = pd.MultiIndex.from_product(
        [range(encoders), range(len(values) // encoders)], names=["encoder_seed", "policy_seed"]
    )
    return pd.DataFrame(values, index=index, columns=range(1, values.shape[1] + 1))


def mean_of(values):
    """Return the mean of independent values over policies."""
    return intervals.crossed(intervals.Sample(frame(np.asarray(values)[:, None])[1]))


# --- from the tidy table --------------------------------------------------------------------------------------------


def test_final_scores_are_means_of_the_last_epochs_of_each_seed(record):
    table = record.table()
    scores = {key: final_scores(result) for key, result in record.results.items()}
    (full,) = (scores[key] for key, cell in record.planned.items() if cell.heads == "full")
    one = table[
        (table["heads"] == "full")
        & (table["policy_seed"] == 3)
        & (table["split"] == "test")
        & (table["metric"] == learning_curves.ACCURACY)
        & (table["epoch"] > 95)
    ]
    assert len(one) == 5
    assert full.loc[3, learning_curves.ACCURACY] == pytest.approx(one["value"].mean())
    assert [each.shape for each in scores.values()] == [(15, 7)] * len(record.planned)  # seeds and metrics


def test_a_panel_does_not_depend_on_the_order_of_the_rows(record):
    table = record.table()
    shuffled = table.sample(frac=1, random_state=1)
    left, right = (learning_curves.panel(rows, learning_curves.ACCURACY) for rows in (table, shuffled))
    assert set(left) == set(right)
    for point, curves in left.items():
        pd.testing.assert_frame_equal(curves, right[point])


def test_bands_contain_the_mean_and_the_interval_is_inside_the_band(record):
    bands = intervals.curve_bands(record.table(), learning_curves.ACCURACY)
    assert (bands["low"] < bands["mean"]).all()
    assert (bands["mean"] < bands["high"]).all()
    assert (bands["high"] - bands["mean"] < bands["sd"]).all()
    assert set(bands["n"]) == {15}


def test_bands_of_an_empty_table_are_empty():
    assert intervals.curve_bands(pd.DataFrame(columns=list(TABLE_COLUMNS)), learning_curves.ACCURACY).empty


def test_one_seed_gives_a_mean_without_an_interval():
    estimate = intervals.mean_interval(learning_curves.final(frame([[0.5, 0.7]]), last=1))
    assert estimate.value == 0.7
    assert math.isnan(estimate.low)
    assert estimate.n == 1


# --- intervals ------------------------------------------------------------------------------------------------------


def test_t_limits_are_scipys():
    low, high = intervals.t_limits(DIFFERENCES)
    theirs = scipy_stats.ttest_1samp(DIFFERENCES, 0).confidence_interval(0.95)
    assert (low, high) == pytest.approx((theirs.low, theirs.high))


def test_the_interquartile_mean_drops_a_quarter_on_either_side():
    assert intervals.interquartile_mean(np.array([-100.0, 1, 2, 3, 4, 5, 6, 900])) == pytest.approx(3.5)


def test_several_encoders_are_the_units_of_the_interval():
    rng = np.random.default_rng(0)
    encoder = rng.normal(0, 1, 5).repeat(15)
    curves = frame((encoder + rng.normal(0, 0.01, 75))[:, None], encoders=5)
    estimate = intervals.mean_interval(learning_curves.final(curves))
    low, high = intervals.t_limits(learning_curves.final(curves).to_numpy())
    assert estimate.n == 5
    assert estimate.high - estimate.low > 3 * (high - low)


# --- units crossed with drives --------------------------------------------------------------------------------------


def crossed_sample(units, drives, table, frames=None, encoders=None):
    """Return a sample of [units, drives] scores, whose mean over frames is each unit's final score."""
    frames = np.ones(drives) if frames is None else np.asarray(frames, float)
    values = frame(table @ (frames / frames.sum())[:, None], encoders or units)
    return intervals.Sample(values[1], DriveScores(pd.DataFrame(table, values.index), frames))


def test_the_variance_of_a_mean_over_units_and_drives_is_that_of_a_two_way_analysis():
    table = np.random.default_rng(0).normal(size=(6, 9))
    rows = pd.DataFrame([(*place, table[place]) for place in np.ndindex(6, 9)], columns=["unit", "drive", "score"])
    squares = sm.stats.anova_lm(sm.OLS.from_formula("score ~ C(unit) + C(drive)", rows).fit())["mean_sq"]
    mean = intervals.crossed(crossed_sample(6, 9, table))
    unit, drive, within = (squares[name] / 54 for name in ("C(unit)", "C(drive)", "Residual"))
    assert (mean.of_units, mean.of_drives) == pytest.approx((unit, drive))
    assert mean.variance == pytest.approx(max(unit + drive - within, unit, drive))
    assert (mean.units, mean.drives) == (6, 9)


def test_a_mean_over_drives_is_no_surer_than_either_sample():
    rng = np.random.default_rng(1)
    for _ in range(50):
        mean = intervals.crossed(crossed_sample(4, 7, rng.normal(size=(4, 7)), rng.integers(1, 9, 7)))
        assert mean.variance >= max(mean.of_units, mean.of_drives)


def test_p_values_agree_with_their_intervals():
    rng = np.random.default_rng(2)
    for level in (0.9, 0.95, 0.99):
        mean = intervals.crossed(crossed_sample(5, 16, rng.normal(0.3, 1, (5, 16))))
        for beyond in (0.0, 0.1):
            low, high = mean.limits(level, beyond)
            assert (mean.p(beyond) < 1 - level) == (low > 0 or high < 0)


@pytest.mark.parametrize(("unit", "drive"), [(1.0, 0.0), (0.5, 0.5), (0.0, 1.0)], ids=str)
def test_units_and_drives_together_keep_the_level(unit, drive):
    """With t over units alone the last two would be covered 64 and 20 times in a hundred."""
    rng, ends = np.random.default_rng(3), []
    for _ in range(400):
        table = unit * rng.normal(size=(5, 1)) / 5**-0.5 + drive * rng.normal(size=16) / 16**-0.5
        ends.append(intervals.crossed(crossed_sample(5, 16, table + rng.normal(size=(5, 16)))).limits())
    assert covers(ends, 0) > 0.95 - 3 * math.sqrt(0.95 * 0.05 / 400)


def test_two_samples_on_the_same_drives_are_compared_drive_by_drive():
    rng = np.random.default_rng(4)
    common = rng.normal(0, 5, 16)
    first, second = (crossed_sample(5, 16, common + rng.normal(size=(5, 16))) for _ in range(2))
    other = dataclasses.replace(
        second, drives=DriveScores(second.drives.scores.rename(columns=lambda d: -d), np.ones(16))
    )
    same, apart = (intervals.crossed(first, dataclasses.replace(sample, sign=-1.0)).error for sample in (second, other))
    assert same < apart / 2


def test_without_scores_by_drive_an_interval_says_so():
    estimate = intervals.mean_interval(learning_curves.final(frame([[0.5], [0.7], [0.6]]), last=1))
    assert estimate.kind == "t, over policy seeds; test drives as they are"
    assert (estimate.low, estimate.high) == pytest.approx(intervals.t_limits(np.array([0.5, 0.7, 0.6])))


def test_variance_components_are_those_that_made_the_data():
    rng = np.random.default_rng(1)
    values = rng.normal(0, 0.3, (200, 1, 1)) + rng.normal(0, 0.2, (200, 5, 1)) + rng.normal(0, 0.1, (200, 5, 5))
    estimate = intervals.variance_components(frame(values.reshape(1000, 5), encoders=200))
    assert estimate == pytest.approx({"encoder": 0.3, "policy": 0.2, "epoch": 0.1}, rel=0.12)
    assert math.isnan(intervals.variance_components(frame(values[0]))["encoder"])


def test_variance_components_are_those_of_a_mixed_model():
    rng = np.random.default_rng(4)
    values = rng.normal(0, 3, (8, 1, 1)) + rng.normal(0, 2, (8, 4, 1)) + rng.normal(0, 1, (8, 4, 5))
    rows = pd.DataFrame(
        [(i, j, value) for i, j, k in np.ndindex(8, 4, 5) for value in [values[i, j, k]]],
        columns=["encoder", "policy", "value"],
    )
    fit = sm.MixedLM.from_formula(
        "value ~ 1", rows, groups="encoder", re_formula="1", vc_formula={"policy": "0 + C(policy)"}
    ).fit()
    theirs = np.sqrt([fit.cov_re.iloc[0, 0], fit.vcomp[0], fit.scale])
    assert list(intervals.variance_components(frame(values.reshape(32, 5), encoders=8)).values()) == pytest.approx(
        theirs, rel=1e-3
    )


# --- comparisons ----------------------------------------------------------------------------------------------------


def test_probability_of_improvement_counts_ties_half():
    first, second = np.array([1.0, 2, 2, 5]), np.array([0.0, 2, 3])
    assert comparisons.improvement(first, second) == pytest.approx((1 + 2 * 1.5 + 3) / 12)


def test_one_value_shows_nothing():
    assert math.isnan(comparisons.detectable(mean_of(DIFFERENCES[:2])))
    assert comparisons.equivalence(mean_of(DIFFERENCES[:1]), 1.0) == 1
    assert comparisons.equivalence(mean_of(np.full(3, 0.5)), 1.0) == 0
    assert comparisons.equivalence(mean_of(np.full(3, 0.5)), 0.5) == 1
    assert math.isnan(comparisons.apart(np.ones(1), np.ones(2)).low)


def test_only_seeds_that_both_have_are_paired():
    first, second = frame([[1.0], [2.0], [3.0]])[1], frame([[1.0], [1.0]])[1]
    assert comparisons.paired(first, second).tolist() == [0, 1]


# --- convergence ----------------------------------------------------------------------------------------------------


def test_first_reach_is_an_epoch_from_one_or_never():
    curve = np.array([0.1, 0.5, 0.4, 0.8])
    assert convergence.first_reach(curve, 0.5) == 2
    assert convergence.first_reach(curve, 0.05) == 1
    assert convergence.first_reach(curve, 0.9) == np.inf


def test_epochs_to_reach_follow_the_mean_curve_and_lie_in_their_interval():
    record = simulate(HEADS_GRID)
    curves = learning_curves.panel(record.table(), learning_curves.ACCURACY)
    rec, full = curves["rec", 1.0], curves["full", 1.0]
    estimate = convergence.epochs_to_reach(full, rec)
    assert full.mean()[estimate.value] >= learning_curves.final(rec).mean() > full.mean()[estimate.value - 1]
    assert estimate.low <= estimate.value <= estimate.high
    assert estimate.value < convergence.epochs_to_reach(rec, rec).value


def test_the_interval_of_epochs_to_reach_is_the_plain_loops():
    record = simulate(HEADS_GRID.model_copy(update={"encoder_seeds": 4, "policy_seeds": 3}))
    curves = learning_curves.panel(record.table(), learning_curves.ACCURACY)
    rec, full = curves["rec", 1.0], curves["full", 1.0]
    slow, fast = (curve.to_numpy().reshape(4, 3, -1) for curve in (rec, full))
    rng, epochs = np.random.default_rng(0), []
    for _ in range(1500):
        seeds = [(encoder, policy) for encoder in rng.choice(4, 4) for policy in rng.choice(3, 3)]
        goal = np.mean([slow[seed][-5:] for seed in seeds])
        above = np.mean([fast[seed] for seed in seeds], axis=0) >= goal
        epochs.append(above.argmax() + 1 if above.any() else np.inf)
    estimate = convergence.epochs_to_reach(full, rec)
    assert (estimate.low, estimate.high) == pytest.approx(np.quantile(epochs, [0.025, 0.975]), abs=1)


def test_a_curve_that_never_reaches_is_infinite_and_so_is_its_interval():
    low, high = (frame(np.full((6, 10), value)) for value in (0.5, 0.6))
    estimate = convergence.epochs_to_reach(low, high)
    assert (estimate.value, estimate.low, estimate.high) == (np.inf, np.inf, np.inf)


def test_a_seed_has_reached_a_target_only_when_it_stays_there():
    spike = [0, 9, 9, 0, 0, 0, 9, 9, 9, 9]
    never = [0] * 10
    estimate = convergence.reach_by_seed(frame([spike, never]), target=5, window=2)
    assert estimate.epochs.tolist() == [8, np.inf]
    assert estimate.share == 0.5


def test_the_median_epoch_is_kaplan_meiers():
    epochs = np.array([4, 6, 6, 9, 12])
    curves = frame((np.arange(1, 16) >= epochs[:, None]).astype(float))
    censored = frame(np.vstack([curves.to_numpy(), np.zeros((2, 15))]))
    for rows, reached in ((curves, 5), (censored, 5)):
        estimate = convergence.reach_by_seed(rows, target=1.0, window=1)
        times = np.where(np.isfinite(estimate.epochs), estimate.epochs, 15)
        theirs = sm.SurvfuncRight(times, np.isfinite(estimate.epochs)).quantile(0.5)
        assert estimate.median == theirs
        assert estimate.share == reached / len(rows)
        assert estimate.area == pytest.approx(np.maximum(16 - epochs, 0).sum() / rows.size)


def test_the_variance_ratio_finds_the_noisier_curves():
    rng = np.random.default_rng(2)
    quiet, loud = rng.normal(0, 1, (15, 40)), rng.normal(0, 3, (15, 40))
    estimate = convergence.spread_ratio(frame(loud), frame(quiet), epochs=20)
    assert estimate.low < 9 < estimate.high
    assert estimate.low > 4
    back = convergence.spread_ratio(frame(quiet), frame(loud), epochs=20)
    assert back.value == pytest.approx(1 / estimate.value)


def test_the_variance_ratio_is_numpys_and_its_interval_the_jackknifes():
    rng = np.random.default_rng(8)
    loud, quiet = rng.normal(0, 2, (15, 30)), rng.normal(0, 1, (15, 30))

    def log_ratio(keep):
        return math.log(np.var(loud[keep, :20], axis=0).mean() / np.var(quiet[keep, :20], axis=0).mean())

    everyone = list(range(15))
    pseudo = [15 * log_ratio(everyone) - 14 * log_ratio([k for k in everyone if k != out]) for out in everyone]
    estimate = convergence.spread_ratio(frame(loud), frame(quiet), epochs=20)
    assert math.log(estimate.value) == pytest.approx(log_ratio(everyone))
    assert np.log([estimate.low, estimate.high]) == pytest.approx(DescrStatsW(pseudo).tconfint_mean())


def test_the_transient_ends_when_most_of_the_rise_is_done():
    epoch = np.arange(1, 101)
    curves = frame(np.tile(1 - np.exp(-epoch / 10), (3, 1)))
    assert convergence.transient(curves) == pytest.approx(31, abs=1)  # exp(-30 / 10) = 0.05


# --- predictions ----------------------------------------------------------------------------------------------------


def test_the_best_constant_command_is_no_worse_than_any_on_a_grid():
    labels = np.random.default_rng(0).normal(0.02, 0.1, 200)
    others = [scipy.special.huber(1, labels - constant).mean() for constant in np.linspace(-0.3, 0.3, 61)]
    assert predictions.steering_floor(labels) <= min(others) + 1e-12


def test_recall_and_f1_of_a_known_table():
    label = np.array([0, 0, 0, 0, 1, 1, 2, 2], np.uint8)
    guess = np.array([[0, 0, 0, 1, 1, 1, 2, 0]], np.uint8)
    assert np.diag(predictions.confusion(guess, label)[0]).tolist() == [0.75, 1, 0.5]
    f1 = np.mean([2 * 3 / (4 + 4), 2 * 2 / (3 + 2), 2 * 1 / (1 + 2)])
    assert predictions.macro_f1(guess, label) == pytest.approx([f1])


def test_accuracy_by_drive_gives_every_drive_the_same_weight():
    label = np.array([0, 0, 0, 1], np.uint8)
    guess = np.array([[0, 0, 0, 0], [0, 0, 1, 1]], np.uint8)
    drives = predictions.episode_accuracy(guess, label, np.array([7, 7, 7, 9], np.int32))
    assert drives.to_dict() == pytest.approx({7: 5 / 6, 9: 0.5})


def test_data_fractions_keep_their_cells_apart():
    record = simulate(DATASIZE_GRID, World(epochs=6))
    assert set(learning_curves.panel(record.table(), learning_curves.ACCURACY)) == {
        (heads, fraction) for heads in ("rec", "full") for fraction in DATASIZE_GRID.fractions
    }


# --- latents --------------------------------------------------------------------------------------------------------


def test_a_probe_finds_what_a_latent_holds_and_nothing_where_there_is_nothing():
    rng = np.random.default_rng(0)
    z, drive = rng.normal(size=(800, 64)).astype(np.float32), np.arange(800) // 40
    held = z[:, 3] * 2.0 + 5
    targets = np.column_stack([held, rng.normal(size=800), np.ones(800)])
    found, nothing, constant = predictions.probe(z, targets, drive)
    assert found > 0.95
    assert nothing < 0.05
    assert math.isnan(constant)
    assert np.isnan(predictions.probe(z, targets, np.zeros(800, int))).all()
    targets[::2, 1] = np.nan
    assert np.array_equal(
        predictions.probe(z, targets, drive), predictions.probe(z[1::2], targets[1::2], drive[1::2]), equal_nan=True
    )


def test_a_probe_is_scikit_learns_ridge_on_held_out_drives():
    rng = np.random.default_rng(2)
    z, drive = rng.normal(size=(300, 64)).astype(np.float32), np.arange(300) // 30
    target = z[:, 0] + rng.normal(size=300)
    x = preprocessing.StandardScaler().fit_transform(z.astype(float))
    error = total = 0.0
    for held in np.array_split(randomness.rng(0, "probe").permutation(10), 5):
        test = np.isin(drive, held)
        fit = linear_model.Ridge(alpha=1.0).fit(x[~test], target[~test])
        error += ((target[test] - fit.predict(x[test])) ** 2).sum()
        total += ((target[test] - target[~test].mean()) ** 2).sum()
    further = rng.normal(size=300)  # what else is asked for makes no difference
    found, _ = predictions.probe(z, np.column_stack([target, further]), drive)
    assert found == pytest.approx(1 - error / total, rel=1e-4)


def test_a_probe_does_not_profit_from_twins_in_the_same_drive():
    rng = np.random.default_rng(1)
    drive = np.arange(800) // 40
    own = rng.normal(size=(20, 64))
    z = (own[drive] + 0.01 * rng.normal(size=(800, 64))).astype(np.float32)  # a latent tells the drive, nothing else
    (found,) = predictions.probe(z, rng.normal(size=20)[drive][:, None], drive)
    assert found < 0.3


def test_principal_components_are_those_of_the_covariance():
    rng = np.random.default_rng(0)
    z = (rng.normal(size=(300, 4)) @ rng.normal(size=(4, 4))).astype(np.float32)
    places, shares = predictions.principal(z)
    values = np.sort(np.linalg.eigvalsh(np.corrcoef(z.T)))[::-1]
    np.testing.assert_allclose(shares, (values / values.sum())[:2], rtol=1e-4)
    np.testing.assert_allclose(places.var(axis=0, ddof=0), values[:2], rtol=1e-3)


# --- error rates over many draws ------------------------------------------------------------------------------------


def near(rate, nominal, draws):
    """Return whether a rate over so many draws is within three standard errors of the nominal one."""
    return abs(rate - nominal) < 3 * math.sqrt(nominal * (1 - nominal) / draws)


def covers(intervals, truth):
    return np.mean([low <= truth <= high for low, high in intervals])


@pytest.mark.parametrize(("encoder", "policy"), [(1.0, 0.0), (1.0, 1.0), (0.0, 1.0)], ids=str)
def test_with_five_encoders_of_three_policies_t_keeps_its_level(encoder, policy):
    rng, ends = np.random.default_rng(1), []
    for _ in range(400):
        values = rng.normal(0, encoder, (5, 1)) + rng.normal(0, policy, (5, 3))
        estimate = intervals.mean_interval(learning_curves.final(frame(values.reshape(15, 1), encoders=5), last=1))
        ends.append((estimate.low, estimate.high))
    assert near(covers(ends, 0), 0.95, 400)


@pytest.mark.parametrize(
    ("grid", "truth"),
    [
        (PAIR, CALM),
        (
            PAIR.model_copy(update={"encoder_seeds": 5, "policy_seeds": 3}),
            dataclasses.replace(CALM, encoder=dict.fromkeys(HEADS_GRID.heads, 0.0035)),
        ),
    ],
    ids=["15 policies", "5 encoders of 3 policies"],
)
def test_epochs_to_reach_and_variance_ratios_cover_the_truth(grid, truth, monkeypatch):
    """Curves with the laptop profile's spread; full is rec and two points, so its mean curve's epoch is known."""
    monkeypatch.setattr(convergence, "DRAWS", 2000)
    mean = truth.mean_curve() + 0.02
    epoch = convergence.first_reach(mean, mean[-learning_curves.LAST :].mean() - 0.02)
    epochs, ratios = [], []
    for seed in range(150):
        curves = simulate_study(grid, truth, seed).panels[learning_curves.ACCURACY]
        rec, full = curves["rec", 1.0], curves["full", 1.0] + 0.02
        for kept, estimate in (
            (epochs, convergence.epochs_to_reach(full, rec)),
            (ratios, convergence.spread_ratio(rec, full, 60)),
        ):
            kept.append((estimate.low, estimate.high))
    assert 0.88 < covers(epochs, epoch) < 0.99
    assert 0.88 < covers(ratios, 1.0) < 0.99


def test_holm_keeps_the_family_wise_error_of_all_pairs_of_four():
    rng, wrong = np.random.default_rng(1), 0
    for _ in range(1000):
        groups = rng.normal(0, 1, (4, 10))
        p_values = [mean_of(a - b).p() for a, b in itertools.combinations(groups, 2)]
        wrong += len(p_values) * min(p_values) <= 0.05  # Holm's smallest p
    assert 0.01 < wrong / 1000 < 0.05 + 3 * math.sqrt(0.05 * 0.95 / 1000)


def test_equivalence_at_the_margin_is_claimed_at_the_nominal_rate():
    samples = np.random.default_rng(2).normal(0.5, 0.4, (2000, 15))
    claimed = np.mean([comparisons.equivalence(mean_of(sample), 0.5) <= 0.05 for sample in samples])
    assert near(claimed, 0.05, 2000)


def test_the_detectable_difference_is_found_four_times_in_five():
    samples = np.random.default_rng(4).normal(0, 1, (2000, 15))
    effect = comparisons.detectable(mean_of(scipy_stats.zscore(np.arange(15.0), ddof=1)))  # of values whose sd is 1
    estimate = scipy_stats.ttest_1samp(samples + effect, 0, axis=1).pvalue <= 0.05
    assert near(estimate.mean(), 0.8, 2000)
