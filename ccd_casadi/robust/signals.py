"""From disturbance force and sensor noise to position and force: responses and RMS values.

    y = G S_i d - T n,   u = S_i d - K S n    (r = 0, S_i = (I + KG)⁻¹, e = -y - n)

White noise of one-sided density s (unit/√Hz) through H has the variance s² ‖H‖₂²/2.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_continuous_lyapunov
from scipy.optimize import minimize_scalar

from ccd_casadi.plants.scaling import StateSpace
from ccd_casadi.support.arrays import Array
from ccd_casadi.synthesis.norms import hinf_norm

REST = 1e-3  # of the lowest frequency of a grid: what counts as constant


@dataclass(frozen=True)
class ClosedLoop:
    """ẋ = A x + B_r r + B_d d, y = C_y x, u = C_u x + D_u r; sensor noise n enters as -r does."""

    A: Array
    B_r: Array
    B_d: Array
    C_y: Array
    C_u: Array
    D_u: Array


@dataclass(frozen=True)
class Noise:
    """RMS of every output and every input under given densities; inf where they are not finite."""

    position_by_noise: Array
    force_by_noise: Array
    position_by_disturbance: Array
    force_by_disturbance: Array


def closed_loop(plant: StateSpace, controller: StateSpace) -> ClosedLoop:
    """The loop of a strictly proper plant (u to y) and a controller (e = r - y - n to u), SI."""
    A, B, C = plant.A, plant.B, plant.C
    k = controller
    N = k.A.shape[0]
    return ClosedLoop(
        A=np.block([[A - B @ k.D @ C, B @ k.C], [-k.B @ C, k.A]]),
        B_r=np.vstack([B @ k.D, k.B]),
        B_d=np.vstack([B, np.zeros((N, B.shape[1]))]),
        C_y=np.hstack([C, np.zeros((C.shape[0], N))]),
        C_u=np.hstack([-k.D @ C, k.C]),
        D_u=k.D,
    )


def gains(G: NDArray, K: NDArray) -> Array:
    """σ_max of S, T, GS (disturbance force to position) and KS (noise to force), rows (4, k)."""
    S = np.linalg.inv(np.eye(G.shape[1]) + G @ K)
    parts = (S, G @ K @ S, S @ G, K @ S)
    return np.array([np.linalg.norm(part, 2, axis=(1, 2)) for part in parts])


def norms(loop: ClosedLoop) -> tuple[tuple[float, float], ...]:
    """‖·‖∞ of S, T, GS and KS, each with its frequency in rad/s (0: at rest), without a grid."""
    p, m = len(loop.C_y), loop.B_d.shape[1]
    nothing = np.zeros((p, p))
    parts = (
        StateSpace(loop.A, loop.B_r, -loop.C_y, np.eye(p)),
        StateSpace(loop.A, loop.B_r, loop.C_y, nothing),
        StateSpace(loop.A, loop.B_d, loop.C_y, np.zeros((p, m))),
        StateSpace(loop.A, loop.B_r, loop.C_u, loop.D_u),
    )
    return tuple(hinf_norm(part) for part in parts)


def highest(gain: Callable[[Array], Array], omega: Array) -> tuple[tuple[float, float], ...]:
    """The largest value of each row of gains (r, k), climbed from a grid in rad/s, and its ω.

    Of a loop in discrete time, from far below the grid (a constant signal) to its end.
    """
    omega = np.concatenate([REST * omega[:1], omega])
    values, found = gain(omega), []
    for row, i in enumerate(values.argmax(axis=1)):
        ends = omega[max(i - 1, 0)], omega[min(i + 1, len(omega) - 1)]
        top = minimize_scalar(
            lambda x, row=row: -float(gain(np.exp([x]))[row, 0]), bounds=np.log(ends),
            method="bounded", options={"xatol": 1e-10},
        )  # fmt: skip
        tops = (float(values[row, i]), 0.0 if i == 0 else float(omega[i]))
        found.append(max(tops, (-float(top.fun), float(np.exp(top.x)))) if i else tops)
    return tuple(found)


def noise(loop: ClosedLoop, sensor: float, disturbance: float) -> Noise:
    """RMS values for white sensor noise (m/√Hz) and white force at every input (N/√Hz)."""
    by_noise = _covariance(loop.A, loop.B_r, sensor)
    by_force = _covariance(loop.A, loop.B_d, disturbance)
    force = _rms(loop.C_u, by_noise)
    if loop.D_u.any():  # white noise straight to the force has no finite variance
        force = np.full_like(force, np.inf)
    return Noise(
        _rms(loop.C_y, by_noise), force, _rms(loop.C_y, by_force), _rms(loop.C_u, by_force)
    )


def _covariance(A: Array, B: Array, density: float) -> Array:
    return solve_continuous_lyapunov(A, -0.5 * density**2 * (B @ B.T))


def _rms(C: Array, X: Array) -> Array:
    return np.sqrt(np.maximum(np.einsum("ij,jk,ik->i", C, X, C), 0.0))
