"""State space of the closed loop, and of what of it the reference can reach.

An observer-based controller carries a copy of the weighted plant: with z = [x; W1; W2; W3] the
difference z - x_K then obeys an equation of its own, which r does not enter. Those states drop
out of every transfer function from r. Whether they do is read off the loop's own entries, not
taken from the synthesis; a controller of any other form keeps its full order.
"""

import numpy as np

from ccd_casadi.kernels.blocks import add, place
from ccd_casadi.kernels.compiled import compiled, inlined
from ccd_casadi.kernels.generalized_plant import first_order_weights

EPS = 2.220446049250313e-16


@compiled
def loop_matrices(A, B, C, Ak, Bk, Ck, Dk):
    """State space of S = (I + GK)⁻¹, r to e, states [x; x_K]; D = I."""
    n, N = A.shape[0], Ak.shape[0]
    p = C.shape[0]
    As, Bs, Cs = np.empty((n + N, n + N)), np.empty((n + N, p)), np.zeros((p, n + N))
    BD = B @ Dk
    place(As, 0, 0, 1.0, A)
    add(As, 0, 0, -1.0, BD @ C)
    place(As, 0, n, 1.0, B @ Ck)
    place(As, n, 0, -1.0, Bk @ C)
    place(As, n, n, 1.0, Ak)
    place(Bs, 0, 0, 1.0, BD)
    place(Bs, n, 0, 1.0, Bk)
    place(Cs, 0, 0, -1.0, C)
    return As, Bs, Cs


@inlined
def pole_rounding(A):
    """What rounding may move an eigenvalue of A by: a pole closer to the axis may lie on it.

    10 eps ‖A‖_F, for eigenvalues that are well conditioned; poles of loops have 1e4 times that.
    """
    return 10.0 * EPS * np.sqrt((A * A).sum())


@inlined
def weighted_loop(A, B, C, Ak, Bk, Ck, Dk, w, delta):
    """State space of r to [W1 e; W2 u; W3 y], states [x; x_K; W1; W2; W3].

    With δ > 0 of (r, d) to [W1 e; W2 u; W3 u].
    """
    n, own, p, m = A.shape[0], A.shape[0] + Ak.shape[0], C.shape[0], B.shape[1]
    f = first_order_weights(w)
    As, Bs, Cs = loop_matrices(A, B, C, Ak, Bk, Ck, Dk)
    count, inputs = (p + 2 * m, p + m) if delta > 0.0 else (2 * p + m, p)
    # what the weights see, e, u and y or u again, of states and inputs
    C_seen, D_seen = np.zeros((count, own)), np.zeros((count, inputs))
    DC = Dk @ C
    place(C_seen, 0, 0, 1.0, Cs)
    for i in range(p):
        D_seen[i, i] = 1.0
    for first in range(p, count if delta > 0.0 else p + m, m):
        place(C_seen, first, 0, -1.0, DC)
        place(C_seen, first, n, 1.0, Ck)
        place(D_seen, first, 0, 1.0, Dk)
    Az, Bz = np.zeros((own + count, own + count)), np.zeros((own + count, inputs))
    Cz, Dz = np.zeros((count, own + count)), np.zeros((count, inputs))
    place(Az, 0, 0, 1.0, As)
    place(Bz, 0, 0, 1.0, Bs)
    if delta > 0.0:
        place(Bz, 0, p, delta, B)
    else:
        place(C_seen, p + m, 0, 1.0, C)
    for i in range(count):
        a, b, c, d = f[0 if i < p else 1 if i < p + m else 2]
        for j in range(own):
            Az[own + i, j], Cz[i, j] = b * C_seen[i, j], d * C_seen[i, j]
        for j in range(inputs):
            Bz[own + i, j], Dz[i, j] = b * D_seen[i, j], d * D_seen[i, j]
        Az[own + i, own + i], Cz[i, own + i] = -a, c
    return Az, Bz, Cz, Dz


@inlined
def reachable_loop(loop, n, N):
    """The weighted loop without z - x_K where that difference is cut off from r, and whether.

    n, N: states of plant and controller. With Az = [[Zz, Zk], [Kz, Kk]] in (z, x_K) the
    difference d = z - x_K obeys

        ḋ = (Zz - Kz) d + (Zz + Zk - Kz - Kk) x_K + (Bz - Bk) r.

    It counts as cut off where every entry of the last two terms is rounding of the entries that
    it is the sum of: dropping it is then a perturbation of each entry of the controller by no
    more than the rounding with which that entry was computed.
    """
    Az, Bz, Cz, Dz = loop
    if Az.shape[0] != 2 * N:
        return loop, False
    p, rows = Bz.shape[1], Cz.shape[0]
    tolerance = 4.0 * N * EPS
    for i in range(N):
        zi, ki = (i if i < n else N + i), n + i
        for j in range(N):
            zj, kj = (j if j < n else N + j), n + j
            a, b, c, d = Az[zi, zj], Az[zi, kj], Az[ki, zj], Az[ki, kj]
            if not abs(a + b - c - d) <= tolerance * (abs(a) + abs(b) + abs(c) + abs(d)):
                return loop, False
        for j in range(p):
            a, b = Bz[zi, j], Bz[ki, j]
            if not abs(a - b) <= tolerance * (abs(a) + abs(b)):
                return loop, False
    Ar, Cr = np.empty((N, N)), np.empty((rows, N))
    for j in range(N):
        zj, kj = (j if j < n else N + j), n + j
        for i in range(N):
            Ar[i, j] = Az[n + i, zj] + Az[n + i, kj]
        for i in range(rows):
            Cr[i, j] = Cz[i, zj] + Cz[i, kj]
    return (Ar, Bz[n : n + N].copy(), Cr, Dz), True
