"""Quadratic programmes, and the conditions of optimality by active sets."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import casadi as ca
import daqp
import numpy as np
import scipy
from scipy.linalg import null_space

from ccd_casadi.support.arrays import Array

QUIET = ("error_on_fail", "print_iter", "print_header", "print_info")


@dataclass(frozen=True)
class QuadraticOptions:
    """Numbers of quadratic programmes, in the units in which they are solved."""

    row_error: float = 1e-7  # by how much a solution may exceed its rows
    bound_error: float = 1e-6  # and its bounds, to which it can be moved
    primal: float = 1e-10  # DAQP's tolerances
    dual: float = 1e-12
    zero: float = 1e-13
    unbounded: float = 1e30  # what DAQP takes for infinite
    curvature: float = 1e-8  # of a step: its solution is then one point
    slack_curvature: float = 1e-3  # of σ over the penalty; with less DAQP starts far out and cycles
    first_rows: int = 200  # of a programme
    added_rows: int = 50  # at a time, of those that its solution exceeds


class QuadraticSolution(NamedTuple):
    """x (n,) and the multipliers (m,) of the rows."""

    x: Array
    multipliers: Array


def solve_quadratic(
    H: Array, c: Array, A: Array, upper: Array, low: Array, high: Array,
    options: QuadraticOptions = QuadraticOptions(),
) -> QuadraticSolution | None:  # fmt: skip
    """min c·x + ½ xᵀ H x over low <= x <= high, A x <= upper; bounds may be infinite.

    None where neither solver keeps the rows of A (m, n), which says nothing of x. H may be
    nearly singular.
    """
    (rows, n), unbounded = A.shape, options.unbounded

    def kept(x: Array) -> bool:
        missed = np.maximum(low - x, x - high).max()
        error = (A @ x - upper).max(initial=-np.inf)
        return bool(error <= options.row_error and missed <= options.bound_error)

    above, below = np.empty(n + rows), np.full(n + rows, -unbounded)
    above[:n], above[n:] = high, upper
    np.minimum(above, unbounded, out=above)
    np.maximum(low, -unbounded, out=below[:n])
    matrix = np.ascontiguousarray(A, float)
    x, _, flag, info = daqp.solve(
        np.array(H, float), c, matrix, above, below, primal_tol=options.primal,
        dual_tol=options.dual, zero_tol=options.zero,
    )  # fmt: skip
    if flag == 1 and kept(x):
        return QuadraticSolution(x, np.maximum(info["lam"][n:], 0.0))
    solver = _interior(n, rows)
    found = solver(h=H, g=c, a=A, lba=-np.inf, uba=upper, lbx=low, ubx=high)
    x = np.array(found["x"]).ravel()
    if not solver.stats()["success"] or not kept(x):
        return None
    return QuadraticSolution(x, np.maximum(np.array(found["lam_a"]).ravel(), 0.0))


def solve_elastic(
    H: Array, c: Array, slopes: Array, value: Array, elastic: Array, low: Array, high: Array,
    penalty: float, radius: float, unit: float, *, free: bool = False,
    options: QuadraticOptions = QuadraticOptions(),
) -> tuple[Array, Array] | None:  # fmt: skip
    """p (n,) and the multipliers (m,) of the rows of a trust-region step:

        min c·p + ½ pᵀ H p + ρ σ    over  low <= p <= high, 0 <= σ,    value + slopes·p <= elastic σ

    σ is by how much the rows are left exceeded (l∞ penalty; Fletcher 1987, section 12.4), so that
    there is a solution where all are elastic; with `free` it may be negative. Solved in steps of
    one radius and with `unit`, the size of c or ρ, as one: the solvers' tolerances mean the same at
    every radius. Of thousands of rows the first are solved for, and then those too that the answer
    leaves exceeded, until there is none. None as in `solve_quadratic`.
    """
    m, n = slopes.shape
    A, hessian, cost = np.empty((m, n + 1)), np.zeros((n + 1, n + 1)), np.empty(n + 1)
    A[:, :n], A[:, n] = slopes, -elastic
    hessian[:n, :n], cost[:n], cost[n] = radius / unit * H, c / unit, penalty / unit
    hessian.ravel()[:: n + 2] += options.curvature
    ends = np.full((2, n + 1), np.inf)
    ends[0, :n], ends[1, :n], ends[0, n] = low / radius, high / radius, -np.inf
    if not free:
        hessian[n, n], ends[0, n] = options.slack_curvature * penalty / unit, 0.0
    upper, held = -value / radius, np.arange(min(m, options.first_rows))
    part: slice | np.ndarray = slice(len(held))  # the first ones are no copy
    while True:
        found = solve_quadratic(hessian, cost, A[part], upper[part], ends[0], ends[1], options)
        if found is None:
            return None
        if len(held) == m:
            break
        missed = A @ found.x - upper
        missed[part] = -np.inf
        if missed.max() <= options.row_error:
            break
        worst = np.argsort(-missed)[: options.added_rows]
        held = part = np.concatenate([held, worst[missed[worst] > options.row_error]])
    multipliers = np.zeros(m)
    multipliers[held] = unit * found.multipliers
    return radius * np.clip(found.x[:n], *ends[:, :n]), multipliers


@lru_cache(maxsize=256)
def _interior(n: int, rows: int) -> ca.Function:
    shapes = {"h": ca.Sparsity.dense(n, n), "a": ca.Sparsity.dense(rows, n)}
    options: dict[str, bool | str] = dict.fromkeys(QUIET, False)
    options["linear_solver"] = "qr"  # an LDL factorisation would warn on the terminal
    return ca.conic("programme", "ipqp", shapes, options)


def damped_bfgs(H: Array, s: Array, y: Array) -> Array:
    """Update a Hessian by the curvature of a step, positive definite (BFGS, Powell's damping).

    Parameters
    ----------
    H, s, y : array (n, n), (n,), (n,)
        The step s changes the gradient by y.

    Returns
    -------
    array (n, n)

    References
    ----------
    J. Nocedal and S. J. Wright, Numerical Optimization, procedure 18.2.
    """
    Hs = H @ s
    curvature = float(s @ Hs)
    if curvature <= 1e-16 * float(np.trace(H)):
        return H
    if s @ y < 0.2 * curvature:
        share = 0.8 * curvature / (curvature - float(s @ y))
        y = share * y + (1.0 - share) * Hs
    return np.asarray(H - np.outer(Hs, Hs) / curvature + np.outer(y, y) / float(s @ y))


def symmetric_rank_one(H: Array, s: Array, y: Array, *, least: float = 1e-8) -> Array:
    """Update a Hessian so that H s = y, which may curve either way (SR1).

    Parameters
    ----------
    H, s, y : array (n, n), (n,), (n,)
        The step s changes the gradient by y.
    least : float
        Denominator over its factors below which it is rounding, and H stays as it is.

    Returns
    -------
    array (n, n)
    """
    rest = y - H @ s
    size = float(rest @ s)
    if abs(size) <= least * float(np.linalg.norm(rest) * np.linalg.norm(s)):
        return H
    return np.asarray(H + np.outer(rest, rest) / size)


def convex(H: Array, least: float) -> Array:
    """H (n, n) with its eigenvalues raised to at least `least`."""
    values, vectors = np.linalg.eigh(H)
    return np.asarray((vectors * np.maximum(values, least)) @ vectors.T)


@dataclass(frozen=True)
class KktOptions:
    """Numbers of the conditions of optimality.

    Attributes
    ----------
    active : float
        Shares of its size or the box: a closer constraint is active; a polish stops where
        steps change J by rounding.
    step : float
        Of the box: differences of true gradients.
    """

    active: float = 1e-6
    step: float = 1e-4


@dataclass(frozen=True)
class Kink:
    """A design where J of θ has more than one gradient.

    Attributes
    ----------
    one_gradient : float
        The residual with the gradient of one side alone.
    slopes : tuple of pairs
        Of J to the two sides of each of some orthogonal directions, all that the active bounds
        leave: differences of true values, per share of the box, over ‖∇J‖∞; NaN without a design.
    multipliers : dict
        Of the bounds on the loop by kind: change of ln of the inner value per ln of a bound.
    first_order : bool
        The slopes are on plants to first order nearby, climbed to from the design's controller.
    """

    one_gradient: float
    slopes: tuple[tuple[float, float], ...]
    multipliers: dict[str, float]
    first_order: bool = False

    @property
    def least_slope(self) -> float:
        """The least of the slopes that are known; NaN where none is."""
        known = [slope for pair in self.slopes for slope in pair if np.isfinite(slope)]
        return min(known, default=float("nan"))


@dataclass(frozen=True)
class KktCertificate:
    """Residuals of the true optimality conditions at a verified design.

    Attributes
    ----------
    stationarity : float
        ‖∇J + Σ μ ∇g‖∞ over ‖∇J‖∞.
    primal : float
        The largest violation of g or a bound, in shares.
    complementarity : float
        The largest |μ g| over ‖∇J‖∞.
    multipliers : dict
        By name: change of J per unit of g, or per unit box of a bound.
    active : tuple of str
    second_order : float or None
        Least eigenvalue of the reduced Hessian of the Lagrangian over ‖∇J‖∞; inf at a vertex, None
        where it was not computed.
    objective_gradient : tuple of float (n,)
        ∇J per unit box.
    kink : Kink or None
        Where J has more than one gradient.
    """

    stationarity: float
    primal: float
    complementarity: float
    multipliers: dict[str, float]
    active: tuple[str, ...]
    second_order: float | None
    objective_gradient: tuple[float, ...]
    kink: Kink | None = None


@dataclass(frozen=True)
class FirstOrder:
    """First derivatives of J and of constraints g at one z of the unit box.

    Attributes
    ----------
    gradient : array (n,)
        ∇J.
    g, jacobian : array (m,), (m, n)
        In shares of `sizes`.
    sizes, names : array (m,), tuple of str
    """

    gradient: Array
    g: Array
    jacobian: Array
    sizes: Array
    names: tuple[str, ...]


@dataclass(frozen=True)
class ActiveSet:
    """The active constraints and bounds at one z of the unit box.

    Attributes
    ----------
    gradient : array (n,)
        ∇J.
    rows, slack, sizes : array (m, n), (m,), (m,)
        Slopes and values, <= 0 inside, in shares of the sizes.
    labels : tuple of str
    constraints : int
        So many of the first rows are of g, the others of bounds.
    violation : float
        The largest of all constraints, active or not; 0 where none is violated.
    """

    gradient: Array
    rows: Array
    slack: Array
    sizes: Array
    labels: tuple[str, ...]
    constraints: int
    violation: float

    @property
    def size(self) -> float:
        """‖∇J‖∞."""
        return max(float(np.abs(self.gradient).max()), 1e-300)

    def multipliers(self) -> Array:
        """The best μ >= 0 (m,), per share."""
        return non_negative(self.rows, -self.gradient)[0]

    def residual(self, mu: Array) -> float:
        """‖∇J + Aᵀμ‖∞/‖∇J‖∞."""
        return float(np.abs(self.gradient + mu @ self.rows).max()) / self.size

    def free(self, mu: Array) -> Array:
        """Orthonormal directions (n, k) that leave what has a multiplier as it is."""
        return np.asarray(null_space(self.rows[mu > 0.0]))

    def certificate(
        self, mu: Array, residual: float, second: float | None, kink: Kink | None = None
    ) -> KktCertificate:
        """What was found, with multipliers per unit of g."""
        per_unit = zip(self.labels, mu / self.sizes, strict=True)
        return KktCertificate(
            stationarity=residual,
            primal=self.violation,
            complementarity=float(np.abs(mu * self.slack).max(initial=0.0)) / self.size,
            multipliers={name: float(value) for name, value in per_unit},
            active=self.labels,
            second_order=second,
            objective_gradient=tuple(map(float, self.gradient)),
            kink=kink,
        )


def non_negative(rows: Array, goal: Array) -> tuple[Array, float]:
    """Find the multipliers μ >= 0 with the least ‖rowsᵀ μ - goal‖₂.

    Parameters
    ----------
    rows, goal : array (m, n), (n,)

    Returns
    -------
    mu : array (m,)
    residual : float
        ‖rowsᵀ μ - goal‖∞ over ‖goal‖∞.
    """
    mu = np.zeros(len(rows))
    if len(rows):
        mu = scipy.optimize.nnls(rows.T, goal, maxiter=100 * len(rows))[0]
    return mu, float(np.abs(goal - mu @ rows).max()) / max(float(np.abs(goal).max()), 1e-300)


def active_set(
    z: Array, here: FirstOrder, variables: Sequence[str], *, active: float = KktOptions.active
) -> ActiveSet:
    """Collect what binds at a point of the unit box.

    Parameters
    ----------
    z, here : array (n,), FirstOrder
    variables : sequence of str (n,)
        Names of the components of z, by which their bounds are labelled.
    active : float
        Shares of its size or of the box within which a constraint g <= 0 or a bound binds.

    Returns
    -------
    ActiveSet
    """
    at = np.flatnonzero(here.g >= -active)
    rows, slack, units = ([*each[at]] for each in (here.jacobian, here.g, here.sizes))
    labels, count = [here.names[i] for i in at], len(at)
    for i, name in enumerate(variables):
        for end, value, sign in (("lower", -z[i], -1.0), ("upper", z[i] - 1.0, 1.0)):
            if value >= -active:
                rows.append(sign * np.eye(z.size)[i])
                labels.append(f"{name} {end}")
                slack.append(value)
                units.append(1.0)
    violation = max(0.0, float((-z).max()), float((z - 1.0).max()), *here.g)
    matrix = np.array(rows).reshape(-1, z.size)
    return ActiveSet(
        here.gradient, matrix, np.array(slack), np.array(units), tuple(labels), count, violation
    )


def reduced_curvature(Z: Array, columns: Array | None, size: float) -> float | None:
    """Find the least eigenvalue of the reduced Hessian ZᵀHZ.

    Parameters
    ----------
    Z, columns : array (n, k), (n, k) or None
        Free directions; HZ, None or NaN where it is not known.
    size : float
        What the eigenvalue is divided by.

    Returns
    -------
    float or None
        inf at a vertex (k = 0), None where HZ is not known.
    """
    if Z.shape[1] == 0:
        return np.inf
    if columns is None or not np.isfinite(columns).all():
        return None
    H = Z.T @ columns
    return float(np.linalg.eigvalsh(0.5 * (H + H.T)).min()) / size


def hessian_products(
    slopes: Callable[[Array], Sequence[Array | None]],
    z: Array,
    directions: Array,
    step: float = KktOptions.step,
) -> Array | None:
    """Multiply a Hessian by directions: differences of gradients, one-sided at an end of the box.

    Parameters
    ----------
    slopes : callable
        Gradients at many points: z (2k, n) to 2k arrays (n,), None where one is not known.
    z, directions : array (n,), (n, k)
        In the unit box; Z.
    step : float
        Of the box.

    Returns
    -------
    array (n, k) or None
        HZ; None where a gradient is not known, or the box leaves less than half of a step.
    """
    ends = np.clip(z + step * np.concatenate([directions.T, -directions.T]), 0.0, 1.0)
    found = [slope for slope in slopes(ends) if slope is not None]
    ups, downs = np.split(ends, 2)
    spans = np.linalg.norm(ups - downs, axis=1)
    if len(found) < len(ends) or (spans < 0.5 * step).any():
        return None
    above, below = np.split(np.array(found), 2)
    return np.asarray(((above - below) / spans[:, None]).T)
