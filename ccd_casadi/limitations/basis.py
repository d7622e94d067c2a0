"""Functions that are analytic in the right half plane, and how much they bend on intervals of v.

The orthonormal functions of Takenaka and Malmquist with real poles, one of them many times
(Laguerre's functions), and pairs of complex ones (Kautz's), each times two fixed factors:

    φ_k(s) (a/(s + a))^e Π_z (s - z)/(s + z̄)^±1

The zeros z are those of the plant in the right half plane: T has them all (+); of a multiplier h
of T that part is turned back (-), so that h T is analytic.
"""

from dataclasses import dataclass

import numpy as np

from ccd_casadi.support.arrays import Array


@dataclass(frozen=True)
class Basis:
    """`reals` a > 0 for s = -a, then `pairs` p (Re p > 0, Im p > 0) for s = -p and its conjugate.

    `corner` a and `order` e of the roll-off; `zeros` z with `turned` -1 for a multiplier, +1 for
    a T; `constant`: 1 is one of the functions.
    """

    reals: tuple[float, ...]
    pairs: tuple[complex, ...]
    corner: float
    order: int
    zeros: tuple[complex, ...] = ()
    turned: int = -1
    constant: bool = False

    def values(self, v: Array) -> np.ndarray:
        """(len(v), n) at s = jv."""
        s = 1j * v
        fixed = (self.corner / (s + self.corner)) ** self.order
        for z in self.zeros:
            fixed = fixed * ((s - z) / (s + np.conj(z))) ** self.turned
        found = [fixed] if self.constant else []
        product = fixed
        for a in self.reals:
            below = s + a
            found.append(product * np.sqrt(2.0 * a) / below)
            product = product * ((s - a) / below)
        for p in self.pairs:
            b, c = 2.0 * p.real, abs(p) ** 2
            below = s * s + b * s + c
            found.append(product * np.sqrt(2.0 * b) * s / below)
            found.append(product * np.sqrt(2.0 * b * c) / below)
            product = product * (s * s - b * s + c) / below
        return np.array(found).T

    def most_curved(self, low: Array, high: Array, weight: Array) -> Array:
        """Σ_k weight_k max |d²/dv²| of every function on the intervals, or more.

        Of F = Π f_i with l_i = f_i'/f_i it is F (Σ l_i)² + F Σ l_i'; |l| <= 1/d and |l'| <= 1/d²
        of a pole at the distance d, 2 Re p/d² and 4 Re p/d³ of an all-pass factor.
        """
        assert not self.constant

        def near(p: complex) -> Array:
            gap = np.maximum(np.maximum(low + p.imag, -p.imag - high), 0.0)
            return np.asarray(np.hypot(p.real, gap))

        corner = near(self.corner + 0j)
        size = (self.corner / corner) ** self.order
        slope, bend = self.order / corner, self.order / corner**2
        for z in self.zeros:
            d = near(complex(z))
            slope, bend = slope + 2.0 * z.real / d**2, bend + 4.0 * z.real / d**3
        weights = iter(np.abs(weight).tolist())
        total = np.zeros(low.shape)
        for a in self.reals:
            d = near(complex(a))
            second = (slope + 1.0 / d) ** 2 + bend + 1.0 / d**2
            total += next(weights) * np.sqrt(2.0 * a) / d * size * second
            slope, bend = slope + 2.0 * a / d**2, bend + 4.0 * a / d**3
        for p in self.pairs:
            one, two = near(p), near(np.conj(p))
            b, r = 2.0 * p.real, size / (one * two)
            first = slope + 1.0 / one + 1.0 / two
            second = first**2 + bend + 1.0 / one**2 + 1.0 / two**2
            total += next(weights) * np.sqrt(2.0 * b) * r * (2.0 * first + high * second)
            total += next(weights) * np.sqrt(2.0 * b) * abs(p) * r * second
            slope = slope + b * (1.0 / one**2 + 1.0 / two**2)
            bend = bend + 2.0 * b * (1.0 / one**3 + 1.0 / two**3)
        return total

    def tail(self, start: float, weight: Array) -> float:
        """∫ |h| dv from `start` on, or more, with a roll-off of order 1: a real pole's function is
        at most √(2a)/v; from twice |p| on one of a pair at most 4√(4 Re p)/v, as |jv + p| >= v/2.
        """
        assert self.order == 1
        assert not self.constant
        assert start >= 2.0 * max(map(abs, self.pairs), default=0.0)
        most = [np.sqrt(2.0 * a) for a in self.reals]
        for p in self.pairs:
            most += [4.0 * np.sqrt(4.0 * p.real)] * 2
        return float(np.abs(weight) @ np.array(most) * self.corner / start)
