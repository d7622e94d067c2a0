"""Eigenpairs next to a negative shift, and the resolvent at every eigenvalue found.

A = K - σM with σ < 0 is positive definite although the stage floats; one factorisation of it
serves the eigen-solve and all derivatives. Point masses are a low-rank change of M and go by
the Woodbury identity, so the same code solves one symmetry or the direct sum of all of them.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy import sparse
from scipy.linalg import cho_factor, cho_solve, cholesky, solve_triangular
from scipy.sparse.linalg import LinearOperator, eigsh, splu

from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import UserError
from ccd_casadi.support.threads import OwnThreads


class StageError(UserError):
    """The stage cannot be evaluated; the message says why and what to change."""


@dataclass(frozen=True)
class Pencil:
    """M and the inverse of A = K + shift M on vectors (n, k)."""

    size: int
    shift: float
    mass: Callable[[Array], Array]
    inverse: Callable[[Array], Array]


def build_pencil(
    shifted: list[sparse.csr_matrix],
    masses: list[sparse.csr_matrix],
    shift: float,
    points: Array,
    added: Array,
) -> Pencil:
    """The direct sum of elastic bodies (A_i, M_i), coupled by point masses.

    `points` (n, r) are displacement functionals and `added` (r,) their masses in kg: M gains
    points diag(added) pointsᵀ.
    """
    # A is symmetric positive definite: pivots from the diagonal, and its transpose is itself in CSC
    how = {"permc_spec": "MMD_AT_PLUS_A", "diag_pivot_thresh": 0.0}
    factors = [
        OwnThreads(partial(splu, A.T, **how, options={"SymmetricMode": True})) for A in shifted
    ]
    cuts = np.cumsum([A.shape[0] for A in shifted])
    M_body = sparse.block_diag(masses, format="csr") if len(masses) > 1 else masses[0]

    def bodies(x: Array) -> Array:
        parts = np.split(np.ascontiguousarray(x), cuts[:-1])
        return np.concatenate([f.value.solve(p) for f, p in zip(factors, parts, strict=True)])

    live = added > 0.0
    G, m = points[:, live], added[live]
    if not live.any():
        return Pencil(int(cuts[-1]), shift, lambda x: M_body @ x, bodies)
    AG = bodies(G)
    small = cho_factor(np.diag(1.0 / (shift * m)) + G.T @ AG)

    def inverse(x: Array) -> Array:
        y = bodies(x)
        return y - AG @ cho_solve(small, G.T @ y)

    def mass(x: Array) -> Array:
        return M_body @ x + G @ (m[:, None] * (G.T @ x) if x.ndim == 2 else m * (G.T @ x))

    return Pencil(int(cuts[-1]), shift, mass, inverse)


def orthonormal(pencil: Pencil, vectors: Array) -> Array:
    """M-orthonormal vectors of the same span (n, k); zero columns are dropped."""
    if vectors.shape[1] == 0:
        return vectors
    scale = np.sqrt(np.einsum("ij,ij->j", vectors, pencil.mass(vectors)))
    V = vectors[:, scale > 0.0] / scale[scale > 0.0]
    for _ in range(2):
        V = solve_triangular(cholesky(V.T @ pencil.mass(V), lower=True), V.T, lower=True).T
    return V


def flexible_modes(pencil: Pencil, rigid: Array, count: int) -> tuple[Array, Array]:
    """The `count` lowest flexible eigenvalues (rad²/s²) and M-orthonormal modes (n, count).

    `rigid` (n, r) are the exact rigid-body modes: projected out, they cost no iterations.
    """

    M_rigid = pencil.mass(rigid)

    def inverse(x: Array) -> Array:
        # from both sides: rounding of K leaves K rigid = 0 to eight digits only
        y = pencil.inverse(x - M_rigid @ (rigid.T @ x))
        return y - rigid @ (M_rigid.T @ y)

    def operator(f: Callable[[Array], Array]) -> LinearOperator:
        return LinearOperator((pencil.size, pencil.size), matvec=f, dtype=float)

    # a fixed start: the same θ gives the same digits
    start = inverse(np.random.default_rng(0).standard_normal(pencil.size))
    ncv = min(pencil.size, max(18, 2 * count + 1))
    how = {"v0": start, "ncv": ncv, "maxiter": 500, "tol": 1e-11, "OPinv": operator(inverse)}
    M = operator(pencil.mass)
    try:
        mu, V = eigsh(M, k=count, M=M, sigma=0.0, **how)
    except Exception as error:
        raise StageError(f"the stage's eigen-solve failed ({error}); check theta") from error
    order = np.argsort(mu)
    return mu[order] - pencil.shift, V[:, order]


def build_resolvent(
    pencil: Pencil, modes: Array, F: Array, largest: float
) -> Callable[[float], Array]:
    """λ -> (K - λM)⁺ F (n, r) from one block Krylov space of A⁻¹M from A⁻¹F, M-orthogonal to
    `modes` (n, k, all known ones).

    (K - λM)x = F reads (1 - (λ + shift) A⁻¹M) x = A⁻¹F, and Krylov spaces do not depend on λ.
    With every mode up to λ deflated the operator is positive definite: Galerkin's method is
    then that of conjugate gradients. Grown until the relative residual at `largest` is 1e-10.
    """
    modes = orthonormal(pencil, modes)
    M_modes = pencil.mass(modes)

    def deflate(x: Array) -> Array:
        for _ in range(2):
            x = x - modes @ (M_modes.T @ x)
        return x

    start = deflate(pencil.inverse(F))
    size = np.sqrt(np.einsum("ij,ij->j", start, pencil.mass(start)).max(initial=0.0))
    V = MV = W = np.zeros((pencil.size, 0))
    block, norms = start, size
    for _ in range(60):
        block = deflate(block)
        for _ in range(2):
            block = block - V @ (MV.T @ block)
        values, turn = np.linalg.eigh(block.T @ pencil.mass(block))
        keep = values > (1e-13 * norms) ** 2
        if not keep.any():
            break
        new = block @ (turn[:, keep] / np.sqrt(values[keep]))
        new = deflate(new)
        new = new - V @ (MV.T @ new)
        new = orthonormal(pencil, new)
        M_new = pencil.mass(new)
        image = deflate(pencil.inverse(M_new))
        V, MV, W = np.hstack([V, new]), np.hstack([MV, M_new]), np.hstack([W, image])
        T = MV.T @ W
        right = MV.T @ start
        y = np.linalg.solve(np.eye(len(T)) - (largest + pencil.shift) * T, right)
        x = V @ y
        residual = start - x + (largest + pencil.shift) * (W @ y)
        error = np.sqrt(np.einsum("ij,ij->j", residual, pencil.mass(residual)).max())
        block, norms = image, float(np.abs(T).max())
        if error < 1e-10 * size:
            break
    else:
        raise StageError("the stage's mode derivatives did not converge; retain another number")
    T, right = MV.T @ W, MV.T @ start
    T = 0.5 * (T + T.T)

    def at(value: float) -> Array:
        return V @ np.linalg.solve(np.eye(len(T)) - (value + pencil.shift) * T, right)

    return at
