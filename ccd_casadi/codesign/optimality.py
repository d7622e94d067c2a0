"""Optimality on the truth, first and second order: of the lifted problem, and over θ with kinks.

In x = (θ, ln ω_S, ln ω_T) local peaks of S are constraints. Over θ alone the value has envelope
gradients and kinks:

    ∇J + Aᵀν = 0,  ν >= 0,   A: what binds of λ(θ) <= 0 and the box of θ,   J = w1 f + w2 ω_b*(θ)

J has one gradient where the multipliers μ of the controller's optimum are unique. Where more binds
than the controller leaves free, two peaks of S equally high say, ω_b*(θ) may have a kink; no side's
gradient is zero then at an optimum. The problem over θ, κ and τ = ln ω_b together is smooth all the
same, and its conditions hold for one μ and ν:

    rowsᵀ μ = goal,   w1 ∇f + w2 (direct + to_thetaᵀ μ) + Aᵀν = 0,   μ, ν >= 0        (`Envelope`)

Rows within 1e-3 of their bounds may carry μ too, and then count by μ times what is left
(complementary slackness): a search of θ and controller ends where a kink's rows meet to 1e-5 or so.

Where they are met a convex combination of the sides' gradients is balanced by A (stationary in the
sense of Clarke), and no direction of θ, κ and τ that the bounds allow makes J fall to first order.
All that is by derivatives at the design, of its controller and what that can be moved to. Whether
another controller is the better one beside it, true values there decide (`Kink.slopes`): with one
direction left its two sides are all that there is, of several directions some are looked along.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import scipy
from scipy.linalg import qr

from ccd_casadi.codesign.outer_problem import lifted_bounds
from ccd_casadi.inner_problem.objective import (
    TrueQuantities,
    constraint_sizes,
    hardware_at,
    objective,
    objective_gradient,
    objective_terms,
    violations,
)
from ccd_casadi.inner_problem.problem import CoDesignProblem, box, plant_of, scaled_plant
from ccd_casadi.optim.kkt import (
    ActiveSet,
    FirstOrder,
    Kink,
    KktCertificate,
    KktOptions,
    active_set,
    hessian_products,
    reduced_curvature,
)
from ccd_casadi.optim.pieces import Box
from ccd_casadi.sampling.inner_samples import InnerSample
from ccd_casadi.sampling.sampler import Sampler
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.text import HZ
from ccd_casadi.synthesis.derivatives import LocalPeak, Sensitivities, local_peaks_with_gradients

if TYPE_CHECKING:
    from ccd_casadi.fixed_structure.local_search import Envelope

Beside = Callable[[Array], Array]


@dataclass(frozen=True)
class ThetaKktOptions:
    """Numbers of the optimality conditions over θ."""

    # The envelope gradient of a controller that is itself optimal to 1e-3 is right to 2e-3: a
    # residual below that does not indicate a kink.
    smooth: float = 1e-3
    equation_weight: float = 10.0  # of the controller's own conditions, which no θ may pay for
    difference: float = 10.0 * KktOptions.step  # of the box: for true values and gradients


def theta_kkt(
    problem: CoDesignProblem,
    sample: InnerSample,
    truth: Sampler | None = None,
    envelope: "Envelope | None" = None,
    beside: Beside | None = None,
    options: ThetaKktOptions = ThetaKktOptions(),
) -> KktCertificate:
    """Residuals of optimality at a sample.

    With `envelope`, of the design there, also where ω_b* has a kink; where `truth` may be evaluated
    with slopes to its sides, or the second-order check where it has none. `beside`: where true
    values are dear, by how much J is larger at θ (n, n_θ) next to it, by climbs on plants as they
    are known there: so exact that steps are a tenth as long, within which a kink stays alone.
    """
    bounds, own = box(problem), hardware_at(problem, np.array(sample.theta))
    at = active_theta(problem, sample)
    if not np.isfinite(at.gradient).all():
        return at.certificate(np.zeros(len(at.labels)), np.inf, None)
    nu = at.multipliers()
    residual = at.residual(nu)
    kink: Kink | None = None
    if residual > options.smooth and envelope is not None:
        direct = own.cost_gradient + problem.w2 * envelope.direct * bounds.width
        to_theta = problem.w2 * envelope.to_theta * bounds.width
        joint, mu, pair = joint_residual(envelope, direct, to_theta, at.rows, at.scale, options)
        if joint < 0.5 * residual:
            multipliers = dict.fromkeys(envelope.names, 0.0)
            for word, value in zip(envelope.names, mu, strict=False):
                multipliers[word] += float(value)
            kink, residual, nu = Kink(residual, (), multipliers), joint, pair
    Z = _steepest_first(at.null_space(nu), at.gradient)
    second = np.inf if Z.shape[1] == 0 else None
    if second is not None or truth is None:
        return at.certificate(nu, residual, second, kink)

    def more(thetas: Array) -> Array:
        J = [objective(problem, one.theta, one.value)
             for one in (sample, *truth.values(thetas, "certificate"))]  # fmt: skip
        return np.array(J[1:]) - J[0]

    def gradients(z: Array) -> list[Array]:
        there = truth.values(bounds.lower + bounds.width * z, "certificate")
        return [objective_gradient(problem, one) for one in there]

    if kink is not None:
        step = KktOptions.step if beside else options.difference
        slopes = _slopes(bounds, beside or more, np.array(sample.theta), Z, at.scale, step)
        kink = Kink(kink.one_gradient, slopes, kink.multipliers, beside is not None)
    elif beside is None:  # λ's own curvature is left out
        columns = hessian_products(gradients, bounds.shares(sample.theta), Z, options.difference)
        second = reduced_curvature(Z, columns, at.scale)
    return at.certificate(nu, residual, second, kink)


def active_theta(problem: CoDesignProblem, sample: InnerSample) -> ActiveSet:
    """∇J at a sample, and what binds of λ and the bounds of θ."""
    own = hardware_at(problem, np.array(sample.theta))
    here = FirstOrder(
        objective_gradient(problem, sample), own.constraints, own.slopes,
        constraint_sizes(problem), plant_of(problem).constraint_names,
    )  # fmt: skip
    return active_set(box(problem).shares(sample.theta), here, problem.names)


def joint_residual(
    envelope: "Envelope", direct: Array, to_theta: Array, A: Array, size: float,
    options: ThetaKktOptions = ThetaKktOptions(),
) -> tuple[float, Array, Array]:  # fmt: skip
    """The residual over θ and controller with the best μ and ν, and these.

        rowsᵀ μ = goal,   direct + to_thetaᵀ μ + Aᵀν = 0,   μ, ν >= 0

    `direct` (n,), `to_theta` (m, n) and A (k, n) are of J per share of the box. The residual is
    the largest of both, over ‖goal‖∞ and over `size`, and of Σ μ slack over ‖goal‖∞: what is to be
    had, to first order, from rows that do not quite bind.
    """
    count, k, weight = len(envelope.rows), len(A), options.equation_weight
    unit = float(np.abs(envelope.goal).max())
    inner = np.hstack([envelope.rows.T / unit, np.zeros((len(envelope.goal), k))])
    ends = np.zeros((len(direct), count - len(to_theta)))
    outer = np.hstack([to_theta.T, ends, A.T]) / size
    goals = envelope.goal / unit, -direct / size
    loose = np.pad(envelope.slack / unit, (0, k))
    found, _ = scipy.optimize.nnls(
        np.vstack([weight * inner, outer, np.diag(loose)]),
        np.concatenate([weight * goals[0], goals[1], np.zeros(count + k)]),
        maxiter=100 * (count + k),
    )
    off = (inner @ found - goals[0], outer @ found - goals[1], [loose @ found])
    return max(float(np.abs(part).max()) for part in off), found[:count], found[count:]


def _steepest_first(Z: Array, gradient: Array) -> Array:
    """The same directions (n, k), turned so that J falls along the first by this gradient."""
    if Z.shape[1] == 0:
        return Z
    turned = qr(np.column_stack([Z.T @ gradient, np.eye(Z.shape[1])]), mode="economic")[0]
    return Z @ turned


def _slopes(
    bounds: Box, more: Beside, theta: Array, Z: Array, size: float, step: float
) -> tuple[tuple[float, float], ...]:
    """Compute how J grows on both sides of a design along each of Z (n, k), per share of the box
    and over `size`; all are evaluated at once."""
    sides = np.array([sign * step * z for z in Z.T for sign in (-1.0, 1.0)])
    ends = np.clip(theta + sides * bounds.width, *bounds)
    steps = np.linalg.norm((ends - theta) / bounds.width, axis=1)
    far = np.flatnonzero(steps > 0.5 * step)
    found = np.full(len(ends), np.nan)
    found[far] = more(ends[far]) / (steps[far] * size)
    return tuple((float(low), float(high)) for low, high in found.reshape(-1, 2))


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
    Z = at.null_space(mu)
    found = at.certificate(mu, at.residual(mu), np.inf if Z.shape[1] == 0 else None)
    if not (second and Z.shape[1]):
        return found
    columns = lagrangian_hessian(here, Z, found.multipliers)
    return replace(found, second_order=reduced_curvature(Z, columns, at.scale))


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
