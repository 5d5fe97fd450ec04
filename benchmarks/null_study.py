"""A real null study: encoders of one head set that differ by their seed only pose as the four head sets.

python -m study.sweep heads --profile smoke --heads '[rec]' --encoder_seeds 4
python benchmarks/null_study.py heads --profile smoke

Takes every way in which four of a sweep's encoders can pose as the four head sets, judges each by the rules of
sweeps/heads.yaml, and prints each claim's outcomes. None but H1, which compares nothing, may be reproduced.
"""

from __future__ import annotations

import argparse
import collections
import itertools

import pandas as pd

from study.analysis import claims
from study.config.files import load_grid
from study.config.heads import HEAD_SETS
from study.config.workspace import HERE
from study.statistics import effects, learning_curves
from study.statistics.drives import DriveScores, by_drive
from study.statistics.learning_curves import ACCURACY, STEERING, Panel, Point
from study.tracking.tracker import Tracker


def posing(values: pd.DataFrame, seeds: tuple[int, ...]) -> Panel:
    """Return the values [seeds, ...] of four encoders of one head set as those of the four head sets."""
    found = {}
    for name, seed in zip(HEAD_SETS, seeds, strict=True):
        own = values.xs(seed, level="encoder_seed", drop_level=False)
        found[name, 1.0] = own.rename(index={seed: 0}, level="encoder_seed")
    return found


def drives_posing(scores: DriveScores | None, seeds: tuple[int, ...]) -> dict[Point, DriveScores | None]:
    """Return the same of scores by test drive."""
    return (
        {point: DriveScores(part, scores.frames) for point, part in posing(scores.scores, seeds).items()}
        if scores
        else {}
    )


def main() -> None:
    """Print each claim's outcomes over the null studies."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sweep", help="a finished sweep with four encoder seeds or more")
    parser.add_argument("--profile")
    parser.add_argument("--tracking", default=HERE.tracking)
    parser.add_argument("--heads", default="rec", help="whose encoders pose (default: rec)")
    options = parser.parse_args()
    record = Tracker(options.tracking).reader.read_sweep(options.sweep, options.profile)
    point, table = (options.heads, max(record.grid.fractions)), record.table()
    curves = {metric: learning_curves.panel(table, metric)[point] for metric in (ACCURACY, STEERING)}
    drives = {metric: by_drive(effects.results_at(record, point), metric) for metric in curves}
    seeds = curves[ACCURACY].index.get_level_values("encoder_seed").unique()
    floor, grid = claims.steering_floor(record, point), load_grid("heads", profile=record.profile)
    ways = list(itertools.permutations(seeds, len(HEAD_SETS)))
    outcomes: collections.Counter[tuple[str, str]] = collections.Counter()
    for way in ways:
        evidence = claims.Evidence(
            grid,
            {metric: posing(values, way) for metric, values in curves.items()},
            floor,
            {metric: drives_posing(scores, way) for metric, scores in drives.items()},
        )
        for verdict in claims.weigh(evidence):
            outcomes[verdict.claim, verdict.outcome] += verdict.outcome != "not tested"
    print(f"{len(seeds)} encoders of {options.heads}, {len(ways)} null studies")
    for (claim, outcome), count in sorted(outcomes.items()):
        if count:
            print(f"{claim} {outcome}: {count}")


if __name__ == "__main__":
    main()
