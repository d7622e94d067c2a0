"""A difference equation in integers, as a processor without floating point computes it.

Every signal is an integer times its step: errors and forces words of 16 or 32 bits, states words
with `guard` more bits behind the point. A coefficient has its own binary point,

    v_i = ⌊(Σ_j ⌊c_ij z_j / 2^s_ij⌋ + 2^g f_i + 2^(g-1)) / 2^g⌋,    z = [⌊X/2^g⌋, e, u - v],
    X_i ← X_i + Σ_j ⌊c_ij z_j / 2^s_ij⌋,

where c of the states are those of A - I: a slow pole keeps the digits of its distance from 1, and
what a word of X cannot hold stays in its guard bits and is not lost. Everything saturates.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ccd_casadi.support.arrays import Array


@dataclass(frozen=True)
class Term:
    """⌊value · z[source] / 2^shift⌋ of a sum."""

    value: int
    shift: int
    source: int

    def of(self, z: Sequence[int]) -> int:
        """Compute the term's integer product.

        Parameters
        ----------
        z : sequence of int

        Returns
        -------
        int
        """
        product = self.value * z[self.source]
        return product >> self.shift if self.shift >= 0 else product << -self.shift


Rows = tuple[tuple[Term, ...], ...]


@dataclass(frozen=True)
class FixedPoint:
    """The integers of a controller with n states, p errors and m forces."""

    bits: int  # of a word
    guard: int  # bits of a state behind its word
    states: Array  # (n,) SI in one count
    errors: Array  # (p,) the same
    forces: Array  # (m,) the same
    to_forces: Rows  # sums over z = [x; e; u - v]
    to_states: Rows  # the same
    at_start: Rows  # over [x; e; u], and X itself
    limits: tuple[int, ...]  # of each force

    @property
    def largest(self) -> int:
        """The largest word; the least is its negative."""
        return int(2 ** (self.bits - 1) - 1)

    def counts(self, values: Array, steps: Array) -> list[int]:
        """Values in SI as words.

        Parameters
        ----------
        values, steps : array (k,)

        Returns
        -------
        list of int
        """
        most = float(self.largest)
        return [int(x) for x in np.clip(np.rint(np.asarray(values) / steps), -most, most)]

    def begin(self, e: Sequence[int], u: Sequence[int]) -> list[int]:
        """Take over without a jump.

        Parameters
        ----------
        e, u : sequence of int
            Words.

        Returns
        -------
        list of int
            X.
        """
        z = [0] * len(self.states) + [*e, *u]
        return [self._held(sum(term.of(z) for term in row)) for row in self.at_start]

    def step(
        self, X: Sequence[int], e: Sequence[int], f: Sequence[int]
    ) -> tuple[list[int], list[int], bool]:
        """Compute one sample of the controller in integers.

        Parameters
        ----------
        X, e, f : sequence of int
            States, and words of errors and feedforward.

        Returns
        -------
        u, X : list of int
        saturated : bool
            Whether a force or a state has met its limit.
        """
        g, m = self.guard, len(self.forces)
        z = [value >> g for value in X] + list(e) + [0] * m
        wanted = [(sum(term.of(z) for term in row) + (own << g) + (1 << g >> 1)) >> g
                  for row, own in zip(self.to_forces, f, strict=True)]  # fmt: skip
        u = [min(max(v, -most), most) for v, most in zip(wanted, self.limits, strict=True)]
        most = self.largest
        z[-m:] = [min(max(a - v, -most), most) for a, v in zip(u, wanted, strict=True)]
        moved = [x + sum(term.of(z) for term in row)
                 for x, row in zip(X, self.to_states, strict=True)]  # fmt: skip
        after = [self._held(x) for x in moved]
        return u, after, u != wanted or after != moved

    def without_limit(self) -> "FixedPoint":
        """The same whose forces have the whole range of a word."""
        return replace(self, limits=(self.largest,) * len(self.forces))

    def only_clipped(self) -> "FixedPoint":
        """The same that feeds back nothing of what a limit cuts off."""
        first = len(self.states) + len(self.errors)
        kept = tuple(tuple(t for t in row if t.source < first) for row in self.to_states)
        return replace(self, to_states=kept)

    def _held(self, x: int) -> int:
        most = self.largest << self.guard
        return min(max(x, -most), most)
