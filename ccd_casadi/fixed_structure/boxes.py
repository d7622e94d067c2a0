"""Boxes of frequency and uncertain parameters, and what a loop is made of as forms on them.

s = y/x, so that frequencies from 0 to infinity are no special case: x = 1, y = jω below a unit,
x = 1/ω, y = j above it; sampled x = cos(ωT/2), y = (2j/T) sin(ωT/2), z = e^{jωT}. A free body is
infinite at 0 Hz: at rest it is enclosed times y².
"""

from dataclasses import dataclass
from enum import IntEnum
from math import factorial
from typing import Self

import numpy as np

from ccd_casadi.fixed_structure.affine import Affine, exponential, inverse, variable
from ccd_casadi.fixed_structure.structure import Structure
from ccd_casadi.kernels.sections import INTEGRATOR, REAL
from ccd_casadi.lti.loop import delay_parts
from ccd_casadi.support.arrays import Array

Pair = tuple[Affine, Affine]  # D and N of N/D, or a pole and its residue


class Chart(IntEnum):
    """What the first coordinate of a box is."""

    LOW = 0  # ω over the unit
    HIGH = 1  # the unit over ω
    SAMPLED = 2  # ωT
    POINT = 3  # as LOW or SAMPLED, at ω_low: only S_low counts there


@dataclass(frozen=True)
class Boxes:
    """N boxes: chart (N,), ends (1 + n_p, N) of the frequency coordinate and the parameters."""

    chart: np.ndarray
    low: Array
    high: Array

    def only(self, chosen: np.ndarray) -> Self:
        """Some of them, by mask or index."""
        return type(self)(*(part[..., chosen] for part in vars(self).values()))

    def beside(self, other: Self) -> Self:
        """These boxes, then the others."""
        pairs = zip(vars(self).values(), vars(other).values(), strict=True)
        return type(self)(*map(np.hstack, pairs))

    def omega(self, unit: float, period: float | None) -> tuple[Array, Array]:
        """The ends of ω in rad/s."""
        if period is not None:
            return self.low[0] / period * unit, self.high[0] / period * unit
        upper = self.chart == Chart.HIGH
        with np.errstate(divide="ignore"):
            first = np.where(upper, 1.0 / self.high[0], self.low[0])
            last = np.where(upper, 1.0 / self.low[0], self.high[0])
        return first * unit, last * unit


@dataclass(frozen=True)
class FrequencyAxis:
    """Frequencies as forms of variable 0: s = y/x, e^{-sT}; period (None: continuous) and delay.
    `at_rest`: as they are there."""

    x: Affine
    y: Affine
    s: Affine
    turn: Affine
    period: float | None
    delay: float
    at_rest: bool

    def factor(self, p: Affine, residue: Affine) -> Pair:
        """D and N of a pole, both times x; they vanish together nowhere."""
        n = len(p.slope)
        if self.period is None:
            return self.y.of(n) - p * self.x.of(n), residue * self.x.of(n)
        T, turn = self.period, self.turn.of(n)
        whole, rest = delay_parts(T, self.delay)
        all_of, early = exponential(p * T), exponential(p * (T - rest))
        N = early - 1.0 + (all_of - early) * turn
        for _ in range(whole):
            N = N * turn
        # both times 1/z, of size one on the axis
        return -(all_of * turn) + 1.0, residue * N * inverse(p) * turn

    def driven_away(self, square: Affine) -> Affine:
        """1/(s² - q) of q = `square` > 0: real poles ±√q, which apart would cancel far above them.

        With hold and delay, h = T - rest of the delay, r = T - h and z = e^{sT}, it is z⁻ᵈ⁻¹ times

            (φ(h) + (2φ(T) - φ(h) - φ(r))/z + φ(r)/z²) / ((1 - 1/z)² - 2qφ(T)/z)

        with φ(x) = (cosh √q x - 1)/q, a power series in q.
        """
        n = len(square.slope)
        x, y = self.x.of(n), self.y.of(n)
        if self.period is None:
            return x * x * inverse(y * y - square * x * x)
        T, turn = self.period, self.turn.of(n)
        whole, rest = delay_parts(T, self.delay)
        late, full, early = (_moved(square, time) for time in (T - rest, T, rest))
        N = late + (full * 2.0 - late - early) * turn + early * turn * turn
        for _ in range(whole + 1):
            N = N * turn
        apart = turn * -1.0 + 1.0
        return N * inverse(apart * apart - square * full * turn * 2.0)

    def driven_away_unheld(self, square: Affine) -> Affine:
        """The same without hold and delay."""
        n = len(square.slope)
        s = self.s.of(n)
        return inverse(s * s - square)

    @property
    def free_body(self) -> Affine:
        """1/s², or y²/s² = x² at rest; sampled y² times what hold and delay make of
        1/s² (`kernels.modes`):

        z⁻ᵈ ((h² + (T² - h²)/z)(1 - 1/z)/2 + T (h + (T - h)/z)/z)/T²
        """
        if self.period is None:
            return self._per_y_squared(self.x * self.x)
        T, turn = self.period, self.turn
        whole, rest = delay_parts(T, self.delay)
        h = T - rest
        first = (turn * (T * T - h * h) + h * h) * (turn * -1.0 + 1.0) * 0.5
        found = (first + (turn * (T - h) + h) * turn * T) * (1.0 / T**2)
        for _ in range(whole):
            found = found * turn
        return self._per_y_squared(found)

    @property
    def free_body_unheld(self) -> Affine:
        """The same without hold and delay: sampled y²/s² = sinc²(ωT/2), |sinc''| <= 1/3."""
        if self.period is None:
            return self._per_y_squared(self.x * self.x)
        half = self.s.centre.imag * 0.5 * self.period
        slope, width = self.s.slope.imag * 0.5 * self.period, np.abs(self.s.slope).sum(0)
        small = np.abs(half) < 1e-3  # there the series holds to rounding
        over = np.where(small, 1.0, half)
        value = np.where(small, 1.0 - half**2 / 6.0, np.sin(over) / over)
        steep = np.where(small, -half / 3.0, (np.cos(over) - np.sin(over) / over) / over)
        rest = (0.5 * self.period * width) ** 2 / 6.0 + 1e-12
        sinc = Affine(value, steep * slope, rest)
        return self._per_y_squared(sinc * sinc)

    def _per_y_squared(self, form: Affine) -> Affine:
        """The form itself at rest, else over y²."""
        return form if self.at_rest else form * inverse(self.y * self.y)


def _moved(square: Affine, time: float, *, terms: int = 8, most: float = 1.0) -> Affine:
    """φ(x) = (cosh √q x - 1)/q = x²/2 Σ 2 uⁿ/(2n + 2)!, u = q x²: how far a unit force moves the
    body in the time x. What is left out from `terms` on is less than twice its first term where
    |u| is at most `most`, and unknown beyond."""
    u = square * time**2
    total = u * 0.0 + 1.0
    for n in range(terms - 1, 0, -1):
        total = u * total * (1.0 / ((2 * n + 1) * (2 * n + 2))) + 1.0
    left = 4.0 / factorial(2 * terms + 2)
    rest = total.rest + np.where(u.size <= most, left, np.inf)
    return Affine(total.centre, total.slope, rest) * (0.5 * time**2)


def axis_of(
    boxes: Boxes, period: float | None, delay: float, at_rest: bool = False
) -> FrequencyAxis:
    """The frequencies of boxes."""
    f = variable(boxes.low[0], boxes.high[0], 0, 1)
    if period is None:
        upper = boxes.chart == Chart.HIGH
        one = Affine(np.ones(len(f.centre)), np.zeros_like(f.slope), np.zeros(len(f.centre)))
        x, y = _either(upper, f, one), _either(upper, one, f) * 1j
        return FrequencyAxis(x, y, y, one, None, 0.0, at_rest)
    half = exponential(f * 0.5j)
    back = exponential(f * -0.5j)
    x, y = (half + back) * 0.5, (half - back) * (1.0 / period)
    return FrequencyAxis(x, y, f * (1j / period), back * back, period, delay, at_rest)


def gain_of(structure: Structure, kappa: Array, axis: FrequencyAxis, integrator: bool) -> Affine:
    """K of a structure, or y K where the channels have an `integrator`."""
    values, x, y = np.exp(kappa), axis.x, axis.y
    one = Affine(np.ones(len(x.centre)), np.zeros_like(x.slope), np.zeros(len(x.centre)))
    above, below = one * values[0], one
    xx, xy, yy = x * x, x * y, y * y
    for kind, sign, at in structure.factors[1:].tolist():
        over = 1.0 / values[at]
        if kind == INTEGRATOR:
            part = y + x * values[at]
        elif kind == REAL:
            part = x + y * over
        else:
            part = xx + xy * (2.0 * over * values[at + 1]) + yy * over**2
        if sign > 0:
            above = above * part
        else:
            below = below * part
    for _ in range(structure.roll_off):
        above = above * x
    if structure.integrator and not integrator:
        below = below * y
    if integrator and not structure.integrator:
        above = above * y
    return above * inverse(below)


def _either(chosen: np.ndarray, first: Affine, second: Affine) -> Affine:
    return Affine(np.where(chosen, first.centre, second.centre),
                  np.where(chosen, first.slope, second.slope),
                  np.where(chosen, first.rest, second.rest))  # fmt: skip
