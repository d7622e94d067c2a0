"""Upper bound of the structured singular value of complex scalars, by diagonal scalings.

    μ(M) <= min over positive diagonal D of σ_max(D M D⁻¹)

In x = ln d the logarithm of σ_max is convex (Sezginer and Overton 1990), and so is that of the
Schatten norm of order 2p that stands in for it here, because it is smooth:

    ln σ_max <= F_p = ln Σ_j σ_j^2p / 2p <= ln σ_max + ln n / 2p,
    ∂F_p/∂x_i = Σ_j w_j (|u_ij|² - |v_ij|²),   w_j = σ_j^2p / Σ σ^2p.

Many matrices are treated at once: balanced (Osborne 1960), then by BFGS with growing p. The bound
given is σ_max itself at the best D, so it holds however far the search came, which always ends.
"""

import numpy as np
from numpy.typing import NDArray

from ccd_casadi.support.arrays import Array

SWEEPS = 10  # of balancing
BALANCED = 1e-4  # of a step in ln d that ends it
ORDERS = (16.0, 256.0, 4096.0)  # p; what the last leaves is below ln n / 8192
STEPS = 60  # of BFGS for each p
FLAT = 1e-7  # a predicted decrease of ln σ_max that is none
HALVINGS = 30


def balanced_bound(M: NDArray) -> Array:
    """σ_max(D M D⁻¹) of matrices (k, n, n) balanced by D: at most a few per cent too large."""
    return _largest(M, _balanced(M))


def mu_bound(M: NDArray) -> Array:
    """The least σ_max(D M D⁻¹) of every one of the matrices (k, n, n), to about 1e-4.

    >>> float(mu_bound(np.array([[[0.0, 4.0], [1.0, 0.0]]]))[0].round(6))
    2.0
    """
    x = _balanced(M)
    best = _largest(M, x)
    if M.shape[1] == 1:
        return best
    for p in ORDERS:
        x = _minimised(M, x, p)
        best = np.minimum(best, _largest(M, x))
    return best


def _balanced(M: NDArray) -> Array:
    """x (k, n): every row of e^x M e^-x as long as its column, off the diagonal."""
    size = np.abs(M) ** 2
    n = size.shape[1]
    size[:, np.arange(n), np.arange(n)] = 0.0
    x = np.zeros(size.shape[:2])
    tiny = np.finfo(float).tiny
    for _ in range(SWEEPS):
        moved = 0.0
        for i in range(n):
            row, column = size[:, i, :].sum(axis=1), size[:, :, i].sum(axis=1)
            live = (row > tiny) & (column > tiny)
            factor = np.sqrt(np.where(live, column, 1.0) / np.where(live, row, 1.0))
            size[:, i, :] *= factor[:, None]
            size[:, :, i] /= factor[:, None]
            step = 0.5 * np.log(factor)
            x[:, i] += step
            moved = max(moved, float(np.abs(step).max(initial=0.0)))
        if moved < BALANCED:
            break
    return x - x.mean(axis=1, keepdims=True)


def _scaled(M: NDArray, x: Array) -> NDArray:
    return np.exp(x[:, :, None] - x[:, None, :]) * M


def _largest(M: NDArray, x: Array) -> Array:
    return np.linalg.svd(_scaled(M, x), compute_uv=False)[:, 0]


def _smooth(M: NDArray, x: Array, p: float) -> tuple[Array, Array]:
    """F_p (k,) and its gradient (k, n)."""
    U, s, Vh = np.linalg.svd(_scaled(M, x))
    top = np.maximum(s[:, :1], np.finfo(float).tiny)
    w = (s / top) ** (2.0 * p)
    total = w.sum(axis=1, keepdims=True)
    value = np.log(top[:, 0]) + np.log(total[:, 0]) / (2.0 * p)
    share = np.abs(U) ** 2 - np.abs(Vh.transpose(0, 2, 1)) ** 2
    return value, (share * (w / total)[:, None, :]).sum(axis=2)


def _minimised(M: NDArray, x: Array, p: float) -> Array:
    """BFGS on F_p from x, all matrices at once; those that are done drop out."""
    k, n = x.shape
    found = x.copy()
    rows = np.arange(k)
    H = np.broadcast_to(np.eye(n), (k, n, n)).copy()
    f, g = _smooth(M, x, p)
    for _ in range(STEPS):
        d = -np.einsum("kij,kj->ki", H, g)
        slope = np.einsum("ki,ki->k", d, g)
        live = -slope > FLAT
        if not live.any():
            break
        rows, M, x, H = rows[live], M[live], x[live], H[live]
        f, g, d, slope = f[live], g[live], d[live], slope[live]
        t = np.minimum(1.0, 2.0 / np.abs(d).max(axis=1))  # no factor above e² at a step
        waiting = np.ones(len(x), dtype=bool)
        new, f_new, g_new = x.copy(), f.copy(), g.copy()
        for _ in range(HALVINGS):
            at = np.flatnonzero(waiting)
            trial = x[at] + t[at, None] * d[at]
            f_trial, g_trial = _smooth(M[at], trial, p)
            good = f_trial <= f[at] + 1e-4 * t[at] * slope[at]
            taken = at[good]
            new[taken], f_new[taken], g_new[taken] = trial[good], f_trial[good], g_trial[good]
            waiting[taken] = False
            t[waiting] *= 0.5
            if not waiting.any():
                break
        s, y = new - x, g_new - g
        H = _updated(H, s, y)
        x, f, g = new, f_new, g_new
        found[rows] = x
        going = ~waiting  # no step goes down: as far as rounding lets it
        rows, M, x, H, f, g = rows[going], M[going], x[going], H[going], f[going], g[going]
        if not len(rows):
            break
    return found


def _updated(H: Array, s: Array, y: Array) -> Array:
    """The BFGS update of inverse Hessians (k, n, n); kept where the curvature is not positive."""
    sy = np.einsum("ki,ki->k", s, y)
    good = sy > 1e-12 * np.linalg.norm(s, axis=1) * np.linalg.norm(y, axis=1)
    rho = np.where(good, 1.0 / np.where(good, sy, 1.0), 0.0)[:, None, None]
    V = np.eye(H.shape[1]) - rho * s[:, :, None] * y[:, None, :]
    made = V @ H @ V.transpose(0, 2, 1) + rho * s[:, :, None] * s[:, None, :]
    return np.where(good[:, None, None], made, H)
