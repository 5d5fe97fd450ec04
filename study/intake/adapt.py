"""Adapt any valid Episode to the study: what its writer left out is filled in from the motion.

*Rate.* Bird views need 10 Hz. Positions, speeds and distances are interpolated, headings along the shorter arc; lights
and commands are those of the nearest earlier step. An agent is present at a moment when it is at the steps around it.

*Commands.* If no agent has commands, they are derived for all agents that may be ego. If some have, an agent without
commands is traffic and never ego; a step with one of the two commands gets the other derived; a step with neither stays
unknown and gives no frame. Derived commands follow from the motion between the step before and the second step after:

- steering: the wheel angle of the bicycle model whose axles are the agent's length apart (highway-env's, so that of
  our town), sin(slip) = yaw rate * length / (2 * speed), angle = atan(2 * tan(slip)), over `STEERING_UNIT`; at most a
  third of pi, and zero below `CREEP`, where the motion does not show the wheel;
- acceleration: -1 below `BRAKING`, and for an agent that stands still; 1 above `STRONG`; else 0.5.

*Progress.* A missing `route_s` is the arclength of the route's nearest point, near that of the step before.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from study.config.settings import DynamicsSettings
from study.episode.schema import RATE_HZ, Episode
from study.errors import BadInputError
from study.intake.motion import wrap

SLOWEST_RATE = 2.0  # below it, straight lines between positions are too far from a drive [Hz]
STEERING_UNIT = DynamicsSettings().steering_unit  # wheel angle [rad] of a steering label of one, as in our town
MOST_STEERING = np.pi / 3  # [rad]
CREEP = 1.0  # [m/s]
BRAKING, STRONG = -0.5, 1.2  # [m/s2]: the town's throttle gives at most 1.0 at one half, 1.4 and more at one
STANDING = 0.1  # [m/s]
OFF_ROUTE = 10.0  # farther than this from its route, an agent has left it [m]
SLACK = 5.0  # largest difference of progress from the distance moved [m]

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
        """Return how many agents may be ego and are present at any step."""
        return int((_may_be_ego(self.episode) & self.episode.present.any(axis=0)).sum())


def adapt(episode: Episode, source: str) -> Adapted:
    """Return the Episode at 10 Hz with commands and progress filled in (see above); `source` names it in errors.

    Raises BadInputError for rates below 2 Hz.
    """
    original = {"rate_hz": episode.rate_hz, "labels": episode.labels, "digest": episode.digest}
    complete = _fill_progress(resample(episode, source))
    return _fill_commands(dataclasses.replace(complete, source=episode.source | {"imported": original}, digest=""))


def _may_be_ego(episode: Episode) -> Bools:
    return np.array([agent.ego for agent in episode.agents], bool)


# --- rate -----------------------------------------------------------------------------------------------------------


def resample(episode: Episode, source: str) -> Episode:
    """Return the Episode at 10 Hz (see above). Raises BadInputError, which names `source`, for rates below 2 Hz."""
    rate = episode.rate_hz
    if abs(rate - RATE_HZ) < 1e-9:
        return episode
    if rate < SLOWEST_RATE:
        raise BadInputError(
            f"{source}: episode.json, field 'rate_hz': {rate:g} steps per second are too few to tell how vehicles "
            f"moved; {SLOWEST_RATE:g} or more are needed"
        )
    moments = np.arange(int((episode.steps - 1) / rate * RATE_HZ + 1e-9) + 1) * (rate / RATE_HZ)  # in steps
    before = np.floor(moments + 1e-9).astype(int)
    after = np.minimum(before + 1, episode.steps - 1)
    share = np.where(moments - before < 1e-9, 0, moments - before)[:, None]
    present = episode.present[before] & (episode.present[after] | (share == 0))

    def between(values: Floats, last: Floats | None = None) -> Floats:
        """Interpolate; where the later value is unknown, keep the earlier."""
        first = values[before].astype(np.float64)
        mean = first + share * ((values[after] if last is None else last) - first)
        filled: Floats = np.where(np.isfinite(mean), mean, first).astype(np.float32)
        return filled

    heading = episode.heading[before] + wrap(episode.heading[after] - episode.heading[before])
    same_light = episode.light[before] == episode.light[after]
    changes: dict[str, Any] = {name: between(getattr(episode, name)) for name in ("x", "y", "speed", "route_s")}
    changes |= {name: getattr(episode, name)[before] for name in ("steering", "acceleration", "light", "light_state")}
    changes |= {
        "heading": wrap(between(episode.heading, heading)).astype(np.float32),
        "lead_gap": between(episode.lead_gap),
        "light_distance": between(
            episode.light_distance, np.where(same_light, episode.light_distance[after], np.float32(np.nan))
        ),
    }
    return dataclasses.replace(episode, rate_hz=RATE_HZ, present=present, **changes)


# --- commands -------------------------------------------------------------------------------------------------------


def _fill_commands(episode: Episode) -> Adapted:
    egos = _may_be_ego(episode)
    steers = episode.present & np.isfinite(episode.steering)
    accelerates = episode.present & np.isfinite(episode.acceleration)
    known = steers | accelerates
    if known.any():
        egos &= known.any(axis=0)
        wanted = known & egos
    else:
        wanted = episode.present & egos
    steering, acceleration = derived_commands(episode)
    steering = np.where(wanted & ~steers, steering, episode.steering)
    acceleration = np.where(wanted & ~accelerates, acceleration, episode.acceleration)
    filled = wanted & ~(steers & accelerates) & np.isfinite(steering) & np.isfinite(acceleration)
    skipped = episode.present & egos & ~(np.isfinite(steering) & np.isfinite(acceleration))
    agents = tuple(dataclasses.replace(agent, ego=bool(ego)) for agent, ego in zip(episode.agents, egos, strict=True))
    labels = "derived" if filled.any() else episode.labels if known.any() else "none"
    changed = dataclasses.replace(episode, agents=agents, labels=labels, steering=steering, acceleration=acceleration)
    return Adapted(changed, int(filled.sum()), int(skipped.sum()))


def derived_commands(episode: Episode) -> tuple[Floats, Floats]:
    """Return steering and acceleration [T, A] float32 as the motion shows them, NaN where it does not (see above)."""
    present = np.pad(episode.present, ((1, 2), (0, 0)))
    steps = np.arange(episode.steps)[:, None]
    ahead = present[2:-1].astype(int) + (present[2:-1] & present[3:])
    first, last = np.where(present[:-3], steps - 1, steps), steps + ahead
    known = episode.present & (last > first)
    with np.errstate(divide="ignore", invalid="ignore"):
        seconds = (last - first) / episode.rate_hz
        columns = np.broadcast_to(np.arange(len(episode.agents)), first.shape)
        turned = wrap(episode.heading[last, columns] - episode.heading[first, columns].astype(np.float64)) / seconds
        change = (episode.speed[last, columns].astype(np.float64) - episode.speed[first, columns]) / seconds
        length = np.array([agent.length for agent in episode.agents])
        speed = (episode.speed[last, columns].astype(np.float64) + episode.speed[first, columns]) / 2
        slip = np.arcsin(np.clip(turned * length / (2 * speed), -0.99, 0.99))
        wheel = np.arctan(2 * np.tan(slip)).clip(-MOST_STEERING, MOST_STEERING)
        wheel = np.where(np.abs(speed) < CREEP, 0, wheel)
        stays = (np.abs(episode.speed) < STANDING) & (change < -BRAKING)
        command = np.select([(change < BRAKING) | stays, change > STRONG], [-1.0, 1.0], 0.5)
    steering, acceleration = (np.where(known, values, np.nan) for values in (wheel / STEERING_UNIT, command))
    return steering.astype(np.float32), acceleration.astype(np.float32)


# --- progress -------------------------------------------------------------------------------------------------------


def _fill_progress(episode: Episode) -> Episode:
    progress = episode.route_s.copy()
    for column, route in enumerate(episode.routes):
        missing = np.flatnonzero(episode.present[:, column] & ~np.isfinite(progress[:, column]))
        if len(route) > 1 and len(missing):
            points = np.stack([episode.x[missing, column], episode.y[missing, column]], axis=1).astype(np.float64)
            progress[missing, column] = progress_along(route.astype(np.float64), points)
    return dataclasses.replace(episode, route_s=progress)


def progress_along(route: NDArray[np.float64], points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the arclength [M] of the route's point nearest to each of the points [M, 2], NaN where it is far away.

    A route may cross itself: after the first point, only the part near the previous one is searched.
    """
    legs = np.diff(route, axis=0)
    lengths = np.hypot(*legs.T)
    legs, starts, lengths = legs[lengths > 0], route[:-1][lengths > 0], lengths[lengths > 0]
    at = np.concatenate([[0.0], lengths.cumsum()])
    progress = np.full(len(points), np.nan)
    if not len(legs):
        return progress
    previous = None
    for number, point in enumerate(points):
        share = np.clip(((point - starts) * legs).sum(axis=1) / lengths**2, 0, 1)
        distance = np.hypot(*(starts + share[:, None] * legs - point).T)
        s = at[:-1] + share * lengths
        if previous is not None:
            moved = float(np.hypot(*(point - points[number - 1])))
            distance = np.where(np.abs(s - previous) <= moved + SLACK, distance, np.inf)
        nearest = int(distance.argmin())
        previous = s[nearest] if distance[nearest] <= OFF_ROUTE else None
        progress[number] = np.nan if previous is None else previous
    return progress
