"""The Episode: one recorded drive of everything on a piece of map. Open format, schema version 1.

An Episode is a folder of four files. Right-handed coordinates: x east, y north [m], heading anticlockwise from x [rad].

`episode.json`
    schema_version  1
    id              the folder's name for people
    source          {"writer": ..., ...}: what wrote it, free keys
    rate_hz         steps per second
    steps           number of steps T; step k is at k / rate_hz seconds
    labels          "recorded", "derived" (commands estimated from the motion) or "none"
    agents          [{"id", "length", "width", "ego"}]: metres; ego: may serve as the ego vehicle
    digests         {file name: sha256} of the other three files
`map.json`
    lanes           [{"id", "centre": [[x, y], ...], "width", "left", "right", "junction", "speed_limit"}]
                    centre in driving direction; left, right: "none", "dashed", "solid" or "curb"; limit [m/s] or null
    lights          [{"id", "stop_line": [[x, y], [x, y]], "lane"}]: lane is the id of the governed lane or null
`states.parquet`    one row for each agent at each step at which it exists, sorted by step, then agent
    step, agent     int32
    x, y            float32 [m], centre of the agent's box (keep |x|, |y| below 10 km: shift the origin)
    heading         float32 [rad]
    speed           float32 [m/s]
    steering        float32, positive to the left, null where unknown
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

import hashlib
import json
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from study.atomic import atomic_folder
from study.config import ACCELERATIONS, BadInputError

SCHEMA_VERSION = 1
GREEN, YELLOW, RED = 0, 1, 2
BORDERS = ("none", "dashed", "solid", "curb")
LABELS = ("recorded", "derived", "none")
FILES = ("map.json", "states.parquet", "lights.parquet", "routes.parquet")
REACH = 10_000.0  # [m] within which float32 keeps the millimetre

FloatTA = NDArray[np.float32]

_REQUIRED = {"step": pa.int32(), "agent": pa.int32()} | dict.fromkeys(("x", "y", "heading", "speed"), pa.float32())
_OPTIONAL_FLOATS = ("steering", "acceleration", "light_distance", "route_s", "lead_gap")
_STATES = pa.schema(
    [(name, kind) for name, kind in _REQUIRED.items()]
    + [("steering", pa.float32()), ("acceleration", pa.float32()), ("light", pa.int32())]
    + [("light_distance", pa.float32()), ("route_s", pa.float32()), ("lead_gap", pa.float32())]
)
_LIGHTS = pa.schema([("step", pa.int32()), ("light", pa.int32()), ("state", pa.int8())])
_ROUTES = pa.schema([("agent", pa.int32()), ("x", pa.float32()), ("y", pa.float32())])


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
    """One vehicle's size [m]; `ego` says whether it may serve as the ego vehicle."""

    id: int
    length: float
    width: float
    ego: bool = True


@dataclass(frozen=True)
class Episode:
    """One recorded drive, dense in memory: T steps, A agents, L lights; values where `present` is false mean nothing.

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
        """T, the number of steps."""
        return len(self.present)


def empty_states(steps: int, agents: int) -> dict[str, Any]:
    """Arrays [T, A] of an Episode in which nothing is known and nobody is present, to be filled by a writer."""
    names = ("x", "y", "heading", "speed", *_OPTIONAL_FLOATS)
    arrays: dict[str, Any] = {name: np.full((steps, agents), np.nan, np.float32) for name in names}
    return arrays | {"present": np.zeros((steps, agents), bool), "light": np.full((steps, agents), -1, np.int32)}


# --- writing --------------------------------------------------------------------------------------------------------


def write_episode(episode: Episode, folder: Path) -> str:
    """Write the Episode as `folder`, whole or not at all, and return its digest.

    An existing `folder` is replaced. Raises BadInputError when the Episode breaks its own schema.
    """
    check_episode(episode, str(folder))
    with atomic_folder(folder) as draft:
        (draft / "map.json").write_text(json.dumps(_map_json(episode), separators=(",", ":"), allow_nan=False))
        for file, table in _tables(episode).items():
            pq.write_table(table, draft / file, compression="zstd", compression_level=3)
        digests = {file: file_digest(draft / file) for file in FILES}
        head = {
            "schema_version": SCHEMA_VERSION,
            "id": episode.id,
            "source": episode.source,
            "rate_hz": episode.rate_hz,
            "steps": episode.steps,
            "labels": episode.labels,
            "agents": [
                {"id": agent.id, "length": agent.length, "width": agent.width, "ego": agent.ego}
                for agent in episode.agents
            ],
            "digests": digests,
        }
        (draft / "episode.json").write_text(json.dumps(head, indent=1, allow_nan=False))
    return _digest(digests)


def _map_json(episode: Episode) -> dict[str, Any]:
    lanes = [
        {
            "id": lane.id,
            "centre": np.round(lane.centre, 4).tolist(),
            "width": lane.width,
            "left": lane.left,
            "right": lane.right,
            "junction": lane.junction,
            "speed_limit": lane.speed_limit,
        }
        for lane in episode.lanes
    ]
    lights = [
        {"id": light.id, "stop_line": np.round(light.stop_line, 4).tolist(), "lane": light.lane}
        for light in episode.lights
    ]
    return {"lanes": lanes, "lights": lights}


def _tables(episode: Episode) -> dict[str, pa.Table]:
    rows = np.nonzero(episode.present)
    ids = np.array([agent.id for agent in episode.agents], np.int32)
    light_ids = np.array([*(light.id for light in episode.lights), -1], np.int32)  # index -1 stays -1
    columns: dict[str, Any] = {"step": rows[0].astype(np.int32), "agent": ids[rows[1]]}
    for name in _STATES.names[2:]:
        values = getattr(episode, name)[rows]
        columns[name] = light_ids[values] if name == "light" else pa.array(values, from_pandas=True)
    lights = len(episode.lights)
    return {
        "states.parquet": pa.table(columns, schema=_STATES),
        "lights.parquet": pa.table(
            {
                "step": np.repeat(np.arange(episode.steps, dtype=np.int32), lights),
                "light": np.tile(light_ids[:-1], episode.steps),
                "state": episode.light_state.reshape(-1).astype(np.int8),
            },
            schema=_LIGHTS,
        ),
        "routes.parquet": pa.table(
            {
                "agent": np.repeat(ids, [len(route) for route in episode.routes]),
                "x": np.concatenate([*(route[:, 0] for route in episode.routes), np.empty(0, np.float32)]),
                "y": np.concatenate([*(route[:, 1] for route in episode.routes), np.empty(0, np.float32)]),
            },
            schema=_ROUTES,
        ),
    }


def file_digest(path: Path) -> str:
    """Hex sha256 of a file's bytes."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def _digest(digests: dict[str, str]) -> str:
    return hashlib.sha256(json.dumps(digests, sort_keys=True).encode()).hexdigest()


# --- reading --------------------------------------------------------------------------------------------------------


def read_episode(folder: Path) -> Episode:
    """Read and check an Episode. Raises BadInputError, with file, row and field, for anything that is not schema 1."""
    head = _json(folder / "episode.json")
    version = head.get("schema_version")
    if version != SCHEMA_VERSION:
        raise BadInputError(
            f"{folder / 'episode.json'}: schema_version is {version!r}; this program reads {SCHEMA_VERSION}"
        )
    digests = _field(head, "digests", dict, folder / "episode.json")
    for file in FILES:
        path = folder / file
        if not path.is_file():
            raise BadInputError(f"{path} is missing: the Episode is not whole; record or copy it again")
        if digests.get(file) != file_digest(path):
            raise BadInputError(f"{path} does not match its digest in episode.json: truncated or changed; get it again")
    try:
        episode = _assemble(folder, head, digests)
    except (KeyError, TypeError, ValueError, IndexError, pa.ArrowException) as error:
        raise BadInputError(f"{folder} is no Episode of schema {SCHEMA_VERSION}: {error!r}") from error
    check_episode(episode, str(folder))
    return episode


def episode_digest(folder: Path) -> str:
    """Digest of an Episode from its head alone, the same as `read_episode` gives. Raises BadInputError for no head."""
    path = folder / "episode.json"
    return _digest(_field(_json(path), "digests", dict, path))


def _json(path: Path) -> dict[str, Any]:
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise BadInputError(f"cannot read {path}: {error.strerror}; is {path.parent} an Episode?") from error
    except ValueError as error:
        raise BadInputError(f"{path} is not valid JSON ({error}): truncated or foreign") from error
    if not isinstance(content, dict):
        raise BadInputError(f"{path} holds {type(content).__name__}, not a JSON object")
    return content


def _field(content: dict[str, Any], name: str, kind: type | tuple[type, ...], path: Path) -> Any:  # noqa: ANN401
    value = content.get(name)
    if not isinstance(value, kind) or isinstance(value, bool) != (kind is bool):
        raise BadInputError(f"{path}: field '{name}' is {value!r}, which is not what schema {SCHEMA_VERSION} asks for")
    return value


def _assemble(folder: Path, head: dict[str, Any], digests: dict[str, str]) -> Episode:
    path = folder / "episode.json"
    steps = int(_field(head, "steps", int, path))
    agents = tuple(
        Agent(int(row["id"]), float(row["length"]), float(row["width"]), bool(row.get("ego", True)))
        for row in _field(head, "agents", list, path)
    )
    chart = _json(folder / "map.json")
    lanes = tuple(
        Lane(
            int(row["id"]),
            np.asarray(row["centre"], np.float64).reshape(-1, 2),
            float(row["width"]),
            row.get("left", "none"),
            row.get("right", "none"),
            bool(row.get("junction", False)),
            None if row.get("speed_limit") is None else float(row["speed_limit"]),
        )
        for row in _field(chart, "lanes", list, folder / "map.json")
    )
    lights = tuple(
        Light(int(row["id"]), np.asarray(row["stop_line"], np.float64).reshape(2, 2), row.get("lane"))
        for row in chart.get("lights", [])
    )
    return Episode(
        id=str(_field(head, "id", str, path)),
        source=_field(head, "source", dict, path),
        rate_hz=float(_field(head, "rate_hz", (int, float), path)),
        labels=str(_field(head, "labels", str, path)),
        agents=agents,
        lanes=lanes,
        lights=lights,
        **_read_states(folder / "states.parquet", steps, agents, lights),
        light_state=_read_lights(folder / "lights.parquet", steps, lights),
        routes=_read_routes(folder / "routes.parquet", agents),
        digest=_digest(digests),
    )


def _columns(path: Path, schema: pa.Schema, required: set[str]) -> dict[str, NDArray[Any]]:
    table = pq.read_table(path)
    missing = required - set(table.column_names)
    if missing:
        raise BadInputError(f"{path}: column '{min(missing)}' is missing; it has {', '.join(table.column_names)}")
    columns = {}
    for item in schema:
        if item.name not in table.column_names:
            continue
        column = table.column(item.name).cast(item.type)
        if column.null_count and not pa.types.is_floating(item.type):
            row = column.is_null().to_numpy().argmax()
            raise BadInputError(f"{path}, row {row}, field '{item.name}': null where a number is needed")
        columns[item.name] = column.to_numpy()
    return columns


def _positions(path: Path, name: str, got: NDArray[Any], ids: list[int]) -> NDArray[np.intp]:
    known = np.array(ids, np.int64)
    order = np.argsort(known)
    at = np.searchsorted(known[order], got).clip(max=max(len(known) - 1, 0))
    bad = known[order][at] != got if len(known) else np.ones(len(got), bool)
    if bad.any():
        row = int(bad.argmax())
        raise BadInputError(f"{path}, row {row}, field '{name}': {got[row]} is not among the declared {name}s")
    positions: NDArray[np.intp] = order[at]
    return positions


def _read_states(path: Path, steps: int, agents: tuple[Agent, ...], lights: tuple[Light, ...]) -> dict[str, Any]:
    columns = _columns(path, _STATES, set(_REQUIRED))
    arrays = empty_states(steps, len(agents))
    step = columns["step"]
    outside = (step < 0) | (step >= steps)
    if outside.any():
        row = int(outside.argmax())
        raise BadInputError(f"{path}, row {row}, field 'step': {step[row]} is outside 0 to {steps - 1}")
    where = (step, _positions(path, "agent", columns["agent"], [agent.id for agent in agents]))
    flat = np.ravel_multi_index(where, (steps, len(agents))) if len(step) else np.empty(0, np.int64)
    back = np.diff(step) < 0
    if back.any():
        row = int(back.argmax()) + 1
        raise BadInputError(f"{path}, row {row}, field 'step': time goes back from {step[row - 1]} to {step[row]}")
    again = np.ones(len(flat), bool)
    again[np.unique(flat, return_index=True)[1]] = False
    if again.any():
        row = int(again.argmax())
        raise BadInputError(f"{path}, row {row}: agent {columns['agent'][row]} stands twice in step {step[row]}")
    if "light" in columns:
        light = columns["light"]
        lit = np.flatnonzero(light >= 0)
        index = np.full(len(light), -1, np.int32)
        index[lit] = _positions(path, "light", light[lit], [item.id for item in lights])
        columns["light"] = index
    for name, values in columns.items():
        if name in arrays:
            arrays[name][where] = values
    arrays["present"][where] = True
    return arrays


def _read_lights(path: Path, steps: int, lights: tuple[Light, ...]) -> NDArray[np.uint8]:
    columns = _columns(path, _LIGHTS, set(_LIGHTS.names))
    state = np.full((steps, len(lights)), 255, np.uint8)
    at = _positions(path, "light", columns["light"], [light.id for light in lights])
    step = columns["step"]
    outside = (step < 0) | (step >= steps)
    if outside.any():
        row = int(outside.argmax())
        raise BadInputError(f"{path}, row {row}, field 'step': {step[row]} is outside 0 to {steps - 1}")
    again = np.ones(len(step), bool)
    again[np.unique(step.astype(np.int64) * max(len(lights), 1) + at, return_index=True)[1]] = False
    if again.any():
        row = int(again.argmax())
        raise BadInputError(f"{path}, row {row}: light {columns['light'][row]} has two states in step {step[row]}")
    state[step, at] = columns["state"]
    if (state > RED).any():
        step_, light = np.argwhere(state > RED)[0]
        raise BadInputError(f"{path}: light {lights[light].id} has no state 0, 1 or 2 at step {step_}")
    return state


def _read_routes(path: Path, agents: tuple[Agent, ...]) -> tuple[NDArray[np.float32], ...]:
    columns = _columns(path, _ROUTES, set(_ROUTES.names))
    at = _positions(path, "agent", columns["agent"], [agent.id for agent in agents])
    points = np.stack([columns["x"], columns["y"]], axis=1).astype(np.float32)
    return tuple(points[at == index] for index in range(len(agents)))


# --- checking -------------------------------------------------------------------------------------------------------


def check_episode(episode: Episode, source: str) -> None:
    """Raise BadInputError, naming field, step and agent, when an Episode holds what cannot be."""

    def refuse(what: str) -> None:
        raise BadInputError(f"{source}: {what}")

    if not (math.isfinite(episode.rate_hz) and episode.rate_hz > 0):
        refuse(f"rate_hz is {episode.rate_hz}; it must be above 0")
    if episode.labels not in LABELS:
        refuse(f"labels is '{episode.labels}'; choose from {', '.join(LABELS)}")
    for name, items in (("agent", episode.agents), ("lane", episode.lanes), ("light", episode.lights)):
        ids = [item.id for item in items]
        if len(set(ids)) != len(ids):
            refuse(f"two {name}s share an id")
    for agent in episode.agents:
        if not (0 < agent.length < 100 and 0 < agent.width < 20):
            refuse(f"agent {agent.id} is {agent.length} m long and {agent.width} m wide")
    _check_map(episode, refuse)
    _check_states(episode, refuse)
    for agent, route in zip(episode.agents, episode.routes, strict=True):
        if not np.isfinite(route).all():
            refuse(f"routes.parquet: the route of agent {agent.id} is not finite")


def _check_map(episode: Episode, refuse: Any) -> None:
    for lane in episode.lanes:
        if len(lane.centre) < 2 or not np.isfinite(lane.centre).all():
            refuse(f"lane {lane.id}: the centre line needs two or more finite points")
        if not 0 < lane.width < 100:
            refuse(f"lane {lane.id}: the width is {lane.width} m")
        for border in (lane.left, lane.right):
            if border not in BORDERS:
                refuse(f"lane {lane.id}: border '{border}'; choose from {', '.join(BORDERS)}")
    lane_ids = {lane.id for lane in episode.lanes}
    for light in episode.lights:
        if light.lane is not None and light.lane not in lane_ids:
            refuse(f"light {light.id} governs lane {light.lane}, which the map does not have")
        if not np.isfinite(light.stop_line).all():
            refuse(f"light {light.id}: the stop line is not finite")


def _check_states(episode: Episode, refuse: Any) -> None:  # noqa: ANN401
    present = episode.present

    def where(bad: NDArray[np.bool_], name: str, rule: str) -> None:
        if bad.any():
            step, column = np.argwhere(bad)[0]
            row = int(present.reshape(-1)[: step * present.shape[1] + column].sum())
            value = getattr(episode, name)[step, column]
            agent = episode.agents[column].id
            refuse(f"states.parquet, row {row}, field '{name}' (step {step}, agent {agent}): {value} {rule}")

    for name in ("x", "y", "heading", "speed"):
        where(present & ~np.isfinite(getattr(episode, name)), name, "is not a finite number")
    for name in _OPTIONAL_FLOATS:
        where(present & np.isinf(getattr(episode, name)), name, "is infinite")
    for name in ("x", "y"):
        where(present & (np.abs(getattr(episode, name)) > REACH), name, f"is farther than {REACH:g} m from the origin")
    where(present & (np.abs(episode.speed) > 120), "speed", "is above 120 m/s; is the unit m/s?")
    known = present & ~np.isnan(episode.acceleration)
    where(known & ~np.isin(episode.acceleration, ACCELERATIONS), "acceleration", f"is not one of {ACCELERATIONS}")
    if present.any():
        _check_units(episode, where)


def _check_units(episode: Episode, where: Any) -> None:  # noqa: ANN401
    """Speed against displacement: a drive in km/h or in feet must not pass for one in m/s and metres."""
    both = episode.present[1:] & episode.present[:-1]
    with np.errstate(invalid="ignore"):
        moved = np.hypot(np.diff(episode.x, axis=0), np.diff(episode.y, axis=0)) * episode.rate_hz
        said = (np.abs(episode.speed[1:]) + np.abs(episode.speed[:-1])) / 2
    moved, said = np.where(both, moved, 0), np.where(both, said, 0)
    if said.sum() + moved.sum() < both.sum() * 0.2:  # next to nothing moves: no statement possible
        return
    ratio = said.sum() / max(float(moved.sum()), 1e-9)
    if not 2 / 3 < ratio < 1.5:
        bad = np.zeros_like(episode.present)
        bad[1:] = both & (np.abs(said - moved) == np.abs(said - moved).max())
        where(bad, "speed", f"does not fit the positions: speeds are {ratio:.2f} times the distance moved per second")
