"""Mixed sensitivity of a plant with poles in the open right half plane, as one without them.

With Y of A Y + Y Aᵀ - Y CᵀC Y = 0 and A_f = A - Y CᵀC stable, N = I + C(s - A)⁻¹Y Cᵀ is all-pass,

    ‖[W1 S; W2 KS; W3 T]‖ = ‖[W1 S N; W2 KS N; W3 N⁻¹ T N]‖,   N⁻¹ = I - C(s - A_f)⁻¹Y Cᵀ

for weights that are scalars times I. On the right r becomes r' with r = N r': -Y Cᵀ in B1. On the
left N⁻¹ T N r' = (N⁻¹G) u, and N⁻¹G = C(s - A_f)⁻¹B is stable. It is y' = C x + C V ξ with

    ξ̇ = VᵀA_fV ξ + VᵀY Cᵀ e,   V (n, k) an orthonormal basis of the range of Y,

the invariant subspace of the k unstable poles. All outputs are then stable functions of e and u, so
that the filter equation of this plant is void: it has one Riccati equation, as a stable one.
"""

from typing import NamedTuple

import numpy as np
from scipy.linalg import schur, solve_sylvester
from scipy.linalg.lapack import dtrsen

from ccd_casadi.kernels.generalized_plant import first_order_weights, generalized_plant
from ccd_casadi.kernels.linear_algebra import lyapunov_triangular


class UnstableModes(NamedTuple):
    """V (n, k), and the stabilising solution Y (n, n) of the Bernoulli equation, of rank k."""

    V: np.ndarray
    Y: np.ndarray


def unstable_part(A, C):
    """Find the unstable part of a plant: A V = V A_u, and P of A_uᵀP + P A_u = (C V)ᵀC V.

    Y = V P⁻¹ Vᵀ; P is singular where C does not see one of the modes.

    Parameters
    ----------
    A, C : arrays (n, n), (p, n)
        Scaled plant.

    Returns
    -------
    V, P : arrays (n, k), (k, k)
    """
    T, V = schur(A)
    grow = np.diag(T) > 0.0  # of a pair both: LAPACK's blocks have equal diagonals
    k = int(grow.sum())
    if not k:
        return V[:, :0], np.zeros((0, 0))
    # Not by `schur(sort=...)`: its call-back into Python writes on stderr where Ctrl-C meets it.
    T, V = dtrsen(grow, T, V, job=b"N")[:2]
    V = V[:, :k]
    return V, lyapunov_triangular(np.ascontiguousarray(T[:k, :k]), (C @ V).T @ (C @ V), True)


def unstable_modes(A, C):
    """Find the modes of a plant that grow.

    Parameters
    ----------
    A, C : arrays (n, n), (p, n)
        Scaled plant.

    Returns
    -------
    UnstableModes or None
        None where there are none.
    """
    V, P = unstable_part(A, C)
    return UnstableModes(V, V @ np.linalg.inv(P) @ V.T) if len(P) else None


def unstable_plant(A, B, C, w, modes):
    """Make the generalized plant of the equivalent problem.

    Parameters
    ----------
    A, B, C : arrays (n, n), (n, m), (p, n)
        Scaled plant.
    w : array (8,)
        Scaled weights.
    modes : UnstableModes

    Returns
    -------
    MixedPlant
        States [plant; ξ; W1; W2; W3], of order n + k + 2p + m.
    """
    V, Y = modes
    (n, k), p, m = V.shape, C.shape[0], B.shape[1]
    into, f = V.T @ Y @ C.T, first_order_weights(w)
    inner = V.T @ (A - Y @ C.T @ C) @ V
    gp = generalized_plant(
        np.block([[A, np.zeros((n, k))], [-into @ C, inner]]),
        np.vstack([B, np.zeros((k, m))]),
        np.hstack([C, np.zeros((p, k))]),
        w,
    )
    gp.B1[:n], gp.B1[n : n + k] = -Y @ C.T, into
    gp.A[n + k + p + m :, n : n + k] = f[2, 1] * C @ V
    gp.C1[p + m :, n : n + k] = f[2, 3] * C @ V
    return gp


def without_copies(Ak, Bk, Ck, modes):
    """The controller in n + 2p + m states: u does not show k of the poles, those of ξ.

    The central controller of the problem as it is stated has that order, and is the only one of
    least entropy, which all-pass factors do not change. In x - Z ξ, with A_K [Z; I] = [Z; I] A_ξ,
    the states ξ are not seen by u.
    """
    n, k = modes.V.shape
    copy = slice(n, n + k)
    rest = np.delete(np.arange(len(Ak)), copy)
    own = Ak[np.ix_(rest, rest)]
    Z = solve_sylvester(own, -Ak[copy, copy], -Ak[rest, copy])
    return own, Bk[rest] - Z @ Bk[copy], np.ascontiguousarray(Ck[:, rest])
