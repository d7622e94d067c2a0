"""First- and second-order optimality over θ of a co-design with a controller of fixed structure.

    ∇J + Aᵀν = 0,  ν >= 0,   A: what binds of λ(θ) <= 0 and the box of θ,   J = w1 f + w2 ω_b*(θ)

J has one gradient where the multipliers μ of the controller's optimum are unique. Where more binds
than the controller leaves free, two peaks of S equally high say, ω_b*(θ) may have a kink; no side's
gradient is zero then at an optimum. The problem over θ, κ and τ = ln ω_b together is smooth all the
same, and its conditions hold for one μ and ν:

    rowsᵀ μ = goal,   w1 ∇f + w2 (direct + to_thetaᵀ μ) + Aᵀν = 0,   μ, ν >= 0        (`Envelope`)

Where they are met a convex combination of the sides' gradients is balanced by A (stationary in the
sense of Clarke), and no direction of θ, κ and τ that the bounds allow makes J fall to first order.
All that is by derivatives at the design, of its controller and what that can be moved to. Whether
another controller is the better one beside it, true values there tell (`Kink.slopes`): with one
direction left its two sides are all that there is, of several directions some are looked along.
"""

import numpy as np
from scipy.linalg import null_space, qr
from scipy.optimize import nnls

from ccd_casadi.codesign.kkt import ACTIVE, STEP, Kink, KktCertificate
from ccd_casadi.codesign.true_value import TrueBandwidth
from ccd_casadi.fixed_structure.optimality import Envelope
from ccd_casadi.inner_problem.constraints import constraint_sizes
from ccd_casadi.inner_problem.objective import hardware_at, objective, objective_gradient
from ccd_casadi.inner_problem.problem import CoDesignProblem, box, plant_of
from ccd_casadi.sampling.samples import BandwidthSample
from ccd_casadi.support.arrays import Array

# The envelope gradient of a controller that is itself optimal to 1e-3 is right to 2e-3: a residual
# below that says nothing of a kink.
SMOOTH = 1e-3
EQUATION = 1e3  # weight of the controller's own conditions, which no θ may pay for
BESIDE = 10.0 * STEP  # of the box: differences of true values and gradients


def sections_kkt(
    problem: CoDesignProblem,
    sample: BandwidthSample,
    truth: TrueBandwidth | None = None,
    envelope: Envelope | None = None,
) -> KktCertificate:
    """Residuals of optimality at a sample.

    With `envelope`, of the design there, also where ω_b* has a kink; where `truth` may be asked
    with slopes to its sides, or the second-order check where it has none.
    """
    lower, upper = box(problem)
    width = upper - lower
    theta = np.array(sample.theta)
    own = hardware_at(problem, theta)
    gradient = objective_gradient(problem, sample)
    rows, labels, slack = [], [], []
    names = plant_of(problem).constraint_names
    size_of = dict(zip(names, constraint_sizes(problem), strict=True))
    for value, row, name in zip(own.constraints, own.slopes, names, strict=True):
        if value >= -ACTIVE:
            rows.append(row)
            labels.append(name)
            slack.append(value)
    for i, name in enumerate(problem.names):
        gaps = ((theta[i] - lower[i]) / width[i], (upper[i] - theta[i]) / width[i])
        for end, gap, sign in zip(("lower", "upper"), gaps, (-1.0, 1.0), strict=True):
            if gap <= ACTIVE:
                rows.append(sign * np.eye(theta.size)[i])
                labels.append(f"{name} {end}")
                slack.append(-gap)
    if not np.isfinite(gradient).all():
        return KktCertificate(np.inf, 0.0, np.inf, {}, tuple(labels), None, tuple(gradient))
    size = max(float(np.abs(gradient).max()), 1e-300)
    A = np.array(rows).reshape(-1, theta.size)
    nu = nnls(A.T, -gradient)[0] if rows else np.zeros(0)
    residual = float(np.abs(gradient + A.T @ nu).max()) / size
    kink: Kink | None = None
    if residual > SMOOTH and envelope is not None:
        direct = own.cost_gradient + problem.w2 * envelope.direct * width
        joint, mu, pair = joint_residual(
            envelope, direct, problem.w2 * envelope.to_theta * width, A, size
        )
        if joint < 0.5 * residual:
            multipliers = dict.fromkeys(envelope.names, 0.0)
            for word, value in zip(envelope.names, mu, strict=False):
                multipliers[word] += float(value)
            kink, residual, nu = Kink(residual, (), multipliers), joint, pair
    Z = _free(A[nu > 0.0], gradient)
    second: float | None = np.inf if Z.shape[1] == 0 else None
    if Z.shape[1] and truth is not None and kink is not None:
        slopes = tuple(_slopes(problem, truth, sample, z, size) for z in Z.T)
        kink = Kink(kink.one_gradient, slopes, kink.multipliers)
    elif Z.shape[1] and truth is not None:
        second = _second(problem, truth, theta, Z, size)
    primal = max(0.0, *(-np.minimum(theta - lower, upper - theta) / width), *own.constraints)
    return KktCertificate(
        stationarity=residual,
        primal=float(primal),
        complementarity=float(np.abs(nu * np.array(slack)).max(initial=0.0)) / size,
        multipliers={
            name: float(value) / size_of.get(name, 1.0)
            for name, value in zip(labels, nu, strict=True)
        },
        active=tuple(labels),
        second_order=second,
        objective_gradient=tuple(map(float, gradient)),
        kink=kink,
    )


def joint_residual(
    envelope: Envelope, direct: Array, to_theta: Array, A: Array, size: float
) -> tuple[float, Array, Array]:
    """The residual over θ and controller with the best μ and ν, and these.

        rowsᵀ μ = goal,   direct + to_thetaᵀ μ + Aᵀν = 0,   μ, ν >= 0

    `direct` (n,), `to_theta` (m, n) and A (k, n) are of J per share of the box. The residual is
    the larger of both, over ‖goal‖∞ and over `size`.
    """
    count, k = len(envelope.rows), len(A)
    unit = float(np.abs(envelope.goal).max())
    inner = np.hstack([envelope.rows.T / unit, np.zeros((len(envelope.goal), k))])
    ends = np.zeros((len(direct), count - len(to_theta)))
    outer = np.hstack([to_theta.T, ends, A.T]) / size
    goals = envelope.goal / unit, -direct / size
    found, _ = nnls(
        np.vstack([EQUATION * inner, outer]),
        np.concatenate([EQUATION * goals[0], goals[1]]),
        maxiter=100 * (count + k),
    )
    off = (inner @ found - goals[0], outer @ found - goals[1])
    return max(float(np.abs(part).max()) for part in off), found[:count], found[count:]


def _free(strong: Array, gradient: Array) -> Array:
    """Orthonormal directions (n, k) that the strongly active bounds leave; the first is the one in
    which J falls by this gradient."""
    Z = null_space(strong) if len(strong) else np.eye(gradient.size)
    if Z.shape[1] == 0:
        return Z
    turned = qr(np.column_stack([Z.T @ gradient, np.eye(Z.shape[1])]), mode="economic")[0]
    return Z @ turned


def _slopes(
    problem: CoDesignProblem, truth: TrueBandwidth, sample: BandwidthSample, z: Array, size: float
) -> tuple[float, float]:
    """By how much J grows on both sides of a design, per share of the box and over `size`."""
    lower, upper = box(problem)
    theta = np.array(sample.theta)

    def value(at: BandwidthSample) -> float:
        return objective(problem, at.theta, at.value)

    found = []
    for sign in (-1.0, 1.0):
        end = np.clip(theta + sign * BESIDE * z * (upper - lower), lower, upper)
        step = float(np.linalg.norm((end - theta) / (upper - lower)))
        slope = np.nan
        if step > 0.5 * BESIDE:
            slope = (value(truth.at(end)) - value(sample)) / (step * size)
        found.append(slope)
    return found[0], found[1]


def _second(
    problem: CoDesignProblem, truth: TrueBandwidth, theta: Array, Z: Array, size: float
) -> float | None:
    """Least eigenvalue of Zᵀ∇²J Z by differences of true gradients; λ's own curvature is left out.

    None where a neighbour is outside the box or has no gradient.
    """
    lower, upper = box(problem)
    columns = []
    for direction in Z.T:
        ends = [theta + sign * BESIDE * direction * (upper - lower) for sign in (1.0, -1.0)]
        if any((end < lower).any() or (end > upper).any() for end in ends):
            return None
        slopes = [objective_gradient(problem, truth.at(end)) for end in ends]
        columns.append((slopes[0] - slopes[1]) / (2.0 * BESIDE))
    H = Z.T @ np.array(columns).T
    if not np.isfinite(H).all():
        return None
    return float(np.linalg.eigvalsh(0.5 * (H + H.T)).min()) / size
