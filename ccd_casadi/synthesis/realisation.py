"""A state space of a transfer function, compared with it: two ways are tried, none is believed.

Conversions lose poles over many decades and entries with small numerators. So each is compared at
frequencies about every root, within what rounding of the coefficients alone explains.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
from scipy.linalg import block_diag

from ccd_casadi.lti.state_space import StateSpace, balanced
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import UserError

if TYPE_CHECKING:
    import control

AWAY, BEYOND, POINTS = 1.01, 30.0, 200  # from a root, of the outermost roots, frequencies
OF_NUMERATOR, OF_DENOMINATOR = 1e-6, 1e-9  # relative errors of coefficients that are allowed
UNSTABLE, AT_REST = 1e-4, 1e-6  # Re p over |p| that counts; |p| over the largest that is 0


def realised(system: "control.TransferFunction") -> StateSpace:
    """A state space with this response and its poles. Raises UserError where there is none."""
    import control

    num, den = _polynomials(system)
    if any(len(n) > len(d) for n, d in zip(num.flat, den.flat, strict=True)):
        raise UserError("the system has no state space: more zeros than poles; make it proper")
    period = float(system.dt or 0.0)

    def by_library() -> StateSpace:
        space = control.ss(system)
        return StateSpace(space.A, space.B, space.C, space.D, period=period)

    ways: list[Callable[[], StateSpace]] = [by_library, lambda: _by_columns(num, den, period)]
    for way in ways if num.size > 1 else ways[1:]:
        try:
            found = way()
        except (ValueError, np.linalg.LinAlgError, control.ControlMIMONotImplemented):
            continue
        if _same(num, den, found):
            return found
    words = "no state space has its response and poles to six digits"
    raise UserError(f"the transfer function is lost in conversion: {words}; give A, B, C, D")


def _polynomials(system: "control.TransferFunction") -> tuple[np.ndarray, np.ndarray]:
    """Numerators and denominators (p, m) of object, without leading zeros, denominators monic."""
    p, m = system.noutputs, system.ninputs
    num, den = np.empty((p, m), object), np.empty((p, m), object)
    for i, j in np.ndindex(p, m):
        n, d = (np.asarray(part[i][j], float) for part in (system.num, system.den))
        if not (np.isfinite(n).all() and np.isfinite(d).all()):
            raise UserError("a coefficient of the transfer function is not a finite number")
        d = np.trim_zeros(d, "f")
        num[i, j], den[i, j] = np.trim_zeros(n, "f") / d[0], d / d[0]
    return num, den


def _by_columns(num: np.ndarray, den: np.ndarray, period: float) -> StateSpace:
    """In controllable companion form, one for each denominator of a column, balanced."""
    p, m = num.shape
    blocks, drive, reading, D = [], [], [], np.zeros((p, m))
    for j in range(m):
        alike: dict[tuple[float, ...], list[int]] = {}
        for i in range(p):
            alike.setdefault(tuple(den[i, j]), []).append(i)
        for d, rows in alike.items():
            n = len(d) - 1
            C = np.zeros((p, n))
            for i in rows:
                full = np.concatenate([np.zeros(n + 1 - len(num[i, j])), num[i, j]])
                D[i, j] = full[0]
                C[i] = full[1:] - full[0] * np.array(d[1:])
            A, B = np.eye(n, k=-1), np.zeros((n, m))
            if n:
                A[0], B[0, j] = -np.array(d[1:]), 1.0
            A, B, C = balanced(A, B, C) if n else (A, B, C)
            blocks.append(A)
            drive.append(B)
            reading.append(C)
    A = block_diag(*blocks)[: sum(map(len, blocks))]
    return StateSpace(A, np.vstack(drive), np.hstack(reading), D, period=period)


def _same(num: np.ndarray, den: np.ndarray, found: StateSpace) -> bool:
    """Whether response and poles are those of the polynomials."""
    if not all(np.isfinite(part).all() for part in (found.A, found.B, found.C, found.D)):
        return False
    each = [np.roots(d) for d in den.flat]
    unstable = [_unstable(poles, found.period) for poles in each]
    own = _unstable(found.poles, found.period)
    if num.size == 1:
        if len(found.A) != len(each[0]) or own != unstable[0]:
            return False
    elif not max(unstable) <= own <= sum(unstable):
        return False
    roots = np.concatenate([*each, *(np.roots(n) for n in num.flat)])
    omega = _frequencies(found.rates_of(roots), found.period)
    s = found.variable(omega)
    response = found.response(omega)
    for (i, j), n in np.ndenumerate(num):
        d = den[i, j]
        below, above = np.polyval(d, s), np.polyval(n, s)
        size, spread = np.abs(below), np.polyval(np.abs(d), np.abs(s))
        allowed = OF_NUMERATOR * np.polyval(np.abs(n), np.abs(s))
        allowed = (allowed + OF_DENOMINATOR * np.abs(above) * spread / size) / size
        if not (np.abs(response[:, i, j] - above / below) <= allowed).all():
            return False
    return True


def _unstable(poles: np.ndarray, period: float) -> int:
    if period:
        return int((np.abs(poles) > 1.0 + UNSTABLE).sum())
    away = np.abs(poles) > AT_REST * np.abs(poles).max(initial=0.0)
    return int((away & (poles.real > UNSTABLE * np.abs(poles))).sum())


def _frequencies(rates: np.ndarray, period: float) -> Array:
    """About every root, and in between, in rad/s."""
    size = np.abs(rates)[np.abs(rates) > 0.0]
    size = np.append(size, [1.0 / period] if period else [] if len(size) else [1.0])
    top = size.max() * BEYOND
    grid = np.geomspace(size.min() / BEYOND, top, POINTS)
    omega = np.concatenate([grid, size * AWAY, size / AWAY])
    return np.unique(omega[omega <= (0.999 * np.pi / period if period else top)])
