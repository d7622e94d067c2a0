"""A difference equation in integers: formats chosen by ranges, coefficients as the C code has them.

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

from ccd_casadi.analysis import MoveLimits
from ccd_casadi.deployment.realisation import Realisation, takeover
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import UserError


@dataclass(frozen=True)
class FixedOptions:
    """Numbers of the formats."""

    headroom: float = 4.0  # of a range over a move's largest value; what is beyond it saturates
    guards: tuple[tuple[int, int], ...] = ((16, 16), (32, 28))  # bits of a word, and behind
    accumulator: int = 62  # bits of a sum beside its sign, one left free


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


@dataclass(frozen=True)
class FixedRequest:
    """The requirements on the integers of the code.

    Attributes
    ----------
    bits : int
        Of a word.
    moves : MoveLimits
        Moves that have to fit the range.
    sensor_step, force_step : float
        Of a count, m and N; 0: chosen by the range.
    """

    bits: int
    moves: MoveLimits
    sensor_step: float = 0.0
    force_step: float = 0.0


@dataclass(frozen=True)
class Ranges:
    """The largest |x| (n,), |e| (p,) and |u| (m,) that occur, SI."""

    states: Array
    errors: Array
    forces: Array


def in_fixed(
    realisation: Realisation, ranges: Ranges, request: FixedRequest,
    options: FixedOptions = FixedOptions(),
) -> Realisation:  # fmt: skip
    """The realisation with its integers, `system` and back-calculation as these are.

    `realisation` is in double precision, `ranges` are without headroom. Raises UserError where a
    step of the electronics is too fine for the range.
    """
    K, L, most = realisation.as_coded, realisation.back_calculation, 2 ** (request.bits - 1) - 1
    n, p, m = len(K.A), K.B.shape[1], len(K.C)

    def steps(peaks: Array, own: float, option: str) -> Array:
        if own:
            if peaks.max(initial=0.0) > own * most:
                reach, words = own * most, f"words of {request.bits} bits reach"
                raise UserError(f"{option} {own:g}: {words} {reach:.3g} and a move needs "
                                f"{peaks.max():.3g}; give a coarser step")  # fmt: skip
            return np.full(len(peaks), own)
        wide = np.where(peaks > 0.0, options.headroom * peaks, 1.0)
        return np.asarray(2.0 ** np.ceil(np.log2(wide)) / (most + 1.0))

    x = steps(ranges.states, 0.0, "")
    e = steps(ranges.errors, request.sensor_step, "--sensor-step")
    u = steps(ranges.forces, request.force_step, "--force-step")
    limit = realisation.saturation
    held = [most if limit is None else min(most, int(limit / own)) for own in u]
    if not all(held):
        raise UserError(f"--saturation {limit:g}: is below a step of the force, {u.max():.3g} N; "
                        "give finer steps or more bits")  # fmt: skip
    z = np.concatenate([x, e, u])
    back = np.zeros((n, m)) if L is None else L
    whole = (
        np.hstack([K.C, K.D, np.zeros((m, m))]) / u[:, None] * z,
        np.hstack([K.A - np.eye(n), K.B, back]) / x[:, None] * z,
        np.hstack([np.zeros((n, n)), takeover(K)]) / x[:, None] * z,
    )
    guard = _guard(np.vstack(whole), request.bits, options)
    to_forces, to_states, at_start = (
        tuple(_terms(row * 2.0**guard, request.bits) for row in M) for M in whole
    )
    fixed = FixedPoint(request.bits, guard, x, e, u, to_forces, to_states, at_start, tuple(held))
    forces, states = (_matrix(rows, own, z, guard)
                      for rows, own in ((to_forces, u), (to_states, x)))  # fmt: skip
    return replace(
        realisation,
        system=replace(K, A=np.eye(n) + states[:, :n], B=states[:, n : n + p], C=forces[:, :n],
                       D=forces[:, n : n + p]),
        back_calculation=None if L is None else states[:, n + p :],
        saturation=None if limit is None else float(min(h * own for h, own in zip(held, u,
                                                                                strict=True))),
        fixed=fixed,
    )  # fmt: skip


def _guard(M: Array, bits: int, options: FixedOptions) -> int:
    """Bits behind the point with which no sum overflows its accumulator."""
    largest = np.abs(M).sum(axis=1).max(initial=1.0) + 2.0  # beside X itself, and the feedforward
    room = options.accumulator - bits - int(np.ceil(np.log2(largest)))
    if room < 0:
        raise UserError(f"--fixed {bits}: gains from one signal to another are up to {largest:.3g} "
                        "counts; balance the controller, or deploy with --single")  # fmt: skip
    return min(dict(options.guards)[bits], room)


def _terms(row: Array, bits: int) -> tuple[Term, ...]:
    """The words nearest to the numbers of a row, each with as many binary digits as it has."""
    found = []
    for source, number in enumerate(row.tolist()):
        shift = bits - 1 - int(np.frexp(number)[1])
        value = round(np.ldexp(number, shift))
        if abs(value) >= 2 ** (bits - 1):  # it was rounded up to the next power of two
            value, shift = value // 2, shift - 1
        while value and value % 2 == 0 and shift > 0:
            value, shift = value // 2, shift - 1
        if value and shift < 63:  # else it is less than a count behind the point
            found.append(Term(value, shift, source))
    return tuple(found)


def _matrix(rows: Rows, own: Array, z: Array, guard: int) -> Array:
    """Convert the integers to a matrix in SI."""
    found = np.zeros((len(rows), len(z)))
    for i, row in enumerate(rows):
        for term in row:
            size = np.ldexp(float(term.value), -term.shift - guard)
            found[i, term.source] = size * own[i] / z[term.source]
    return found
