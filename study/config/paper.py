"""The numbers that the paper gives for its networks and labels."""

from __future__ import annotations

import itertools

from study.config.heads import HEADS

IMAGE = 64  # pixels a side, after the area average from 256 (Sec. IV-A)
LATENT = 64  # numbers in z
CHANNELS = (32, 64, 128)  # of the three convolutions; a decoder runs them backwards
KERNEL, STRIDE = 4, 2
CORE = 6  # 64 -> 31 -> 14 -> 6 pixels a side, no padding anywhere
STEERING_HIDDEN = (256, 64)
ACCELERATION_HIDDEN = (128, 64)
ACCELERATIONS = (-1.0, 0.5, 1.0)  # class 0, 1, 2: throttle - brake of the autopilot (Sec. IV-C)
STEERING_CROP = 0.25  # where a command is applied; the loss sees the raw label
DROPOUT = 0.5
ENCODER_FRAMES = 500_000  # train and test (Sec. IV-A)
TRAIN_SHARE = 0.8  # of the frames (Sec. V)
ENCODER_EPOCHS = 200  # (Sec. IV-B)
ENCODER_BATCH = 2048  # (Sec. IV-B)


def parameter_counts() -> dict[str, int]:
    """Learnable numbers of the encoder and of each head, biases and BatchNorm's affine included (Sec. IV-B)."""
    area, core = KERNEL * KERNEL, CHANNELS[-1] * CORE * CORE
    convolutions = zip((3, *CHANNELS[:-1]), CHANNELS, strict=True)
    encoder = sum(i * o * area + o + 2 * o for i, o in convolutions) + core * LATENT + LATENT
    counts = {"encoder": encoder}
    widths = CHANNELS[::-1]
    for name, head in HEADS.items():
        fully_connected = LATENT * core + core + 2 * core
        hidden = sum(i * o * area + o + 2 * o for i, o in itertools.pairwise(widths))
        counts[name] = fully_connected + hidden + widths[-1] * head.channels * area + head.channels
    return counts
