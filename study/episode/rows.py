"""The states of an Episode as rows, one for each agent at each step: memory follows what is alive at a time.

`Rows` have equal length N: `step` int64, `agent` (index into the agents) int64, `number` (of the row in its file),
`x`, `y`, ... as in `study.episode.schema`, float32, NaN where unknown, and `light` int32, an index into the lights.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from study.config.paper import ACCELERATIONS
from study.episode.chart import REACH
from study.episode.findings import Findings
from study.episode.schema import OPTIONAL_FLOATS, Agent, Episode, Light, empty_states
from study.errors import BadInputError

FILE = "states.parquet"
REQUIRED = {"step": pa.int32(), "agent": pa.int32()} | dict.fromkeys(("x", "y", "heading", "speed"), pa.float32())
STATES = pa.schema(
    [(name, kind) for name, kind in REQUIRED.items()]
    + [("steering", pa.float32()), ("acceleration", pa.float32()), ("light", pa.int32())]
    + [("light_distance", pa.float32()), ("route_s", pa.float32()), ("lead_gap", pa.float32())]
)
FASTEST = 120.0  # [m/s]

Rows = dict[str, NDArray[Any]]
Bools = NDArray[np.bool_]


def read_columns(path: Path, schema: pa.Schema, required: set[str]) -> tuple[Rows, Bools]:
    """Return the columns of a table that the schema has, and which rows hold null where a number is needed.

    Raises BadInputError, with the field, for a column that is missing or of another type.
    """
    try:
        table = pq.read_table(path, columns=None)
    except (pa.ArrowException, ValueError) as error:
        raise BadInputError(f"{path} is no Parquet table ({str(error).splitlines()[0]}): write it again") from error
    if missing := required - set(table.column_names):
        raise BadInputError(f"{path}: column '{min(missing)}' is missing; it has {', '.join(table.column_names)}")
    columns: Rows = {}
    null = np.zeros(len(table), bool)
    for field in schema:
        if field.name not in table.column_names:
            continue
        if table.column_names.count(field.name) > 1:
            raise BadInputError(f"{path}, field '{field.name}' stands twice in the table; keep one of the columns")
        column = table.column(field.name)
        number = pa.types.is_integer(column.type) or pa.types.is_floating(column.type) or pa.types.is_null(column.type)
        try:
            if not number:
                raise BadInputError(
                    f"{path}, field '{field.name}' holds {column.type}; numbers ({field.type}) are needed"
                )  # noqa: TRY301
            column = column.cast(field.type)
        except pa.ArrowException as error:
            words = str(error).splitlines()[0]
            raise BadInputError(f"{path}, field '{field.name}': {field.type} is needed: {words}") from error
        if not pa.types.is_floating(field.type):
            null |= column.is_null().to_numpy()
            column = column.fill_null(-1)
        columns[field.name] = column.to_numpy()
    return columns, null


def positions(values: NDArray[Any], ids: Sequence[int]) -> tuple[NDArray[np.int64], Bools]:
    """Return where each value stands among the declared ids, and whether it is one of them."""
    if not len(ids):
        return np.zeros(len(values), np.int64), np.zeros(len(values), bool)
    order = np.argsort(ids)
    known = np.array(ids, np.int64)[order]
    at = np.searchsorted(known, values).clip(max=len(known) - 1)
    return order[at], known[at] == values


def repeated(first: NDArray[Any], second: NDArray[Any]) -> Bools:
    """Return which rows have both values of an earlier row."""
    again = np.ones(len(first), bool)
    cells = first.astype(np.int64) * (int(second.max(initial=0)) + 1) + second
    again[np.unique(cells, return_index=True)[1]] = False
    return again


def read_rows(folder: Path, steps: int, agents: Sequence[Agent], lights: Sequence[Light], findings: Findings) -> Rows:
    """Return the rows that are right, sorted by step, then agent; `findings` get the others.

    The rows of the file may stand in any order. Raises BadInputError when the file is no such table.
    """
    columns, null = read_columns(folder / FILE, STATES, set(REQUIRED))
    step, agent = columns.pop("step").astype(np.int64), columns.pop("agent")
    numbers = np.arange(len(step))
    bad = np.zeros(len(step), bool)

    def check(wrong: Bools, text: str, **values: NDArray[Any]) -> None:
        wrong = wrong & ~bad
        if wrong.any():
            findings.add_rows(wrong, numbers, agent, text, {"step": step, **values})
            bad[wrong] = True

    check(null, ": null in step, agent or light, where a number is needed; leave the row out (light: -1 for none)")
    check((step < 0) | (step >= steps), f", field 'step': {{step}} is outside 0 to {steps - 1}, by 'steps' in the head")
    column, known = positions(agent, [item.id for item in agents])
    check(~known, ", field 'agent': {agent} is not among the declared agents; add it to episode.json")
    good = np.flatnonzero(~bad)
    again = np.zeros(len(step), bool)
    again[good] = repeated(step[good], column[good])
    check(again, ": agent {agent} stands twice in step {step}; keep one of the rows")
    if "light" in columns:
        light = columns["light"]
        at, known = positions(light, [item.id for item in lights])
        unknown = (light >= 0) & ~known & ~bad
        text = ", field 'light' (step {step}, agent {agent}): {light} is not among the declared lights"
        findings.add_rows(unknown, numbers, agent, text, {"step": step, "light": light})
        findings.values += int(unknown.sum())
        columns["light"] = np.where((light >= 0) & known, at, -1).astype(np.int32)
        if "light_distance" in columns:
            columns["light_distance"] = np.where(unknown, np.float32(np.nan), columns["light_distance"])
    rows = columns | {"step": step, "agent": column, "number": numbers}
    order = np.lexsort((column, step))
    rows = select(rows, order[~bad[order]] if bad.any() or (np.diff(order) != 1).any() else slice(None))
    wrong = value_faults(rows, agents, findings)
    missing = [name for name in STATES.names if name not in REQUIRED and name not in columns]
    if missing:
        findings.warn(FILE, f": no column {', '.join(missing)}: what they would hold is derived or stays unknown")
    findings.rows += int(bad.sum() + wrong.sum())
    return select(rows, ~wrong) if wrong.any() else rows


def select(rows: Rows, part: Any) -> Rows:
    """Return some of the rows: an index, a slice or a mask."""
    return {name: values[part] for name, values in rows.items()}


def value_faults(rows: Rows, agents: Sequence[Agent], findings: Findings) -> Bools:
    """Return which rows hold impossible values, each by itself; `findings` get them.

    An impossible value that need not be known does not make its row wrong: it is made unknown, NaN, in `rows`.
    """
    ids = np.array([agent.id for agent in agents], np.int64)[rows["agent"]]
    bad = np.zeros(len(ids), bool)

    def check(wrong: Bools, name: str, rule: str) -> None:
        wrong = wrong & ~bad
        if not wrong.any():
            return
        text = f", field '{name}' (step {{step}}, agent {{agent}}): {{value:.8g}} {rule}"
        findings.add_rows(wrong, rows["number"], ids, text, {"step": rows["step"], "value": rows[name]})
        if name in OPTIONAL_FLOATS:
            make_unknown(rows, name, wrong, findings)
        else:
            bad[wrong] = True

    x, y, speed = rows["x"], rows["y"], rows["speed"]
    same = (x == y) & (x == speed) & (x < 0)
    check(same, "x", "is also its y and speed: a mark for a missing state; leave such rows out")
    for name in ("x", "y", "heading", "speed"):
        check(~np.isfinite(rows[name]), name, "is not a finite number; leave out rows of agents that are not there")
    for name in OPTIONAL_FLOATS:
        if name in rows:
            check(np.isinf(rows[name]), name, "is infinite; write null where it is unknown")
    for name in ("x", "y"):
        check(np.abs(rows[name]) > REACH, name, f"is farther than {REACH:g} m from the origin; shift map and agents")
    check(np.abs(speed) > FASTEST, "speed", f"is above {FASTEST:g} m/s; is the unit m/s?")
    if "acceleration" in rows:
        known = ~np.isnan(rows["acceleration"])
        allowed = np.isin(rows["acceleration"], ACCELERATIONS)
        check(known & ~allowed, "acceleration", f"is not one of {ACCELERATIONS}; write null to have it derived")
    if "steering" in rows:
        wheel = "is beyond any wheel: 1 is 1.22 rad of the front wheels to the left; write null to have it derived"
        check(np.abs(rows["steering"]) > 1, "steering", wheel)
    return bad


def make_unknown(rows: Rows, name: str, wrong: Bools, findings: Findings) -> None:
    """Make the values of some rows unknown, and count them."""
    rows[name] = np.where(wrong, np.float32(np.nan), rows[name])
    findings.values += int(wrong.sum())


def dense_states(rows: Rows, steps: int, agents: int) -> dict[str, Any]:
    """Return the arrays [T, A] of an Episode that hold these rows."""
    arrays = empty_states(steps, agents)
    where = (rows["step"], rows["agent"])
    for name, values in rows.items():
        if name in arrays:
            arrays[name][where] = values
    arrays["present"][where] = True
    return arrays


def episode_rows(episode: Episode) -> Rows:
    """Return the rows of an Episode, sorted by step, then agent."""
    where = np.nonzero(episode.present)
    names = ("x", "y", "heading", "speed", "light", *OPTIONAL_FLOATS)
    rows = {name: getattr(episode, name)[where] for name in names}
    return rows | {"step": where[0], "agent": where[1], "number": np.arange(len(where[0]))}
