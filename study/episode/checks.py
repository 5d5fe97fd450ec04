"""Check that an Episode is what its format promises, before it is written."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from study.episode.chart import parse_map
from study.episode.fields import BadFieldError
from study.episode.findings import Findings
from study.episode.rows import episode_rows, value_faults
from study.episode.schema import CLASSES, LABELS, Episode


def map_json(episode: Episode) -> dict[str, Any]:
    """Return the content of map.json."""
    return {
        "lanes": [vars(lane) | {"centre": np.round(lane.centre, 4).tolist()} for lane in episode.lanes],
        "lights": [vars(light) | {"stop_line": np.round(light.stop_line, 4).tolist()} for light in episode.lights],
    }


def check_episode(episode: Episode, source: str) -> None:
    """Raise BadInputError, naming field, step and agent, when an Episode holds impossible values."""
    findings = Findings(Path(source))
    _check_head(episode, findings)
    try:
        parse_map(map_json(episode), findings)
    except BadFieldError as error:
        findings.add("map.json", f": {error}")
    value_faults(episode_rows(episode), episode.agents, findings)
    for agent, route in zip(episode.agents, episode.routes, strict=True):
        if not np.isfinite(route).all():
            findings.add("routes.parquet", f": the route of agent {agent.id} is not finite")
    findings.refuse()


def _check_head(episode: Episode, findings: Findings) -> None:
    def refuse(what: str) -> None:
        findings.add("episode.json", f": {what}")

    if not (math.isfinite(episode.rate_hz) and episode.rate_hz > 0):
        refuse(f"rate_hz is {episode.rate_hz}; it must be above 0")
    if episode.labels not in LABELS:
        refuse(f"labels is '{episode.labels}'; choose from {', '.join(LABELS)}")
    ids = [agent.id for agent in episode.agents]
    if len(set(ids)) != len(ids):
        refuse("two agents share an id")
    for agent in episode.agents:
        if not (0 < agent.length < 100 and 0 < agent.width < 20):
            refuse(f"agent {agent.id} is {agent.length} m long and {agent.width} m wide")
        if agent.kind not in CLASSES:
            refuse(f"the class of agent {agent.id} is '{agent.kind}'; choose from {', '.join(CLASSES)}")
