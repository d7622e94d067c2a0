"""Every local peak of the singular values of S, KS, T and GS, with exact derivatives.

As `figures`, with the gain of a matrix M(jω) in place of a modulus. Each singular value σ_k is a
constraint of its own: where the largest two meet, both bind, and no derivative is lost. The sorted
σ_k of plant i has the number i + kP among the rows, P the number of plants. With u, v its singular
vectors and κ_a a parameter of channel i, each M depends on K_i by rank one,

    ∂M = P_i ∂K_i Q_i,   ∂σ = Re(uᴴP_i ∂K_i Q_i v),

    M       P               Q            to the plant and to frequency
    S      -S G V           Uᵀ S         -S ∂(GK) S
    T       S G V           Uᵀ S          S ∂(GK) S
    KS     (I - KSG) V      Uᵀ S          ∂K S - KS ∂(GK) S
    S G₀   -S G V           Uᵀ S G₀      -S ∂(GK) S G₀ + S ∂G₀

where G₀ is the continuous plant (without hold and delay, `free_responses`) and K = V diag(K_i) Uᵀ.
With more inputs than outputs S and T are p x p, KS is m x p, S G₀ p x m: p singular values each, of
matrices that are filled up to m x m with zeros here. Rows that a channel bounds for itself are
numbered after them (`own_rows`): L M stands for M, and L P for P.
"""

from dataclasses import dataclass

import numpy as np

from ccd_casadi.fixed_structure.channel_structure import ChannelStructure
from ccd_casadi.fixed_structure.figures import assess, to_theta
from ccd_casadi.fixed_structure.loop import stable
from ccd_casadi.fixed_structure.loop_problem import (
    Assessment,
    Constraints,
    Curve,
    chain_of,
    plant_of_row,
)
from ccd_casadi.fixed_structure.mimo_levels import MatrixProblem, levels, offsets
from ccd_casadi.fixed_structure.mimo_loop import whole_closed_loops
from ccd_casadi.fixed_structure.peak_search import closed_on_zero, frequency_grid
from ccd_casadi.fixed_structure.structure import response_and_slopes
from ccd_casadi.support.arrays import Array

# ln of the share of its bound under which a peak is none of ours: above that of S = I, whose
# singular values ripple around 1 wherever the loop has no gain.
RELEVANT = -0.4
WITHIN = 0.4
# Sorted singular values may have two maxima between neighbours of the grid, where the smooth ones
# cross, or one and a crossing, past which the slope has no change of sign: brackets of a maximum
# above -CLOSE are looked at again at so many places and at the maximum (an even number: the middle
# of a regular grid's bracket is the maximum itself).
CLOSE = 0.1
FINER = 12
# Curve, row, start, low and high end of each.
Brackets = tuple[np.ndarray, np.ndarray, Array, Array, Array]


@dataclass(frozen=True)
class Rows:
    """M constraints at fixed frequencies: value and slope to ln v, derivatives to κ (M, n).

    `U`, `s`, `V` (M, m, m) are the singular vectors and values of each row's matrix, `at` which of
    them, `left` = Uᴴ P (M, m, channels), `right` = Q V, `inner` = Uᵀ S G V; k the channels' K_i
    (M, c), `log_slopes` (M, n) ∂ln K_i/∂κ.
    """

    value: Array
    slope: Array
    to_kappa: Array
    U: np.ndarray
    s: Array
    V: np.ndarray
    at: np.ndarray
    left: np.ndarray
    right: np.ndarray
    inner: np.ndarray
    k: np.ndarray
    log_slopes: np.ndarray


def evaluate_rows(
    problem: MatrixProblem, kappa: Array, tau: float, curve: np.ndarray, row: np.ndarray, v: Array
) -> Rows:
    """The singular values that the rows name, of these curves at these v; without the margin."""
    plants, structure = problem.plants, problem.structure
    which, number = plant_of_row(problem, row), row // len(plants.plants)
    at = np.where(number < problem.own.first, number, 0)
    k, ln_slope, log_slopes = _channels(structure, kappa, v)
    G, dG = plants.responses(which, v)
    K = plants.into @ (k[..., None] * plants.out)
    K_x = plants.into @ ((k * ln_slope)[..., None] * plants.out)
    eye = np.eye(K.shape[-1])
    S = np.linalg.inv(eye + G @ K)
    SG = S @ G
    SL_xS = S @ (dG @ K + G @ K_x) @ S
    m, c = plants.into.shape
    of_t, of_ks, of_gs = (_chosen(curve, code) for code in (Curve.T, Curve.KS, Curve.GS))
    M = _filled(np.where(of_t, eye - S, S), m, m)
    M_x = _filled(np.where(of_t, SL_xS, -SL_xS), m, m)
    left = _filled(np.where(of_t, SG, -SG), m, m)
    right = _filled(plants.out @ S, c, m)
    if of_ks.any():
        M = np.where(of_ks, _filled(K @ S, m, m), M)
        M_x = np.where(of_ks, _filled(K_x @ S - K @ SL_xS, m, m), M_x)
        left = np.where(of_ks, np.eye(m) - K @ SG, left)
    if of_gs.any():
        free, dfree = plants.free_responses(which, v)
        M = np.where(of_gs, _filled(S @ free, m, m), M)
        M_x = np.where(of_gs, _filled(S @ dfree - SL_xS @ free, m, m), M_x)
        right = np.where(of_gs, plants.out @ S @ free, right)
    L = problem.own.picked(curve, number, m)
    if L is not None:
        M, M_x, left = L @ M, L @ M_x, L @ left
    U, s, Vh = np.linalg.svd(M)
    V = np.conj(np.swapaxes(Vh, 1, 2))
    lefts = np.conj(np.swapaxes(U, 1, 2)) @ left @ plants.into
    rights = right @ V
    rows = np.arange(len(v))
    sigma = s[rows, at]
    offset, offset_slope = offsets(problem, tau, curve, number, v)
    share = lefts[rows, at] * k * rights[rows, :, at] / sigma[:, None]
    to_kappa = np.empty((len(v), len(kappa)))
    for i, place in enumerate(structure.slices):
        to_kappa[:, place] = (share[:, [i]] * log_slopes[:, place]).real
    pushed = np.einsum("mi,mij,mj->m", np.conj(U[rows, :, at]), M_x, V[rows, :, at])
    slope = pushed.real / sigma + offset_slope
    with np.errstate(divide="ignore"):
        value = np.log(sigma) + offset
    inner = plants.out @ SG @ plants.into
    return Rows(value, slope, to_kappa, U, s, V, at, lefts, rights, inner, k, log_slopes)


def whole_constraints(
    problem: MatrixProblem, kappa: Array, tau: float, curve: np.ndarray, row: np.ndarray, v: Array
) -> Constraints:
    """Values and derivatives of these rows at these v."""
    found = evaluate_rows(problem, kappa, tau, curve, row, v)
    to_tau = np.zeros(len(v))
    to_tau[curve == Curve.SHAPE] = 1.0
    end = curve == Curve.CROSSING
    to_tau[end] = (found.slope / chain_of(problem, v))[end]
    return Constraints(curve, row, v, found.value + problem.margin, found.to_kappa, to_tau)


@assess.register
def _(
    problem: MatrixProblem,
    kappa: Array,
    tau: float,
    *,
    within: float = WITHIN,
    depth: float = RELEVANT,
    each: bool = False,
) -> Assessment:
    poles = whole_closed_loops(problem.plants, problem.structure, kappa)
    good = stable(poles)
    if not good.any() if each else not good.all():
        return Assessment(False, poles, None, None)
    own = problem.own
    v, regular = frequency_grid(problem, problem.structure.roots(kappa), poles)
    P, count = v.shape
    crossing = problem.plants.variable(np.exp(tau + own.lead))  # by number
    found, near = [], []
    which = np.broadcast_to(np.arange(P)[:, None], v.shape)
    for curve, value in levels(problem, kappa, tau, which, v, min(depth, -within)).items():
        short = problem.ends_at_crossing(curve)
        if short:
            value = np.where(v[..., None] <= crossing, value, -np.inf)
        left = np.pad(value, ((0, 0), (1, 0), (0, 0)), constant_values=-np.inf)[:, :-1]
        right = np.pad(value, ((0, 0), (0, 1), (0, 0)), constant_values=-np.inf)[:, 1:]
        i, at, k = np.nonzero((value > depth) & (value >= left) & (value > right))
        low, high = v[i, np.maximum(at - 1, 0)], v[i, np.minimum(at + 1, count - 1)]
        if short:
            high = np.minimum(high, crossing[k])
        brackets = (np.full(len(i), curve), i + k * P, v[i, at], low, high)
        found.append(_split(problem, kappa, tau, brackets, value[i, at, k]))
        i, at, k = np.nonzero(regular[..., None] & (value > -within))
        near.append((np.full(len(i), curve), i + k * P, v[i, at]))
    kind, rows, start, low, high = (np.concatenate(part) for part in zip(*found, strict=True))

    def slope(x: Array, of: np.ndarray) -> Array:
        return evaluate_rows(problem, kappa, tau, kind[of], rows[of], np.exp(x)).slope

    top, closed = closed_on_zero(slope, start, low, high)
    # An open end at ω_b is the crossing; one at the lowest frequency is a row of its own.
    ending = [curve for curve in problem.curves if problem.ends_at_crossing(curve)]
    whole = closed | ~np.isin(kind, ending) | (start < 0.1 * crossing[rows // P])
    kind, rows, top = kind[whole], rows[whole], top[whole]
    every = np.arange(P * own.first)
    faster = (own.first + own.bounded(Curve.CROSSING))[:, None] * P + np.arange(P)
    ends = np.concatenate([every, faster.ravel()])
    low_v = float(problem.plants.variable(np.array([problem.low]))[0])
    kind = np.concatenate([kind, np.full(len(every), Curve.S_LOW),
                           np.full(len(ends), Curve.CROSSING)])  # fmt: skip
    rows = np.concatenate([rows, every, ends])
    top = np.concatenate([top, np.full(len(every), low_v), crossing[ends // P]])
    other = [np.concatenate(part) for part in zip(*near, strict=True)]
    return Assessment(
        True,
        poles,
        whole_constraints(problem, kappa, tau, kind, rows, top),
        whole_constraints(problem, kappa, tau, *other),
    )


@to_theta.register
def _(problem: MatrixProblem, kappa: Array, found: Constraints) -> Array:
    plants = problem.plants
    out = np.zeros((len(found.v), plants.plants[0].dA.shape[0]))
    which = plant_of_row(problem, found.plant)
    at = evaluate_rows(problem, kappa, 0.0, found.curve, found.plant, found.v)
    rows = np.arange(len(found.v))
    sigma = at.s[rows, at.at][:, None]
    u, v = np.conj(at.U[rows, :, at.at]), at.V[rows, :, at.at]
    K = plants.into @ (at.k[..., None] * plants.out)
    G, _ = plants.responses(which, found.v)
    S = np.linalg.inv(np.eye(K.shape[-1]) + G @ K)
    free, _ = plants.free_responses(which, found.v)
    of_t, of_ks, of_gs = (_chosen(found.curve, code) for code in (Curve.T, Curve.KS, Curve.GS))
    # ∂M = left ∂G right, and S ∂G₀ of the compliance
    m, p = K.shape[1:]
    own_s = _filled(S, m, p)
    left = np.where(of_ks, K @ S, own_s) * np.where(of_t, 1.0, -1.0)
    L = problem.own.picked(found.curve, found.plant // len(plants.plants), m)
    if L is not None:
        left = L @ left
    right = np.where(of_gs, K @ S @ free, _filled(K @ S, m, m))
    x = np.einsum("mi,mij->mj", u, left)
    y = np.einsum("mij,mj->mi", right, v)
    x_free = np.einsum("mi,mij->mj", u, own_s)
    for i in np.unique(which):
        own = np.flatnonzero(which == i)
        out[own] = plants.form_to_theta(int(i), found.v[own], x[own], y[own]).real
        own = own[found.curve[own] == Curve.GS]
        if len(own):
            out[own] += plants.form_to_theta(
                int(i), found.v[own], x_free[own], v[own], free=True
            ).real
    return np.asarray(out / sigma)


def _channels(
    structure: ChannelStructure, kappa: Array, v: Array
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """K_i (M, c), ∂ln K_i/∂ln v (M, c), and ∂ln K_i/∂κ (M, n) of every channel's own κ."""
    parts = [response_and_slopes(own, part, 1j * v) for own, part in structure.split(kappa)]
    values, slopes, ln_slopes = zip(*parts, strict=True)
    return np.stack(values, -1), np.stack(ln_slopes, -1), np.concatenate(slopes, -1)


def _split(
    problem: MatrixProblem, kappa: Array, tau: float, brackets: Brackets, value: Array
) -> Brackets:
    """Brackets of one curve's maxima with `value` there, narrowed; several in one come apart.

    A maximum of σ_k+1 where smooth ones cross has one of σ_k beside it, which the grid may miss.
    """
    kind, rows, start, low, high = brackets
    at = np.flatnonzero((value > -CLOSE) & (low < high))
    if not len(at):
        return brackets
    P = len(problem.plants.plants)
    inside = np.geomspace(low[at], high[at], FINER, axis=1)
    inside = np.sort(np.concatenate([inside, start[at, None]], axis=1), axis=1)
    which = np.broadcast_to((rows[at] % P)[:, None], inside.shape)
    level = levels(problem, kappa, tau, which, inside, -2.0 * CLOSE)[Curve(int(kind[0]))]

    def tops(row: np.ndarray) -> np.ndarray:
        own = level[np.arange(len(at)), :, row // P]
        return np.asarray((own[:, 1:-1] >= own[:, :-2]) & (own[:, 1:-1] > own[:, 2:]))

    first = problem.own.first * P  # of the rows that no other crosses

    def bracketed(row: np.ndarray, top: np.ndarray) -> Brackets:
        i, m = np.nonzero(top)
        return kind[at[i]], row[i], inside[i, m + 1], inside[i, m], inside[i, m + 2]

    own = tops(rows[at])
    kept = np.setdiff1d(np.arange(len(start)), at[own.any(axis=1)])
    crossed = (rows[at] >= P) & (rows[at] < first)
    above = np.where(crossed, rows[at] - P, rows[at])
    beside = tops(above) & crossed[:, None]
    known = above[:, None] == rows  # no maximum twice
    x = inside[:, 1:-1, None]
    beside &= ~(known[:, None] & (low <= x) & (x <= high)).any(axis=2)
    parts = zip((part[kept] for part in brackets), bracketed(rows[at], own),
                bracketed(above, beside), strict=True)  # fmt: skip
    kind, rows, start, low, high = (np.concatenate(part) for part in parts)
    return kind, rows, start, low, high


def _filled(M: np.ndarray, rows: int, columns: int) -> np.ndarray:
    """The matrices (k, a, b) with zeros below and beside."""
    a, b = M.shape[1:]
    return M if (a, b) == (rows, columns) else np.pad(M, ((0, 0), (0, rows - a), (0, columns - b)))


def _chosen(curve: np.ndarray, code: Curve) -> np.ndarray:
    return np.asarray(curve == code)[:, None, None]
