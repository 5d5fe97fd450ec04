"""A real null study: encoders of one head set that differ by their seed only pose as the four head sets.

python -m study.sweep heads --profile smoke --heads '[rec]' --encoder_seeds 4
python benchmarks/null_study.py heads --profile smoke

Takes every way in which four of a sweep's encoders can pose as the four head sets, judges each by the rules of
sweeps/heads.yaml, and prints each claim's outcomes. None but H1, which says that there is no effect, may be reproduced.
"""

from __future__ import annotations

import argparse
import collections
import itertools

import pandas as pd

from study.analysis import claims, learning_curves
from study.analysis.learning_curves import Panel
from study.config.files import load_grid
from study.config.heads import HEAD_SETS
from study.config.workspace import HERE
from study.tracking.tracker import Tracker


def posing(curves: pd.DataFrame, seeds: tuple[int, ...]) -> Panel:
    """Return the curves of four encoders of one head set as those of the four head sets."""
    found = {}
    for name, seed in zip(HEAD_SETS, seeds, strict=True):
        own = curves.xs(seed, level="encoder_seed", drop_level=False)
        found[name, 1.0] = own.rename(index={seed: 0}, level="encoder_seed")
    return found


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
    accuracy, steering = (
        learning_curves.panel(table, metric)[point] for metric in (learning_curves.ACCURACY, learning_curves.STEERING)
    )
    seeds = accuracy.index.get_level_values("encoder_seed").unique()
    floor, grid = claims.steering_floor(record, point), load_grid("heads", profile=record.profile)
    ways = list(itertools.permutations(seeds, len(HEAD_SETS)))
    outcomes: collections.Counter[tuple[str, str]] = collections.Counter()
    for way in ways:
        evidence = claims.Evidence(grid, posing(accuracy, way), posing(steering, way), floor)
        for verdict in claims.weigh(evidence):
            outcomes[verdict.claim, verdict.outcome] += verdict.outcome != "not tested"
    print(f"{len(seeds)} encoders of {options.heads}, {len(ways)} null studies")
    for (claim, outcome), count in sorted(outcomes.items()):
        if count:
            print(f"{claim} {outcome}: {count}")


if __name__ == "__main__":
    main()
