"""A SUMO net as lanes, links between them and traffic lights.

Units are metres and m/s, x is east and y north, as in an Episode. Lanes for pedestrians or trains alone are left out.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from study.convert.xml import number, place, polyline, read_xml, text
from study.episode.schema import GREEN, RED, YELLOW, Lane, Light
from study.errors import BadInputError

WIDTH = 3.2  # SUMO's default of a lane [m]
ROAD = {"passenger", "private", "taxi", "bus", "coach", "delivery", "truck", "trailer", "motorcycle", "bicycle"}
STATES = (
    dict.fromkeys("Gg", GREEN) | dict.fromkeys("oO", GREEN) | dict.fromkeys("Yy", YELLOW) | dict.fromkeys("rus", RED)
)

Points = NDArray[np.float64]


@dataclass(frozen=True)
class Link:
    """A way from a lane to another, over the internal lane `via`; `signal` is its place in the state of light `tl`."""

    start: str
    to: str
    via: str
    tl: str
    signal: int


@dataclass(frozen=True)
class Program:
    """The program of a light: states in turn, each with its duration [s]; only a static one tells the states."""

    static: bool
    offset: float
    durations: NDArray[np.float64]
    states: tuple[str, ...]

    def at(self, seconds: NDArray[np.float64]) -> list[str]:
        """Return the state at each moment."""
        ends = self.durations.cumsum()
        moments = np.mod(seconds - self.offset + 1e-6, ends[-1])
        return [self.states[phase] for phase in np.searchsorted(ends, moments, side="right").tolist()]


@dataclass(frozen=True)
class Net:
    """A net: shapes of lanes by id, lanes by edge, rightmost first, links by the lane that they leave."""

    path: Path
    lanes: tuple[Lane, ...]
    lights: tuple[Light, ...]
    shapes: dict[str, Points]
    edge_of: dict[str, str]
    lanes_of: dict[str, list[str]]
    links: dict[str, list[Link]]
    programs: dict[str, Program]
    light_of: dict[tuple[str, str, int], int]  # (lane, tl, signal) -> index into `lights`

    def way(self, start: str, edge: str) -> tuple[Link, list[str]] | None:
        """Return a link from a lane, or else from one beside it, to an edge, and the internal lanes on its way."""
        here = self.lanes_of[self.edge_of[start]]
        nearest = sorted(here, key=lambda lane: abs(here.index(lane) - here.index(start)))
        for lane in nearest:
            for link in self.links.get(lane, ()):
                if self.edge_of.get(link.to) == edge:
                    return link, self._inside(link)
        return None

    def _inside(self, link: Link) -> list[str]:
        inside: list[str] = []
        via = link.via
        while via in self.shapes and via not in inside:
            inside.append(via)
            via = next((onward.via for onward in self.links.get(via, ())), "")
        return inside

    def light_states(self, states: Mapping[str, Sequence[str]], steps: int, source: Path) -> NDArray[np.uint8]:
        """Return the state [T, L] of each light from the states of each tlLogic, one text for each step."""
        table = np.full((steps, len(self.lights)), RED, np.uint8)
        for (_, tl, signal), light in self.light_of.items():
            letters = {state: state[signal : signal + 1] for state in set(states[tl])}
            for state, letter in letters.items():
                if letter not in STATES:
                    raise BadInputError(
                        f"{source}: light '{tl}' has the state '{state}', in which place {signal} is none of "
                        f"{''.join(STATES)}: is it of another net than {self.path}?"
                    )
            table[:, light] = [STATES[letters[state]] for state in states[tl]]
        return table


def read_net(path: Path, lights: bool = True) -> Net:  # noqa: FBT001, FBT002
    """Read a .net.xml, or .net.xml.gz. Raises BadInputError for anything else, and for a net without lights.

    Without `lights`, a net may have none, and those that it has are left out.
    """
    root = read_xml(path, "net")
    shapes: dict[str, Points] = {}
    lanes_of: dict[str, list[str]] = {}
    found: list[tuple[ET.Element, ET.Element]] = []
    for edge in root.iter("edge"):
        if edge.get("function", "normal") not in {"normal", "internal"}:
            continue
        name = text(edge, "id", path)
        for lane in sorted(edge.iter("lane"), key=lambda lane: number(lane, "index", path)):
            if _for_vehicles(lane):
                shapes[text(lane, "id", path)] = polyline(lane, "shape", path)
                lanes_of.setdefault(name, []).append(text(lane, "id", path))
                found.append((edge, lane))
    if not shapes:
        raise BadInputError(f"{path}: field 'edge': there is no lane for vehicles")
    edge_of = {lane: edge for edge, lanes in lanes_of.items() for lane in lanes}
    links = _read_links(root, path)
    programs = _read_programs(root, path) if lights else {}
    if lights and not programs:
        raise BadInputError(
            f"{path}: field 'tlLogic': the net has no traffic lights; netconvert --tls.guess adds them, --no-lights "
            "converts the net as it is"
        )
    lanes = _lanes(root, found, lanes_of, path)
    numbers = {text(lane, "id", path): number_ for number_, (_, lane) in enumerate(found)}
    light_of: dict[tuple[str, str, int], int] = {}
    signals: list[Light] = []
    for link in (link for lane in shapes for link in links.get(lane, ()) if link.tl and programs):
        if link.tl not in programs:
            raise BadInputError(f"{path}: 'connection' of {link.start}, field 'tl': there is no tlLogic '{link.tl}'")
        if (link.start, link.tl, link.signal) not in light_of:
            light_of[link.start, link.tl, link.signal] = len(signals)
            governed = lanes[numbers[link.start]]
            signals.append(Light(len(signals), _stop_line(governed), governed.id))
    return Net(path, lanes, tuple(signals), shapes, edge_of, lanes_of, links, programs, light_of)


def _for_vehicles(lane: ET.Element) -> bool:
    allow, disallow = lane.get("allow", "all").split(), lane.get("disallow", "").split()
    if "disallow" in lane.keys():  # noqa: SIM118 - an element's items are its children
        return "all" not in disallow and not set(disallow) >= ROAD
    return "all" in allow or bool(ROAD & set(allow))


def _read_links(root: ET.Element, path: Path) -> dict[str, list[Link]]:
    links: dict[str, list[Link]] = {}
    for row in root.iter("connection"):
        start = f"{text(row, 'from', path)}_{text(row, 'fromLane', path)}"
        to = f"{text(row, 'to', path)}_{text(row, 'toLane', path)}"
        tl = row.get("tl", "")
        signal = int(number(row, "linkIndex", path)) if tl else -1
        links.setdefault(start, []).append(Link(start, to, row.get("via", ""), tl, signal))
    return links


def _read_programs(root: ET.Element, path: Path) -> dict[str, Program]:
    """Return the programs; of several for one light the first, with which SUMO starts, and not static."""
    programs: dict[str, Program] = {}
    for logic in root.iter("tlLogic"):
        phases = list(logic.iter("phase"))
        if not phases:
            raise BadInputError(f"{path}: {place(logic)} has no 'phase'")
        durations = np.array([number(phase, "duration", path) for phase in phases])
        if (durations <= 0).any():
            raise BadInputError(f"{path}: {place(logic)}, field 'duration': {durations.min():g} s; above 0 is needed")
        name = text(logic, "id", path)
        static = logic.get("type") == "static" and name not in programs
        states = tuple(text(phase, "state", path) for phase in phases)
        offset = logic.get("offset", "0")
        seconds = number(logic, "offset", path) if offset != "begin" else 0.0
        first = programs.get(name, Program(static, seconds, durations, states))
        programs[name] = Program(static, first.offset, first.durations, first.states)
    return programs


def _lanes(
    root: ET.Element, found: list[tuple[ET.Element, ET.Element]], lanes_of: dict[str, list[str]], path: Path
) -> tuple[Lane, ...]:
    """Return the lanes; where roads in both directions touch is a solid line, at the side of the road a curb."""
    ways = {(edge.get("from"), edge.get("to")) for edge, _ in found}
    right_hand = root.get("lefthand") not in {"true", "1"}
    lanes = []
    for key, (edge, lane) in enumerate(found):
        beside = lanes_of[text(edge, "id", path)]
        at, inside = beside.index(text(lane, "id", path)), edge.get("function") == "internal"
        middle = "solid" if (edge.get("to"), edge.get("from")) in ways else "curb"
        outer = "curb" if at == 0 else "dashed"
        inner = middle if at == len(beside) - 1 else "dashed"
        left, right = (inner, outer) if right_hand else (outer, inner)
        lanes.append(
            Lane(
                key,
                polyline(lane, "shape", path),
                number(lane, "width", path, WIDTH),
                "none" if inside else left,
                "none" if inside else right,
                inside,
                number(lane, "speed", path),
            )
        )
    return tuple(lanes)


def _stop_line(lane: Lane) -> Points:
    ahead = lane.centre[-1] - lane.centre[-2]
    across = np.array([ahead[1], -ahead[0]]) / max(float(np.hypot(*ahead)), 1e-9) * lane.width / 2
    return np.stack([lane.centre[-1] + across, lane.centre[-1] - across])
