"""Levels γ of a general plant: the least that has a controller, and what a closed loop reaches.

See `general_hinf` for the equations of the controller and their source.
"""

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from scipy.linalg import LinAlgError, block_diag, matrix_balance, schur, svd

from ccd_casadi.lti.state_space import StateSpace, sigma_max
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import UserError


@dataclass(frozen=True)
class HinfCertificate:
    """The certificate of a closed loop by its own matrices.

    Attributes
    ----------
    gamma : float
        Its largest gain is below.
    norm : float
        Its H∞ norm, by its own matrices.
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
    """F_l(P, K), the closed loop from w to z; y and u are the last of P."""
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


def largest_apart(
    P: StateSpace, K: StateSpace, CL: StateSpace, points: int = 400
) -> tuple[float, float]:
    """The largest gain of a loop by the responses of P and K apart, as whoever connects them sees.

    Parameters
    ----------
    P, K, CL : StateSpace
    points : int
        Of the grid: at poles' frequencies, between and beyond.

    Returns
    -------
    gain, rounding : float
        The largest gain, and how far that of the closed loop's matrices differs at most.
    """
    sizes = np.abs(np.linalg.eigvals(CL.A)) if len(CL.A) else np.ones(1)
    sizes = sizes[sizes > 0.0]
    grid = np.geomspace(1e-3 * sizes.min(), 1e3 * sizes.max(), points)
    omega = np.sort(np.concatenate([grid, sizes]))
    p2 = K.D.shape[1]
    p1, m1 = np.subtract(P.D.shape, K.D.T.shape)
    G, C = P.sweep(omega), K.sweep(omega)
    back = np.linalg.solve(np.eye(p2) - G[:, p1:, m1:] @ C, G[:, p1:, :m1])
    apart = sigma_max(G[:, :p1, :m1] + G[:, :p1, m1:] @ C @ back)
    return float(apart.max()), float(np.abs(apart - sigma_max(CL.sweep(omega))).max())


def spectral_norm(M: Array) -> float:
    """σ_max; 0 of an empty matrix."""
    return float(np.linalg.norm(M, 2)) if M.size else 0.0


@dataclass(frozen=True)
class HinfOptions:
    """Numbers of the synthesis.

    Attributes
    ----------
    accuracy : float
        Relative, of γ at the end of the bisection.
    above : float
        Relative: the controller is that of a level so far above the least one. At the least one it
        has a pole at infinity, and close to it one that double precision does not resolve.
    axis : float
        Share of the size of a matrix within which an eigenvalue counts as on the axis.
    hamiltonian_axis : float
        The same of a Hamiltonian matrix, whose eigenvalues come closer to it near the least γ.
    uncontrolled : float
        Distance of [A - λ, B] from one of lower rank, over its size, below which λ is lost.
    rank : float
        Share of the largest singular value below which one is 0.
    negative : float
        Share of the largest eigenvalue of X or Y below minus which one is negative.
    up, down : float
        Factors by which the first levels go up, and down, until γ lies between two.
    largest : float
        γ over the first that is tried, above which there is no controller.
    smallest : float
        The same, below which no level is tried: w is kept from z as well as is liked.
    tries, wider : int, float
        Levels above the least, each `wider` times as far, until the closed loop is certified.
    room : float
        Relative: the gain that is certified is so far above the largest that was seen.
    guard : float
        And by so many times of how far two ways to compute gains differ.
    lost : float
        Relative, what rounding may add to the level of the controller.
    """

    accuracy: float = 1e-9
    above: float = 1e-4
    axis: float = 1e-10
    hamiltonian_axis: float = 1e-13
    uncontrolled: float = 1e-8
    rank: float = 1e-10
    negative: float = 1e-8
    up: float = 4.0
    down: float = 1e-3
    largest: float = 1e12
    smallest: float = 1e-6
    tries: int = 7
    wider: float = 6.0
    room: float = 1e-6
    guard: float = 10.0
    lost: float = 1e-3


class HinfFailure(StrEnum):
    """The reason why there is no controller, or none that is certified."""

    NOT_STABILISABLE = "not stabilisable"
    NOT_DETECTABLE = "not detectable"
    CONTROL_FREE = "a control is free"
    MEASUREMENT_EXACT = "a measurement is free of w"
    ZERO_OF_P12 = "P12 has a zero on the axis"
    ZERO_OF_P21 = "P21 has a zero on the axis"
    NO_LEVEL = "no level has a controller"
    NOT_CERTIFIED = "no closed loop is certified"


class NoHinfController(UserError):
    """No certified controller, with its `reason`; the message has the remedy."""

    def __init__(self, reason: HinfFailure, words: str) -> None:
        super().__init__(f"{reason}: {words}")
        self.reason = reason


@dataclass(frozen=True)
class GeneralPlant:
    """A plant with D12 = [0; I], D21 = [0 I], D22 = 0; `unit_u`, `unit_y` take its u and y back:
    u = unit_u⁻¹ ũ, y = unit_y ỹ."""

    A: Array
    B1: Array
    B2: Array
    C1: Array
    C2: Array
    D11: Array
    unit_u: Array
    unit_y: Array

    @property
    def least(self) -> float:
        """The bound that no level is below, max(σ_max[D1111 D1112], σ_max[D1111; D1121])."""
        m2, p2 = len(self.unit_u), len(self.unit_y)
        p1, m1 = self.D11.shape
        return max(spectral_norm(self.D11[: p1 - m2]), spectral_norm(self.D11[:, : m1 - p2]))


def least_level(gp: GeneralPlant, options: HinfOptions = HinfOptions()) -> tuple[float, float, str]:
    """The least γ that has a controller, by bisection of ln γ.

    Parameters
    ----------
    gp : GeneralPlant
    options : HinfOptions

    Returns
    -------
    gamma, below : float
        A level that has one, and one that has none; relative to each other within `accuracy`.
    why : str
        Which condition does not hold at the latter.
    """
    low = gp.least
    why, high = "the direct terms of w to z", max(2.0 * low, 1.0)
    first = high
    while isinstance(found := riccati_pair(gp, high, options), str):
        low, why, high = max(low, high), found, options.up * high
        if high > options.largest * first:
            raise NoHinfController(
                HinfFailure.NO_LEVEL, f"up to γ = {high:.3g}: {why}; scale the plant"
            )
    low, least = low or options.down * high, options.smallest * high
    while not isinstance(found := riccati_pair(gp, low, options), str) and low > least:
        high, low = low, options.down * low
    if not isinstance(found, str):
        return high, 0.0, "nothing: the gain may be made as small as is liked"
    why = found
    while high > low * (1.0 + options.accuracy):
        middle = float(np.sqrt(low * high))
        if middle in (low, high):
            break
        found = riccati_pair(gp, middle, options)
        if isinstance(found, str):
            low, why = middle, found
        else:
            high = middle
    return high, low, why


def riccati_pair(
    gp: GeneralPlant, gamma: float, options: HinfOptions = HinfOptions()
) -> tuple[Array, Array] | str:
    """X and Y (n, n) at a level, or in words which condition does not hold."""
    if gamma <= gp.least:
        return "the direct terms of w to z"
    B, C = np.hstack([gp.B1, gp.B2]), np.vstack([gp.C1, gp.C2])
    D12, D21 = _direct(gp)
    X = _stabilising(gp.A, B, gp.C1, np.hstack([gp.D11, D12]), gamma, gp.B1.shape[1], options)
    if isinstance(X, str):
        return f"the control equation: {X}"
    Y = _stabilising(gp.A.T, C.T, gp.B1.T, np.vstack([gp.D11, D21]).T, gamma, len(gp.C1), options)
    if isinstance(Y, str):
        return f"the filter equation: {Y}"
    if len(X) and np.abs(np.linalg.eigvals(X @ Y)).max() >= gamma**2:
        return "the coupling, the spectral radius of XY"
    return X, Y


def _stabilising(
    A: Array, B: Array, C1: Array, D: Array, gamma: float, first: int, options: HinfOptions
) -> Array | str:
    """The stabilising solution of one of the two equations; `first` inputs count -γ²."""
    n, m = len(A), B.shape[1]
    R = D.T @ D - block_diag(gamma**2 * np.eye(first), np.zeros((m - first, m - first)))
    try:
        inner = np.linalg.solve(R, np.hstack([D.T @ C1, B.T]))
    except np.linalg.LinAlgError:
        return "singular direct terms"
    H = np.block([[A, np.zeros((n, n))], [-C1.T @ C1, -A.T]])
    H = H - np.vstack([B, -C1.T @ D]) @ inner
    if not n:
        return np.zeros((0, 0))
    if not np.abs(H).max() < 1e100:  # nan too
        return "overflow"
    H, scaling = matrix_balance(H, permute=False, separate=True)
    try:
        T, Z, stable = schur(H, output="real", sort="lhp")
    except LinAlgError:
        return "an eigenvalue on the axis"
    poles = np.linalg.eigvals(T)
    if stable != n or np.abs(poles.real).min() <= options.hamiltonian_axis * np.abs(poles).max():
        return "an eigenvalue on the axis"
    basis = scaling[0][:, None] * Z[:, :n]
    U, s, Vt = svd(basis[:n])
    if s[-1] == 0.0:  # close to it X is large, and beyond it negative
        return "no solution"
    X = basis[n:] @ (Vt.T / s) @ U.T
    X = 0.5 * (X + X.T)
    values = np.linalg.eigvalsh(X)
    natural = spectral_norm(C1) ** 2 / max(spectral_norm(A), 1e-300)  # what it is of one pole
    if values[0] < -options.negative * max(values[-1], natural):
        return "a solution that is not positive"
    return np.asarray(X)


def _direct(gp: GeneralPlant) -> tuple[Array, Array]:
    """[0; I] and [0 I]."""
    m2, p2 = len(gp.unit_u), len(gp.unit_y)
    p1, m1 = gp.D11.shape
    return np.eye(p1)[:, p1 - m2 :], np.eye(m1)[m1 - p2 :]


def central_controller(
    gp: GeneralPlant, gamma: float, options: HinfOptions = HinfOptions()
) -> StateSpace | str:
    """The central controller at a level for y = ỹ without D22, or why there is none.

    With F = -R⁻¹[D1•ᵀC1 + BᵀX], L = -[B1D•1ᵀ + YCᵀ]R̃⁻¹ and Z = (1 - YX/γ²)⁻¹

        D̂11 = -D1121D1111ᵀ(γ² - D1111D1111ᵀ)⁻¹D1112 - D1122
        D̂12D̂12ᵀ = 1 - D1121(γ² - D1111ᵀD1111)⁻¹D1121ᵀ
        D̂21ᵀD̂21 = 1 - D1112ᵀ(γ² - D1111D1111ᵀ)⁻¹D1112
        B̂2 = Z(B2 + L12)D̂12,   Ĉ2 = -D̂21(C2 + F12),   B̂1 = -Z L2 + B̂2D̂12⁻¹D̂11
        Ĉ1 = F2 + D̂11D̂21⁻¹Ĉ2,   Â = A + BF + B̂1D̂21⁻¹Ĉ2
        K = Ĉ1(s - Â)⁻¹B̂1 + D̂11

    Parameters
    ----------
    gp : GeneralPlant
    gamma : float
    options : HinfOptions

    Returns
    -------
    StateSpace
        From y to u in their own units; or a str.
    """
    pair = riccati_pair(gp, gamma, options)
    if isinstance(pair, str):
        return pair
    X, Y = pair
    m2, p2 = len(gp.unit_u), len(gp.unit_y)
    p1, m1 = gp.D11.shape
    (D12, D21), B, C = _direct(gp), np.hstack([gp.B1, gp.B2]), np.vstack([gp.C1, gp.C2])
    wide, tall = np.hstack([gp.D11, D12]), np.vstack([gp.D11, D21])
    R = wide.T @ wide - block_diag(gamma**2 * np.eye(m1), np.zeros((m2, m2)))
    R_y = tall @ tall.T - block_diag(gamma**2 * np.eye(p1), np.zeros((p2, p2)))
    F = -np.linalg.solve(R, wide.T @ gp.C1 + B.T @ X)
    L = -np.linalg.solve(R_y, tall @ gp.B1.T + C @ Y).T
    F12, F2 = F[m1 - p2 : m1], F[m1:]
    L12, L2 = L[:, p1 - m2 : p1], L[:, p1:]
    a, b = gp.D11[: p1 - m2, : m1 - p2], gp.D11[: p1 - m2, m1 - p2 :]
    c, d = gp.D11[p1 - m2 :, : m1 - p2], gp.D11[p1 - m2 :, m1 - p2 :]
    rows = np.linalg.solve(gamma**2 * np.eye(len(a)) - a @ a.T, b)
    columns = np.linalg.solve(gamma**2 * np.eye(a.shape[1]) - a.T @ a, c.T)
    K11 = -c @ a.T @ rows - d
    K12 = np.linalg.cholesky(np.eye(m2) - c @ columns)
    K21 = np.linalg.cholesky(np.eye(p2) - b.T @ rows).T
    Z = np.linalg.inv(np.eye(len(X)) - Y @ X / gamma**2)
    B_2, C_2 = Z @ (gp.B2 + L12) @ K12, -K21 @ (gp.C2 + F12)
    B_1 = -Z @ L2 + B_2 @ np.linalg.solve(K12, K11)
    inverse_C2 = np.linalg.solve(K21, C_2)
    C_1 = F2 + K11 @ inverse_C2
    A = gp.A + B @ F + B_1 @ inverse_C2
    to_u, to_y = np.linalg.inv(gp.unit_u), np.linalg.inv(gp.unit_y)
    return StateSpace(A, B_1 @ to_y, to_u @ C_1, to_u @ K11 @ to_y)
