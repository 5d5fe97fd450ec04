"""Read the JSON files of an Episode, and its digest: light enough for planning, without arrays."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

from study.episode.schema import SCHEMA_VERSION, VEHICLE
from study.errors import BadInputError


def read_json(path: Path) -> dict[str, Any]:
    """Return the JSON object in a file. Raises BadInputError for anything else."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise BadInputError(f"cannot read {path}: {error.strerror}; is {path.parent} an Episode?") from error
    except (ValueError, RecursionError) as error:
        raise BadInputError(f"{path} is not valid JSON ({error}): truncated or foreign") from error
    if not isinstance(content, dict):
        raise BadInputError(f"{path} holds {type(content).__name__}, not a JSON object")
    return content


def typed_field(content: dict[str, Any], name: str, kind: type | tuple[type, ...], path: Path) -> Any:
    """Return a field of a file's content. Raises BadInputError when it is missing or of another type."""
    value = content.get(name)
    if not isinstance(value, kind) or isinstance(value, bool):
        raise BadInputError(f"{path}: field '{name}' is {value!r}, which is not what schema {SCHEMA_VERSION} asks for")
    return value


def file_digest(path: Path) -> str:
    """Return the hex sha256 of a file's bytes."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def combined_digest(digests: dict[str, str], classes: dict[int, str]) -> str:
    """Return the digest of an Episode from those of its files and the classes of its agents, by id."""
    if other := {str(agent): kind for agent, kind in classes.items() if kind != VEHICLE}:
        digests = digests | {"classes": hashlib.sha256(json.dumps(other, sort_keys=True).encode()).hexdigest()}
    return hashlib.sha256(json.dumps(digests, sort_keys=True).encode()).hexdigest()


def episode_digest(folder: Path) -> str:
    """Return the digest that `read_episode` gives, from the head alone. Raises BadInputError where there is none."""
    path = folder / "episode.json"
    head = read_json(path)
    classes = {agent["id"]: agent.get("class", VEHICLE) for agent in head.get("agents", ())}
    return combined_digest(typed_field(head, "digests", dict, path), classes)
