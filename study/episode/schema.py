"""The Episode: one recorded drive of everything on a piece of map. Open format, schema versions 1 and 1.1.

An Episode is a folder of four files. Right-handed coordinates: x east, y north [m], heading anticlockwise from x [rad].

`episode.json`
    schema_version  1, or 1.1 where agents have classes; where all are vehicles we write 1, the same bytes as before
    id              the folder's name for people
    source          {"writer": ..., ...}: what wrote it, free keys; "recording": name of what this drive was cut from,
                    if from a longer one: such drives share vehicles, and stay in one set
    rate_hz         steps per second
    steps           number of steps T; step k is at k / rate_hz seconds
    labels          "recorded", "derived" (commands estimated from the motion) or "none"
    agents          [{"id", "length", "width", "ego", "class"}]: metres; ego: may serve as the ego vehicle; class, in
                    1.1 only: "vehicle" (the default), "cyclist" or "pedestrian"; ego defaults to true for vehicles,
                    to false for the others
    digests         {file name: sha256} of the other three files
`map.json`
    lanes           [{"id", "centre": [[x, y], ...], "width", "left", "right", "junction", "speed_limit"}]
                    centre in driving direction; left, right: "none", "dashed", "solid" or "curb"; limit [m/s] or null;
                    of points [x, y, height] the height is left out
    lights          [{"id", "stop_line": [[x, y], [x, y]], "lane"}]: lane is the id of the governed lane or null
`states.parquet`    one row for each agent at each step at which it exists, in any order (we write: step, then agent)
    step, agent     int32
    x, y            float32 [m], centre of the agent's box (keep |x|, |y| below 10 km: shift the origin)
    heading         float32 [rad]
    speed           float32 [m/s], negative when reversing
    steering        float32, angle of the front wheels over 1.22 rad, -1 to 1, positive to the left, null where unknown
    acceleration    float32, one of -1, 0.5, 1, null where unknown
    light           int32, id of the next light on the agent's route, -1 where none
    light_distance  float32 [m] along the route to its stop line, null where none
    route_s         float32 [m], progress along the agent's route, null where unknown
    lead_gap        float32 [m], free way ahead on the planned route, null where unknown or free
`lights.parquet`    step int32, light int32, state int8: 0 green, 1 yellow, 2 red; every light at every step
`routes.parquet`    agent int32, x float32, y float32: each agent's planned way as a polyline, in driving order

Optional are the last six columns of `states.parquet`, and any rows in `lights.parquet` and `routes.parquet`.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

SCHEMA_VERSION, WITH_CLASSES = 1, 1.1
RATE_HZ = 10.0  # of history and future (Sec. III-A)
GREEN, YELLOW, RED = 0, 1, 2
LABELS = ("recorded", "derived", "none")
OPTIONAL_FLOATS = ("steering", "acceleration", "light_distance", "route_s", "lead_gap")
VEHICLE, CYCLIST, PEDESTRIAN = CLASSES = ("vehicle", "cyclist", "pedestrian")
BORDERS = ("none", "dashed", "solid", "curb")

FloatTA = NDArray[np.float32]


@dataclass(frozen=True)
class Lane:
    """One lane of the map; `centre` is [P, 2] float [m] in driving direction, `speed_limit` in m/s."""

    id: int
    centre: NDArray[np.float64]
    width: float
    left: str = "none"
    right: str = "none"
    junction: bool = False
    speed_limit: float | None = None


@dataclass(frozen=True)
class Light:
    """One traffic light; `stop_line` is [2, 2] float [m]."""

    id: int
    stop_line: NDArray[np.float64]
    lane: int | None = None


@dataclass(frozen=True)
class Agent:
    """One agent's size [m] and class; `ego` says whether it may serve as the ego, by default only a vehicle."""

    id: int
    length: float
    width: float
    ego: bool = None  # type: ignore[assignment]  # until the class is known
    kind: str = VEHICLE

    def __post_init__(self) -> None:
        """Fill in `ego`."""
        if self.ego not in (True, False):
            object.__setattr__(self, "ego", self.kind == VEHICLE)


@dataclass(frozen=True)
class Episode:
    """One recorded drive, dense in memory: T steps, A agents, L lights; where `present` is false, values mean nothing.

    `x`, `y`, `heading`, `speed`, `steering`, `acceleration`, `light_distance`, `route_s`, `lead_gap`: [T, A] float32,
    NaN where unknown. `light`: [T, A] int32, an index into `lights`, -1 for none. `light_state`: [T, L] uint8.
    `routes`: for each agent a polyline [P, 2] float32 [m], empty where there is none. Columns follow `agents`.
    """

    id: str
    source: dict[str, Any]
    rate_hz: float
    labels: str
    agents: tuple[Agent, ...]
    lanes: tuple[Lane, ...]
    lights: tuple[Light, ...]
    present: NDArray[np.bool_]
    x: FloatTA
    y: FloatTA
    heading: FloatTA
    speed: FloatTA
    steering: FloatTA
    acceleration: FloatTA
    light: NDArray[np.int32]
    light_distance: FloatTA
    route_s: FloatTA
    lead_gap: FloatTA
    light_state: NDArray[np.uint8]
    routes: tuple[NDArray[np.float32], ...]
    digest: str = field(default="", compare=False)  # over the four files, known once written or read

    @property
    def steps(self) -> int:
        """Return T, the number of steps."""
        return len(self.present)


def empty_states(steps: int, agents: int) -> dict[str, Any]:
    """Return arrays [T, A] of an Episode in which nothing is known and no agent is present, for a writer to fill."""
    names = ("x", "y", "heading", "speed", *OPTIONAL_FLOATS)
    arrays: dict[str, Any] = {name: np.full((steps, agents), np.nan, np.float32) for name in names}
    return arrays | {"present": np.zeros((steps, agents), bool), "light": np.full((steps, agents), -1, np.int32)}
