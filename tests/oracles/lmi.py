"""The bounded-real lemma as a linear matrix inequality, solved by Clarabel through cvxpy.

γ enters linearly, so a first solve minimises it. It ends where X is nearly singular, and the
controller, which divides by X, with poles far out or on the wrong side. A second one, at the
backed-off γ, keeps X as far from singular as it can. Two forms:

* Output feedback in the variables (X, Y, A_K, B_K, C_K, D_K) after the change of variables of
  Scherer, Gahinet & Chilali (1997), for any standard plant.
* Disturbance feedforward, where D21 is square and invertible and A - B1 D21⁻¹ C2 stable (Doyle,
  Glover, Khargonekar & Francis 1989): w is then known from y, the filter half of the problem has
  its infimum at Y = ∞, and u = F x + F_w w is all that is left to find. Mixed sensitivity is of
  this kind.

Cost grows with the sixth power of the order: some ten states. Needs cvxpy (the extra `bench`).
"""

import warnings
from dataclasses import replace
from typing import Any

import numpy as np

from ccd_casadi.extensions.cross_check.backends import Attempt, StandardPlant, balance
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import require

STRICT = 1e-7  # a definite matrix is at least this much so
LARGEST_EIGENVALUE = 1e8  # of X and Y, which nothing else may bound
LARGEST = 20  # states


def solve(plant: StandardPlant, *, gamma_backoff: float = 1.02) -> Attempt:
    """Minimal γ of the LMI, then a controller at gamma_backoff times it.

    Raises MissingPackage without cvxpy.
    """
    cvxpy = require("cvxpy", "bench")
    n = len(plant.A)
    if n > LARGEST:
        reason = f"the LMI of {n} states is too large; at most {LARGEST}"
        return Attempt(np.nan, np.nan, None, reason)
    P = balance(without_d22(plant))
    make = _feedforward if _knows_disturbance(P) else _output_feedback
    gamma_opt, K = make(cvxpy, P)
    if K is None:
        return Attempt(np.nan, np.nan, None, "the LMI is infeasible, or the solver gave up")
    gamma = gamma_backoff * gamma_opt
    relaxed = make(cvxpy, P, gamma)[1]
    return Attempt(gamma_opt, gamma, with_d22(relaxed or K, plant.D22))


def without_d22(plant: StandardPlant) -> StandardPlant:
    """The plant with D22 = 0; `with_d22` turns its controller into one of the plant itself."""
    return replace(plant, D22=np.zeros_like(plant.D22))


def with_d22(K: StateSpace, D22: Array) -> StateSpace:
    """K (I + D22 K)⁻¹: what `K` has to be where y carries D22 u as well."""
    E = np.linalg.inv(np.eye(D22.shape[0]) + D22 @ K.D)
    DE = K.D @ E
    return StateSpace(K.A - K.B @ E @ D22 @ K.C, K.B @ E, K.C - DE @ D22 @ K.C, DE)


def _knows_disturbance(P: StandardPlant) -> bool:
    p, w = P.D21.shape
    if p != w or np.linalg.matrix_rank(P.D21) < p:
        return False
    left = np.linalg.eigvals(P.A - P.B1 @ np.linalg.solve(P.D21, P.C2))
    return bool(left.real.max() < 0.0)


def _feedforward(
    cvxpy: Any, P: StandardPlant, gamma: float | None = None
) -> tuple[float, StateSpace | None]:
    """X > 0, [[AX + B2L + (·)ᵀ, B1 + B2F_w, (C1X + D12L)ᵀ], [·, -γI, (D11 + D12F_w)ᵀ], ...] < 0."""
    n, w, m, z = len(P.A), P.B1.shape[1], P.B2.shape[1], P.C1.shape[0]
    X = cvxpy.Variable((n, n), symmetric=True)
    L, Fw = cvxpy.Variable((m, n)), cvxpy.Variable((m, w))
    g: Any = cvxpy.Variable(nonneg=True) if gamma is None else gamma
    AX = P.A @ X + P.B2 @ L
    B, C, D = P.B1 + P.B2 @ Fw, P.C1 @ X + P.D12 @ L, P.D11 + P.D12 @ Fw
    M = cvxpy.bmat([
        [AX + AX.T, B, C.T],
        [B.T, -g * np.eye(w), D.T],
        [C, D, -g * np.eye(z)],
    ])  # fmt: skip
    if not _solved(cvxpy, g, gamma, X, M):
        return np.inf, None
    value = float(g.value) if gamma is None else gamma
    try:
        return value, _observer(P, X.value, L.value, Fw.value)
    except np.linalg.LinAlgError:
        return value, None


def _observer(P: StandardPlant, X: Array, L: Array, Fw: Array) -> StateSpace:
    """u = F x + F_w w, x and w from ẋ = A x + B1 w + B2 u, w = D21⁻¹(y - C2 x), F = L X⁻¹."""
    F = np.linalg.solve(X, L.T).T
    inverse = np.linalg.inv(P.D21)
    Ck, Dk = F - Fw @ inverse @ P.C2, Fw @ inverse
    Bw = P.B1 @ inverse
    return StateSpace(P.A - Bw @ P.C2 + P.B2 @ Ck, Bw + P.B2 @ Dk, Ck, Dk)


def _output_feedback(
    cvxpy: Any, P: StandardPlant, gamma: float | None = None
) -> tuple[float, StateSpace | None]:
    """[[X, I], [I, Y]] > 0 and the inequality of Scherer, Gahinet & Chilali, their (41)."""
    n, w, m = len(P.A), P.B1.shape[1], P.B2.shape[1]
    z, p = P.C1.shape[0], P.C2.shape[0]
    X, Y = (cvxpy.Variable((n, n), symmetric=True) for _ in range(2))
    Ah, Bh = cvxpy.Variable((n, n)), cvxpy.Variable((n, p))
    Ch, Dh = cvxpy.Variable((m, n)), cvxpy.Variable((m, p))
    g: Any = cvxpy.Variable(nonneg=True) if gamma is None else gamma
    AX, YA = P.A @ X + P.B2 @ Ch, Y @ P.A + Bh @ P.C2
    corner = Ah.T + P.A + P.B2 @ Dh @ P.C2
    B, YB = P.B1 + P.B2 @ Dh @ P.D21, Y @ P.B1 + Bh @ P.D21
    CX, C = P.C1 @ X + P.D12 @ Ch, P.C1 + P.D12 @ Dh @ P.C2
    D = P.D11 + P.D12 @ Dh @ P.D21
    M = cvxpy.bmat([
        [AX + AX.T, corner, B, CX.T],
        [corner.T, YA + YA.T, YB, C.T],
        [B.T, YB.T, -g * np.eye(w), D.T],
        [CX, C, D, -g * np.eye(z)],
    ])  # fmt: skip
    both = cvxpy.bmat([[X, np.eye(n)], [np.eye(n), Y]])
    if not _solved(cvxpy, g, gamma, both, M):
        return np.inf, None
    value = float(g.value) if gamma is None else gamma
    try:
        K = _recovered(P, X.value, Y.value, Ah.value, Bh.value, Ch.value, Dh.value)
    except np.linalg.LinAlgError:
        return value, None
    return value, K


def _recovered(
    P: StandardPlant, X: Array, Y: Array, Ah: Array, Bh: Array, Ch: Array, Dk: Array
) -> StateSpace:
    """The controller, from M Nᵀ = I - X Y by a singular value decomposition."""
    U, s, Vt = np.linalg.svd(np.eye(len(X)) - X @ Y)
    root = np.sqrt(s)
    M, N = U * root, Vt.T * root
    Ck = np.linalg.solve(M, (Ch - Dk @ P.C2 @ X).T).T
    Bk = np.linalg.solve(N, Bh - Y @ P.B2 @ Dk)
    inner = Ah - N @ Bk @ P.C2 @ X - Y @ P.B2 @ Ck @ M.T - Y @ (P.A + P.B2 @ Dk @ P.C2) @ X
    Ak = np.linalg.solve(N, np.linalg.solve(M, inner.T).T)
    return StateSpace(Ak, Bk, Ck, Dk)


def _solved(cvxpy: Any, g: Any, gamma: float | None, positive: Any, negative: Any) -> bool:
    """Minimise γ, or at a given γ maximise λ_min of `positive`; whether it was solved."""
    least = STRICT if gamma is None else cvxpy.Variable()
    objective = cvxpy.Minimize(g) if gamma is None else cvxpy.Maximize(least)
    one = np.eye(positive.shape[0])
    constraints = [positive >> least * one, negative << -STRICT * np.eye(negative.shape[0])]
    if gamma is not None:
        constraints.append(positive << LARGEST_EIGENVALUE * one)
    problem = cvxpy.Problem(objective, constraints)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # "may be inaccurate": the certificate judges that
            problem.solve(solver=cvxpy.CLARABEL)
    except cvxpy.SolverError:
        return False
    return problem.status in (cvxpy.OPTIMAL, cvxpy.OPTIMAL_INACCURATE)
