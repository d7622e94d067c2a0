"""Powell's damped BFGS update: the matrix stays positive definite (Nocedal and Wright, 18.3)."""

import numpy as np

from ccd_casadi.support.arrays import Array


def damped_bfgs(H: Array, s: Array, y: Array) -> Array:
    """H (n, n) with the curvature that a change y of the gradient along the step s shows."""
    Hs = H @ s
    curvature = float(s @ Hs)
    if curvature <= 1e-16 * float(np.trace(H)):
        return H
    if s @ y < 0.2 * curvature:
        share = 0.8 * curvature / (curvature - float(s @ y))
        y = share * y + (1.0 - share) * Hs
    return np.asarray(H - np.outer(Hs, Hs) / curvature + np.outer(y, y) / float(s @ y))
