"""Elastic bodies by finite elements: their material, and eigenpairs next to a negative shift.

A = K - σM with σ < 0 is positive definite although the stage floats; one factorisation of it
serves the eigen-solve and all derivatives. Point masses are a low-rank change of M and go by
the Woodbury identity, so the same code solves one symmetry or the direct sum of all of them.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy import sparse
from scipy.linalg import cho_factor, cho_solve, cholesky, solve_triangular
from scipy.sparse.linalg import splu

from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import UserError
from ccd_casadi.support.worker_process import OwnThreads


@dataclass(frozen=True)
class Material:
    """Isotropic linear elasticity; the defaults are those of aluminium 6061-T6.

    Attributes
    ----------
    young : float
        E in Pa.
    poisson : float
        Poisson's ratio.
    density : float
        kg/m³.
    """

    young: float = 68.9e9
    poisson: float = 0.33
    density: float = 2700.0

    @property
    def lame(self) -> tuple[float, float]:
        """λ and μ in Pa."""
        shear = self.young / (2.0 * (1.0 + self.poisson))
        return 2.0 * shear * self.poisson / (1.0 - 2.0 * self.poisson), shear


@dataclass(frozen=True)
class KrylovOptions:
    """Numbers of the block Krylov methods."""

    block: int = 3  # vectors of a block with which modes are searched
    most_blocks: int = 200  # of a space
    mode_residual: float = 1e-11  # relative, of a mode
    solution_residual: float = 1e-10  # relative, of the solution with the resolvent
    rounding: float = 1e-13  # of the operator's norm: below, a direction of a block is dropped


class StageError(UserError):
    """The stage cannot be evaluated; the message has the cause and what to change."""


@dataclass(frozen=True)
class Pencil:
    """Products with M and solutions with A = K + shift M on vectors (n, k).

    Attributes
    ----------
    size : int
        n.
    shift : float
        rad²/s².
    mass, inverse : callable
        x -> M x, and x -> A⁻¹ x.
    """

    size: int
    shift: float
    mass: Callable[[Array], Array]
    inverse: Callable[[Array], Array]


def build_pencil(
    shifted: Iterable[sparse.csr_matrix],
    masses: list[sparse.csr_matrix],
    shift: float,
    points: Array,
    added: Array,
    *,
    columns: int = 4,
) -> Pencil:
    """Factor the direct sum of elastic bodies (A_i, M_i), coupled by point masses.

    Parameters
    ----------
    shifted : iterable of sparse (n_i, n_i)
        A_i = K_i + shift M_i, N/m; not kept.
    masses : list of sparse (n_i, n_i)
        M_i, kg.
    shift : float
        rad²/s².
    points : array (n, r)
        Displacement functionals of the point masses.
    added : array (r,)
        Point masses in kg: M gains points diag(added) pointsᵀ.
    columns : int
        Right-hand sides that are solved at once: of two to five each takes half as long as one
        alone, of more twice as long.

    Returns
    -------
    Pencil
    """
    # A is symmetric positive definite: pivots from the diagonal, and its transpose is itself in CSC
    how = {"permc_spec": "MMD_AT_PLUS_A", "diag_pivot_thresh": 0.0}
    factors = [
        OwnThreads(partial(splu, A.T, **how, options={"SymmetricMode": True})) for A in shifted
    ]
    cuts = np.cumsum([M.shape[0] for M in masses])
    M_body = sparse.block_diag(masses, format="csr") if len(masses) > 1 else masses[0]

    def bodies(x: Array) -> Array:
        out = np.empty(x.shape)
        for factor, low, high in zip(factors, [0, *cuts], cuts, strict=False):
            for first in range(0, x.shape[1], columns):
                here = slice(low, high), slice(first, first + columns)
                out[here] = factor.value.solve(x[here])
        return out

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
    """Orthonormalise vectors in the norm of M; zero columns are dropped.

    Parameters
    ----------
    pencil : Pencil
    vectors : array (n, k)

    Returns
    -------
    array (n, k')
        Of the same span.
    """
    if vectors.shape[1] == 0:
        return vectors
    scale = np.sqrt(np.einsum("ij,ij->j", vectors, pencil.mass(vectors)))
    V = vectors[:, scale > 0.0] / scale[scale > 0.0]
    for _ in range(2):
        V = solve_triangular(cholesky(V.T @ pencil.mass(V), lower=True), V.T, lower=True).T
    return V


@dataclass(frozen=True)
class Krylov:
    """A block Krylov space of A⁻¹M: V (n, k), M-orthonormal, and T = VᵀMA⁻¹MV (k, k).

    What A⁻¹M makes of the last block is not in the space: `rest` (b, b) is the Gram matrix of its
    part beside it.
    """

    V: Array
    T: Array
    rest: Array

    def beside(self, y: Array) -> Array:
        """‖A⁻¹MVy - VTy‖ (m,) in the norm of M, of the columns of y (k, m)."""
        last = y[-len(self.rest) :]
        return np.asarray(np.sqrt(np.maximum(np.sum(last * (self.rest @ last), axis=0), 0.0)))


def krylov_spaces(
    pencil: Pencil, start: Array, without: Array, options: KrylovOptions
) -> Iterator[Krylov]:
    """Yield the Krylov spaces from `start` (n, b), each a block larger, M-orthogonal to `without`
    (n, r).

    Each block is orthogonalised against all before it: one product with M and one solution a block
    are all.
    """
    V, MV, block = without, pencil.mass(without), start
    out, T, scale = V.shape[1], np.zeros((0, 0)), 0.0
    for _ in range(options.most_blocks):
        for _ in range(2):
            block = block - V @ (MV.T @ block)
        M_block = pencil.mass(block)
        gram = block.T @ M_block
        scale = scale or float(np.sqrt(gram.max(initial=0.0)))
        if len(T):
            yield Krylov(V[:, out:], T, gram)
        for least in ((options.rounding * scale) ** 2, 0.0):
            values, turn = np.linalg.eigh(block.T @ M_block)
            turn = turn[:, values > least] / np.sqrt(values[values > least])
            block, M_block = block @ turn, M_block @ turn
            again = MV.T @ block
            block, M_block = block - V @ again, M_block - MV @ again
        if not block.shape[1]:
            return
        V, MV = np.hstack([V, block]), np.hstack([MV, M_block])
        block = pencil.inverse(M_block)
        known, own = np.split(MV[:, out:].T @ block, [len(T)])
        T = np.block([[T, known], [known.T, 0.5 * (own + own.T)]])
        scale = float(np.abs(T).max())


def flexible_modes(
    pencil: Pencil, rigid: Array, count: int, *, options: KrylovOptions = KrylovOptions()
) -> tuple[Array, Array]:
    """Compute the lowest flexible eigenpairs of K v = λ M v.

    Blocks find modes of equal frequency, as many as a block has vectors.

    Parameters
    ----------
    pencil : Pencil
    rigid : array (n, r)
        Exact rigid-body modes, M-orthonormal: projected out, they need no iterations.
    count : int
        Number of modes.
    options : KrylovOptions

    Returns
    -------
    λ (count,) in rad²/s², modes (n, count), M-orthonormal

    Raises
    ------
    StageError
        The iteration does not converge.
    """
    # a fixed start: the same θ gives the same digits
    draws = np.random.default_rng(0).standard_normal((pencil.size, options.block))
    for space in krylov_spaces(pencil, pencil.inverse(draws), rigid, options):
        mu, Y = np.linalg.eigh(space.T)
        mu, Y = mu[: -count - 1 : -1], Y[:, : -count - 1 : -1]
        if len(mu) == count and (space.beside(Y) <= options.mode_residual * mu).all():
            return 1.0 / mu - pencil.shift, space.V @ Y
    raise StageError("the stage's eigen-solve did not converge; check theta")


def build_resolvent(
    pencil: Pencil,
    modes: Array,
    F: Array,
    largest: float,
    *,
    options: KrylovOptions = KrylovOptions(),
) -> Callable[[float], Array]:
    """Build λ -> (K - λM)⁺ F from one block Krylov space of A⁻¹M from A⁻¹F.

    (K - λM)x = F reads (1 - (λ + shift) A⁻¹M) x = A⁻¹F, and Krylov spaces do not depend on λ.
    With every mode up to λ deflated the operator is positive definite: Galerkin's method is
    then that of conjugate gradients. The space grows until the residual at `largest` is small.

    Parameters
    ----------
    pencil : Pencil
    modes : array (n, k)
        All known modes; the solution is M-orthogonal to them.
    F : array (n, r)
        Right-hand sides.
    largest : float
        Largest λ of interest, rad²/s².
    options : KrylovOptions

    Returns
    -------
    callable
        λ -> array (n, r).

    Raises
    ------
    StageError
        The iteration does not converge.
    """
    if not F.shape[1]:
        return lambda value: F
    start = pencil.inverse(F)
    M_start = pencil.mass(start)

    def of(space: Krylov, value: float) -> Array:
        """Compute x = Vy in a space."""
        operator = np.eye(len(space.T)) - (value + pencil.shift) * space.T
        return np.asarray(np.linalg.solve(operator, space.V.T @ M_start))

    for space in krylov_spaces(pencil, start, orthonormal(pencil, modes), options):
        size = np.linalg.norm(space.V.T @ M_start, axis=0).max()
        left = (largest + pencil.shift) * space.beside(of(space, largest)).max()
        if left < options.solution_residual * size:
            found = space
            return lambda value: found.V @ of(found, value)
    raise StageError("the stage's mode derivatives did not converge; retain another number")
