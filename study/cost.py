"""What a sweep is expected to take: time on the reference machine (2 CPU cores at 2.5 GHz), disk, frames.

The rates are rounded from `benchmarks/`; a running sweep corrects them by what it measures.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from study.config import CEILING, HEAD_SETS, IMAGE, Cell, StudySettings

STEP_HZ = 10
VEHICLE_FRAMES_PER_S = 90_000.0  # simulated, on two cores
FRAMES_PER_S = 6_000.0  # chosen and rendered, on two cores
ENCODER_IMAGE_S = 1 / 2900  # an image forward and backward through the encoder
HEAD_IMAGE_S = 1 / 3700  # the same for each head
TEST_COST = 0.35  # an image evaluated, as a share of an image trained
POLICY_FRAME_S = 1 / 500_000  # a frame forward and backward through one policy, on two cores
DRIVE_READ_S = 0.12  # a drive read again for the true state
CELL_START_S = 10.0  # a process starts, imports torch and opens the data; a result is committed

FRAME_BYTES = IMAGE * IMAGE * 3 + 2 * IMAGE * IMAGE // 8 + 40  # image, two bit masks, labels
STATE_BYTES = 32  # of one vehicle at one step in an Episode
RESULT_BYTES = 12_000_000  # weights, curves, samples and predictions of a cell, with its share of the tracking store


@dataclass(frozen=True)
class Cost:
    """Seconds on the reference machine, and bytes on disk."""

    seconds: float
    bytes: int


def recording_cost(settings: StudySettings) -> Cost:
    """Of recording the drives."""
    recording = settings.recording
    steps = (recording.encoder_episodes + recording.policy_episodes) * settings.town.vehicles * STEP_HZ
    return Cost(
        steps * (recording.warm_up + recording.duration) / VEHICLE_FRAMES_PER_S,
        int(steps * recording.duration * STATE_BYTES),
    )


def data_cost(settings: StudySettings, *, recorded: bool = True) -> Cost:
    """Of recording the drives, unless they are there already, and rendering the frames."""
    images = settings.frames.encoder + settings.frames.policy
    rendering = Cost(images / FRAMES_PER_S, images * FRAME_BYTES)
    return total([recording_cost(settings), rendering]) if recorded else rendering


def cell_cost(settings: StudySettings, cell: Cell, policy_seeds: int) -> Cost:
    """Of one cell: its encoder, unless it is the ceiling, and its policies."""
    frames, encoder, policy = settings.frames, settings.encoder, settings.policy
    policies = policy_seeds * policy.epochs * frames.policy * POLICY_FRAME_S + CELL_START_S
    if cell.heads == CEILING:
        return Cost(policies + settings.recording.policy_episodes * DRIVE_READ_S, RESULT_BYTES)
    train = frames.encoder * (1 - frames.test_share)
    if encoder.budget == "epochs":
        train *= cell.fraction
    images = encoder.epochs * (train + TEST_COST * frames.encoder * frames.test_share)
    seconds = images * (ENCODER_IMAGE_S + HEAD_IMAGE_S * len(HEAD_SETS[cell.heads]))
    return Cost(seconds + policies, RESULT_BYTES)


def total(costs: Iterable[Cost]) -> Cost:
    """The sum."""
    listed = list(costs)
    return Cost(sum(cost.seconds for cost in listed), sum(cost.bytes for cost in listed))


def clock(seconds: float) -> str:
    """A time for people, e.g. `7 s`, `12 min`, `3 h 05 min`."""
    if seconds < 100:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 100 else f"{minutes // 60} h {minutes % 60:02d} min"


def size(count: float) -> str:
    """Bytes for people, e.g. `310 MB`, `7.0 GB`."""
    return f"{count / 1e9:.1f} GB" if count >= 1e9 else f"{count / 1e6:.0f} MB"
