"""The independent proof of a design: closed-loop poles, and ‖[W1 S; W2 KS; W3 T]‖∞ twice.

Nothing here comes from the synthesis but the controller's matrices: the loop is rebuilt from
plant and controller, the weights enter as transfer functions in the frequency sweep and as
their own states in the Hamiltonian test.

With disturbances (δ > 0) it is ‖[W1 I; W2 K; W3 K] S [I  δG]‖∞: neither the filter's solution nor
the spectral factor is used.
"""

import numpy as np

from ccd_casadi.kernels.closed_loop import loop_matrices
from ccd_casadi.kernels.compiled import compiled
from ccd_casadi.kernels.frequency import narrow, next_trial, promised, response, responses
from ccd_casadi.kernels.generalized_plant import first_order_weights, squared_weights
from ccd_casadi.kernels.sensitivity import axis_frequencies
from ccd_casadi.kernels.small import add_gram, add_real, invert, largest_eigenvalue, multiply

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
    k = add_real(k, Dk)
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
    Z = np.zeros((S.shape[1], S.shape[1]), np.complex128)
    add_gram(Z, S, W1)
    add_gram(Z, multiply(k, S), W2)
    add_gram(Z, multiply(last, S), W3)
    return np.sqrt(largest_eigenvalue(Z))


@compiled
def stack_gain(G, K, Dk, w, delta, ω):
    """σ_max of [W1 S; W2 K S; W3 T](jω), or of the four blocks, from the transfer functions."""
    return _stack(response(G, ω), response(K, ω), Dk, w, delta, ω)


@compiled
def stack_gains(G, K, Dk, w, delta, ω):
    """The stack's gain at every ω of an array."""
    g, k = responses(G, ω), responses(K, ω)
    out = np.empty(ω.size)
    for i in range(ω.size):
        out[i] = _stack(g[i], k[i], Dk, w, delta, ω[i])
    return out


@compiled
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


@compiled
def level_test(G, K, Dk, w, delta, loop, level):
    """Whether the Hamiltonian of the weighted loop shows no gain above `level`.

    Eigenvalues near the imaginary axis are candidates only; the gain in the intervals that
    they bound decides. False as well where LAPACK fails or the feedthrough exceeds the level.
    """
    Az, Bz, Cz, Dz = loop
    p = Dz.shape[1]
    gram, size = np.zeros((p, p), np.complex128), 0.0
    for k in range(Dz.shape[0]):
        for i in range(p):
            size += Dz[k, i] ** 2
            for j in range(p):
                gram[i, j] += Dz[k, i] * Dz[k, j]
    if size >= level**2 and largest_eigenvalue(gram) >= level**2:
        return False
    candidates, info = axis_frequencies(Az, Bz, Cz, Dz, level)
    if info != 0:
        return False
    n = candidates.size
    if n == 0:
        return stack_gain(G, K, Dk, w, delta, 1.0) <= level
    # Between two neighbouring candidates the sign of gain - level cannot change.
    for i in range(n + 1):
        if i == 0:
            ω = 0.5 * candidates[0]
        elif i == n:
            ω = 2.0 * candidates[n - 1]
        else:
            ω = np.sqrt(candidates[i - 1] * candidates[i])
        if not stack_gain(G, K, Dk, w, delta, ω) <= level:
            return False
    # A candidate beside the axis may stand at a narrow crossing; on it the gain is the level.
    for i in range(n):
        if not stack_gain(G, K, Dk, w, delta, candidates[i]) <= level * (1.0 + 1e-9):
            return False
    return True


def four_block_loop(A, B, C, Ak, Bk, Ck, Dk, w, delta):
    """State space of (r, d) to [W1 e; W2 u; W3 u], states [x; x_K; W1; W2; W3]."""
    n, N, m, p = A.shape[0], Ak.shape[0], B.shape[1], C.shape[0]
    f = first_order_weights(w)
    As, Bs, Cs = loop_matrices(A, B, C, Ak, Bk, Ck, Dk)
    Bs = np.hstack([Bs, np.vstack([delta * B, np.zeros((N, m))])])
    De = np.hstack([np.eye(p), np.zeros((p, m))])
    Cu, Du = np.hstack([-Dk @ C, Ck]), Dk @ De
    signals = ((Cs, De), (Cu, Du), (Cu, Du))
    poles = np.repeat(-f[:, 0], [p, m, m])
    Az = np.zeros((n + N + poles.size, n + N + poles.size))
    Az[: n + N, : n + N] = As
    Az[n + N :, n + N :] = np.diag(poles)
    Az[n + N :, : n + N] = np.vstack([b * c for b, (c, _) in zip(f[:, 1], signals, strict=True)])
    Bz = np.vstack([Bs, *(b * d for b, (_, d) in zip(f[:, 1], signals, strict=True))])
    Cz = np.hstack([
        np.vstack([d * c for d, (c, _) in zip(f[:, 3], signals, strict=True)]),
        np.diag(np.repeat(f[:, 2], [p, m, m])),
    ])  # fmt: skip
    Dz = np.vstack([d * through for d, (_, through) in zip(f[:, 3], signals, strict=True)])
    return Az, Bz, Cz, Dz
