"""A controller in integers: their formats, chosen by the ranges of its signals.

Errors and forces are words of 16 or 32 bits, states words with `guard` more bits behind the point;
each coefficient has as many binary digits as a word holds (`integer_equation`).
"""

from dataclasses import dataclass, replace

import numpy as np

from ccd_casadi.analysis import MoveLimits
from ccd_casadi.deployment.integer_equation import FixedPoint, Rows, Term
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
