"""Rollouts: an actor drives, and the drive is an Episode like any recorded one."""

from __future__ import annotations

from collections.abc import Collection
from functools import cache

import numpy as np

from study.birdview.limits import Limits
from study.config.paper import IMAGE
from study.config.settings import SPEEDS, StudySettings
from study.data.true_state import Columns
from study.driving.actors import Actor, Expert
from study.driving.drives import Drive
from study.driving.observations import Observations
from study.driving.ride import Ride
from study.episode.schema import Episode
from study.errors import BadInputError


class ActorError(BadInputError):
    """An actor that raised; the message says where."""


def rollout(
    drive: Drive,
    actor: Actor,
    settings: StudySettings,
    *,
    only: Collection[int] | None = None,
) -> list[Episode]:
    """Return a drive as each of the actor's drivers has driven it, at 10 Hz, all side by side in copies of the town.

    With `only`, some of the drivers drive, as they do among the others: the actor decides for all in any case.

    An Episode's `source["drive"]` has the ego's agent number, the step at which the actor took over, and what ended the
    drive: "time", "collision", "off route", "blocked", or "failure" with its reason. Equal arguments give equal bits.
    Steering is cropped at `driving.crop`. The paper's 0.25 (Sec. IV-C) is too little for right turns of our town: the
    expert itself, cropped there, leaves its way; at 0.42 it does not.
    Raises ActorError when the actor raises, BadInputError for a town that cannot be drawn.
    """
    first = Ride(drive, settings)
    if actor.sees:
        first.paint_map()
    rides = [first, *(first.copy() for _ in range(actor.drivers - 1))]
    chosen = range(len(rides)) if only is None else sorted(only)
    for driver in set(range(len(rides))).difference(chosen):
        rides[driver].ended = "left out"
    seen = _nothing(rides)
    while any(not ride.ended for ride in rides):
        for place, ride in enumerate(rides):
            seen.driving[place] = not ride.ended
            if not ride.ended:
                ride.observe()
                seen.speeds[place], seen.steering[place], seen.level[place] = ride.past()
                if actor.sees:
                    seen.image[place] = ride.view()
        _step(rides, actor, seen)
    return [rides[driver].episode(actor.name, driver) for driver in chosen]


def _step(rides: list[Ride], actor: Actor, seen: Observations) -> None:
    try:
        commands = actor.commands(seen)
    except Exception as error:
        place = int(seen.driving.argmax())
        raise ActorError(
            f"actor '{actor.name}' raised {type(error).__name__}: {error}; at {rides[place].time:.1f} s of drive "
            f"{rides[place].drive.seed}"
        ) from error
    for place, ride in enumerate(rides):
        if ride.ended:
            continue
        if commands is None:
            ride.follow(cropped=isinstance(actor, Expert) and actor.cropped)
        else:
            ride.act(float(commands.steering[place]), float(commands.level[place]))


def _nothing(rides: list[Ride]) -> Observations:
    drivers, limits = len(rides), cache(lambda: Limits(rides[0].map[0]))

    def state() -> Columns:
        rows = [ride.state(limits()) for ride in rides]
        return {name: np.concatenate([row[name] for row in rows]) for name in rows[0]}

    return Observations(
        np.zeros((drivers, IMAGE, IMAGE, 3), np.uint8),
        np.zeros((drivers, SPEEDS), np.float32),
        np.zeros(drivers, np.float32),
        np.zeros(drivers, np.int64),
        np.zeros(drivers, bool),
        state,
    )
