"""Peaks of S as constraints, and the certificate of optimality on the true lifted problem."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.linalg import null_space

from ccd_casadi.codesign.outer_problem import lifted_bounds
from ccd_casadi.inner_problem.objective import (
    TrueQuantities,
    constraint_sizes,
    hardware_at,
    objective_terms,
    violations,
)
from ccd_casadi.inner_problem.problem import CoDesignProblem, plant_of, scaled_plant
from ccd_casadi.optim.kkt import (
    ActiveSet,
    FirstOrder,
    KktCertificate,
    KktOptions,
    active_set,
    hessian_products,
    reduced_curvature,
)
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.text import HZ
from ccd_casadi.synthesis.derivatives import LocalPeak, Sensitivities, local_peaks_with_gradients

HALF_POWER = -0.5 * np.log(2.0)
OTHER_PEAK = "S_max at "  # begins the name of a local peak besides the largest


@dataclass(frozen=True)
class LiftedKktOptions:
    """Numbers of the optimality conditions of the true lifted problem."""

    same_peak: float = 0.03  # ln ω within which peaks of one plant are one
    inside: float = 2e-9  # ln: what a step aims inside S_max and S_low, to end feasible as given
    smooth: float = 1e-6  # residual up to which nothing indicates a kink
    accuracy: float = 1e-8  # of the terms of J, which may cancel: of ω_b
    longest_newton_step: float = 1e-3  # of the box: a longer one leaves the basin


@dataclass(frozen=True)
class PeakConstraint:
    """A local peak of S as a constraint: its name, ln of it minus ln of its bound, unit-box slope.

    `omega` in rad/s and `member` of the robust set identify the peak.
    """

    name: str
    value: float
    row: Array
    omega: float
    member: int

    @property
    def tag(self) -> tuple[str, float, int]:
        """The kind of the peak, ln ω and its plant: by these it is found again at another x."""
        kind = "peak" if self.name.startswith(OTHER_PEAK) else "shelf"
        return kind, float(np.log(self.omega)), self.member


def other_peaks(
    problem: CoDesignProblem, x: Array, design: Sensitivities, band: float,
    options: LiftedKktOptions = LiftedKktOptions(),
) -> tuple[PeakConstraint, ...]:  # fmt: skip
    """Local peaks of S besides the largest that are within `band` (ln) of what they must not pass.

    That is S_max anywhere, on every plant of a robust set, and -3 dB below ω_b, which is the first
    crossing only as long as they do not pass it.
    """
    figures, width = design.figures, lifted_bounds(problem).width
    peaks = local_peaks_with_gradients(
        scaled_plant(problem, tuple(x[:-2])),
        problem.weights.at(figures.omega_S, figures.omega_T),
        design,
        gamma_backoff=problem.inner.gamma_backoff,
        least=float(np.exp(min(HALF_POWER, np.log(problem.inner.S_max)) - band)),
    )
    S_max, found = np.log(problem.inner.S_max), []
    norm = _of_norm(peaks, design, options.same_peak)
    for peak in peaks:
        if peak is norm:
            continue  # the row S_max itself
        on = f" on plant {peak.member} of the set" if peak.member else ""
        place = f"{peak.omega / HZ:.4g} Hz{on}"
        shelf = peak.member == 0 and peak.omega < figures.bandwidth
        if peak.ln_gain >= S_max - band:
            level, kind = S_max, OTHER_PEAK
        elif shelf and abs(peak.ln_gain - HALF_POWER) <= band:
            level, kind = HALF_POWER, "-3 dB at "
        else:
            continue
        found.append(PeakConstraint(
            kind + place, peak.ln_gain - level, peak.gradient * width, peak.omega, peak.member
        ))  # fmt: skip
    return tuple(found)


def _of_norm(peaks: tuple[LocalPeak, ...], design: Sensitivities, same: float) -> LocalPeak | None:
    """The peak that ‖S‖∞ is read at: by its plant and frequency, as others may be as high."""
    if design.made is None:
        return None
    place = np.log(design.figures.sensitivity_peak_frequency)
    own = [peak for peak in peaks if peak.member == design.made.worst]
    nearest = min(own, key=lambda peak: abs(np.log(peak.omega) - place), default=None)
    far = nearest is None or abs(np.log(nearest.omega) - place) > same
    return None if far else nearest


@dataclass(frozen=True)
class TrueDesign:
    """The true design at x = (θ, ln ω_S, ln ω_T), and by what it is compared with others."""

    truth: TrueQuantities
    x: Array
    options: LiftedKktOptions = LiftedKktOptions()

    @property
    def problem(self) -> CoDesignProblem:
        """Whose design it is."""
        return self.truth.problem

    @property
    def design(self) -> Sensitivities:
        """The synthesis with its derivatives."""
        return self.truth.at(self.x)

    @property
    def theta(self) -> Array:
        """The θ of x."""
        return self.x[: len(self.problem.names)]

    @property
    def acceptable(self) -> bool:
        """Certified, within S_max and S_low as given (no slack), and λ(θ) <= 0 to rounding."""
        met = self.problem.inner.feasible(self.design.figures)
        return met and not violations(self.problem, self.theta)

    @cached_property
    def terms(self) -> tuple[float, float]:
        """The two terms of J."""
        return objective_terms(self.problem, self.theta, self.design.figures.bandwidth)

    @property
    def objective(self) -> float:
        """The objective J."""
        return sum(self.terms)

    @cached_property
    def kkt(self) -> KktCertificate:
        """The first-order certificate of the design."""
        return kkt_certificate(self)

    @property
    def residual(self) -> float:
        """The scaled residual of the optimality conditions."""
        return max(self.kkt.stationarity, self.kkt.complementarity)

    def rise(self, other: "TrueDesign") -> float:
        """Return by how much another J is larger, over what J may differ by and still be the
        same."""
        return (other.objective - self.objective) / (
            self.options.accuracy * sum(map(abs, self.terms))
        )


def kkt_certificate(here: TrueDesign, second: bool = False) -> KktCertificate:
    """First-order residuals; the second-order check too where `second` lets it synthesise."""
    plain = _certificate(here, active_at(here), second)
    if plain.stationarity <= here.options.smooth:
        return plain
    others = other_peaks(here.problem, here.x, here.design, KktOptions.active)
    if not others:  # with them a difference of gradients would mix one peak with another
        return plain
    return _certificate(here, active_at(here, others), False)


def active_at(here: TrueDesign, others: tuple[PeakConstraint, ...] = ()) -> ActiveSet:
    """The active constraints and bounds, with `others` besides the problem's own."""
    variables = (*here.problem.names, "omega_S", "omega_T")
    z = lifted_bounds(here.problem).shares(here.x)
    return active_set(z, first_order(here, others), variables)


def _certificate(here: TrueDesign, at: ActiveSet, second: bool) -> KktCertificate:
    mu = at.multipliers()
    Z = at.free(mu)
    found = at.certificate(mu, at.residual(mu), np.inf if Z.shape[1] == 0 else None)
    if not (second and Z.shape[1]):
        return found
    columns = lagrangian_hessian(here, Z, found.multipliers)
    return replace(found, second_order=reduced_curvature(Z, columns, at.size))


def first_order(
    here: TrueDesign, others: tuple[PeakConstraint, ...] = (), inside: float = 0.0
) -> FirstOrder:
    """J, the bounds on the loop (ln, `inside` tighter), λ, and `others` like the bounds."""
    problem, design, count = here.problem, here.design, len(here.problem.names)
    own, sizes = hardware_at(problem, here.theta), constraint_sizes(problem)
    total = np.hstack([design.to_theta, design.to_break_frequencies])
    total *= lifted_bounds(problem).width
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
    here: TrueDesign, directions: Array, multipliers: Mapping[str, float]
) -> Array | None:
    """∇²L Z (n, k) by differences of true gradients, unit-box variables; None where not certified.

    `multipliers` by the certificate's names.
    """
    bounds = lifted_bounds(here.problem)

    def slope(z: Array) -> Array | None:
        there = replace(here, x=bounds.lower + bounds.width * z)
        if not there.design.figures.certified:
            return None
        found = first_order(there)
        mu = np.array([multipliers.get(name, 0.0) for name in found.names]) * found.sizes
        return found.gradient + mu @ found.jacobian

    at = bounds.shares(here.x)
    return hessian_products(lambda ends: [slope(z) for z in ends], at, directions)


def newton_step(here: TrueDesign) -> Array | None:
    """Return the end of a Newton step; None without a positive reduced Hessian, or where the step
    is too long.

    From a design whose certificate is of the plain conditions. The Hessian takes two true designs
    per free direction. Nocedal and Wright, Numerical Optimization, 18.1.
    """
    problem, mu, at = here.problem, here.kkt.multipliers, active_at(here)
    held = np.array([mu[name] > 0.0 for name in at.labels], bool)
    A = at.rows[held]
    inside = np.array([here.options.inside * (name in problem.inner.bounds) for name in at.labels])
    aim = np.where(np.arange(held.size) < at.constraints, -(at.slack + inside), 0.0)[held]
    Z = null_space(A)
    if Z.shape[1] == 0:  # a vertex
        return None
    columns = lagrangian_hessian(here, Z, mu)
    if columns is None:
        return None
    H = Z.T @ columns
    H = 0.5 * (H + H.T)
    if np.linalg.eigvalsh(H).min() <= 0.0:
        return None
    d = -Z @ np.linalg.solve(H, Z.T @ at.gradient)
    if A.size:
        d = d + np.linalg.lstsq(A, aim, rcond=None)[0]
    if np.abs(d).max() > here.options.longest_newton_step:
        return None
    bounds = lifted_bounds(problem)
    return np.clip(here.x + bounds.width * d, *bounds)
