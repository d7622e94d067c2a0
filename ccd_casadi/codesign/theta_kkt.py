"""First- and second-order optimality over θ, of a value that has envelope gradients and kinks.

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

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy
from scipy.linalg import qr

from ccd_casadi.fixed_structure.local_search import Envelope
from ccd_casadi.inner_problem.objective import (
    constraint_sizes,
    hardware_at,
    objective,
    objective_gradient,
)
from ccd_casadi.inner_problem.problem import CoDesignProblem, box, plant_of
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
    envelope: Envelope | None = None,
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
        joint, mu, pair = joint_residual(envelope, direct, to_theta, at.rows, at.size, options)
        if joint < 0.5 * residual:
            multipliers = dict.fromkeys(envelope.names, 0.0)
            for word, value in zip(envelope.names, mu, strict=False):
                multipliers[word] += float(value)
            kink, residual, nu = Kink(residual, (), multipliers), joint, pair
    Z = _steepest_first(at.free(nu), at.gradient)
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
        slopes = _slopes(bounds, beside or more, np.array(sample.theta), Z, at.size, step)
        kink = Kink(kink.one_gradient, slopes, kink.multipliers, beside is not None)
    elif beside is None:  # λ's own curvature is left out
        columns = hessian_products(gradients, bounds.shares(sample.theta), Z, options.difference)
        second = reduced_curvature(Z, columns, at.size)
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
    envelope: Envelope, direct: Array, to_theta: Array, A: Array, size: float,
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
