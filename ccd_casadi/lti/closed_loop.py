"""The loop of a plant and a controller: one closed-loop matrix, and every response out of it.

e = r - y,   u = K e,   y = G (u + d)
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ccd_casadi.lti.state_space import StateSpace, strictly_proper
from ccd_casadi.support.arrays import Array


@dataclass(frozen=True)
class ClosedLoop:
    """ẋ = A x + B_r r + B_d d (x⁺ with a `period` > 0 in s), y = C_y x, u = C_u x + D_u r.

    x = [x_G; x_K]; sensor noise n enters as -r does.
    """

    A: Array
    B_r: Array
    B_d: Array
    C_y: Array
    C_u: Array
    D_u: Array
    period: float = 0.0

    @cached_property
    def S(self) -> StateSpace:
        """r to e: (1 + GK)⁻¹."""
        return StateSpace(self.A, self.B_r, -self.C_y, np.eye(len(self.C_y)), period=self.period)

    @cached_property
    def T(self) -> StateSpace:
        """r to y: GK(1 + GK)⁻¹."""
        return strictly_proper(self.A, self.B_r, self.C_y, self.period)

    @cached_property
    def GS(self) -> StateSpace:
        """d to y: (1 + GK)⁻¹G."""
        return strictly_proper(self.A, self.B_d, self.C_y, self.period)

    @cached_property
    def KS(self) -> StateSpace:
        """r to u: K(1 + GK)⁻¹."""
        return StateSpace(self.A, self.B_r, self.C_u, self.D_u, period=self.period)


def closed_loop(G: StateSpace, K: StateSpace) -> ClosedLoop:
    """The loop of a plant without feedthrough (u to y) and a controller (e to u), of one time."""
    m, p, k = G.B.shape[1], len(G.C), len(K.A)
    return ClosedLoop(
        A=np.block([[G.A - G.B @ K.D @ G.C, G.B @ K.C], [-K.B @ G.C, K.A]]),
        B_r=np.vstack([G.B @ K.D, K.B]),
        B_d=np.vstack([G.B, np.zeros((k, m))]),
        C_y=np.hstack([G.C, np.zeros((p, k))]),
        C_u=np.hstack([-K.D @ G.C, K.C]),
        D_u=K.D,
        period=G.period,
    )


def sensitivity(L: np.ndarray) -> np.ndarray:
    """(1 + L)⁻¹ (k, p, p) of an open loop L = GK (k, p, p)."""
    return 1.0 / (1.0 + L) if L.shape[-1] == 1 else np.linalg.inv(np.eye(L.shape[-1]) + L)


def equivalent_open_loop(L: np.ndarray, i: int) -> np.ndarray:
    """1/S_ii - 1 (k,) of S = (1 + L)⁻¹: what channel i sees while the others are closed."""
    return np.asarray(L[:, 0, 0] if L.shape[1] == 1 else 1.0 / sensitivity(L)[:, i, i] - 1.0)


def sigma_max(response: np.ndarray) -> Array:
    """σ_max (...) of matrices (..., p, m): the root of the largest eigenvalue of MMᴴ.

    Squaring leaves it as exact as singular values are, in two thirds of their time.
    """
    if response.shape[-2:] == (1, 1):
        return np.abs(response[..., 0, 0])
    squared = response @ response.conj().swapaxes(-1, -2)
    return np.asarray(np.sqrt(np.linalg.eigvalsh(squared)[..., -1]))


def responses_of(G: np.ndarray, K: np.ndarray) -> dict[str, np.ndarray]:
    """S, KS, T and GS (k, ·, ·) by name, of G (k, p, m) and K (k, m, p)."""
    S = sensitivity(G @ K)
    return {"S": S, "KS": K @ S, "T": G @ K @ S, "GS": S @ G}
