"""Certificate of first- and second-order optimality on the true problem.

    min J(x) = w1 f(θ) + w2 ω_b(x),  x = (θ, ln ω_S, ln ω_T),
    g(x) = (ln‖S‖∞ - ln S_max, ln σ_max(S(jω_low)) - ln S_low, λ(θ)) <= 0,  bounds,

and ln‖GS‖∞ - ln compliance_max where that is given, with the total derivatives of the true
synthesis. Variables are scaled to the unit box, and the residual to the gradient of J: r = ‖∇J +
Aᵀμ‖∞/‖∇J‖∞ with μ >= 0 by non-negative least squares.

‖S‖∞ has a kink where two local peaks are equal (or two plants of a robust set), and ω_b jumps where
a local maximum of σ_max(S) below it reaches -3 dB. Where the plain conditions fail, every such peak
within `ACTIVE` is a constraint of its own.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from scipy.linalg import null_space
from scipy.optimize import nnls

from ccd_casadi.codesign.outer_problem import lifted_bounds
from ccd_casadi.codesign.peak_constraints import PeakConstraint, other_peaks
from ccd_casadi.inner_problem.constraints import ACTIVE, constraint_sizes
from ccd_casadi.inner_problem.problem import CoDesignProblem, plant_of
from ccd_casadi.plants.plant import constraint_values, hardware_slopes
from ccd_casadi.support.arrays import Array
from ccd_casadi.synthesis.derivatives import Sensitivities

# The polish stops where steps no longer change J by more than rounding; a constraint closer
# than ACTIVE (in logarithm, or share of the box or its size) is one that it runs along.
STEP = 1e-4  # of the box: differences of true gradients
SMOOTH = 1e-6  # residual up to which nothing speaks of a kink


@dataclass(frozen=True)
class Kink:
    """What is known of a design where J of θ has more than one gradient.

    one_gradient: the residual with that of one side alone. slopes: of J to the two sides of each of
    some orthogonal directions, all that the active bounds leave; differences of true values, per
    share of the box, over ‖∇J‖∞; NaN where there is no design. multipliers: of the bounds on the
    loop by kind, change of ln of the inner value per ln of a bound.
    """

    one_gradient: float
    slopes: tuple[tuple[float, float], ...]
    multipliers: dict[str, float]

    @property
    def least_slope(self) -> float:
        """The least of the slopes that are known; NaN where none is."""
        known = [slope for pair in self.slopes for slope in pair if np.isfinite(slope)]
        return min(known, default=float("nan"))


@dataclass(frozen=True)
class KktCertificate:
    """Residuals of the true optimality conditions at a verified design.

    stationarity: scaled, see the module. primal: largest violation of g (logarithms) or a bound
    (share of the box). complementarity: largest |μ g| over ‖∇J‖∞. multipliers: per name, change
    of J per unit of g, or per unit box of a bound. second_order: least eigenvalue of the reduced
    Hessian of the Lagrangian over ‖∇J‖∞, inf at a vertex, None where it was not computed.
    kink: of sections, where one gradient of J is not all that there are.
    """

    stationarity: float
    primal: float
    complementarity: float
    multipliers: dict[str, float]
    active: tuple[str, ...]
    second_order: float | None
    objective_gradient: tuple[float, ...]
    kink: Kink | None = None


def kkt_certificate(
    problem: CoDesignProblem,
    x: Array,
    design: Sensitivities,
    true_at: Callable[[Array], Sensitivities] | None = None,
) -> KktCertificate:
    """First-order residuals at x; the second-order check too where `true_at` may synthesise."""
    plain = _first_order(problem, x, design, (), true_at)
    if plain.stationarity <= SMOOTH:
        return plain
    others = other_peaks(problem, x, design, ACTIVE)
    return _first_order(problem, x, design, others, true_at) if others else plain


@dataclass(frozen=True)
class ActiveSet:
    """∇J and the constraints within `ACTIVE` of their bounds at one x, in unit-box variables.

    rows: (m, n) gradients, slack: (m,) values (<= 0 inside), one each per label; the first
    `constraints` are of g, the rest bounds. violation: the largest of all, 0 where none is.
    """

    gradient: Array
    rows: Array
    slack: Array
    labels: tuple[str, ...]
    constraints: int
    violation: float


def active_set(
    problem: CoDesignProblem,
    x: Array,
    design: Sensitivities,
    others: tuple[PeakConstraint, ...] = (),
) -> ActiveSet:
    """The active constraints and bounds at x, with `others` besides the problem's own."""
    lower, upper = lifted_bounds(problem)
    width = upper - lower
    gradient, g, jacobian, names = lagrangian_parts(problem, x, design)
    first, own = len(problem.inner.bounds), constraint_sizes(problem)
    if others:
        g = np.append(g, [peak.value for peak in others])
        jacobian = np.vstack([jacobian, *(peak.row for peak in others)])
        names = (*names, *(peak.name for peak in others))
    rows, labels, slack = [], [], []
    sizes = np.ones(len(g))
    sizes[first : first + len(own)] = own
    for value, size, row, name in zip(g, sizes, jacobian, names, strict=True):
        if value >= -ACTIVE * size:
            rows.append(row)
            labels.append(name)
            slack.append(value)
    count = len(rows)
    low, high = (lower - x) / width, (x - upper) / width
    for i, name in enumerate((*problem.names, "omega_S", "omega_T")):
        for end, value, sign in (("lower", low[i], -1.0), ("upper", high[i], 1.0)):
            if value >= -ACTIVE:
                rows.append(sign * np.eye(x.size)[i])
                labels.append(f"{name} {end}")
                slack.append(value)
    violation = max(0.0, float(low.max()), float(high.max()), float(np.max(g / sizes, initial=0.0)))
    matrix = np.array(rows).reshape(-1, x.size)
    return ActiveSet(gradient, matrix, np.array(slack), tuple(labels), count, violation)


def _first_order(
    problem: CoDesignProblem,
    x: Array,
    design: Sensitivities,
    others: tuple[PeakConstraint, ...],
    true_at: Callable[[Array], Sensitivities] | None,
) -> KktCertificate:
    at = active_set(problem, x, design, others)
    gradient, A, slack = at.gradient, at.rows, at.slack
    if others:
        true_at = None  # a difference of gradients would mix one peak with another
    size = max(float(np.abs(gradient).max()), 1e-300)
    mu, residual, complementarity = np.empty(0), gradient, 0.0
    if at.labels:
        mu, _ = nnls(A.T, -gradient)
        residual = gradient + A.T @ mu
        complementarity = float(np.abs(mu * slack).max()) / size
    second = _second_order(problem, x, A[mu > 0.0], size, mu, at.labels, true_at)
    return KktCertificate(
        stationarity=float(np.abs(residual).max()) / size,
        primal=at.violation,
        complementarity=complementarity,
        multipliers={name: float(value) for name, value in zip(at.labels, mu, strict=True)},
        active=at.labels,
        second_order=second,
        objective_gradient=tuple(float(value) for value in gradient),
    )


def lagrangian_parts(
    problem: CoDesignProblem, x: Array, design: Sensitivities
) -> tuple[Array, Array, Array, tuple[str, ...]]:
    """∇J, g and its Jacobian in unit-box variables, and the constraints' names."""
    plant = plant_of(problem)
    count = len(problem.names)
    lower, upper = lifted_bounds(problem)
    width = upper - lower
    theta = x[:count]
    df, dlam = hardware_slopes(plant, theta)
    total = np.hstack([design.to_theta, design.to_break_frequencies])
    gradient = problem.w2 * total[0]
    gradient[:count] += problem.w1 * df
    lam = constraint_values(plant, theta)
    g = np.concatenate([design.values[1:-1] - problem.inner.levels, lam])
    jacobian = np.vstack([total[1:-1], np.hstack([dlam, np.zeros((len(lam), 2))])])
    names = (*problem.inner.bounds, *plant.constraint_names)
    return gradient * width, g, jacobian * width, names


def _second_order(
    problem: CoDesignProblem,
    x: Array,
    strong: Array,
    size: float,
    mu: Array,
    labels: tuple[str, ...],
    true_at: Callable[[Array], Sensitivities] | None,
) -> float | None:
    """Least eigenvalue of Zᵀ∇²L Z, Z spanning the null space of the strongly active gradients."""
    Z = null_space(strong) if strong.size else np.eye(x.size)
    if Z.shape[1] == 0:
        return np.inf
    if true_at is None:
        return None
    columns = lagrangian_hessian(
        problem, x, Z, dict(zip(labels, map(float, mu), strict=True)), true_at
    )
    if columns is None:
        return None
    H = Z.T @ columns
    return float(np.linalg.eigvalsh(0.5 * (H + H.T)).min()) / size


def lagrangian_hessian(
    problem: CoDesignProblem,
    x: Array,
    directions: Array,
    multipliers: Mapping[str, float],
    true_at: Callable[[Array], Sensitivities],
) -> Array | None:
    """∇²L Z (n, k) by differences of true gradients, unit-box variables; None where not certified.

    At a bound the difference is one-sided. `multipliers` by the certificate's names.
    """
    lower, upper = lifted_bounds(problem)
    width = upper - lower

    def slope(at: Array) -> Array | None:
        design = true_at(at)
        if not design.figures.certified:
            return None
        gradient, _, jacobian, names = lagrangian_parts(problem, at, design)
        return gradient + sum(
            (multipliers.get(name, 0.0) * row for name, row in zip(names, jacobian, strict=True)),
            start=np.zeros(x.size),
        )

    columns = np.empty((x.size, directions.shape[1]))
    for k, direction in enumerate(directions.T):
        step = STEP * direction * width
        ends = [np.clip(x + sign * step, lower, upper) for sign in (1.0, -1.0)]
        slopes = [slope(end) for end in ends]
        span = float(np.linalg.norm((ends[0] - ends[1]) / width))
        if slopes[0] is None or slopes[1] is None or span < 0.5 * STEP:
            return None
        columns[:, k] = (slopes[0] - slopes[1]) / span
    return columns
