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

from ccd_casadi.analysis.move_limits import Limits
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

    def at(self, times: Array) -> Array:
        """r, ṙ, r̈, r⃛ and r⁗ (5, k) at times in s, at rest before the start and after the end."""
        ends = np.concatenate([[0.0], np.cumsum(self.durations)])
        start = np.zeros((len(ends), 4))  # of each interval: r and three derivatives
        for i, (span, snap) in enumerate(zip(self.durations, self.snaps, strict=True)):
            start[i + 1] = _advanced(start[i], snap, np.array([span]))[:4, 0]
        start[-1, 1:] = 0.0  # what rounding left
        t = np.asarray(times, float)
        place = np.clip(np.searchsorted(ends, t, side="right") - 1, 0, len(self.snaps))
        snaps = np.append(self.snaps, 0.0)
        snaps = np.where(t < 0.0, 0.0, snaps[place])
        return _advanced(start[place].T, snaps, np.maximum(t - ends[place], 0.0))


def _advanced(state: Array, snap: float | Array, t: Array) -> Array:
    """r and four derivatives (5, k) a time t after `state` (4, ...), with a constant snap."""
    r, v, a, j = state
    rows = (
        r + t * (v + t * (a / 2 + t * (j / 6 + t * snap / 24))),
        v + t * (a + t * (j / 2 + t * snap / 6)),
        a + t * (j + t * snap / 2),
        j + t * snap,
        snap + 0.0 * t,
    )
    return np.asarray(np.broadcast_arrays(*rows))


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
