"""Adapting: any valid Episode as one that the study can use. What its writer left out is filled in from the motion.

*Rate.* Bird views need 10 Hz. Positions, speeds and distances are interpolated, headings the short way round; lights
and commands are those of the nearest earlier step. An agent is there at a moment when it is at the steps around it.

*Commands.* Where nobody has any, they are derived for all agents that may be ego. Where some have, an agent without
any is traffic and no ego; of a step with one of both the other is derived; a step with neither stays unknown and gives
no frame. Derived commands follow from the motion between the step before and the second step after:

- steering: the wheel angle of the bicycle model whose axles are the agent's length apart (highway-env's, so that of
  our town), sin(slip) = yaw rate * length / (2 * speed), angle = atan(2 * tan(slip)), over `STEERING_UNIT`; at most a
  third of pi, and zero below `CREEP`, where the motion does not show the wheel;
- acceleration: -1 below `BRAKING`, and for an agent that stands and stays; 1 above `STRONG`; else 0.5.

*Progress.* A missing `route_s` is the arclength of the route's nearest point, near that of the step before.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from study.episode.schema import RATE_HZ, Episode
from study.errors import BadInputError

SLOWEST_RATE = 2.0  # below it, straight lines between positions are no drive any more [Hz]
STEERING_UNIT = 2.4  # wheel angle [rad] of a steering label of one, as in our town
MOST_STEERING = np.pi / 3  # [rad]
CREEP = 1.0  # [m/s]
BRAKING, STRONG = -0.5, 1.2  # [m/s2]: the town's throttle gives at most 1.0 at one half, 1.4 and more at one
STANDING = 0.1  # [m/s]
OFF_ROUTE = 10.0  # farther from its route than this, an agent has left it [m]
SLACK = 5.0  # how far progress may be from what the speed says [m]
ASKEW = 0.4  # between heading and motion; more than that at a quarter of all moments is another convention [rad]

Floats = NDArray[np.float32]
Bools = NDArray[np.bool_]


@dataclass(frozen=True)
class Adapted:
    """An Episode for the study, and at how many moments of its egos a command was derived, or is unknown."""

    episode: Episode
    derived: int
    skipped: int

    @property
    def egos(self) -> int:
        """Agents that may be ego and are there at all."""
        may = np.array([agent.ego for agent in self.episode.agents], bool)
        return int((may & self.episode.present.any(axis=0)).sum())


def adapt(episode: Episode, source: str) -> Adapted:
    """The Episode at 10 Hz with commands and progress filled in (see above); `source` names it in errors.

    Raises BadInputError when headings do not fit the motion, and for rates below 2 Hz.
    """
    _check_headings(episode, source)
    written = {"rate_hz": episode.rate_hz, "labels": episode.labels, "digest": episode.digest}
    episode = _fill_progress(_resample(episode, source))
    adapted = _fill_commands(episode)
    named = dataclasses.replace(adapted.episode, source=episode.source | {"imported": written}, digest="")
    return dataclasses.replace(adapted, episode=named)


def _turn(angle: NDArray[Any]) -> NDArray[Any]:
    """The same angle within half a turn."""
    wrapped: NDArray[Any] = np.mod(angle + np.pi, 2 * np.pi) - np.pi
    return wrapped


def _check_headings(episode: Episode, source: str) -> None:
    both = episode.present[1:] & episode.present[:-1] & (episode.speed[:-1] > 2 * CREEP)
    with np.errstate(invalid="ignore"):
        motion = np.arctan2(np.diff(episode.y, axis=0), np.diff(episode.x, axis=0))
        off = np.where(both, np.abs(_turn(motion - episode.heading[:-1])), 0)
    if not both.any() or np.quantile(off[both], 0.75) <= ASKEW:
        return
    step, column = np.unravel_index(int(off.argmax()), off.shape)
    row = int(episode.present.reshape(-1)[: step * off.shape[1] + column].sum())
    raise BadInputError(
        f"{source}: states.parquet, row {row}, field 'heading' (step {step}, agent {episode.agents[column].id}): "
        f"{episode.heading[step, column]:.3g} does not fit the motion, which goes to {motion[step, column]:.3g}; "
        "headings are radians, anticlockwise from the x axis"
    )


# --- rate -----------------------------------------------------------------------------------------------------------


def _resample(episode: Episode, source: str) -> Episode:
    rate = episode.rate_hz
    if abs(rate - RATE_HZ) < 1e-9:
        return episode
    if rate < SLOWEST_RATE:
        raise BadInputError(
            f"{source}: episode.json, field 'rate_hz': {rate:g} steps per second are too few to tell how vehicles "
            f"moved; {SLOWEST_RATE:g} or more are needed"
        )
    at = np.arange(int((episode.steps - 1) / rate * RATE_HZ + 1e-9) + 1) * (rate / RATE_HZ)
    before = np.floor(at + 1e-9).astype(int)
    after = np.minimum(before + 1, episode.steps - 1)
    share = np.where(at - before < 1e-9, 0, at - before)[:, None]
    present = episode.present[before] & (episode.present[after] | (share == 0))

    def between(values: Floats, last: Floats | None = None) -> Floats:
        """Interpolated; the earlier value where the later is unknown."""
        first = values[before].astype(np.float64)
        mixed = first + share * ((values[after] if last is None else last) - first)
        mixture: Floats = np.where(np.isfinite(mixed), mixed, first).astype(np.float32)
        return mixture

    heading = episode.heading[before] + _turn(episode.heading[after] - episode.heading[before])
    same_light = episode.light[before] == episode.light[after]
    changes: dict[str, Any] = {name: between(getattr(episode, name)) for name in ("x", "y", "speed", "route_s")}
    changes |= {name: getattr(episode, name)[before] for name in ("steering", "acceleration", "light", "light_state")}
    changes |= {
        "heading": _turn(between(episode.heading, heading)).astype(np.float32),
        "lead_gap": between(episode.lead_gap),
        "light_distance": between(
            episode.light_distance, np.where(same_light, episode.light_distance[after], np.float32(np.nan))
        ),
    }
    return dataclasses.replace(episode, rate_hz=RATE_HZ, present=present, **changes)


# --- commands -------------------------------------------------------------------------------------------------------


def _fill_commands(episode: Episode) -> Adapted:
    may = np.array([agent.ego for agent in episode.agents], bool)
    steers = episode.present & np.isfinite(episode.steering)
    accelerates = episode.present & np.isfinite(episode.acceleration)
    known = steers | accelerates
    if known.any():
        may &= known.any(axis=0)
        wanted = known & may
    else:
        wanted = episode.present & may
    steering, acceleration = derived_commands(episode)
    steering = np.where(wanted & ~steers, steering, episode.steering)
    acceleration = np.where(wanted & ~accelerates, acceleration, episode.acceleration)
    filled = wanted & ~(steers & accelerates) & np.isfinite(steering) & np.isfinite(acceleration)
    skipped = episode.present & may & ~(np.isfinite(steering) & np.isfinite(acceleration))
    agents = tuple(dataclasses.replace(agent, ego=bool(ego)) for agent, ego in zip(episode.agents, may, strict=True))
    labels = "derived" if filled.any() else episode.labels if known.any() else "none"
    changed = dataclasses.replace(episode, agents=agents, labels=labels, steering=steering, acceleration=acceleration)
    return Adapted(changed, int(filled.sum()), int(skipped.sum()))


def derived_commands(episode: Episode) -> tuple[Floats, Floats]:
    """Steering and acceleration [T, A] float32 as the motion shows them, NaN where it does not (see above)."""
    there = np.pad(episode.present, ((1, 2), (0, 0)))
    steps = np.arange(episode.steps)[:, None]
    back = there[:-3]
    ahead = there[2:-1].astype(int) + (there[2:-1] & there[3:])
    first, last = np.where(back, steps - 1, steps), steps + ahead
    known = episode.present & (last > first)
    with np.errstate(divide="ignore", invalid="ignore"):
        seconds = (last - first) / episode.rate_hz
        columns = np.broadcast_to(np.arange(len(episode.agents)), first.shape)
        turned = _turn(episode.heading[last, columns] - episode.heading[first, columns].astype(np.float64)) / seconds
        change = (episode.speed[last, columns].astype(np.float64) - episode.speed[first, columns]) / seconds
        length = np.array([agent.length for agent in episode.agents])
        speed = (episode.speed[last, columns].astype(np.float64) + episode.speed[first, columns]) / 2
        slip = np.arcsin(np.clip(turned * length / (2 * speed), -0.99, 0.99))
        wheel = np.arctan(2 * np.tan(slip)).clip(-MOST_STEERING, MOST_STEERING)
        wheel = np.where(np.abs(speed) < CREEP, 0, wheel)
        stays = (np.abs(episode.speed) < STANDING) & (change < -BRAKING)
        command = np.select([(change < BRAKING) | stays, change > STRONG], [-1.0, 1.0], 0.5)
    unknown = np.float32(np.nan)
    return (
        np.where(known, wheel / STEERING_UNIT, unknown).astype(np.float32),
        np.where(known, command, unknown).astype(np.float32),
    )


# --- progress -------------------------------------------------------------------------------------------------------


def _fill_progress(episode: Episode) -> Episode:
    progress = episode.route_s.copy()
    for column, route in enumerate(episode.routes):
        missing = np.flatnonzero(episode.present[:, column] & ~np.isfinite(progress[:, column]))
        if len(route) > 1 and len(missing):
            points = np.stack([episode.x[missing, column], episode.y[missing, column]], axis=1).astype(np.float64)
            progress[missing, column] = _along(route.astype(np.float64), points)
    return dataclasses.replace(episode, route_s=progress)


def _along(route: NDArray[np.float64], points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Arclength [M] of the route's point nearest to each of the points [M, 2], NaN where it is far from all of it.

    A route may cross itself: after the first point only what is near the one before is looked at.
    """
    ways = np.diff(route, axis=0)
    lengths = np.hypot(*ways.T)
    ways, starts, lengths = ways[lengths > 0], route[:-1][lengths > 0], lengths[lengths > 0]
    at = np.concatenate([[0.0], lengths.cumsum()])
    found = np.full(len(points), np.nan)
    if not len(ways):
        return found
    previous = None
    for number, point in enumerate(points):
        share = np.clip(((point - starts) * ways).sum(axis=1) / lengths**2, 0, 1)
        distance = np.hypot(*(starts + share[:, None] * ways - point).T)
        s = at[:-1] + share * lengths
        if previous is not None:
            moved = float(np.hypot(*(point - points[number - 1])))
            distance = np.where(np.abs(s - previous) <= moved + SLACK, distance, np.inf)
        nearest = int(distance.argmin())
        previous = s[nearest] if distance[nearest] <= OFF_ROUTE else None
        found[number] = np.nan if previous is None else previous
    return found
