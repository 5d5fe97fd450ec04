"""Encoders: the paper's networks, their losses, and trainings that are repeatable, resumable and clear in failure."""

from __future__ import annotations

import itertools
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.numpy import load_file, save_file
from torch import nn
from torch.nn import functional

from study.compute import device
from study.compute.device import choose_precision
from study.config.heads import HEAD_SETS, HEADS
from study.config.paper import IMAGE, LATENT, parameter_counts
from study.config.settings import BirdviewSettings, EncoderSettings, FramesSettings
from study.data.build import frames_flow
from study.data.frames import Frames, open_frames, unpack_masks
from study.encoder import batches, bounds, networks, training
from study.encoder.autoencoder import MultiHeadAutoencoder
from study.encoder.batches import plan_training
from study.encoder.inputs import mask_places, unpack
from study.encoder.latents import choose_samples, encode
from study.encoder.networks import Decoder, Encoder, convolve_blocks, interleave_blocks
from study.encoder.training import TrainedEncoder, train_encoder
from study.engine.flows import run_flow
from study.errors import BadInputError, TrainingDivergedError
from tests.support.drives import write_drives
from tests.support.synchronisation import record_synchronisations

FRAMES = FramesSettings(encoder=160, policy=40, spacing=0.3, balance="none")
SETTINGS = EncoderSettings(epochs=2, batch=32, precision="fp32")


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("frames")
    encoder, policy = (
        write_drives(folder, 5, cars=8, steps=60),
        write_drives(folder, 2, first_seed=50, cars=8, steps=60),
    )
    run_flow(frames_flow(FRAMES, BirdviewSettings(), encoder, policy, folder / "store"))
    return folder / "store"


@pytest.fixture(scope="module")
def frames(store: Path) -> Frames:
    return open_frames(store).encoder


@pytest.fixture(autouse=True)
def one_thread() -> Any:
    """Use one thread: two wait actively for each other, which takes ten times as long beside other tests."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


class KilledError(Exception):
    pass


def train(
    frames: Frames,
    heads: str = "rec+plan",
    settings: EncoderSettings = SETTINGS,
    *,
    fraction: float = 1.0,
    seed: int = 0,
    checkpoint: Path | None = None,
    device: str = "cpu",
    kill_at: int | None = None,
    logged: list[tuple[int, dict[str, float]]] | None = None,
) -> TrainedEncoder:
    def progress(done: int, total: int) -> None:
        if done == kill_at:
            raise KilledError

    return train_encoder(
        frames,
        heads,
        fraction,
        seed,
        settings,
        FRAMES,
        device=device,
        checkpoint=checkpoint,
        log=lambda epoch, losses: None if logged is None else logged.append((epoch, losses)),
        progress=progress,
    )


def assert_same(one: TrainedEncoder, other: TrainedEncoder) -> None:
    assert one.curves.equals(other.curves)
    for name in ("weights", "samples"):
        ours, theirs = getattr(one, name), getattr(other, name)
        assert ours.keys() == theirs.keys()
        for key, value in ours.items():
            assert np.array_equal(value, theirs[key]), key


def images(count: int) -> torch.Tensor:
    return torch.rand(count, 3, IMAGE, IMAGE, generator=torch.Generator().manual_seed(1))


# --- networks -------------------------------------------------------------------------------------------------------


def test_learnable_numbers_are_the_papers() -> None:
    counted = {"encoder": Encoder()} | {name: Decoder(head.channels) for name, head in HEADS.items()}
    learnable = {
        name: sum(weights.numel() for weights in network.parameters() if weights.requires_grad)
        for name, network in counted.items()
    }
    assert learnable == parameter_counts()
    assert (learnable["encoder"], learnable["rec"], learnable["plan"]) == (461_024, 474_403, 473_377)


def test_every_head_gives_an_image_of_the_inputs_size() -> None:
    z = Encoder()(images(2))
    assert z.shape == (2, LATENT)
    for channels in (3, 1):
        assert Decoder(channels)(z).shape == (2, channels, IMAGE, IMAGE)


def test_networks_equal_plain_torch_layers_in_output_and_gradient() -> None:
    """Biases that BatchNorm cancels are left out of the backward pass, which changes no other gradient.

    Weight gradients before a BatchNorm are differences of large sums: two kernels that add in another order agree only
    relative to the whole gradient, not number by number.
    """
    torch.manual_seed(0)  # a Decoder draws its weights from torch's own generator
    decoder = Decoder(1)
    plain = [
        nn.Conv2d(*_shape(layer), 4, 2)
        if isinstance(layer, nn.Conv2d)
        else nn.ConvTranspose2d(*_shape(layer), 4, 2, output_padding=layer.output_padding)
        if isinstance(layer, nn.ConvTranspose2d)
        else type(layer)(layer.num_features)
        if isinstance(layer, nn.BatchNorm2d)
        else nn.ReLU()
        for layer in decoder.convolutions
    ]
    stock = nn.Sequential(*plain, nn.ConvTranspose2d(32, 1, 4, 2))
    stock.load_state_dict(
        decoder.convolutions.state_dict() | {f"{len(plain)}.{k}": v for k, v in decoder.output.state_dict().items()}
    )
    z = torch.randn(16, LATENT, generator=torch.Generator().manual_seed(0))
    core = decoder.fully_connected(z).view(-1, 6, 6, 128).permute(0, 3, 1, 2)
    ours, theirs = decoder(z), stock(core)
    assert torch.allclose(ours, theirs, atol=1e-5)
    ours.square().mean().backward()
    theirs.square().mean().backward()
    for name, layer in zip(("0", "3"), (stock[0], stock[3]), strict=True):
        expected = layer.weight.grad
        got = decoder.convolutions.get_submodule(name)
        assert (got.weight.grad - expected).norm() < 1e-4 * expected.norm()
        assert layer.bias.grad.abs().max() < 1e-4 * expected.abs().max()
    assert torch.allclose(decoder.output.bias.grad, stock[-1].bias.grad, rtol=1e-4)


def _shape(layer: Any) -> tuple[int, int]:
    return layer.in_channels, layer.out_channels


def test_a_seed_gives_every_head_set_the_same_encoder_and_heads() -> None:
    torch.manual_seed(5)
    networks = {heads: MultiHeadAutoencoder(heads, SETTINGS, 3).state_dict() for heads in HEAD_SETS}
    for smaller, larger in itertools.combinations(networks.values(), 2):
        shared = smaller.keys() & larger.keys()
        assert any(name.startswith("encoder") for name in shared)
        assert all(torch.equal(smaller[name], larger[name]) for name in shared)
    other = MultiHeadAutoencoder("rec", SETTINGS, 4).state_dict()
    assert not torch.equal(networks["rec"]["encoder.mean.weight"], other["encoder.mean.weight"])


def test_initial_weights_are_spread_as_torchs_own() -> None:
    ours = MultiHeadAutoencoder("full", SETTINGS, 0)
    for ours_layer, stock_layer in zip(ours.decoders["rec"].modules(), Decoder(3).modules(), strict=True):
        if isinstance(ours_layer, nn.Linear | nn.ConvTranspose2d):
            assert float(ours_layer.weight.detach().abs().max()) == pytest.approx(
                float(stock_layer.weight.detach().abs().max()), rel=0.02
            )


def test_masks_are_unpacked_as_the_frame_store_packs_them(frames: Frames) -> None:
    masks = np.array(frames.masks[:20])
    assert masks.any()
    unpacked = unpack(torch.from_numpy(masks), mask_places(["pred", "plan"]))
    expected = unpack_masks(masks)
    assert np.array_equal(unpacked["pred"].squeeze(1).numpy(), expected[:, 0])
    assert np.array_equal(unpacked["plan"].squeeze(1).numpy(), expected[:, 1])


@pytest.mark.parametrize(("reduction", "channels"), [("sum", 3), ("mean", 1)])
def test_loss_is_the_weighted_sum_of_cross_entropies(frames: Frames, reduction: Any, channels: int) -> None:
    """Summed over an image's numbers, rec's weighs three times as much; what is logged by head is the mean."""
    settings = EncoderSettings(loss=reduction, head_weights={"rec": 2.0, "plan": 0.5})
    module = MultiHeadAutoencoder("full", settings, 0)
    batch = torch.tensor(frames.images[:8]), torch.tensor(frames.masks[:8])
    losses = dict(zip(module.metrics, module.losses(*batch).tolist(), strict=True))
    plan = torch.from_numpy(unpack_masks(frames.masks[:8])[:, 1:]).float()
    pixels = batch[0].permute(0, 3, 1, 2) / 255
    with torch.no_grad():
        outputs = module(pixels)
    assert losses["loss_plan"] == pytest.approx(
        float(functional.binary_cross_entropy(outputs["plan"].sigmoid(), plan)), rel=1e-4
    )
    assert losses["loss_rec"] == pytest.approx(
        float(functional.binary_cross_entropy(outputs["rec"].sigmoid(), pixels)), rel=1e-4
    )
    total = 2 * channels * losses["loss_rec"] + losses["loss_pred"] + 0.5 * losses["loss_plan"]
    assert losses["loss"] == pytest.approx(total, rel=1e-5)


@pytest.mark.parametrize(("reduction", "numbers"), [("sum", 64 * 64), ("mean", 3 * 64 * 64)])
def test_gradients_taken_head_by_head_are_those_of_the_total_loss(frames: Frames, reduction: Any, numbers: int) -> None:
    """Also through the noise of a variational encoder, and with weights; KL keeps its relation to the likelihood."""
    settings = EncoderSettings(loss=reduction, beta=0.3, head_weights={"rec": 2.0, "plan": 0.5})
    images, masks = torch.tensor(frames.images[:16]), torch.tensor(frames.masks[:16])
    module = MultiHeadAutoencoder("full", settings, 0)
    losses = dict(zip(module.metrics, module.gradients(images, masks, module._noise(16)).tolist(), strict=True))

    reference = MultiHeadAutoencoder("full", settings, 0)
    pixels, targets = images.permute(0, 3, 1, 2) / 255, unpack(masks, mask_places(["pred", "plan"]))
    features = reference.encoder.features(pixels)
    mean, log_variance = reference.encoder.mean(features), reference.encoder.log_variance(features)
    noise = networks.seeded_generator(0, "encoder noise")
    z = mean + (log_variance / 2).exp() * torch.randn(mean.shape, generator=noise)
    normal = torch.distributions.Normal
    kl = torch.distributions.kl_divergence(normal(mean, (log_variance / 2).exp()), normal(0.0, 1.0))
    total = 0.3 * kl.sum(1).mean() / numbers
    for head, weight in (("rec", 2.0 * 3 * 64 * 64 / numbers), ("pred", 1.0), ("plan", 0.5)):
        loss = functional.binary_cross_entropy_with_logits(
            reference.decoders[head](z), (targets | {"rec": pixels})[head]
        )
        total = total + weight * loss
    total.backward()
    assert losses["loss"] == pytest.approx(float(total.detach()), rel=1e-5)
    for (name, ours), theirs in zip(module.named_parameters(), reference.parameters(), strict=True):
        if theirs.grad is None:
            assert ours.grad is None, name
        else:
            assert torch.allclose(ours.grad, theirs.grad, rtol=1e-3, atol=1e-4 * float(theirs.grad.abs().max())), name


def test_bounds_are_the_entropy_of_the_targets_and_the_loss_of_their_mean(
    frames: Frames, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The same numbers from torch's loss over all frames at once, and from blocks of any size."""
    train_rows, test = frames.indices("train"), frames.indices("test")
    masks = unpack_masks(frames.masks).astype(np.float64)
    targets = {"rec": frames.images / 255, "pred": masks[:, 0], "plan": masks[:, 1]}
    monkeypatch.setattr(bounds, "BLOCK", 7)
    found = bounds.loss_bounds(frames, "full")
    for head, values in targets.items():
        truth = torch.from_numpy(values[test])
        constant = torch.from_numpy((values[train_rows].sum(0) + 0.5) / (len(train_rows) + 1)).expand_as(truth)
        assert found[head] == pytest.approx(
            {
                "entropy": float(functional.binary_cross_entropy(truth, truth)),
                "constant": float(functional.binary_cross_entropy(constant, truth)),
            }
        )
        assert found[head]["entropy"] < found[head]["constant"]
    squared = replace(HEADS["rec"], loss="squared-error")
    monkeypatch.setitem(HEADS, "rec", squared)
    truth = targets["rec"][test]
    constant = (targets["rec"][train_rows].sum(0) + 0.5) / (len(train_rows) + 1)
    assert bounds.loss_bounds(frames, "rec")["rec"] == pytest.approx(
        {"entropy": 0.0, "constant": np.square(truth - constant).mean()}
    )


# --- training -------------------------------------------------------------------------------------------------------


def test_each_heads_loss_is_logged_on_both_splits_every_epoch_and_falls(frames: Frames) -> None:
    logged: list[tuple[int, dict[str, float]]] = []
    trained = train(frames, "full", logged=logged)
    assert [epoch for epoch, _ in logged] == [1, 2]
    for split, metric in itertools.product(("train", "test"), ("loss", "loss_rec", "loss_pred", "loss_plan")):
        curve = trained.curves.query("split == @split and metric == @metric").sort_values("epoch")["value"].tolist()
        assert curve == [losses[f"{split}/{metric}"] for _, losses in logged]
        assert curve[1] < curve[0]
    weights = {"loss_rec": 3, "loss_pred": 1, "loss_plan": 1}
    totals = trained.curves.assign(value=lambda rows: rows["value"] * rows["metric"].map(weights).fillna(-1))
    assert totals.groupby(["split", "epoch"])["value"].sum().abs().max() < 1e-5
    assert len(trained.curves) == 2 * 2 * 4
    assert trained.frames == len(frames.indices("train"))


def test_same_seed_same_bytes_whatever_the_global_generators(frames: Frames) -> None:
    torch.manual_seed(1)
    one = train(frames)
    torch.manual_seed(2)
    assert_same(one, train(frames))
    assert not np.array_equal(one.weights["mean.weight"], train(frames, seed=1).weights["mean.weight"])


def test_bf16_follows_fp32_within_one_percent(frames: Frames) -> None:
    """Stated tolerance: each epoch's losses differ by less than 1 % of fp32's; latents come from fp32 in both."""
    exact = train(frames, "full", fraction=0.5)
    fast = train(frames, "full", SETTINGS.model_copy(update={"precision": "bf16"}), fraction=0.5)
    assert (exact.precision, fast.precision) == ("fp32", "bf16")
    train_rows = exact.curves["split"] == "train"
    gap = (fast.curves["value"] / exact.curves["value"] - 1).abs()
    assert 0 < gap[train_rows].max() < 0.01


def test_auto_is_fp32_where_the_processor_has_no_bf16(monkeypatch: pytest.MonkeyPatch) -> None:
    cpu = torch.device("cpu")
    for flags, expected in (({"avx2"}, "fp32"), ({"avx512f", "amx_bf16"}, "bf16")):
        monkeypatch.setattr(device, "cpu_lines", lambda _, flags=flags: [" ".join(flags)])
        assert choose_precision("auto", cpu) == expected
    assert choose_precision("fp32", cpu) == "fp32"


def test_an_apple_gpu_is_chosen_when_asked_for_and_computes_in_fp32(monkeypatch: pytest.MonkeyPatch) -> None:
    """What torch would find is given: there may be no such GPU here."""
    monkeypatch.setattr("torch.backends.mps.is_available", lambda: True)
    assert (device.choose_device("mps"), device.device_name("mps")) == ("mps", device.APPLE)
    assert device.choose_device("auto") != "mps"
    assert choose_precision("auto", torch.device("mps")) == "fp32"
    with pytest.raises(BadInputError, match=r"bf16 .* 'mps'; choose from auto, fp32"):
        choose_precision("bf16", torch.device("mps"))
    with pytest.raises(BadInputError, match="'mps:1' is not on this machine"):
        device.choose_device("mps:1")


def test_variational_adds_a_layer_and_its_loss(frames: Frames) -> None:
    plain, variational = train(frames, "rec"), train(frames, "rec", SETTINGS.model_copy(update={"beta": 1.0}))
    assert variational.weights.keys() - plain.weights.keys() == {"log_variance.weight", "log_variance.bias"}
    assert "loss_kl" in set(variational.curves["metric"])
    assert "loss_kl" not in set(plain.curves["metric"])
    one, again = (encode(variational.weights, frames.images, frames.indices("test")) for _ in range(2))
    assert np.array_equal(one, again)


def test_an_epoch_takes_each_frame_once_in_even_batches(frames: Frames) -> None:
    settings = SETTINGS.model_copy(update={"batch": 30})
    plan = plan_training(frames, 1.0, 0, settings, FRAMES)
    parts = plan.parts(0)
    assert len(parts) == plan.steps == -(-len(frames.indices("train")) // 30)
    assert np.array_equal(np.sort(np.concatenate(parts)), frames.indices("train"))
    sizes = [len(part) for part in parts]
    assert max(sizes) <= 30
    assert max(sizes) - min(sizes) <= 1
    assert not np.array_equal(np.concatenate(parts), np.concatenate(plan.parts(1)))


def test_the_step_budget_keeps_the_steps_of_all_the_data(frames: Frames) -> None:
    settings = SETTINGS.model_copy(update={"budget": "steps"})
    all_data = plan_training(frames, 1.0, 0, settings, FRAMES)
    quarter = plan_training(frames, 0.25, 0, settings, FRAMES)
    assert quarter.steps == all_data.steps
    times = np.unique(np.concatenate(quarter.parts(1)), return_counts=True)
    assert np.array_equal(times[0], quarter.subset)
    assert set(times[1]) == {4}
    literal = plan_training(frames, 0.25, 0, SETTINGS, FRAMES)
    assert literal.steps == -(-all_data.steps // 4)
    trained = train(frames, "rec", settings, fraction=0.25)
    assert trained.frames == len(quarter.subset)
    assert trained.curves["epoch"].max() == settings.epochs


def test_data_on_a_device_and_data_copied_ahead_give_the_batches_of_the_mapped_files(frames: Frames) -> None:
    plan, cpu = plan_training(frames, 1.0, 0, SETTINGS, FRAMES), torch.device("cpu")
    tensors = torch.tensor(frames.images), torch.tensor(frames.masks)
    for parts in (plan.parts(0), plan.parts(1)[:2], np.array_split(plan.subset, 9)):  # fewer and more than are ahead
        mapped = list(batches.Batches((frames.images, frames.masks), parts, cpu))
        assert [len(images) for images, _ in mapped] == [len(part) for part in parts]
        for others in (
            batches.Batches(tensors, parts, cpu),
            batches.prefetched((frames.images, frames.masks), parts, cpu),
        ):
            for one, other in zip(mapped, others, strict=True):
                assert all(torch.equal(a, b) for a, b in zip(one, other, strict=True))


# --- the way of a GPU, as far as a CPU can take it --------------------------------------------------------------------


def both_ways(frames: Frames, heads: str, beta: float) -> Iterator[tuple[MultiHeadAutoencoder, torch.Tensor]]:
    """Yield an autoencoder with the gradients and losses of one batch: head by head, and after `fuse`."""
    images, masks = torch.tensor(frames.images[:16]), torch.tensor(frames.masks[:16])
    for fused in (False, True):
        module = MultiHeadAutoencoder(heads, EncoderSettings(beta=beta), 0)
        if fused:
            module.fuse()
        yield module, module.gradients(images, masks, module._noise(16))


def assert_same_step(frames: Frames, heads: str, beta: float, tolerance: float) -> None:
    (eager, expected), (fused, losses) = both_ways(frames, heads, beta)
    assert torch.allclose(losses, expected, rtol=1e-3 * tolerance)
    for (name, ours), theirs in zip(fused.named_parameters(), eager.parameters(), strict=True):
        if theirs.grad is None:
            assert ours.grad is None, name
        elif theirs.grad.norm() > 2e-4:  # a bias before a BatchNorm has none but rounding
            assert (ours.grad - theirs.grad).norm() <= tolerance * theirs.grad.norm(), name
    for (name, ours), theirs in zip(fused.named_buffers(), eager.buffers(), strict=True):
        assert (ours - theirs).double().norm() <= tolerance * theirs.double().norm() / 10, name


@pytest.mark.stress
def test_a_compiled_step_is_the_step_head_by_head(frames: Frames, recwarn: pytest.WarningsRecorder) -> None:
    """Stated tolerance, in float32: 3e-5 of each loss, 0.3 % of BatchNorm's statistics, 3 % of each gradient's norm.

    With fresh weights the gradients behind a BatchNorm are small differences of large sums: head by head, float32 is
    itself up to 3 % away from float64.
    """
    assert_same_step(frames, "rec+plan", 0.3, 0.03)
    assert not [warning for warning in recwarn if "torch.compile failed" in str(warning.message)]


def test_what_cannot_be_compiled_trains_without_after_one_warning(
    frames: Frames, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(function: Any, **options: Any) -> Any:
        def run(*batch: Any) -> None:
            function(*batch)  # BatchNorm has seen the batch already
            raise RuntimeError("no C compiler\nfound")

        return run

    monkeypatch.setattr(torch, "compile", broken)
    with pytest.warns(RuntimeWarning, match=r"failed \(RuntimeError: no C compiler\).*TORCH_COMPILE_DISABLE=1"):
        assert_same_step(frames, "rec+plan", 0.0, 0.0)


def test_inside_an_epoch_nothing_waits_for_the_device(frames: Frames, monkeypatch: pytest.MonkeyPatch) -> None:
    reads = record_synchronisations(monkeypatch, MultiHeadAutoencoder, "training_step", "validation_step")
    train(frames, "full", SETTINGS.model_copy(update={"beta": 0.5}))
    assert reads == []


def test_memory_of_a_step_is_estimated_from_above(frames: Frames) -> None:
    """More than what autograd keeps and two of the largest gradients, and not more than twice as much."""
    for heads in ("rec", "full"):
        storages: dict[int, int] = {}

        def keep(tensor: torch.Tensor, storages: dict[int, int] = storages) -> torch.Tensor:
            storages[tensor.untyped_storage().data_ptr()] = tensor.untyped_storage().nbytes()
            return tensor

        module = MultiHeadAutoencoder(heads, SETTINGS, 0)
        weights = {parameter.data_ptr() for parameter in module.parameters()}
        with torch.autograd.graph.saved_tensors_hooks(keep, lambda tensor: tensor):
            losses = module.losses(torch.tensor(frames.images[:32]), torch.tensor(frames.masks[:32]))
        assert losses.requires_grad
        activations = sum(count for pointer, count in storages.items() if pointer not in weights)
        estimate = training.step_bytes(heads, 32, "fp32") - training.SPARE_BYTES
        assert activations + 2 * 32 * 31 * 31 * 32 * 4 <= estimate <= 2.5 * activations


def test_a_gpu_with_too_little_memory_is_known_before_training(frames: Frames, monkeypatch: pytest.MonkeyPatch) -> None:
    gpu = torch.device("cuda", 0)
    need = training.step_bytes("full", 2048, "bf16")
    for free, room in ((need, 0), (need + 100, 100)):
        monkeypatch.setattr(torch.cuda, "mem_get_info", lambda device, free=free: (free, 2 * free))
        assert training.check_memory(gpu, "full", 2048, "bf16") == room
        assert batches.resident(frames, gpu, room) == (frames.images, frames.masks)  # the data stay outside
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda device: (need - 1, need))
    with pytest.raises(BadInputError, match=r"cuda:0 has .* GB .*batch 2048 .* full needs about .*--encoder.batch"):
        training.check_memory(gpu, "full", 2048, "bf16")


# --- going on -------------------------------------------------------------------------------------------------------


@pytest.fixture
def every_step(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(training, "CHECKPOINT_SECONDS", 0)
    monkeypatch.setattr(training, "PROGRESS_SECONDS", 0)


@pytest.mark.usefixtures("every_step")
@pytest.mark.parametrize("beta", [0.0, 0.5])
def test_a_killed_training_ends_as_one_that_was_never_killed(frames: Frames, tmp_path: Path, beta: float) -> None:
    """KilledError inside the first epoch, at its last step, and inside the second: the same bytes in the end."""
    settings = EncoderSettings(epochs=2, batch=32, beta=beta, precision="auto")
    expected = train(frames, settings=settings)
    for number, kills in enumerate(((3,), (4, 5, 7))):
        checkpoint = tmp_path / str(number)
        for kill in kills:
            with pytest.raises(KilledError):
                train(frames, settings=settings, checkpoint=checkpoint, kill_at=kill)
        logged: list[tuple[int, dict[str, float]]] = []
        assert_same(expected, train(frames, settings=settings, checkpoint=checkpoint, logged=logged))
        assert [epoch for epoch, _ in logged] == [1, 2]
        assert [path.name for path in tmp_path.iterdir() if path.name.startswith(".")] == []


@pytest.mark.usefixtures("every_step")
def test_a_finished_training_is_not_done_again(frames: Frames, tmp_path: Path) -> None:
    first = train(frames, checkpoint=tmp_path / "done")
    assert_same(first, train(frames, checkpoint=tmp_path / "done", kill_at=1))


@pytest.mark.usefixtures("every_step")
def test_a_checkpoint_of_another_configuration_is_refused(frames: Frames, tmp_path: Path) -> None:
    path = tmp_path / "checkpoint"
    train(frames, "rec", checkpoint=path)
    for name, changed in (
        ("heads", {"heads": "full"}),
        ("encoder_seed", {"seed": 1}),
        ("lr", {"settings": SETTINGS.model_copy(update={"lr": 1e-3})}),
        ("fraction", {"fraction": 0.5}),
    ):
        with pytest.raises(BadInputError, match=f"another configuration: {name} "):
            train(frames, **({"heads": "rec"} | changed), checkpoint=path)
    other = replace(frames, images=np.asarray(frames.images) ^ 1)
    with pytest.raises(BadInputError, match="frames is"):
        train(other, "rec", checkpoint=path)


@pytest.mark.usefixtures("every_step")
def test_a_checkpoint_serves_settings_that_make_no_difference(frames: Frames, tmp_path: Path) -> None:
    path = tmp_path / "checkpoint"
    first = train(frames, "rec", checkpoint=path)
    other = SETTINGS.model_copy(update={"budget": "steps", "head_weights": {"rec": 1.0, "pred": 9.0}})
    again = train(frames, "rec", checkpoint=path, settings=other)
    assert all(np.array_equal(first.weights[name], again.weights[name]) for name in first.weights)


@pytest.mark.parametrize("damage", [lambda raw: raw[:1000], lambda raw: b"", lambda raw: raw[:-9000] + bytes(9000)])
def test_a_damaged_checkpoint_is_reported_and_not_used(
    frames: Frames, tmp_path: Path, damage: Callable[[bytes], bytes], capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "checkpoint"
    first = train(frames, "rec", checkpoint=path)
    path.write_bytes(damage(path.read_bytes()))
    assert_same(first, train(frames, "rec", checkpoint=path))
    assert "damaged checkpoint" in capsys.readouterr().err


@pytest.mark.stress
def test_a_training_that_was_really_killed_goes_on(store: Path, frames: Frames, tmp_path: Path) -> None:
    """SIGKILL at a random moment after the first checkpoint, in a process of its own."""
    checkpoint = tmp_path / "checkpoint"
    program = f"""
import torch
from pathlib import Path
from study.encoder import training
from study.config.settings import EncoderSettings, FramesSettings
from study.data.frames import open_frames
torch.set_num_threads(1)
training.CHECKPOINT_SECONDS = 0
training.train_encoder(
    open_frames(Path({str(store)!r})).encoder, "rec", 1.0, 0, EncoderSettings(epochs=6, batch=16),
    FramesSettings.model_validate_json({FRAMES.model_dump_json()!r}), device="cpu",
    checkpoint=Path({str(checkpoint)!r}), log=lambda epoch, losses: print(epoch, flush=True),
)
"""
    with subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        for line in process.stdout:
            if int(line) == 2:
                process.kill()
                break
    assert process.returncode == -signal.SIGKILL
    settings = EncoderSettings(epochs=6, batch=16)
    assert_same(train(frames, "rec", settings), train(frames, "rec", settings, checkpoint=checkpoint))


# --- bad input and bad luck -----------------------------------------------------------------------------------------


def test_a_loss_that_is_not_finite_names_epoch_and_step(frames: Frames, tmp_path: Path) -> None:
    settings = EncoderSettings(epochs=2, batch=32, lr=1e30, precision="fp32")
    with pytest.raises(TrainingDivergedError, match="epoch 1, step 2;"):
        train(frames, "rec", settings, checkpoint=tmp_path / "checkpoint")
    assert list(tmp_path.iterdir()) == []


def test_too_little_device_memory_names_the_setting_that_lowers_it(frames: Frames) -> None:
    def progress(done: int, total: int) -> None:
        raise torch.OutOfMemoryError("tried to allocate 9 GiB")

    where = {"device": "cpu", "checkpoint": None, "log": lambda epoch, losses: None, "progress": progress}
    with pytest.raises(BadInputError, match=r"too little memory for batch 32.*9 GiB.*lower --encoder.batch"):
        train_encoder(frames, "rec", 1.0, 0, SETTINGS, FRAMES, **where)


def test_unusable_input_is_refused_with_the_way_out(frames: Frames) -> None:
    with pytest.raises(BadInputError, match=r"unknown head set 'rec[+]plam'; choose from rec, rec"):
        train(frames, "rec+plam")
    with pytest.raises(BadInputError, match=r"batch 500 is larger than the 128 training frames.*--encoder.batch"):
        train(frames, "rec", EncoderSettings(batch=500))
    for name in ("cuda:99", "mps"):
        with pytest.raises(BadInputError, match=f"device '{name}' is not on this machine; choose from cpu"):
            train(frames, "rec", device=name)
    with pytest.raises(BadInputError, match="unknown device 'gpu'"):
        train(frames, "rec", device="gpu")


@pytest.mark.usefixtures("every_step")
def test_ctrl_c_and_sigterm_keep_their_meaning(frames: Frames) -> None:
    """Lightning would turn the one into exit code 1 and delay the other to the end of the epoch."""

    def stop(number: int) -> None:
        train_encoder(
            frames,
            "rec",
            1.0,
            0,
            SETTINGS,
            FRAMES,
            device="cpu",
            checkpoint=None,
            log=lambda epoch, losses: pytest.fail("an epoch went on"),
            progress=lambda done, total: os.kill(os.getpid(), number),
        )

    interrupted = signal.signal(signal.SIGINT, signal.default_int_handler)  # dask-jobqueue sets its own on import
    try:
        with pytest.raises(KeyboardInterrupt):
            stop(signal.SIGINT)
    finally:
        signal.signal(signal.SIGINT, interrupted)

    def terminate(*_: object) -> None:
        raise KilledError

    before = signal.signal(signal.SIGTERM, terminate)
    try:
        with pytest.raises(KilledError):
            stop(signal.SIGTERM)
        assert signal.getsignal(signal.SIGTERM) is terminate
    finally:
        signal.signal(signal.SIGTERM, before)


# --- what is kept ---------------------------------------------------------------------------------------------------


def test_latents_depend_on_neither_batch_nor_order(frames: Frames, tmp_path: Path) -> None:
    """And weights may have been saved and loaded in between."""
    weights = train(frames, "rec").weights
    save_file({name: np.ascontiguousarray(value) for name, value in weights.items()}, tmp_path / "weights")
    indices = frames.indices("test")
    z = encode(weights, frames.images, indices)
    assert z.shape == (len(indices), LATENT)
    assert z.dtype == np.float32
    again = encode(load_file(tmp_path / "weights"), frames.images, indices[::-1], batch=7)
    assert np.allclose(z, again[::-1], atol=1e-4)
    assert z.std(axis=0).min() > 0


def test_foreign_weights_are_refused(frames: Frames) -> None:
    with pytest.raises(BadInputError, match="not the weights of an encoder"):
        encode({"policy.weight": np.zeros((3, 3), np.float32)}, frames.images, frames.indices("test"))


def test_samples_are_the_same_rich_test_frames_for_every_encoder(frames: Frames) -> None:
    rows = choose_samples(frames)
    test = frames.indices("test")
    assert len(rows) == len(set(rows.tolist())) == 16
    assert set(rows) <= set(test)
    assert frames.labels["episode"][rows].nunique() == frames.labels["episode"][test].nunique()
    masks = unpack_masks(frames.masks[:])
    assert masks[rows].mean() > masks[test].mean()
    samples = train(frames, "full").samples
    assert np.array_equal(samples["input"], frames.images[rows])
    assert np.array_equal(samples["plan_target"], masks[rows][:, 1] * 255)
    assert {name: value.shape[1:] for name, value in samples.items()} == {
        "input": (64, 64, 3),
        "rec_output": (64, 64, 3),
        "pred_output": (64, 64),
        "plan_output": (64, 64),
        "pred_target": (64, 64),
        "plan_target": (64, 64),
    }
    assert all(value.dtype == np.uint8 for value in samples.values())


@pytest.mark.parametrize("channels", [1, 2, 3, 5])
def test_convolutions_in_blocks_and_their_gradients_are_those_of_torch(channels: int) -> None:
    torch.manual_seed(channels)
    images = torch.randn(2, channels, 10, 6, dtype=torch.float64, requires_grad=True)
    weight = torch.randn(7, channels, 4, 4, dtype=torch.float64, requires_grad=True)
    bias = torch.randn(7, dtype=torch.float64)
    inputs = torch.randn(2, 7, 5, 3, dtype=torch.float64, requires_grad=True)
    back = torch.randn(7, channels, 4, 4, dtype=torch.float64, requires_grad=True)
    for in_blocks, plain, needed in (
        (convolve_blocks(images, weight, bias), functional.conv2d(images, weight, bias, 2), (images, weight)),
        (interleave_blocks(inputs, back, channels), functional.conv_transpose2d(inputs, back, None, 2), (inputs, back)),
    ):
        torch.testing.assert_close(in_blocks, plain, rtol=0, atol=1e-12)
        upstream = torch.randn_like(plain)
        gradients = [torch.autograd.grad(output, needed, upstream) for output in (in_blocks, plain)]
        torch.testing.assert_close(*gradients, rtol=0, atol=1e-11)
