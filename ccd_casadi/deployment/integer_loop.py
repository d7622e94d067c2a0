"""A loop whose controller computes in integers: what it needs, what rounding adds; in words."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import isfinite

import numpy as np

from ccd_casadi.analysis.setpoint import Setpoint
from ccd_casadi.analysis.setpoint_feedforward import forward_force, forward_gains
from ccd_casadi.codesign.reasons import Finding, Reason
from ccd_casadi.deployment.fixed_point import Ranges
from ccd_casadi.deployment.integer_equation import FixedPoint, Term
from ccd_casadi.deployment.on_hardware import UNLIMITED, OnHardware
from ccd_casadi.lti.ports import BreakPoint, course
from ccd_casadi.lti.state_space import StateSpace, closed_loop
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.text import spoken, with_unit


@dataclass(frozen=True)
class ResponseSumOptions:
    """Numbers of a sum over an impulse response."""

    block: int = 256  # samples at once
    share: float = 1e-3  # of the sum, that the rest may be
    most: int = 20_000  # blocks at most; beyond them nothing is known


@dataclass(frozen=True)
class RoundingBound:
    """The bound of what rounding adds to the outputs."""

    bits: int  # of a word
    errors: Array  # (p,) largest movement of each sensor, its unit; infinite where not known

    @property
    def largest(self) -> float:
        """The bound for the first sensor, which a move is of."""
        return float(self.errors[0])


def ranges_of_moves(
    plant: StateSpace, held: StateSpace, K: StateSpace, profile: Setpoint,
    forward: Array | None, places: Sequence[BreakPoint] = (),
) -> Ranges:  # fmt: skip
    """Largest values in moves of every axis, with feedforward where there is one and without.

    `plant` is from u to y in SI, `held` the same behind hold and delay, `K` as it runs; `forward`
    is (5, m, p), `places` are of several sensors on one actuator.
    """
    n, p, m = len(K.A), K.B.shape[1], len(K.C)
    count = int(np.ceil(2.0 * profile.duration / held.period))
    time = np.arange(count, dtype=float) * held.period
    peaks = np.zeros(n + p + m)
    for axis in range(1 if places else p):
        reference = course(plant, axis, places)[1]
        for way in (None,) if forward is None else (None, forward):
            gains = forward_gains(way, m, reference, axis, places)
            wanted, ahead = forward_force(profile, gains, time, held.period)
            x, z = np.zeros(len(held.A)), np.zeros(n)
            for r, f in zip(wanted, ahead, strict=True):
                e = reference * r - held.C @ x
                u = K.C @ z + K.D @ e + f
                peaks = np.maximum(peaks, np.abs(np.concatenate([z, e, u])))
                x, z = held.A @ x + held.B @ u, K.A @ z + K.B @ e
    return Ranges(peaks[:n], peaks[n : n + p], peaks[n + p :])


def rounding_bound(
    held: StateSpace, K: StateSpace, fixed: FixedPoint,
    options: ResponseSumOptions = ResponseSumOptions(),
) -> RoundingBound:  # fmt: skip
    """Bound what the integers move the sensors on one plant."""
    loop = closed_loop(held, K)
    n, k = len(held.A), len(K.A)
    states, count = fixed.states, 2.0**-fixed.guard
    at_e = loop.B_r * fixed.errors
    at_u = np.vstack([held.B, np.zeros((k, held.B.shape[1]))])
    # of X: the count that is cut off moves u and the next X by what it would have
    used = np.vstack([held.B @ K.C, K.A - np.eye(k)]) * states
    lost_u = np.array([_fractions(row) for row in fixed.to_forces]) * count
    lost_x = np.array([_fractions(row) for row in fixed.to_states]) * count * states
    sources = np.hstack([
        0.5 * at_e, at_u * fixed.forces * (1.0 + lost_u), used,
        np.vstack([np.zeros((n, k)), np.diag(lost_x)]),
    ])  # fmt: skip
    return RoundingBound(fixed.bits, _sum_responses(loop.A, sources, loop.C_y, options))


def _fractions(row: Sequence[Term]) -> int:
    return sum(term.shift > 0 for term in row)


def _sum_responses(A: Array, B: Array, C: Array, options: ResponseSumOptions) -> Array:
    """Σ_k |C A^k B| over all k and columns (p,)."""
    if not np.abs(np.linalg.eigvals(A)).max(initial=0.0) < 1.0:
        return np.full(len(C), np.inf)
    rows, last = [C], C
    for _ in range(options.block - 1):
        last = last @ A
        rows.append(last)
    block, jump = np.vstack(rows), np.linalg.matrix_power(A, options.block)
    total, before = np.zeros(len(C)), np.full(len(C), np.inf)
    for _ in range(options.most):
        part = np.abs(block @ B).sum(axis=1).reshape(options.block, len(C)).sum(axis=0)
        total = total + part
        ratio = part / np.maximum(before, np.finfo(float).tiny)
        # two blocks that fall alike: the rest falls at least as a series of their ratio
        rest = np.where(ratio < 1.0, part * ratio / np.maximum(1.0 - ratio, options.share), np.inf)
        if (rest <= options.share * total).all():
            return np.asarray(total + rest)
        before, B = part, jump @ B
    return np.full(len(C), np.inf)


def rounding_finding(found: RoundingBound) -> Finding:
    """State what integers add to the error."""
    why = Reason.ROUNDING if isfinite(found.largest) else Reason.ROUNDING_UNKNOWN
    return why(bits=found.bits, largest=found.largest)


def integer_words(
    fixed: FixedPoint | None, rounding: RoundingBound | None, moved: OnHardware | None
) -> tuple[str, ...]:
    """Describe what the integers of the code are, what they add, and what they may spoil.

    Parameters
    ----------
    fixed, rounding, moved : FixedPoint, RoundingBound, OnHardware or None

    Returns
    -------
    tuple of str
        Lines; empty of floating point.
    """
    if fixed is None:
        return ()
    counts = [
        f"{name} {' and '.join(f'{step:.3g}' for step in dict.fromkeys(steps.tolist()))} {unit}"
        for name, steps, unit in (("e", fixed.errors, "m"), ("u", fixed.forces, "N"))
    ]
    count = spoken(f"a count of {', of '.join(counts)}")
    first = f"{fixed.bits} bits, saturating; {count}; coefficients judged as rounded"
    faults = integer_faults(rounding, moved)
    added = () if faults or rounding is None else (rounding_finding(rounding).words(),)
    return first, *added, *faults


def integer_faults(rounding: RoundingBound | None, moved: OnHardware | None) -> tuple[str, ...]:
    """Describe what integers may spoil: a move that saturates a word, roundings that leave its
    window.

    Parameters
    ----------
    rounding, moved : RoundingBound, OnHardware or None

    Returns
    -------
    tuple of str
    """
    if rounding is None or moved is None:
        return ()
    parts = []
    if not rounding.largest <= moved.window:
        window = with_unit(moved.window, spoken("m"))
        beyond = f", beyond its window, {window}" if isfinite(rounding.largest) else ""
        parts.append(f"{rounding_finding(rounding).words()}{beyond}")
    full = [name for name, move in moved.ways.items() if name in UNLIMITED and move.saturated]
    if full:
        parts.append(f"a move saturates words of {rounding.bits} bits ({full[0]})")
    return tuple(parts)
