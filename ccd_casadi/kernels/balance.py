"""Coordinates in which the Hamiltonian's entries are of one size, and what rounding leaves there.

A diagonal change of states x = T x̂ is symplectic on (x, λ): H becomes diag(T⁻¹, T) H diag(T, T⁻¹)
and X becomes T X T, so γ_opt and the controller as a transfer function stay what they are. With
τ_i powers of two nothing is rounded (P. Benner, Symplectic balancing of Hamiltonian matrices,
SIAM J. Sci. Comput. 22, 2001; here the diagonal part only, by the sweeps of Osborne).

Plain NumPy: only a design that fails comes here.
"""

import numpy as np

from ccd_casadi.kernels.lapack import stable_subspace
from ccd_casadi.kernels.riccati import NOISE, projected


def balancing(H):
    """τ (N,), powers of two that make the sum of a 2N x 2N Hamiltonian's entries smallest.

    No other power of any one of them makes it smaller; each sweep lowers the sum.
    """
    N = H.shape[0] // 2
    M = np.abs(H)
    for i in range(2 * N):
        M[i, i] = 0.0
    τ = np.ones(N)
    for _ in range(40):  # it settles in three to six
        settled = True
        for i in range(N):
            k = N + i
            # τ_i divides row i and column k, once more where they meet, and multiplies the others
            d2, u2 = M[i, k], M[k, i]
            d1, u1 = M[i].sum() + M[:, k].sum() - 2.0 * d2, M[:, i].sum() + M[k].sum() - 2.0 * u2
            if d1 + d2 == 0.0 or u1 + u2 == 0.0:
                continue
            f = 1.0
            while 0.5 * d1 / f + 0.75 * d2 / f**2 > u1 * f + 3.0 * u2 * f**2:  # 2f is better
                f *= 2.0
            while d1 / f + 3.0 * d2 / f**2 < 0.5 * u1 * f + 0.75 * u2 * f**2:
                f *= 0.5
            if f != 1.0:
                settled = False
                τ[i] *= f
                M[i] /= f
                M[:, k] /= f
                M[:, i] *= f
                M[k] *= f
        if settled:
            break
    return τ


def in_coordinates(gp, τ):
    """The generalized plant with states x̂ = x/τ."""
    rows = τ.reshape(-1, 1)
    return gp._replace(
        A=gp.A * (τ / rows), B1=gp.B1 / rows, B2=gp.B2 / rows, C1=gp.C1 * τ, C2=gp.C2 * τ
    )


def rounding_noise(H0):
    """What rounding alone makes of a projection that is zero: X(γ = ∞) is positive semidefinite.

    Four times the most negative one there, at least `NOISE`.
    """
    _, U1, U2, _, ok = stable_subspace(H0)
    return max(NOISE, -4.0 * projected(U1, U2)[3].min()) if ok else NOISE
