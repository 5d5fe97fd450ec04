"""Makes small real Episodes with numpy alone: four roads, one crossing with lights, cars that drive routes.

The world: roads along x and y meet at the origin, one lane each way, right-hand traffic. Cars come in from each arm,
stop at red and yellow lights and behind their leader, and go straight, left or right. Everything that an Episode can
hold is there: commands, lights, routes, gaps; and it is a pure function of its arguments.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from study.birdview.renderer import Renderer
from study.config.settings import BirdviewSettings
from study.data.frames import unpack_masks
from study.episode.files import write_episode
from study.episode.schema import GREEN, RED, YELLOW, Agent, Episode, Lane, Light, empty_states

LANE = 3.5  # [m], width
ARM = 120.0  # [m], from the stop line outwards
CORNER = 8.0  # [m], from the origin to each stop line
SPEED = 11.0  # [m/s], the limit
WHEEL_BASE = 2.8  # [m]
CYCLE = 40  # steps of one approach's green, yellow and all red

Points = NDArray[np.float64]


def turned(points: Points, quarters: int) -> Points:
    """Turn points [.., 2] anticlockwise about the origin by quarter turns."""
    angle = np.pi / 2 * quarters
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return np.asarray(points @ turn.T)


def _way(turn: str) -> tuple[Points, Points, Points]:
    """Return the approach from the west, the way through the crossing and the way out, every half metre."""
    y = -LANE / 2
    approach = np.stack([np.arange(-CORNER - ARM, -CORNER + 0.25, 0.5), np.full(int(ARM * 2) + 1, y)], axis=1)
    if turn == "straight":
        inside = np.stack([np.linspace(-CORNER, CORNER, 33), np.full(33, y)], axis=1)
    else:
        side = 1 if turn == "left" else -1
        radius = CORNER - side * y
        angle = np.linspace(0, np.pi / 2, 31)
        inside = np.stack([-CORNER + radius * np.sin(angle), y + side * radius * (1 - np.cos(angle))], axis=1)
    heading = {"straight": (1.0, 0.0), "left": (0.0, 1.0), "right": (0.0, -1.0)}[turn]
    out = inside[-1] + np.arange(0, ARM + 0.25, 0.5)[:, None] * np.array(heading)
    return approach, inside, out


def crossing_lanes() -> tuple[Lane, ...]:
    """Return the map: approach, exit and three ways through for each arm."""
    lanes = []
    for arm in range(4):
        for kind, turn in enumerate(("straight", "left", "right")):
            approach, inside, out = (turned(part, arm) for part in _way(turn))
            lanes.append(Lane(10 * arm + 2 + kind, inside, LANE, junction=True, speed_limit=SPEED))
            if turn == "straight":
                lanes.append(Lane(10 * arm, approach, LANE, left="dashed", right="curb", speed_limit=SPEED))
                lanes.append(Lane(10 * arm + 1, out, LANE, left="dashed", right="curb", speed_limit=SPEED))
    return tuple(lanes)


def crossing_lights() -> tuple[Light, ...]:
    """Return one light at the end of each approach."""
    line = np.array([[-CORNER, -LANE], [-CORNER, 0.0]])
    return tuple(Light(arm, turned(line, arm), lane=10 * arm) for arm in range(4))


def crossing_drive(seed: int = 0, cars: int = 12, steps: int = 80, name: str | None = None) -> Episode:
    """Return an Episode of `steps` at 10 Hz with `cars` at the crossing, each of which may be ego and never leaves."""
    rng = np.random.default_rng([seed, 7])
    clock = np.arange(steps) + int(rng.integers(4 * CYCLE))
    green_arm, phase = clock // CYCLE % 4, clock % CYCLE
    colour = np.select([phase < CYCLE - 16, phase < CYCLE - 6], [GREEN, YELLOW], RED)
    light_state = np.where(green_arm[:, None] == np.arange(4), colour[:, None], RED).astype(np.uint8)

    arms = np.arange(cars) % 4
    place = np.arange(cars) // 4  # in the queue of its arm
    ways = [[turned(part, arm) for part in _way(("straight", "left", "right")[rng.integers(3)])] for arm in arms]
    routes = [np.concatenate([way[0], way[1][1:], way[2][1:]]) for way in ways]
    lengths = [np.concatenate([[0.0], np.hypot(*np.diff(route, axis=0).T).cumsum()]) for route in routes]
    turns = [np.unwrap(np.arctan2(*np.gradient(route, axis=0).T[::-1])) for route in routes]

    s = ARM - 3 - place * 14.0 - rng.uniform(0, 8, cars) - rng.uniform(0, 15, 4)[arms]
    speed = rng.uniform(2, SPEED, cars)
    preferred = SPEED * rng.uniform(0.8, 1.1, cars)
    weave, pace, start = rng.uniform(0.01, 0.5, cars), rng.uniform(0.5, 2.0, cars), rng.uniform(0, 6, cars)
    agents = tuple(Agent(100 + car, 4.6 + 0.1 * (car % 5), 1.9) for car in range(cars))
    states = empty_states(steps, cars)
    states["present"][:] = True
    for step in range(steps):
        for car in range(cars):
            to_line = ARM - s[car]
            gaps = [s[other] - s[car] - 4.8 for other in range(cars) if arms[other] == arms[car] and s[other] > s[car]]
            gap = min(gaps, default=np.inf)
            stop = light_state[step, arms[car]] != GREEN and 0 < to_line < speed[car] ** 2 / 8 + 4
            close = gap < speed[car] ** 2 / 8 + 3
            command = -1.0 if stop or close or speed[car] > preferred[car] else 0.5
            command = 1.0 if command > 0 and speed[car] < preferred[car] - 2.5 else command
            slope = np.interp(s[car] + 1.0, lengths[car], turns[car]) - np.interp(
                s[car] - 1.0, lengths[car], turns[car]
            )
            wheel = np.arctan(WHEEL_BASE * slope / 2.0) + weave[car] * np.sin(pace[car] * step / 10 + start[car]) * (
                speed[car] > 1
            )
            row = {
                "x": np.interp(s[car], lengths[car], routes[car][:, 0]),
                "y": np.interp(s[car], lengths[car], routes[car][:, 1]),
                "heading": np.interp(s[car], lengths[car], turns[car]),
                "speed": speed[car],
                "steering": wheel / 2.0,
                "acceleration": command,
                "route_s": s[car],
                "lead_gap": gap if np.isfinite(gap) else np.nan,
                "light": arms[car] if to_line > 0 else -1,
                "light_distance": to_line if to_line > 0 else np.nan,
            }
            for field, value in row.items():
                states[field][step, car] = value
        command_now = states["acceleration"][step]
        speed = np.clip(speed + np.where(command_now < 0, -5.0, 2.5 * command_now) / 10, 0, None)
        s = s + speed / 10
    return Episode(
        id=name or f"crossing-{seed}",
        source={"writer": "tests", "seed": seed},
        rate_hz=10.0,
        labels="recorded",
        agents=agents,
        lanes=crossing_lanes(),
        lights=crossing_lights(),
        light_state=light_state,
        routes=tuple(route.astype(np.float32) for route in routes),
        **states,
    )


def write_drives(folder: Path, count: int, first_seed: int = 0, cars: int = 12, steps: int = 80) -> list[Path]:
    """Write `count` crossing drives below `folder` and return their folders, in order."""
    paths = [folder / f"drive-{first_seed + number:03d}" for number in range(count)]
    for number, path in enumerate(paths):
        write_episode(crossing_drive(first_seed + number, cars, steps, path.name), path)
    return paths


def bird_view(
    episode: Episode, step: int, agent: int, settings: BirdviewSettings
) -> tuple[NDArray[np.uint8], NDArray[np.bool_], NDArray[np.bool_]]:
    """Return one moment as image [64, 64, 3] uint8 and the masks pred and plan, [64, 64] bool."""
    images, masks = Renderer(episode, settings).render(np.array([[step, agent]]))
    pred, plan = unpack_masks(masks[0]).astype(bool)[:2]
    return images[0], pred, plan
