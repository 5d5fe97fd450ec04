"""Policies: stacked seeds that do not touch each other, the paper's networks, losses and metrics, honest scaling."""

from __future__ import annotations

import dataclasses
import itertools
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch
from torch import nn
from torch.nn import functional

from study.config.settings import SPEEDS, PolicySettings
from study.errors import BadInputError, TrainingDivergedError
from study.policy import ensemble
from study.policy.draws import draw_epoch, initial_weights
from study.policy.latents import normalisation, normalise
from study.policy.metrics import METRICS, Labels, likeliest, measure
from study.policy.networks import WIDTHS, Layer, Scratch, dropped, forward_backward, predict
from study.policy.training import TrainedPolicies, join_policies, train_policies
from study.results.cell_result import CURVE_COLUMNS
from tests.support.synchronisation import record_synchronisations

SETTINGS = PolicySettings(epochs=5, batch=64, lr=5e-3)
TRAIN, TEST = 300, 120  # 300 is no multiple of 64: the last batch is short


def drive(frames: int, seed: int, noise: float = 0.3) -> tuple[np.ndarray, pd.DataFrame]:
    """Draw latents far from zero mean and unit deviation, and labels that a policy can read off them."""
    rng = np.random.default_rng(seed)
    signal = rng.normal(size=(frames, 64))
    wish = signal[:, 0] + signal[:, 1] + noise * rng.normal(size=frames)
    labels = {"steering": np.tanh(signal[:, 2]) / 4, "acceleration": np.digitize(wish, [-0.6, 0.6])}
    labels |= {"keyframe": rng.random(frames) < 0.3, "weight": rng.uniform(0.5, 1.5, frames)}
    scale = np.geomspace(0.1, 10, 64)
    return (signal * scale + 3 * scale).astype(np.float32), pd.DataFrame(labels)


def train(seeds: Any = (0, 1), settings: PolicySettings = SETTINGS, **options: Any) -> TrainedPolicies:
    (z_train, labels_train), (z_test, labels_test) = drive(TRAIN, 1), drive(TEST, 2)
    return train_policies(z_train, z_test, labels_train, labels_test, seeds, settings, **options)


@pytest.fixture(scope="module")
def fifteen() -> TrainedPolicies:
    return train(range(15))


def score(policies: TrainedPolicies, metric: str, split: str = "test") -> pd.Series:
    curves = policies.curves
    last = curves[(curves["metric"] == metric) & (curves["split"] == split) & (curves["epoch"] == SETTINGS.epochs)]
    return last.set_index("policy_seed")["value"]


# --- seeds ----------------------------------------------------------------------------------------------------------


def test_a_seed_among_fifteen_is_what_it_is_alone(fifteen: TrainedPolicies) -> None:
    alone = train([7])
    for name in alone.weights:
        if not name.startswith("z_"):
            np.testing.assert_array_equal(alone.weights[name][0], fifteen.weights[name][7], err_msg=name)
    np.testing.assert_array_equal(alone.steering[0], fifteen.steering[7])
    np.testing.assert_allclose(
        alone.curves["value"], fifteen.curves.query("policy_seed == 7")["value"], rtol=1e-6, atol=1e-7
    )


def test_neither_order_nor_number_of_cores_changes_a_seed(fifteen: TrainedPolicies) -> None:
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        few = train([12, 3])
    finally:
        torch.set_num_threads(threads)
    np.testing.assert_array_equal(few.steering, fifteen.steering[[12, 3]])


@pytest.mark.parametrize("shares", [[[3, 1, 2]], [[3], [1, 2]], [[3, 1], [2]], [[3], [1], [2]]])
def test_policies_trained_in_shares_and_joined_are_those_trained_at_once(shares: list[list[int]]) -> None:
    """Byte for byte, and row for row of the curves."""
    once = train([3, 1, 2])
    joined = join_policies([train(share) for share in shares])
    assert list(joined.weights) == list(once.weights)
    for name, weights in once.weights.items():
        assert joined.weights[name].dtype == weights.dtype
        assert joined.weights[name].tobytes() == weights.tobytes(), name
    assert joined.steering.tobytes() == once.steering.tobytes()
    assert joined.acceleration.tobytes() == once.acceleration.tobytes()
    pd.testing.assert_frame_equal(joined.curves, once.curves, check_exact=True)


def test_joined_policies_took_the_time_of_all_shares() -> None:
    shares = [dataclasses.replace(train([seed]), seconds=seed + 0.5) for seed in (1, 2)]
    assert join_policies(shares).seconds == 4.0


def test_all_seeds_as_one_group_come_out_as_one_group_each(
    fifteen: TrainedPolicies, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The way of a GPU, taken on a CPU."""
    monkeypatch.setattr(ensemble, "_groups", lambda seeds, device: [slice(0, seeds)])
    together = train(range(15))
    np.testing.assert_allclose(together.steering, fifteen.steering, rtol=1e-3, atol=1e-4)
    np.testing.assert_allclose(
        together.weights["acceleration_0_weight"], fifteen.weights["acceleration_0_weight"], rtol=1e-3, atol=1e-4
    )


def test_inside_an_epoch_nothing_waits_for_the_device(monkeypatch: pytest.MonkeyPatch) -> None:
    """The way of a GPU: no number leaves it before the epoch's end."""
    reads = record_synchronisations(monkeypatch, ensemble.PolicyEnsemble, "training_step")
    monkeypatch.setattr(ensemble, "_groups", lambda seeds, device: [slice(0, seeds)])
    train()
    assert reads == []


def test_training_leaves_the_number_of_threads_as_it_was() -> None:
    threads = torch.get_num_threads()
    train()
    assert torch.get_num_threads() == threads


def test_the_same_call_gives_the_same_bytes() -> None:
    first, second = train(), train()
    assert all(first.weights[name].tobytes() == second.weights[name].tobytes() for name in first.weights)
    assert first.steering.tobytes() == second.steering.tobytes()
    pd.testing.assert_frame_equal(first.curves, second.curves, check_exact=True)


def test_seeds_differ_in_weights_order_and_dropout() -> None:
    first, second = dict(initial_weights(0)), dict(initial_weights(1))
    assert all(not torch.equal(first[name], second[name]) for name in first)
    draws = draw_epoch((0, 1), 0, 500)
    assert not torch.equal(draws.order[0], draws.order[1])
    assert all(not torch.equal(words[0], words[1]) for layers in draws.bits.values() for words in layers)


def test_epochs_differ_in_order_and_dropout() -> None:
    first, second = draw_epoch((0,), 0, 500), draw_epoch((0,), 1, 500)
    assert not torch.equal(first.order, second.order)
    assert not torch.equal(first.bits["steering"][0], second.bits["steering"][0])


def test_an_epoch_shows_every_frame_once() -> None:
    order = draw_epoch((0, 5), 3, 100).order
    assert torch.equal(order.sort(1).values, torch.arange(100).expand(2, -1))


# --- dropout --------------------------------------------------------------------------------------------------------


def test_every_unit_is_dropped_with_probability_one_half() -> None:
    rows, hidden = 4096, 64
    words = draw_epoch((0,), 0, rows).bits["acceleration"][1]
    mask = dropped(words, rows, Scratch())
    assert mask.shape == (1, rows, hidden)
    assert set(mask.unique().tolist()) == {0.0, 2.0}
    deviation = 0.5 / rows**0.5
    assert ((mask[0] / 2).mean(0) - 0.5).abs().max() < 5 * deviation
    assert ((mask[0] / 2).mean(1) - 0.5).abs().max() < 6 * 0.5 / hidden**0.5


def test_dropped_units_are_independent_of_each_other() -> None:
    rows = 4096
    mask = dropped(draw_epoch((0,), 0, rows).bits["acceleration"][1], rows, Scratch())[0] - 1
    correlation = mask.T @ mask / rows - torch.eye(64)
    assert correlation.abs().max() < 6 / rows**0.5
    neighbours = (mask[1:] * mask[:-1]).mean(0)
    assert neighbours.abs().max() < 5 / rows**0.5


def test_dropout_keeps_the_mean() -> None:
    """Hidden units that are all 1 before dropout are 1 in the mean after each of the two layers."""
    rows, width = 20_000, 64
    zero = torch.zeros(1, width, width)
    one, gradients = torch.ones(1, 1, width), (torch.empty(1, width, width), torch.empty(1, 1, width))
    average = torch.full((1, width, 1), 1 / width)
    last = Layer(average, torch.zeros(1, 1, 1), torch.empty(1, width, 1), torch.empty(1, 1, 1))
    words = [
        torch.from_numpy(np.random.default_rng(k).integers(-(2**31), 2**31, (1, rows * 2), np.int32)) for k in (0, 1)
    ]
    hidden = []

    def keep(outputs: torch.Tensor) -> torch.Tensor:
        hidden.append(outputs)
        return outputs

    forward_backward(
        [Layer(zero, one, *gradients), Layer(zero, one, *gradients), last],
        torch.zeros(1, rows, width),
        words,
        keep,
        Scratch(),
    )
    assert abs(hidden[0].mean().item() - 1) < 5 / (rows * width) ** 0.5
    second = Layer(torch.full((1, width, width), 1 / width), torch.zeros(1, 1, width), *gradients)
    forward_backward([Layer(zero, one, *gradients), second, last], torch.zeros(1, rows, width), words, keep, Scratch())
    assert abs(hidden[1].mean().item() - 1) < 5 * (2 / (rows * width)) ** 0.5


# --- against torch's own layers -------------------------------------------------------------------------------------


class Masked(nn.Module):
    """Applies Dropout(0.5) with given units dropped."""

    kept: torch.Tensor

    def forward(self, hidden: torch.Tensor) -> torch.Tensor:
        return hidden * self.kept / 0.5


def unpacked(words: torch.Tensor, rows: int) -> torch.Tensor:
    """Return which units are kept, [rows, H], bit by bit with numpy."""
    bits = [words.numpy().view(np.uint32) >> bit & 1 for bit in range(32)]
    return torch.from_numpy(1 - np.concatenate(bits).astype(np.float32)).view(rows, -1)


def plain_fit(seed: int, z: np.ndarray, labels: pd.DataFrame, epochs: int) -> dict[str, nn.Sequential]:
    """Fit one policy with torch's layers, losses, autograd and Adam, and the random draws of the stacked one."""
    start = dict(initial_weights(seed))
    networks, masks = {}, {}
    for name, widths in WIDTHS.items():
        masks[name] = (Masked(), Masked())
        linear = [nn.Linear(*pair) for pair in itertools.pairwise(widths)]
        for layer, module in enumerate(linear):
            module.weight.data = start[f"{name}_{layer}_weight"].T.clone()
            module.bias.data = start[f"{name}_{layer}_bias"].clone()
        networks[name] = nn.Sequential(
            linear[0], nn.ReLU(), masks[name][0], linear[1], nn.ReLU(), masks[name][1], linear[2]
        )
    adam = torch.optim.Adam([weight for network in networks.values() for weight in network.parameters()], SETTINGS.lr)
    x = torch.from_numpy(normalise(normalisation(z, "zscore"), z))
    steering = torch.tensor(labels["steering"].to_numpy(np.float32))
    acceleration = torch.tensor(labels["acceleration"].to_numpy(np.int64))
    for epoch in range(epochs):
        draws = draw_epoch((seed,), epoch, len(x))
        for first in range(0, len(x), SETTINGS.batch):
            rows = draws.order[0, first : first + SETTINGS.batch]
            for name, layers in masks.items():
                for mask, words in zip(layers, draws.bits[name], strict=True):
                    each = words.shape[1] // len(x)
                    mask.kept = unpacked(words[0, first * each : (first + len(rows)) * each], len(rows))
            loss = functional.smooth_l1_loss(networks["steering"](x[rows])[:, 0], steering[rows])
            loss = loss + functional.cross_entropy(networks["acceleration"](x[rows]), acceleration[rows])
            adam.zero_grad()
            loss.backward()
            adam.step()
    return networks


def test_a_stacked_policy_is_the_plain_fit() -> None:
    """Smooth L1 + cross-entropy, ReLU, dropout and Adam by torch itself give the same weights after 5 epochs."""
    z, labels = drive(TRAIN, 1)
    stacked = train([0, 4])
    for name, network in plain_fit(4, z, labels, SETTINGS.epochs).items():
        for layer, module in enumerate(module for module in network if isinstance(module, nn.Linear)):
            weight, bias = (stacked.weights[f"{name}_{layer}_{part}"][1] for part in ("weight", "bias"))
            np.testing.assert_allclose(weight, module.weight.detach().T, rtol=1e-3, atol=1e-4)
            np.testing.assert_allclose(bias, module.bias.detach(), rtol=1e-3, atol=1e-4)


def test_initial_weights_are_spread_as_those_of_torch() -> None:
    start = dict(initial_weights(0))
    for name, widths in WIDTHS.items():
        for layer, (inputs, outputs) in enumerate(itertools.pairwise(widths)):
            theirs = nn.Linear(inputs, outputs)
            ours = start[f"{name}_{layer}_weight"]
            assert ours.shape == theirs.weight.T.shape
            assert start[f"{name}_{layer}_bias"].shape == theirs.bias.shape
            assert ours.abs().max() <= inputs**-0.5
            if ours.numel() > 4000:
                assert abs(ours.std().item() / theirs.weight.std().item() - 1) < 0.05


# --- what comes out -------------------------------------------------------------------------------------------------


def test_shapes_and_types(fifteen: TrainedPolicies) -> None:
    assert fifteen.acceleration.shape == fifteen.steering.shape == (15, TEST)
    assert fifteen.acceleration.dtype == np.uint8
    assert fifteen.steering.dtype == np.float32
    assert fifteen.weights["steering_0_weight"].shape == (15, 64, 256)
    assert fifteen.weights["acceleration_2_weight"].shape == (15, 64, 3)
    assert fifteen.weights["acceleration_2_bias"].shape == (15, 3)
    assert fifteen.weights["z_mean"].shape == fifteen.weights["z_std"].shape == (64,)
    assert fifteen.seconds > 0


def test_curves_hold_every_seed_epoch_split_and_metric_once(fifteen: TrainedPolicies) -> None:
    curves = fifteen.curves
    assert tuple(curves.columns) == CURVE_COLUMNS
    expected = set(itertools.product(range(15), ("train", "test"), range(1, SETTINGS.epochs + 1), METRICS))
    points = list(curves[["policy_seed", "split", "epoch", "metric"]].itertuples(index=False, name=None))
    assert len(points) == len(expected)
    assert set(points) == expected
    assert set(curves["stage"]) == {"policy"}


def test_log_and_progress_hear_of_every_epoch_and_of_the_mean_over_seeds() -> None:
    logs, steps = [], []
    policies = train(log=lambda *what: logs.append(what), progress=lambda *what: steps.append(what))
    assert [epoch for epoch, _ in logs] == list(range(1, SETTINGS.epochs + 1))
    assert steps == [(epoch, SETTINGS.epochs) for epoch in range(1, SETTINGS.epochs + 1)]
    assert logs[-1][1]["test/cross_entropy"] == pytest.approx(score(policies, "cross_entropy").mean(), rel=1e-5)


def test_predict_repeats_the_stored_predictions_from_the_stored_weights(fifteen: TrainedPolicies) -> None:
    steering, logits = predict(fifteen.weights, drive(TEST, 2)[0])
    np.testing.assert_allclose(steering, fifteen.steering, rtol=1e-5, atol=1e-6)
    np.testing.assert_array_equal(logits.argmax(2), fifteen.acceleration)


def test_last_curve_point_is_of_the_stored_predictions(fifteen: TrainedPolicies) -> None:
    labels = drive(TEST, 2)[1]
    accuracy = (fifteen.acceleration == labels["acceleration"].to_numpy()).mean(1)
    np.testing.assert_allclose(score(fifteen, "acceleration_accuracy"), accuracy, atol=1e-6)


def test_policies_learn_what_can_be_learnt() -> None:
    (z_train, labels_train), (z_test, labels_test) = drive(2000, 1), drive(500, 2)
    policies = train_policies(z_train, z_test, labels_train, labels_test, range(3), SETTINGS)
    floor = np.bincount(labels_test["acceleration"]).max() / len(z_test)
    assert score(policies, "acceleration_accuracy").min() > floor + 0.3
    guess = np.abs(labels_test["steering"] - labels_test["steering"].mean())
    assert score(policies, "steering_loss").max() < 0.5 * (guess**2).mean() / 2


# --- metrics --------------------------------------------------------------------------------------------------------


def test_metrics_agree_with_numpy() -> None:
    rng = np.random.default_rng(0)
    truth, right = rng.normal(size=90), rng.choice(3, 90, p=[0.1, 0.3, 0.6])
    keyframe, weight = rng.random(90) < 0.3, rng.uniform(0, 2, 90)
    steering, logits = rng.normal(size=(4, 90)) * 2, rng.normal(size=(4, 90, 3))
    got = measure(
        torch.tensor(steering, dtype=torch.float32),
        torch.tensor(logits, dtype=torch.float32),
        Labels(
            torch.tensor(truth, dtype=torch.float32),
            torch.tensor(right),
            *(torch.tensor(values, dtype=torch.float32) for values in (keyframe, weight)),
        ),
    )
    off = np.abs(steering - truth)
    chance = np.exp(logits) / np.exp(logits).sum(2, keepdims=True)
    hit = logits.argmax(2) == right
    errors = np.where(off < 1, off**2 / 2, off - 0.5)
    expected = {
        "steering_loss": errors.mean(1),
        "keyframe_accuracy": hit[:, keyframe].mean(1),
        "natural_accuracy": np.average(hit, axis=1, weights=weight),
        "natural_steering_loss": np.average(errors, axis=1, weights=weight),
        "acceleration_accuracy": hit.mean(1),
        "balanced_accuracy": np.mean([hit[:, right == each].mean(1) for each in range(3)], axis=0),
        "cross_entropy": -np.log(chance[:, np.arange(90), right]).mean(1),
    }
    for metric, values in zip(METRICS, got.numpy(), strict=True):
        np.testing.assert_allclose(values, expected[metric], rtol=1e-5, err_msg=metric)


def test_of_equal_logits_the_first_class_counts() -> None:
    logits = torch.tensor(list(itertools.product((-1.0, 0.0, 2.0), repeat=3))).T[None]
    assert torch.equal(likeliest(logits), torch.from_numpy(logits.numpy().argmax(1)))


def test_balanced_accuracy_is_over_the_classes_that_occur() -> None:
    logits = functional.one_hot(torch.tensor([[0, 0, 0, 1]]), 3).float()
    metrics = measure(torch.zeros(1, 4), logits, Labels(torch.zeros(4), torch.tensor([0, 0, 1, 1]), *torch.ones(2, 4)))
    assert metrics[2].item() == pytest.approx(0.75)


def test_train_metrics_are_of_the_train_split_without_dropout() -> None:
    """With as many test frames as train frames, the part that is measured is the whole split."""
    z, labels = drive(TRAIN, 1)
    policies = train_policies(z, z, labels, labels, [0], SETTINGS)
    train_curve, test_curve = (policies.curves.query(f"split == '{split}'")["value"] for split in ("train", "test"))
    np.testing.assert_allclose(train_curve, test_curve, rtol=1e-5, atol=1e-6)


# --- the latent -----------------------------------------------------------------------------------------------------


def test_scaling_comes_from_the_train_split_only(fifteen: TrainedPolicies) -> None:
    z_train, labels_train = drive(TRAIN, 1)
    z_test, labels_test = drive(TEST, 2)
    moved = train_policies(z_train, 100 * z_test + 7, labels_train, labels_test, [0], SETTINGS)
    for name in ("z_mean", "z_std"):
        np.testing.assert_array_equal(moved.weights[name], fifteen.weights[name])
    np.testing.assert_allclose(moved.weights["z_mean"], z_train.mean(0), rtol=1e-5)
    scaled = normalise(moved.weights, z_train)
    assert np.abs(scaled.mean(0)).max() < 1e-4
    assert np.abs(scaled.std(0) - 1).max() < 1e-4


def test_a_dead_latent_number_does_no_harm() -> None:
    z = drive(50, 1)[0]
    z[:, 5] = 2.5
    assert np.all(normalise(normalisation(z, "zscore"), z)[:, 5] == 0)


def test_l2_gives_every_latent_length_one_and_none_leaves_it() -> None:
    z = drive(50, 1)[0]
    np.testing.assert_allclose(np.linalg.norm(normalise(normalisation(z, "l2"), z), axis=1), 1, rtol=1e-5)
    np.testing.assert_array_equal(normalise(normalisation(z, "none"), z), z)


@pytest.mark.parametrize("how", ["l2", "none"])
def test_predict_knows_how_z_was_scaled(how: Any) -> None:
    policies = train(settings=SETTINGS.model_copy(update={"normalise": how}))
    steering, _ = predict(policies.weights, drive(TEST, 2)[0])
    np.testing.assert_allclose(steering, policies.steering, rtol=1e-4, atol=1e-5)


def test_policies_that_are_given_speeds_read_them_and_start_from_their_own_seed() -> None:
    """Labels that only the ten further numbers tell: learned with them, not without."""
    settings = SETTINGS.model_copy(update={"inputs": "z+speed", "epochs": 20})
    rng = np.random.default_rng(4)
    sets = []
    for frames in (TRAIN, TEST):
        z, speeds = rng.normal(size=(frames, 64)), rng.normal(5, 2, size=(frames, SPEEDS))
        labels = drive(frames, 1)[1].assign(steering=0.0, acceleration=np.digitize(speeds[:, 0], [4, 6]))
        sets.append((np.column_stack([z, speeds]).astype(np.float32), labels))
    (train_x, train_labels), (test_x, test_labels) = sets
    given = train_policies(train_x, test_x, train_labels, test_labels, [0, 1], settings)
    alone = train_policies(train_x, test_x, train_labels, test_labels, [1], settings)
    blind = train_policies(train_x[:, :64], test_x[:, :64], train_labels, test_labels, [0, 1], SETTINGS)
    assert given.weights["acceleration_0_weight"].shape == (2, settings.width, 128)
    np.testing.assert_array_equal(given.steering[1], alone.steering[0])
    np.testing.assert_allclose(predict(given.weights, test_x)[0], given.steering, rtol=1e-4, atol=1e-5)
    accuracies = [(each.acceleration == test_labels["acceleration"].to_numpy()).mean() for each in (given, blind)]
    assert accuracies[0] > accuracies[1] + 0.2


# --- what cannot be done --------------------------------------------------------------------------------------------


def test_a_loss_that_is_not_finite_names_seed_and_epoch() -> None:
    z, labels = drive(TRAIN, 1)
    huge = labels.assign(steering=np.float32(3e38))
    with pytest.raises(TrainingDivergedError, match=r"seed 11 .* epoch 1"):
        train_policies(z, z, huge, huge, [11], SETTINGS)


def test_threads_come_back_after_a_failure() -> None:
    threads = torch.get_num_threads()
    z, labels = drive(TRAIN, 1)
    huge = labels.assign(steering=np.float32(3e38))
    with pytest.raises(TrainingDivergedError):
        train_policies(z, z, huge, huge, [0], SETTINGS)
    assert torch.get_num_threads() == threads


def test_too_little_device_memory_names_the_settings_that_lower_it() -> None:
    def progress(done: int, total: int) -> None:
        raise torch.OutOfMemoryError("tried to allocate 9 GiB")

    with pytest.raises(BadInputError, match=r"for 2 policies at batch 64 .*9 GiB.*--policy.batch or --policy_seeds"):
        train(progress=progress)


@dataclasses.dataclass(frozen=True)
class Wrong:
    message: str
    z: Any = None
    column: str = "steering"
    labels: Any = None
    seeds: tuple[int, ...] = (0,)
    batch: int = 64


@pytest.mark.parametrize(
    "wrong",
    [
        Wrong("at least one", seeds=()),
        Wrong("each once", seeds=(1, 1)),
        Wrong(r"policy.batch is 301, more than the 300", batch=301),
        Wrong(r"float64 \[300, 64\]", z=lambda z: z.astype(np.float64)),
        Wrong(r"float32 \[300, 63\]", z=lambda z: z[:, 1:]),
        Wrong("not finite", z=lambda z: np.where(z >= z.max(), np.nan, z).astype(np.float32)),
        Wrong("classes 0 to 2", column="acceleration", labels=np.full(TRAIN, 3)),
        Wrong("must be 300 finite steerings", labels=np.full(TRAIN, np.nan)),
    ],
    ids=lambda wrong: wrong.message,
)
def test_data_that_cannot_be_learnt_from_is_refused(wrong: Wrong) -> None:
    (z, labels), (z_test, labels_test) = drive(TRAIN, 1), drive(TEST, 2)
    if wrong.labels is not None:
        labels[wrong.column] = wrong.labels
    settings = SETTINGS.model_copy(update={"batch": wrong.batch})
    with pytest.raises(BadInputError, match=wrong.message):
        train_policies(wrong.z(z) if wrong.z else z, z_test, labels, labels_test, wrong.seeds, settings)
