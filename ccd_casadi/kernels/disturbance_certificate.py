"""The proof of a design with disturbances: poles, and the norm of all blocks by two methods.

    ‖[W1 I; W2 K; W3 K] S [I  δG]‖∞ on a refined grid, and by a Hamiltonian of the weighted loop.

Nothing here comes from the synthesis but the controller's matrices: neither the filter's solution
nor the spectral factor. Plain NumPy around compiled responses and eigenvalues.
"""

import numpy as np

from ccd_casadi.kernels.certificate import REFINED_FROM
from ccd_casadi.kernels.closed_loop import loop_matrices
from ccd_casadi.kernels.frequency import responses
from ccd_casadi.kernels.generalized_plant import first_order_weights, squared_weights
from ccd_casadi.kernels.refine import promised
from ccd_casadi.kernels.sensitivity import axis_frequencies

ZOOMS, POINTS = 8, 9  # each narrows the bracket of a peak to a quarter


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
