"""Natural modes of K v = λ M v, and which of them are rigid: what K does not resist.

Whether λ is zero cannot be seen from λ: its rounding is that of the largest, so that one stiff
link (1 mg on 1e9 N/m) would hide a resonance. It is seen from K in units in which every entry of
its diagonal is one,

    K' = d⁻¹K d⁻¹,   d = √diag K,

which no unit of a coordinate changes: entries of K with relative errors ε move the eigenvalues of
K' by n ε. So K' resists a motion by what it has there, or by rounding. What lies between is
refused unless the case states how many rigid-body modes there are.

A negative eigenvalue is a motion that K drives away, as the negative stiffness of a magnetic
bearing does: λ < 0, and poles ±√-λ where nothing damps it. It is no rigid-body mode.

Flexible modes are those of the M-orthogonal complement, low ones by the inverse where stiffnesses
are many decades apart: an eigenvalue solver errs by ε of its largest eigenvalue.
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import eigh

from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import PlantError

EPS = float(np.finfo(float).eps)


@dataclass(frozen=True)
class RigidModeOptions:
    """Numbers that decide which modes are rigid."""

    rounding: float = 100.0  # times n ε: eigenvalues of K' below it may be rounding of zero
    known: float = 1e-10  # eigenvalue of K' from which on K resists: its λ is known to n ε/known
    stated: float = 1e-3  # eigenvalue of K' of a rigid motion at most, where their number is stated
    hidden: float = 1e-9  # relative gain below which a rigid body is not driven, or not measured
    stiff: float = 1e8  # λ_max/λ_min from which on low modes are found by the inverse


def natural_modes(
    K: Array, M: Array, stated: int | None = None, *, options: RigidModeOptions = RigidModeOptions()
) -> tuple[Array, Array, np.ndarray]:
    """Eigenvalues λ, modes and which are rigid, with λ = 0 there, lowest first.

        K Φ = M Φ Λ,   ΦᵀMΦ = 1

    Parameters
    ----------
    K, M : arrays (n, n)
        Stiffness and mass, symmetric, M positive definite, SI.
    stated : int, optional
        How many rigid-body modes the case states: where K leaves it open those of least |λ| are.
    options : RigidModeOptions

    Returns
    -------
    λ (n,), Φ (n, n), rigid (n,)
        Rigid ones first.

    Raises
    ------
    PlantError
        K has an eigenvalue that is neither zero nor known.
    """
    diagonal = np.abs(np.diag(K))
    d = np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))
    w, U = np.linalg.eigh(K / d[:, None] / d)
    order = np.argsort(np.abs(w), kind="stable")
    w, U = np.abs(w[order]), U[:, order]
    rounding = options.rounding * len(K) * EPS
    count = int((w <= rounding).sum())
    if stated is not None and count <= stated < len(w):
        count = stated if w[:stated].max(initial=0.0) <= options.stated else count
    open_ones = w[count:] < options.known
    if open_ones.any() and count != stated:
        raise PlantError(
            f"the stiffness matrix resists a motion by {w[count]:.2g} of its entries: by rounding, "
            f"or by a spring? If it is a rigid-body mode, state [suspension] rigid_modes = "
            f"{count + int(open_ones.sum())}; else give more digits, or softer links"
        )
    L = np.linalg.cholesky(M)
    A = np.linalg.solve(L, np.linalg.solve(L, K).T)
    rigid = U[:, :count] / d[:, None]
    Q, _ = np.linalg.qr(L.T @ rigid, mode="complete")
    own, rest = Q[:, :count], Q[:, count:]
    lam, shapes = np.linalg.eigh(rest.T @ (0.5 * (A + A.T)) @ rest)
    modes = np.linalg.solve(L.T, np.hstack([own, rest @ shapes]))
    if len(lam) and lam[-1] > options.stiff * lam[0] > 0.0:
        lam, modes[:, count:] = _low_ones_by_the_inverse(K, M, lam, modes, count)
    return np.append(np.zeros(count), lam), modes, np.arange(len(K)) < count


def number_modes(modes: Array, rigid: np.ndarray) -> np.ndarray:
    """The flexible ones of modes (n, n), lowest first, in the order of their numbers.

    Where each coordinate of the model is a mode the model's order counts: what shifts a mode alone
    then shifts the same one at every θ, also past a crossing of frequencies. Else the lowest is
    the first. Each branch of eigenvalues has a function of its own, of which the divided
    differences hold as they do for one, where eigenvalues are apart.
    """
    flexible = np.flatnonzero(~rigid)
    if np.count_nonzero(modes[:, flexible]) == len(flexible):
        flexible = flexible[np.argsort(np.abs(modes).argmax(0)[flexible])]
    return flexible


def driven_and_measured(
    B: Array, C: Array, *, options: RigidModeOptions = RigidModeOptions()
) -> tuple[Array, Array]:
    """Coordinates z, q = T z, of which the first ones alone are driven and measured.

    Free bodies q̈ = B u, y = C q are C B/s², whatever T. Where C, B and C B are of one rank,
    T = [range B, kernel C] parts what the loop sees from what it neither drives nor measures.

    Parameters
    ----------
    B, C : arrays (k, m), (p, k)
        Relative to those of the whole plant.
    options : RigidModeOptions

    Returns
    -------
    T (k, rank), and its part (rank, k) of T⁻¹

    Raises
    ------
    PlantError
        A motion is driven and not measured, or the reverse: no controller can hold it.
    """
    U, s, _ = np.linalg.svd(B, full_matrices=False)
    driven = int((s > options.hidden).sum())
    _, s, Vt = np.linalg.svd(C)
    measured = int((s > options.hidden).sum())
    both = np.linalg.svd(Vt[:measured] @ U[:, :driven], compute_uv=False)
    known = int((both > options.hidden).sum())
    if driven > known:
        words = "it drifts away; add an output that sees it, or a spring that holds it"
        raise PlantError(f"a rigid-body motion is driven and not measured: {words}")
    if measured > known:
        words = "no force holds it; add an input that moves it, or a spring that holds it"
        raise PlantError(f"a rigid-body motion is measured and not driven: {words}")
    if known == len(B):
        return np.eye(known), np.eye(known)
    T = np.hstack([U[:, :known], Vt[known:].T])
    return T[:, :known], np.linalg.inv(T)[:known]


def embed(T: Array, own: np.ndarray, kept: np.ndarray) -> Array:
    """Embed a transformation of some coordinates into all of them.

    Parameters
    ----------
    T : array (k, r)
        Transformation of the coordinates `own`.
    own : int array (k,)
        Their numbers.
    kept : int array
        Numbers of the coordinates that stay, r of them among `own`.

    Returns
    -------
    array (n, len(kept))
    """
    n = len(own) - T.shape[1] + len(kept)
    whole = np.eye(n)[:, kept]
    whole[np.ix_(own, np.isin(kept, own))] = T
    return whole


def _low_ones_by_the_inverse(
    K: Array, M: Array, lam: Array, modes: Array, count: int
) -> tuple[Array, Array]:
    """λ and modes of the flexible ones, those below the middle of M v = μ K v, μ = 1/λ.

    A Cholesky factor errs as the entries of K in their own units do, so that the largest μ are
    known as well as K' is. Rigid modes are held at a λ among these.
    """
    rigid = M @ modes[:, :count]
    held = 0.5 * max(lam[0], EPS * lam[-1])  # below the flexible ones, and of their size
    inverse, shapes = eigh(M, K + held * rigid @ rigid.T)
    along = np.linalg.norm(rigid.T @ shapes, axis=0) ** 2 / inverse
    flexible = np.sort(np.argsort(along)[: len(lam)])[::-1]
    low, found = 1.0 / inverse[flexible], shapes[:, flexible] / np.sqrt(inverse[flexible])
    fine = low < np.sqrt(lam[-1] * low[0])
    return np.where(fine, low, lam), np.where(fine, found, modes[:, count:])
