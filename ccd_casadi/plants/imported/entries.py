"""Numbers that are known at samples of θ as smooth functions of it: polynomials, or processes.

To each a polynomial is fitted by least squares, of the total degree that predicts rows left out
best. It is a Gaussian process where that predicts them better and samples are enough: a process
chooses its length scales, and on few samples the best error left out is luck.

Source: Hastie, Tibshirani & Friedman, The Elements of Statistical Learning (2009), eq. 7.64, for
leave-one-out in closed form.
"""

from itertools import combinations_with_replacement
from math import comb, prod

import casadi as ca
import numpy as np

from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import PlantError
from surrogates import SurrogateFitError, fit, to_casadi

MAX_DEGREE, MAX_TERMS = 12, 500
SINGULAR = 1e-9  # terms that the samples do not tell apart, or samples that nothing else pins
GOOD = 1e-3  # of an entry's range: below it a polynomial is not compared with a process


def fit_entries(theta: Array, Y: Array) -> tuple[ca.Function, Array]:
    """θ -> q numbers, of numbers Y (N, q) at samples θ (N, p), and the error (N, q) at each sample,
    predicted without it. Raises PlantError where the samples are too few."""
    lower, width = theta.min(axis=0), np.ptp(theta, axis=0)
    N, p = theta.shape
    unit = 2.0 * (theta - lower) / np.where(width > 0.0, width, np.nan) - 1.0
    if not np.isfinite(unit).all():
        words = "a parameter does not vary among the samples"
        raise PlantError(f"the samples cannot be interpolated: {words}; add samples")
    left_out = np.full(Y.shape, np.inf)
    coefficients = np.zeros((0, Y.shape[1]))
    powers = np.zeros((0, p))
    for degree in range(MAX_DEGREE + 1):
        if not comb(p + degree, degree) < min(N, MAX_TERMS + 1):
            break
        rows = combinations_with_replacement(range(p), degree)
        powers = np.vstack([powers, [np.bincount(row, minlength=p) for row in map(list, rows)]])
        coefficients = np.pad(coefficients, ((0, len(powers) - len(coefficients)), (0, 0)))
        A = np.prod(unit[:, None, :] ** powers, axis=2)
        Q, R = np.linalg.qr(A)
        own = 1.0 - (Q**2).sum(axis=1)
        pivots = np.abs(np.diag(R))
        if pivots.min() < SINGULAR * pivots.max() or own.min() < SINGULAR:
            continue
        found = np.linalg.solve(R, Q.T @ Y)
        errors = (Y - A @ found) / own[:, None]
        better = (errors**2).sum(axis=0) < (left_out**2).sum(axis=0)
        coefficients[:, better], left_out[:, better] = found[:, better], errors[:, better]
    if not np.isfinite(left_out).all():
        words = f"{N} samples of {p} parameters do not settle a polynomial"
        raise PlantError(f"the samples cannot be interpolated: {words}; add samples")
    x = ca.MX.sym("theta", p)
    scaled = 2.0 * (x - lower) / width - 1.0
    terms = [prod((scaled[j] ** int(k) for j, k in enumerate(row) if k), start=ca.MX(1.0))
             for row in powers]  # fmt: skip
    y = ca.vertsplit(ca.mtimes(ca.DM(coefficients.T), ca.vertcat(*terms)))
    rms = np.sqrt((left_out**2).mean(axis=0))
    enough = len(theta) >= 2 * comb(p + 3, 3)
    for i in np.flatnonzero(enough & (rms > GOOD * np.ptp(Y, axis=0)) & (np.ptp(Y, axis=0) > 0.0)):
        try:
            process = fit(theta, Y[:, i], noise=0.0, starts=2)
        except SurrogateFitError as error:
            raise PlantError(f"the samples cannot be interpolated: {error}; add samples") from error
        if process.loo.rms < rms[i]:
            y[i], left_out[:, i] = to_casadi(process, std=False)(x), process.left_out
    return ca.Function("entries", [x], [ca.vertcat(*y)]), left_out
