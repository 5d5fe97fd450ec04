"""Write and read Episodes as folders of JSON and Parquet files."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from study.atomic import atomic_folder
from study.episode.checks import check_episode
from study.episode.head import combined_digest, file_digest, read_json, typed_field
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


# --- writing --------------------------------------------------------------------------------------------------------


def write_episode(episode: Episode, folder: Path) -> str:
    """Write the Episode as `folder`, atomically, and return its digest.

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
            "agents": [vars(agent) for agent in episode.agents],
            "digests": digests,
        }
        (draft / "episode.json").write_text(json.dumps(head, indent=1, allow_nan=False))
    return combined_digest(digests)


def _map_json(episode: Episode) -> dict[str, Any]:
    return {
        "lanes": [vars(lane) | {"centre": np.round(lane.centre, 4).tolist()} for lane in episode.lanes],
        "lights": [vars(light) | {"stop_line": np.round(light.stop_line, 4).tolist()} for light in episode.lights],
    }


def _tables(episode: Episode) -> dict[str, pa.Table]:
    rows = np.nonzero(episode.present)
    ids = np.array([agent.id for agent in episode.agents], np.int32)
    light_ids = np.array([*(light.id for light in episode.lights), -1], np.int32)  # index -1 stays -1
    columns: dict[str, Any] = {"step": rows[0].astype(np.int32), "agent": ids[rows[1]]}
    for name in _STATES.names[2:]:
        values = getattr(episode, name)[rows]
        columns[name] = light_ids[values] if name == "light" else pa.array(values, from_pandas=True)
    lights = {
        "step": np.repeat(np.arange(episode.steps, dtype=np.int32), len(episode.lights)),
        "light": np.tile(light_ids[:-1], episode.steps),
        "state": episode.light_state.reshape(-1).astype(np.int8),
    }
    points = np.concatenate([*episode.routes, np.empty((0, 2), np.float32)])
    routes = {"agent": np.repeat(ids, [len(route) for route in episode.routes]), "x": points[:, 0], "y": points[:, 1]}
    return {
        "states.parquet": pa.table(columns, schema=_STATES),
        "lights.parquet": pa.table(lights, schema=_LIGHTS),
        "routes.parquet": pa.table(routes, schema=_ROUTES),
    }


# --- reading --------------------------------------------------------------------------------------------------------


def read_episode(folder: Path) -> Episode:
    """Read and check an Episode. Raises BadInputError, with file, row and field, for anything that is not schema 1."""
    path = folder / "episode.json"
    head = read_json(path)
    version = head.get("schema_version")
    if version != SCHEMA_VERSION:
        raise BadInputError(f"{path}: schema_version is {version!r}; this program reads {SCHEMA_VERSION}")
    digests = typed_field(head, "digests", dict, path)
    for file in FILES:
        if not (folder / file).is_file():
            raise BadInputError(f"{folder / file} is missing: the Episode is not whole; record or copy it again")
        if digests.get(file) != file_digest(folder / file):
            raise BadInputError(
                f"{folder / file} does not match its digest in episode.json: truncated or changed; get it again"
            )
    try:
        episode = _assemble(folder, head, digests)
    except (KeyError, TypeError, ValueError, IndexError, pa.ArrowException) as error:
        raise BadInputError(f"{folder} is no Episode of schema {SCHEMA_VERSION}: {error!r}") from error
    check_episode(episode, str(folder))
    return episode


def _assemble(folder: Path, head: dict[str, Any], digests: dict[str, str]) -> Episode:
    path, map_path = folder / "episode.json", folder / "map.json"
    steps = int(typed_field(head, "steps", int, path))
    agents = tuple(
        Agent(int(row["id"]), float(row["length"]), float(row["width"]), bool(row.get("ego", True)))
        for row in typed_field(head, "agents", list, path)
    )
    map_json = read_json(map_path)
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
        for row in typed_field(map_json, "lanes", list, map_path)
    )
    lights = tuple(
        Light(int(row["id"]), np.asarray(row["stop_line"], np.float64).reshape(2, 2), row.get("lane"))
        for row in map_json.get("lights", [])
    )
    return Episode(
        id=str(typed_field(head, "id", str, path)),
        source=typed_field(head, "source", dict, path),
        rate_hz=float(typed_field(head, "rate_hz", (int, float), path)),
        labels=str(typed_field(head, "labels", str, path)),
        agents=agents,
        lanes=lanes,
        lights=lights,
        **_read_states(folder / "states.parquet", steps, agents, lights),
        light_state=_read_lights(folder / "lights.parquet", steps, lights),
        routes=_read_routes(folder / "routes.parquet", agents),
        digest=combined_digest(digests),
    )


def _refuse_row(path: Path, bad: NDArray[np.bool_], text: str, **values: NDArray[Any]) -> None:
    """Raise BadInputError for the first bad row; `text` is formatted with its `values`."""
    if bad.any():
        row = int(bad.argmax())
        at_row = {name: array[row] for name, array in values.items()}
        raise BadInputError(f"{path}, row {row}{text.format(**at_row)}")


def _columns(path: Path, schema: pa.Schema, required: set[str]) -> dict[str, NDArray[Any]]:
    table = pq.read_table(path)
    if missing := required - set(table.column_names):
        raise BadInputError(f"{path}: column '{min(missing)}' is missing; it has {', '.join(table.column_names)}")
    columns = {}
    for field in schema:
        if field.name not in table.column_names:
            continue
        column = table.column(field.name).cast(field.type)
        if not pa.types.is_floating(field.type):
            _refuse_row(path, column.is_null().to_numpy(), f", field '{field.name}': null where a number is needed")
        columns[field.name] = column.to_numpy()
    return columns


def _positions(path: Path, name: str, values: NDArray[Any], ids: list[int]) -> NDArray[np.intp]:
    """Return where each value stands among the declared ids."""
    order = np.argsort(ids)
    known = np.array(ids, np.int64)[order]
    at = np.searchsorted(known, values).clip(max=max(len(known) - 1, 0))
    unknown = known[at] != values if len(known) else np.ones(len(values), bool)
    _refuse_row(path, unknown, f", field '{name}': {{value}} is not among the declared {name}s", value=values)
    positions: NDArray[np.intp] = order[at]
    return positions


def _check_steps(path: Path, step: NDArray[Any], steps: int) -> None:
    outside = (step < 0) | (step >= steps)
    _refuse_row(path, outside, f", field 'step': {{step}} is outside 0 to {steps - 1}", step=step)


def _repeated(step: NDArray[Any], column: NDArray[np.intp]) -> NDArray[np.bool_]:
    """Return which rows have step and column of an earlier row."""
    repeated = np.ones(len(step), bool)
    cells = step.astype(np.int64) * (int(column.max(initial=0)) + 1) + column
    repeated[np.unique(cells, return_index=True)[1]] = False
    return repeated


def _read_states(path: Path, steps: int, agents: tuple[Agent, ...], lights: tuple[Light, ...]) -> dict[str, Any]:
    columns = _columns(path, _STATES, set(_REQUIRED))
    step, agent = columns["step"], columns["agent"]
    _check_steps(path, step, steps)
    where = (step, _positions(path, "agent", agent, [agent.id for agent in agents]))
    back = np.diff(step, prepend=step[:1]) < 0
    _refuse_row(path, back, ", field 'step': time goes back from {old} to {new}", old=np.roll(step, 1), new=step)
    text = ": agent {agent} stands twice in step {step}"
    _refuse_row(path, _repeated(*where), text, agent=agent, step=step)
    if "light" in columns:
        light = columns["light"]
        lit = light >= 0
        index = np.full(len(light), -1, np.int32)
        index[lit] = _positions(path, "light", light[lit], [item.id for item in lights])
        columns["light"] = index
    arrays = empty_states(steps, len(agents))
    for name, values in columns.items():
        if name in arrays:
            arrays[name][where] = values
    arrays["present"][where] = True
    return arrays


def _read_lights(path: Path, steps: int, lights: tuple[Light, ...]) -> NDArray[np.uint8]:
    columns = _columns(path, _LIGHTS, set(_LIGHTS.names))
    step, light = columns["step"], columns["light"]
    at = _positions(path, "light", light, [light.id for light in lights])
    _check_steps(path, step, steps)
    _refuse_row(path, _repeated(step, at), ": light {light} has two states in step {step}", light=light, step=step)
    state = np.full((steps, len(lights)), 255, np.uint8)
    state[step, at] = columns["state"]
    if (state > RED).any():
        bad_step, bad_light = np.argwhere(state > RED)[0]
        raise BadInputError(f"{path}: light {lights[bad_light].id} has no state 0, 1 or 2 at step {bad_step}")
    return state


def _read_routes(path: Path, agents: tuple[Agent, ...]) -> tuple[NDArray[np.float32], ...]:
    columns = _columns(path, _ROUTES, set(_ROUTES.names))
    at = _positions(path, "agent", columns["agent"], [agent.id for agent in agents])
    points = np.stack([columns["x"], columns["y"]], axis=1).astype(np.float32)
    return tuple(points[at == index] for index in range(len(agents)))
