"""Stationary covariances by Lyapunov's equation, and variances' derivatives by its adjoint.

    continuous   A P + P A' + Q = 0        A' X + X A + W = 0
    sampled      (1 + A) P (1 + A)' - P + Q = 0        and alike

    d tr(W P) = 2 tr(X dA P) + tr(X dQ)      (continuous; sampled 2 tr(X dA P (1 + A)') + …)

so one more equation gives the derivatives to any number of parameters. The sampled one is solved
as a continuous one, of A_c = (2 + A)⁻¹A and 2 (2 + A)⁻¹ Q (2 + A)⁻ᵀ.
"""

import numpy as np
from scipy.linalg import solve_continuous_lyapunov

from ccd_casadi.support.arrays import Array


def covariance(A: Array, Q: Array, *, sampled: bool) -> Array:
    """P of a stable process with Q symmetric; a sampled one's A is the change over a period."""
    if sampled:
        inverse = np.linalg.inv(2.0 * np.eye(len(A)) + A)
        A, Q = inverse @ A, 2.0 * inverse @ Q @ inverse.T
    P = solve_continuous_lyapunov(A, -Q)
    return np.asarray(0.5 * (P + P.T))


def weighted_slopes(
    A: Array, P: Array, weight: Array, changes: list[tuple[Array, Array]], *, sampled: bool
) -> Array:
    """d tr(W P) for changes (dA, dQ) at a fixed symmetric W (n, n)."""
    X = covariance(A.T, weight, sampled=sampled)
    after = P @ (A.T + np.eye(len(A))) if sampled else P
    return np.array([2.0 * np.sum(X * (dA @ after).T) + np.sum(X * dQ) for dA, dQ in changes])
