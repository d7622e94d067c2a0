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

KEPT = 1e-7  # by how much an answer may miss its rows
INSIDE = 1e-6  # and its bounds, to which it can be moved
CURVED = 1e-8  # of a step in its own units: its answer is then one point
SLACK = 1e-3  # of the penalty: σ's curvature; with less DAQP begins so far out that it cycles
UNBOUNDED = 1e30  # what DAQP takes for infinite
QUIET = ("error_on_fail", "print_iter", "print_header", "print_info")
TOLERANCES = {"primal_tol": 1e-10, "dual_tol": 1e-12, "zero_tol": 1e-13}
AT_FIRST, ADDED = 200, 50  # rows of a programme, and those that its answer exceeds, at a time
LOST = 1e-8  # share of its factors below which a scalar product is rounding


class Answer(NamedTuple):
    """x (n,) and the multipliers (m,) of the rows."""

    x: Array
    multipliers: Array


def solve_quadratic(
    H: Array, c: Array, A: Array, upper: Array, low: Array, high: Array
) -> Answer | None:
    """min c·x + ½ xᵀ H x over low <= x <= high, A x <= upper; bounds may be infinite.

    None where neither solver keeps the rows of A (m, n), which tells nothing of x. H may be
    nearly singular.
    """
    rows, n = A.shape

    def kept(x: Array) -> bool:
        missed = np.maximum(low - x, x - high).max()
        return bool((A @ x - upper).max(initial=-np.inf) <= KEPT and missed <= INSIDE)

    above, below = np.empty(n + rows), np.full(n + rows, -UNBOUNDED)
    above[:n], above[n:] = high, upper
    np.minimum(above, UNBOUNDED, out=above)
    np.maximum(low, -UNBOUNDED, out=below[:n])
    matrix = np.ascontiguousarray(A, float)
    x, _, flag, info = daqp.solve(np.array(H, float), c, matrix, above, below, **TOLERANCES)
    if flag == 1 and kept(x):
        return Answer(x, np.maximum(info["lam"][n:], 0.0))
    solver = _interior(n, rows)
    found = solver(h=H, g=c, a=A, lba=-np.inf, uba=upper, lbx=low, ubx=high)
    x = np.array(found["x"]).ravel()
    if not solver.stats()["success"] or not kept(x):
        return None
    return Answer(x, np.maximum(np.array(found["lam_a"]).ravel(), 0.0))


def solve_elastic(
    H: Array, c: Array, slopes: Array, value: Array, elastic: Array, low: Array, high: Array,
    penalty: float, radius: float, unit: float, *, free: bool = False,
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
    hessian.ravel()[:: n + 2] += CURVED
    ends = np.full((2, n + 1), np.inf)
    ends[0, :n], ends[1, :n], ends[0, n] = low / radius, high / radius, -np.inf
    if not free:
        hessian[n, n], ends[0, n] = SLACK * penalty / unit, 0.0
    upper, held = -value / radius, np.arange(min(m, AT_FIRST))
    part: slice | np.ndarray = slice(len(held))  # the first ones are no copy
    while True:
        found = solve_quadratic(hessian, cost, A[part], upper[part], *ends)
        if found is None:
            return None
        if len(held) == m:
            break
        missed = A @ found.x - upper
        missed[part] = -np.inf
        if missed.max() <= KEPT:
            break
        worst = np.argsort(-missed)[:ADDED]
        held = part = np.concatenate([held, worst[missed[worst] > KEPT]])
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
    """H (n, n) with the curvature that a change y of the gradient along the step s shows.

    Powell's damping keeps it positive definite.
    """
    Hs = H @ s
    curvature = float(s @ Hs)
    if curvature <= 1e-16 * float(np.trace(H)):
        return H
    if s @ y < 0.2 * curvature:
        share = 0.8 * curvature / (curvature - float(s @ y))
        y = share * y + (1.0 - share) * Hs
    return np.asarray(H - np.outer(Hs, Hs) / curvature + np.outer(y, y) / float(s @ y))


def symmetric_rank_one(H: Array, s: Array, y: Array) -> Array:
    """H (n, n) with H s = y, which may curve either way; as it is where the denominator is lost."""
    rest = y - H @ s
    size = float(rest @ s)
    if abs(size) <= LOST * float(np.linalg.norm(rest) * np.linalg.norm(s)):
        return H
    return np.asarray(H + np.outer(rest, rest) / size)


def convex(H: Array, least: float) -> Array:
    """H (n, n) with its eigenvalues raised to at least `least`."""
    values, vectors = np.linalg.eigh(H)
    return np.asarray((vectors * np.maximum(values, least)) @ vectors.T)


# A constraint closer than this to its bound, in shares of its size or of the box, is active: a
# polish stops where steps change J by no more than rounding.
ACTIVE = 1e-6
STEP = 1e-4  # of the box: differences of true gradients


@dataclass(frozen=True)
class Kink:
    """What is known of a design where J of θ has more than one gradient.

    one_gradient: the residual with that of one side alone. slopes: of J to the two sides of each of
    some orthogonal directions, all that the active bounds leave; differences of true values, per
    share of the box, over ‖∇J‖∞; NaN where there is no design. multipliers: of the bounds on the
    loop by kind, change of ln of the inner value per ln of a bound. first_order: the slopes are on
    plants as they are known nearby, climbed to from the design's controller.
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

    stationarity: scaled, see the module. primal: largest violation of g or a bound, in shares.
    complementarity: largest |μ g| over ‖∇J‖∞. multipliers: per name, change of J per unit of g, or
    per unit box of a bound. second_order: least eigenvalue of the reduced Hessian of the Lagrangian
    over ‖∇J‖∞, inf at a vertex, None where it was not computed. kink: where one gradient of J is
    not all that there are.
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
    """∇J (n,), and values g (m,) and Jacobian (m, n) of constraints by name, at one z of the unit
    box; g in shares of `sizes` (m,)."""

    gradient: Array
    g: Array
    jacobian: Array
    sizes: Array
    names: tuple[str, ...]


@dataclass(frozen=True)
class ActiveSet:
    """∇J (n,) and what is within `ACTIVE` of its bound at one z of the unit box.

    rows (m, n) and slack (m,), <= 0 inside, are in shares of `sizes` (m,), one each per label; the
    first `constraints` are of g, the rest bounds. violation: the largest of all, 0 where none is.
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
    """μ >= 0 (m,) that brings rowsᵀ μ nearest to `goal` (n,), and what is missing over ‖goal‖∞."""
    mu = np.zeros(len(rows))
    if len(rows):
        mu = scipy.optimize.nnls(rows.T, goal, maxiter=100 * len(rows))[0]
    return mu, float(np.abs(goal - mu @ rows).max()) / max(float(np.abs(goal).max()), 1e-300)


def active_set(z: Array, here: FirstOrder, variables: Sequence[str]) -> ActiveSet:
    """What binds at z of the unit box: g <= 0, and the ends of `variables`."""
    at = np.flatnonzero(here.g >= -ACTIVE)
    rows, slack, units = ([*each[at]] for each in (here.jacobian, here.g, here.sizes))
    labels, count = [here.names[i] for i in at], len(at)
    for i, name in enumerate(variables):
        for end, value, sign in (("lower", -z[i], -1.0), ("upper", z[i] - 1.0, 1.0)):
            if value >= -ACTIVE:
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
    """Least eigenvalue of ZᵀHZ over `size`, columns (n, k) = HZ; inf at a vertex, None unknown."""
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
    step: float = STEP,
) -> Array | None:
    """HZ (n, k) by differences of gradients, all at once: z (2 k, n) -> (n,) of each; one-sided at
    an end of the unit box.

    None where a gradient is not known, or the box leaves less than half of a step.
    """
    ends = np.clip(z + step * np.concatenate([directions.T, -directions.T]), 0.0, 1.0)
    found = [slope for slope in slopes(ends) if slope is not None]
    ups, downs = np.split(ends, 2)
    spans = np.linalg.norm(ups - downs, axis=1)
    if len(found) < len(ends) or (spans < 0.5 * step).any():
        return None
    above, below = np.split(np.array(found), 2)
    return np.asarray(((above - below) / spans[:, None]).T)
