"""The independent proof of a design: closed-loop poles, and ‖[W1 S; W2 KS; W3 T]‖∞ twice.

Nothing here comes from the synthesis but the controller's matrices: the loop is rebuilt from
plant and controller, the weights enter as transfer functions in the frequency sweep and as
their own states in the Hamiltonian test.

With disturbances it is ‖[W1 I; W2 K; W3 K] S [I  δG]‖∞ on a refined grid and by the weighted loop's
Hamiltonian: neither the filter's solution nor the spectral factor is used. That part is plain NumPy
around compiled responses and eigenvalues.
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
ZOOMS, POINTS = 8, 9  # each narrows the bracket of a peak to a quarter


@compiled
def _stack(g, k, Dk, w, ω):
    """σ_max of [W1 S; W2 K S; W3 T] from the responses of plant and controller at one ω."""
    W1, W2, W3 = squared_weights(w, ω)
    p = g.shape[0]
    if p == 1:
        T, u2 = 0.0j, 0.0
        for i in range(k.shape[0]):
            u = k[i, 0] + Dk[i, 0]
            u2 += u.real**2 + u.imag**2
            T += g[0, i] * u
        T2, D2 = T.real**2 + T.imag**2, (1.0 + T.real) ** 2 + T.imag**2
        return np.sqrt((W1 + W2 * u2 + W3 * T2) / D2)
    k = add_real(k, Dk)
    L = multiply(g, k)
    M = L.copy()
    for i in range(p):
        M[i, i] += 1.0
    S = invert(M)
    Z = np.zeros((p, p), np.complex128)
    add_gram(Z, S, W1)
    add_gram(Z, multiply(k, S), W2)
    add_gram(Z, multiply(L, S), W3)
    return np.sqrt(largest_eigenvalue(Z))


@compiled
def stack_gain(G, K, Dk, w, ω):
    """σ_max of [W1 S; W2 K S; W3 T](jω), from the transfer functions."""
    return _stack(response(G, ω), response(K, ω), Dk, w, ω)


@compiled
def stack_gains(G, K, Dk, w, ω):
    """The stack's gain at every ω of an array."""
    g, k = responses(G, ω), responses(K, ω)
    out = np.empty(ω.size)
    for i in range(ω.size):
        out[i] = _stack(g[i], k[i], Dk, w, ω[i])
    return out


@compiled
def stack_norm(G, K, Dk, w, grid):
    """sup over ω of the stack's gain: the grid, then successive parabolas at its top peaks."""
    n = grid.size
    values = stack_gains(G, K, Dk, w, grid)
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
            f = stack_gain(G, K, Dk, w, np.exp(new))
            a, fa, x, fx, b, fb = narrow(a, fa, x, fx, b, fb, new, f)
        if fx > best:
            best, at = fx, np.exp(x)
    return best, at


@compiled
def level_test(G, K, Dk, w, loop, level):
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
        return stack_gain(G, K, Dk, w, 1.0) <= level
    # Between two neighbouring candidates the sign of gain - level cannot change.
    for i in range(n + 1):
        if i == 0:
            ω = 0.5 * candidates[0]
        elif i == n:
            ω = 2.0 * candidates[n - 1]
        else:
            ω = np.sqrt(candidates[i - 1] * candidates[i])
        if not stack_gain(G, K, Dk, w, ω) <= level:
            return False
    # A candidate beside the axis may stand at a narrow crossing; on it the gain is the level.
    for i in range(n):  # noqa: SIM110 (numba has no all())
        if not stack_gain(G, K, Dk, w, candidates[i]) <= level * (1.0 + 1e-9):
            return False
    return True


def four_block_gains(G, K, Dk, w, delta, omega):
    """σ_max of the stack at every ω (k,), from the transfer functions of prepared G and K."""
    g, k = responses(G, omega), responses(K, omega) + Dk
    W1, W2, W3 = squared_weights(w, omega)
    if g.shape[1:] == (1, 1):
        g, k = g[:, 0, 0], k[:, 0, 0]
        effort = W1 + (W2 + W3) * np.abs(k) ** 2
        return np.sqrt(effort * (1.0 + np.abs(delta * g) ** 2)) / np.abs(1.0 + g * k)
    one = np.broadcast_to(np.eye(g.shape[1]), (len(g), g.shape[1], g.shape[1]))
    right = np.linalg.solve(one + g @ k, np.concatenate([one, delta * g], axis=2))
    error, force = np.sqrt(W1)[:, None, None], np.sqrt(W2 + W3)[:, None, None]
    stack = np.concatenate([error * right, force * (k @ right)], axis=1)
    return np.linalg.norm(stack, 2, axis=(1, 2))


def four_block_norm(G, K, Dk, w, delta, grid):
    """sup over ω of the stack's gain, and where: the grid, its highest peaks zoomed into."""
    values = four_block_gains(G, K, Dk, w, delta, grid)
    i = int(np.argmax(values))
    best, at = float(values[i]), float(grid[i])
    top, x = best, np.log(grid)
    left, here, right = values[:-2], values[1:-1], values[2:]
    for i in np.flatnonzero((here >= left) & (here > right)):
        # as in `certificate.stack_norm`: no parabola is trusted with the highest peaks
        room = promised(x[i], left[i], x[i + 1], here[i], x[i + 2], right[i])
        if here[i] < REFINED_FROM * top and here[i] + 2.0 * room < 0.9999 * top:
            continue
        low, high = grid[i], grid[i + 2]
        for _ in range(ZOOMS):
            trial = np.linspace(low, high, POINTS)
            found = four_block_gains(G, K, Dk, w, delta, trial)
            k = int(np.clip(found.argmax(), 1, POINTS - 2))
            low, high = trial[k - 1], trial[k + 1]
            if found[k] > best:
                best, at = float(found[k]), float(trial[k])
            elif found[k] - found.min() < 1e-10 * best:
                break
    return best, at


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


def four_block_level_test(G, K, Dk, w, delta, loop, level):
    """Whether the Hamiltonian of the weighted loop shows no gain above `level`.

    As in `certificate.level_test`: eigenvalues near the axis are candidates, the gain decides.
    """
    Dz = loop[3]
    if np.linalg.norm(Dz, 2) >= level:
        return False
    candidates, info = axis_frequencies(*loop, level)
    if info != 0:
        return False
    if not candidates.size:
        return bool(four_block_gains(G, K, Dk, w, delta, np.ones(1))[0] <= level)
    between = np.sqrt(candidates[:-1] * candidates[1:])
    between = np.concatenate([[0.5 * candidates[0]], between, [2.0 * candidates[-1]]])
    gains = four_block_gains(G, K, Dk, w, delta, np.concatenate([between, candidates]))
    allowed = level * np.repeat([1.0, 1.0 + 1e-9], [between.size, candidates.size])
    return bool((gains <= allowed).all())
