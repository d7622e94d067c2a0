"""Total derivatives of a loop's figures on a plant other than the one its controller is made for.

With K = K(P_d, w) from the design plant P_d and the loop closed on P,

    dσ_max(S) = -Re a (dG K + G dK) b,

dG is a matter of P alone, and dK goes back through the Riccati equation of P_d as in
`kernels.gradients`, with aG and b taken on P. Both plants have one time and force unit.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ccd_casadi.kernels.figures import Code, Figure
from ccd_casadi.kernels.generalized_plant import first_order_weights, generalized_plant
from ccd_casadi.kernels.gradients import (
    _column,
    _contract,
    _gain_cotangents,
    _riccati_terms,
    _row,
)
from ccd_casadi.kernels.lapack import lyapunov_triangular, stable_subspace
from ccd_casadi.kernels.pullback import gain_to_weights, to_plant, to_weights
from ccd_casadi.kernels.riccati import level_hamiltonian, lqr_hamiltonian
from ccd_casadi.support.arrays import Array


class Loop(NamedTuple):
    """A plant with its derivatives to θ, and the frequency at which σ_max(S) is differentiated."""

    A: Array
    B: Array
    C: Array
    dA: Array
    dB: Array
    dC: Array
    omega: float


def off_design_gradients(
    A: Array, B: Array, C: Array, w: Array, backoff: float, dA: Array, dB: Array, dC: Array,
    row: Array, gamma_gradient: Array, loops: Sequence[Loop],
) -> tuple[Array, Array, Array]:  # fmt: skip
    """Gradients of (ω_b, ln‖S‖∞, ln σ_max(S(jω_low)), γ_opt), of ω_b with K held, and σ's gaps.

    The first (4, n_θ + 8), to θ and to the weights. A, B, C and their derivatives are the design
    plant's, `row` the synthesis on it with the gradient of its γ_opt; `loops` are where ω_b, the
    peak and ω_low are taken. NaN where there are none.
    """
    count = dA.shape[0]
    out, fixed, gaps = np.full((4, count + 8), np.nan), np.full(count, np.nan), np.full(3, np.nan)
    if row[Figure.CODE] != Code.CERTIFIED or row[Figure.BALANCED] or len(loops) != 3:
        return out, fixed, gaps
    gp = generalized_plant(A, B, C, w)
    Ag, B1, B2, C1, C2, d1, d2 = gp
    n, m, p = A.shape[0], B.shape[1], C.shape[0]
    H0 = lqr_hamiltonian(Ag, B2, C1, d2, p, m)
    f = first_order_weights(w)
    gamma = backoff * row[Figure.GAMMA_OPT]
    t = gamma**2 - d1**2
    T11, U1, U2, _, split = stable_subspace(level_hamiltonian(H0, B1, C1, d1, t))
    if not split:
        return out, fixed, gaps
    inverse = np.linalg.inv(U1)
    X = U2 @ inverse
    X = 0.5 * (X + X.T)
    F = -(B2.T @ X + d2 * C1[p : p + m]) / d2**2
    Ak = Ag + B2 @ F - B1 @ C2
    for i, loop in enumerate(loops):
        a, Kb, aG, lG, rG, lK, rK, slope, gain, gaps[i] = _gain_cotangents(
            loop.A, loop.B, loop.C, Ak, B1, F, loop.omega
        )
        direct = (
            _contract(-np.outer(lG, rG).real[None], loop.dA)
            + _contract(-np.outer(lG, Kb).real[None], loop.dB)
            + _contract(-np.outer(a, rG).real[None], loop.dC)
        )[0]
        h = aG + _row(lK, B2)
        XrK = _column(X, rK)
        X_ = B2 @ np.outer(h, rK).real / d2**2
        X_ = 0.5 * (X_ + X_.T)
        Lh = lyapunov_triangular(T11, -(inverse @ X_) @ inverse.T, False)
        Ar, Ar_rate, B2r, C1r, C1r_rate, level = _riccati_terms(T11, U1, U2, Lh, gp, t)
        rate = 1j * loop.omega * rK
        Ar -= np.outer(lK, rK).real
        Ar_rate -= np.outer(lK, rate).real
        B2r += (np.outer(XrK, h) / d2**2 - np.outer(lK, _column(F, rK))).real
        C2r = np.outer(_row(lK, B1), rK).real
        pa, pb, pc = to_plant(Ar, B2r, C1r, C2r, f, C, m)
        pw = to_weights(Ar, Ar_rate, C1r, C1r_rate, f, w, n, p, m)
        states = slice(n + p, n + p + m)  # of W2
        pw = pw + gain_to_weights(h, rK[states], XrK[states], rate[states], f, w)
        through = _contract(pa[None], dA) + _contract(pb[None], dB) + _contract(pc[None], dC)
        out[i] = 2.0 * gamma * backoff * level * gamma_gradient
        out[i, :count] += direct + through[0]
        out[i, count:] += pw
        if i == 0:  # ω_b by the implicit function theorem
            fixed[:] = -direct / slope
            out[i] /= -slope
        else:
            out[i] /= gain
    out[3] = gamma_gradient
    return out, fixed, gaps
