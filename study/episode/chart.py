"""The lanes and lights of map.json: each is read by itself, so that every one that is wrong is named."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np

from study.episode import fields
from study.episode.findings import Findings
from study.episode.schema import BORDERS, Lane, Light

FILE = "map.json"
REACH = 10_000.0  # [m] within which float32 keeps the millimetre


def parse_map(content: dict[str, Any], findings: Findings) -> tuple[tuple[Lane, ...], tuple[Light, ...]]:
    """Return the lanes and lights that are right; `findings` get the others, and the heights that are left out.

    Raises BadFieldError when there is no list of lanes or lights.
    """
    content = content | {"lights": content.get("lights", [])}
    lanes = parse_objects(content, "lanes", _lane, FILE, findings)
    known = {lane.id for lane, _ in lanes}
    lights = parse_objects(content, "lights", lambda place, row: _light(place, row, known), FILE, findings)
    heights = sum(high for _, high in (*lanes, *lights))
    if heights:
        findings.warn(
            FILE, f": {heights} lines have points with three coordinates; x and y are taken, heights left out"
        )
    return tuple(lane for lane, _ in lanes), tuple(light for light, _ in lights)


Parsed = TypeVar("Parsed")


def parse_objects(
    content: dict[str, Any],
    name: str,
    parse: Callable[[str, dict[str, Any]], Parsed],
    file: str,
    findings: Findings,
) -> list[Parsed]:
    """Return what `parse` makes of each object in a list; `findings` get those that are wrong, one of each kind.

    Raises BadFieldError when there is no such list.
    """
    parsed: list[Parsed] = []
    faults: dict[str, list[str]] = {}
    ids: set[int] = set()
    for place, row in fields.objects(content, name):
        try:
            if row is None:
                raise fields.BadFieldError(f"field '{place}' is no object", "object")  # noqa: TRY301
            item = parse(place, row)
            number = fields.integer(row, "id", place)
            if number in ids:
                text = f"field '{place}.id' is {number}: two {name} share an id; give each its own"
                raise fields.BadFieldError(text, "id twice")  # noqa: TRY301
            ids.add(number)
            parsed.append(item)
        except fields.BadFieldError as error:
            faults.setdefault(error.kind, []).append(str(error))
    for texts in faults.values():
        findings.add(file, f": {texts[0]}", len(texts), name)
    return parsed


def _lane(place: str, row: dict[str, Any]) -> tuple[Lane, bool]:
    number = fields.integer(row, "id", place)
    name = f"{place} (lane {number})"
    centre, high = fields.points(row, "centre", name, least=2)
    _check_reach(centre, f"{name}.centre")
    limit = None if row.get("speed_limit") is None else fields.number(row, "speed_limit", name, 0, 200)
    lane = Lane(
        number,
        centre,
        fields.number(row, "width", name, 0, 100),
        fields.choice(row, "left", name, BORDERS),
        fields.choice(row, "right", name, BORDERS),
        fields.truth(row, "junction", name, default=False),
        limit,
    )
    return lane, high


def _light(place: str, row: dict[str, Any], lanes: set[int]) -> tuple[Light, bool]:
    number = fields.integer(row, "id", place)
    name = f"{place} (light {number})"
    line, high = fields.points(row, "stop_line", name, least=2)
    if len(line) != 2:
        raise fields.BadFieldError(
            f"field '{name}.stop_line' has {len(line)} points; 2 are needed, its two ends", "ends"
        )
    _check_reach(line, f"{name}.stop_line")
    lane = None if row.get("lane") is None else fields.integer(row, "lane", name)
    if lane is not None and lane not in lanes:
        raise fields.BadFieldError(
            f"field '{name}.lane' is {lane}, which the map does not have (or not rightly); name a lane, or null",
            "unknown lane",
        )
    return Light(number, line, lane), high


def _check_reach(line: np.ndarray[Any, np.dtype[np.float64]], name: str) -> None:
    far = np.abs(line) > REACH
    if far.any():
        at, axis = np.argwhere(far)[0].tolist()
        raise fields.BadFieldError(
            f"field '{name}[{at}][{axis}]' is {line[at, axis]:.10g}, farther than {REACH:g} m from the origin; shift "
            "map and agents by the same offset (is the map left in UTM?)",
            "far",
        )
