"""Settings of every stage, the paper's numbers with their section, and content keys.

Settings are frozen pydantic models. A profile (`sweeps/profiles/*.yaml`) names the values that differ from the
defaults here; a sweep file (`sweeps/*.yaml`) names a grid. Section numbers refer to arXiv 2003.00695.
"""

from __future__ import annotations

import hashlib
import itertools
import json
import math
import re
from pathlib import Path
from typing import Annotated, Any, Literal, Self, TypeVar

import yaml
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError, model_validator

# --- the paper's networks (Sec. IV-B, IV-C) -------------------------------------------------------------------------

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

HEADS: dict[str, int] = {"rec": 3, "pred": 1, "plan": 1}  # decoder head -> output channels
HEAD_SETS: dict[str, tuple[str, ...]] = {
    "rec": ("rec",),
    "rec+pred": ("rec", "pred"),
    "rec+plan": ("rec", "plan"),
    "full": ("rec", "pred", "plan"),
}
CEILING = "state"  # in the place of a head set: a cell without encoder, whose policies are given the true state


class BadInputError(Exception):
    """Something a user gave cannot be used. Commands print it and exit with code 2, without a traceback.

    The message says what is wrong, what was given, what is allowed and what to do next.
    """


class TrainingDivergedError(RuntimeError):
    """A loss became infinite or no number: the cell has failed, and trying again would not help."""


def one_of(what: str, got: object, allowed: object) -> BadInputError:
    """Error for a name that is not among the allowed ones."""
    names = ", ".join(str(name) for name in allowed)  # type: ignore[attr-defined]
    return BadInputError(f"unknown {what} '{got}'; choose from {names}")


def masked(text: str) -> str:
    """The text with the credentials of any URI in it hidden."""
    text = re.sub(r"(\w://)[^/@\s]*@", r"\1***@", text)
    return re.sub(r"(?i)\b(password=)[^&\s]+", r"\1***", text)


class Settings(BaseModel):
    """Frozen, and no setting that is not known."""

    model_config = ConfigDict(frozen=True, extra="forbid")


def _from_json(value: Any) -> Any:
    """Return a number of a JSON, or those of a mapping, as floats: null is NaN, "never" is infinity."""
    if isinstance(value, dict):
        return {name: _from_json(item) for name, item in value.items()}
    return math.nan if value is None else math.inf if value == "never" else value


FromJson = BeforeValidator(_from_json)
Number = Annotated[float, FromJson]
Model = TypeVar("Model", bound=BaseModel)
Share = Annotated[float, Field(ge=0, le=1)]
Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]
Count = Annotated[int, Field(ge=1)]


class TownSettings(Settings):
    """The simulated town and its traffic (Sec. IV-A; ours, in the place of CARLA's Town03)."""

    rows: Annotated[int, Field(ge=2)] = Field(5, description="rows of the street grid")
    columns: Annotated[int, Field(ge=2)] = Field(5, description="columns of the street grid")
    block: tuple[Positive, Positive] = Field((68.0, 92.0), description="shortest and longest block [m]")
    dropped_edges: Annotated[int, Field(ge=0)] = Field(3, description="streets left out of the full grid")
    two_lane_share: Share = Field(0.4, description="share of streets with two lanes each way")
    vehicles: Count = Field(100, description="vehicles in the town (Sec. IV-A: 100)")
    speed_limit: Positive = Field(40.0, description="the town's one speed limit [km/h]")
    road_limits: tuple[Positive, ...] = Field(
        (), description="limits to draw for each road [km/h]; empty: one limit everywhere. Drawn into the map layer"
    )
    green: Positive = Field(8.0, description="green of one phase: approaches across from each other together [s]")
    yellow: Positive = Field(1.5, description="yellow [s]")
    all_red: NotNegative = Field(1.0, description="all approaches red [s]")
    brake_hold: NotNegative = Field(
        0.5, description="a brake, once on, is held at least this long [s]; 0 is literal CARLA"
    )

    @model_validator(mode="after")
    def _block_in_order(self) -> Self:
        if self.block[0] > self.block[1]:
            raise ValueError(f"block: the shortest, {self.block[0]}, is longer than the longest, {self.block[1]}")
        return self


class RecordingSettings(Settings):
    """How long a drive is watched, and which drives. Each drive has its own town, drawn from its own seed."""

    warm_up: NotNegative = Field(10.0, description="driven before recording starts [s]")
    duration: Positive = Field(24.0, description="recorded [s], at 10 Hz")
    encoder_episodes: Annotated[int, Field(ge=2)] = Field(80, description="drives for the encoder set")
    policy_episodes: Annotated[int, Field(ge=2)] = Field(80, description="other drives, for the policy set (Sec. IV-A)")
    seed: Annotated[int, Field(ge=0)] = Field(0, description="seed of the first drive")


class BirdviewSettings(Settings):
    """What is painted (Sec. III-A)."""

    view: Positive = Field(40.0, description="side of the square field of view [m] (Sec. III-A)")
    behind: NotNegative = Field(15.0, description="of which lies behind the ego [m] (Sec. III-A: ego at 20 m, 15 m)")
    render: Annotated[int, Field(ge=IMAGE)] = Field(
        256, description="pixels a side before the area average to 64 (Sec. IV-A)"
    )
    history: Annotated[int, Field(ge=0)] = Field(10, description="past poses at 10 Hz (Sec. III-A)")
    future: Annotated[int, Field(ge=1)] = Field(10, description="next poses at 10 Hz in the pred and plan masks")
    light_range: Positive = Field(27.0, description="a light colours the route when its stop line is this near [m]")


class FramesSettings(Settings):
    """Which recorded moments become frames, and how they are split (Sec. IV-A, V; PAPER.md 2.7 to 2.9)."""

    encoder: Annotated[int, Field(ge=10)] = Field(25_000, description="frames of the encoder set, train and test")
    policy: Annotated[int, Field(ge=10)] = Field(
        12_500, description="frames of the balanced policy set, train and test"
    )
    test_share: Annotated[float, Field(gt=0, lt=1)] = Field(0.2, description="share of test frames (Sec. V)")
    split: Literal["episode", "frame"] = Field("episode", description="split whole drives, or frames (literal)")
    unit: Literal["frame", "drive"] = Field("frame", description="data fractions of frames (literal) or of drives")
    spacing: Positive = Field(1.0, description="least time between two frames of one vehicle [s]")
    standing_weight: Share = Field(0.3, description="chance that a standing moment is kept for the encoder set")
    balance: Literal["all", "steering", "none"] = Field("all", description="what the policy set is raked to")
    near_zero: Share = Field(0.4, description="policy set: share of steering labels within 0.01 of zero")
    standing: Share = Field(0.08, description="policy set: share of standing vehicles")
    weight_cap: Positive = Field(20.0, description="largest raking weight, in multiples of the mean weight")
    seed: Annotated[int, Field(ge=0)] = Field(0, description="seed of the choice of frames and of the split")


class EncoderSettings(Settings):
    """Training of an encoder with its heads (Sec. III-B, IV-B)."""

    epochs: Count = Field(15, description="epochs (Sec. IV-B: 200)")
    batch: Annotated[int, Field(ge=2)] = Field(128, description="batch size (Sec. IV-B: 2048)")
    lr: Positive = Field(2e-3, description="Adam's learning rate (Sec. IV-B: '5^{-3}', read as 5e-3)")
    beta: NotNegative = Field(0.0, description="weight of the KL term; above 0 the autoencoder is variational")
    head_weights: dict[str, NotNegative] = Field(
        default_factory=lambda: dict.fromkeys(HEADS, 1.0), description="weight of each head's loss (plain sum: 1)"
    )
    budget: Literal["epochs", "steps"] = Field(
        "epochs", description="at a smaller fraction: same epochs (literal) or same steps"
    )
    precision: Literal["auto", "fp32", "bf16"] = Field(
        "auto", description="auto: bf16 autocast where the hardware multiplies bf16 matrices, else fp32"
    )

    @model_validator(mode="after")
    def _known_heads(self) -> Self:
        for head in self.head_weights:
            if head not in HEADS:
                raise ValueError(f"head_weights: unknown head '{head}'; choose from {', '.join(HEADS)}")
        return self


class PolicySettings(Settings):
    """Training of the policies on a frozen encoder's latents (Sec. III-B.3, IV-C)."""

    epochs: Annotated[int, Field(ge=5)] = Field(100, description="epochs (Sec. IV-C: 100)")
    batch: Annotated[int, Field(ge=2)] = Field(512, description="batch size (Sec. IV-C: 2048)")
    lr: Positive = Field(5e-4, description="Adam's learning rate (Sec. IV-C: '5^{-4}', read as 5e-4)")
    normalise: Literal["zscore", "l2", "none"] = Field("zscore", description="how z is normalised (Sec. IV-C)")


class StudySettings(Settings):
    """Every setting of every stage; a profile is one of these."""

    town: TownSettings = TownSettings()
    recording: RecordingSettings = RecordingSettings()
    birdview: BirdviewSettings = BirdviewSettings()
    frames: FramesSettings = FramesSettings()
    encoder: EncoderSettings = EncoderSettings()
    policy: PolicySettings = PolicySettings()


Fraction = Annotated[float, Field(gt=0, le=1)]


class Rules(Settings):
    """When a claim counts as reproduced, decided before the run (PAPER.md section 3; used by `study.claims`).

    A sweep file gives each rule a number, or one for each profile: `{smoke: 0.1, laptop: 0.015}`; a profile that is not
    named takes the largest.

    Three of them stand for what a study of one encoder a cell cannot see; a run of several (`heads-encoders`) checks
    them. With s the sd over encoders of one head set (the report's variance components, pooled over head sets), two
    encoders differ by sqrt(2) s, and the largest of a claim's three contrasts by up to 3.4 s at 0.05 (of one: 2.8 s).
    So `encoder_allowance` should be at least 3.4 s of final accuracy, 3.4 s of final steering loss should be well below
    `steering_margin`, and `spread_factor` at least exp(3.4 s) with s that of the log of the variance over P policies,
    whose square is smaller than what is found by 2 / (P - 1), the part of chance: this needs P = 10 or more.
    What was found is in benchmarks/README.md.
    """

    alpha: Annotated[float, Field(gt=0, lt=0.5)] = Field(0.05, description="error rate of a claim's contrasts together")
    accuracy_margin: NotNegative = Field(0.005, description="smallest difference in accuracy that matters")
    encoder_allowance: NotNegative = Field(
        0.015,
        description="what two encoders may differ in accuracy by their seeds alone; added to both ends of an interval "
        "when there is one encoder for each cell",
    )
    steering_margin: NotNegative = Field(
        0.05, description="largest difference in steering loss that is none, as a share of the best constant's loss"
    )
    reach_slack: Share = Field(0.1, description="how much later than the text says, as a share of all epochs")
    spread_factor: Annotated[float, Field(ge=1)] = Field(
        1.5,
        description="what two encoders may differ in the variance of their policies, with one encoder for each cell",
    )


class Grid(Settings):
    """A sweep file: the cells of a study and what is read off them."""

    name: str
    title: str = Field(description="headline of the report")
    heads: Annotated[tuple[str, ...], Field(min_length=1)] = Field(description="head sets")
    fractions: Annotated[tuple[Fraction, ...], Field(min_length=1)] = Field(
        (1.0,), description="data fractions in (0, 1] (Sec. V-B)"
    )
    encoder_seeds: Count = Field(1, description="encoders for each head set and fraction")
    policy_seeds: Count = Field(15, description="policies on each encoder (Sec. V-A: 15)")
    baseline: str = Field("rec", description="head set that the others are compared with")
    ceiling: bool = Field(default=True, description="one more cell: policies on the true state, as a ceiling")
    claims: tuple[str, ...] = Field((), description="claims of the paper that this sweep tests")
    rules: Rules = Field(Rules(), description="when a claim counts as reproduced")
    settings: dict[str, Any] = Field(default_factory=dict, description="settings that differ from every profile's")

    @model_validator(mode="after")
    def _known(self) -> Self:
        for heads in (*self.heads, self.baseline):
            if heads not in HEAD_SETS:
                raise ValueError(f"unknown head set '{heads}'; choose from {', '.join(HEAD_SETS)}")
        for name in ("heads", "fractions"):
            values = getattr(self, name)
            if len(set(values)) != len(values):
                raise ValueError(f"{name}: {list(values)} names one twice")
        return self

    def cells(self) -> list[Cell]:
        """The cells in the order they are worth running: one encoder seed of everything first, the ceiling last."""
        return [
            *(
                Cell(heads=heads, fraction=fraction, encoder_seed=seed)
                for seed in range(self.encoder_seeds)
                for fraction in self.fractions
                for heads in self.heads
            ),
            *[Cell(heads=CEILING)] * self.ceiling,
        ]


class Cell(Settings):
    """One point of the grid: an encoder, and the policies on it."""

    heads: str
    fraction: Fraction = 1.0
    encoder_seed: Annotated[int, Field(ge=0)] = 0

    @property
    def label(self) -> str:
        """Name for people, e.g. `rec+plan 100% e0`."""
        if self.heads == CEILING:
            return f"{CEILING} (ceiling)"
        return f"{self.heads} {self.fraction * 100:g}% e{self.encoder_seed}"


# --- keys -----------------------------------------------------------------------------------------------------------


def content_key(stage: str, settings: object, inputs: tuple[str, ...], format_version: int) -> str:
    """Key of a stage's product: 16 hex digits of sha256 over the canonical JSON of all that it is made from."""
    plain = settings.model_dump(mode="json") if isinstance(settings, BaseModel) else settings
    text = json.dumps(
        {"stage": stage, "settings": plain, "inputs": inputs, "format_version": format_version},
        sort_keys=True,
        separators=(",", ":"),
        allow_nan=False,
    )
    return hashlib.sha256(text.encode()).hexdigest()[:16]


# Raised on purpose when a stage's code changes what it makes; a test holds each product's digest.
FORMAT_VERSIONS = {"episodes": 1, "frames": 1, "encoder": 1, "state": 1, "cell": 1}


def recording_key(settings: StudySettings) -> str:
    """Key of the drives: each is then known by its seed. How many there are does not matter here."""
    own = {
        "town": settings.town.model_dump(mode="json"),
        "warm_up": settings.recording.warm_up,
        "duration": settings.recording.duration,
    }
    return content_key("episodes", own, (), FORMAT_VERSIONS["episodes"])


def drive_name(seed: int) -> str:
    """Name of the drive of that seed, in the folder of its recording key."""
    return f"{seed:08d}"


def frames_key(settings: StudySettings, source: str | None = None) -> str:
    """Key of the frame store; `source` stands for the drives when they are not our town's."""
    own = {
        "frames": settings.frames.model_dump(mode="json", exclude={"unit"}),  # says how a store is used
        "birdview": settings.birdview.model_dump(mode="json"),
    }
    if source is None:
        own["drives"] = settings.recording.model_dump(
            mode="json", include={"encoder_episodes", "policy_episodes", "seed"}
        )
    return content_key("frames", own, (source or recording_key(settings),), FORMAT_VERSIONS["frames"])


def encoder_key(settings: StudySettings, cell: Cell, frames: str) -> str:
    """Key of a trained encoder. What makes no difference at the full data is left out there."""
    if cell.heads == CEILING:
        return content_key("state", {}, (frames,), FORMAT_VERSIONS["state"])
    own: dict[str, Any] = {
        "encoder": settings.encoder.model_dump(mode="json", exclude={"budget", "head_weights"}),
        "heads": {head: settings.encoder.head_weights.get(head, 1.0) for head in HEAD_SETS[cell.heads]},
        "fraction": cell.fraction,
        "encoder_seed": cell.encoder_seed,
    }
    if cell.fraction < 1:
        own |= {"budget": settings.encoder.budget, "unit": settings.frames.unit}
    return content_key("encoder", own, (frames,), FORMAT_VERSIONS["encoder"])


def cell_key(settings: StudySettings, cell: Cell, policy_seeds: int, frames: str) -> str:
    """Key of a cell's result: its encoder and the policies on it."""
    own = {"policy": settings.policy.model_dump(mode="json"), "policy_seeds": policy_seeds}
    return content_key("cell", own, (encoder_key(settings, cell, frames),), FORMAT_VERSIONS["cell"])


# --- learnable numbers ----------------------------------------------------------------------------------------------


def parameter_counts() -> dict[str, int]:
    """Learnable numbers of the encoder and of each head, biases and BatchNorm's affine included (Sec. IV-B)."""
    area, core = KERNEL * KERNEL, CHANNELS[-1] * CORE * CORE
    convolutions = zip((3, *CHANNELS[:-1]), CHANNELS, strict=True)
    encoder = sum(i * o * area + o + 2 * o for i, o in convolutions) + core * LATENT + LATENT
    counts = {"encoder": encoder}
    widths = CHANNELS[::-1]
    for head, channels in HEADS.items():
        fully_connected = LATENT * core + core + 2 * core
        hidden = sum(i * o * area + o + 2 * o for i, o in itertools.pairwise(widths))
        counts[head] = fully_connected + hidden + widths[-1] * channels * area + channels
    return counts


# --- files ----------------------------------------------------------------------------------------------------------

SWEEPS = Path("sweeps")
DEFAULT_TRACKING = "sqlite:///mlruns/mlflow.db"


def read_yaml(path: Path) -> dict[str, Any]:
    """A YAML file's mapping. Raises BadInputError when it is missing, broken or no mapping."""
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise BadInputError(f"cannot read {path}: {error.strerror}") from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        where = getattr(error, "problem_mark", None)
        line = f", line {where.line + 1}" if where else ""
        raise BadInputError(f"{path}{line} is not valid YAML: {getattr(error, 'problem', error)}") from error
    if not isinstance(content, dict):
        raise BadInputError(f"{path} holds no settings (a mapping such as 'encoder: {{epochs: 15}}' is needed)")
    return content


def named_files(folder: Path) -> dict[str, Path]:
    """Name -> path of the YAML files in a folder, by name."""
    return {path.stem: path for path in sorted(folder.glob("*.yaml"), key=lambda path: path.stem)}


def explain(error: ValidationError, source: str) -> BadInputError:
    """The clear form of pydantic's complaint."""
    lines: list[str] = []
    for item in error.errors(include_url=False):
        if item["type"] == "too_short" and lines:  # follows from the error inside, which is told already
            continue
        where = ".".join(str(part) for part in item["loc"])
        if item["type"] == "extra_forbidden":
            lines.append(f"unknown setting '{where}'")
            continue
        message = item["msg"].removeprefix("Value error, ")
        got = "" if isinstance(item["input"], dict) else f" (got {item['input']!r})"
        lines.append(f"{where}: {message}{got}" if where else message)
    return BadInputError(f"{source}: " + "; ".join(lines))


def validated(model: type[Model], content: object, source: str) -> Model:
    """The content as that model. Raises BadInputError that names the source and every field that is wrong."""
    try:
        return model.model_validate(content)
    except ValidationError as error:
        raise explain(error, source) from error


def merge(base: dict[str, Any], over: dict[str, Any]) -> dict[str, Any]:
    """`base` with the values of `over`, nested mappings merged."""
    merged = dict(base)
    for name, value in over.items():
        below = merged.get(name)
        merged[name] = merge(below, value) if isinstance(value, dict) and isinstance(below, dict) else value
    return merged


def load_grid(
    name: str, overrides: dict[str, Any] | None = None, folder: Path = SWEEPS, profile: str = "laptop"
) -> Grid:
    """The sweep of that name, with that profile's rules. Raises BadInputError for an unknown sweep or setting."""
    files = named_files(folder)
    if name not in files:
        raise one_of("sweep", name, files or [f"nothing: there are no sweep files in {folder.absolute()}"])
    content = merge(read_yaml(files[name]), overrides or {}) | {"name": name}
    if isinstance(content.get("rules"), dict):
        content["rules"] = {rule: _of_profile(value, profile) for rule, value in content["rules"].items()}
    return validated(Grid, content, f"sweep {name}")


def _of_profile(value: object, profile: str) -> object:
    """A rule's number for a profile; what cannot be chosen from stays, for the check to name it."""
    if not isinstance(value, dict):
        return value
    numbers = [each for each in value.values() if isinstance(each, int | float)]
    return value.get(profile, max(numbers)) if len(numbers) == len(value) > 0 else value


def load_profile(name: str, overrides: dict[str, Any] | None = None, folder: Path = SWEEPS) -> StudySettings:
    """The profile of that name. Raises BadInputError for an unknown profile or setting."""
    files = named_files(folder / "profiles")
    if name not in files:
        raise one_of("profile", name, files)
    return validated(StudySettings, merge(read_yaml(files[name]), overrides or {}), f"profile {name}")
