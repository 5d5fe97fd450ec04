"""A metric: how often a policy accelerates fully where the expert brakes. See docs/extend/metric.md.

python -m examples.metric heads --profile smoke
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from study.analysis.metrics import METRICS, Metric
from study.config.paper import ACCELERATIONS
from study.console.options import run
from study.report.__main__ import main
from study.results.cell_result import CellResult

BRAKE, FULL = ACCELERATIONS.index(-1.0), ACCELERATIONS.index(1.0)


def missed_brakes(result: CellResult) -> NDArray[np.float64]:
    """Return, for each policy, the share of the expert's braking frames that it answers with full throttle."""
    braking = result.predictions["acceleration_label"] == BRAKE
    return np.mean(result.predictions["acceleration"][:, braking] == FULL, axis=1, dtype=np.float64)


MISSED_BRAKES = Metric(
    name="missed_brakes",
    title="missed brakes",
    unit="%",
    factor=100,
    digits=1,
    better="lower",
    about="Missed brakes: share of the expert's braking frames that get full throttle, after the last epoch.",
    values=missed_brakes,
)

if __name__ == "__main__":
    METRICS[MISSED_BRAKES.name] = MISSED_BRAKES
    run(main)
