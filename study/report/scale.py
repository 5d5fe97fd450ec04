"""How much encoders are trained, beside the paper's numbers."""

from __future__ import annotations

import math

from study.config.paper import ENCODER_BATCH, ENCODER_EPOCHS, ENCODER_FRAMES, TRAIN_SHARE
from study.report.model import Scale
from study.results.sweep_record import SweepRecord


def training_scale(record: SweepRecord) -> tuple[Scale, ...]:
    """Return the scale of a sweep's encoders at each data fraction, the largest first."""
    settings = record.settings.encoder
    frames = record.settings.frames
    train = record.data.get("sets", {}).get("encoder", {}).get("train") or frames.encoder * (1 - frames.test_share)
    return tuple(
        _scale(fraction, round(train), settings.epochs, settings.batch, same_steps=settings.budget == "steps")
        for fraction in sorted(record.grid.fractions, reverse=True)
    )


def _scale(fraction: float, train: int, epochs: int, batch: int, *, same_steps: bool) -> Scale:
    """Return the scale at a fraction; with `same_steps` an epoch has as many images as at fraction 1."""
    paper = round(ENCODER_FRAMES * TRAIN_SHARE * fraction)
    part = round(train * fraction)
    epoch = train if same_steps else part
    return Scale(
        fraction=fraction,
        frames=part,
        images=epochs * epoch,
        steps=epochs * math.ceil(epoch / batch),
        paper_frames=paper,
        paper_images=ENCODER_EPOCHS * paper,
        paper_steps=ENCODER_EPOCHS * math.ceil(paper / ENCODER_BATCH),
    )
