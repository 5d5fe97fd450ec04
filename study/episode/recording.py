"""A recording as its files hold it: checked, but not yet dense, so that a long one of many agents fits in memory."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from study.episode import fields
from study.episode.chart import parse_map, parse_objects
from study.episode.findings import Findings
from study.episode.head import combined_digest, file_digest, read_json, typed_field
from study.episode.rows import Rows, dense_states, positions, read_columns, read_rows, repeated, select
from study.episode.schema import (
    CLASSES,
    LABELS,
    RED,
    SCHEMA_VERSION,
    VEHICLE,
    WITH_CLASSES,
    Agent,
    Episode,
    Lane,
    Light,
)
from study.errors import BadInputError

FILES = ("map.json", "states.parquet", "lights.parquet", "routes.parquet")
LIGHTS = pa.schema([("step", pa.int32()), ("light", pa.int32()), ("state", pa.int8())])
ROUTES = pa.schema([("agent", pa.int32()), ("x", pa.float32()), ("y", pa.float32())])
MOST_CELLS = 1 << 20  # steps x agents of a part: dense, it takes 43 MB
MOST_STEPS = 10_000_000  # eleven days at 10 Hz
SHORTEST = 600  # steps that are not cut any more

Floats = NDArray[np.float32]


@dataclass(frozen=True)
class Recording:
    """What the files of an Episode hold, without what is wrong in them."""

    id: str
    source: dict[str, Any]
    rate_hz: float
    steps: int
    labels: str
    agents: tuple[Agent, ...]
    lanes: tuple[Lane, ...]
    lights: tuple[Light, ...]
    rows: Rows
    light_state: NDArray[np.uint8]
    routes: tuple[Floats, ...]
    digests: dict[str, str]

    def episode(self) -> Episode:
        """Return the recording as one dense Episode."""
        states = dense_states(self.rows, self.steps, len(self.agents))
        names = ("id", "source", "rate_hz", "labels", "agents", "lanes", "lights", "light_state", "routes")
        common = {name: getattr(self, name) for name in names}
        classes = {agent.id: agent.kind for agent in self.agents}
        return Episode(**common, **states, digest=combined_digest(self.digests, classes))

    def parts(self) -> Iterator[Recording]:
        """Yield the recording cut in time, so that each part is small when dense; a small one is yielded whole.

        A part has the agents that are there during it; one that is there at a cut is in both parts, by the same id.
        """
        for first, last in self._spans(0, self.steps):
            if (first, last) == (0, self.steps):
                yield self
            else:
                yield self.part(first, last)

    def _spans(self, first: int, last: int) -> Iterator[tuple[int, int]]:
        begin, end = np.searchsorted(self.rows["step"], [first, last])
        agents = len(self.agents) if last - first == self.steps else len(np.unique(self.rows["agent"][begin:end]))
        if (last - first) * agents <= MOST_CELLS or last - first <= SHORTEST:
            yield first, last
        else:
            middle = (first + last) // 2
            yield from self._spans(first, middle)
            yield from self._spans(middle, last)

    def part(self, first: int, last: int) -> Recording:
        """Return the steps from `first` to `last`, without it, with the agents that are there during them."""
        begin, end = np.searchsorted(self.rows["step"], [first, last])
        rows = select(self.rows, slice(begin, end))
        there, column = np.unique(rows["agent"], return_inverse=True)
        return dataclasses.replace(
            self,
            id=f"{self.id} from step {first}",
            source=self.source | {"steps": [first, last]},
            steps=last - first,
            agents=tuple(self.agents[agent] for agent in there),
            rows=rows | {"step": rows["step"] - first, "agent": column},
            light_state=self.light_state[first:last],
            routes=tuple(self.routes[agent] for agent in there),
        )


def read_recording(folder: Path, findings: Findings) -> Recording | None:
    """Read the files of an Episode; `findings` get all that is wrong in them, and the Recording is without it.

    Returns None where nothing can be read: a file is missing, truncated or foreign, or the head has no rate, steps or
    agents.
    """
    path = folder / "episode.json"
    try:
        head = read_json(path)
        digests = _check_files(folder, head)
        rate, steps, labels, agents = _parse_head(path, head, findings)
        name, source = typed_field(head, "id", str, path), typed_field(head, "source", dict, path)
        lanes, lights = _parse_map(folder / "map.json", findings)
    except (BadInputError, OSError) as error:
        findings.refused(error)
        return None
    source = _parse_source(source, findings)
    tables: list[Any] = []
    for read in (
        lambda: read_rows(folder, steps, agents, lights, findings),
        lambda: _read_lights(folder / "lights.parquet", steps, lights, findings),
        lambda: _read_routes(folder, agents, findings),
    ):
        try:
            tables.append(read())
        except (BadInputError, OSError) as error:
            findings.refused(error)
    if len(tables) < 3:
        return None
    rows, light_state, routes = tables
    return Recording(name, source, rate, steps, labels, agents, lanes, lights, rows, light_state, routes, digests)


def _check_files(folder: Path, head: dict[str, Any]) -> dict[str, str]:
    """Return the digests of the files, which are those in the head."""
    path = folder / "episode.json"
    version = head.get("schema_version")
    if version not in (SCHEMA_VERSION, WITH_CLASSES):
        raise BadInputError(
            f"{path}: schema_version is {version!r}; this program reads {SCHEMA_VERSION} and {WITH_CLASSES}"
        )
    digests = typed_field(head, "digests", dict, path)
    for file in FILES:
        if not (folder / file).is_file():
            raise BadInputError(f"{folder / file} is missing: the Episode is not whole; record or copy it again")
        if digests.get(file) != file_digest(folder / file):
            raise BadInputError(
                f"{folder / file} does not match its digest in episode.json: truncated or changed; get it again"
            )
    return digests  # type: ignore[no-any-return]


def _parse_map(path: Path, findings: Findings) -> tuple[tuple[Lane, ...], tuple[Light, ...]]:
    try:
        return parse_map(read_json(path), findings)
    except fields.BadFieldError as error:
        raise BadInputError(f"{path}: {error}") from error


def _parse_head(path: Path, head: dict[str, Any], findings: Findings) -> tuple[float, int, str, tuple[Agent, ...]]:
    try:
        rate = fields.number(head, "rate_hz", "", 0, 10_000)
        steps = fields.integer(head, "steps", "")
        labels = typed_field(head, "labels", str, path)
        version = head["schema_version"]
        agents = parse_objects(head, "agents", lambda place, row: _agent(place, row, version), path.name, findings)
        if labels not in LABELS:
            raise BadInputError(f"{path}: field 'labels' is '{labels}'; choose from {', '.join(LABELS)}")
        if not 0 <= steps <= MOST_STEPS:
            raise BadInputError(f"{path}: field 'steps' is {steps}; 0 to {MOST_STEPS:,} are needed")
    except fields.BadFieldError as error:
        raise BadInputError(f"{path}: {error}") from error
    return rate, steps, labels, tuple(agents)


def _agent(place: str, row: dict[str, Any], version: float) -> Agent:
    number = fields.integer(row, "id", place)
    name = f"{place} (agent {number})"
    size = fields.number(row, "length", name, 0, 100), fields.number(row, "width", name, 0, 20)
    if "class" in row and version == SCHEMA_VERSION:
        text = f"field '{name}.class' needs schema_version {WITH_CLASSES} in the head, which is {version}"
        raise fields.BadFieldError(text, "class")
    kind = fields.choice(row, "class", name, CLASSES)
    return Agent(number, *size, fields.truth(row, "ego", name, default=kind == VEHICLE), kind)


def _parse_source(source: dict[str, Any], findings: Findings) -> dict[str, Any]:
    """Return the source without top-level keys that hold NaN or infinities, which JSON has not."""
    for place in fields.not_finite(source, "source"):
        findings.add("episode.json", f": field '{place}' is not finite; write null, or leave it out")
    return {name: value for name, value in source.items() if not any(fields.not_finite(value, name))}


def _read_lights(path: Path, steps: int, lights: tuple[Light, ...], findings: Findings) -> NDArray[np.uint8]:
    """Return the state of each light at each step; where `findings` get one that has none, it is red."""
    columns, null = read_columns(path, LIGHTS, set(LIGHTS.names))
    step, light, state = columns["step"], columns["light"], columns["state"]
    at, known = positions(light, [item.id for item in lights])
    numbers = np.arange(len(step))
    bad = null.copy()

    def check(wrong: NDArray[np.bool_], text: str) -> None:
        wrong = wrong & ~bad
        rows = np.flatnonzero(wrong)
        if len(rows):
            row = rows[0]
            words = text.format(step=step[row], light=light[row], state=state[row])
            findings.add(path.name, f", row {numbers[row]}{words}", len(rows))
        bad[wrong] = True

    if null.any():
        findings.add(path.name, f", row {int(null.argmax())}: null where a number is needed", int(null.sum()))
    check(~known, ", field 'light': {light} is not among the declared lights")
    check((step < 0) | (step >= steps), f", field 'step': {{step}} is outside 0 to {steps - 1}")
    check((state < 0) | (state > RED), ", field 'state': {state} is none of 0, 1 and 2, green, yellow and red")
    good = ~bad
    again = np.zeros(len(step), bool)
    again[good] = repeated(step[good], at[good])
    check(again, ": light {light} has two states in step {step}")
    good = ~bad
    counts = np.bincount(at[good], minlength=len(lights))
    if (counts < steps).any() and steps > 0:
        short = int((counts < steps).argmax())
        has = np.zeros(steps, bool)
        has[step[good & (at == short)]] = True
        text = f": light {lights[short].id} has no state 0, 1 or 2 at step {int(has.argmin())}"
        findings.add(path.name, text, int((steps - counts).sum()), "states of lights")
        if findings.errors and steps * len(lights) > 16 * (len(step) + MOST_CELLS):
            raise BadInputError(f"{path}{text}; every light needs a state at every step")
    table = np.full((steps, len(lights)), RED, np.uint8)
    table[step[good], at[good]] = state[good]
    return table


def _read_routes(folder: Path, agents: tuple[Agent, ...], findings: Findings) -> tuple[Floats, ...]:
    columns, null = read_columns(folder / "routes.parquet", ROUTES, set(ROUTES.names))
    at, known = positions(columns["agent"], [agent.id for agent in agents])
    points = np.stack([columns["x"], columns["y"]], axis=1).astype(np.float32)
    numbers = np.arange(len(points))
    unknown = null | ~known
    text = ", field 'agent': {agent} is not among the declared agents"
    findings.add_rows(unknown, numbers, columns["agent"], text, file="routes.parquet")
    infinite = ~unknown & ~np.isfinite(points).all(axis=1)
    text = ", field 'x' or 'y': the route of agent {agent} is not finite"
    findings.add_rows(infinite, numbers, columns["agent"], text, file="routes.parquet")
    good = np.flatnonzero(~unknown & ~infinite)
    order = good[np.argsort(at[good], kind="stable")]
    ends = np.searchsorted(at[order], np.arange(1, len(agents)))
    return tuple(np.split(points[order], ends)) if agents else ()
