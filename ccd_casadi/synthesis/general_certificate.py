"""What is known of a closed loop by its own matrices: its poles, and that its gain is below γ.

References
----------
S. Boyd, V. Balakrishnan and P. Kabamba, A bisection method for computing the H∞ norm of a transfer
matrix, Math. Control Signals Systems 2, 1989.
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import matrix_balance

from ccd_casadi.lti.state_space import StateSpace, sigma_max
from ccd_casadi.support.arrays import Array


@dataclass(frozen=True)
class HinfCertificate:
    """What is known of a closed loop by its own matrices.

    Attributes
    ----------
    gamma : float
        Its largest gain is below.
    norm : float
        A gain that it reaches, the largest on a grid.
    gamma_opt : float
        The least level that has a controller, to `HinfOptions.accuracy`.
    max_real_pole : float
        Largest real part of its poles, 1/s.
    lower_bound : float
        The largest level that was tried and has no controller, by the conditions of the Riccati
        equations.
    limited_by : str
        Which of them did not hold there.
    """

    gamma: float
    norm: float
    gamma_opt: float
    max_real_pole: float
    lower_bound: float
    limited_by: str


def lower_transformation(P: StateSpace, K: StateSpace, nmeas: int, ncon: int) -> StateSpace:
    """F_l(P, K), the closed loop from w to z.

    Parameters
    ----------
    P, K : StateSpace
    nmeas, ncon : int
        Numbers of y and u, the last of P.

    Returns
    -------
    StateSpace
    """
    p1, m1 = P.D.shape[0] - nmeas, P.D.shape[1] - ncon
    B1, B2, C1, C2 = P.B[:, :m1], P.B[:, m1:], P.C[:p1], P.C[p1:]
    D11, D12, D21, D22 = P.D[:p1, :m1], P.D[:p1, m1:], P.D[p1:, :m1], P.D[p1:, m1:]
    left = np.linalg.inv(np.eye(ncon) - K.D @ D22)  # u = left (C_k x_k + D_k (C2 x + D21 w))
    u_x, u_k, u_w = left @ K.D @ C2, left @ K.C, left @ K.D @ D21
    y_x, y_k, y_w = C2 + D22 @ u_x, D22 @ u_k, D21 + D22 @ u_w
    return StateSpace(
        np.block([[P.A + B2 @ u_x, B2 @ u_k], [K.B @ y_x, K.A + K.B @ y_k]]),
        np.vstack([B1 + B2 @ u_w, K.B @ y_w]),
        np.hstack([C1 + D12 @ u_x, D12 @ u_k]),
        D11 + D12 @ u_w,
    )


def is_below(system: StateSpace, gamma: float, *, axis: float = 1e-11) -> bool:
    """Whether the largest gain of a stable system is below γ.

    σ_max(D) < γ, and the Hamiltonian matrix of Boyd, Balakrishnan and Kabamba has no eigenvalue on
    the axis: a gain of γ would be reached there. Eigenvalues that rounding may have taken off the
    axis are where the gain itself is compared with γ.

    Parameters
    ----------
    system : StateSpace
        Stable.
    gamma : float
    axis : float
        Real part over size within which the gain is compared.

    Returns
    -------
    bool
    """
    A, B, C, D = system.A, system.B, system.C, system.D
    if spectral_norm(D) >= gamma:
        return False
    if not len(A):
        return True
    R = gamma**2 * np.eye(D.shape[1]) - D.T @ D
    inner = np.linalg.solve(R, np.hstack([D.T @ C, B.T]))
    n = len(A)
    middle = C.T @ (np.eye(len(C)) + D @ np.linalg.solve(R, D.T)) @ C
    H = np.block([[A + B @ inner[:, :n], B @ inner[:, n:]], [-middle, -(A + B @ inner[:, :n]).T]])
    poles = np.linalg.eigvals(matrix_balance(H, permute=False)[0])
    near = poles[np.abs(poles.real) <= max(axis**0.5, 1e-6) * np.abs(poles)]
    omega = np.unique(np.abs(near.imag))
    omega = np.concatenate([np.zeros(1), omega])  # beyond the last one the gain is that of D
    between = np.concatenate([omega, 0.5 * (omega[1:] + omega[:-1])])
    return bool(not len(between) or sigma_max(system.swept(between)).max() < gamma)


def largest_on_grid(
    P: StateSpace, K: StateSpace, CL: StateSpace, points: int = 400
) -> tuple[float, float]:
    """A gain that a loop reaches: at poles' frequencies, between and beyond, and at both ends.

    Parameters
    ----------
    P, K, CL : StateSpace
        The gain is that of the closed loop's matrices, and of P and K apart, as whoever connects
        them has it.
    points : int
        Of the grid.

    Returns
    -------
    norm, rounding : float
        The largest gain, and how far the two differ at most.
    """
    sizes = np.abs(np.linalg.eigvals(CL.A)) if len(CL.A) else np.ones(1)
    sizes = sizes[sizes > 0.0]
    grid = np.geomspace(1e-3 * sizes.min(), 1e3 * sizes.max(), points)
    omega = np.sort(np.concatenate([grid, sizes]))
    p2 = K.D.shape[1]
    p1, m1 = np.subtract(P.D.shape, K.D.T.shape)
    G, C = P.swept(omega), K.swept(omega)
    back = np.linalg.solve(np.eye(p2) - G[:, p1:, m1:] @ C, G[:, p1:, :m1])
    apart = sigma_max(G[:, :p1, :m1] + G[:, :p1, m1:] @ C @ back)
    whole = sigma_max(CL.swept(omega))
    ends = float(sigma_max(CL.swept(np.zeros(1)))[0]), spectral_norm(CL.D)
    norm = max(float(apart.max()), float(whole.max()), *ends)
    return norm, float(np.abs(apart - whole).max())


def spectral_norm(M: Array) -> float:
    """σ_max; 0 of an empty matrix."""
    return float(np.linalg.norm(M, 2)) if M.size else 0.0
