"""The network that is trained: an encoder with the decoder heads of a head set (Sec. III-B, IV-B)."""

from __future__ import annotations

import warnings
from collections.abc import Callable

import lightning
import torch
from torch import Tensor, nn
from torch.nn import functional

from study.config.heads import HEAD_SETS, HEADS
from study.config.paper import LATENT
from study.config.settings import EncoderSettings
from study.encoder.inputs import Split, mask_places, to_float, unpack
from study.encoder.networks import PIXELS, Decoder, initialise, seeded_generator, untrained_encoder
from study.errors import one_of

LOSSES: dict[str, Callable[[Tensor, Tensor], Tensor]] = {  # by the name in a head's record; logits, target -> mean
    "cross-entropy": functional.binary_cross_entropy_with_logits,
    "squared-error": lambda logits, target: functional.mse_loss(logits.sigmoid(), target),
}


class MultiHeadAutoencoder(lightning.LightningModule):
    """An encoder and the decoder heads of a head set, with the loss that trains them (Sec. III-B).

    The loss adds up the heads' negative log likelihoods, each times its `head_weights`. With the loss "sum", that of an
    image is the sum over its numbers, as the paper writes it: 12,288 for rec, 4,096 for a mask. The total is divided by
    4,096, a constant to which Adam is indifferent, so a head's mean per number is weighted by its channels: rec 3, a
    mask 1. With "mean" each head's mean per number counts alike. With `beta` > 0, beta times the Kullback-Leibler
    divergence of z from N(0, 1) is added, divided by what rec's likelihood is divided by, so that beta = 1 is the
    evidence lower bound of `rec` with either loss.

    The losses by head that are logged are means per number, the divergence is per number of rec. They are averaged over
    each epoch and split on the device: Lightning's own logging would wait for it at every step. Raises BadInputError
    for an unknown head set.
    """

    def __init__(self, heads: str, settings: EncoderSettings, encoder_seed: int) -> None:
        super().__init__()
        if heads not in HEAD_SETS:
            raise one_of("head set", heads, HEAD_SETS)
        self.settings, self.beta = settings, settings.beta * _numbers("rec", settings)
        self.head_weights = {
            head: settings.head_weights.get(head, 1.0) * _numbers(head, settings) for head in HEAD_SETS[heads].heads
        }
        self.automatic_optimization = False  # gradients come head by head, see `losses`
        self.encoder = untrained_encoder(encoder_seed, variational=settings.beta > 0)
        self._head_losses = {head: LOSSES[HEADS[head].loss] for head in self.head_weights}
        self._mask_places = mask_places(self.head_weights)
        self.decoders = nn.ModuleDict({head: Decoder(HEADS[head].channels) for head in HEAD_SETS[heads].heads})
        for head, decoder in self.decoders.items():
            initialise(decoder, seeded_generator(encoder_seed, f"decoder weights {head}"))
        self.metrics = ("loss", *(f"loss_{head}" for head in self.decoders), *(["loss_kl"] if settings.beta else []))
        self.noise_seed = encoder_seed
        self.noise: torch.Generator | None = None
        self.noise_state: Tensor | None = None  # of the checkpoint that a training resumes from
        self._fused: _Fused | None = None
        self.reset_means()

    def forward(self, images: Tensor) -> dict[str, Tensor]:
        """Return the logits of each head for images [B, 3, 64, 64] float in [0, 1]."""
        z = self.encoder(images)
        return {head: decoder(z) for head, decoder in self.decoders.items()}

    def losses(self, images: Tensor, masks: Tensor, noise: Tensor | None = None, *, by_head: bool = False) -> Tensor:
        """Return the losses named in `metrics`, of images [B, 64, 64, 3] uint8 and masks [B, K, 512] uint8.

        `noise` [B, 64] float32 moves z within its variance, when variational. The losses carry gradients. With
        `by_head` they carry none: the gradients of the total loss are added to the parameters' one head after the
        other, so that memory for the activations of one head suffices.
        """
        pixels = to_float(images)
        targets = unpack(masks, self._mask_places)
        features = self.encoder.features(pixels)
        z = self.encoder.mean(features)
        ends: list[tuple[Tensor, Tensor | None]] = []  # of the encoder's graph, with incoming gradients
        divergence = []
        if self.encoder.log_variance is not None:
            mean, log_variance = z.float(), self.encoder.log_variance(features).float()
            kl = (mean.square() + log_variance.exp() - 1 - log_variance).sum(1).mean() / (2 * PIXELS)
            divergence.append(kl.detach() if by_head else kl)
            ends.append((self.beta * kl, None))
            if noise is not None:  # on the test split the mean stands for z, as for the policies
                z = mean + torch.exp(log_variance / 2) * noise
        given = z.detach().requires_grad_() if by_head else z
        parts = []
        weights = [self.head_weights[head] for head in self.decoders]
        for weight, (head, decoder) in zip(weights, self.decoders.items(), strict=True):
            loss = self._head_losses[head](decoder(given), targets.get(head, pixels))
            if by_head:
                torch.autograd.backward(weight * loss)
            parts.append(loss.detach() if by_head else loss)
        if by_head:
            outputs, incoming = zip(*ends, (z, given.grad), strict=True)
            torch.autograd.backward(outputs, incoming)
        weights += [self.beta] * len(divergence)
        parts += divergence
        return torch.stack([sum(w * part for w, part in zip(weights, parts, strict=True)), *parts])  # type: ignore[list-item]

    def _noise(self, count: int) -> Tensor | None:
        if not self.beta:
            return None
        if self.noise is None:
            self.noise = seeded_generator(self.noise_seed, "encoder noise", self.device)
            if self.noise_state is not None:
                self.noise.set_state(self.noise_state)
        return torch.randn((count, LATENT), generator=self.noise, device=self.device)

    def training_step(self, batch: tuple[Tensor, Tensor]) -> None:
        """Take one step of the optimiser."""
        optimizer = self.optimizers(use_pl_optimizer=False)
        assert isinstance(optimizer, torch.optim.Optimizer)
        optimizer.zero_grad()
        self._note("train", self.gradients(*batch, self._noise(len(batch[0]))), len(batch[0]))
        optimizer.step()

    def validation_step(self, batch: tuple[Tensor, Tensor]) -> None:
        """Add the losses of a batch of the test split to the means."""
        losses = self._fused(*batch, None) if self._fused else None
        self._note("test", self.losses(*batch) if losses is None else losses, len(batch[0]))

    def gradients(self, images: Tensor, masks: Tensor, noise: Tensor | None) -> Tensor:
        """Return the losses of a batch, and add the gradients of their total to the parameters'."""
        losses = self._fused(images, masks, noise) if self._fused else None
        return self.losses(images, masks, noise, by_head=True) if losses is None else losses

    def fuse(self) -> None:
        """Compute losses and gradients by torch.compile from now on, where that works."""
        self._fused = _Fused(self)

    def configure_optimizers(self) -> torch.optim.Optimizer:
        """Return Adam (Sec. IV-B)."""
        return torch.optim.Adam(self.parameters(), lr=self.settings.lr, fused=True)

    def _note(self, split: Split, losses: Tensor, count: int) -> None:
        weighted = torch.cat([losses, losses.new_ones(1)]).to(_accurate(losses.device)) * count
        self.sums[split] = self.sums[split].to(weighted.dtype).to(losses.device) + weighted
        self.totals[split].append(losses[0])

    def reset_means(self) -> None:
        """Start the means of an epoch."""
        self.sums = {name: torch.zeros(len(self.metrics) + 1, dtype=torch.float64) for name in ("train", "test")}
        self.totals: dict[str, list[Tensor]] = {"train": [], "test": []}

    def means(self) -> dict[str, float]:
        """Return the mean of each loss since the last reset, e.g. "train/loss_rec"; waits for the device."""
        means: dict[str, float] = {}
        rows = torch.stack([sums.to(_accurate(self.device)).to(self.device) for sums in self.sums.values()]).tolist()
        for split, (*values, count) in zip(self.sums, rows, strict=True):
            means |= {f"{split}/{name}": value / count for name, value in zip(self.metrics, values, strict=True)}
        return means

    def not_finite(self, split: Split) -> int:
        """Return the position, since the last reset, of the first batch whose loss was not finite; there is one."""
        return int(torch.stack(self.totals[split]).isfinite().int().argmin())


def _accurate(device: torch.device) -> torch.dtype:
    """Return the type of sums over an epoch: float64, which Apple's GPUs lack."""
    return torch.float32 if device.type == "mps" else torch.float64


def _numbers(head: str, settings: EncoderSettings) -> int:
    """Return what a head's mean per number is multiplied by in the loss."""
    return HEADS[head].channels if settings.loss == "sum" else 1


class _Fused:
    """An autoencoder's losses and their gradients by torch.compile: one graph for each size of batch and each split.

    A call returns the losses and, in training, adds their gradients to the parameters'. It returns None where
    compiling fails, after one warning.
    """

    def __init__(self, module: MultiHeadAutoencoder) -> None:
        torch.compiler.reset()  # graphs of an encoder trained before would count against the limit
        self.module = module
        self.function: Callable[..., Tensor] | None = torch.compile(module.losses, dynamic=False, fullgraph=True)
        self.compiled: set[tuple[int, bool]] = set()  # sizes, each in training or not

    def __call__(self, images: Tensor, masks: Tensor, noise: Tensor | None) -> Tensor | None:
        if self.function is None:
            return None
        kind = len(images), self.module.training
        buffers = [] if kind in self.compiled else [buffer.clone() for buffer in self.module.buffers()]
        try:
            losses = self.function(images, masks, noise)
            if self.module.training:
                torch.autograd.backward(losses[0])
        except Exception as error:
            if kind in self.compiled or isinstance(error, torch.OutOfMemoryError):
                raise
            warnings.warn(
                f"torch.compile failed ({type(error).__name__}: {str(error).strip().splitlines()[0]}); the encoder "
                "trains without it, more slowly (TORCH_COMPILE_DISABLE=1 leaves it out)",
                RuntimeWarning,
                stacklevel=2,
            )
            self.function = None
            self.module.zero_grad()
            for buffer, value in zip(self.module.buffers(), buffers, strict=True):
                buffer.copy_(value)
            return None
        self.compiled.add(kind)
        return losses.detach()
