"""Least-squares polynomials of total degree p, the degree by leave-one-out.

Source: Hastie, Tibshirani & Friedman, The Elements of Statistical Learning (2009),
section 3.2 for the deviation, eq. 7.64 for leave-one-out in closed form.
"""

from dataclasses import dataclass
from itertools import combinations_with_replacement
from math import comb
from typing import Literal, overload

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import qr, solve_triangular

from surrogates.interface import Array, Errors, SurrogateFitError, box, freeze, points_in
from surrogates.samples import Samples
from surrogates.validation import errors

MAX_DEGREE = 12
MAX_TERMS = 500
# Terms that the observations do not tell apart, or samples that nothing else pins.
SINGULAR = 1e-9
# Weights tried on gradients beside values: where the polynomial cannot follow the
# function, slopes are wrong by more than values are.
GRADIENT_WEIGHTS = (1.0, 0.1)


@dataclass(frozen=True, eq=False)
class Polynomial:
    """A polynomial in Legendre products, v = 2 (x - lower) / (upper - lower) - 1.

    value(x) = Σ_i coefficients_i Π_j P_{exponents_ij}(v_j), output units;
    variance(x) = residual_variance (1 + ‖root φ(x)‖²), φ the products: that of an
    unseen sample, the misfit of the polynomial included.

    exponents (m, d), coefficients (m,), root (m, m). left_out (n,), loo: output units.
    """

    lower: Array
    upper: Array
    exponents: Array
    coefficients: Array
    root: Array
    residual_variance: float
    left_out: Array
    loo: Errors

    def __post_init__(self) -> None:
        d, m = box(self.lower, self.upper)[0].size, self.coefficients.size
        if self.exponents.shape != (m, d) or self.root.shape != (m, m):
            raise ValueError(f"exponents and root do not fit {m} coefficients of {d} inputs")
        if (self.exponents != np.round(self.exponents)).any() or (self.exponents < 0).any():
            raise ValueError("exponents must be whole and not negative")
        freeze(self.lower, self.upper, self.exponents, self.coefficients, self.root, self.left_out)

    @property
    def degree(self) -> int:
        """The total degree p."""
        return int(self.exponents.sum(axis=1).max())

    @overload
    def predict(self, X: ArrayLike, return_std: Literal[False] = False) -> Array: ...
    @overload
    def predict(self, X: ArrayLike, return_std: Literal[True]) -> tuple[Array, Array]: ...
    def predict(self, X: ArrayLike, return_std: bool = False) -> Array | tuple[Array, Array]:
        """Return the value (m,) at X (m, d), and the standard deviation (m,) if asked."""
        unit = (points_in(self, X) - self.lower) / (self.upper - self.lower)
        phi = products(self.exponents, unit)[0]
        value = phi @ self.coefficients
        if not return_std:
            return value
        h = np.sum((phi @ self.root.T) ** 2, axis=1)
        return value, np.sqrt(self.residual_variance * (1.0 + h))


def fit_polynomial(samples: Samples, degree: int | None = None) -> Polynomial:
    """Return the weighted least-squares polynomial of the degree with least error left out.

    Weights are 1 / noise where the noise is known. Gradients, where there are any,
    are further equations, left out together with their sample.

    Raises:
        SurrogateFitError: the `degree` asked for has more terms than the samples settle.
    """
    n, d = samples.X.shape
    degrees = range(MAX_DEGREE + 1) if degree is None else [degree]
    weights = (1.0,) if samples.dY is None else GRADIENT_WEIGHTS
    best: Polynomial | None = None
    for p in degrees:
        terms = comb(d + p, p)
        if terms >= samples.observations or (terms > MAX_TERMS and degree is None):
            break
        for weight in weights:
            found = _least_squares(samples, p, weight)
            if found is not None and (best is None or found.loo.rms < best.loo.rms):
                best = found
    if best is None:
        raise SurrogateFitError(
            f"{n} samples of {d} inputs do not settle a polynomial of degree {degree}: "
            "take more samples or a lower degree"
        )
    return best


def _least_squares(samples: Samples, degree: int, gradient_weight: float) -> Polynomial | None:
    """The polynomial of this degree, or None if the samples do not settle it."""
    n, d = samples.X.shape
    exponents = total_degree(d, degree)
    phi, slopes = products(exponents, samples.unit, samples.dY is not None)
    rows, targets, weights = [phi], [samples.Y], [samples.least_squares_weights]
    if samples.dY is not None:
        for j in range(d):  # by v, half of the box: the unit in which P_k(v) is of order 1
            rows.append(slopes[j])
            targets.append(samples.dY[:, j] * (samples.upper - samples.lower)[j] / 2.0)
            weights.append(gradient_weight * samples.least_squares_weights)
    w = np.concatenate(weights)
    A, b = np.vstack(rows) * w[:, None], np.concatenate(targets) * w
    Q, R = qr(A, mode="economic")
    pivots = np.abs(np.diag(R))
    if pivots.min() < SINGULAR * pivots.max():
        return None
    coefficients = solve_triangular(R, Q.T @ b)
    # Leaving out sample i with its gradient: residual (I - H_ii)⁻¹ e_i, first component.
    c = len(rows)
    Q = Q.reshape(c, n, -1)
    gap = np.eye(c) - np.einsum("aim,bim->iab", Q, Q)
    if np.linalg.eigvalsh(gap).min() < SINGULAR:
        return None
    e = (b - A @ coefficients).reshape(c, n).T
    left_out = np.linalg.solve(gap, e[:, :, None])[:, 0, 0] / w[:n]
    # var(left out) = s² / (1 - h): solved for s², sample by sample, and averaged.
    variance = float(np.mean((w[:n] * left_out) ** 2 * gap[:, 0, 0]))
    return Polynomial(
        lower=samples.lower,
        upper=samples.upper,
        exponents=exponents,
        coefficients=coefficients,
        root=solve_triangular(R, np.eye(len(R)), trans="T"),
        residual_variance=variance,
        left_out=left_out,
        loo=errors(left_out, samples.Y),
    )


def total_degree(d: int, degree: int) -> Array:
    """Return the exponents (m, d), m = C(d + p, p), of the products of degree <= p.

    >>> total_degree(2, 1).tolist()
    [[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]
    """
    rows = [
        np.bincount(chosen, minlength=d) if chosen else np.zeros(d)
        for k in range(degree + 1)
        for chosen in combinations_with_replacement(range(d), k)
    ]
    return np.array(rows, dtype=float)


def products(exponents: Array, unit: Array, slopes: bool = False) -> tuple[Array, list[Array]]:
    """Return φ (n, m) at points in the unit box (n, d), and [∂φ/∂v_j (n, m)] if asked."""
    powers = exponents.astype(int)
    v = 2.0 * unit - 1.0
    table = [np.ones_like(v), v]
    derivative = [np.zeros_like(v), np.ones_like(v)]
    for k in range(1, int(powers.max(initial=1))):
        table.append(((2 * k + 1) * v * table[k] - k * table[k - 1]) / (k + 1))
        derivative.append(derivative[k - 1] + (2 * k + 1) * table[k])
    P, dP = np.array(table), np.array(derivative)
    d = v.shape[1]
    factors = [P[powers[:, j], :, j].T for j in range(d)]
    phi = np.prod(factors, axis=0)
    if not slopes:
        return phi, []
    along = []
    for j in range(d):
        others = np.prod([f for i, f in enumerate(factors) if i != j], axis=0)
        along.append(dP[powers[:, j], :, j].T * others)
    return phi, along
