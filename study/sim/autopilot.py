"""The expert: planned routes and the CARLA autopilot's rule (docs/paper.md 2.6), for all vehicles of a town at once.

Arrays have one entry for each of N vehicles: with numpy, a step of a hundred vehicles costs hardly more than a step of
one. Distances along a route are measured at the vehicle's centre; gaps and distances to a stop line from the front
bumper.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from study.config.paper import ACCELERATIONS
from study.config.settings import DynamicsSettings
from study.episode.schema import GREEN, RED, YELLOW
from study.sim.dynamics import BRAKE, DT, LOOK, stopping_distance
from study.sim.geometry import LENGTH, WIDTH, Floats, Ints, Pose, true_pairs, within
from study.sim.town import Town

REACH = LOOK + 8.0  # distance between centres within which lie all vehicles of the look-ahead [m]
MARGIN = 0.1  # added on both sides of a vehicle when its path is tested [m]

KP_LATERAL, KP_HEADING = 1 / 0.6, 1 / 0.2  # gains of highway-env's steering control [1/s]
SLOWEST = 3.0  # steering control divides by at least this speed, or standing cars would turn their wheels wildly [m/s]
MOST_STEERING = np.pi / 3  # [rad]

SPACING = 0.5  # between the samples of a planned path [m]
SAMPLES = 512  # kept of each vehicle's path
AHEAD, BEHIND = 70.0, 10.0  # length of path that is kept at least, before and behind the vehicle [m]
GAP = 7.5  # of street that a waiting vehicle takes [m]
AT_LINE = 5.0  # a vehicle this near to its stop line is the first of its queue [m]
NEVER = 2**62  # a step beyond every drive
GAP_MARGIN = 0.8  # by which a turning vehicle leaves the crossing lane before the other arrives [s]


@dataclass(frozen=True)
class Decisions:
    """The command of every vehicle in one step, and what it was based on; [N] arrays.

    `steering`: label, wheel angle over `steering_unit`, positive to the left. `acceleration`: one of ACCELERATIONS.
    `light`: next signal on the route, -1 for none. `light_distance`: centre to its stop line along the route [m].
    `lead_gap`: free way from the front bumper along the route [m], inf where nothing is within LOOK.
    """

    steering: Floats
    acceleration: Floats
    light: Ints
    light_distance: Floats
    route_s: Floats
    lead_gap: Floats


class Fleet:
    """The state of the autopilot: where every vehicle is on its planned route, and its decisions in force."""

    def __init__(
        self, town: Town, vehicles: int, brake_hold: float, dynamics: DynamicsSettings, rng: np.random.Generator
    ) -> None:
        self.town, self.rng, self.dynamics = town, rng, dynamics
        self.hold_steps = round(brake_hold / DT)
        self.limits = np.array([strip.limit for strip in town.strips])
        self.starts: list[list[float]] = [[] for _ in range(vehicles)]  # of the route's strips, along it
        self.routes: list[list[int]] = [[] for _ in range(vehicles)]  # strips
        self.turns: list[list[tuple[int, float]]] = [[] for _ in range(vehicles)]  # signalled movements ahead
        self.ends = np.zeros(vehicles)  # of the planned route
        self.sampled = np.zeros(vehicles, np.int64)  # strips of the route that `x` and so on hold
        self.x, self.y, self.heading, self.curvature = np.zeros((4, vehicles, SAMPLES))
        self.first, self.filled = np.zeros((2, vehicles), np.int64)  # number of the first sample kept; how many are
        self.s = np.zeros(vehicles)
        self.lateral = np.zeros(vehicles)
        self.at = np.zeros(vehicles, np.int64)  # position in `routes` of the strip that the vehicle is on
        self.strip = np.zeros(vehicles, np.int64)
        self.strip_start, self.strip_end = np.zeros((2, vehicles))
        self.move = np.full(vehicles, -1)  # next or present signalled movement, -1 for none
        self.move_start, self.move_end = np.full((2, vehicles), np.inf)
        self.stopping = np.zeros(vehicles, bool)  # for the light ahead
        self.running = np.zeros(vehicles, bool)  # through a yellow that came too late to stop
        self.held = np.zeros(vehicles, bool)  # before a junction whose exit is full
        self.denied = np.full(vehicles, NEVER)  # step at which that first kept the vehicle from using its green
        self.since = np.zeros(vehicles, np.int64)  # step at which the junction was entered
        self.braking = np.zeros(vehicles, bool)
        self.brake_until = np.zeros(vehicles, np.int64)
        moves = town.movements
        self.move_exit = np.array([move.exit for move in moves], np.int64)
        self.move_yields = np.array([move.turn == town.yielding for move in moves], bool)
        self.move_signal = np.array([town.signal_of[move.entry] for move in moves], np.int64)
        self.move_length = np.array([move.length for move in moves])
        self.street_length = np.array([strip.piece.length for strip in town.strips])
        self.load = np.zeros(len(town.strips))  # vehicles that are on a strip or plan to use it
        self.meets = ~np.isnan(town.enter)  # whether two movements obstruct each other
        across = np.where(town.opposing, town.enter, np.inf)
        self.first_crossing = np.nan_to_num(across, nan=np.inf).min(axis=1, initial=np.inf)

    # --- routes -----------------------------------------------------------------------------------------------------

    def place(self, slot: int, strip: int, s: float) -> None:
        """Give a vehicle a new route that starts on a street's strip, with the vehicle at `s` [m] of it."""
        for old in self.routes[slot][int(self.at[slot]) :]:
            self.load[old] -= 1
        self.routes[slot], self.starts[slot], self.turns[slot] = [], [], []
        self.ends[slot] = self.sampled[slot] = self.first[slot] = self.filled[slot] = self.at[slot] = 0
        self.s[slot], self.lateral[slot] = s, 0.0
        self.stopping[slot] = self.running[slot] = self.held[slot] = self.braking[slot] = False
        self.brake_until[slot] = 0
        self.denied[slot] = NEVER
        self.move[slot] = -1
        self._append(slot, strip)
        self._lengthen(slot)
        self._stand_on(slot)
        self._next_turn(slot)

    def _append(self, slot: int, strip: int) -> None:
        self.routes[slot].append(strip)
        self.starts[slot].append(float(self.ends[slot]))
        self.ends[slot] += self.street_length[strip]
        self.load[strip] += 1

    def _lengthen(self, slot: int) -> None:
        """Extend a route that gets short, and sample the path as far as the look-ahead needs."""
        signalled = bool(self.town.signals)
        while self.ends[slot] < self.s[slot] + AHEAD + 60 or (signalled and len(self.turns[slot]) < 2):
            self._turn(slot, self.rng)
        spare = int(self.s[slot] / SPACING) - int(BEHIND / SPACING) - int(self.first[slot])
        if 0 < spare < self.filled[slot]:
            kept = int(self.filled[slot]) - spare
            for values in (self.x, self.y, self.heading, self.curvature):
                values[slot, :kept] = values[slot, spare : spare + kept]
            self.first[slot] += spare
            self.filled[slot] = kept
        while (self.first[slot] + self.filled[slot]) * SPACING < self.s[slot] + AHEAD + 60:
            self._sample(slot, int(self.sampled[slot]))
            self.sampled[slot] += 1

    def plan(self, slot: int, distance: float, rng: np.random.Generator) -> None:
        """Extend a vehicle's route to `distance` [m] ahead, drawn from `rng`: it no longer depends on the traffic."""
        while self.ends[slot] < self.s[slot] + distance:
            self._turn(slot, rng)

    def _turn(self, slot: int, rng: np.random.Generator) -> None:
        number = self._choose(self.town.ways[self.routes[slot][-1]], rng)
        movement = self.town.movements[number]
        if self.town.phases[movement.node]:
            self.turns[slot].append((number, float(self.ends[slot])))
        for strip in (*movement.strips, movement.exit):
            self._append(slot, strip)

    def _choose(self, ways: tuple[int, ...], rng: np.random.Generator) -> int:
        """Return a random movement; full streets are avoided, since rings of them would lock for ever."""
        exits = self.move_exit[list(ways)]
        free = np.maximum(1 - self.load[exits] * GAP / self.street_length[exits], 0.02) ** 2
        return ways[int(np.searchsorted(np.cumsum(free), rng.random() * free.sum()))]

    def _sample(self, slot: int, number: int) -> None:
        start, filled = self.starts[slot][number], int(self.filled[slot])
        piece = self.town.strips[self.routes[slot][number]].piece
        begin = int(self.first[slot]) + filled
        count = max(int(np.ceil((start + piece.length) / SPACING)) - begin, 0)
        x, y, heading = piece.at(np.arange(begin, begin + count, dtype=np.float64) * SPACING - start)
        if filled:  # headings continue without jumps, so that they can be interpolated
            heading = heading + 2 * np.pi * round((self.heading[slot, filled - 1] - piece.heading) / (2 * np.pi))
        new = slice(filled, filled + count)
        self.x[slot, new], self.y[slot, new], self.heading[slot, new] = x, y, heading
        self.curvature[slot, new] = piece.curvature
        self.filled[slot] += count

    def _stand_on(self, slot: int) -> None:
        at = int(self.at[slot])
        self.strip[slot] = self.routes[slot][at]
        self.strip_start[slot] = self.starts[slot][at]
        # Not the next strip's start: the route may not be planned that far yet.
        self.strip_end[slot] = self.starts[slot][at] + self.street_length[self.routes[slot][at]]

    def _next_turn(self, slot: int) -> None:
        if self.turns[slot]:
            number, start = self.turns[slot].pop(0)
            self.move[slot], self.move_start[slot] = number, start
            self.move_end[slot] = start + self.move_length[number]

    def follow(self, x: Floats, y: Floats) -> None:
        """Locate every vehicle on its planned path, and plan ahead."""
        rows = np.arange(len(x))
        near = (self.s / SPACING).astype(np.int64) - self.first
        window = np.maximum(near[:, None] + np.arange(-3, 7), 0)
        place = (rows * SAMPLES)[:, None] + window
        dx, dy = x[:, None] - self.x.take(place), y[:, None] - self.y.take(place)
        best = (dx * dx + dy * dy).argmin(axis=1)
        k = window[rows, best]
        dx, dy, heading = dx[rows, best], dy[rows, best], self.heading[rows, k]
        c, s = np.cos(heading), np.sin(heading)
        self.s = (self.first + k) * SPACING + dx * c + dy * s
        self.lateral = dy * c - dx * s
        for slot in (self.s > self.strip_end).nonzero()[0].tolist():
            self.load[self.strip[slot]] -= 1
            self.at[slot] += 1
            self._stand_on(slot)
        for slot in (self.s - LENGTH / 2 > self.move_end).nonzero()[0].tolist():
            self._next_turn(slot)
            self.running[slot] = self.stopping[slot] = self.held[slot] = False
            self.denied[slot] = NEVER
        short = (self.first + self.filled) * SPACING < self.s + AHEAD
        for slot in (short | (self.strip_end + 40 > self.ends)).nonzero()[0].tolist():
            self._lengthen(slot)

    def ahead(self, values: Floats, distance: Floats) -> Floats:
        """Return a sampled quantity, interpolated at `distance` [m] ahead."""
        rows = np.arange(len(distance))
        place = (self.s + distance) / SPACING - self.first
        k = np.floor(place).astype(np.int64)
        low = values[rows, k]
        return low + (place - k) * (values[rows, k + 1] - low)

    # --- the rule ---------------------------------------------------------------------------------------------------

    def decide(
        self,
        step: int,
        pose: Pose,
        controls: tuple[Floats, Floats],
        pairs: tuple[Ints, Ints],
        lights: NDArray[np.uint8],
        crossings: Floats | float = np.inf,
    ) -> Decisions:
        """Return every vehicle's command from `pose` (x, y, heading, speed) after `follow`.

        `controls`: acceleration [m/s2] and wheel angle [rad] that act now, the answers to earlier commands.
        `pairs`: each (i, j), sorted, of vehicles within at least REACH of each other; `lights`: states of the signals.
        `crossings`: free way before each bumper to a crossing in use [m].
        """
        _, _, heading, speed = pose
        force, wheel = controls
        lead_gap, lead = self._lead(pose, pairs)
        front = self.s + LENGTH / 2 - self.move_start  # of the bumper, from the stop line; -inf without a light
        state = self._heed_lights(front, speed, force, lights)
        crossing = self._right_of_way(step, front, speed, state, lead_gap, lead)
        lead_gap = np.minimum(lead_gap, crossings)
        gap = np.minimum(np.minimum(lead_gap, crossing), self._room_behind(step, front, speed, state))
        kmh = speed * 3.6
        limit = self.limits[self.strip] * 3.6
        ray = np.maximum(0.5, kmh * kmh / 100) + 2 + speed * self.dynamics.lag
        brake = (kmh >= limit) | self.stopping | (gap < ray)
        self.brake_until[brake & ~self.braking] = step + self.hold_steps  # from the brake's first step on
        brake |= step < self.brake_until
        self.braking = brake
        low, middle, high = ACCELERATIONS
        acceleration = np.where(brake, low, np.where(kmh >= limit - 10, middle, high))
        known = (self.move >= 0) & (self.s <= self.move_start)
        signals = self.move_signal if len(self.move_signal) else np.array([-1])
        return Decisions(
            steering=-self._steer(heading, speed, wheel) / self.dynamics.steering_unit,
            acceleration=acceleration,
            light=np.where(known, signals[self.move], -1),
            light_distance=np.where(known, self.move_start - self.s, np.nan),
            route_s=self.s.copy(),
            lead_gap=lead_gap,
        )

    def _steer(self, heading: Floats, speed: Floats, wheel: Floats) -> Floats:
        """Return wheel angles by highway-env's cascade of lateral and heading control, with curvature fed forward.

        A wheel that lags is steered for the moment at which it has answered: by the pose and the path then.
        """
        lag = self.dynamics.wheel_lag
        v = np.maximum(speed, SLOWEST)
        curvature = self.ahead(self.curvature, speed * (DT + lag))
        course = self.ahead(self.heading, speed * (DT + lag))
        course = course - np.arcsin(curvature * LENGTH / 2)  # the body points inwards
        lateral = self.lateral
        if lag:
            now = np.arctan(np.tan(wheel) / 2)
            aslant = heading + now - self.ahead(self.heading, np.zeros(len(speed)))
            lateral = lateral + lag * speed * np.sin(aslant)
            heading = heading + lag * speed * np.sin(now) / (LENGTH / 2)
        aside = within(np.arcsin(within(-KP_LATERAL * lateral / v, 1)), np.pi / 4)
        error = np.mod(course + aside - heading + np.pi, 2 * np.pi) - np.pi
        rate = v * curvature + KP_HEADING * error
        slip = np.arcsin(within(LENGTH / 2 / v * rate, 1))
        return within(np.arctan(2 * np.tan(slip)), MOST_STEERING)

    def _lead(self, pose: Pose, pairs: tuple[Ints, Ints]) -> tuple[Floats, Ints]:
        """Return the free way before each bumper [m], inf beyond LOOK, and the vehicle that ends it, -1 for none."""
        x, y, heading, _ = pose
        i, j = pairs
        near = np.floor(self.s / SPACING).astype(np.int64) - self.first
        rows = np.arange(len(x))
        middle = near + round(17 / SPACING)
        close = np.hypot(x[j] - self.x[rows, middle][i], y[j] - self.y[rows, middle][i]) < 20.5
        i, j = i[close], j[close]
        window = (rows * SAMPLES + near)[:, None] + np.arange(2, round((LOOK + LENGTH / 2 + 2) / SPACING), 2)
        px, py = self.x.take(window), self.y.take(window)  # twice as fast as by row and column
        dx, dy = px[i] - x[j][:, None], py[i] - y[j][:, None]
        met = ((dx * dx + dy * dy).min(axis=1) < (LENGTH / 2 + WIDTH) ** 2).nonzero()[0]  # beyond, no sample is a hit
        i, j, dx, dy = i[met], j[met], dx[met], dy[met]
        c, s = np.cos(heading)[j][:, None], np.sin(heading)[j][:, None]
        along = np.maximum(np.abs(dx * c + dy * s) - LENGTH / 2, 0)
        aside = np.maximum(np.abs(dy * c - dx * s) - WIDTH / 2, 0)
        away = along * along + aside * aside
        width = WIDTH / 2 + MARGIN
        hit = away < width * width
        hits = hit.any(axis=1).nonzero()[0]
        i, j, away, k = i[hits], j[hits], np.sqrt(away[hits]), hit[hits].argmax(axis=1)
        pair = np.arange(len(i))
        before, after = away[pair, np.maximum(k - 1, 0)], away[pair, k]
        part = np.where(k > 0, (before - width) / np.maximum(before - after, 1e-9), 1.0)
        where = near[i] + 2 * (k + 1) + 2 * (part - 1) + self.first[i]
        distance = where * SPACING - self.s[i] + width - LENGTH / 2
        order = np.lexsort((distance, i))
        i, j, distance = i[order], j[order], distance[order]
        nearest = np.concatenate([i[:1] >= 0, i[1:] != i[:-1]])
        gap, lead = np.full(len(x), np.inf), np.full(len(x), -1)
        gap[i[nearest]], lead[i[nearest]] = distance[nearest], j[nearest]
        gap[gap > LOOK] = np.inf
        return gap, lead

    def _heed_lights(self, front: Floats, speed: Floats, force: Floats, lights: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Decide whether to stop for the light ahead, and return the state that each vehicle faces."""
        state = np.full(len(front), GREEN, np.uint8)
        ruled = self.move >= 0
        state[ruled] = lights[self.move_signal[self.move[ruled]]]
        before = ruled & (front <= 0)
        bound = before & (state != GREEN)
        way = stopping_distance(speed, force, self.dynamics.lag)
        late = bound & (-front < way + DT * speed)  # too late to stop
        heeded = bound & (-front <= way + 0.2 * speed + 2.5)
        self.running = late & ~self.stopping & ((state == YELLOW) | self.running)
        self.stopping = (self.stopping & bound) | (heeded & ~self.running)
        return np.where(before, state, np.where(ruled, GREEN, RED)).astype(np.uint8)

    def _right_of_way(
        self, step: int, front: Floats, speed: Floats, state: NDArray[np.uint8], lead_gap: Floats, lead: Ints
    ) -> Floats:
        """Return the distance from each bumper to where the vehicle must let others pass [m], inf where it need not."""
        town, gap = self.town, np.full(len(front), np.inf)
        if not len(self.move_length):
            return gap
        inside = (self.move >= 0) & (front > 0)
        self.since = np.where(inside, np.minimum(self.since, step), step)
        goes = inside | self.running | ((state == GREEN) & ~self.held)
        waits = (self.move >= 0) & (front > -45)
        one, other = waits.nonzero()[0], (waits & goes).nonzero()[0]
        rows, columns = true_pairs(self.meets[self.move[one]].take(self.move[other], axis=1))
        i, j = one[rows], other[columns]
        a, b = self.move[i], self.move[j]
        into_i, out_i, into_j, out_j = town.enter[a, b], town.leave[a, b], town.enter[b, a], town.leave[b, a]
        open_ = (front[i] - LENGTH < out_i) & (front[j] - LENGTH < out_j) & (front[i] <= into_i)
        begun = np.where(self.move_yields[b], np.minimum(into_j, self.first_crossing[b]), into_j)
        taken = (front[j] > begun) & open_
        across = town.opposing[a, b]
        yields = across & self.move_yields[a] & ~self.move_yields[b]
        # From across: a turn that crosses waits for vehicles that can arrive before it is through.
        stuck = (lead[j] >= 0) & (lead_gap[j] < into_j - front[j]) & (speed[lead[j]] < 2)
        soon = _time(into_j - front[j], speed[j], 2.5, 12.0) < GAP_MARGIN + self.dynamics.lag + _time(
            out_i + LENGTH - front[i], speed[i], 1.7, 9.0
        )
        crossing = self.first_crossing[a]
        turn = yields & (front[i] <= crossing) & (taken | (open_ & soon & ~stuck))
        # From the side: vehicles inside the junction go first, the others wait behind their stop line.
        older = ~across & open_ & (inside[j] | self.running[j])
        line = older & ~inside[i]
        rank = (self.since[j] < self.since[i]) | ((self.since[j] == self.since[i]) & (j < i))
        meet = (older & inside[i] & (taken | rank)) | (across & ~yields & taken)
        for where, distance in ((turn, crossing), (line, np.zeros(len(i))), (meet, into_i)):
            np.minimum.at(gap, i[where], distance[where] - front[i[where]])
        return gap

    def _room_behind(self, step: int, front: Floats, speed: Floats, state: NDArray[np.uint8]) -> Floats:
        """Return the distance to the stop line [m] where the street behind the junction is full, inf elsewhere.

        A vehicle that could not enter at green goes before others into the same street; else the cycles of two
        junctions may let one approach fill it at every green, and keep another waiting.
        """
        room = self.street_length.copy()
        np.minimum.at(room, self.strip, self.s - self.strip_start - LENGTH / 2 + speed * speed / (2 * BRAKE))
        ruled = self.move >= 0
        gap = np.full(len(front), np.inf)
        if not ruled.any():
            return gap
        way_out = self.move_exit[self.move]
        coming = ruled & (front > 0) & (self.strip != way_out)
        taken = np.bincount(way_out[coming], minlength=len(room))
        before = ruled & (front <= 0)
        queue = np.full(len(room), NEVER)
        np.minimum.at(queue, way_out[before], self.denied[before])
        full = room[way_out] < GAP * (taken[way_out] + 1)
        self.held = before & (full | (queue[way_out] < self.denied))
        fresh = self.held & (state == GREEN) & (front > -AT_LINE) & (self.denied == NEVER)
        self.denied[fresh] = step
        gap[self.held] = -front[self.held]
        return gap


def _time(distance: Floats, speed: Floats, acceleration: float, top: float) -> Floats:
    """Return the time to cover a distance when accelerating up to the top speed [s]; 0 for a distance behind."""
    distance, speed = np.maximum(distance, 0), np.minimum(speed, top)
    ramp = (top - speed) / acceleration
    on_ramp = (speed + top) / 2 * ramp
    short = (np.sqrt(speed * speed + 2 * acceleration * distance) - speed) / acceleration
    return np.where(distance < on_ramp, short, ramp + (distance - on_ramp) / top)
