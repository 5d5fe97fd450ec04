"""Networks of the encoder and its decoder heads (Sec. III-B)."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from study.config.heads import HEADS
from study.config.paper import CHANNELS, CORE, IMAGE, KERNEL, LATENT, STRIDE
from study.errors import BadInputError
from study.randomness import rng

_CORE_NUMBERS = CHANNELS[-1] * CORE * CORE
CHANNEL_BLOCK = 8  # channels that a GPU's matrix units take at once
PIXELS = HEADS["rec"].channels * IMAGE * IMAGE


class _Convolution(nn.Conv2d):
    """A convolution before a BatchNorm, which takes its bias away again: the bias has no gradient to wait for."""

    def forward(self, input: Tensor) -> Tensor:  # noqa: A002 - torch's name
        assert self.bias is not None
        if input.device.type != "cuda" or self.in_channels >= CHANNEL_BLOCK:
            return functional.conv2d(input, self.weight, self.bias.detach(), self.stride)
        return convolve_blocks(input, self.weight, self.bias.detach())


def convolve_blocks(images: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    """Return the convolution, kernel 4 and stride 2, of images with even sides, as one with kernel 2 and stride 1.

    Blocks of 2x2 pixels become one pixel with four times the channels. A GPU's matrix units want channels by the
    eight, so some of zeros are added.
    """
    extra = -4 * images.shape[1] % CHANNEL_BLOCK
    blocks = functional.pad(functional.pixel_unshuffle(images, STRIDE), (0, 0, 0, 0, 0, extra))
    kernels = functional.pad(functional.pixel_unshuffle(weight, STRIDE), (0, 0, 0, 0, 0, extra))
    return functional.conv2d(blocks, kernels, bias)


def interleave_blocks(images: Tensor, weight: Tensor, channels: int) -> Tensor:
    """Return the transposed convolution, kernel 4 and stride 2, as one with kernel 2 to four times the channels.

    See `_SubPixel`, and `convolve_blocks` for the channels of zeros.
    """
    kernels = functional.pad(_sub_kernels(weight), (0, 0, 0, 0, 0, 0, 0, -4 * channels % CHANNEL_BLOCK))
    blocks = functional.conv2d(images, kernels, padding=1)[:, : 4 * channels]
    count, _, rows, columns = blocks.shape
    corners = blocks.reshape(count, 2, 2, channels, rows, columns).permute(0, 3, 4, 1, 5, 2)
    return corners.reshape(count, channels, 2 * rows, 2 * columns)


def _sub_kernels(weight: Tensor) -> Tensor:
    """Return the 2x2 kernels [4 D, C, 2, 2] of the four outputs of each pixel, of weight [C, D, 4, 4]."""
    corners = weight.reshape(*weight.shape[:2], 2, 2, 2, 2).flip(2, 4)  # the kernel's halves, then odd and even
    return corners.permute(3, 5, 1, 0, 2, 4).flatten(0, 2)


class _SubPixel(torch.autograd.Function):
    """A transposed convolution, kernel 4 and stride 2, as a 2x2 convolution to four times the channels.

    Each input pixel's four outputs are computed side by side and then interleaved: on a CPU about twice as fast as
    oneDNN's own, which is slow with few output channels and with output padding. Backward, oneDNN's own is fast.
    """

    @staticmethod
    def forward(ctx: Any, images: Tensor, weight: Tensor, bias: Tensor, extra: int) -> Tensor:
        """Return [B, D, 2 H + 2 + extra, ..] of images [B, C, H, W], weight [C, D, 4, 4], bias [D]; channels last."""
        ctx.save_for_backward(images, weight)
        ctx.extra = extra
        channels = weight.shape[1]
        blocks = functional.conv2d(images, _sub_kernels(weight), bias.repeat(4), padding=1).permute(0, 2, 3, 1)
        rows, columns = blocks.shape[1:3]
        output = blocks.new_empty(len(images), 2 * rows + extra, 2 * columns + extra, channels)
        output[:, 2 * rows :] = bias  # out of every kernel's reach
        output[:, :, 2 * columns :] = bias
        inside = output[:, : 2 * rows, : 2 * columns].view(-1, rows, 2, columns, 2, channels)
        inside.copy_(blocks.reshape(-1, rows, columns, 2, 2, channels).permute(0, 1, 3, 2, 4, 5))
        return output.permute(0, 3, 1, 2)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        """Return the gradients of images and weight."""
        images, weight = ctx.saved_tensors
        two, none, one, extra, transposed = [STRIDE] * 2, [0, 0], [1, 1], [ctx.extra] * 2, True
        of_images, of_weight, _ = torch.ops.aten.convolution_backward(
            gradients[0], images, weight, None, two, none, one, transposed, extra, 1, [True, True, False]
        )
        return of_images, of_weight, None, None


def _transposed(layer: nn.ConvTranspose2d, images: Tensor, bias: Tensor) -> Tensor:
    """Return the output of a layer with another bias, which gets no gradient."""
    extra = layer.output_padding[0]
    if images.device.type == "cpu":
        # Autocast does not look into the function: the layer computes in the type that it is given.
        output: Tensor = _SubPixel.apply(  # type: ignore[no-untyped-call]
            images, layer.weight.to(images.dtype), bias.to(images.dtype), extra
        )
        return output
    if images.device.type == "cuda" and layer.out_channels < CHANNEL_BLOCK and not extra:
        return interleave_blocks(images, layer.weight, layer.out_channels) + bias.view(-1, 1, 1)
    return functional.conv_transpose2d(images, layer.weight, bias, STRIDE, output_padding=extra)


class _TransposedConvolution(nn.ConvTranspose2d):
    """The same, transposed. Here the bias' gradient, zero but for rounding, took half of the backward time on a CPU."""

    def forward(self, input: Tensor, output_size: list[int] | None = None) -> Tensor:  # noqa: A002, ARG002
        assert self.bias is not None
        return _transposed(self, input, self.bias.detach())


class Encoder(nn.Module):
    """Images to z: three convolutions and a fully connected layer (Sec. IV-B).

    Input [B, 3, 64, 64] float in [0, 1], output z [B, 64]. With `variational`, one more layer gives log variances.
    """

    def __init__(self, variational: bool = False) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        for before, after in itertools.pairwise((HEADS["rec"].channels, *CHANNELS)):
            layers += [_Convolution(before, after, KERNEL, STRIDE), nn.BatchNorm2d(after), nn.ReLU(inplace=True)]
        self.convolutions = nn.Sequential(*layers)
        self.mean = nn.Linear(_CORE_NUMBERS, LATENT)
        self.log_variance = nn.Linear(_CORE_NUMBERS, LATENT) if variational else None

    def features(self, images: Tensor) -> Tensor:
        """Return the input [B, 4608] of the fully connected layers, pixel by pixel as in channels-last memory."""
        features: Tensor = self.convolutions(images)
        return features.permute(0, 2, 3, 1).flatten(1)

    def forward(self, images: Tensor) -> Tensor:
        """Return the latent; its mean when variational."""
        z: Tensor = self.mean(self.features(images))
        return z


class Decoder(nn.Module):
    """z [B, 64] to the logits [B, channels, 64, 64] of one head, in float32: the encoder backwards (Sec. IV-B)."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.fully_connected = nn.Sequential(
            nn.Linear(LATENT, _CORE_NUMBERS), nn.BatchNorm1d(_CORE_NUMBERS), nn.ReLU(inplace=True)
        )
        layers: list[nn.Module] = []
        # 6 -> 14 -> 31 -> 64 without padding: the middle layer needs one row and column more (docs/paper.md)
        for (before, after), extra in zip(itertools.pairwise(CHANNELS[::-1]), (0, 1), strict=True):
            layers += [
                _TransposedConvolution(before, after, KERNEL, STRIDE, output_padding=extra),
                nn.BatchNorm2d(after),
                nn.ReLU(inplace=True),
            ]
        self.convolutions = nn.Sequential(*layers)
        self.output = nn.ConvTranspose2d(CHANNELS[0], channels, KERNEL, STRIDE)

    def forward(self, z: Tensor) -> Tensor:
        """Return logits; a sigmoid makes them the paper's output."""
        core = self.fully_connected(z).view(-1, CORE, CORE, CHANNELS[-1]).permute(0, 3, 1, 2)
        # The bias is added in float32, where its gradient is exact, and faster than inside the convolution.
        assert self.output.bias is not None
        logits = _transposed(self.output, self.convolutions(core), torch.zeros_like(self.output.bias))
        return logits.float() + self.output.bias.view(-1, 1, 1)


def initialise(network: nn.Module, generator: torch.Generator) -> None:
    """Draw every layer's weights and biases as torch does by default, U(-1/sqrt(fan in), 1/sqrt(fan in))."""
    with torch.no_grad():
        for layer in network.modules():
            if isinstance(layer, nn.Linear | nn.Conv2d | nn.ConvTranspose2d):
                bound = 1 / math.sqrt(layer.weight[0].numel())
                layer.weight.uniform_(-bound, bound, generator=generator)
                if layer.bias is not None:
                    layer.bias.uniform_(-bound, bound, generator=generator)


def untrained_encoder(seed: int, *, variational: bool = False) -> Encoder:
    """Return an encoder with the initial weights of that seed."""
    encoder = Encoder(variational)
    initialise(encoder, seeded_generator(seed, "encoder weights"))
    return encoder


def seeded_generator(seed: int, purpose: str, device: torch.device | str = "cpu") -> torch.Generator:
    """Return torch's generator of one purpose of a seed (see `rng`)."""
    return torch.Generator(device).manual_seed(int(rng(seed, purpose).integers(2**63)))


def encoder_of(weights: Mapping[str, NDArray[Any]]) -> Encoder:
    """Return the trained network of these weights. Raises BadInputError when they are not an Encoder's."""
    encoder = Encoder(variational="log_variance.weight" in weights)
    try:
        encoder.load_state_dict({name: torch.from_numpy(np.array(value)) for name, value in weights.items()})
    except (RuntimeError, TypeError) as error:
        raise BadInputError(f"these are not the weights of an encoder: {error}") from error
    return encoder.eval()
