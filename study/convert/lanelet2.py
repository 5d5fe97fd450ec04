"""Lanes of a lanelet2 map (.osm), in the metres of a recording."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from study.convert.xml import number, read_xml, text
from study.episode.schema import Lane
from study.errors import BadInputError

LANES = {"road", "highway", "play_street", "emergency_lane", "bus_lane", "bicycle_lane", "exit"}  # subtypes
BORDERS = {"curbstone": "curb", "road_border": "curb", "guard_rail": "curb", "wall": "curb", "fence": "curb"}
POINTS = 20  # of a centre line

Floats = NDArray[np.float64]


def read_lanes(path: Path, origin: tuple[float, float], limit: float | None) -> list[Lane]:
    """Return the lanes; `origin` is the recording's, in UTM [m]; `limit` holds where the map has none [m/s].

    Raises BadInputError for anything that is no such map, or has no lanelet for vehicles.
    """
    root = read_xml(path, "osm")
    nodes = {
        text(node, "id", path): (number(node, "lat", path), number(node, "lon", path)) for node in root.iter("node")
    }
    if not nodes:
        raise BadInputError(f"{path}: field 'node': the map has no points")
    degrees = np.array(list(nodes.values()))
    metres = dict(zip(nodes, utm(degrees[:, 0], degrees[:, 1]) - origin, strict=True))
    ways: dict[str, tuple[Floats, str]] = {}
    for way in root.iter("way"):
        refs = [text(row, "ref", path) for row in way.iter("nd")]
        if unknown := [ref for ref in refs if ref not in metres]:
            raise BadInputError(f"{path}: way {way.get('id')}, field 'nd': there is no node {unknown[0]}")
        ways[text(way, "id", path)] = np.array([metres[ref] for ref in refs]).reshape(-1, 2), _border(_tags(way))
    lanes: list[Lane] = []
    for relation in root.iter("relation"):
        tags = _tags(relation)
        if tags.get("type") == "lanelet" and tags.get("subtype", "road") in LANES:
            lanes.append(_lane(len(lanes), relation, tags, ways, limit, path))
    if not lanes:
        raise BadInputError(f"{path}: field 'relation': there is no lanelet for vehicles")
    return lanes


def onward(lanes: list[Lane]) -> list[list[int]]:
    """Return the lanes that begin where each one ends."""
    starts = np.array([lane.centre[0] for lane in lanes])
    return [np.flatnonzero(np.hypot(*(starts - lane.centre[-1]).T) < 0.5).tolist() for lane in lanes]


def _tags(element: ET.Element) -> dict[str, str]:
    return {tag.get("k", ""): tag.get("v", "") for tag in element.iter("tag")}


def _border(tags: dict[str, str]) -> str:
    kind, subtype = tags.get("type", ""), tags.get("subtype", "")
    if kind in BORDERS:
        return BORDERS[kind]
    if not kind.startswith("line_"):
        return "none"
    return "dashed" if subtype.startswith("dashed") else "solid"


def _lane(
    key: int,
    relation: ET.Element,
    tags: dict[str, str],
    ways: dict[str, tuple[Floats, str]],
    limit: float | None,
    path: Path,
) -> Lane:
    sides: dict[str, tuple[Floats, str]] = {}
    for role in ("left", "right"):
        refs = [row.get("ref", "") for row in relation.iter("member") if row.get("role") == role]
        parts = [ways[ref] for ref in refs if ref in ways]
        if not parts or len(parts) < len(refs) or any(len(points) < 2 for points, _ in parts):
            raise BadInputError(f"{path}: lanelet {relation.get('id')}, field 'member': its {role} bound is missing")
        sides[role] = _joined([points for points, _ in parts]), parts[0][1]
    left, right = (_even(sides[role][0]) for role in ("left", "right"))
    if np.hypot(*(left[0] - right[0])) + np.hypot(*(left[-1] - right[-1])) > np.hypot(
        *(left[0] - right[-1])
    ) + np.hypot(*(left[-1] - right[0])):
        right = right[::-1]
    ahead, across = (left[-1] + right[-1]) - (left[0] + right[0]), (left - right).mean(axis=0)
    if ahead[0] * across[1] - ahead[1] * across[0] < 0:  # the left bound must be on the left
        left, right = left[::-1], right[::-1]
    speed = tags.get("speed_limit", "").removesuffix("km/h").strip()
    own = float(speed) / 3.6 if speed.replace(".", "", 1).isdigit() else limit
    width = float(np.hypot(*(left - right).T).mean())
    borders = sides["left"][1], sides["right"][1]
    return Lane(key, (left + right) / 2, width, *borders, "turn_direction" in tags, own)


def _joined(parts: list[Floats]) -> Floats:
    """Return the parts of a bound as one line; each may be drawn either way."""
    line = parts[0]
    for part in parts[1:]:
        ends = [np.hypot(*(line[at] - part[to])) for at, to in ((-1, 0), (-1, -1), (0, -1), (0, 0))]
        nearest = int(np.argmin(ends))
        onward_part = part if nearest in {0, 2} else part[::-1]
        line = np.concatenate([line, onward_part] if nearest < 2 else [onward_part, line])
    return line


def _even(line: Floats) -> Floats:
    along = np.concatenate([[0.0], np.hypot(*np.diff(line, axis=0).T).cumsum()])
    at = np.linspace(0, along[-1], POINTS)
    return np.stack([np.interp(at, along, line[:, axis]) for axis in (0, 1)], axis=1)


def utm(latitude: Floats, longitude: Floats) -> Floats:
    """Return UTM coordinates [N, 2] [m] of WGS84 degrees, all in the zone of the first (Krueger's series)."""
    zone = int((longitude[0] + 180) // 6) + 1
    a, f = 6378137.0, 1 / 298.257223563
    n = f / (2 - f)
    radius = a / (1 + n) * (1 + n**2 / 4 + n**4 / 64)
    alpha = (n / 2 - 2 / 3 * n**2 + 5 / 16 * n**3, 13 / 48 * n**2 - 3 / 5 * n**3, 61 / 240 * n**3)
    phi, lam = np.radians(latitude), np.radians(longitude - (6 * zone - 183))
    e = 2 * np.sqrt(n) / (1 + n)
    t = np.sinh(np.arctanh(np.sin(phi)) - e * np.arctanh(e * np.sin(phi)))
    xi, eta = np.arctan2(t, np.cos(lam)), np.arcsinh(np.sin(lam) / np.hypot(t, np.cos(lam)))
    east = eta + sum(value * np.cos(2 * j * xi) * np.sinh(2 * j * eta) for j, value in enumerate(alpha, start=1))
    north = xi + sum(value * np.sin(2 * j * xi) * np.cosh(2 * j * eta) for j, value in enumerate(alpha, start=1))
    false_north = np.where(latitude < 0, 10_000_000.0, 0.0)
    return np.stack([500_000 + 0.9996 * radius * east, false_north + 0.9996 * radius * north], axis=1)
