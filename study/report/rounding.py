"""Numbers as reports print them: a dash where there is none, "never" for an epoch that is never reached."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial

from study.analysis.metrics import METRICS, Metric
from study.report.model import Spread
from study.statistics.effects import MINUS
from study.statistics.intervals import Estimate
from study.statistics.learning_curves import STEERING

NOTHING = "\N{EM DASH}"
LOSS = METRICS[STEERING].unit
Show = Callable[[float], str]


def fixed(value: float | None, digits: int = 2, factor: float = 1.0, *, sign: bool = False) -> str:
    """Return `factor * value` with that many digits."""
    if value is None or math.isnan(value):
        return NOTHING
    if math.isinf(value):
        return "never"
    shown = f"{abs(factor * value):.{digits}f}"
    zero = not shown.strip("0.")
    return ("" if zero else MINUS if value < 0 else "+" if sign else "") + shown


def percent(value: float, digits: int = 1) -> str:
    """Return a share in percent, or a difference of shares in points."""
    return fixed(value, digits, 100)


def show(metric: Metric, value: float | None, *, sign: bool = False) -> str:
    """Return a metric's value in the metric's unit."""
    return fixed(value, metric.digits, metric.factor, sign=sign)


points = partial(fixed, digits=2, factor=100, sign=True)
epochs = partial(fixed, digits=0)
scores = partial(fixed, digits=1, sign=True)


def between(low: float, high: float, show: Show) -> str:
    """Return an interval's two ends."""
    ends = [show(low), show(high)]
    return ends[0] if math.isnan(low) or math.isinf(low) else " to ".join(ends)


def interval(estimate: Estimate | Spread | None, show: Show) -> str:
    """Return the interval of an estimate or a score."""
    return between(estimate.low, estimate.high, show) if estimate else NOTHING


def kinds(rows: Iterable[Estimate | Spread]) -> str:
    """Return the kinds of some intervals, each once."""
    return "; ".join(dict.fromkeys(row.kind for row in rows))


def duration(seconds: float) -> str:
    """Return a time span."""
    return f"{fixed(seconds, 0)} s" if seconds < 100 else NOTHING if math.isnan(seconds) else f"{seconds / 60:.1f} min"


def gigabytes(count: int | None) -> str:
    """Return a number of bytes."""
    return NOTHING if count is None else f"{count / 1e9:.2f} GB"


def thousands(count: int | None) -> str:
    """Return a count with thin spaces between thousands."""
    return NOTHING if count is None else f"{count:,}".replace(",", "\N{THIN SPACE}")


def probability(p: float) -> str:
    """Return a p value."""
    return "< 0.0001" if p < 0.0001 else fixed(p, 4)


@dataclass(frozen=True)
class Unit:
    """The unit of a claim's findings: its name, how its numbers are rounded, and how a sentence puts it."""

    name: str
    show: Show
    phrase: str


UNITS = {
    "points": Unit("percentage points", points, "{} points"),
    "loss": Unit(LOSS, partial(fixed, digits=3, factor=1e3, sign=True), f"{{}} · {LOSS}"),
    "epochs": Unit("epoch", epochs, "epoch {}"),
    "ratio": Unit("ratio", fixed, "ratio {}"),
    "score": Unit("points of driving score", scores, "{} points of driving score"),
}
