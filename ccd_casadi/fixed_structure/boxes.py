"""Boxes of frequency and uncertain parameters, and what a loop is made of as forms on them.

s = y/x, so that frequencies from 0 to infinity are no special case: x = 1, y = jω below a unit,
x = 1/ω, y = j above it; sampled x = cos(ωT/2), y = (2j/T) sin(ωT/2), z = e^{jωT}. A free body is
infinite at 0 Hz: at rest it is enclosed times y².
"""

from dataclasses import dataclass, replace
from enum import IntEnum
from functools import cached_property
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
    """The meaning of the first coordinate of a box."""

    LOW = 0  # ω over the unit
    HIGH = 1  # the unit over ω
    SAMPLED = 2  # ωT
    POINT = 3  # as LOW or SAMPLED, at ω_low: only S_low counts there


@dataclass(frozen=True)
class Boxes:
    """N boxes over a frequency coordinate and the parameters.

    Attributes
    ----------
    chart : array (N,)
        Which coordinate of frequency (`Chart`).
    low, high : array (1 + n_p, N)
        Ends.
    """

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
    `at_rest`: as they are there.

    `low_pass` has the poles λ of W(s) = 1/Π(1 - s/λ), what actuator and sensor do to every mode g:
    W g in continuous time. Behind a hold each pole of W g is held apart, its residues those of

        W(s)/(s - p) = W(p)/(s - p) + Σ R_λ/((λ - p)(s - λ)),   R_λ the residue of W at λ

    so that every mode g adds Σ R_λ g(λ) h_λ, h_λ being 1/(s - λ) with hold and delay.
    """

    x: Affine
    y: Affine
    s: Affine
    turn: Affine
    period: float | None
    delay: float
    at_rest: bool
    low_pass: tuple[complex, ...] = ()

    @cached_property
    def residues(self) -> np.ndarray:
        """The residues R_λ of W."""
        poles = np.array(self.low_pass)
        others = 1.0 - poles[:, None] / poles
        np.fill_diagonal(others, 1.0)
        return np.asarray(-poles / others.prod(axis=1))

    @cached_property
    def passed(self) -> Affine:
        """W at s = y/x, of no hold."""
        found = self.x * 0.0 + 1.0
        for pole in self.low_pass:
            found = found * self.x * inverse(self.x - self.y * (1.0 / pole))
        return found

    @cached_property
    def plain(self) -> "FrequencyAxis":
        """The axis without W, as a force on the mechanics has it."""
        return replace(self, low_pass=())

    @cached_property
    def held_low_pass(self) -> tuple[Affine, ...]:
        """h_λ of every λ."""
        one = self.x * 0.0
        parts = (self.factor(one + pole, one + 1.0, bare=True) for pole in self.low_pass)
        return tuple(N * inverse(D) for D, N in parts)

    def lag(self, gains: list[Affine]) -> Affine:
        """Σ R_λ g(λ) h_λ of g(λ) for every λ; sampled."""
        n = len(gains[0].slope)
        total = gains[0] * 0.0
        for R, gain, held in zip(self.residues, gains, self.held_low_pass, strict=True):
            total = total + gain * held.of(n) * complex(R)
        return total

    def lagged_of(self, poles: list[Pair]) -> Affine | None:
        """The same of g = Σ residue/(s - p); None where nothing is to be added."""
        if self.period is None or not self.low_pass:
            return None
        gains = []
        for pole in self.low_pass:
            each = [residue * inverse(p * -1.0 + pole) for p, residue in poles]
            gains.append(sum(each[1:], each[0]))
        return self.lag(gains)

    def factor(self, p: Affine, residue: Affine, bare: bool = False) -> Pair:
        """D and N of a pole, both times x; they vanish together nowhere. `bare`: without W, but for
        which N has W(p) behind a hold."""
        n = len(p.slope)
        if self.period is None:
            N = residue * self.x.of(n)
            return self.y.of(n) - p * self.x.of(n), N if bare else N * self.passed.of(n)
        if not bare:
            for pole in self.low_pass:
                residue = residue * inverse(p * (-1.0 / pole) + 1.0)
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
            return x * x * inverse(y * y - square * x * x) * self.passed.of(n)
        T, turn = self.period, self.turn.of(n)
        whole, rest = delay_parts(T, self.delay)
        late, full, early = (_moved(square, time) for time in (T - rest, T, rest))
        N = late + (full * 2.0 - late - early) * turn + early * turn * turn
        apart = turn * -1.0 + 1.0
        if self.low_pass:  # W/(s² - q) = (a + bs)/(s² - q) + Σ R_λ/((λ² - q)(s - λ))
            even, odd = self._even_and_odd(square)
            below = inverse(even * even - square * odd * odd)
            speed = _speed(square, T - rest) + _speed(square, rest) * turn
            N = N * even * below - speed * apart * odd * below
        for _ in range(whole + 1):
            N = N * turn
        found = N * inverse(apart * apart - square * full * turn * 2.0)
        if self.low_pass:
            found += self.lag([inverse(square * -1.0 + pole**2) for pole in self.low_pass])
        return found

    def _even_and_odd(self, square: Affine) -> tuple[Affine, Affine]:
        """E and O of Π(1 - s/λ) = E(s²) + s O(s²)."""
        parts = []
        powers = np.poly(1.0 / np.array(self.low_pass)).real  # of s, from 0 on
        for own in (powers[::2], powers[1::2]):
            total = square * 0.0
            for value in own[::-1]:
                total = total * square + float(value)
            parts.append(total)
        return parts[0], parts[1]

    def driven_away_unheld(self, square: Affine) -> Affine:
        """The same without hold and delay, and without W."""
        if self.period is None:
            return self.plain.driven_away(square)
        s = self.s.of(len(square.slope))
        return inverse(s * s - square)

    @property
    def free_body(self) -> Affine:
        """1/s², or y²/s² = x² at rest; sampled y² times what hold and delay make of
        1/s² (`kernels.modes`):

        z⁻ᵈ ((h² + (T² - h²)/z)(1 - 1/z)/2 + T (h + (T - h)/z)/z)/T²

        W adds W'(0)/s, of which y² makes W'(0) z⁻ᵈ (h + (T - h)/z) (x - yT/2) y/T, as 1 - 1/z =
        Ty (x - yT/2), and R_λ/(λ² (s - λ)).
        """
        if self.period is None:
            return self._per_y_squared(self.x * self.x * self.passed)
        T, turn = self.period, self.turn
        whole, rest = delay_parts(T, self.delay)
        h = T - rest
        first = (turn * (T * T - h * h) + h * h) * (turn * -1.0 + 1.0) * 0.5
        found = (first + (turn * (T - h) + h) * turn * T) * (1.0 / T**2)
        slope = sum(1.0 / pole for pole in self.low_pass).real if self.low_pass else 0.0
        if self.low_pass:
            back = self.x - self.y * (0.5 * T)
            found = found + (turn * (T - h) + h) * back * self.y * (slope / T)
        for _ in range(whole):
            found = found * turn
        if self.low_pass:
            one = self.x * 0.0
            found = found + self.y * self.y * self.lag([one + p**-2 for p in self.low_pass])
        return self._per_y_squared(found)

    @property
    def free_body_unheld(self) -> Affine:
        """The same without hold, delay and W: sampled y²/s² = sinc²(ωT/2), |sinc''| <= 1/3."""
        if self.period is None:
            return self.plain.free_body
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
    return _series(square * time**2, 1, terms, most) * (0.5 * time**2)


def _speed(square: Affine, time: float, *, terms: int = 8, most: float = 1.0) -> Affine:
    """sinh(√q x)/√q = x Σ uⁿ/(2n + 1)!: how fast a unit force has made it then, as `_moved`."""
    return _series(square * time**2, 0, terms, most) * time


def _series(u: Affine, first: int, terms: int, most: float) -> Affine:
    """(1 + first)! Σ uⁿ/(2n + 1 + first)!."""
    total = u * 0.0 + 1.0
    for n in range(terms - 1, 0, -1):
        total = u * total * (1.0 / ((2 * n + first) * (2 * n + 1 + first))) + 1.0
    left = 4.0 / factorial(2 * terms + 1 + first)
    rest = total.rest + np.where(u.size <= most, left, np.inf)
    return Affine(total.centre, total.slope, rest)


def axis_of(
    boxes: Boxes, period: float | None, delay: float, at_rest: bool = False,
    low_pass: tuple[complex, ...] = (),
) -> FrequencyAxis:  # fmt: skip
    """The frequencies of boxes."""
    f = variable(boxes.low[0], boxes.high[0], 0, 1)
    if period is None:
        upper = boxes.chart == Chart.HIGH
        one = Affine(np.ones(len(f.centre)), np.zeros_like(f.slope), np.zeros(len(f.centre)))
        x, y = _either(upper, f, one), _either(upper, one, f) * 1j
        return FrequencyAxis(x, y, y, one, None, 0.0, at_rest, low_pass)
    half = exponential(f * 0.5j)
    back = exponential(f * -0.5j)
    x, y = (half + back) * 0.5, (half - back) * (1.0 / period)
    s = f * (1j / period)
    return FrequencyAxis(x, y, s, back * back, period, delay, at_rest, low_pass)


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
