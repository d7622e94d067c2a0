"""Upper bound of the structured singular value of complex scalars, by diagonal scalings.

    μ(M) <= min over positive diagonal D of σ_max(D M D⁻¹)

D is the one that balances M (Osborne 1960): every row as long as its column. It bounds μ as any D
does; the best one was up to 8 % better on what a study asks for.
"""

import numpy as np
from numpy.typing import NDArray

from ccd_casadi.support.arrays import Array

SWEEPS = 10  # of balancing
BALANCED = 1e-4  # of a step in ln d that ends it


def mu_bound(M: NDArray) -> Array:
    """σ_max(D M D⁻¹) of every one of the matrices (k, n, n), balanced by D.

    >>> float(mu_bound(np.array([[[0.0, 4.0], [1.0, 0.0]]]))[0].round(6))
    2.0
    """
    x = _balanced(M)
    scaled = np.exp(x[:, :, None] - x[:, None, :]) * M
    return np.linalg.svd(scaled, compute_uv=False)[:, 0]


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
