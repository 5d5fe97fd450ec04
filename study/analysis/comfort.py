"""Comfort of a motion, by nuPlan's bounds."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.signal import savgol_filter

Floats = NDArray[np.float64]

LONGITUDINAL = (-4.05, 2.40)  # acceleration [m/s2]
LATERAL = 4.89  # acceleration, either way [m/s2]
JERK, LONGITUDINAL_JERK = 8.37, 4.13  # of the whole acceleration and of its longitudinal part [m/s3]
YAW_RATE, YAW_ACCELERATION = 0.95, 1.93  # [rad/s, rad/s2]
WINDOW, LONG_WINDOW = 8, 15  # steps of 0.1 s that are smoothed over: accelerations, and their derivatives
ORDER = 2


def comfortable(speed: Floats, heading: Floats, rate_hz: float) -> NDArray[np.bool_]:
    """Return whether each step [T] is within all of nuPlan's bounds (metric ego_is_comfortable of nuplan-devkit).

    `speed` [T] m/s, `heading` [T] rad. As there, values are smoothed and derived by Savitzky-Golay filters of order 2.
    Motions of fewer than three steps are comfortable.
    """
    if len(speed) <= ORDER:
        return np.ones(len(speed), bool)
    angle = np.unwrap(heading)
    yaw_rate, yaw_acceleration = (_smooth(angle, LONG_WINDOW, rate_hz, order) for order in (1, 2))
    along = _smooth(np.gradient(speed, 1 / rate_hz), WINDOW, rate_hz)
    across = _smooth(speed * yaw_rate, WINDOW, rate_hz)
    jerk = _smooth(np.hypot(along, across), LONG_WINDOW, rate_hz, 1)
    along_jerk = _smooth(along, LONG_WINDOW, rate_hz, 1)
    within = (along >= LONGITUDINAL[0]) & (along <= LONGITUDINAL[1])
    bounds = (
        (across, LATERAL),
        (jerk, JERK),
        (along_jerk, LONGITUDINAL_JERK),
        (yaw_rate, YAW_RATE),
        (yaw_acceleration, YAW_ACCELERATION),
    )
    for values, bound in bounds:
        within &= np.abs(values) <= bound
    return within


def _smooth(values: Floats, window: int, rate_hz: float, derivative: int = 0) -> Floats:
    width = min(window, len(values))
    smooth: Floats = savgol_filter(values, width, ORDER, deriv=derivative, delta=1 / rate_hz)
    return smooth
