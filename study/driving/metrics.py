"""Scores of a drive: pure functions of its Episode, as `rollout` returns it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from study.analysis.comfort import comfortable
from study.birdview.targets import corners
from study.driving.faults import at_fault
from study.driving.surface import off_road
from study.episode.schema import PEDESTRIAN, RED, Agent, Episode

WALKER, VEHICLE, LAYOUT, RED_LIGHT = 0.50, 0.60, 0.65, 0.70  # penalties of the CARLA leaderboard, for each infraction
KERB = 0.3  # a corner this far beyond every lane is over the kerb [m]

Floats = NDArray[np.float64]


def _unit(text: str) -> Any:
    return field(metadata={"unit": text})


@dataclass(frozen=True)
class DriveScores:
    """The scores of one drive, over the time that the actor drove.

    `route_completion`: way made along the planned route, as a share of the expert's way in the same drive, at most 1
        (the leaderboard's route has an end; ours goes on, so the expert's way is its length, as in nuPlan's
        ego_progress_along_expert_route).
    `driving_score`: 100 x route completion x the product of the penalties, one for each infraction: 0.50 a collision
        with a pedestrian, 0.60 with a vehicle, 0.65 a layout infraction, 0.70 a red light (CARLA leaderboard 1.0).
    `success`: 1 when the actor drove for the whole time without any infraction, else 0.
    `collision`: 1 when the drive ended in one; `at_fault`: 1 when that was the ego's fault (nuPlan, `faults`).
    `red_lights`: stop lines that the front bumper crossed while the light was red (the leaderboard's test).
    `layout`: times that a corner of the ego left the road by more than 0.3 m. It stands for the leaderboard's
        collisions with the layout: our town has no solid kerbs.
    `off_route`: 1 when the drive ended since the ego's centre was more than 4 m from its planned path (ours; the
        leaderboard ends a drive at 30 m).
    `blocked`: 1 when the drive ended since the ego stood for 10 s while the expert, in its place, would have gone
        (ours; the leaderboard waits 180 s).
    `failed`: 1 when the actor gave a command that is none.
    `distance`: way made, on the route or not. `time`: that the actor drove. `mean_speed`: distance over time.
    `comfort`: share of the time within all of nuPlan's bounds (`comfortable`); the expert, whose brake is -5 m/s2, is
        not comfortable by them, so it is to be read beside the expert's own.
    `steering_rate`: root mean square of the applied steering label's change, its oscillation (the whiteness of Tampuu
        et al. 2023, Sensors 23(5) 2845).
    """

    route_completion: float = _unit("share")
    driving_score: float = _unit("0 to 100")
    success: float = _unit("0 or 1")
    collision: float = _unit("0 or 1")
    at_fault: float = _unit("0 or 1")
    red_lights: float = _unit("count")
    layout: float = _unit("count")
    off_route: float = _unit("0 or 1")
    blocked: float = _unit("0 or 1")
    failed: float = _unit("0 or 1")
    distance: float = _unit("km")
    time: float = _unit("s")
    mean_speed: float = _unit("m/s")
    comfort: float = _unit("share")
    steering_rate: float = _unit("1/s")


UNITS = {item.name: str(item.metadata["unit"]) for item in fields(DriveScores)}


class _Track:
    """The ego's part of an Episode, from the step at which the actor took over."""

    def __init__(self, episode: Episode) -> None:
        facts = episode.source["drive"]
        (column,) = (place for place, agent in enumerate(episode.agents) if agent.id == facts["ego"])
        rows = slice(facts["first_step"], episode.steps)
        self.agent, self.light = episode.agents[column], episode.light[rows, column]
        self.light_state = episode.light_state[rows]
        names = ("x", "y", "heading", "speed", "steering", "route_s", "light_distance")
        parts = (getattr(episode, name)[rows, column].astype(np.float64) for name in names)
        self.x, self.y, self.heading, self.speed, self.steering, self.route_s, self.light_distance = parts


def progress(episode: Episode) -> float:
    """Return the way that the ego made along its planned route [m]: of the expert's drive, the route's length."""
    s = _Track(episode).route_s
    return float(s[-1] - s[0]) if len(s) else 0.0


def score_drive(episode: Episode, route_length: float) -> DriveScores:
    """Return the scores of a drive; `route_length` is the `progress` [m] of the expert in the same drive."""
    facts, track = episode.source["drive"], _Track(episode)
    ended, collision = facts["ended"], facts["collision"]
    completion = float(np.clip(progress(episode) / max(route_length, 1e-9), 0, 1))
    reds, layout = _red_lights(track), _layout(track, episode)
    other = _other(collision, episode)
    penalties = (
        (WALKER if other and other.kind == PEDESTRIAN else VEHICLE) ** (ended == "collision")
        * LAYOUT**layout
        * RED_LIGHT**reds
    )
    time = len(track.speed) / episode.rate_hz
    distance = float(track.speed.sum()) / episode.rate_hz
    changes = np.diff(track.steering) * episode.rate_hz
    return DriveScores(
        route_completion=completion,
        driving_score=100 * completion * penalties,
        success=float(ended == "time" and not reds and not layout),
        collision=float(ended == "collision"),
        at_fault=float(_at_fault(collision, other, episode)),
        red_lights=float(reds),
        layout=float(layout),
        off_route=float(ended == "off route"),
        blocked=float(ended == "blocked"),
        failed=float(ended == "failure"),
        distance=distance / 1000,
        time=time,
        mean_speed=distance / time if time else 0.0,
        comfort=float(comfortable(track.speed, track.heading, episode.rate_hz).mean()) if time else 1.0,
        steering_rate=float(np.sqrt((changes**2).mean())) if len(changes) else 0.0,
    )


def _other(collision: dict[str, Any] | None, episode: Episode) -> Agent | None:
    """Return the agent that the ego collided with."""
    return next((agent for agent in episode.agents if collision and agent.id == collision["agent"]), None)


def _at_fault(collision: dict[str, Any] | None, other: Agent | None, episode: Episode) -> bool:
    if collision is None or other is None:
        return False
    poses = np.array(collision["ego"]), np.array(collision["other"])
    return at_fault(*poses, episode.lanes, (other.length, other.width))


def collisions_per_km(scores: Sequence[DriveScores], *, at_fault: bool) -> float:
    """Return the collisions of all drives, at fault or not, over the way of all [1/km]; NaN without any way."""
    count = sum(score.at_fault if at_fault else score.collision - score.at_fault for score in scores)
    distance = sum(score.distance for score in scores)
    return count / distance if distance else float("nan")


def _red_lights(track: _Track) -> int:
    """Count the stop lines crossed at red: a light whose distance falls below that of the front bumper."""
    before = (track.light >= 0) & (track.light_distance > track.agent.length / 2)
    after = (track.light[1:] != track.light[:-1]) | (track.light_distance[1:] <= track.agent.length / 2)
    crossed = np.flatnonzero(before[:-1] & after)
    return int((track.light_state[crossed + 1, track.light[crossed]] == RED).sum())


def _layout(track: _Track, episode: Episode) -> int:
    """Count the times that a corner of the ego's box left the road."""
    poses = np.stack([track.x, track.y, track.heading], axis=1)
    points = corners(poses, track.agent.length, track.agent.width)
    out = off_road(points.reshape(-1, 2), episode.lanes, KERB).reshape(-1, 4).any(axis=1)
    return int((np.diff(out.astype(np.int8), prepend=0) == 1).sum())
