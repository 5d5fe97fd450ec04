"""Write and read Episodes as folders of JSON and Parquet files."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from study.atomic import atomic_folder
from study.episode.checks import check_episode
from study.episode.schema import RED, SCHEMA_VERSION, Agent, Episode, Lane, Light, empty_states
from study.errors import BadInputError

FILES = ("map.json", "states.parquet", "lights.parquet", "routes.parquet")

_REQUIRED = {"step": pa.int32(), "agent": pa.int32()} | dict.fromkeys(("x", "y", "heading", "speed"), pa.float32())
_STATES = pa.schema(
    [(name, kind) for name, kind in _REQUIRED.items()]
    + [("steering", pa.float32()), ("acceleration", pa.float32()), ("light", pa.int32())]
    + [("light_distance", pa.float32()), ("route_s", pa.float32()), ("lead_gap", pa.float32())]
)
_LIGHTS = pa.schema([("step", pa.int32()), ("light", pa.int32()), ("state", pa.int8())])
_ROUTES = pa.schema([("agent", pa.int32()), ("x", pa.float32()), ("y", pa.float32())])


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
