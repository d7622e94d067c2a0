"""Certificate of first- and second-order optimality on the true lifted problem.

    min J(x) = w1 f(θ) + w2 ω_b(x),  x = (θ, ln ω_S, ln ω_T),
    g(x) = (ln‖S‖∞ - ln S_max, ln σ_max(S(jω_low)) - ln S_low, λ(θ)) <= 0,  bounds,

and ln‖GS‖∞ - ln compliance_max where that is given, with the total derivatives of the true
synthesis, scaled as `optim.kkt` has it.

‖S‖∞ has a kink where two local peaks are equal (or two plants of a robust set), and ω_b jumps where
a local maximum of σ_max(S) below it reaches -3 dB. Where the plain conditions fail, every such peak
within `ACTIVE` is a constraint of its own.

Newton's step on these conditions (`newton_step`) is for what J's rounding hides from a descent:

    min ∇Jᵀd + ½ dᵀ∇²L d   s.t.  Ad = -(g + ε) on active constraints, d = 0 on active bounds

J is good to some 1e-9 of its terms, so that a method which watches it fall ends where the residual
of its gradient is 1e-6; the gradients themselves are good to 1e-10.
"""

from collections.abc import Callable, Mapping

import numpy as np
from scipy.linalg import null_space

from ccd_casadi.codesign.outer_problem import lifted_bounds
from ccd_casadi.codesign.peak_constraints import PeakConstraint, other_peaks
from ccd_casadi.inner_problem.objective import constraint_sizes, hardware_at
from ccd_casadi.inner_problem.problem import CoDesignProblem, plant_of
from ccd_casadi.inner_problem.true_function import TrueQuantities
from ccd_casadi.optim.kkt import (
    ACTIVE,
    ActiveSet,
    FirstOrder,
    KktCertificate,
    active_set,
    hessian_products,
    reduced_curvature,
)
from ccd_casadi.support.arrays import Array
from ccd_casadi.synthesis.derivatives import Sensitivities

INSIDE = 2e-9  # ln: what a step aims inside S_max and S_low, so that its end is feasible as given
SMOOTH = 1e-6  # residual up to which nothing speaks of a kink
NEAR = 1e-3  # of the box: a longer step is not of the basin that the residual spoke of


def kkt_certificate(
    problem: CoDesignProblem,
    x: Array,
    design: Sensitivities,
    true_at: Callable[[Array], Sensitivities] | None = None,
) -> KktCertificate:
    """First-order residuals at x; the second-order check too where `true_at` may synthesise."""
    plain = _certificate(problem, x, active_at(problem, x, design), true_at)
    if plain.stationarity <= SMOOTH:
        return plain
    others = other_peaks(problem, x, design, ACTIVE)
    if not others:  # with them a difference of gradients would mix one peak with another
        return plain
    return _certificate(problem, x, active_at(problem, x, design, others), None)


def active_at(
    problem: CoDesignProblem,
    x: Array,
    design: Sensitivities,
    others: tuple[PeakConstraint, ...] = (),
) -> ActiveSet:
    """The active constraints and bounds at x, with `others` besides the problem's own."""
    lower, upper = lifted_bounds(problem)
    here = first_order(problem, x, design, others)
    return active_set((x - lower) / (upper - lower), here, (*problem.names, "omega_S", "omega_T"))


def _certificate(
    problem: CoDesignProblem,
    x: Array,
    at: ActiveSet,
    true_at: Callable[[Array], Sensitivities] | None,
) -> KktCertificate:
    mu = at.multipliers()
    Z = at.free(mu)
    found = at.certificate(mu, at.residual(mu), np.inf if Z.shape[1] == 0 else None)
    if found.second_order is not None or true_at is None:
        return found
    columns = lagrangian_hessian(problem, x, Z, found.multipliers, true_at)
    return at.certificate(mu, found.stationarity, reduced_curvature(Z, columns, at.size))


def first_order(
    problem: CoDesignProblem,
    x: Array,
    design: Sensitivities,
    others: tuple[PeakConstraint, ...] = (),
    inside: float = 0.0,
) -> FirstOrder:
    """J, the bounds on the loop (ln, `inside` tighter), λ, and `others` like the bounds, at x."""
    count, (lower, upper) = len(problem.names), lifted_bounds(problem)
    own, sizes = hardware_at(problem, x[:count]), constraint_sizes(problem)
    total = np.hstack([design.to_theta, design.to_break_frequencies]) * (upper - lower)
    gradient = problem.w2 * total[0]
    gradient[:count] += own.cost_gradient
    bounds, peaks = design.values[1:-1] - problem.inner.levels, [peak.value for peak in others]
    names = (*problem.inner.bounds, *plant_of(problem).constraint_names)
    lam = np.pad(own.slopes, ((0, 0), (0, 2)))
    return FirstOrder(
        gradient,
        np.concatenate([bounds + inside, own.constraints, np.add(peaks, inside)]),
        np.vstack([total[1:-1], lam, *(peak.row for peak in others)]),
        np.concatenate([np.ones_like(bounds), sizes, np.ones_like(peaks)]),
        (*names, *(peak.name for peak in others)),
    )


def lagrangian_hessian(
    problem: CoDesignProblem,
    x: Array,
    directions: Array,
    multipliers: Mapping[str, float],
    true_at: Callable[[Array], Sensitivities],
) -> Array | None:
    """∇²L Z (n, k) by differences of true gradients, unit-box variables; None where not certified.

    `multipliers` by the certificate's names.
    """
    lower, upper = lifted_bounds(problem)
    width = upper - lower

    def slope(z: Array) -> Array | None:
        at = lower + width * z
        design = true_at(at)
        if not design.figures.certified:
            return None
        here = first_order(problem, at, design)
        mu = np.array([multipliers.get(name, 0.0) for name in here.names]) * here.sizes
        return here.gradient + mu @ here.jacobian

    return hessian_products(slope, (x - lower) / width, directions)


def newton_step(
    problem: CoDesignProblem, quantities: TrueQuantities, x: Array, kkt: KktCertificate
) -> Array | None:
    """Where the step from x ends; None without a positive reduced Hessian, or past `NEAR`.

    x = (θ, ln ω_S, ln ω_T) with its certificate `kkt` of the plain conditions. The Hessian takes
    two true designs per free direction. Nocedal and Wright, Numerical Optimization, 18.1.
    """
    here = active_at(problem, x, quantities.at(x))
    held = np.array([kkt.multipliers[name] > 0.0 for name in here.labels], bool)
    A = here.rows[held]
    inside = np.array([INSIDE * (name in problem.inner.bounds) for name in here.labels])
    aim = np.where(np.arange(held.size) < here.constraints, -(here.slack + inside), 0.0)[held]
    Z = null_space(A)
    if Z.shape[1] == 0:  # a vertex
        return None
    columns = lagrangian_hessian(problem, x, Z, kkt.multipliers, quantities.at)
    if columns is None:
        return None
    H = Z.T @ columns
    H = 0.5 * (H + H.T)
    if np.linalg.eigvalsh(H).min() <= 0.0:
        return None
    d = -Z @ np.linalg.solve(H, Z.T @ here.gradient)
    if A.size:
        d = d + np.linalg.lstsq(A, aim, rcond=None)[0]
    if np.abs(d).max() > NEAR:
        return None
    lower, upper = lifted_bounds(problem)
    return np.clip(x + (upper - lower) * d, lower, upper)
