"""The plant, the loop and its figures in sixty digits: the second instance of the fuzzing's judge.

From M, D, K, B, C and the suspension's rule as the documentation has them; nothing is scaled, and
nothing is shared with the kernels.
"""

from typing import Any

import mpmath as mp
import numpy as np

from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.plants.as_written import natural_modes
from ccd_casadi.plants.modal import Suspension
from ccd_casadi.plants.plant import Mechanics
from ccd_casadi.support.arrays import Array
from ccd_casadi.synthesis.weights import Weights

mp.mp.dps = 60


class ExactLoop:
    """σ_max(S) and of the weighted stack at one ω, rad/s."""

    def __init__(
        self, system: Mechanics, suspension: Suspension, K: StateSpace, weights: Weights
    ) -> None:
        self.weights = weights
        self.M, self.B, self.C = (_exact(X) for X in (system.M, system.B, system.C))
        self.K, self.D = _exact(system.K), _exact(system.D)
        self.controller = [_exact(X) for X in (K.A, K.B, K.C, K.D)]
        L = mp.cholesky(self.M)
        inverse = L**-1
        lam, Q = mp.eigsy(inverse * self.K * inverse.T)
        shapes = self.M * (inverse.T * Q)  # M Φ, so that M h(M⁻¹K) = (MΦ) h(Λ) (MΦ)ᵀ
        w_r = 2 * mp.pi * mp.mpf(suspension.frequency_hz)
        count = int(natural_modes(system.K, system.M)[2].sum())
        rigid = sorted(range(len(lam)), key=lambda i: lam[i])[:count]
        zeta = mp.mpf(system.damping_ratio or 0.0)
        for i in range(len(lam)):
            column = shapes[:, i]
            if i in rigid:
                self.K += (w_r**2 - lam[i]) * column * column.T
                self.D += 2 * mp.mpf(suspension.damping_ratio) * w_r * column * column.T
            else:
                self.D += 2 * zeta * mp.sqrt(lam[i]) * column * column.T

    def _responses(self, omega: float) -> tuple[Any, Any, Any]:
        s = mp.mpc(0, omega)
        G = self.C * mp.lu_solve(s**2 * self.M + s * self.D + self.K, self.B)
        A, B, C, D = self.controller
        K = C * mp.lu_solve(s * mp.eye(A.rows) - A, B) + D
        return G, K, (mp.eye(G.rows) + G * K) ** -1

    def sensitivity(self, omega: float) -> float:
        return _largest(self._responses(omega)[2])

    def stack(self, omega: float) -> float:
        G, K, S = self._responses(omega)
        W1, W2, W3 = (mp.mpc(complex(w[0])) for w in self.weights.responses(np.array([omega])))
        rows = [W1 * S, W2 * K * S, W3 * G * K * S]
        square = sum((X.H * X for X in rows[1:]), rows[0].H * rows[0])
        return float(mp.sqrt(max(mp.eighe(square, eigvals_only=True))))


def _exact(X: Array) -> Any:
    """A matrix of the doubles' own values; mpmath has no matrices without rows or columns."""
    return mp.matrix(np.asarray(X, float).tolist()) if np.size(X) else mp.matrix(*np.shape(X))


def _largest(X: Any) -> float:
    return float(mp.sqrt(max(mp.eighe(X.H * X, eigvals_only=True))))
