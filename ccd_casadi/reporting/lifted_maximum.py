"""ω_b*(θ) from the lifted surrogates: the largest ω_b over (ω_S, ω_T) within S_max and S_low.

The fields over (ω_S, ω_T) are smooth, so a few Chebyshev nodes per θ carry them; the maximum
along the constraints, with its kinks and jumps in θ, is then found on the interpolant by a grid
and successive zooms from several candidates. All θ go at once.
"""

from dataclasses import dataclass

import numpy as np

from ccd_casadi.codesign.outer_problem import lifted_bounds
from ccd_casadi.inner_problem.problem import CoDesignProblem
from ccd_casadi.support.arrays import Array
from surrogates import GaussianProcess
from surrogates.gaussian_process import mean_at_many

NODES = 13  # per axis; the interpolant is then closer to the surrogate than that to the truth
COARSE = 41  # points per axis of the first grid
ZOOM = np.linspace(-1.0, 1.0, 7)
ZOOMS = 8  # each shrinks the window to a third
SLACKS = (0.0, 0.02, 0.1)  # in ln S; candidates slightly outside may lead to the best inside


@dataclass(frozen=True)
class InnerMaximum:
    """Per θ the largest bandwidth in rad/s and where, x (t, n_θ + 2); NaN where infeasible."""

    bandwidth: Array
    x: Array


def fields(
    processes: tuple[GaussianProcess, ...], thetas: Array, omega_S: Array, omega_T: Array
) -> Array:
    """ω_b and ln of each bounded figure (…, t, a, b) on the grid of ln ω_S (a,), ln ω_T (b,)."""
    t, a, b = len(thetas), len(omega_S), len(omega_T)
    pairs = np.stack(np.meshgrid(omega_S, omega_T, indexing="ij"), -1).reshape(-1, 2)
    X = np.hstack([np.repeat(thetas, a * b, axis=0), np.tile(pairs, (t, 1))])
    return np.array([mean_at_many(process, X) for process in processes]).reshape(-1, t, a, b)


def inner_maximum(
    problem: CoDesignProblem, processes: tuple[GaussianProcess, ...], thetas: Array
) -> InnerMaximum:
    """The largest surrogate bandwidth at every θ (t, n_θ), subject to every bound."""
    low, high = (bound[-2:] for bound in lifted_bounds(problem))
    nodes = np.cos(np.pi * np.arange(NODES) / (NODES - 1))
    axes = [0.5 * (low[k] + high[k]) + 0.5 * (high[k] - low[k]) * nodes for k in range(2)]
    values = fields(processes, thetas, *axes)
    limits = problem.inner.levels[:, None, None, None]
    t = np.arange(len(thetas))

    def at(u: Array, v: Array) -> tuple[Array, Array]:
        """Bandwidth and violation (t, i, j) at nodes' coordinates u (t, i), v (t, j)."""
        f = np.einsum(
            "tim,qtmn,tjn->qtij", _basis(nodes, u), values, _basis(nodes, v), optimize=True
        )
        return f[0], (f[1:] - limits).max(axis=0)

    grid = np.linspace(-1.0, 1.0, COARSE)
    flat = np.broadcast_to(grid, (len(thetas), COARSE))
    bandwidth, violation = at(flat, flat)
    best = np.full(len(thetas), -np.inf)
    where = np.full((len(thetas), 2), np.nan)
    for slack in SLACKS:
        i, j = _pick(bandwidth, violation, slack)
        u, v = grid[i], grid[j]
        half = 2.0 / (COARSE - 1)
        for _ in range(ZOOMS):
            us = np.clip(u[:, None] + half * ZOOM, -1.0, 1.0)
            vs = np.clip(v[:, None] + half * ZOOM, -1.0, 1.0)
            b, g = at(us, vs)
            i, j = _pick(b, g, 0.0)
            u, v = us[t, i], vs[t, j]
            half *= 2.0 / (len(ZOOM) - 1)
        found = np.where(g[t, i, j] <= 0.0, b[t, i, j], -np.inf)
        better = found > best
        best = np.where(better, found, best)
        where[better] = np.stack([u, v], -1)[better]
    omega = 0.5 * (low + high) + 0.5 * (high - low) * where
    return InnerMaximum(np.where(np.isfinite(best), best, np.nan), np.hstack([thetas, omega]))


def _pick(bandwidth: Array, violation: Array, slack: float) -> tuple[Array, Array]:
    """Per θ the indices of the largest bandwidth within the slack, else of the least violation."""
    merit = np.where(violation <= slack, bandwidth, -1e12 * (1.0 + np.maximum(violation, 0.0)))
    flat = merit.reshape(len(merit), -1).argmax(axis=1)
    return np.unravel_index(flat, merit.shape[1:])


def _basis(nodes: Array, points: Array) -> Array:
    """Barycentric Lagrange basis on Chebyshev points: (t, i) coordinates to (t, i, node)."""
    weights = (-1.0) ** np.arange(len(nodes))
    weights[[0, -1]] *= 0.5
    gap = points[..., None] - nodes
    hit = gap == 0.0
    terms = weights / np.where(hit, 1.0, gap)
    basis = terms / terms.sum(-1, keepdims=True)
    return np.where(hit.any(-1, keepdims=True), hit.astype(float), basis)
