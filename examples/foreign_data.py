"""Write drives of another world as Episodes, from the text of the format alone: nothing of this program is imported.

The world is one road that bends left and right, with cars that follow each other. See docs/extend/data.md.

    python examples/foreign_data.py FOLDER
    python -m study.data import FOLDER --out data/imported/ring
    python -m study.sweep heads --profile smoke --data data/imported/ring
"""

import hashlib
import json
import sys
from pathlib import Path

import numpy as np
import pandas as pd

DRIVES, CARS, STEPS, RATE_HZ = 6, 10, 200, 10.0
WIDTH, LENGTH = 1.9, 4.5  # of a car [m]
WAVES, RADIUS, SWAY = 5, 90.0, 20.0  # of the road: bends, mean radius and its change [m]


def road(points: int = 2000) -> tuple[np.ndarray, np.ndarray]:
    """Return a closed line [P, 2] in driving direction and its arclength [P], both in metres."""
    angle = np.linspace(0, 2 * np.pi, points)
    radius = RADIUS + SWAY * np.cos(WAVES * angle)
    line = radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return line, np.concatenate([[0.0], np.hypot(*np.diff(line, axis=0).T).cumsum()])


def states(rng: np.random.Generator) -> pd.DataFrame:
    """Return where each car is at each step; all cars speed up, slow down and stop together."""
    line, length = road()
    time = np.arange(STEPS)[:, None] / RATE_HZ
    speed = np.clip(6 + 5 * np.sin(time * rng.uniform(0.3, 0.5) + rng.uniform(0, 6)), 0, 10) + np.zeros((1, CARS))
    progress = np.arange(CARS) * length[-1] / CARS + rng.uniform(0, 10) + speed.cumsum(axis=0) / RATE_HZ

    (x, y), (front_x, front_y) = (
        [np.interp(distance, length, line[:, axis], period=length[-1]) for axis in (0, 1)]
        for distance in (progress, progress + 0.5)
    )
    step, car = np.indices(progress.shape)
    table = {
        "step": step.astype(np.int32),
        "agent": car.astype(np.int32),
        "x": x.astype(np.float32),
        "y": y.astype(np.float32),
        "heading": np.arctan2(front_y - y, front_x - x).astype(np.float32),
        "speed": speed.astype(np.float32),
    }
    return pd.DataFrame({name: values.ravel() for name, values in table.items()})


def write_drive(folder: Path, seed: int) -> None:
    """Write one Episode: map, states, no lights, and each car's way."""
    folder.mkdir(parents=True)
    line, _ = road(300)
    lane = {"id": 0, "centre": line.tolist(), "width": 3.5, "left": "dashed", "right": "curb"}
    world = {"lanes": [lane | {"junction": False, "speed_limit": 11.0}], "lights": []}
    (folder / "map.json").write_text(json.dumps(world))
    states(np.random.default_rng(seed)).to_parquet(folder / "states.parquet", index=False)
    lights = {"step": np.int32, "light": np.int32, "state": np.int8}
    pd.DataFrame({name: np.empty(0, kind) for name, kind in lights.items()}).to_parquet(folder / "lights.parquet")
    way = np.concatenate([line, line[1:]]).astype(np.float32)  # two laps
    routes = {"agent": np.repeat(np.arange(CARS, dtype=np.int32), len(way))}
    routes |= {name: np.tile(way[:, axis], CARS) for axis, name in enumerate("xy")}
    pd.DataFrame(routes).to_parquet(folder / "routes.parquet", index=False)
    files = ("map.json", "states.parquet", "lights.parquet", "routes.parquet")
    head = {
        "schema_version": 1,
        "id": folder.name,
        "source": {"writer": "examples/foreign_data.py", "seed": seed},
        "rate_hz": RATE_HZ,
        "steps": STEPS,
        "labels": "none",  # steering and acceleration follow from the motion when the drives are imported
        "agents": [{"id": car, "length": LENGTH, "width": WIDTH, "ego": True} for car in range(CARS)],
        "digests": {name: hashlib.sha256((folder / name).read_bytes()).hexdigest() for name in files},
    }
    (folder / "episode.json").write_text(json.dumps(head))


if __name__ == "__main__":
    for number in range(DRIVES):
        write_drive(Path(sys.argv[1]) / f"drive-{number}", number)
