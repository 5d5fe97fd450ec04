"""Read profiles and sweep files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml
from pydantic import ValidationError

from study.config.grid import Grid
from study.config.heads import HEAD_SETS
from study.config.settings import Model, StudySettings
from study.config.workspace import HERE
from study.errors import BadInputError, one_of


def read_yaml(path: Path) -> dict[str, Any]:
    """Return a YAML file's mapping. Raises BadInputError when it is missing, broken or no mapping."""
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
    """Return the path by name of the YAML files in a folder, ordered by name."""
    return {path.stem: path for path in sorted(folder.glob("*.yaml"), key=lambda path: path.stem)}


def explain(error: ValidationError, source: str) -> BadInputError:
    """Return pydantic's error as one clear line."""
    lines: list[str] = []
    for item in error.errors(include_url=False):
        if item["type"] == "too_short" and lines:  # follows from the error inside, which is told already
            continue
        where = ".".join(str(part) for part in item["loc"])
        if item["type"] == "extra_forbidden":
            lines.append(f"unknown setting '{where}'")
            continue
        message = item["msg"].removeprefix("Value error, ")
        whole = isinstance(item["input"], dict) and not item["type"].endswith("_type")  # a group of settings
        got = "" if whole else f" (got {item['input']!r})"
        lines.append(f"{where}: {message}{got}" if where else message)
    return BadInputError(f"{source}: " + "; ".join(lines))


def validated(model: type[Model], content: object, source: str) -> Model:
    """Return the content as that model. Raises BadInputError that names the source and every field that is wrong."""
    try:
        return model.model_validate(content)
    except ValidationError as error:
        raise explain(error, source) from error


def merge(base: dict[str, Any], over: dict[str, Any]) -> dict[str, Any]:
    """Return `base` with the values of `over`, nested mappings merged."""
    merged = dict(base)
    for name, value in over.items():
        below = merged.get(name)
        merged[name] = merge(below, value) if isinstance(value, dict) and isinstance(below, dict) else value
    return merged


def _files_with(kind: str, name: str, folder: Path) -> dict[str, Path]:
    files = named_files(folder)
    if not files:
        raise BadInputError(f"no {kind} files in {folder.absolute()}: start in the project's folder, which has them")
    if name not in files:
        raise one_of(kind, name, files)
    return files


def load_grid(
    name: str, overrides: dict[str, Any] | None = None, folder: Path = HERE.sweeps, profile: str = "laptop"
) -> Grid:
    """Return the sweep of that name with a profile's rules and settings.

    Raises BadInputError for an unknown name or setting.
    """
    files = _files_with("sweep", name, folder)
    content = merge(read_yaml(files[name]), overrides or {}) | {"name": name}
    by_profile = content.pop("profile_settings", {})
    if not isinstance(by_profile, dict):
        raise BadInputError(f"sweep {name}: profile_settings maps profiles to settings: {{laptop: {{encoder: ..}}}}")
    if profile in by_profile:
        content["settings"] = merge(content.get("settings", {}), by_profile[profile])
    if isinstance(content.get("rules"), dict):
        content["rules"] = {rule: _of_profile(value, profile) for rule, value in content["rules"].items()}
    return validated(Grid, content, f"sweep {name}")


def _of_profile(value: object, profile: str) -> object:
    """Return a rule for a profile, the largest where it is not named; leave what is no such choice to validation."""
    if not isinstance(value, dict) or not value or set(value) & set(HEAD_SETS):
        return value
    choices = list(value.values())
    if profile in value:
        return value[profile]
    if all(isinstance(each, int | float) for each in choices):
        return max(choices)
    if all(isinstance(each, dict) and each for each in choices):
        names = dict.fromkeys(name for each in choices for name in each)
        return {name: max(each.get(name, max(each.values())) for each in choices) for name in names}
    return value


def load_profile(name: str, overrides: dict[str, Any] | None = None, folder: Path = HERE.sweeps) -> StudySettings:
    """Return the profile of that name. Raises BadInputError for an unknown profile or setting."""
    files = _files_with("profile", name, folder / "profiles")
    return validated(StudySettings, merge(read_yaml(files[name]), overrides or {}), f"profile {name}")
