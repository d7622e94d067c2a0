"""Hessians learnt from gradients (Nocedal and Wright 2006, 6.2 and 18.3)."""

import numpy as np

from ccd_casadi.support.arrays import Array

LOST = 1e-8  # share of its factors below which a scalar product is rounding


def damped_bfgs(H: Array, s: Array, y: Array) -> Array:
    """H (n, n) with the curvature that a change y of the gradient along the step s shows.

    Powell's damping keeps it positive definite.
    """
    Hs = H @ s
    curvature = float(s @ Hs)
    if curvature <= 1e-16 * float(np.trace(H)):
        return H
    if s @ y < 0.2 * curvature:
        share = 0.8 * curvature / (curvature - float(s @ y))
        y = share * y + (1.0 - share) * Hs
    return np.asarray(H - np.outer(Hs, Hs) / curvature + np.outer(y, y) / float(s @ y))


def symmetric_rank_one(H: Array, s: Array, y: Array) -> Array:
    """H (n, n) with H s = y, which may curve either way; as it is where the denominator is lost."""
    rest = y - H @ s
    size = float(rest @ s)
    if abs(size) <= LOST * float(np.linalg.norm(rest) * np.linalg.norm(s)):
        return H
    return np.asarray(H + np.outer(rest, rest) / size)


def convex(H: Array, least: float) -> Array:
    """H (n, n) with its eigenvalues raised to at least `least`."""
    values, vectors = np.linalg.eigh(H)
    return np.asarray((vectors * np.maximum(values, least)) @ vectors.T)
