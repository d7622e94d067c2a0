"""Descent on a function that is the largest of smooth pieces, of which a point shows one alone.

    min t + ½ dᵀH d   s.t.  J_i + g_iᵀ(z + d - z_i) <= t,   λ + ∇λ d <= 0,
                            |d| <= Δ,   0 <= z + d <= 1

over the pieces that were met near the best point z: a bundle method with a trust region (Schramm
and Zowe, 1992). Where a step does not hold what the pieces promise the point that it led to shows
one more. Pieces that would lie above J(z), as they do where J is not convex, are lowered to it. H
learns from their combination Σ μ_i g_i, which is what is smooth of ∇J along a kink.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from ccd_casadi.optim.quadratic import solve_quadratic
from ccd_casadi.optim.quasi_newton import damped_bfgs
from ccd_casadi.support.arrays import Array

FIRST, LARGEST, LEAST = 1e-2, 0.2, 1e-10  # of the box: radii
NEAR = 4.0  # radii from the best point within which a piece counts
PIECES = 8  # per variable, at most
BENT = 0.5  # of the largest slope, per share of the box: by what a piece is lowered, at least
RESTORED = 5  # Newton's steps back to λ <= 0
INSIDE = 1e-10  # of λ
CURVED = (1e-4, 1e-8)  # of d and t, in the programme's own units: its answer is then one point
JUMP = 10.0  # times the slopes on both sides: what is steeper is no kink
BESIDE = 1e-3  # of the box: so near by no other piece is as steep

Constraints = Callable[[Array], tuple[Array, Array]]


@dataclass(frozen=True)
class Local:
    """J and its gradient (n,) at z (n,) in the unit box; of one piece, where there is a kink."""

    z: Array
    value: float
    gradient: Array


@dataclass(frozen=True)
class _Step:
    """d, by how much the pieces promise that J falls, and their combination Σ μ_i g_i."""

    change: Array
    promised: float
    gradient: Array


def jumps(a: Local, b: Local) -> bool:
    """Whether J is not continuous between two points near by, as the slopes at both tell."""
    away = float(np.abs(b.z - a.z).max())
    steepest = max(float(np.abs(one.gradient).sum()) for one in (a, b))
    return away < BESIDE and abs(b.value - a.value) > JUMP * steepest * away


def descend(
    at: Callable[[Array], Local | None],
    start: Local,
    known: Sequence[Local],
    constraints: Constraints,
    *,
    steps: int,
    settled: float,
) -> Local:
    """The best point after at most `steps` new ones, where the pieces promise no more, or beside a
    jump of J.

    `at` gives None where J is not known; `constraints` λ (m,) and ∇λ (m, n). `settled` is relative
    to J. `known` are further points that were met before; `start` keeps λ <= 0.
    """
    best, pieces, radius = start, [start, *known], FIRST
    H = np.zeros((start.z.size, start.z.size))
    step = _step(best, pieces, constraints, radius, H)
    for _ in range(steps):
        if radius < LEAST or (step is not None and step.promised <= settled * abs(best.value)):
            break
        if step is None:  # that tells nothing of an optimum: a programme of its own, nearer by
            H, radius = np.zeros_like(H), 0.5 * radius
            step = _step(best, pieces, constraints, radius, H)
            continue
        z = _restored(np.clip(best.z + step.change, 0.0, 1.0), constraints)
        there = None if z is None else at(z)
        gained = -np.inf if there is None else best.value - there.value
        length = float(np.abs(step.change).max())
        if gained < 0.1 * step.promised:
            radius = 0.5 * min(radius, length)
        elif gained > 0.7 * step.promised and length > 0.9 * radius:
            radius = min(2.0 * radius, LARGEST)
        if there is not None:
            if gained < 0.0 and jumps(best, there):
                break
            pieces.append(there)
        if there is not None and gained > 0.0:
            moved, best = there.z - best.z, there
            after = _step(best, pieces, constraints, radius, H)
            if after is not None:
                H = _learnt(H, moved, step.gradient, after.gradient)
        step = _step(best, pieces, constraints, radius, H)
    return best


def _learnt(H: Array, moved: Array, before: Array, after: Array) -> Array:
    change = after - before
    if not H.any():
        seen = abs(float(moved @ change)) / float(moved @ moved)
        H = max(seen, 1e-3 * float(np.abs(after).max())) * np.eye(len(H))
    return damped_bfgs(H, moved, change) if H.any() else H


def _step(
    best: Local, pieces: Sequence[Local], constraints: Constraints, radius: float, H: Array
) -> _Step | None:
    """None where the programme is not solved."""
    n = best.z.size
    size = max(float(np.abs(best.gradient).max()), 1e-300)
    away = np.array([best.z - piece.z for piece in pieces])
    far = np.abs(away).max(axis=1)
    chosen = [i for i in np.argsort(far, kind="stable")[: PIECES * n] if far[i] <= NEAR * radius]
    slopes, away = np.array([pieces[i].gradient for i in chosen]), away[chosen]
    value = np.array([pieces[i].value for i in chosen]) + (slopes * away).sum(axis=1)
    below = np.maximum(best.value - value, BENT * size * (away**2).sum(axis=1))
    g, jacobian = constraints(best.z)
    # In steps of one radius, over which J changes by about size·radius.
    m, rows = len(chosen), len(chosen) + len(g)
    A = np.zeros((rows, n + 1))
    A[:m, :n], A[:m, n], A[m:, :n] = slopes / size, -1.0, jacobian
    upper = np.append(below / (size * radius), np.maximum(-g - INSIDE, 0.0) / radius)
    low = np.append(np.maximum(-1.0, -best.z / radius), -10.0 * n)
    high = np.append(np.minimum(1.0, (1.0 - best.z) / radius), 10.0 * n)
    hessian = np.diag(np.append(np.full(n, CURVED[0]), CURVED[1]))
    hessian[:n, :n] += radius / size * H
    found = solve_quadratic(hessian, np.eye(n + 1)[n], A, upper, low, high)
    if found is None:
        return None
    mu = found.multipliers[:m]
    d = radius * np.clip(found.x[:n], low[:n], high[:n])
    promised = -size * radius * float(found.x[n]) - 0.5 * float(d @ H @ d)
    return _Step(d, promised, mu @ slopes / max(float(mu.sum()), 1e-300))


def _restored(z: Array, constraints: Constraints) -> Array | None:
    """The point, moved to λ <= 0 by as little as its slopes tell; None where that fails."""
    for _ in range(RESTORED):
        g, jacobian = constraints(z)
        broken = g > 0.0
        if not broken.any():
            return z
        shift = np.linalg.lstsq(jacobian[broken], g[broken] + INSIDE, rcond=None)[0]
        z = np.clip(z - shift, 0.0, 1.0)
    return None
