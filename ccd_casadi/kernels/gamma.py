"""γ_opt = max(γ_X, γ_jω): the root of the Riccati level f, or the bound that no controller passes.

docs/theory.md derives both; t = γ² - d1². In 1/t the Hamiltonian is affine and f nearly straight,
so that Newton's method needs fewer steps in 1/t than in t. Near the root the third-order expansion
of the stable subspace takes its place: a step of order four from one Schur form, whose own terms
show when it is good enough.
"""

from typing import NamedTuple

import numpy as np

from ccd_casadi.kernels.compiled import compiled, inlined
from ccd_casadi.kernels.frequency import narrow, next_trial, prepare, response, responses
from ccd_casadi.kernels.generalized_plant import frobenius, squared_weights
from ccd_casadi.kernels.linear_algebra import lyapunov_triangular
from ccd_casadi.kernels.riccati import riccati_level, root_nearby


class LowerBoundOptions(NamedTuple):
    """Numbers of the bound that no controller passes.

    Attributes
    ----------
    rest : float
        Share of the lowest frequency of a grid that stands for rest, where a plant may have a pole.
    refined_from : float
        Of the highest γ_jω² of the grid: a peak as high may overtake it when it is refined.
    trials : int
        Parabolas of a peak, at most.
    tolerance : float
        Of γ_jω², relative: what a further parabola may add.
    """

    rest: float = 1e-9
    refined_from: float = 0.95
    trials: int = 40
    tolerance: float = 1e-12


class OptimalGammaOptions(NamedTuple):
    """Numbers of the search for γ_opt.

    Attributes
    ----------
    forms : int
        Schur forms, at most.
    first : float
        γ over γ_jω to begin with, without a guess.
    above : float
        γ_jω itself puts eigenvalues on the axis: the test is made this far above it, of γ².
    expanded : float
        Relative step in 1/t, below which the expansion of the stable subspace is tried.
    changed : float
        It is taken where it changes Newton's step by less than this share.
    """

    forms: int = 60
    first: float = 1.3
    above: float = 1e-7
    expanded: float = 0.3
    changed: float = 0.5


OPTIONS = LowerBoundOptions()
SEARCH = OptimalGammaOptions()
BACKWARD = 8.0 * 2.0**-52  # |δH|/|H| of a Schur form; 6 eps was measured, N up to 35


@inlined
def lower_bound_squared(w, gain, ω):
    """γ_jω²(ω) = |W1|² R/(|W1|² + R), R = |W2|²/σ² + |W3|²: no controller does better at ω.

    `gain` is σ, the least gain of the plant there; without any S = I in some direction.
    """
    W1, W2, W3 = squared_weights(w, ω)
    if gain == 0.0:
        return W1
    R = W2 / gain**2 + W3
    return W1 * R / (W1 + R)


def plant_gain(A, B, C, ω):
    """Compute the least gain of a plant over output directions, σ_p(G(jω)).

    Parameters
    ----------
    A, B, C : arrays (n, n), (n, m), (p, n)
    ω : array (k,)

    Returns
    -------
    array (k,)
        0 where m < p.
    """
    if B.shape[1] < C.shape[0]:
        return np.zeros(ω.size)
    gains = np.linalg.svd(responses(prepare(A, B, C), ω), compute_uv=False)
    return np.ascontiguousarray(gains[:, -1])


@inlined
def _least_gain(g):
    """σ_p of g (p, m); 0 where m < p."""
    p, m = g.shape
    if m < p:
        return 0.0
    if m == 1:
        return abs(g[0, 0])
    return np.linalg.svd(g)[1][p - 1]


@compiled
def gamma_lower_bound(G, w, grid, sigma):
    """γ_jω = max over ω, from σ_p(G) on a grid and successive parabolas at its best peaks.

    G is the prepared plant. Rest counts where the lowest frequency has the highest value. Returns
    γ_jω and where it is.
    """
    n = grid.size
    values = np.empty(n)
    for i in range(n):
        values[i] = lower_bound_squared(w, sigma[i], grid[i])
    best, at = values[0], grid[0]
    for i in range(n):
        if values[i] > best:
            best, at = values[i], grid[i]
    top = best
    for i in range(1, n - 1):
        least = max(values[i - 1], OPTIONS.refined_from * top)
        if values[i] >= least and values[i] > values[i + 1]:
            a, x, b = np.log(grid[i - 1]), np.log(grid[i]), np.log(grid[i + 1])
            fa, fx, fb = values[i - 1], values[i], values[i + 1]
            for _ in range(OPTIONS.trials):
                new, room = next_trial(a, fa, x, fx, b, fb, OPTIONS.tolerance)
                if room == 0.0:
                    break
                ω = np.exp(new)
                f = lower_bound_squared(w, _least_gain(response(G, ω)), ω)
                a, fa, x, fx, b, fb = narrow(a, fa, x, fx, b, fb, new, f)
            if fx > best:
                best, at = fx, np.exp(x)
    if at == grid[0]:
        ω = OPTIONS.rest * grid[0]
        f = lower_bound_squared(w, _least_gain(response(G, ω)), ω)
        if f > best:
            best, at = f, ω
    return np.sqrt(best), at


@compiled
def rounding_error(frame, t, d1):
    """δγ/γ that the rounding of one Schur form leaves at the root, from a frame at t nearby.

    With f = c/s as in `riccati_level`, a change δH moves s² f by tr(Λ R),
    R = [-U2; U1]ᵀ δH [U1; U2] and T11 Λ + Λ T11ᵀ + qqᵀ = 0. With δH of |δH| = BACKWARD |H|
    spread evenly over its 2N x 2N entries, R has entries of size |δH|/2N, and their sum with Λ the
    size |Λ| |δH|/2N. Since s² f' = qᵀZq/t², t moves by that over qᵀZq/t², and δγ/γ = δt/(2 γ²).
    """
    H, T11, _, _, _, Z, q, _, _ = frame
    N = q.size
    Q = np.empty((N, N))
    for i in range(N):
        for j in range(N):
            Q[i, j] = -q[i] * q[j]
    Λ = lyapunov_triangular(T11, Q, False)
    moved = BACKWARD * frobenius(H) * frobenius(Λ) / (2.0 * N)
    return moved * t / abs(np.dot(q, Z @ q)) * t / (2.0 * (t + d1**2))


@inlined
def undecided_range(frame, t, f, slope, d1, gamma_jw):
    """Return how far above γ_jω, relative, γ_X may yet lie where f > 0 at t, a hair above; 0:
    nowhere.

    At γ_jω f begins like a square root, a + b √(t - t_jω), so that from t down to there it falls by
    b √(t - t_jω), twice what its tangent says; rounding moves it by as much as it moves a root.
    """
    size = 2.0 * (t + d1**2)  # dt = size dγ/γ
    hair = (t - (gamma_jw**2 - d1**2)) / size
    left = rounding_error(frame, t, d1)
    if slope > 0.0 and f > slope * size * (left + 2.0 * hair):
        return 0.0
    return left + hair


@compiled
def optimal_gamma(H0, B1, C1, d1, gamma_jw, guess, tolerance, noise):
    """γ_opt = max(γ_X, γ_jω) by safeguarded steps on f, one Schur form each.

    f(t) > 0 where γ is achievable: t_low has failed or is γ_jω's, t_high has been achieved. A step
    outside of them is halved between them, or doubled without t_high. γ_jω limits where a level
    just above it is achieved; that is tried as soon as a step leads there.

    `guess` starts the iteration (0: none), `noise` is the level's. Returns γ_opt, whether γ_jω
    limits, the number of Schur forms, whether it closed to the relative `tolerance` in γ, and
    the relative error that rounding and search may have left (infinite where it is not known),
    γ_jω taken as exact.
    """
    t_jw = max(gamma_jw**2 * (1 + SEARCH.above) - d1**2, 1e-12 * d1**2)
    t_low, t_high = t_jw, np.inf
    start = guess if guess > 0.0 else SEARCH.first * gamma_jw
    t = max(start**2 - d1**2, t_jw)
    tested = False
    for forms in range(1, SEARCH.forms + 1):
        f, slope, ok, frame = riccati_level(H0, B1, C1, d1, t, noise)
        if ok and f > 0.0:
            if t <= t_jw:
                left = undecided_range(frame, t, f, slope, d1, gamma_jw)
                return gamma_jw, True, forms, True, max(tolerance, left)
            t_high = min(t_high, t)
        else:
            t_low = max(t_low, t)
            tested = tested or t <= t_jw
        newton = ok and slope > 0.0
        new, error = t, np.inf
        if newton:
            step = f / (slope * t * t)  # Newton's, in 1/t
            error = abs(step)
            if error * t < SEARCH.expanded:
                better, estimate = root_nearby(B1, C1, d1, frame, step, noise)
                if abs(better - step) < SEARCH.changed * abs(step):
                    step, error = better, estimate
            new = t / (1.0 + step * t) if step * t > -1.0 else np.inf
        # relative in γ: dγ/γ = dt/(2 γ²) = -t² dσ/(2 γ²)
        if newton and new > t_jw and error * t * t <= 2.0 * tolerance * (t + d1**2):
            left = max(tolerance, rounding_error(frame, t, d1))
            return np.sqrt(new + d1**2), False, forms, True, left
        if t_high - t_low <= 2.0 * tolerance * (t_low + d1**2):
            # no root closed this: rounding alone decides here which levels pass, and how far up
            return np.sqrt(t_high + d1**2), False, forms, True, np.inf
        if newton and new <= t_jw and not tested:
            new = t_jw
        elif not (newton and t_low < new < t_high):
            new = 2.0 * t if t_high == np.inf else 0.5 * (t_low + t_high)
        t = new
    return np.sqrt(max(t, 0.0) + d1**2), False, SEARCH.forms, False, np.inf
