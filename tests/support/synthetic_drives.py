"""Draws what policies do at the wheel from known effects: drives of the columns that a sweep's record has."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import pandas as pd

from study.config.baselines import BASELINES
from study.results.drives import EXPERT

BETTER = {"rec": 30.0, "rec+pred": 45.0, "rec+plan": 60.0, "full": 75.0}


@dataclass(frozen=True)
class Wheel:
    """Holds true driving scores by head set or baseline, and what policies, drives and both together add to them."""

    score: dict[str, float] = field(default_factory=lambda: BETTER)
    policy_sd: float = 2.0
    drive_sd: float = 6.0
    both_sd: float = 6.0
    drives: int = 20
    unseen: int = 10
    policies: int = 5  # of a baseline


def with_drives(record, wheel=None, seed=0, without=()):
    """Return a record whose cells have driven, but for those of the head sets in `without`."""
    wheel, rng = wheel or Wheel(), np.random.default_rng(seed)
    lists = {"town": range(2_000_001, 2_000_001 + wheel.drives), "unseen": range(3_000_001, 3_000_001 + wheel.unseen)}
    effects = {place: rng.normal(0, wheel.drive_sd, len(seeds)) for place, seeds in lists.items()}
    expert = [row for place, seeds in lists.items() for row in _rows(rng, EXPERT, place, seeds, [98.0] * len(seeds))]
    drives = {}
    for key, cell in record.planned.items():
        if key not in record.results or cell.heads in without:
            continue
        rows = list(expert)
        for policy in range(wheel.policies if cell.heads in BASELINES else record.grid.policy_seeds):
            own = wheel.score.get(cell.heads, 20.0) + rng.normal(0, wheel.policy_sd)
            for place, seeds in lists.items():
                scores = own + effects[place] + rng.normal(0, wheel.both_sd, len(seeds)) - 10 * (place == "unseen")
                rows += _rows(rng, policy, place, seeds, scores)
        drives[key] = pd.DataFrame(rows)
    return replace(record, drives=drives)


def _rows(rng, policy, place, seeds, scores):
    return [_row(rng, policy, place, drive, float(score)) for drive, score in zip(seeds, scores, strict=True)]


def _row(rng, policy, place, drive, score):
    """Return one drive of about this score, which may lie beyond 0 to 100: it is the mean that is known."""
    ended = "time" if rng.random() < score / 100 else str(rng.choice(["collision", "off route", "blocked"]))
    share = float(np.clip(score / 100, 0, 1))
    return {
        "policy_seed": policy,
        "place": place,
        "drive": drive,
        "way": 400.0,
        "ended": ended,
        "reason": "",
        "route_completion": share**0.5,
        "driving_score": score,
        "success": float(ended == "time"),
        "collision": float(ended == "collision"),
        "at_fault": float(ended == "collision" and rng.random() < 0.7),
        "red_lights": float(rng.random() > share),
        "layout": float(rng.random() > share),
        "off_route": float(ended == "off route"),
        "blocked": float(ended == "blocked"),
        "failed": 0.0,
        "distance": 0.4 * share,
        "time": 60.0,
        "mean_speed": 0.4 * share * 1000 / 60,
        "comfort": 0.6 + 0.3 * share,
        "steering_rate": 0.5 - 0.4 * share,
    }
