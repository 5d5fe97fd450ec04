"""Settings of every stage, the paper's numbers with their section, and content keys.

Settings are frozen pydantic models. A profile (`sweeps/profiles/*.yaml`) names the values that differ from the
defaults here; a sweep file (`sweeps/*.yaml`) names a grid. Section numbers refer to arXiv 2003.00695.
"""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal, Self, TypeVar

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, model_validator

from study.config.heads import HEADS
from study.config.paper import IMAGE, LATENT


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
SPEEDS = 10  # past speeds that a policy may be given: now and 0.1 s to 0.9 s ago


class TownSettings(Settings):
    """The simulated town and its traffic (Sec. IV-A; ours, in the place of CARLA's Town03)."""

    rows: Annotated[int, Field(ge=2)] = Field(5, description="rows of the street grid")
    columns: Annotated[int, Field(ge=2)] = Field(5, description="columns of the street grid")
    block: tuple[Positive, Positive] = Field((68.0, 92.0), description="shortest and longest block [m]")
    dropped_edges: Annotated[int, Field(ge=0)] = Field(3, description="streets left out of the full grid")
    two_lane_share: Share = Field(0.4, description="share of streets with two lanes each way")
    vehicles: Count = Field(100, description="vehicles in the town (Sec. IV-A: 100)")
    speed_limit: Positive = Field(40.0, description="the one speed limit of a town without road_limits [km/h]")
    road_limits: tuple[Positive, ...] = Field(
        (20.0, 30.0, 40.0),
        description="limits to draw for each road [km/h]; empty: speed_limit everywhere. The map layer shows them",
    )
    green: Positive = Field(8.0, description="green of one phase: approaches across from each other together [s]")
    yellow: Positive = Field(1.5, description="yellow [s]")
    all_red: NotNegative = Field(1.0, description="all approaches red [s]")
    brake_hold: NotNegative = Field(
        0.2, description="a brake, once on, is held at least this long [s]; 0 is literal CARLA"
    )
    per_drive: bool = Field(
        default=False,
        description="a new town for every drive; else one for all, drawn from recording.seed (literal)",
    )
    traffic: Literal["right", "left"] = Field(
        "right",
        description="side of the road on which vehicles drive; left is the mirror image of the same town",
        exclude_if=lambda side: side == "right",  # what was made before the setting keeps its key and its bytes
    )
    pedestrians: Annotated[int, Field(ge=0)] = Field(
        0,
        description="pedestrians, who walk along kerbs and cross arms of junctions while their light is red",
        exclude_if=lambda count: count == 0,  # what was made before the setting keeps its key and its bytes
    )

    @model_validator(mode="after")
    def _block_in_order(self) -> Self:
        if self.block[0] > self.block[1]:
            raise ValueError(f"block: the shortest, {self.block[0]}, is longer than the longest, {self.block[1]}")
        return self


class DynamicsSettings(Settings):
    """How vehicles answer commands (ours, in the place of CARLA's engine, gear, tyres and steering)."""

    lag: NotNegative = Field(
        0.0, description="time constant with which the acceleration follows its command [s]; 0: at once"
    )
    wheel_lag: NotNegative = Field(
        0.0, description="time constant with which the wheel angle follows its command [s]; 0: at once"
    )
    steering_unit: Positive = Field(
        1.22, description="wheel angle of a steering label of 1 [rad] (CARLA: its largest, 70 degrees)"
    )


class RecordingSettings(Settings):
    """How long a drive is watched, and which drives. Traffic and lights of each drive are drawn from its own seed."""

    warm_up: NotNegative = Field(10.0, description="driven before recording starts [s]")
    duration: Positive = Field(24.0, description="recorded [s], at 10 Hz")
    encoder_episodes: Annotated[int, Field(ge=2)] = Field(80, description="drives for the encoder set")
    policy_episodes: Annotated[int, Field(ge=2)] = Field(80, description="other drives, for the policy set (Sec. IV-A)")
    seed: Annotated[int, Field(ge=0)] = Field(0, description="seed of the first drive, and of the one town")


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
    """Which recorded moments become frames, and how they are split (Sec. IV-A, V; docs/paper.md)."""

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
    loss: Literal["sum", "mean"] = Field(
        "sum", description="a head's loss: sum over its image's numbers (literal), or their mean, averaged over a batch"
    )
    head_weights: dict[str, NotNegative] = Field(
        default_factory=lambda: dict.fromkeys(HEADS, 1.0), description="further weight of each head's loss (paper: 1)"
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
    inputs: Literal["z", "z+speed"] = Field(
        "z", description="z+speed: beside z, the true speeds of the past second, 0.1 s apart (a control)"
    )
    share: Annotated[float, Field(gt=0, le=1)] = Field(
        1.0, description="share of the policy set's training frames that policies learn from; nested random subsets"
    )

    @property
    def width(self) -> int:
        """Return how many numbers a policy is given."""
        return LATENT + (SPEEDS if self.inputs == "z+speed" else 0)


class DrivingSettings(Settings):
    """Drives of policies in closed loop, in traffic that neither set holds (ours; the paper has none)."""

    drives: Count = Field(20, description="held-out drives of each policy in the study's town")
    unseen_towns: Annotated[int, Field(ge=0)] = Field(
        5, description="held-out drives of each policy in other towns, each in one of its own"
    )
    duration: Positive = Field(60.0, description="length of a drive, unless something ends it [s]")
    crop: Positive = Field(
        0.42, description="steering is cropped to plus or minus this; at Sec. IV-C's 0.25 the expert misses right turns"
    )
    baseline_policies: Count = Field(5, description="policies of each baseline that drive")


class StudySettings(Settings):
    """Every setting of every stage; a profile is one of these."""

    town: TownSettings = TownSettings()
    dynamics: DynamicsSettings = DynamicsSettings()
    recording: RecordingSettings = RecordingSettings()
    birdview: BirdviewSettings = BirdviewSettings()
    frames: FramesSettings = FramesSettings()
    encoder: EncoderSettings = EncoderSettings()
    policy: PolicySettings = PolicySettings()
    driving: DrivingSettings = DrivingSettings()
