"""The symmetric fourth-order setpoint of a move: the shortest with its derivatives in bounds.

Snap is ± s or 0, with the times t4 of constant snap, t3 of constant jerk, t2 of constant
acceleration and t1 of constant velocity, so that

    jerk = s t4,   acceleration = jerk (t4 + t3),   velocity = acceleration (2 t4 + t3 + t2),
    stroke = velocity (4 t4 + 2 t3 + t2 + t1).

Each time is the longest that no later bound forbids, from the innermost outwards. (Lambrechts,
Boerlage and Steinbuch 2005.)
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq

from ccd_casadi.robust.demands import Limits as Limits
from ccd_casadi.support.arrays import Array


@dataclass(frozen=True)
class Setpoint:
    """Snap values over 15 intervals, `durations` (15,) in s; what the move reaches."""

    durations: Array
    snaps: Array
    velocity: float
    acceleration: float
    jerk: float

    @property
    def duration(self) -> float:
        """Of the move in s."""
        return float(self.durations.sum())

    def at(self, times: Array) -> tuple[Array, Array]:
        """Position and acceleration at times (k,) in s, exact; after the move it stays there."""
        ends = np.cumsum(self.durations)
        place, rate = np.zeros_like(times), np.zeros_like(times)
        state, start = np.zeros(4), 0.0  # r, ṙ, r̈, r⃛
        for end, span, snap in zip(ends, self.durations, self.snaps, strict=True):
            inside = (times >= start) & (times <= end)
            for h, where in ((times[inside] - start, inside), (span, None)):
                r, v, a, j = state
                moved = (
                    r + v * h + a * h**2 / 2 + j * h**3 / 6 + snap * h**4 / 24,
                    v + a * h + j * h**2 / 2 + snap * h**3 / 6,
                    a + j * h + snap * h**2 / 2,
                    j + snap * h,
                )
                if where is None:
                    state = np.array(moved)
                else:
                    place[where], rate[where] = moved[0], moved[2]
            start = end
        place[times > start], rate[times > start] = state[0], 0.0
        return place, rate


def setpoint(limits: Limits) -> Setpoint:
    """The shortest symmetric fourth-order move; all limits positive."""
    s, stroke = limits.snap, limits.stroke

    def reached(t4: float, t3: float, t2: float, t1: float) -> tuple[float, float, float, float]:
        jerk = s * t4
        acceleration = jerk * (t4 + t3)
        velocity = acceleration * (2 * t4 + t3 + t2)
        return jerk, acceleration, velocity, velocity * (4 * t4 + 2 * t3 + t2 + t1)

    bounds = (limits.jerk, limits.acceleration, limits.velocity, stroke)

    def longest(first: int, times: Callable[[float], tuple[float, float, float, float]]) -> float:
        """The largest t that keeps the bounds from the `first` on, which grow with t."""

        def over(t: float) -> float:
            values = reached(*times(t))
            return max(values[i] / bounds[i] for i in range(first, 4)) - 1.0

        high = 1.0
        while over(high) < 0.0:
            high *= 2.0
        return 0.0 if over(0.0) >= 0.0 else brentq(over, 0.0, high, xtol=1e-15, rtol=1e-14)

    t4 = longest(0, lambda t: (t, 0.0, 0.0, 0.0))
    t3 = longest(1, lambda t: (t4, t, 0.0, 0.0))
    t2 = longest(2, lambda t: (t4, t3, t, 0.0))
    # the stroke is not bounded but met
    jerk, acceleration, velocity, _ = reached(t4, t3, t2, 0.0)
    t1 = max(0.0, stroke / velocity - (4 * t4 + 2 * t3 + t2))
    ramp = [t4, t3, t4]
    up = np.array([*ramp, t2, *ramp])
    durations = np.concatenate([up, [t1], up])
    pulse = np.array([s, 0.0, -s])
    rise = np.concatenate([pulse, [0.0], -pulse])
    return Setpoint(durations, np.concatenate([rise, [0.0], -rise]), velocity, acceleration, jerk)
