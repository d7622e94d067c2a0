"""A plant as its function returned it: natural modes, rigid ones, and in first order for the judge.

Of K v = λ M v those modes are rigid that K does not resist. Whether λ is zero cannot be seen from
λ: its rounding is that of the largest, so that one stiff link (1 mg on 1e9 N/m) would hide a
resonance. It is seen from K in units in which every entry of its diagonal is one,

    K' = d⁻¹K d⁻¹,   d = √diag K,

which no unit of a coordinate changes: entries of K with relative errors ε move the eigenvalues of
K' by n ε. So K' resists a motion by what it has there, or by rounding. What lies between is
refused unless the case states how many rigid-body modes there are.

A negative eigenvalue is a motion that K drives away, as the negative stiffness of a magnetic
bearing does: λ < 0, and poles ±√-λ where nothing damps it. It is no rigid-body mode.

Flexible modes are those of the M-orthogonal complement, low ones by the inverse where stiffnesses
are many decades apart: an eigenvalue solver errs by ε of its largest eigenvalue.

In first order a finished loop is judged on it,

    M q̈ + D q̇ + K q = B u,   y = C q;   ẋ = [0 1; -M⁻¹K -M⁻¹D] x + [0; M⁻¹B] u,   x = (q, q̇)

in the person's own coordinates and units, free bodies free, nothing reduced, scaled or put in modal
form, with its actuators and sensors around it, but for one case: beside a link so stiff that
λ_max > 1e7 λ_min the eigenvalues of A err by ε λ_max in squares of rates, which moves the soft
poles and hides free bodies. There x = (η, η̇), q = Φ η with `natural_modes`, which know the soft
modes, M = 1 and K = Λ.

Off the model, with a common shift s of the resonances, shifts s_i of single modes, a factor d of
the damping and a gain g of what u moves,

    K' = (1 + s)²(K + Σ_i ((1 + s_i)² - 1) λ_i M φ_i (M φ_i)ᵀ),
    D' = d (D + Σ_i 2 ζ (1 + s)(1 + s_i) ω_i M φ_i (M φ_i)ᵀ),   b_j' = (1 + g) b_j.

A plant of first order is as its function returned it, and off its model as `first_order` has it.
A motion that K drives away, λ_i < 0, has ω_i = 0 here: ζ damps none.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import eigh

from ccd_casadi.lti.state_space import StateSpace, strictly_proper
from ccd_casadi.lti.wiring import Slopes
from ccd_casadi.plants.first_order import first_order
from ccd_casadi.plants.plant import Mechanics
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


def as_written(
    system: Mechanics,
    *,
    shift: float = 0.0,
    modes: Sequence[float] = (),
    damping: float = 1.0,
    gain: float = 0.0,
    inputs: int | None = None,
    rigid_modes: int | None = None,
    stiff: float = 1e7,
) -> StateSpace:
    """The state space of a plant's matrices, on or off the model.

    Parameters
    ----------
    system : Mechanics
        M, D, K, B, C at one θ, SI, and the damping ratio ζ where the model gives one.
    shift, modes, damping, gain : float, sequence of float, float, float
        s, s_i in the order of the modes' numbers, d and g; of a given D the matrix is kept.
    inputs : int, optional
        How many columns b_j of B are those of u, the first; None: all.
    rigid_modes : int, optional
        How many there are, where the case states it.
    stiff : float
        λ_max/λ_min of the flexible modes above which these are the coordinates: rounding would
        cost the low ones their digits.

    Returns
    -------
    StateSpace
        Force to displacement. Free bodies that are neither driven nor measured are left out.

    Raises
    ------
    PlantError
        Where it is not known which modes are rigid, or no controller can hold one.
    """
    B = system.B.copy()
    B[:, :inputs] *= 1.0 + gain
    if system.first_order:
        system_of = strictly_proper(-system.K, B, system.C)
        if shift or damping != 1.0 or any(modes):
            none = Slopes(*(np.zeros((0, *part.shape)) for part in (system.K, system.B, system.C)))
            states = first_order(system_of.A, system_of.B, system_of.C, none)
            system_of = states.off(shift, damping, modes).system
        return system.wiring.around(system_of)
    lam, shapes, rigid = natural_modes(system.K, system.M, rigid_modes)
    own = np.zeros(len(lam))
    single = number_modes(shapes, rigid)[: len(modes)]
    own[single] = list(modes)[: len(single)]
    pushes = system.M @ shapes
    ratio = (1.0 + shift) * (1.0 + own)
    K = (1.0 + shift) ** 2 * (system.K + (pushes * (((1.0 + own) ** 2 - 1.0) * lam)) @ pushes.T)
    zeta = system.damping_ratio or 0.0
    omega = ratio * np.sqrt(np.maximum(lam, 0.0))
    D = damping * (system.D + (pushes * (2.0 * zeta * omega)) @ pushes.T)
    M, C = system.M, system.C
    sides, soft = _seen(shapes, rigid, B, C), np.abs(lam[~rigid])
    spread = bool(len(soft)) and soft.max() > stiff * soft.min()
    if sides is None and spread:
        sides = shapes, shapes
    if sides is not None:
        left, right = sides
        M, K, D = (left.T @ part @ right for part in (M, K, D))
        B, C = left.T @ B, C @ right
    if spread:  # exactly, where products with K would lose it
        M, K = (
            np.eye(len(M)),
            np.diag(np.append(np.zeros(len(M) - len(soft)), (ratio**2 * lam)[~rigid])),
        )
    n, rates = len(M), np.linalg.solve(M, np.hstack([K, D, B]))
    A = np.zeros((2 * n, 2 * n))
    A[:n, n:] = np.eye(n)
    A[n:] = -rates[:, : 2 * n]
    drive = np.vstack([np.zeros_like(B), rates[:, 2 * n :]])
    plant = strictly_proper(A, drive, np.hstack([C, np.zeros_like(C)]))
    return system.wiring.around(plant)


def _seen(shapes: Array, rigid: np.ndarray, B: Array, C: Array) -> tuple[Array, Array] | None:
    """Test and trial shapes (n, k) without the rigid-body motions that are neither driven nor
    measured; None where all are: then the person's own coordinates stay."""
    free, flexible = shapes[:, rigid], shapes[:, ~rigid]
    sizes = np.linalg.norm(shapes.T @ B, 2), np.linalg.norm(C @ shapes, 2)
    if not free.size or not all(sizes):
        return None
    T, back = driven_and_measured(free.T @ B / sizes[0], C @ free / sizes[1])
    if T.shape[1] == free.shape[1]:
        return None
    return np.hstack([free @ back.T, flexible]), np.hstack([free @ T, flexible])
