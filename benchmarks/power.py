"""How often the claims' rules are wrong under no difference, and what they find when there is one: by simulation.

python benchmarks/power.py [--studies 1000]

Simulates studies of a known truth with the spreads that were measured at the profile `laptop` (benchmarks/README.md):
encoders by head set, test drives, policies, epochs that remember the one before; tails of Student's t with three
degrees of freedom. Judges each by `study.analysis.claims`, prints a table, and keeps it in results/power.json.
"""

from __future__ import annotations

import argparse
import json
import math
import platform
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy import signal

from study.analysis import claims
from study.analysis.claims import CLAIMS, Evidence
from study.config.grid import Grid, Rules
from study.config.heads import HEAD_SETS
from study.statistics import effects
from study.statistics.drives import DriveScores
from study.statistics.learning_curves import ACCURACY, STEERING, Point

Array = NDArray[np.float64]
RESULT = Path(__file__).with_name("results") / "power.json"

# Accuracy and steering loss of rec by epoch, as the laptop profile's `heads` has them (reports/reference/heads).
EPOCHS = 100
KNOTS = np.array([1, 2, 5, 10, 20, 50, 100])
REC_ACCURACY = (0.674, 0.720, 0.756, 0.792, 0.8076, 0.8284, 0.846)
FAST_ACCURACY = (0.674, 0.74, 0.80, 0.835, 0.8455, 0.846, 0.846)  # of a rec that is done after 20 epochs
REC_STEERING = np.array([2.7, 2.3, 1.73, 1.21, 0.79, 0.43, 0.27]) * 1e-3
FLOOR = 0.00482  # steering loss of the best constant command there
ENCODERS = {"rec": 0.0015, "rec+pred": 0.0021, "rec+plan": 0.0067, "full": 0.0029}  # s of reports/reference
DRIVES = 16  # test drives there: what `Truth.drive` is stated for


@dataclass(frozen=True)
class Truth:
    """A true world, in shares of accuracy unless stated.

    `gain`: by head set, above rec at all the data; `encoder`: s by head set, half of its variance from drives that an
    encoder happens to suit; `drive`: standard error of a difference of two head sets by the choice of 16 drives,
    whatever the encoders; `drives`: number of test drives; `policy`: sd over policies of one encoder, of a wander that
    remembers 0.95 of the epoch before; `start`: sd over policies in the first epoch; `spread`: factor on both for rec;
    `epoch`: sd of each epoch; `steering`: mean loss by head set, as a multiple of rec's; `curve`: rec's mean accuracy
    at KNOTS; `tails`: degrees of freedom of encoders, drives and policies.
    """

    gain: Mapping[str, float] = field(default_factory=dict)
    encoder: Mapping[str, float] = field(default_factory=lambda: ENCODERS)
    drive: float = 0.0036
    drives: int = DRIVES
    policy: float = 0.003
    start: float = 0.03
    spread: float = 1.0
    epoch: float = 0.0013
    steering: Mapping[str, float] = field(default_factory=dict)
    curve: tuple[float, ...] = REC_ACCURACY
    tails: float = 3.0

    def mean_curve(self) -> Array:
        """Return rec's accuracy by epoch without any spread."""
        return np.asarray(np.interp(np.log(np.arange(1, EPOCHS + 1)), np.log(KNOTS), self.curve))


def draw(rng: np.random.Generator, tails: float, *shape: int) -> Array:
    """Return draws of mean 0 and variance 1 with the tails of Student's t, cut at ten standard deviations."""
    scale = math.sqrt((tails - 2) / tails)
    return np.asarray(np.clip(scale * rng.standard_t(tails, shape), -10, 10))


def wander(rng: np.random.Generator, tails: float, *shape: int) -> Array:
    """Return curves [..., epochs] of variance 1 that remember 0.95 of the epoch before."""
    steps = math.sqrt(1 - 0.95**2) * rng.normal(size=(*shape, EPOCHS))
    steps[..., 0] = draw(rng, tails, *shape)
    return np.asarray(signal.lfilter([1], [1, -0.95], steps))


def simulate(grid: Grid, truth: Truth, seed: int) -> Evidence:
    """Return what the claims' rules look at, of one study of that grid in that world."""
    rng = np.random.default_rng(seed)
    shape, epoch = (grid.encoder_seeds, grid.policy_seeds), np.arange(1, EPOCHS + 1)
    index = pd.MultiIndex.from_product([range(n) for n in shape], names=["encoder_seed", "policy_seed"])
    frames = np.round(rng.gamma(8, 20, truth.drives)) + 20
    weights = frames / frames.sum()
    single = truth.drive * math.sqrt(DRIVES / 2)  # sd of one drive's effect on one head set
    common, seeds = draw(rng, truth.tails, truth.drives), draw(rng, truth.tails, *shape)
    curve, loss = truth.mean_curve(), np.interp(np.log(epoch), np.log(KNOTS), REC_STEERING)
    panels: dict[str, dict[Point, pd.DataFrame]] = {ACCURACY: {}, STEERING: {}}
    scores: dict[str, dict[Point, DriveScores | None]] = {ACCURACY: {}, STEERING: {}}

    def keep(metric: str, point: Point, values: Array, by_drive: Array) -> None:
        """Keep curves [E, P, epochs], moved by the drives' part, and the scores by drive [E, P, drives]."""
        values += (by_drive @ weights)[..., None]
        table = values[..., -1:] + by_drive - (by_drive @ weights)[..., None]
        panels[metric][point] = pd.DataFrame(values.reshape(-1, EPOCHS), index, epoch)
        scores[metric][point] = DriveScores(pd.DataFrame(table.reshape(len(index), -1), index), frames)

    for point in effects.points(grid):
        heads, s = point[0], truth.encoder[point[0]] / math.sqrt(2)
        wide = truth.spread if heads == "rec" else 1.0
        drive = single * draw(rng, truth.tails, truth.drives) + 0.08 * common
        suits = s * math.sqrt(DRIVES) * draw(rng, truth.tails, shape[0], 1, truth.drives)
        noise = 0.01 * rng.normal(size=(*shape, truth.drives))
        policies = truth.start * draw(rng, truth.tails, *shape, 1) * np.exp(-(epoch - 1) / 1.5)
        policies = wide * (policies + truth.policy * wander(rng, truth.tails, *shape))
        values = curve + truth.gain.get(heads, 0.0) + s * draw(rng, truth.tails, shape[0], 1, 1) + policies
        values += truth.epoch * rng.normal(size=(*shape, EPOCHS))
        keep(ACCURACY, point, values, drive - 0.08 * (common @ weights) + suits + noise)
        size = truth.steering.get(heads, 1.0) * loss
        factor = 0.07 * seeds + 0.035 * draw(rng, truth.tails, *shape) + 0.05 * draw(rng, truth.tails, shape[0], 1)
        losses = size * np.exp(np.clip(factor, -0.5, 0.5)[..., None] + 0.05 * rng.normal(size=(*shape, EPOCHS)))
        of_drives = 0.05 * size[-1] * math.sqrt(DRIVES) * (draw(rng, truth.tails, truth.drives) + common)
        keep(STEERING, point, losses, np.broadcast_to(of_drives, noise.shape))
    return Evidence(grid, panels, FLOOR, scores)


RULES = Rules()
HEADS = Grid(name="heads", title="T", heads=tuple(HEAD_SETS))
DATASIZE = Grid(name="datasize", title="T", heads=("rec", "full"), fractions=(1, 0.5, 0.25, 0.125, 0.0625))
RUNG = {"rec": 0.0, "rec+pred": 0.01, "rec+plan": 0.02, "full": 0.03}
ONE_IS_NOT = {"rec": 0.0, "rec+pred": 0.05, "rec+plan": 0.05, "full": 0.1}  # the hardest case for H2: one rung is none
AT_BOUND = RULES.steering_good * FLOOR / REC_STEERING[-1]


def sized(grid: Grid, encoders: int, policies: int) -> Grid:
    """Return a grid of that many encoders, and policies on each."""
    return grid.model_copy(update={"encoder_seeds": encoders, "policy_seeds": policies})


def outcomes(grid: Grid, truth: Truth, studies: int, names: tuple[str, ...] = tuple(CLAIMS)) -> pd.DataFrame:
    """Return each claim's outcome (columns) in each simulated study (rows), without claims that are not tested."""
    rows = []
    for seed in range(studies):
        evidence = simulate(grid, truth, seed)
        verdicts = [claims.verdict(CLAIMS[name], evidence) for name in names]
        rows.append({each.claim: each.outcome for each in verdicts if each.outcome != "not tested"})
    return pd.DataFrame(rows)


def rates(table: pd.DataFrame, outcome: str = "reproduced") -> dict[str, float]:
    """Return the share of studies in which each claim has that outcome."""
    return {str(name): float((column == outcome).mean()) for name, column in table.items()}


NULLS: dict[str, tuple[Grid, Truth, tuple[str, ...]]] = {
    f"{name}, {design}, {grid.name} {'+'.join(wanted)}": (sized(grid, *size), truth, wanted)
    for design, size in {"A (1 encoder x 15 policies)": (1, 15), "B (5 x 3)": (5, 3)}.items()
    for name, grid, truth, wanted in (
        ("no difference", HEADS, Truth(), ("H0", "H2", "H3")),
        ("no difference, small drive effect", HEADS, Truth(drive=0.0025), ("H0", "H2", "H3")),
        ("one rung is none, others +5 points", HEADS, Truth(gain=ONE_IS_NOT), ("H2", "H3")),
        ("no difference", HEADS, Truth(), ("H4", "H5")),
        ("steering at its bound", HEADS, Truth(steering=dict.fromkeys(HEAD_SETS, AT_BOUND)), ("H1",)),
        ("no difference", DATASIZE, Truth(), ("D2", "D3")),
        ("steering at the margin", DATASIZE, Truth(steering={"full": 1 + RULES.steering_margin}), ("D1",)),
        ("no difference", DATASIZE, Truth(), ("D4",)),
    )
}
SLOW = {"H4", "H5", "D4"}  # bootstraps and jackknives: a quarter of the studies
POWERS: dict[str, tuple[Grid, Truth, tuple[str, ...]]] = {
    **{
        f"+1 point a rung, {encoders} x {policies}, {drives} drives": (
            sized(HEADS, encoders, policies),
            Truth(gain=RUNG, drives=drives),
            ("H0", "H2", "H3"),
        )
        for drives in (DRIVES, 64)
        for encoders, policies in ((1, 15), (5, 3), (8, 2), (15, 1), (20, 1))
    },
    **{
        f"variance of rec x 4, {encoders} x {policies}": (sized(HEADS, encoders, policies), Truth(spread=2.0), ("H5",))
        for encoders, policies in ((1, 15), (5, 3))
    },
}


def main() -> None:
    """Print the rates and keep them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--studies", type=int, default=1000, help="of each row (default: 1000)")
    parser.add_argument("--only", default="", help="rows whose name holds this")
    options = parser.parse_args()
    result: dict[str, Any] = {"python": platform.python_version()}
    for part, rows in (("false reproduced", NULLS), ("power", POWERS)):
        result[part] = {}
        for name, (grid, truth, wanted) in rows.items():
            if options.only not in name:
                continue
            studies = options.studies // (4 if SLOW & set(wanted) else 1)
            result[part][name] = {"studies": studies, **rates(outcomes(grid, truth, studies, wanted))}
            shares = ", ".join(f"{claim} {100 * result[part][name][claim]:.1f} %" for claim in wanted)
            print(f"{part}: {name} ({studies} studies): {shares}", flush=True)
            if not options.only:
                RESULT.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
