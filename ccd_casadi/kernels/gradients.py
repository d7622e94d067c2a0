"""Total derivatives of the figures of closed loops, the controller moving with its design plant.

Each figure is a scalar of S = (I + GK)⁻¹ with K = C_K(s - A_K)⁻¹B_K, A_K = A + B2 F - B1 C2,
F = -(B2ᵀX + D12ᵀC1)/d2² and X the stabilising solution of

    AᵀX + XA + C1ᵀC1 + t VᵀV - d2² FᵀF = 0,   V = (B1ᵀX + Sᵀ)/t,   t = γ² - d1².

With K = K(P_d, w) from the design plant P_d and the loop closed on P,

    dσ_max(S) = -Re a (dG K + G dK) b,   dσ_max(SG) = -Re a (G dK b' - dG c),

a = uᵀS, b = S v, b' = S G v, c = (I + KG)⁻¹ v with the singular vectors u, v. dG is a matter of P
alone; P is P_d in a nominal design, a plant off the model in a robust one, in one unit of time and
force. dK goes back through the Riccati equation of P_d: with X̄ the gradient to X, one adjoint
Lyapunov equation A_c L + L A_cᵀ + X̄ = 0 with A_c = A + B1 V + B2 F gives the gradient to every
matrix at once, however many parameters there are. γ_opt, where X is infinite, has the same equation
in the basis [U1; U2] of the stable subspace: only f = λ_min(X⁻¹) and its null vector q appear, T11
Λ + Λ T11ᵀ + qqᵀ = 0. With δ > 0, and for an unstable plant, the filter's solution stands in B1 and
has an adjoint Lyapunov equation of its own (`adjoint`).

Plain NumPy: a point is differentiated once, and compiled this took a third of the set-up.
"""

from collections.abc import Sequence
from math import nan
from typing import Any, NamedTuple

import numpy as np

from ccd_casadi.kernels.adjoint import (
    FourBlockPullback,
    MixedPullback,
    PlantGradients,
    UnstablePullback,
    bound_gradient,
    bound_peak,
)
from ccd_casadi.kernels.frequency import prepare
from ccd_casadi.kernels.gamma import gamma_lower_bound
from ccd_casadi.kernels.generalized_plant import generalized_plant, unstable_modes, unstable_plant
from ccd_casadi.kernels.linear_algebra import lyapunov_triangular, stable_subspace
from ccd_casadi.kernels.riccati import (
    RiccatiOptions,
    level_hamiltonian,
    lqr_hamiltonian,
    riccati_level,
)
from ccd_casadi.kernels.riccati_synthesis import (
    disturbance_bound,
    filter_solution,
    innovations_plant,
)
from ccd_casadi.kernels.sensitivity import Code, Column
from ccd_casadi.support.arrays import Array


class LoopAt(NamedTuple):
    """A loop at the frequency where a gain is differentiated.

    Attributes
    ----------
    plant
        With A, B, C and dA, dB, dC to θ.
    omega : float
        Over ω₀.
    compliance : bool
        The gain of S G, else of S; those of S G are the last among several.
    """

    plant: Any
    omega: float
    compliance: bool = False


class MadeFor(NamedTuple):
    """The data that a controller is synthesised for.

    Attributes
    ----------
    plant
        As that of `LoopAt`.
    w : array (8,)
        Scaled weights.
    backoff : float
        γ/γ_opt.
    delta : float
    """

    plant: Any
    w: Array
    backoff: float
    delta: float = 0.0


def _transpose(M):
    return np.swapaxes(M, -1, -2)


def _riccati_terms(T11, U1, U2, L, gp, t):
    """Gradients of tr(Λ E) to the generalized plant and γ², E the differential in the basis of U.

    E is the stationary value of 2 pᵀẋ + zᵀz - γ² wᵀw over u and the disturbance w, so that only
    what stands in ẋ and z counts. The gradients to A and C1 are p xᵀ and z xᵀ summed over Λ; with
    each comes the sum with ẋ for x. Λ (k, N, N): every result has k in front.
    """
    _, B1, B2, C1, _, d1, d2 = gp
    p, m = B1.shape[1], B2.shape[1]
    V = (B1.T @ U2 + d1 * (C1[:p] @ U1)) / t
    F = -(B2.T @ U2 + d2 * (C1[p : p + m] @ U1)) / d2**2
    Z = C1 @ U1
    Z[:p] += d1 * V
    Z[p : p + m] += d2 * F
    states, rates = U1.T, (U1 @ T11).T
    costate, output = 2.0 * (U2 @ L), 2.0 * (Z @ L)
    of_plant = PlantGradients(
        costate @ states, costate @ rates, costate @ V.T, costate @ F.T, output @ states,
        output @ rates, np.zeros((len(L), p, len(states))),
    )  # fmt: skip
    return of_plant, -(V * (V @ L)).sum((1, 2))


def gamma_gradient(posed, gamma_opt):
    """Gradients of γ_opt = γ_X to A, B, C and the weights; whether the Hamiltonian splits there."""
    gp, H0, back = posed
    _, B1, _, C1, _, d1, _ = gp
    t = gamma_opt**2 - d1**2
    _, _, ok, (_, T11, U1, U2, _, _, q, _, _) = riccati_level(
        H0, B1, C1, d1, t, RiccatiOptions.noise
    )
    Lq = lyapunov_triangular(T11, -np.outer(q, q), False)
    terms, level = _riccati_terms(T11, U1, U2, Lq[None], gp, t)
    # γ moves so that f stays zero
    scale = -1.0 / (level[0] * 2.0 * gamma_opt)
    return *(scale * part[0] for part in back.to_plant_and_weights(terms)), ok


def _gain_cotangents(A, B, C, Ak, Bk, Ck, ω, compliance):
    """Vectors of dσ = -Re(aᵀ(dG K + G dK)b) at ω, and dσ/dω, σ, the relative gap to σ_2.

    A, B, C (k, ...) and ω (k,) are one a loop; vectors are columns, (k, n, 1). The last loops,
    where `compliance` is True, are of S G: b is S G v and -(I + KG)⁻¹ v stands for K b.
    """
    jω = 1j * ω[:, None, None]
    M, Mk = jω * np.eye(A.shape[-1]) - A, jω * np.eye(len(Ak)) - Ak
    GB, KB = np.linalg.solve(M, B), np.linalg.solve(Mk, Bk)
    G, K = C @ GB, Ck @ KB
    p = C.shape[1]
    S = np.linalg.inv(np.eye(p) + G @ K)
    first = compliance.count(False)
    found = _of_gain(G[:first], K[:first], S[:first], False)
    if first < len(compliance):
        last = _of_gain(G[first:], K[first:], S[first:], True)
        found = tuple(np.concatenate(both) for both in zip(found, last, strict=True))
    s, gap, a, b, Kb = found
    aG = _transpose(G) @ a
    lG, rG = np.linalg.solve(_transpose(M), _transpose(C) @ a), GB @ Kb
    lK, rK = np.linalg.solve(_transpose(Mk), Ck.T @ aG), KB @ b
    # dG/dω = -j C M⁻² B, dK/dω likewise
    slope = (1j * ((lG * rG).sum((1, 2)) + (lK * rK).sum((1, 2)))).real
    return a, b, Kb, aG, lG, rG, lK, rK, slope, s, gap


def _of_gain(G, K, S, compliance):
    """σ_max of S, or of S G, the relative gap to σ_2, and a, b, K b of `_gain_cotangents`."""
    U, s, Vh = np.linalg.svd(S @ G if compliance else S)
    gap = np.ones(len(s)) if s.shape[1] == 1 else (s[:, 0] - s[:, 1]) / s[:, 0]
    a, v = _transpose(S) @ U[:, :, :1].conj(), _transpose(Vh[:, :1]).conj()
    b = S @ (G @ v if compliance else v)
    # (I + KG)⁻¹ v = v - K S G v
    return s[:, 0], gap, a, b, K @ b - v if compliance else K @ b


def loop_gradients(made_for, posed, gamma_opt, gamma_slope, loops):
    """Gradients (k, n_θ + n_w) of σ_max of S(jω) or S G(jω) of each loop, to θ and the weights.

    `gamma_slope` (n_θ + n_w) is the gradient of γ_opt. Returns besides, one a loop, the gradient
    to θ with K held, the slopes dσ/dω, σ, the relative gaps (σ1 - σ2)/σ1; and whether the
    Hamiltonian splits.
    """
    plant, backoff = made_for.plant, made_for.backoff
    m, p, count = plant.B.shape[1], plant.C.shape[0], plant.dA.shape[0]
    gp, H0, back = posed
    Ag, B1, B2, C1, C2, d1, d2 = gp
    gamma = backoff * gamma_opt
    t = gamma**2 - d1**2
    T11, U1, U2, _, ok = stable_subspace(level_hamiltonian(H0, B1, C1, d1, t))
    if not ok:
        none = np.full((len(loops), gamma_slope.size), nan)
        return none, none[:, :count], none[:, 0], none[:, 0], none[:, 0], False
    inverse = np.linalg.inv(U1)
    X = U2 @ inverse
    X = 0.5 * (X + X.T)
    F = -(B2.T @ X + d2 * C1[p : p + m]) / d2**2
    plants = (np.array([getattr(loop.plant, name) for loop in loops]) for name in "ABC")
    ω = np.array([loop.omega for loop in loops])
    a, b, Kb, aG, lG, rG, lK, rK, slopes, gains, gaps = _gain_cotangents(
        *plants, Ag + B2 @ F - B1 @ C2, B1, F, ω, [loop.compliance for loop in loops]
    )
    direct = -_outer(lG, rG), -_outer(lG, Kb), -_outer(a, rG)
    h = aG + B2.T @ lK
    XrK = X @ rK
    X_ = B2 @ _outer(h, rK) / d2**2
    X_ = 0.5 * (X_ + _transpose(X_))
    right = -(inverse @ X_) @ inverse.T
    Lh = np.array([lyapunov_triangular(T11, part, False) for part in right])
    terms, level = _riccati_terms(T11, U1, U2, Lh, gp, t)
    rate = 1j * ω[:, None, None] * rK
    through_K = terms._replace(
        A=terms.A - _outer(lK, rK),
        A_rate=terms.A_rate - _outer(lK, rate),
        B1=terms.B1 - _outer(lK, b - C2 @ rK),
        B2=terms.B2 + _outer(XrK, h) / d2**2 - _outer(lK, F @ rK),
        C2=_outer(B1.T @ lK, rK),
    )
    *through, w_ = back.to_plant_and_weights(through_K)
    held = _contract(direct, [_changes(loop.plant) for loop in loops])
    out = (2.0 * gamma * backoff * level)[:, None] * gamma_slope
    out[:, :count] += held + _contract(through, [_changes(plant)])
    out[:, count:] += w_ + back.gain_to_weights(h, rK, XrK, rate)
    return out, held, slopes, gains, gaps, True


def _changes(plant):
    return plant.dA, plant.dB, plant.dC


def _outer(x, y):
    """Re x yᵀ of columns."""
    return (x * _transpose(y)).real


def _contract(cotangents, changes):
    """Σ_ij cotangent[k, i, j] change[θ, i, j] over A, B and C, (k, θ); changes one a k, or one."""
    rows = np.concatenate([part.reshape(len(part), -1) for part in cotangents], axis=1)
    flat = [
        np.concatenate([d.reshape(len(d), c[0].size) for c, d in zip(cotangents, of, strict=True)],
                       axis=1)
        for of in changes
    ]  # fmt: skip
    if len(flat) == 1:
        return rows @ flat[0].T
    return np.array([change @ row for row, change in zip(rows, flat, strict=True)])


def figure_gradients(
    made_for: MadeFor, row: Array, grid: Array, sigma: Array, loops: Sequence[LoopAt]
) -> tuple[Array, Array, Array, Array, bool]:
    """Differentiate (ω_b, ln‖S‖∞, ln σ_max(S(jω_low)), γ_opt); the controller moves with its plant.

    Gradients are NaN where the Hamiltonian does not split, where the design is not certified or
    needed balanced coordinates, and without loops.

    Parameters
    ----------
    made_for : MadeFor
        The design plant.
    row : array
        The synthesis on it.
    grid, sigma : arrays
        Its frequencies and gains.
    loops : sequence of LoopAt
        Where ω_b, the peak and ω_low are taken, on that plant or others; ln σ of a fourth one is
        before γ_opt in the result.

    Returns
    -------
    gradients : array (4, n_θ + n_w)
        To θ, then to the scaled weights, with δ at the end where δ > 0.
    held : array (n_θ,)
        Of ω_b with K held, which is the paper's.
    gaps : array
        Of the largest singular values.
    to_gamma : array (n_θ + n_w,)
        Of γ_opt.
    splits : bool
        Whether the Hamiltonian splits.
    """
    count = made_for.plant.dA.shape[0]
    total = count + made_for.w.size + (made_for.delta > 0.0)
    none = (np.full((len(loops) + 1, total), nan), np.full(count, nan), np.full(len(loops), nan))
    to_gamma = np.full(total, nan)
    if row[Column.CODE] != Code.CERTIFIED or row[Column.BALANCED]:
        return *none, to_gamma, True
    with np.errstate(all="ignore"):  # an undefined number is seen in the result
        posed, gamma_opt, ok = _pose(made_for), float(row[Column.GAMMA_OPT]), True
        if row[Column.LIMITED_BY_BOUND] > 0.5:
            *slopes, to_weights = _bound_gradient(made_for, grid, sigma)
        else:
            *slopes, to_weights, ok = gamma_gradient(posed, gamma_opt)
        if not ok:
            return *none, to_gamma, False
        to_theta = _contract([part[None] for part in slopes], [_changes(made_for.plant)])[0]
        to_gamma = np.concatenate([to_theta, to_weights])
        if not loops:
            return *none, to_gamma, True
        found, held, slopes, gains, gaps, ok = loop_gradients(
            made_for, posed, gamma_opt, to_gamma, loops
        )
        if not ok:
            return *none, to_gamma, False
        # ω_b by the implicit function theorem; a peak's own frequency drops out (envelope)
        scale = np.array([-slopes[0], *gains[1:]])
        out = np.vstack([found / scale[:, None], to_gamma])
        return out, -held[0] / slopes[0], gaps, to_gamma, True


def peak_gradients(
    made_for: MadeFor, row: Array, gamma_slope: Array, loops: Sequence[LoopAt]
) -> Array:
    """Differentiate ln σ_max(S(jω)) at local maxima over ω, whose frequencies drop out (envelope).

    Parameters
    ----------
    made_for, row, loops
        As in `figure_gradients`.
    gamma_slope : array
        Its `to_gamma`.

    Returns
    -------
    array (k, n_θ + n_w)
        NaN where there are none.
    """
    with np.errstate(all="ignore"):
        found, _, _, gains, _, ok = loop_gradients(
            made_for, _pose(made_for), float(row[Column.GAMMA_OPT]), gamma_slope, loops
        )
    return found / gains[:, None] if ok else found


def _bound_gradient(made_for, grid, sigma):
    """Gradients of γ_jω to A, B, C and the weights, at its peak."""
    plant, w, _, delta = made_for
    A, B, C = plant.A, plant.B, plant.C
    near, least = gamma_lower_bound(prepare(A, B, C), w, grid, sigma)[1], True
    if delta:
        _, near, least = disturbance_bound(A, B, C, w, delta, grid)
    at = bound_peak(A, B, C, w, delta, near, least)
    *parts, w_, to_delta = bound_gradient(A, B, C, w, delta, at, least)
    return *parts, np.append(w_, to_delta) if delta else w_


def _pose(made_for):
    """The generalized plant, its Hamiltonian at γ = ∞, and the way back to plant and weights."""
    plant, w, _, delta = made_for
    A, B, C = plant.A, plant.B, plant.C
    if delta:
        Y, _ = filter_solution(A, B, C, delta)
        gp, back = innovations_plant(A, B, C, w, Y), FourBlockPullback(A, B, C, w, Y, delta)
    elif modes := unstable_modes(A, C):
        gp, back = unstable_plant(A, B, C, w, modes), UnstablePullback(A, B, C, w, modes)
    else:
        gp, back = generalized_plant(A, B, C, w), MixedPullback(A, B, C, w)
    return gp, lqr_hamiltonian(gp), back
