"""Inputs and outputs together along chosen motions, whatever their number; quiet modes left alone.

    [φ_quiet, 1, x, y, φ_damped] at the points = Q R

All act by the columns of Q after the quiet ones. They have length 1 and are normal to each other
and to what quiet modes show at the points.

Or they act as loads at reference points would, and read what moves there:

    f = (V_ref V⁺)ᵀ u,   y_ref = V_ref V⁺ y,   V = [1, x, y, x y] at the points

f are the least forces that do the work of the loads u on every motion V.
"""

from collections.abc import Sequence

import numpy as np

from ccd_casadi.plants.rigid_modes import natural_modes
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import PlantError


def in_axes(
    W: Array, dW: Array, motions: Array, dmotions: Array, quiet: int
) -> tuple[Array, Array]:
    """Weights of nodes (N, m) combined to those of axes, and the slopes.

    `motions` (N, c) are those of the nodes, of which the first `quiet` are left alone. Raises
    PlantError where the points do not tell them apart.
    """
    A, dA = W.T @ motions, dW.transpose(0, 2, 1) @ motions + W.T @ dmotions
    Q, R = np.linalg.qr(A)
    if np.abs(np.diag(R)).min() < 1e-9 * np.abs(np.diag(R)).max():
        words = "places: forces or sensors are on one line, or a quiet or damped mode is not seen"
        raise PlantError(f"{words} where they are; move one, or drop the mode")
    sign = np.where(np.diag(R) < 0.0, -1.0, 1.0)
    Q, R = Q * sign, sign[:, None] * R
    # with the positive diagonal of R that makes Q one: dQ = Q Ω + (I - Q Qᵀ) dA R⁻¹
    step = dA @ np.linalg.inv(R)
    turn = Q.T @ step
    lower = np.tril(turn, -1)
    dQ = Q @ (lower - lower.transpose(0, 2, 1)) + step - Q @ turn
    Q, dQ = Q[:, quiet:], dQ[..., quiet:]
    return W @ Q, dW @ Q + W @ dQ


def at_reference(W: Array, dW: Array, nodes: Array, reference: Array) -> tuple[Array, Array]:
    """Weights of nodes (N, m) combined to those of three or four points (p, 2), and the slopes.

    V has as many columns as there are points. Raises PlantError where W does not tell them apart.
    """
    here, there = (
        np.column_stack([np.ones(len(points)), points, points.prod(axis=1)])[:, : len(reference)]
        for points in (nodes, reference)
    )
    V, dV = W.T @ here, dW.transpose(0, 2, 1) @ here
    if np.linalg.cond(V / np.abs(here).max(axis=0)) > 1e6:
        raise PlantError("places: forces or sensors are on one line; move one, or drop reference")
    inverse, beyond = np.linalg.pinv(V), np.linalg.inv(V.T @ V) @ dV.transpose(0, 2, 1)
    slope = beyond - beyond @ V @ inverse - inverse @ dV @ inverse
    N, dN = there @ inverse, there @ slope
    return W @ N.T, dW @ N.T + W @ dN.transpose(0, 2, 1)


def followed_modes(
    M: Array, K: Array, dM: Array, dK: Array, numbers: Sequence[int]
) -> tuple[Array, Array]:
    """Shapes of flexible modes, from 1 by frequency, as columns, and their slopes.

    φ' = Σ_j φ_j φ_jᵀ(K' - λ M')φ/(λ - λ_j) - φ φᵀM'φ/2,   j over all other modes
    """
    lam, modes, rigid = natural_modes(K, M)
    flexible = np.flatnonzero(~rigid)
    if max(numbers, default=0) > len(flexible):
        raise PlantError(f"places: mode {max(numbers)} is beyond the {len(flexible)} flexible ones")
    at = flexible[[number - 1 for number in numbers]]
    modes[:, at] *= np.where(modes[np.abs(modes[:, at]).argmax(axis=0), at] < 0.0, -1.0, 1.0)
    slopes = np.zeros((len(dM), len(M), len(at)))
    for k, i in enumerate(at):
        gap = lam[i] - lam
        gap[i] = np.inf
        moved = (dK - lam[i] * dM) @ modes[:, i]
        own = 0.5 * (dM @ modes[:, i]) @ modes[:, i]
        slopes[:, :, k] = (moved @ modes / gap) @ modes.T - own[:, None] * modes[:, i]
    return modes[:, at], slopes
