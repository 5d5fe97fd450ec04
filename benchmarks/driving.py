"""Policy-steps per second of one core in closed loop, and what bounds them: `python benchmarks/driving.py`.

Fifteen policies drive one held-out drive of 100 vehicles side by side, on an encoder of the study's shape with its
initial weights. Each part of a step is timed by processor time: deciding and recording, painting, networks, moving.
Printed are medians over rounds with the lowest and highest, in ms for each policy and step.
"""

from __future__ import annotations

import json
import time
from pathlib import Path

import numpy as np
import torch

from study.compute.provenance import provenance
from study.config.paper import IMAGE
from study.config.settings import SPEEDS, StudySettings
from study.driving.actors import PolicyActor, image_encoder
from study.driving.drives import held_out_drives
from study.driving.observations import Observations
from study.driving.ride import Ride
from study.encoder.networks import untrained_encoder
from study.policy.latents import normalisation
from study.policy.networks import slots
from study.randomness import rng

RESULT = Path(__file__).parent / "results" / "driving.json"
POLICIES, STEPS, ROUNDS = 15, 20, 5


def untrained_policies() -> PolicyActor:
    draw = rng(0, "benchmark policies")
    weights = {
        slot.key: draw.normal(size=(POLICIES, *slot.shape)).astype(np.float32) * 0.1
        for name in ("steering", "acceleration")
        for slot in slots(name)
    }
    weights |= normalisation(draw.normal(size=(100, 64)).astype(np.float32), "zscore")
    encoder = {name: value.numpy() for name, value in untrained_encoder(0).state_dict().items()}
    return PolicyActor("untrained", image_encoder(encoder), weights)


def measure(rides: list[Ride], actor: PolicyActor) -> dict[str, float]:
    """Return the ms of each part for each policy and step. The expert moves the egos, so that no drive ends."""
    seen = Observations(
        np.zeros((POLICIES, IMAGE, IMAGE, 3), np.uint8),
        np.zeros((POLICIES, SPEEDS), np.float32),
        np.zeros(POLICIES, np.float32),
        np.zeros(POLICIES, np.int64),
        np.ones(POLICIES, bool),
    )
    parts = dict.fromkeys(("decide", "paint", "networks", "move"), 0.0)
    for _ in range(STEPS):
        times = [time.process_time()]
        for ride in rides:
            ride.observe()
        times.append(time.process_time())
        for place, ride in enumerate(rides):
            seen.image[place] = ride.view()
        times.append(time.process_time())
        actor.commands(seen)
        times.append(time.process_time())
        for ride in rides:
            ride.follow()
        times.append(time.process_time())
        for name, spent in zip(parts, np.diff(times), strict=True):
            parts[name] += float(spent) * 1000 / STEPS / POLICIES
    return parts | {"all": sum(parts.values())}


def main() -> None:
    torch.set_num_threads(1)
    first = Ride(held_out_drives(StudySettings(), 1)[0], StudySettings())
    first.paint_map()
    rides = [first, *(first.copy() for _ in range(POLICIES - 1))]
    actor = untrained_policies()
    measure(rides, actor)
    rounds = [measure(rides, actor) for _ in range(ROUNDS)]
    table = {}
    for name in rounds[0]:
        values = sorted(part[name] for part in rounds)
        table[name] = {"median": float(np.median(values)), "lowest": values[0], "highest": values[-1]}
        print(f"{name:9} {table[name]['median']:6.2f} ms  ({values[0]:.2f} to {values[-1]:.2f}, n={ROUNDS})")
    rate = 1000 / table["all"]["median"]
    print(f"{rate:.0f} policy-steps/s on one core")
    RESULT.write_text(json.dumps({"rate": rate, "ms": table, "provenance": provenance()}, indent=1) + "\n")


if __name__ == "__main__":
    main()
