"""Fields of JSON objects that others have written, by type: each error names the field and what it holds."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from study.errors import BadInputError


class BadFieldError(BadInputError):
    """A field holds what it must not. The message begins with the field; its file is known to the caller.

    Faults of one `kind` can be counted together.
    """

    def __init__(self, text: str, kind: str) -> None:
        super().__init__(text)
        self.kind = kind


def _refuse(place: str, value: Any, needed: str) -> BadFieldError:
    got = "missing" if value is MISSING else "null" if value is None else f"{value!r:.60}"
    kind = f"{re.sub(r'.*[.]', '', place)}: {needed}"
    return BadFieldError(f"field '{place}' is {got}; {needed} is needed", re.sub(r"\d", "", kind))


MISSING = object()


def number(row: dict[str, Any], name: str, place: str, low: float = -math.inf, high: float = math.inf) -> float:
    """Return a finite number between `low` and `high`, exclusive."""
    value = row.get(name, MISSING)
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise _refuse(f"{place}.{name}".lstrip("."), value, "a finite number")
    if not low < value < high:
        raise _refuse(f"{place}.{name}".lstrip("."), value, f"a number between {low:g} and {high:g}")
    return float(value)


def integer(row: dict[str, Any], name: str, place: str) -> int:
    """Return a whole number of 32 bits, as ids are."""
    value = row.get(name, MISSING)
    whole = isinstance(value, int) or (isinstance(value, float) and value.is_integer())
    if isinstance(value, bool) or not whole or not -(2**31) <= int(value) < 2**31:
        raise _refuse(f"{place}.{name}".lstrip("."), value, "one whole number below 2^31")
    return int(value)


def truth(row: dict[str, Any], name: str, place: str, default: bool) -> bool:  # noqa: FBT001
    """Return true or false, `default` where the field is missing."""
    value = row.get(name, default)
    if not isinstance(value, bool):
        raise _refuse(f"{place}.{name}", value, "true or false")
    return value


def choice(row: dict[str, Any], name: str, place: str, allowed: tuple[str, ...]) -> str:
    """Return one of the allowed words, the first where the field is missing."""
    value = row.get(name, allowed[0])
    if not isinstance(value, str) or value not in allowed:
        raise _refuse(f"{place}.{name}", value, f"one of {', '.join(allowed)}")
    return value


def points(row: dict[str, Any], name: str, place: str, least: int) -> tuple[NDArray[np.float64], bool]:
    """Return points [P, 2] of [x, y] or [x, y, height], and whether heights were left out."""
    value = row.get(name, MISSING)
    where = f"{place}.{name}"
    if not isinstance(value, list) or len(value) < least:
        raise _refuse(where, value, f"a list of {least} or more points [x, y]")
    sizes = {len(point) if isinstance(point, list) else 0 for point in value}
    if sizes not in ({2}, {3}):
        raise _refuse(where, value, "a list of points [x, y], or of [x, y, height]")
    for at, point in enumerate(value):
        for axis, coordinate in enumerate(point[:2]):
            if type(coordinate) not in (int, float) or not math.isfinite(coordinate):
                raise _refuse(f"{where}[{at}][{axis}]", coordinate, "a finite number")
    return np.array([point[:2] for point in value], np.float64), sizes == {3}


def objects(content: dict[str, Any], name: str) -> Iterator[tuple[str, dict[str, Any] | None]]:
    """Yield place and content of each object in a list, None where something else stands there."""
    value = content.get(name, MISSING)
    if not isinstance(value, list):
        raise _refuse(name, value, "a list")
    for at, row in enumerate(value):
        yield f"{name}[{at}]", row if isinstance(row, dict) else None


def not_finite(value: Any, place: str) -> Iterator[str]:
    """Yield the place of every number below `value` that is not finite."""
    if isinstance(value, float) and not math.isfinite(value):
        yield place
    elif isinstance(value, dict):
        for name, part in value.items():
            yield from not_finite(part, f"{place}.{name}")
    elif isinstance(value, list):
        for at, part in enumerate(value):
            yield from not_finite(part, f"{place}[{at}]")
