"""Inverses of matrices of which one term of rank one is only known to lie in a disc.

    (M + g c rᵀ)⁻¹ = X - γ u vᵀ,   X = M⁻¹, u = X c, v = Xᵀ r, γ = g/(1 + g β), β = rᵀu

g in a disc that does not hold -1/β leaves γ in a disc too. (Sherman and Morrison's formula.)
"""

from dataclasses import dataclass, replace

import numpy as np

from ccd_casadi.lti.closed_loop import sigma_max
from ccd_casadi.support.arrays import Array

# of a polygon around a disc, and a little for the rounding of the disc itself
CORNERS = (1.0 + 1e-9) * np.exp(2j * np.pi * np.arange(8) / 8) / np.cos(np.pi / 8)
GUARD = 64.0 * 2.2e-16  # of ‖M‖‖X‖: several times what inverse and norms of a few rows lose
HUGE = 1e150  # of what has no inverse

Range = tuple[Array, Array]  # not below a norm anywhere on a box, and not above it


@dataclass(frozen=True)
class Turned:
    """A + γB (N, p, q) of N boxes, B of rank one, |γ - gamma| <= radius (N,), `lost` to rounding;
    `good` (N,) where there is such a disc."""

    A: np.ndarray
    B: np.ndarray
    gamma: np.ndarray
    radius: Array
    lost: Array
    good: np.ndarray

    def between(self, left: np.ndarray, right: np.ndarray) -> "Turned":
        """With a matrix (N, k, p) in front of it and one (N, q, l) behind it."""
        lost = self.lost * norm(left, loosely=True) * norm(right, loosely=True)
        return replace(self, A=left @ self.A @ right, B=left @ self.B @ right, lost=lost)

    def from_one(self, y: np.ndarray) -> "Turned":
        """1 - y (A + γB), y (N,)."""
        A, B = (y[:, None, None] * part for part in (self.A, self.B))
        return replace(self, A=np.eye(A.shape[1]) - A, B=-B, lost=np.abs(y) * self.lost + GUARD)

    @property
    def middle(self) -> np.ndarray:
        """With γ in the middle of its disc."""
        return np.asarray(self.A + self.gamma[:, None, None] * self.B)

    @property
    def reach(self) -> Array:
        """How far from its middle it goes."""
        return np.asarray(self.radius * norm(self.B, loosely=True))

    def norms(self) -> Range:
        """σ_max, which is convex in γ: its largest value is at a corner of a polygon."""
        size = norm(self.middle)
        most = size + self.reach
        if min(self.A.shape[1:]) > 1:
            places = (self.gamma + CORNERS[:, None] * self.radius)[..., None, None]
            most = np.maximum(size, norm(self.A + places * self.B).max(axis=0))
        return most + self.lost, size - self.reach - self.lost


def inverses(
    M: np.ndarray, terms: Array, column: np.ndarray, row: np.ndarray, g: np.ndarray, radius: Array
) -> Turned:
    """Of M (N, p, p), the sizes `terms` (N,) of what it sums, c, r (N, p), g (N,), its radius."""
    none = np.linalg.det(M) == 0.0
    X = np.linalg.inv(np.where(none[:, None, None], np.eye(M.shape[1]), M))
    X = np.where(none[:, None, None], HUGE, X)
    u, v = np.einsum("Npq,Nq->Np", X, column), np.einsum("Np,Npq->Nq", row, X)
    beta = np.einsum("Np,Np->N", row, u)
    a = 1.0 + beta * g
    q = np.abs(a) ** 2 - (np.abs(beta) * radius) ** 2
    good = (q > 0.0) & (norm(X, loosely=True) < HUGE)
    q = np.where(good, q, 1.0)
    gamma = np.where(good, (g * a.conj() - beta.conj() * radius**2) / q, 0.0)
    radius = np.where(good, radius / q, 0.0)
    X = np.where(good[:, None, None], X, np.eye(M.shape[1]))
    B = np.where(good[:, None, None], -u[:, :, None] * v[:, None, :], 0.0)
    size = norm(X, loosely=True)
    lost = (np.abs(gamma) + radius) * norm(B, loosely=True)
    lost = GUARD * (1.0 + terms * size) * (size + lost)
    return Turned(X, B, gamma, radius, lost, good)


def norm_with(A: np.ndarray, p: np.ndarray, q: np.ndarray, radius: Array) -> Array:
    """σ_max of A + Σ δ_i p_i q_iᵀ at most for all |δ_i| <= radius_i (n, N).

        |xᴴAy| + Σ r_i |xᴴp_i||q_iᵀy| <= λ_max [[P, A], [Aᴴ, Q]],   |x| = |y| = 1,
        P = Σ r_i a_i p_i p_iᴴ,   Q = Σ r_i/a_i q_i* q_iᵀ   for any a_i > 0

    A (N, k, l), p (n, N, k), q (n, N, l). Terms that A keeps apart count apart.
    """
    P, Q = _grams(p, q, radius)
    if A.shape[1:] == (1, 1):
        x, y, apart = P[:, 0, 0].real, Q[:, 0, 0].real, np.abs(A[:, 0, 0])
        return np.asarray((1.0 + GUARD) * (0.5 * (x + y) + np.hypot(0.5 * (x - y), apart)))
    values = np.linalg.eigvalsh(np.block([[P, A], [A.conj().transpose(0, 2, 1), Q]]))
    return np.asarray(values[:, -1] + GUARD * np.abs(values).max(axis=1))


def norm_of_any(p: np.ndarray, q: np.ndarray, radius: Array) -> Array:
    """The norm of Σ δ_i p_i q_iᵀ at most for all |δ_i| <= radius_i."""
    P, Q = _grams(p, q, radius)
    return np.asarray(np.sqrt(norm(P) * norm(Q)))


def _grams(p: np.ndarray, q: np.ndarray, radius: Array) -> tuple[np.ndarray, np.ndarray]:
    """P and Q of `norm_with`, a_i by the lengths of both."""
    share = (np.linalg.norm(q, axis=2) + 1e-30) / (np.linalg.norm(p, axis=2) + 1e-30)
    return (np.einsum("iN,iNa,iNb->Nab", radius * share, p, p.conj()),
            np.einsum("iN,iNa,iNb->Nab", radius / share, q.conj(), q))  # fmt: skip


def norm(M: np.ndarray, loosely: bool = False) -> Array:
    """σ_max of matrices (..., p, q); `loosely` the root of the sum of squares, which it is where
    the rank is one and else not above."""
    if loosely or 1 in M.shape[-2:]:
        if M.shape[-2:] == (1, 1):
            return np.asarray(np.abs(M[..., 0, 0]))
        return np.asarray(np.sqrt((np.abs(M) ** 2).sum(axis=(-2, -1))))
    return sigma_max(M)
