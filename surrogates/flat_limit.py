"""The mean of a process whose kernel is nearly flat over the box, without cancellation.

Long length scales make all covariances nearly equal, and weights of 10⁹ that cancel. They cancel
in the part of the kernel that is of finite rank and known in closed form,

    k(x, y) = e(x) e(y) (T(x, y) + R(x, y)),    T a polynomial of x:

Matérn 5/2, e = 1: T = 1 - 5/6 s + 25/24 s², R = O(s^(5/2)), s the scaled squared distance;
RBF, e = exp(-‖x̃‖²/2): T = Σ_{k<=q} u^k / k!, R = O(u^(q+1)), u = x̃·ỹ, x̃ = (x - middle) / lengths.

Kept after a study (docs/surrogates.md): without it, of 128 IPOPT solves on smooth functions 54
(Matérn) and 102 (RBF) end at the "acceptable" level and up to 9 more find no feasible point; length
scales up to 10 boxes mend Matérn alone; a jitter of 1e-10 mends both, but moves J of the case
studies by up to 4e-9, and the error at the optimum from 8e-9 to 3e-5.

So Σ_i α_i T(x, X_i) is one polynomial, whose coefficients are summed once in extended precision,
and what is left to sum at every look is small. The same arithmetic serves arrays and symbols.

Source: Driscoll & Fornberg, Interpolation in the limit of increasingly flat radial basis
functions, Comput. Math. Appl. 43 (2002); Fornberg, Larsson & Flyer, SIAM J. Sci. Comput. 33 (2011).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import comb, factorial
from typing import Any, Protocol

import numpy as np

from surrogates.covariance import ROOT5, Hyperparameters, Kernel
from surrogates.interface import Array
from surrogates.polynomial import products, total_degree
from surrogates.sampling_plan import sobol

# Cancellation that is left as it is, and what the degree of T is chosen for.
HARMLESS, AIM = 1e-10, 1e-12
# How flat the kernel has to be: the largest s (Matérn) and |u| (RBF) in the box.
MATERN_FLAT, RBF_FLAT = 1.0, 4.0
RBF_DEGREES = range(2, 9)
MOST_TERMS = 500
# Remainders are summed as series up to these s and |u|, in closed form beyond.
MATERN_SERIES, MATERN_TERMS = 2.0, 40  # (√5 √2)^40 / 38! < 1e-24
RBF_SERIES, RBF_TERMS = 6.0, 45  # 6^45 / 45! < 1e-21
# Added to s under the root of the odd terms, which start at r³: AD finds 0 · 1e15 and not 0 · inf.
UNDER_ROOT = 1e-30
NODES_A_TERM = 3


@dataclass(frozen=True, eq=False)
class FlatLimit:
    """mean = e(x) (Σ_m polynomial_m φ_m(x) + Σ_i R-terms), in units of the scaled output.

    exponents (m, d), polynomial (m,): in Legendre products of the unit box. values (n,), slopes
    (n, d) or None: the weights of R and of its derivative, σ² and e(X_i) included. degree: of T.
    """

    kernel: Kernel
    degree: int
    exponents: Array
    polynomial: Array
    values: Array
    slopes: Array | None
    points: Array
    lengths: Array

    def mean(self, unit: Array) -> Array:
        """The mean (m,) at points (m, d) of the unit box, in units of the scaled output."""
        p = products(self.exponents, unit)[0] @ self.polynomial
        x = (unit - 0.5) / self.lengths
        if self.kernel is Kernel.RBF:
            u = x @ self.points.T
            total = remainder_of_exp(u, self.degree, ARRAYS) @ self.values
            if self.slopes is not None:
                along = x @ self.slopes.T
                total += np.sum(along * remainder_of_exp(u, self.degree - 1, ARRAYS), axis=1)
            return np.asarray(np.exp(-0.5 * np.sum(x * x, axis=1)) * (p + total))
        z = x[:, None, :] - self.points
        s = np.einsum("mij,mij->mi", z, z)
        remainders = remainder_of_matern(s, int(self.slopes is not None), ARRAYS)
        total = remainders[0] @ self.values
        if self.slopes is not None:
            total -= 2.0 * np.sum(np.einsum("mij,ij->mi", z, self.slopes) * remainders[1], axis=1)
        return np.asarray(p + total)


def flat_limit(kernel: Kernel, p: Hyperparameters, X: Array, weights: Array) -> FlatLimit | None:
    """Return the mean of a process in this form; None where it does not need it, or is too rough.

    X (n, d) in the unit box; weights (n,) of values, or (n (1 + d),) of values and slopes.
    """
    n, d = X.shape
    lost = cancellation(p, weights, n)
    degree = None if lost <= HARMLESS else _degree(kernel, p.length_scales, lost)
    if degree is None:
        return None
    points = (X - 0.5) / p.length_scales
    by_component = p.signal_variance * weights.reshape(-1, n)
    values, slopes = by_component[0].copy(), None
    if len(by_component) > 1:
        slopes = (by_component[1:] / p.length_scales[:, None]).T.copy()
    if kernel is Kernel.RBF:
        own = np.exp(-0.5 * np.sum(points**2, axis=1))
        values *= own
        if slopes is not None:
            slopes *= own[:, None]
            values -= np.sum(slopes * points, axis=1)
    exponents = total_degree(d, degree)
    nodes = sobol(np.zeros(d), np.ones(d), NODES_A_TERM * len(exponents), seed=0)
    known = _finite_part(kernel, degree, (nodes - 0.5) / p.length_scales, points, values, slopes)
    found = np.linalg.lstsq(products(exponents, nodes)[0], known, rcond=None)[0]
    polynomial = np.asarray(found, dtype=float)
    return FlatLimit(kernel, degree, exponents, polynomial, values, slopes, points, p.length_scales)


def cancellation(p: Hyperparameters, weights: Array, n: int) -> float:
    """Return the rounding error of k̂ᵀ weights in scaled units: eps σ² Σ_i |α_i| c_i.

    c = 1 for values (n,) and 1 / l_j for slopes. More noise or jitter lowers it, and costs one
    to two digits of accuracy.
    """
    largest = np.repeat(np.append(1.0, 1.0 / p.length_scales), n)[: weights.size]
    return float(np.finfo(float).eps) * p.signal_variance * float(largest @ np.abs(weights))


def _degree(kernel: Kernel, lengths: Array, lost: float) -> int | None:
    """The degree of T that leaves a harmless cancellation, or the largest that is affordable."""
    d, flat = lengths.size, float(np.sum(1.0 / lengths**2))
    if kernel is Kernel.MATERN52:
        degrees = [4] if flat <= MATERN_FLAT else []
    else:
        degrees = list(RBF_DEGREES) if flat / 4.0 <= RBF_FLAT else []
    affordable = [q for q in degrees if comb(d + q, q) <= MOST_TERMS]
    for q in affordable:
        if (flat / 4.0) ** (q + 1) / factorial(q + 1) * lost <= AIM:
            return q
    return max(affordable, default=None)


def _finite_part(
    kernel: Kernel, degree: int, x: Array, points: Array, values: Array, slopes: Array | None
) -> Array:
    """Σ_i of the weights times T at x (m, d), summed in the longest floats of the machine."""
    long = np.longdouble
    a, b, w = x.astype(long), points.astype(long), values.astype(long)
    g = None if slopes is None else slopes.astype(long)
    total = np.zeros(len(a), dtype=long)
    for k in range(len(b)):  # one sample at a time bounds the memory
        if kernel is Kernel.RBF:
            u = a @ b[k]
            shorter, last = np.ones_like(u), np.ones_like(u)
            for j in range(1, degree + 1):
                last = last * u / j
                shorter += last if j < degree else 0.0
            total += w[k] * (shorter + last)
            if g is not None:
                total += (a @ g[k]) * shorter
            continue
        z = a - b[k]
        s = np.sum(z * z, axis=1)
        total += w[k] * (1 - 5 * s / 6 + 25 * s * s / 24)
        if g is not None:
            total -= 2 * (z @ g[k]) * (25 * s / 12 - long(5) / 6)
    return total.astype(float)


class Arithmetic(Protocol):
    """What differs between arrays and symbols: ARRAYS below, SYMBOLS in `casadi_export`."""

    def exp(self, x: Any, /) -> Any: ...
    def sqrt(self, x: Any, /) -> Any: ...
    def choose(self, condition: Any, then: Any, otherwise: Any, /) -> Any: ...


class _Arrays:
    exp = staticmethod(np.exp)
    sqrt = staticmethod(np.sqrt)
    choose = staticmethod(np.where)


ARRAYS: Arithmetic = _Arrays()


def remainder_of_exp(u: Any, degree: int, arithmetic: Arithmetic) -> Any:
    """Return e^u - Σ_{k<=degree} u^k / k!: near 0 as its own series, where nothing cancels."""
    near = 1.0 + 0.0 * u
    for k in range(RBF_TERMS, degree + 1, -1):
        near = 1.0 + near * u / k
    near = near * u ** (degree + 1) / factorial(degree + 1)
    far = arithmetic.exp(u) - sum(u**k / factorial(k) for k in range(degree + 1))
    return arithmetic.choose(u * u < RBF_SERIES**2, near, far)


def remainder_of_matern(s: Any, order: int, arithmetic: Arithmetic) -> list[Any]:
    """Return [R, R'](s) up to `order` <= 1 of the kernel beyond 1 - 5/6 s + 25/24 s², likewise."""
    r = arithmetic.sqrt(s + UNDER_ROOT)
    # Series and closed form each stay finite where the other one is taken.
    far_s = arithmetic.choose(s < MATERN_SERIES, MATERN_SERIES + 0.0 * s, s)
    far_r = arithmetic.sqrt(far_s)
    e = arithmetic.exp(-ROOT5 * far_r)
    closed = [
        (1.0 + ROOT5 * far_r + (5.0 / 3.0) * far_s) * e
        - (1.0 - (5.0 / 6.0) * far_s + (25.0 / 24.0) * far_s * far_s),
        (-5.0 / 6.0) * (1.0 + ROOT5 * far_r) * e + (5.0 / 6.0) - (25.0 / 12.0) * far_s,
    ]
    series = [_VALUE, _SLOPE][: order + 1]
    return [
        arithmetic.choose(s < MATERN_SERIES, even_odd(c, first, s, r), outer)
        for (c, first), outer in zip(series, closed, strict=False)
    ]


def even_odd(c: Sequence[float], first_odd: int, s: Any, r: Any) -> Any:
    """Σ c_m r^m by Horner in s = r², the odd terms from first_odd with one r outside."""
    even = odd = 0.0 * s
    for coefficient in reversed(c[0::2]):
        even = coefficient + s * even
    for coefficient in reversed(c[first_odd::2]):
        odd = coefficient + s * odd
    return even + s ** ((first_odd - 1) // 2) * r * odd


def matern_series(terms: int) -> list[float]:
    """Taylor coefficients in r of (1 + a r + a² r²/3) e^(-a r), a = √5, degrees 0 to terms - 1.

    (-a)^m (m - 1)(m - 3) / (3 m!): those of r and r³ vanish, which makes the kernel twice
    differentiable.
    """
    return [(-ROOT5) ** m * ((m - 1) * (m - 3)) / (3.0 * factorial(m)) for m in range(terms)]


def _beyond(terms: int) -> list[float]:
    return [0.0 if m in (0, 2, 4) else c for m, c in enumerate(matern_series(terms))]


# R = Σ c_m r^m and R' = Σ (m/2) c_m r^(m-2).
_VALUE = (_beyond(MATERN_TERMS), 5)
_SLOPE = ([0.5 * (m + 2) * _VALUE[0][m + 2] for m in range(MATERN_TERMS - 2)], 3)
