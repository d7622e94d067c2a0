"""σ_max of S, KS, T and GS of many loops at many frequencies, as the judge reads them.

With A = QTQᴴ, T upper triangular (Schur), C(s - A)⁻¹B is a back substitution, for all plants and
all s at once. Of the search's own rows and kernels nothing is used. The peaks of S that are found
so are confirmed by Hamiltonian matrices (`lti.norms`), which begin at them.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.linalg import schur

from ccd_casadi.fixed_structure.bounds import Bounds
from ccd_casadi.lti.closed_loop import sigma_max
from ccd_casadi.lti.hold import Sampling
from ccd_casadi.lti.norms import hinf_norm
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.support.arrays import Array

AT_ONCE = 8192  # numbers of an array that stays in a processor's cache
CONFIRMED = 1e-6  # relative: between the peak of S on the grid and by the Hamiltonian


class Triangular:
    """State spaces of one shape by their Schur forms; one alone stands for every plant's."""

    def __init__(self, systems: Sequence[StateSpace]) -> None:
        forms = [schur(x.A, output="complex") for x in systems]
        self.T = np.array([T for T, _ in forms])
        coupled = np.triu((self.T != 0.0).any(axis=0), 1)
        self.coupled = [np.flatnonzero(row) for row in coupled]  # few states of a modal plant are
        self.B = np.array([Q.conj().T @ x.B for (_, Q), x in zip(forms, systems, strict=True)])
        self.C = np.array([x.C @ Q for (_, Q), x in zip(forms, systems, strict=True)])
        self.D = np.array([x.D for x in systems])

    def at(self, which: np.ndarray, s: np.ndarray) -> np.ndarray:
        """C(s - A)⁻¹B + D (N, k, p, m) of the systems `which` (N,) at points s (N, k)."""
        own = which if len(self.T) > 1 else np.zeros_like(which)
        p, m = self.D.shape[1:]
        found = np.empty((*s.shape, p, m), complex)
        step = max(1, AT_ONCE // (s.shape[1] * m))
        for first in range(0, len(s), step):
            part = slice(first, first + step)
            found[part] = self._substituted(own[part], s[part])
        return found

    def _substituted(self, own: np.ndarray, s: np.ndarray) -> np.ndarray:
        T, B, C, (N, k) = self.T[own], self.B[own], self.C[own], s.shape
        n, m = B.shape[1:]
        X = np.empty((N, n, k * m), complex)  # (s - T)⁻¹B
        for i in reversed(range(n)):
            right, j = B[:, i, None, :], self.coupled[i]
            if len(j):
                right = right + (T[:, i, j][:, None] @ X[:, j]).reshape(N, k, m)
            X[:, i] = (right / (s - T[:, i, i, None])[..., None]).reshape(N, k * m)
        total = (C @ X).reshape(N, C.shape[1], k, m).transpose(0, 2, 1, 3)
        return np.asarray(self.D[own, None] + total)


class LoopTable:
    """The loops of a set of plants: `free` and `G` of the plants without and with hold and delay,
    K of the controller, which may have an `integrator`.
    """

    def __init__(
        self,
        free: Sequence[StateSpace],
        G: Sequence[StateSpace],
        K: StateSpace,
        sampling: Sampling | None,
        bounds: Bounds,
        integrator: bool = True,
    ) -> None:
        self.G, self.K = Triangular(G), Triangular([K])
        self.free = self.G if sampling is None else Triangular(free)
        self.period = None if sampling is None else sampling.period
        self.bounds, self.integrator = bounds, integrator

    def at(self, which: np.ndarray, omega: Array) -> dict[str, Array]:
        """Every curve (N, k) of the plants `which` (N,) at ω (N, k) in rad/s."""
        matrices = self._matrices(which, omega)
        found = {name: sigma_max(M) for name, M in matrices.items()}
        weights = self.bounds.weights
        if weights is not None:
            _, W_KS, W_T = np.abs(weights.responses(omega.ravel())).reshape(3, *omega.shape)
            found["weighted KS"], found["weighted T"] = W_KS * found["KS"], W_T * found["T"]
        for own in self.bounds.channels:
            if own.given:
                found[f"S of {own.name}"] = _length(own.output, matrices["S"])
            if own.M_K is not None and weights is not None:
                W = weights.M_K / own.M_K * W_KS
                found[f"weighted KS of {own.name}"] = W * _length(own.force, matrices["KS"])
        return found

    def sensitivity(
        self, which: np.ndarray, omega: Array, row: Sequence[float] | None = None
    ) -> Array:
        """σ_max(S), or ‖rᵀS‖ of a row r, as `at`."""
        S = self._loops(which, omega)[0]
        return sigma_max(S) if row is None else _length(row, S)

    def singular(self, which: np.ndarray, omega: Array) -> Array:
        """(4, N, k, p) all singular values of S, KS, T and GS, the largest first."""
        return np.stack([np.linalg.svd(M, compute_uv=False)
                         for M in self._matrices(which, omega).values()])  # fmt: skip

    def _matrices(self, which: np.ndarray, omega: Array) -> dict[str, np.ndarray]:
        S, g, k = self._loops(which, omega)
        free = g if self.period is None else self.free.at(which, 1j * omega)
        KS = _product(k, S)
        return {"S": S, "KS": KS, "T": _product(g, KS), "GS": _product(S, free)}

    def _loops(self, which: np.ndarray, omega: Array) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        s = 1j * omega if self.period is None else np.exp(1j * omega * self.period)
        g, k = self.G.at(which, s), self.K.at(which, s)
        open_ = np.eye(g.shape[-2]) + _product(g, k)
        return (1.0 / open_ if open_.shape[-1] == 1 else np.linalg.inv(open_)), g, k


def _product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Of matrices (..., p, q) and (..., q, m)."""
    return np.asarray(a * b if a.shape[-1] == 1 else a @ b)


def _length(row: Sequence[float], M: np.ndarray) -> Array:
    """‖rᵀM‖ of a row r and matrices (..., p, m)."""
    return np.asarray(np.linalg.norm(np.array(row) @ M, axis=-1))


def norms(
    loops: Sequence[StateSpace], period: float | None, peak: Array, at: Array
) -> tuple[Array, np.ndarray]:
    """‖S‖∞ (P,) of every plant's loop, and whether `peak` (P,) at ω (P,) is it.

    `loops` are S, or a row of it, of sampled loops in z.
    """
    run = (replace(loop, period=period or 0.0) for loop in loops)
    each = [hinf_norm(loop, omega)[0] for loop, omega in zip(run, at, strict=True)]
    found = np.maximum(peak, each)
    return found, np.abs(found / peak - 1.0) <= CONFIRMED
