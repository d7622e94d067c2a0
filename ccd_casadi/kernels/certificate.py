"""The independent proof of a design: closed-loop poles, and ‖[W1 S; W2 KS; W3 T]‖∞ twice.

Nothing here comes from the synthesis but the controller's matrices: the loop is rebuilt from
plant and controller, the weights enter as transfer functions in the frequency sweep and as
their own states in the Hamiltonian test.
"""

import numpy as np
from numba import njit

from ccd_casadi.kernels.frequency import response
from ccd_casadi.kernels.generalized_plant import first_order_weights, weight_magnitudes
from ccd_casadi.kernels.sensitivity import axis_frequencies


@njit(cache=True)
def weighted_loop(A, B, C, Ak, Bk, Ck, Dk, w):
    """State space of r to [W1 e; W2 u; W3 y], states [x; x_K; W1; W2; W3]."""
    n, N, p, m = A.shape[0], Ak.shape[0], C.shape[0], B.shape[1]
    f = first_order_weights(w)
    i1, i2 = n + N, n + N + p
    i3 = i2 + m
    total = i3 + p
    Az, Bz = np.zeros((total, total)), np.zeros((total, p))
    Cz, Dz = np.zeros((2 * p + m, total)), np.zeros((2 * p + m, p))
    DC = Dk @ C
    Az[:n, :n] = A - B @ DC
    Az[:n, n:i1] = B @ Ck
    Az[n:i1, :n] = -Bk @ C
    Az[n:i1, n:i1] = Ak
    Bz[:n, :] = B @ Dk
    Bz[n:i1, :] = Bk
    Az[i1:i2, :n] = -f[0, 1] * C
    Az[i2:i3, :n] = -f[1, 1] * DC
    Az[i2:i3, n:i1] = f[1, 1] * Ck
    Bz[i2:i3, :] = f[1, 1] * Dk
    Az[i3:, :n] = f[2, 1] * C
    Cz[:p, :n] = -f[0, 3] * C
    Cz[p : p + m, :n] = -f[1, 3] * DC
    Cz[p : p + m, n:i1] = f[1, 3] * Ck
    Dz[p : p + m, :] = f[1, 3] * Dk
    Cz[p + m :, :n] = f[2, 3] * C
    for i in range(p):
        Az[i1 + i, i1 + i] = -f[0, 0]
        Bz[i1 + i, i] = f[0, 1]
        Cz[i, i1 + i] = f[0, 2]
        Dz[i, i] = f[0, 3]
        Az[i3 + i, i3 + i] = -f[2, 0]
        Cz[p + m + i, i3 + i] = f[2, 2]
    for i in range(m):
        Az[i2 + i, i2 + i] = -f[1, 0]
        Cz[p + i, i2 + i] = f[1, 2]
    return Az, Bz, Cz, Dz


@njit(cache=True)
def stack_gain(G, K, Dk, w, ω):
    """σ_max of [W1 S; W2 K S; W3 T](jω), from the transfer functions."""
    W1, W2, W3 = weight_magnitudes(w, ω)
    g = response(G, ω)
    k = response(K, ω) + Dk
    L = g @ k
    p = L.shape[0]
    if p == 1:
        u2 = 0.0
        for i in range(k.shape[0]):
            u2 += abs(k[i, 0]) ** 2
        T2 = abs(L[0, 0]) ** 2
        return np.sqrt(W1**2 + W2**2 * u2 + W3**2 * T2) / abs(1.0 + L[0, 0])
    M = L.copy()
    for i in range(p):
        M[i, i] += 1.0
    S = np.linalg.inv(M)
    U, T = k @ S, L @ S
    Z = W1**2 * (S.conj().T @ S) + W2**2 * (U.conj().T @ U) + W3**2 * (T.conj().T @ T)
    return np.sqrt(np.linalg.eigvalsh(Z)[p - 1])


@njit(cache=True)
def stack_norm(G, K, Dk, w, grid):
    """sup over ω of the stack's gain: the grid, then a golden-section search at its top peaks."""
    n = grid.size
    values = np.empty(n)
    best, at = 0.0, 0.0
    for i in range(n):
        values[i] = stack_gain(G, K, Dk, w, grid[i])
        if not values[i] <= best:
            best, at = values[i], grid[i]
    top = best
    for i in range(1, n - 1):
        left, right = values[i - 1], values[i + 1]
        if values[i] < left or values[i] <= right:
            continue
        # A parabola through three points tells how much a peak can gain.
        bend = 2.0 * values[i] - left - right
        if bend > 0.0 and values[i] + 0.25 * (right - left) ** 2 / bend < 0.9999 * top:
            continue
        a, b = np.log(grid[i - 1]), np.log(grid[i + 1])
        r = 0.5 * (np.sqrt(5.0) - 1.0)
        x1, x2 = b - r * (b - a), a + r * (b - a)
        f1 = stack_gain(G, K, Dk, w, np.exp(x1))
        f2 = stack_gain(G, K, Dk, w, np.exp(x2))
        for _ in range(25):
            if f1 > f2:
                b, x2, f2 = x2, x1, f1
                x1 = b - r * (b - a)
                f1 = stack_gain(G, K, Dk, w, np.exp(x1))
            else:
                a, x1, f1 = x1, x2, f2
                x2 = a + r * (b - a)
                f2 = stack_gain(G, K, Dk, w, np.exp(x2))
        if max(f1, f2) > best:
            best, at = (f1, np.exp(x1)) if f1 > f2 else (f2, np.exp(x2))
    return best, at


@njit(cache=True)
def level_test(G, K, Dk, w, loop, level):
    """Whether the Hamiltonian of the weighted loop shows no gain above `level`.

    Eigenvalues near the imaginary axis are candidates only; the gain in the intervals that
    they bound decides. False as well where LAPACK fails or the feedthrough exceeds the level.
    """
    Az, Bz, Cz, Dz = loop
    if np.linalg.norm(Dz) >= level and np.linalg.svd(Dz)[1][0] >= level:
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
    return True
