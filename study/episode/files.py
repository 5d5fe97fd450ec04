"""Write and read Episodes as folders of JSON and Parquet files."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from study.atomic import atomic_folder
from study.episode.checks import check_episode, map_json
from study.episode.findings import Findings
from study.episode.head import combined_digest, file_digest
from study.episode.recording import FILES, LIGHTS, ROUTES, read_recording
from study.episode.rows import STATES
from study.episode.schema import SCHEMA_VERSION, VEHICLE, WITH_CLASSES, Agent, Episode
from study.errors import BadInputError

MOST_DENSE = 40_000_000  # steps x agents: 1.6 GB


# --- writing --------------------------------------------------------------------------------------------------------


def write_episode(episode: Episode, folder: Path) -> str:
    """Write the Episode as `folder`, atomically, and return its digest.

    An existing `folder` is replaced. Raises BadInputError when the Episode breaks its own schema.
    """
    check_episode(episode, str(folder))
    with atomic_folder(folder) as draft:
        (draft / "map.json").write_text(json.dumps(map_json(episode), separators=(",", ":"), allow_nan=False))
        for file, table in _tables(episode).items():
            pq.write_table(table, draft / file, compression="zstd", compression_level=3)
        digests = {file: file_digest(draft / file) for file in FILES}
        classes = {agent.id: agent.kind for agent in episode.agents}
        plain = set(classes.values()) <= {VEHICLE}
        head = {
            "schema_version": SCHEMA_VERSION if plain else WITH_CLASSES,
            "id": episode.id,
            "source": episode.source,
            "rate_hz": episode.rate_hz,
            "steps": episode.steps,
            "labels": episode.labels,
            "agents": [_agent_json(agent, plain) for agent in episode.agents],
            "digests": digests,
        }
        (draft / "episode.json").write_text(json.dumps(head, indent=1, allow_nan=False))
    return combined_digest(digests, classes)


def _agent_json(agent: Agent, plain: bool) -> dict[str, Any]:  # noqa: FBT001
    fields = dict(vars(agent))
    kind = fields.pop("kind")
    return fields if plain else fields | {"class": kind}


def _tables(episode: Episode) -> dict[str, pa.Table]:
    rows = np.nonzero(episode.present)
    ids = np.array([agent.id for agent in episode.agents], np.int32)
    light_ids = np.array([*(light.id for light in episode.lights), -1], np.int32)  # index -1 stays -1
    columns: dict[str, Any] = {"step": rows[0].astype(np.int32), "agent": ids[rows[1]]}
    for name in STATES.names[2:]:
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
        "states.parquet": pa.table(columns, schema=STATES),
        "lights.parquet": pa.table(lights, schema=LIGHTS),
        "routes.parquet": pa.table(routes, schema=ROUTES),
    }


# --- reading --------------------------------------------------------------------------------------------------------


def read_episode(folder: Path) -> Episode:
    """Read and check an Episode. Raises BadInputError, with file, row and field, for anything else."""
    findings = Findings(folder)
    recording = read_recording(folder, findings)
    findings.refuse()
    assert recording is not None  # or there was something to refuse
    cells = recording.steps * len(recording.agents)
    if cells > MOST_DENSE:
        raise BadInputError(
            f"{folder} has {recording.steps:,} steps of {len(recording.agents):,} agents, too many to hold at once; "
            "'python -m study.data import' cuts it into parts"
        )
    return recording.episode()
