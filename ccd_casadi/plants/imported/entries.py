"""Numbers that are known at samples of θ as smooth functions of it, through every sample.

A polynomial trend and what it misses at the samples, spread by a radial function φ (universal
kriging; Matérn's covariance with ν = 7/2, which has three derivatives):

    y(θ) = P(θ) b + Σ_i a_i φ(|θ - θ_i|/l),   y(θ_i) = Y_i,   Pᵀa = 0

Degree and length l are, for each number, those that predict samples left out best.

Sources: Rasmussen & Williams, Gaussian Processes for Machine Learning (2006), 2.7 and 5.4.2, for
trends and, in closed form, samples left out: e_i = a_i/W_ii, a = W Y.
"""

from itertools import combinations_with_replacement
from math import comb, prod
from typing import Any

import casadi as ca
import numpy as np

from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import PlantError

LOST = "the samples cannot be interpolated"
MAX_DEGREE, MAX_TERMS = 12, 500
SINGULAR = 1e-9  # terms that the samples do not tell apart, or samples that nothing else pins
LENGTHS = (0.5, 1.0, 2.0)  # of half the range of each parameter
MOST = 1e4  # a_i over the numbers: beyond, their sum loses digits
AT_A_SAMPLE = 1e-16  # of the squared distance: φ has no slope there, but its root would


def fit_entries(theta: Array, Y: Array) -> tuple[ca.Function, Array]:
    """θ -> q numbers, of numbers Y (N, q) at samples θ (N, p), and the error (N, q) at each sample,
    predicted without it. Raises PlantError where the samples are too few, or one is there twice."""
    lower, width = theta.min(axis=0), np.ptp(theta, axis=0)
    N, p = theta.shape
    unit = 2.0 * (theta - lower) / np.where(width > 0.0, width, np.nan) - 1.0
    if not np.isfinite(unit).all():
        raise PlantError(f"{LOST}: a parameter does not vary among the samples; add samples")
    if len(np.unique(unit, axis=0)) < N:
        raise PlantError("two samples are at the same theta; keep one of them")
    squares = ((unit[:, None] - unit) ** 2).sum(axis=2)
    radial = [_matern(squares / length**2, np) for length in LENGTHS]
    left_out, trend = np.full(Y.shape, np.inf), np.zeros((0, Y.shape[1]))
    spread = np.zeros((len(LENGTHS), *Y.shape))
    powers = np.zeros((0, p))
    for degree in range(MAX_DEGREE + 1):
        if not comb(p + degree, degree) < min(N, MAX_TERMS + 1):
            break
        rows = combinations_with_replacement(range(p), degree)
        powers = np.vstack([powers, [np.bincount(row, minlength=p) for row in map(list, rows)]])
        trend = np.pad(trend, ((0, len(powers) - len(trend)), (0, 0)))
        Q, R = np.linalg.qr(np.prod(unit[:, None, :] ** powers, axis=2), mode="complete")
        (own, rest), R = np.split(Q, [len(powers)], axis=1), R[: len(powers)]
        pivots = np.abs(np.diag(R))
        if pivots.min() < SINGULAR * pivots.max() or (rest**2).sum(axis=1).min() < SINGULAR:
            continue
        for k, phi in enumerate(radial):
            W = rest @ np.linalg.solve(rest.T @ phi @ rest, rest.T)
            a = W @ Y
            errors = a / np.diag(W)[:, None]
            better = (errors**2).sum(axis=0) < (left_out**2).sum(axis=0)
            better &= (k == 0) | (np.abs(a).max(axis=0) <= MOST * np.abs(Y).max(axis=0))
            left_out[:, better], spread[:, :, better] = errors[:, better], 0.0
            spread[k][:, better] = a[:, better]
            trend[:, better] = np.linalg.solve(R, own.T @ (Y - phi @ a))[:, better]
    if not np.isfinite(left_out).all():
        words = f"{N} samples of {p} parameters do not settle a polynomial; add samples"
        raise PlantError(f"{LOST}: {words}")
    x = ca.MX.sym("theta", p)
    scaled = 2.0 * (x - lower) / width - 1.0
    terms = [prod((scaled[j] ** int(k) for j, k in enumerate(row) if k), start=ca.MX(1.0))
             for row in powers]  # fmt: skip
    y = ca.mtimes(ca.DM(trend.T), ca.vertcat(*terms))
    away = ca.sum1((ca.repmat(scaled, 1, N) - ca.DM(unit.T)) ** 2).T
    for length, a in zip(LENGTHS, spread, strict=True):
        if a.any():
            y += ca.mtimes(ca.DM(a.T), _matern(away / length**2, ca))
    return ca.Function("entries", [x], [y]), left_out


def _matern(squares: Any, module: Any) -> Any:
    """φ of squared distances over l², by NumPy or CasADi."""
    x = module.sqrt(7.0 * squares + AT_A_SAMPLE)
    return (1.0 + x + 0.4 * x**2 + x**3 / 15.0) * module.exp(-x)
