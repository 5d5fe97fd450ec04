"""Read XML files with errors that name file and field."""

from __future__ import annotations

import gzip
import math
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, cast

import numpy as np
from numpy.typing import NDArray

from study.errors import BadInputError


@contextmanager
def opened(path: Path) -> Iterator[IO[bytes]]:
    """Open a file, unpacked if its name ends in .gz. Raises BadInputError when it cannot be read, or is no XML."""
    try:
        with gzip.open(path) if path.suffix == ".gz" else path.open("rb") as stream:
            yield cast("IO[bytes]", stream)
    except ET.ParseError as error:
        raise BadInputError(f"{path} is no valid XML ({error}): truncated or foreign") from error
    except (OSError, EOFError) as error:
        raise BadInputError(f"cannot read {path}: {getattr(error, 'strerror', None) or error}") from error


def read_xml(path: Path, root: str) -> ET.Element:
    """Return the root element of a file. Raises BadInputError when it has another name than `root`."""
    with opened(path) as stream:
        element = ET.parse(stream).getroot()  # noqa: S314 - expat itself refuses entities that grow
    if element.tag != root:
        raise BadInputError(f"{path}: the root element is '{element.tag}'; '{root}' is needed")
    return element


def text(element: ET.Element, name: str, path: Path) -> str:
    """Return an attribute. Raises BadInputError where there is none."""
    value = element.get(name)
    if value is None:
        raise BadInputError(f"{path}: {place(element)} has no attribute '{name}'")
    return value


def number(element: ET.Element, name: str, path: Path, default: float | None = None) -> float:
    """Return an attribute as a number. Raises BadInputError where it is none, or not finite."""
    value = text(element, name, path) if default is None else element.get(name, default)
    try:
        result = float(value)
    except ValueError:
        result = math.nan
    if not math.isfinite(result):
        raise BadInputError(f"{path}: {place(element)}, field '{name}': '{value}' is not a number")
    return result


def polyline(element: ET.Element, name: str, path: Path) -> NDArray[np.float64]:
    """Return an attribute "x,y x,y ..." as points [P, 2], without heights. Raises BadInputError for other texts."""
    value = text(element, name, path)
    try:
        points = np.array([[float(part) for part in point.split(",")[:2]] for point in value.split()])
    except ValueError:
        points = np.empty(0)
    if points.ndim != 2 or points.shape[1] != 2 or len(points) < 2 or not np.isfinite(points).all():
        raise BadInputError(f"{path}: {place(element)}, field '{name}': '{value[:60]}' is no list of points x,y")
    return points


def place(element: ET.Element) -> str:
    """Return the name of an element, with its id where it has one."""
    key = element.get("id")
    return f"'{element.tag}'" if key is None else f"'{element.tag}' {key}"
