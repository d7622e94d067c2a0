"""The four-block problem: reference and input disturbance in, one filter equation, one γ search.

    ‖[W1 I; W2 K; W3 K] S [I  δG]‖∞,   δ = W_d/M_K in the units of the scaled plant,

bounds S, GS, KS and KSG at once (for one channel KSG = T). Every weighted output is a function of
e and u, which the controller knows, so that the filter equation does not depend on γ,

    A Y + Y Aᵀ + δ² B Bᵀ - Y CᵀC Y = 0,

and with N = I + C(s - A)⁻¹YCᵀ, the spectral factor of [I δG][I δG]^~ = N N^~, the problem is one
of a single Riccati equation for the same plant with the reference entering through B1 = -YCᵀ too:
in it D21 = I, A - B1 C2 is the filter's own, stable, and everything of `riccati` and `gamma` holds.
Its solution is X̂ = X(I - YX/γ²)⁻¹ with X of the four-block problem, so that X̂ >= 0 is X >= 0 and
ρ(XY) < γ² in one (Doyle, Glover, Khargonekar & Francis 1989; Glover & Doyle 1988, for D11).

Plain NumPy around the compiled search.
"""

import numpy as np

from ccd_casadi.kernels.bound_peak import bound_terms
from ccd_casadi.kernels.frequency import prepare, responses
from ccd_casadi.kernels.generalized_plant import MixedPlant, first_order_weights, squared_weights
from ccd_casadi.kernels.lapack import stable_subspace

EDGE = 0.95  # squared: a peak of the bound below this share of the highest is not refined
AT_REST = np.concatenate([[0.0], np.geomspace(1e-9, 5e-6, 8)])  # over ω₀: where W1 is largest
ZOOMS, POINTS = 4, 17  # each narrows the bracket of a peak to an eighth


def filter_solution(A, B, C, delta):
    """Y (n, n), and whether the filter's Hamiltonian splits: A - YCᵀC is then stable."""
    H = np.block([[A.T, -C.T @ C], [-(delta**2) * (B @ B.T), -A]])
    _, U1, U2, _, ok = stable_subspace(np.ascontiguousarray(H))
    if not ok:
        return np.full_like(A, np.nan), False
    Y = np.linalg.solve(U1.T, U2.T)
    return 0.5 * (Y + Y.T), True


def four_block_plant(A, B, C, w, delta):
    """A, B1, B2, C1, C2, D11, D12 of (r, d) to [W1 e; W2 u; W3 u]; states [plant; W1; W2; W3]."""
    n, m, p = A.shape[0], B.shape[1], C.shape[0]
    f, channels = first_order_weights(w), [p, m, m]
    N = n + p + 2 * m
    pole, into, out, direct = (np.repeat(f[:, k], channels) for k in range(4))
    twice = np.vstack([np.eye(m), np.eye(m)])
    Ag, B1, B2 = np.zeros((N, N)), np.zeros((N, p + m)), np.zeros((N, m))
    Ag[:n, :n], Ag[n:, n:], Ag[n : n + p, :n] = A, -np.diag(pole), -f[0, 1] * C
    B1[:n, p:], B1[n : n + p, :p] = delta * B, f[0, 1] * np.eye(p)
    B2[:n], B2[n + p :] = B, into[p:, None] * twice
    C1, D11, D12 = np.zeros((p + 2 * m, N)), np.zeros((p + 2 * m, p + m)), np.zeros((p + 2 * m, m))
    C1[:, n:], C1[:p, :n] = np.diag(out), -f[0, 3] * C
    D11[:p, :p], D12[p:] = f[0, 3] * np.eye(p), direct[p:, None] * twice
    return Ag, B1, B2, C1, np.hstack([-C, np.zeros((p, N - n))]), D11, D12


def innovations_plant(A, B, C, w, Y):
    """The plant of the equivalent problem; states as in `four_block_plant`.

    z = [W1 e; (d2 z2 + d3 z3)/d; (d2 z3 - d3 z2)/d] with d² = d2² + d3²: turned so that the
    feedthrough of u is [0; d I; 0], as the kernels of the first kind take it.
    """
    n, m, p = A.shape[0], B.shape[1], C.shape[0]
    Ag, B1, B2, C1, C2, D11, D12 = four_block_plant(A, B, C, w, 0.0)
    B1 = np.ascontiguousarray(B1[:, :p])
    B1[:n] = -Y @ C.T
    d2, d3 = D12[p, 0], D12[p + m, 0]
    d = np.hypot(d2, d3)
    C1[p:] = np.kron(np.array([[d2, d3], [-d3, d2]]) / d, np.eye(m)) @ C1[p:]
    return MixedPlant(Ag, B1, B2, C1, C2, float(D11[0, 0]), float(d))


# ---- what no controller passes ------------------------------------------------------------------


def _bounds(G, w, delta, omega):
    """γ_jω² (2, k) along the directions of the largest and least gain of G."""
    g = responses(G, omega)
    sigma = np.abs(g[:, 0]) if g.shape[1:] == (1, 1) else np.linalg.svd(g, compute_uv=False)
    p, m = G[2].shape[0], G[1].shape[1]
    ends = np.array([sigma[:, 0], sigma[:, -1] if m >= p else np.zeros(omega.size)])
    W1, W2, W3 = squared_weights(w, omega)
    return bound_terms(W1, W2, W3, ends, delta).value


def disturbance_bound(A, B, C, w, delta, grid):
    """γ_jω, the ω over ω₀ where it is attained, and whether along the least gain (else largest)."""
    G = prepare(A, B, C)
    grid = np.concatenate([AT_REST, grid])
    values = np.nan_to_num(_bounds(G, w, delta, grid), nan=0.0)  # a pole at 0
    top, at = values.max(), np.unravel_index(int(values.argmax()), values.shape)
    best = float(top), float(grid[at[1]]), bool(at[0])
    inner = values[:, 1:-1]
    peaks = (inner >= values[:, :-2]) & (inner > values[:, 2:]) & (inner > EDGE * top)
    for branch, i in zip(*np.nonzero(peaks), strict=True):
        low, high = grid[i], grid[i + 2]
        for _ in range(ZOOMS):
            trial = np.linspace(low, high, POINTS)
            found = _bounds(G, w, delta, trial)[branch]
            k = int(np.clip(found.argmax(), 1, POINTS - 2))
            low, high = trial[k - 1], trial[k + 1]
            if found[k] > best[0]:
                best = float(found[k]), float(trial[k]), bool(branch)
    return float(np.sqrt(best[0])), *best[1:]
