"""The largest norm of a matrix over terms of rank one that are only known to lie in discs.

    e = A f - B u,   u = Σ w_i c_i,   |w_i| <= r_i |q_iᵀ(Z f - u)|  or  <= r_i |b_iᵀ f|

|e| <= γ|f| for all of them where some τ_i > 0 give (S-procedure)

    |A f - B u|² + Σ τ_i (r_i² |q_iᵀ(Z f - u)|² - |w_i|²) <= γ² |f|²   for all f and w.

The least Σ τ_i |w_i|² of a u is uᴴP⁻¹u, so that matrices of the size of u remain:

    γ² = λ_max(AᴴA + ZᴴQZ + Q_b + Rᴴ(P⁻¹ - N)⁻¹R),   P⁻¹ > N = BᴴB + Q,   R = BᴴA + QZ,
    P = Σ c_i c_iᵀ/τ_i,   Q = Σ τ_i r_i² q_i* q_iᵀ,   Q_b = Σ τ_i r_i² b_i b_iᵀ.

Where u is a number all terms are one disc, and γ is known as it is.
"""

from dataclasses import dataclass

import numpy as np

from ccd_casadi.lti.closed_loop import sigma_max
from ccd_casadi.support.arrays import Array

GUARD = 64.0 * 2.2e-16  # several times what products, inverses and norms of a few rows lose
LEAST = 1e-3  # of the largest term: by how much a term counts at least where τ is chosen
NEAREST = 0.05  # to where P⁻¹ - N is singular: the first guess stays so far away


@dataclass(frozen=True)
class Terms:
    """n terms of N boxes: `radius` (N, n), `columns` c (n, p), `rows` q (N, n, p) and `inputs` b
    (n, m), one of which is 0; by default b is."""

    columns: Array
    rows: np.ndarray
    radius: Array
    inputs: Array | None = None

    def pushes(self, B: np.ndarray, Z: np.ndarray) -> Array:
        """How far each moves e per radius, to first order (N, n): |B c_i|(|q_iᵀZ| + |b_i|)."""
        return _lengths(B @ self.columns.T, 1) * self._seen(self.rows @ Z)

    def largest(self, A: np.ndarray, B: np.ndarray, Z: np.ndarray) -> Array:
        """γ (N,) of A (N, k, m), B (N, k, p), Z (N, p, m); infinite where none is found."""
        if B.shape[2] == 1:
            R = (_lengths(self.rows, 2) * np.abs(self.columns[:, 0]) * self.radius).sum(axis=1)
            good, BZ = R < 1.0, B @ Z
            R = np.where(good, R, 0.0)
            left, beside = 1.0 - R * R, self.pushes(B, 0.0 * Z) * self.radius
            value = norm(A + (R * R / left)[:, None, None] * BZ) + norm(BZ) * R / left
            value += beside.sum(axis=1) / (1.0 - R)
            return np.asarray(np.where(good, value * (1.0 + GUARD / (1.0 - R)), np.inf))
        sizes = [norm(part, loosely=True)[:, None] for part in (A, B, Z)]
        gain, seen = _lengths(B @ self.columns.T, 1), self._seen(self.rows @ Z)
        first, tau = self._level(A, B, Z, self._guess(gain, seen, sizes[0]))
        # where these lengths lead to no τ, those of c and q do if any do
        gain = sizes[1] * _lengths(self.columns, 1)
        plain = self._guess(gain, self._seen(sizes[2][..., None] * self.rows), sizes[0])
        tau = np.where(np.isinf(first)[:, None], plain, tau)
        return np.fmin(first, self._level(A, B, Z, tau)[0])

    def _seen(self, rows: np.ndarray) -> Array:
        """The lengths of what each sees of f (N, n)."""
        return _lengths(rows, 2) + (0.0 if self.inputs is None else _lengths(self.inputs, 1))

    def _guess(self, gain: Array, seen: Array, size: Array) -> Array:
        """τ (N, n) where each term moves e, of `size`, by its radius times `gain` and `seen`."""
        total = size + (gain * seen * self.radius).sum(axis=1, keepdims=True)
        tau = _share(total * gain, self.radius * seen)
        P, Q, _ = self._sums(tau)
        near = np.sqrt(np.abs(np.einsum("Nab,Nba->N", P, Q)))[:, None]
        return tau * np.where(near < np.inf, 1.0 / np.maximum(1.0 - near, NEAREST), 1.0)

    def _sums(self, tau: Array) -> tuple[Array, np.ndarray, Array | float]:
        """P, Q and Q_b (N, ·, ·)."""
        weight = tau * self.radius**2
        Q_b = 0.0 if self.inputs is None else _products(weight, self.inputs)
        return (
            _products(1.0 / tau, self.columns),
            _adjoint(self.rows) @ (weight[..., None] * self.rows),
            Q_b,
        )

    def _level(
        self, A: np.ndarray, B: np.ndarray, Z: np.ndarray, tau: Array
    ) -> tuple[Array, Array]:
        """γ (N,) with these τ, infinite where P⁻¹ is not above N; and better τ, those with which
        the worst f and w lie on the edges of all discs."""
        P, Q, Q_b = self._sums(tau)
        one, back = np.eye(P.shape[1]), _adjoint(B)
        P += (1e-13 * _trace(P) + 1e-250)[:, None, None] * one
        good = np.asarray(np.isfinite(P).all(axis=(1, 2)))
        L = np.linalg.cholesky(np.where(good[:, None, None], P, one))
        back_L = L.transpose(0, 2, 1)
        X, N = back_L @ (back @ A + Q @ Z), back @ B + Q
        left = one - back_L @ N @ L
        good &= np.isfinite(left).all(axis=(1, 2))
        values, V = np.linalg.eigh(np.where(good[:, None, None], left, one))
        lost = GUARD * (1.0 + _trace(P) * _trace(N))
        good &= values[:, 0] > 2.0 * lost
        values = np.where(good[:, None], values - lost[:, None], 1.0)
        Y = _adjoint(V) @ X
        square = _adjoint(A) @ A + _adjoint(Z) @ Q @ Z + Q_b + _adjoint(Y) @ (Y / values[..., None])
        good &= np.isfinite(square).all(axis=(1, 2))
        squares, F = np.linalg.eigh(np.where(good[:, None, None], square, np.eye(A.shape[2])))
        a, b, z, held = norm(A, True), norm(B, True), norm(Z, True), _trace(Q)
        lost = a * a + held * z * z + squares.sum(axis=1)
        lost += _trace(P) * (a * b + held * z) ** 2 / values[:, 0]
        value = np.where(good, np.sqrt(squares[:, -1] + 2.0 * GUARD * lost), np.inf)
        f = F[:, :, -1:]
        inner = V @ ((Y @ f) / values[..., None])  # u = -L times it
        w = np.abs(self.columns @ np.linalg.solve(back_L, inner))[..., 0] / tau
        seen = np.abs(self.rows @ (Z @ f + L @ inner))[..., 0]
        if self.inputs is not None:
            seen += np.abs(self.inputs @ f)[..., 0]
        return value, tau * _share(w, self.radius * seen)


def norm(M: np.ndarray, loosely: bool = False) -> Array:
    """σ_max of matrices (..., p, q); `loosely` the root of the sum of squares, which it is where
    the rank is one and else not above."""
    if loosely or 1 in M.shape[-2:]:
        if M.shape[-2:] == (1, 1):
            return np.asarray(np.abs(M[..., 0, 0]))
        return np.asarray(np.sqrt((np.abs(M) ** 2).sum(axis=(-2, -1))))
    return sigma_max(M)


def _share(above: Array, below: Array) -> Array:
    """The quotient, terms that are far smaller than others as if they were not."""
    parts = (part + LEAST * part.max(axis=1, keepdims=True) + 1e-300 for part in (above, below))
    above, below = parts
    found = above / below
    return np.where(np.isfinite(found), np.clip(found, 1e-100, 1e100), 1.0)


def _products(weights: Array, rows: Array) -> Array:
    """Σ w_i r_i r_iᵀ (N, p, p) of w (N, n) and r (n, p)."""
    p = rows.shape[1]
    return (weights @ (rows[:, :, None] * rows[:, None]).reshape(-1, p * p)).reshape(-1, p, p)


def _adjoint(M: np.ndarray) -> np.ndarray:
    return np.asarray(M.conj().transpose(0, 2, 1))


def _trace(M: np.ndarray) -> Array:
    return np.asarray(np.trace(M, axis1=1, axis2=2).real)


def _lengths(M: np.ndarray, axis: int) -> Array:
    return np.asarray(np.linalg.norm(M, axis=axis))
