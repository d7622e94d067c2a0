"""Setpoints of fourth order, and the feedforward of them."""

from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from ccd_casadi.analysis import MoveLimits
from ccd_casadi.support.arrays import Array


@dataclass(frozen=True)
class Setpoint:
    """A symmetric fourth-order move: constant snap over each of 15 intervals.

    Attributes
    ----------
    durations, snaps : (15,) array
        Of the intervals, s, and snap there, unit of y per s⁴.
    velocity, acceleration, jerk : float
        The largest that the move reaches.
    """

    durations: Array
    snaps: Array
    velocity: float
    acceleration: float
    jerk: float

    @property
    def duration(self) -> float:
        """The duration of the move in s."""
        return float(self.durations.real.sum())

    @property
    def squared_acceleration(self) -> Any:
        """∫ r̈² dt over the move, m²/s³; exact."""
        t, start = self.durations, self._starts()
        a, j, s = start[:-1, 2], start[:-1, 3], self.snaps
        inner = a * a + t * (a * j + t * ((j * j + a * s) / 3 + t * (j * s / 4 + t * s * s / 20)))
        return (t * inner).sum()

    def _starts(self) -> Array:
        """r and three derivatives (16, 4) where each interval begins, and at the end."""
        start = np.zeros((len(self.durations) + 1, 4), self.durations.dtype)
        for i, (span, snap) in enumerate(zip(self.durations, self.snaps, strict=True)):
            start[i + 1] = _advance(start[i], snap, np.array([span]))[:4, 0]
        start[-1, 1:] = 0.0  # what rounding left
        return start

    def inside(self, shares: Array) -> Array:
        """r and four derivatives (5, 15, k) at shares of each interval, (k,) or (15, k).

        Analytic in the durations and snaps, which may be complex.
        """
        start, snaps = self._starts()[:-1].T[:, :, None], self.snaps[:, None]
        return _advance(start, snaps, self.durations[:, None] * np.atleast_2d(shares))

    def at(self, times: Array) -> Array:
        """r, ṙ, r̈, r⃛ and r⁗ (5, k) at times in s, at rest before the start and after the end."""
        ends = np.concatenate([[0.0], np.cumsum(self.durations)])
        start = self._starts()
        t = np.asarray(times, float)
        place = np.clip(np.searchsorted(ends.real, t, side="right") - 1, 0, len(self.snaps))
        snaps = np.append(self.snaps, 0.0)
        snaps = np.where(t < 0.0, 0.0, snaps[place])
        return _advance(start[place].T, snaps, np.maximum(t - ends[place], 0.0))


def _advance(state: Array, snap: float | Array, t: Array) -> Array:
    """r and four derivatives (5, ...) a time t after `state` (4, ...), with a constant snap."""
    r, v, a, j = state
    rows = (
        r + t * (v + t * (a / 2 + t * (j / 6 + t * snap / 24))),
        v + t * (a + t * (j / 2 + t * snap / 6)),
        a + t * (j + t * snap / 2),
        j + t * snap,
        snap + 0.0 * t,
    )
    return np.asarray(np.broadcast_arrays(*rows))


def setpoint(limits: MoveLimits) -> Setpoint:
    """The shortest symmetric fourth-order move.

    Analytic in the limits, which may be complex: a step along the imaginary axis gives derivatives.

    Parameters
    ----------
    limits : MoveLimits
        All positive.

    Returns
    -------
    Setpoint
        At rest before its start and after its end.
    """
    stroke, v, a, j, s = (getattr(limits, item.name) for item in fields(limits))
    t4 = _longest(j / s, (a / s) ** 0.5, (v / (2 * s)) ** (1 / 3), (stroke / (8 * s)) ** 0.25)
    jerk = s * t4
    # what t3 does to the stroke, x² (x - t4) = stroke/(2 jerk) with x = 2 t4 + t3, by Cardano
    half, fourth = (t4 / 3) ** 3 + stroke / (4 * jerk), stroke / (4 * jerk)
    root = (fourth * (2 * (t4 / 3) ** 3 + fourth)) ** 0.5
    x = t4 / 3 + (half + root) ** (1 / 3) + (t4 / 3) ** 2 / (half + root) ** (1 / 3)
    t3 = _longest(a / jerk - t4, 0.5 * ((t4 * t4 + 4 * v / jerk) ** 0.5 - 3 * t4), x - 2 * t4)
    acceleration, rise = jerk * (t4 + t3), 2 * t4 + t3
    t2 = _longest(v / acceleration - rise,
                  0.5 * ((rise * rise + 4 * stroke / acceleration) ** 0.5 - 3 * rise))  # fmt: skip
    velocity = acceleration * (rise + t2)
    t1 = _longest(stroke / velocity - (2 * rise + t2))
    ramp = [t4, t3, t4]
    up = np.array([*ramp, t2, *ramp])
    durations = np.concatenate([up, [t1], up])
    pulse = np.array([s, 0.0 * s, -s])
    rising = np.concatenate([pulse, [0.0], -pulse])
    return Setpoint(durations, np.concatenate([rising, [0.0], -rising]), velocity, acceleration,
                    jerk)  # fmt: skip


def _longest(*bounds: Any) -> Any:
    """The longest time within all bounds; zero where one of them is negative."""
    time = min(bounds, key=np.real)
    return time if np.real(time) > 0.0 else 0.0 * time
