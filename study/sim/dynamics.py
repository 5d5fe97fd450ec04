"""How vehicles answer commands: force, its lag, and the way to a stop."""

from __future__ import annotations

import math

import numpy as np

from study.config.settings import DynamicsSettings, TownSettings
from study.errors import BadInputError
from study.sim.geometry import Floats

DT = 0.1  # [s]
LOOK = 30.0  # look-ahead for vehicles on the route [m]
THROTTLE = {0.5: 1.0, 1.0: 2.5}  # acceleration at rest, which falls with speed [m/s2]
TOP_SPEED = 25.0  # at which throttle no longer accelerates [m/s]
BRAKE = 5.0  # [m/s2]
MOST_WHEEL_LAG = 0.2  # at which turning vehicles are up to 0.7 m off the middle of their lane [s]


def follow_command(value: Floats, command: Floats, lag: float) -> Floats:
    """Return the response one step later: da/dt = (command - a) / lag, solved exactly; at once without lag."""
    return command if lag == 0 else value + (command - value) * -math.expm1(-DT / lag)


def stopping_distance(speed: Floats, force: Floats, lag: float) -> Floats:
    """Return the way to a stop under a full brake from now on [m], while `force` [m/s2] acts and answers with `lag`."""
    if lag == 0:
        return speed * speed / (2 * BRAKE)
    gain = (force + BRAKE) * lag
    time = (speed + gain) / BRAKE
    for _ in range(3):  # v(t) = speed - BRAKE t + gain (1 - exp(-t / lag)) = 0
        time = (speed - gain * np.expm1(-time / lag)) / BRAKE
    way: Floats = speed * time - BRAKE * time * time / 2 + gain * (time + lag * np.expm1(-time / lag))
    return way


def check_dynamics(town: TownSettings, dynamics: DynamicsSettings) -> None:
    """Raise BadInputError when vehicles cannot keep their lane, or stop from the highest limit within LOOK."""
    if dynamics.wheel_lag > MOST_WHEEL_LAG:
        raise BadInputError(
            f"dynamics.wheel_lag: with {dynamics.wheel_lag:g} s, vehicles leave their lanes in turns; "
            f"take at most {MOST_WHEEL_LAG:g} s"
        )

    def way(lag: float, kmh: float) -> float:
        speed = np.array([kmh / 3.6])
        force = THROTTLE[0.5] * (1 - speed / TOP_SPEED)  # near the limit
        return float(stopping_distance(speed, force, lag)[0] + DT * speed[0])  # and a step until it is seen

    fastest = max(town.road_limits or (town.speed_limit,))
    if way(dynamics.lag, fastest) > LOOK:
        lags = [tenths / 10 for tenths in range(50) if way(tenths / 10, fastest) <= LOOK]
        limits = [kmh for kmh in range(1, 200) if way(dynamics.lag, kmh) <= LOOK]
        lag = f"a lag of at most {max(lags):g} s (dynamics.lag), or " if lags else ""
        raise BadInputError(
            f"town.{'road_limits' if town.road_limits else 'speed_limit'}: stopping from {fastest:g} km/h with a lag "
            f"of {dynamics.lag:g} s takes {way(dynamics.lag, fastest):.0f} m, and the autopilot looks {LOOK:g} m "
            f"ahead; take {lag}limits of at most {max(limits, default=0)} km/h"
        )
