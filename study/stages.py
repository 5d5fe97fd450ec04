"""The stages of a study, and what each is expected to cost.

A study is a graph of stages. Each is a pure function from settings and the products of earlier stages to one product:

    record -> select -> render -> encoder -> latents -> policy -> result -> drive

`STAGES` is the only list of them: progress words, cost estimates, keys and MLflow names derive from its records.
`study.data` and `study.cell` arrange the stages in flows; `study.engine` runs them.

Costs are for the reference machine (2 CPU cores at 2.5 GHz). The rates are rounded from `benchmarks/`; a running sweep
corrects them by its own measurements.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeAlias, TypeVar

from study.config.baselines import CEILING, SUPERVISED
from study.config.grid import Cell
from study.config.heads import HEAD_SETS, mask_heads
from study.config.keys import cell_key, drive_key, encoder_key, frames_key, recording_key
from study.config.paper import IMAGE
from study.config.settings import StudySettings

STEP_HZ = 10
VEHICLE_FRAMES_PER_S = 90_000.0  # simulated, on two cores
FRAMES_PER_S = 6_000.0  # chosen and rendered, on two cores
ENCODER_IMAGE_S = 1 / 2900  # an image forward and backward through the encoder
HEAD_IMAGE_S = 1 / 3700  # the same for each head
TEST_COST = 0.35  # an image evaluated, as a share of an image trained
ENCODED_PER_S = 6_000.0  # images encoded, on one core
POLICY_FRAME_S = 1 / 500_000  # a frame forward and backward through one policy, on two cores
SUPERVISED_EPOCHS = 20  # over the policy set, of the supervised baseline
DRIVE_READ_S = 0.12  # a drive read again for the true state
POLICY_STEP_S = 0.0015  # a step of one policy at the wheel, on two cores
DRIVEN = 0.4  # share of their time that drives last: most end early
RESULT_S = 5.0  # a result is assembled, exported and committed

STATE_BYTES = 32  # of one vehicle at one step in an Episode
RESULT_BYTES = 12_000_000  # weights, curves, samples and predictions of a cell, with its share of the tracking store


# --- what runs ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Work:
    """What a stage's key and cost follow from. The stages of the data need the settings alone."""

    settings: StudySettings
    cell: Cell = field(default_factory=lambda: Cell(heads=CEILING))
    policy_seeds: int = 0
    frames: str = ""  # key of the frame store


@dataclass(frozen=True)
class Stage:
    """One stage.

    `name` in curves and in MLflow; `activity` on the display; `unit` of progress; `key`: content key of the product;
    `cost`: expected seconds.
    """

    name: str
    activity: str
    unit: str
    key: Callable[[Work], str]
    cost: Callable[[Work], float]


@dataclass(frozen=True)
class Task:
    """One call that an engine runs somewhere: `function(*args)`.

    A function that is slow to import is given by its name, as "module:function". With `reports`, it gets a further
    argument `report`: call `report("progress", done, total)`, `report("log", epoch, metrics)` or
    `report("device", name)`. `weight`: the task's share of its stage, such as frames or policy seeds. With
    `accelerated` it runs on a GPU, where the engine has any.
    """

    stage: Stage
    function: Callable[..., Any] | str
    args: tuple[Any, ...]
    weight: int = 1
    reports: bool = False
    accelerated: bool = False


@dataclass(frozen=True)
class Batch:
    """Tasks of one stage that do not depend on each other.

    `before`: the weight of what was done earlier; `receive`: called with the number of a task and its result as soon as
    it is there, so that it can be kept while others run.
    """

    tasks: Sequence[Task]
    before: int = 0
    receive: Callable[[int, Any], None] = lambda *_: None


T = TypeVar("T")
# A sequence of stages: it yields a batch, is sent the results in the order of the tasks, and returns its product.
Flow: TypeAlias = Generator[Batch, list[Any], T]


# --- costs ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Cost:
    """Seconds on the reference machine, and bytes on disk."""

    seconds: float
    bytes: int


def _vehicle_frames(settings: StudySettings, seconds: float) -> float:
    """Return the states of vehicles in that many seconds of all drives."""
    drives = settings.recording.encoder_episodes + settings.recording.policy_episodes
    return drives * settings.town.vehicles * STEP_HZ * seconds


def _record_seconds(work: Work) -> float:
    recording = work.settings.recording
    return _vehicle_frames(work.settings, recording.warm_up + recording.duration) / VEHICLE_FRAMES_PER_S


def _render_seconds(work: Work) -> float:
    return (work.settings.frames.encoder + work.settings.frames.policy) / FRAMES_PER_S


def _encoder_seconds(work: Work) -> float:
    if work.cell.baseline:
        return 0.0
    frames, encoder = work.settings.frames, work.settings.encoder
    train = frames.encoder * (1 - frames.test_share)
    if encoder.budget == "epochs":
        train *= work.cell.fraction
    images = encoder.epochs * (train + TEST_COST * frames.encoder * frames.test_share)
    return images * (ENCODER_IMAGE_S + HEAD_IMAGE_S * len(HEAD_SETS[work.cell.heads].heads))


def _latents_seconds(work: Work) -> float:
    if work.cell.heads == CEILING:
        return work.settings.recording.policy_episodes * DRIVE_READ_S
    if work.cell.heads == SUPERVISED:
        return SUPERVISED_EPOCHS * work.settings.frames.policy * ENCODER_IMAGE_S
    return work.settings.frames.policy / ENCODED_PER_S


def _policy_seconds(work: Work) -> float:
    frames, policy = work.settings.frames, work.settings.policy
    shown = frames.policy * (frames.test_share + policy.share * (1 - frames.test_share))
    return work.policy_seeds * policy.epochs * shown * POLICY_FRAME_S


def _drive_seconds(work: Work) -> float:
    driving = work.settings.driving
    policies = min(work.policy_seeds, driving.baseline_policies) if work.cell.baseline else work.policy_seeds
    steps = (driving.drives + driving.unseen_towns) * driving.duration * STEP_HZ
    return policies * steps * DRIVEN * POLICY_STEP_S


def _cell_key(work: Work) -> str:
    return cell_key(work.settings, work.cell, work.policy_seeds, work.frames)


RECORD = Stage("record", "recording drives", "drive", lambda work: recording_key(work.settings), _record_seconds)
SELECT = Stage("select", "choosing frames", "drive", lambda work: frames_key(work.settings), lambda _: 0.0)
RENDER = Stage("render", "rendering frames", "frame", SELECT.key, _render_seconds)
DESCRIBE = Stage("describe", "describing the data", "card", RENDER.key, lambda _: 0.0)
ENCODER = Stage("encoder", "encoder", "step", lambda w: encoder_key(w.settings, w.cell, w.frames), _encoder_seconds)
LATENTS = Stage("latents", "encoding", "frame", ENCODER.key, _latents_seconds)
POLICY = Stage("policy", "policies", "epoch", _cell_key, _policy_seconds)
RESULT = Stage("result", "assembling the result", "cell", POLICY.key, lambda _: RESULT_S)
DRIVE = Stage("drive", "driving", "drive", lambda work: drive_key(work.settings, _cell_key(work)), _drive_seconds)

DATA_STAGES = (RECORD, SELECT, RENDER, DESCRIBE)
CELL_STAGES = (ENCODER, LATENTS, POLICY, RESULT)
STAGES = {stage.name: stage for stage in (*DATA_STAGES, *CELL_STAGES, DRIVE)}


def share_done(stages: Sequence[Stage], work: Work, stage: Stage, done: float) -> float:
    """Return the share of all these stages' expected time that is over when `done` of one stage, in [0, 1], is."""
    costs = {each.name: each.cost(work) for each in stages}
    before = sum(costs[each.name] for each in stages[: stages.index(stage)])
    return (before + costs[stage.name] * done) / (sum(costs.values()) or 1.0)


def recording_cost(settings: StudySettings) -> Cost:
    """Return the cost of recording the drives."""
    size_on_disk = _vehicle_frames(settings, settings.recording.duration) * STATE_BYTES
    return Cost(RECORD.cost(Work(settings)), int(size_on_disk))


def data_cost(settings: StudySettings, *, recorded: bool = True) -> Cost:
    """Return the cost of rendering the frames and, unless the drives exist already, of recording them."""
    images = settings.frames.encoder + settings.frames.policy
    frame_bytes = IMAGE * IMAGE * 3 + len(mask_heads()) * IMAGE * IMAGE // 8 + 40  # image, bit masks, labels
    rendering = Cost(RENDER.cost(Work(settings)), images * frame_bytes)
    return total([recording_cost(settings), rendering]) if recorded else rendering


def cell_cost(settings: StudySettings, cell: Cell, policy_seeds: int) -> Cost:
    """Return the cost of one cell: its encoder, unless it is a baseline, and its policies."""
    work = Work(settings, cell, policy_seeds)
    return Cost(sum(stage.cost(work) for stage in CELL_STAGES), RESULT_BYTES)


def total(costs: Iterable[Cost]) -> Cost:
    """Return the sum of some costs."""
    terms = list(costs)
    return Cost(sum(cost.seconds for cost in terms), sum(cost.bytes for cost in terms))


def duration_text(seconds: float) -> str:
    """Return a time for people, e.g. `7 s`, `12 min`, `3 h 05 min`."""
    if seconds < 100:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 100 else f"{minutes // 60} h {minutes % 60:02d} min"


def size_text(count: float) -> str:
    """Return a number of bytes for people, e.g. `310 MB`, `7.0 GB`."""
    return f"{count / 1e9:.1f} GB" if count >= 1e9 else f"{count / 1e6:.0f} MB"
