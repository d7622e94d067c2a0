"""The independent proof of a design: closed-loop poles, and ‖[W1 S; W2 KS; W3 T]‖∞ twice.

Nothing here comes from the synthesis but the controller's matrices: the loop is rebuilt from
plant and controller, the weights enter as transfer functions in the frequency sweep and as
their own states in the Hamiltonian test.

With disturbances (δ > 0) it is ‖[W1 I; W2 K; W3 K] S [I  δG]‖∞: neither the filter's solution nor
the spectral factor is used.
"""

import numpy as np

from ccd_casadi.kernels.blocks import add, frobenius, place
from ccd_casadi.kernels.compiled import compiled, inlined
from ccd_casadi.kernels.frequency import narrow, next_trial, promised, response, responses
from ccd_casadi.kernels.generalized_plant import squared_weights
from ccd_casadi.kernels.sensitivity import axis_frequencies
from ccd_casadi.kernels.small import invert, largest_singular, multiply

REFINED_FROM = 0.95  # of the largest gain on the grid: a peak this high is refined in any case
REFINEMENTS = 40  # trials a peak; some six are used


@compiled
def _stack(g, k, Dk, w, delta, ω):
    """σ_max of the stack from the responses of plant and controller at one ω."""
    W1, W2, W3 = squared_weights(w, ω)
    p, m = g.shape
    if p == 1:
        T, u2, g2 = 0.0j, 0.0, 0.0
        for i in range(m):
            u, v = k[i, 0] + Dk[i, 0], g[0, i]
            u2 += u.real**2 + u.imag**2
            g2 += v.real**2 + v.imag**2
            T += v * u
        T2, D2 = T.real**2 + T.imag**2, (1.0 + T.real) ** 2 + T.imag**2
        if delta > 0.0:
            return np.sqrt((W1 + (W2 + W3) * u2) * (1.0 + delta**2 * g2) / D2)
        return np.sqrt((W1 + W2 * u2 + W3 * T2) / D2)
    add(k, 0, 0, 1.0, Dk)
    L = multiply(g, k)
    M = L.copy()
    for i in range(p):
        M[i, i] += 1.0
    S = invert(M)
    last = L
    if delta > 0.0:
        SG, last = multiply(S, g), k
        wide = np.zeros((p, p + m), np.complex128)
        for i in range(p):
            for j in range(p):
                wide[i, j] = S[i, j]
            for j in range(m):
                wide[i, p + j] = delta * SG[i, j]
        S = wide
    KS, last = multiply(k, S), multiply(last, S)
    Z = np.empty((p + KS.shape[0] + last.shape[0], S.shape[1]), np.complex128)
    place(Z, 0, 0, np.sqrt(W1), S)
    place(Z, p, 0, np.sqrt(W2), KS)
    place(Z, p + KS.shape[0], 0, np.sqrt(W3), last)
    return largest_singular(Z)


@compiled
def stack_gain(G, K, Dk, w, delta, ω):
    """σ_max of [W1 S; W2 K S; W3 T](jω), or of the four blocks, from the transfer functions."""
    return _stack(response(G, ω), response(K, ω), Dk, w, delta, ω)


@inlined
def stack_gains(G, K, Dk, w, delta, ω):
    """The stack's gain at every ω of an array."""
    g, k = responses(G, ω), responses(K, ω)
    out = np.empty(ω.size)
    for i in range(ω.size):
        out[i] = _stack(g[i], k[i], Dk, w, delta, ω[i])
    return out


@inlined
def stack_norm(G, K, Dk, w, delta, grid):
    """sup over ω of the stack's gain: the grid, then successive parabolas at its top peaks."""
    n = grid.size
    values = stack_gains(G, K, Dk, w, delta, grid)
    best, at = 0.0, 0.0
    for i in range(n):
        if not values[i] <= best:
            best, at = values[i], grid[i]
    top = best
    for i in range(1, n - 1):
        left, right = values[i - 1], values[i + 1]
        if values[i] < left or values[i] <= right:
            continue
        a, x, b = np.log(grid[i - 1]), np.log(grid[i]), np.log(grid[i + 1])
        fa, fx, fb = left, values[i], right
        for trial in range(REFINEMENTS):
            # The parabola's promise is trusted to half, and not at all while the points stand
            # wide: between two of the grid a peak was 1.2 % higher where it promised 0.06 %.
            promise = fx + 2.0 * promised(a, fa, x, fx, b, fb)
            if promise < 0.9999 * top and (trial > 1 or fx < REFINED_FROM * top):
                break
            new, room = next_trial(a, fa, x, fx, b, fb, 1e-9)
            if room == 0.0:
                break
            f = stack_gain(G, K, Dk, w, delta, np.exp(new))
            a, fa, x, fx, b, fb = narrow(a, fa, x, fx, b, fb, new, f)
        if fx > best:
            best, at = fx, np.exp(x)
    return best, at


@inlined
def level_test(G, K, Dk, w, delta, loop, level):
    """Whether the Hamiltonian of the weighted loop shows no gain above `level`.

    Eigenvalues near the imaginary axis are candidates only; the gain in the intervals that
    they bound decides. False as well where LAPACK fails or the feedthrough exceeds the level.
    """
    Az, Bz, Cz, Dz = loop
    if frobenius(Dz) >= level and largest_singular(Dz.astype(np.complex128)) >= level:
        return False
    candidates, info = axis_frequencies(Az, Bz, Cz, Dz, level)
    if info != 0:
        return False
    n = candidates.size
    if n == 0:
        return stack_gain(G, K, Dk, w, delta, 1.0) <= level
    # Between two neighbouring candidates the sign of gain - level cannot change.
    for i in range(n + 1):
        ω = 0.5 * candidates[0] if i == 0 else 2.0 * candidates[n - 1]
        if 0 < i < n:
            ω = np.sqrt(candidates[i - 1] * candidates[i])
        if not stack_gain(G, K, Dk, w, delta, ω) <= level:
            return False
    # A candidate beside the axis may stand at a narrow crossing; on it the gain is the level.
    for i in range(n):
        if not stack_gain(G, K, Dk, w, delta, candidates[i]) <= level * (1.0 + 1e-9):
            return False
    return True
