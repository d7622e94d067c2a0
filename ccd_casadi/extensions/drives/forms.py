"""Filters of drives by their parameters: response, slopes, and coefficients of the difference
equation.

A filter is a product of factors over another one, each of a frequency f, of second order with a
damping D or of first order without one:

    q = 1 + 2 D u x + (u x)²,   r = 1 + u x

    bilinear    x = (1 - 1/z)/(1 + 1/z),  u = 1/(π f T)
    prewarped   the same x,               u = 1/tan(π f T): exact at f
    backward    x = 1 - 1/z,              u = 1/(2π f T)
"""

from dataclasses import dataclass
from enum import StrEnum
from typing import ClassVar

import numpy as np

from ccd_casadi.support.arrays import Array

Factor = tuple[str, ...]  # names of f and D, or of f alone


class Rule(StrEnum):
    """How a drive makes a difference equation of a filter."""

    BILINEAR = "bilinear"
    PREWARPED = "prewarped"
    BACKWARD = "backward"


class Number(StrEnum):
    """The numbers that a drive's filters compute with."""

    DOUBLE = "double"
    SINGLE = "single"
    FIXED_30 = "fixed30"


@dataclass(frozen=True)
class Form:
    """A filter's factors above and below the line, by names of their parameters."""

    above: tuple[Factor, ...]
    below: tuple[Factor, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """The parameters, each once."""
        return tuple(dict.fromkeys(name for part in (*self.above, *self.below) for name in part))


FORMS = {
    "general": Form((("f_Z", "D_Z"),), (("f_N", "D_N"),)),
    "notch": Form((("f", "D_Z"),), (("f", "D_N"),)),
    "pt2": Form((), (("f", "D"),)),
    "pt1": Form((), (("f",),)),
    "lead_lag": Form((("f_Z",),), (("f_N",),)),
}


@dataclass(frozen=True)
class Filter:
    """One filter of a drive.

    Attributes
    ----------
    form : Form
    rule : Rule
    number : Number
    period : float
        T, s.
    """

    form: Form
    rule: Rule
    number: Number
    period: float
    of_fixed: ClassVar[float] = 2.0**30  # that many steps in one
    largest_fixed: ClassVar[float] = 2.0  # 32 bits with a sign

    def response(self, values: dict[str, float], z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """F (k,) on the unit circle and ∂ln F/∂ln p (n, k), p in the order of the form."""
        x = 1.0 - 1.0 / z
        if self.rule is not Rule.BACKWARD:
            x = x / (1.0 + 1.0 / z)
        F, slopes = np.ones(len(z), complex), np.zeros((len(self.form.names), len(z)), complex)
        for sign, factors in ((1, self.form.above), (-1, self.form.below)):
            for f, *damping in factors:
                u, steep = self._scale(values[f])
                v, D = u * x, values[damping[0]] if damping else 0.0
                part = 1.0 + 2.0 * D * v + v * v if damping else 1.0 + v
                F = F * part if sign > 0 else F / part
                by_f = (2.0 * D * v + 2.0 * v * v if damping else v) / part
                slopes[self.form.names.index(f)] += sign * steep * by_f
                if damping:
                    slopes[self.form.names.index(damping[0])] += sign * 2.0 * D * v / part
        return F, slopes

    def _scale(self, f: float) -> tuple[float, float]:
        """u of a frequency in Hz, and d ln u/d ln f."""
        turn = np.pi * f * self.period
        if self.rule is Rule.BILINEAR:
            return 1.0 / turn, -1.0
        if self.rule is Rule.BACKWARD:
            return 0.5 / turn, -1.0
        return 1.0 / np.tan(turn), -2.0 * turn / np.sin(2.0 * turn)

    def coefficients(self, values: dict[str, float]) -> tuple[Array, Array]:
        """b (3,) and a (3,) of powers of 1/z, a_0 = 1, rounded to the drive's numbers:
        y_k = b_0 u_k + b_1 u_{k-1} + b_2 u_{k-2} - a_1 y_{k-1} - a_2 y_{k-2}."""
        b, a = (self._product(values, part) for part in (self.form.above, self.form.below))
        order = max(len(b), len(a))
        if self.rule is not Rule.BACKWARD:
            b, a = (np.convolve(p, _binomial(order - len(p))) for p in (b, a))
        b, a = (np.pad(p, (0, 3 - len(p))) for p in (b, a))
        return self._rounded(b / a[0]), self._rounded(a / a[0])

    def _product(self, values: dict[str, float], factors: tuple[Factor, ...]) -> Array:
        found = np.ones(1)
        for f, *damping in factors:
            u = self._scale(values[f])[0]
            away = np.array([1.0, -1.0])  # 1 - 1/z
            whole = np.array([1.0, 0.0 if self.rule is Rule.BACKWARD else 1.0])
            part = whole + u * away
            if damping:
                D = values[damping[0]]
                part = np.convolve(whole, whole) + 2.0 * D * u * np.convolve(whole, away)
                part = part + u * u * np.convolve(away, away)
            found = np.convolve(found, part)
        return np.asarray(found)

    def _rounded(self, c: Array) -> Array:
        if self.number is Number.SINGLE:
            return np.asarray(c.astype(np.float32), float)
        if self.number is Number.FIXED_30:
            return np.asarray(np.rint(c * self.of_fixed) / self.of_fixed)
        return c

    def fits(self, values: dict[str, float]) -> bool:
        """Whether the drive's numbers hold every coefficient."""
        b, a = self.coefficients(values)
        most = self.largest_fixed if self.number is Number.FIXED_30 else np.inf
        return bool(max(np.abs(b).max(), np.abs(a).max()) < most)


def _binomial(order: int) -> Array:
    """(1 + 1/z)^order."""
    found = np.ones(1)
    for _ in range(order):
        found = np.convolve(found, [1.0, 1.0])
    return found
