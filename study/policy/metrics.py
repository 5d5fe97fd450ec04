"""Metrics of a policy's predictions on labelled frames."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from study.config.paper import ACCELERATIONS

SPLITS = ("train", "test")
METRICS = (
    "steering_loss",
    "acceleration_accuracy",
    "balanced_accuracy",
    "cross_entropy",
    "keyframe_accuracy",
    "natural_accuracy",
    "natural_steering_loss",
)


class Labels(NamedTuple):
    """The commands to learn: steering [N] float32 and acceleration class [N] int64.

    `keyframe` [N] float32: 1 where the class has just changed. `weight` [N] float32, mean 1: with it, frames are
    distributed as in driving.
    """

    steering: Tensor
    acceleration: Tensor
    keyframe: Tensor
    weight: Tensor


def likeliest(logits: Tensor) -> Tensor:
    """Return the class of the largest of logits [S, 3, N]; argmax takes 40 times as long on a CPU."""
    first, second, third = logits.unbind(1)
    return torch.where(first >= torch.maximum(second, third), 0, torch.where(second >= third, 1, 2))


def measure(steering: Tensor, logits: Tensor, labels: Labels) -> Tensor:
    """Return METRICS of each seed, [7, S], from steering [S, N] and logits [S, N, 3].

    Balanced accuracy is the mean recall of the classes that occur. Keyframe accuracy is 0 where there is no keyframe.
    """
    errors = functional.smooth_l1_loss(steering, labels.steering.expand_as(steering), reduction="none")
    by_class = logits.transpose(1, 2).contiguous()
    right = (likeliest(by_class) == labels.acceleration).to(torch.float32)
    occurs = functional.one_hot(labels.acceleration, len(ACCELERATIONS)).to(torch.float32)
    counts = occurs.sum(0)
    balanced = (right @ occurs / counts.clamp(min=1)).sum(1) / (counts > 0).sum()
    cross_entropy = -(by_class.log_softmax(1) * occurs.T).sum(1).mean(1)
    keyframe = right @ labels.keyframe / labels.keyframe.sum().clamp(min=1)
    weight = labels.weight / labels.weight.sum()
    natural = [(values * weight).sum(1) for values in (right, errors)]  # a product of matrices rounds by S
    return torch.stack([errors.mean(1), right.mean(1), balanced, cross_entropy, keyframe, *natural])
