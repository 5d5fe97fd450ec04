"""What SUMO tells of vehicles and persons: read from FCD output, or from a scenario that is run through TraCI.

Positions are of the front's middle, angles are compass degrees: clockwise from north. Of persons, the lane is empty,
and those in a vehicle are left out.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import socket
import subprocess
import tempfile
import xml.etree.ElementTree as ET
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from study.convert.sumo_net import Net
from study.convert.xml import number, opened, read_xml, text
from study.episode.schema import RATE_HZ
from study.errors import BadInputError

SIZES = {  # SUMO's default length and width of each vehicle class [m]
    "passenger": (5.0, 1.8),
    "delivery": (6.5, 2.16),
    "emergency": (6.5, 2.16),
    "truck": (7.1, 2.4),
    "trailer": (16.5, 2.55),
    "bus": (12.0, 2.5),
    "coach": (14.0, 2.6),
    "motorcycle": (2.2, 0.9),
    "moped": (2.1, 0.8),
    "bicycle": (1.6, 0.65),
    "pedestrian": (0.215, 0.478),
}
DEFAULT_TYPES = {"DEFAULT_VEHTYPE": "passenger", "DEFAULT_BIKETYPE": "bicycle", "DEFAULT_TAXITYPE": "taxi"}
DEFAULT_TYPES |= {"DEFAULT_PEDTYPE": "pedestrian"}
PERSON = "person "  # before the ids of persons, which may be those of vehicles
MISSING = "the extra 'sumo' is not installed: pip install 'study[sumo]' brings SUMO and TraCI"

Kind = tuple[float, float, str]  # length and width [m], vehicle class


@dataclass
class Trace:
    """Rows of vehicles and persons, one for each at each step, and the state of each light at each step."""

    source: Path
    rate: float
    begin: float
    steps: int
    step: NDArray[np.int64]
    vehicle: NDArray[np.int64]  # index into the three lists
    lane: list[str]
    values: NDArray[np.float64]  # [N, 4]: x, y [m], angle [compass degrees], speed [m/s]
    names: list[str]
    kinds: list[Kind]
    routes: list[list[str]]  # edges, empty where unknown
    states: dict[str, list[str]] = field(default_factory=dict)

    @property
    def times(self) -> NDArray[np.float64]:
        """Return the time of each step [s]."""
        return self.begin + np.arange(self.steps) / self.rate


class _Rows:
    """Rows as they come in."""

    def __init__(self) -> None:
        self.step: list[int] = []
        self.vehicle: list[int] = []
        self.lane: list[str] = []
        self.values: list[Sequence[float]] = []
        self.known: dict[str, int] = {}

    def add(self, step: int, name: str, lane: str, values: Sequence[float]) -> None:
        self.step.append(step)
        self.vehicle.append(self.known.setdefault(name, len(self.known)))
        self.lane.append(lane)
        self.values.append(values)

    def columns(self) -> tuple[NDArray[np.int64], NDArray[np.int64], list[str], NDArray[np.float64], list[str]]:
        values = np.array(self.values, np.float64).reshape(-1, 4)
        return np.array(self.step, np.int64), np.array(self.vehicle, np.int64), self.lane, values, list(self.known)


# --- FCD output -----------------------------------------------------------------------------------------------------


def read_fcd(path: Path, net: Net, demand: Sequence[Path], tls_states: Path | None) -> Trace:
    """Read FCD output; `demand` are the files with vehicle types and routes, `tls_states` is SaveTLSStates output.

    Raises BadInputError, naming file and field, for missing or wrong values, uneven times, vehicle types whose size is
    unknown, and lights whose states cannot be told.
    """
    rows = _Rows()
    times: list[float] = []
    types: list[str] = []
    with opened(path) as stream:
        for _, element in ET.iterparse(stream):  # noqa: S314 - expat itself refuses entities that grow
            if element.tag != "timestep":
                continue
            for row in element:
                walks = row.tag == "person"
                if row.tag not in {"vehicle", "person"} or row.get("vehicle"):  # a person in a vehicle
                    continue
                name, known = PERSON * walks + text(row, "id", path), len(rows.known)
                values = [number(row, column, path) for column in ("x", "y", "angle", "speed")]
                rows.add(len(times), name, "" if walks else text(row, "lane", path), values)
                if len(rows.known) > known:
                    types.append(text(row, "type", path))
            times.append(number(element, "time", path))
            element.clear()
    if not rows.step:
        raise BadInputError(f"{path}: field 'timestep': there is no vehicle; is it fcd-output?")
    rate, step_of = _steps(np.array(times), path)
    kinds, routes = _read_demand(demand)
    step, vehicle, lane, states, names = rows.columns()
    sizes = [_kind(name, kinds, path) for name in types]
    ways = [routes.get(name, []) for name in names]
    steps = int(step_of[-1]) + 1
    trace = Trace(path, rate, times[0], steps, step_of[step], vehicle, lane, states, names, sizes, ways)
    trace.states = _light_states(net, trace, tls_states)
    return trace


def _steps(times: NDArray[np.float64], path: Path) -> tuple[float, NDArray[np.int64]]:
    if len(times) < 2:
        raise BadInputError(f"{path}: field 'time': one timestep is no recording")
    period = float(np.median(np.diff(times)))
    steps = (times - times[0]) / period if period > 0 else np.full(len(times), np.nan)
    uneven = ~(np.abs(steps - steps.round()) < 0.1)
    if uneven.any():
        raise BadInputError(
            f"{path}: field 'time': {times[uneven.argmax()]:g} s is no multiple of the steps of {period:g} s"
        )
    return round(1 / period, 6), steps.round().astype(np.int64)


def _read_demand(paths: Sequence[Path]) -> tuple[dict[str, Kind], dict[str, list[str]]]:
    """Return vehicle types by id and the edges of vehicles' routes by vehicle id."""
    kinds: dict[str, Kind] = {}
    routes: dict[str, list[str]] = {}
    for path in paths:
        with opened(path) as stream:
            root = ET.parse(stream).getroot()  # noqa: S314 - expat itself refuses entities that grow
        named = {row.get("id", ""): row.get("edges", "").split() for row in root.iter("route")}
        for row in root.iter("vType"):
            group = row.get("vClass", "passenger")
            length, width = SIZES.get(group, SIZES["passenger"])
            kinds[text(row, "id", path)] = number(row, "length", path, length), number(row, "width", path, width), group
        for row in root.iter("vehicle"):
            own = row.find("route")
            edges = own.get("edges", "").split() if own is not None else named.get(row.get("route", ""), [])
            routes[text(row, "id", path)] = edges
    return kinds, routes


def _kind(name: str, kinds: dict[str, Kind], path: Path) -> Kind:
    if name in kinds:
        return kinds[name]
    if name not in DEFAULT_TYPES:
        raise BadInputError(
            f"{path}: 'vehicle', field 'type': the size of '{name}' is unknown; name the file that defines it with "
            "--routes"
        )
    group = DEFAULT_TYPES[name]
    return *SIZES.get(group, SIZES["passenger"]), group


def _light_states(net: Net, trace: Trace, path: Path | None) -> dict[str, list[str]]:
    """Return the states of each light from a file, or else from its static program."""
    recorded: dict[str, list[tuple[float, str]]] = {}
    if path is not None:
        for row in read_xml(path, "tlsStates").iter("tlsState"):
            entry = number(row, "time", path), text(row, "state", path)
            recorded.setdefault(text(row, "id", path), []).append(entry)
    states = {}
    for tl, program in net.programs.items():
        if tl in recorded:
            moments = np.array([moment for moment, _ in recorded[tl]])
            at = np.searchsorted(moments, trace.times + 1e-3, side="right") - 1
            if at[0] < 0:
                raise BadInputError(
                    f"{path}: light '{tl}', field 'time': its states begin at {moments[0]:g} s, {trace.source} at "
                    f"{trace.begin:g} s"
                )
            states[tl] = [recorded[tl][place][1] for place in at.tolist()]
        elif program.static:
            states[tl] = program.at(trace.times)
        else:
            raise BadInputError(
                f"{net.path}: 'tlLogic' {tl}, field 'type': only a static program tells its states; write "
                "SaveTLSStates output of this light and name it with --tls-states, or give --no-lights"
            )
    return states


# --- TraCI ----------------------------------------------------------------------------------------------------------


def net_of(scenario: Path) -> Path:
    """Return the net that a .sumocfg names. Raises BadInputError where it names none."""
    root = read_xml(scenario, "configuration")
    name = next((row.get("value") or row.get("v") for row in root.iter("net-file")), None)
    if not name:
        raise BadInputError(f"{scenario}: field 'net-file' is missing")
    return scenario.parent / name


def run_scenario(scenario: Path, net: Net, seed: int, warm_up: float, seconds: float) -> Trace:
    """Run a scenario at 10 Hz with a seed, and return what is there during `seconds` after a warm-up [s].

    Vehicles are never teleported. Raises BadInputError when SUMO is not installed, or refuses the scenario.
    """
    rows = _Rows()
    kinds: list[Kind] = []
    states: dict[str, list[str]] = {tl: [] for tl in net.programs}
    with _connected(scenario, seed) as connection:
        connection.simulationStep(connection.simulation.getTime() + warm_up if warm_up else 0)
        begin, step = connection.simulation.getTime(), 0
        new = connection.vehicle.getIDList()
        codes = _codes()
        connection.simulation.subscribe((codes.VAR_DEPARTED_VEHICLES_IDS, codes.VAR_MIN_EXPECTED_VEHICLES))
        for tl in states:
            connection.trafficlight.subscribe(tl, (codes.TL_RED_YELLOW_GREEN_STATE,))
        while True:
            _take(connection, new, step, rows, kinds)
            _take_persons(connection, step, rows, kinds)
            for tl, result in connection.trafficlight.getAllSubscriptionResults().items():
                states[tl].extend(result.values())
            step += 1
            if step >= round(seconds * RATE_HZ):
                break
            connection.simulationStep()
            world = connection.simulation.getSubscriptionResults()
            new = world[codes.VAR_DEPARTED_VEHICLES_IDS]
            if not world[codes.VAR_MIN_EXPECTED_VEHICLES]:
                break
        still = set(connection.vehicle.getIDList())  # the others have arrived, and shown their way
        routes = [list(connection.vehicle.getRoute(name)) if name in still else [] for name in rows.known]
    at, vehicle, lane, values, names = rows.columns()
    return Trace(scenario, RATE_HZ, begin, step, at, vehicle, lane, values, names, kinds, routes, states)


def _take(connection: Any, new: Sequence[str], step: int, rows: _Rows, kinds: list[Kind]) -> None:
    """Add the rows of a step, and the kinds of vehicles that are seen first; `new` are to be subscribed."""
    vehicle = connection.vehicle
    codes = _codes()
    place, angle, speed, lane = codes.VAR_POSITION, codes.VAR_ANGLE, codes.VAR_SPEED, codes.VAR_LANE_ID
    for name in new:
        vehicle.subscribe(name, (place, angle, speed, lane))
    for name, values in sorted(vehicle.getAllSubscriptionResults().items()):
        if not values[lane]:  # it is parked beside the road
            continue
        if name not in rows.known:
            kinds.append((vehicle.getLength(name), vehicle.getWidth(name), vehicle.getVehicleClass(name)))
        rows.add(step, name, values[lane], (*values[place], values[angle], values[speed]))


def _take_persons(connection: Any, step: int, rows: _Rows, kinds: list[Kind]) -> None:
    """Add the rows of the persons that are on foot in a step; they have no lane."""
    person, codes = connection.person, _codes()
    place, angle, speed, vehicle = codes.VAR_POSITION, codes.VAR_ANGLE, codes.VAR_SPEED, codes.VAR_VEHICLE
    known = person.getAllSubscriptionResults()
    for name in sorted(person.getIDList()):
        if name not in known:
            person.subscribe(name, (place, angle, speed, vehicle))
            known[name] = person.getSubscriptionResults(name)
        values = known[name]
        if values[vehicle]:
            continue
        if PERSON + name not in rows.known:
            kinds.append((person.getLength(name), person.getWidth(name), "pedestrian"))
        rows.add(step, PERSON + name, "", (*values[place], values[angle], values[speed]))


def _codes() -> Any:
    return import_module("traci").constants


@contextlib.contextmanager
def _connected(scenario: Path, seed: int) -> Iterator[Any]:
    """Start SUMO with a scenario and yield the connection; SUMO ends with the block."""
    if find_spec("traci") is None:
        raise BadInputError(MISSING)
    traci = import_module("traci")
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    options = {"step-length": 1 / RATE_HZ, "seed": seed, "time-to-teleport": -1, "remote-port": port}
    command = [_sumo(), "-c", str(scenario), "--no-step-log", "--no-warnings"]
    command += [word for name, value in options.items() for word in (f"--{name}", str(value))]
    with tempfile.TemporaryFile("w+") as said:
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=said)
        try:
            with contextlib.redirect_stdout(None):  # TraCI prints that it waits
                connection = traci.connect(port, proc=process, waitBetweenRetries=0.2)
            yield connection
            connection.close()
        except (traci.exceptions.TraCIException, traci.exceptions.FatalTraCIError) as error:
            process.wait(10)
            said.seek(0)
            lines = [line for line in said.read().splitlines() if line.startswith("Error")]
            raise BadInputError(f"{scenario}: SUMO cannot run it ({lines[0] if lines else error})") from error
        finally:
            if process.poll() is None:
                process.kill()
            process.wait()


def _sumo() -> str:
    """Return the path of the program `sumo`: that of the package eclipse-sumo, of SUMO_HOME, or on the path."""
    package = find_spec("sumo")
    homes = [*(package.submodule_search_locations or () if package else ()), os.environ.get("SUMO_HOME", "")]
    for home in homes:
        if (program := shutil.which("sumo", path=str(Path(home) / "bin"))) is not None:
            return program
    if (program := shutil.which("sumo")) is None:
        raise BadInputError(MISSING)
    return program
