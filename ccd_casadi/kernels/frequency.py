"""Frequency responses of state-space systems through their real Schur form, and their slopes.

With D⁻¹AD = Q T Qᵀ, D diagonal and T quasi upper triangular, C (jω - A)⁻¹ B =
(CDQ)(jω - T)⁻¹(QᵀD⁻¹B): one real back-substitution a frequency, with no row exchanges, so that a
whole grid runs through it in vector instructions.
"""

from typing import NamedTuple

import numpy as np

from ccd_casadi.kernels.compiled import compiled, inlined
from ccd_casadi.kernels.linear_algebra import balance, schur


class ResponseGridOptions(NamedTuple):
    """Numbers of responses over a grid.

    Attributes
    ----------
    chunk : int
        Frequencies at a time: the working rows stay in the first-level cache.
    """

    chunk: int = 32


OPTIONS = ResponseGridOptions()


@compiled
def prepare(A, B, C):
    """Transform a system by its real Schur form: each frequency then costs O(n²).

    T is off by eps ‖D⁻¹AD‖, and a controller's A is up to 3000 times as large as that.

    Parameters
    ----------
    A, B, C : arrays (n, n), (n, m), (p, n)

    Returns
    -------
    T, QᵀD⁻¹B, CDQ : arrays
        With D⁻¹AD = Q T Qᵀ.
    """
    A, scale = balance(A)
    T, Q, _, _, _ = schur(A)
    return T, Q.T.copy() @ (B / scale.reshape(-1, 1)), (C * scale) @ Q


@compiled
def _solve(T, X, ω):
    """X ← (jω - T)⁻¹ X, complex (n, m), at one frequency."""
    n, m = X.shape
    i = n - 1
    while i >= 0:
        first = i - 1 if i > 0 and T[i, i - 1] != 0.0 else i
        for row in range(first, i + 1):
            for k in range(i + 1, n):
                factor = T[row, k]
                for j in range(m):
                    X[row, j] += factor * X[k, j]
        if first == i:
            pivot = 1.0 / (1j * ω - T[i, i])
            for j in range(m):
                X[i, j] *= pivot
        else:
            a, d = 1j * ω - T[first, first], 1j * ω - T[i, i]
            b, c = T[first, i], T[i, first]
            pivot = 1.0 / (a * d - b * c)
            for j in range(m):
                x, y = X[first, j], X[i, j]
                X[first, j] = (d * x + b * y) * pivot
                X[i, j] = (c * x + a * y) * pivot
        i = first - 1


@inlined
def _solve_chunk(T, b, ω, x, y):
    """x + jy = (jω - T)⁻¹ b at every ω of a chunk; x, y are (n, chunk)."""
    n, count = b.size, ω.size
    i = n - 1
    while i >= 0:
        first = i - 1 if i > 0 and T[i, i - 1] != 0.0 else i
        for row in range(first, i + 1):
            xr, yr = x[row], y[row]
            for s in range(count):
                xr[s] = b[row]
                yr[s] = 0.0
            for k in range(i + 1, n):
                factor, xk, yk = T[row, k], x[k], y[k]
                for s in range(count):
                    xr[s] += factor * xk[s]
                    yr[s] += factor * yk[s]
        if first == i:
            a, xr, yr = T[i, i], x[i], y[i]
            for s in range(count):
                # (x + jy)/(-a + jω)
                size = 1.0 / (a * a + ω[s] * ω[s])
                re, im = xr[s], yr[s]
                xr[s] = (ω[s] * im - a * re) * size
                yr[s] = -(ω[s] * re + a * im) * size
        else:
            a, d, bb, c = T[first, first], T[i, i], T[first, i], T[i, first]
            x1, y1, x2, y2 = x[first], y[first], x[i], y[i]
            for s in range(count):
                # det = (jω - a)(jω - d) - bc
                re, im = a * d - bb * c - ω[s] * ω[s], -ω[s] * (a + d)
                size = 1.0 / (re * re + im * im)
                re, im = re * size, -im * size
                u = -d * x1[s] - ω[s] * y1[s] + bb * x2[s]
                v = -d * y1[s] + ω[s] * x1[s] + bb * y2[s]
                p = c * x1[s] - a * x2[s] - ω[s] * y2[s]
                q = c * y1[s] - a * y2[s] + ω[s] * x2[s]
                x1[s], y1[s] = u * re - v * im, u * im + v * re
                x2[s], y2[s] = p * re - q * im, p * im + q * re
        i = first - 1


@compiled
def responses(system, ω):
    """Evaluate C (jω - A)⁻¹ B.

    Parameters
    ----------
    system : tuple
        As `prepare` returns it.
    ω : array (k,)

    Returns
    -------
    complex array (k, p, m)
    """
    T, B, C = system
    n, m = B.shape
    p = C.shape[0]
    out = np.empty((ω.size, p, m), np.complex128)
    chunk = OPTIONS.chunk
    x, y = np.empty((n, chunk)), np.empty((n, chunk))
    re, im = np.empty(chunk), np.empty(chunk)
    for start in range(0, ω.size, chunk):
        part = ω[start : start + chunk]
        count = part.size
        for j in range(m):
            _solve_chunk(T, B[:, j].copy(), part, x, y)
            for i in range(p):
                re[:count], im[:count] = 0.0, 0.0
                for k in range(n):
                    factor, xk, yk = C[i, k], x[k], y[k]
                    for s in range(count):
                        re[s] += factor * xk[s]
                        im[s] += factor * yk[s]
                for s in range(count):
                    out[start + s, i, j] = complex(re[s], im[s])
    return out


@compiled
def response(system, ω):
    """C (jω - A)⁻¹ B, complex (p, m), of a prepared system."""
    T, B, C = system
    X = B.astype(np.complex128)
    _solve(T, X, ω)
    return _apply(C, X)


@compiled
def response_and_slope(system, ω):
    """The response and its derivative with respect to ω, -j C (jω - A)⁻² B."""
    T, B, C = system
    X = B.astype(np.complex128)
    _solve(T, X, ω)
    value = _apply(C, X)
    _solve(T, X, ω)
    return value, -1j * _apply(C, X)


@compiled
def _apply(C, X):
    p, n = C.shape
    m = X.shape[1]
    Y = np.zeros((p, m), np.complex128)
    for i in range(p):
        for j in range(m):
            for k in range(n):
                Y[i, j] += C[i, k] * X[k, j]
    return Y


@compiled
def _vertex(a, fa, x, fx, b, fb):
    """Return where the parabola through three points, a < x < b, is highest; x if it bends
    upwards."""
    left, right = (fx - fa) / (x - a), (fb - fx) / (b - x)
    bend = (left - right) / (b - a)
    return x + 0.5 * (left / bend - (x - a)) if bend > 0.0 else x


@compiled
def promised_rise(a, fa, x, fx, b, fb):
    """Return how far the parabola through three points, a < x < b, rises above fx; inf: it bends
    upwards.

    Points beside a pole are not evenly spread: a formula for even steps would promise too little.
    """
    left, right = (fx - fa) / (x - a), (fb - fx) / (b - x)
    bend = (left - right) / (b - a)
    return 0.25 * (left - bend * (x - a)) ** 2 / bend if bend > 0.0 else np.inf


@compiled
def next_trial(a, fa, x, fx, b, fb, tolerance):
    """The next ln ω to try in a bracket a < x < b with fx its best, and the room for a gain.

    The parabola's vertex; where that is x itself, a point a little way into the longer side, so
    that the bracket closes from both. The room is the larger drop to the bracket's ends: what a
    parabola may still promise is no measure, it can be zero by the symmetry of three points. It
    comes back as 0 once below `tolerance`, relative to fx, or when the bracket has closed.
    """
    room = max(fx - fa, fx - fb)
    if b - a < 1e-12 or room <= tolerance * abs(fx):
        return x, 0.0
    vertex = _vertex(a, fa, x, fx, b, fb)
    if not (a < vertex < b) or abs(vertex - x) < 1e-2 * (b - a):
        vertex = x - 0.1 * (x - a) if x - a > b - x else x + 0.1 * (b - x)
    return vertex, room


@compiled
def narrow(a, fa, x, fx, b, fb, new, f):
    """The bracket once `new` has been tried."""
    if f > fx:
        if new > x:
            return x, fx, new, f, b, fb
        return a, fa, new, f, x, fx
    if new > x:
        return a, fa, x, fx, new, f
    return new, f, x, fx, b, fb
