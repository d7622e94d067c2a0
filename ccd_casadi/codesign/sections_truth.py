"""The outer problem on the true ω_b*(θ) of a fixed structure: direct, polish, KKT certificate.

    min  w1 f(θ) + w2 ω_b*(θ)   s.t.  θ_min <= θ <= θ_max,  λ(θ) <= 0

or w1 f(θ) + w2 e*(θ), w2 > 0, where the inner problem minimises the RMS error e in m. Where
channels are designed on their own ω_b* is the least of theirs, and an optimum may lie where two are
equal: stationary there is a convex combination of their gradients.

Every evaluation is a design that the judge confirms, with its envelope gradient, or NaN.
"""

from collections.abc import Callable
from dataclasses import replace

import casadi as ca
import numpy as np
from scipy.linalg import null_space
from scipy.optimize import nnls

from ccd_casadi.codesign.formulation import FormulationResult
from ccd_casadi.codesign.kkt import ACTIVE, STEP, KktCertificate
from ccd_casadi.codesign.outer_problem import (
    OuterFailure,
    OuterSolution,
    nested_program,
    solve_program,
)
from ccd_casadi.inner_problem.problem import CoDesignProblem, box, plant_of
from ccd_casadi.plants.plant import constraint_values, hardware_cost
from ccd_casadi.sampling.sampler import Sampler
from ccd_casadi.sampling.samples import BandwidthSample
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.casadi_callback import VectorCallback
from surrogates import design

STATIONARY = 1e-5  # scaled residual below which a polish has nothing to do
PRECISE = 1e-6  # IPOPT's tolerance: ω_b* is known to about 1e-8
KINK = 1e-4  # relative: channels whose bandwidths are so close count as equal
SETTLED = 1e-7  # of J: at a kink of ω_b* no residual falls, a hundred line searches gain no more


class TrueBandwidth(VectorCallback):
    """θ -> ω_b*(θ) in rad/s with its envelope gradient; NaN where no design is certified."""

    def __init__(self, sampler: Sampler, label: str) -> None:
        self.sampler, self.label = sampler, label
        self.known: dict[bytes, BandwidthSample] = {}
        count = len(sampler.problem.names)
        super().__init__("true_bandwidth", count, 1, self._value, self._slope)

    def at(self, theta: Array) -> BandwidthSample:
        """The sample at θ; repeated points cost nothing."""
        key = np.asarray(theta, float).tobytes()
        if key not in self.known:
            self.known[key] = self.sampler.bandwidths(theta, self.label)[0]
        return self.known[key]

    def _value(self, theta: Array) -> Array:
        sample = self.at(theta)
        stationary = np.isfinite(sample.gradient).all()
        return np.array([sample.value if stationary else np.nan])

    def _slope(self, theta: Array) -> Array:
        return np.array(self.at(theta).gradient)[None, :]


def objective(problem: CoDesignProblem, sample: BandwidthSample) -> float:
    """J in its own unit; infinite where θ is infeasible."""
    lam = constraint_values(plant_of(problem), sample.theta)
    if not sample.feasible or (lam > 1e-9).any():
        return np.inf
    cost = hardware_cost(plant_of(problem), sample.theta)
    return problem.w1 * cost + problem.w2 * sample.value


def solve_direct_sections(sampler: Sampler, starts: int, *, seed: int) -> FormulationResult:
    """IPOPT on the true ω_b*(θ) from the case's start and a Sobol set of starts."""
    problem = sampler.problem
    lower, upper = box(problem)
    points = np.array(problem.start)[None, :]
    if starts > 1:
        points = np.vstack([points, design("sobol", lower, upper, starts - 1, seed)])
    truth = TrueBandwidth(sampler, "direct")
    good = [p for p in points if truth.at(p).feasible and np.isfinite(truth.at(p).gradient).all()]
    if not good:
        message = f"none of {len(points)} starting designs is certified"
        return FormulationResult(None, None, (), (), None, False, message)
    program = nested_program(problem, truth)
    program = type(program)(**{**vars(program), "exact_hessian": False})
    try:
        solution = solve_program(program, np.array(good), tolerance=PRECISE, settled=SETTLED)
    except OuterFailure as error:
        best = min((truth.at(p) for p in good), key=lambda s: objective(problem, s))
        if not np.isfinite(objective(problem, best)):
            return FormulationResult(None, None, (), (), None, False, str(error))
        return FormulationResult(np.array(best.theta), None, (), (), None, False, str(error))
    best = min(truth.known.values(), key=lambda s: objective(problem, s))
    return FormulationResult(np.array(best.theta), None, (), (), solution, True, "")


def polish_sections(sampler: Sampler, theta: Array) -> tuple[BandwidthSample, OuterSolution | None]:
    """From a design nearly optimal to the best θ that IPOPT finds on the true problem near it."""
    problem = sampler.problem
    lower, upper = box(problem)
    near = np.where(theta - lower <= 1e-3 * (upper - lower), lower, theta)
    near = np.where(upper - near <= 1e-3 * (upper - lower), upper, near)
    truth = TrueBandwidth(sampler, "polishing")
    candidates = [truth.at(point) for point in np.unique([near, theta], axis=0)]
    best = min(candidates, key=lambda s: objective(problem, s))
    if sections_kkt(problem, best).stationarity <= STATIONARY:
        return best, None
    program = nested_program(problem, truth)
    program = type(program)(**{**vars(program), "exact_hessian": False})
    solution: OuterSolution | None = None
    try:
        solution = solve_program(
            program, np.array(best.theta), warm=True, tolerance=PRECISE, settled=SETTLED
        )
    except OuterFailure:
        pass
    return min(truth.known.values(), key=lambda s: objective(problem, s)), solution


def sections_kkt(
    problem: CoDesignProblem, sample: BandwidthSample, truth: TrueBandwidth | None = None
) -> KktCertificate:
    """First-order residuals over θ at a sample; the second-order check where `truth` may ask."""
    plant = plant_of(problem)
    lower, upper = box(problem)
    width = upper - lower
    theta = np.array(sample.theta)
    symbol = ca.MX.sym("theta", theta.size)
    f, lam = plant.hardware(symbol)
    slopes = ca.Function("slopes", [symbol], [ca.jacobian(f, symbol), ca.jacobian(lam, symbol)])
    dlam = np.array(slopes(theta)[1])

    def gradient_at(point: BandwidthSample) -> Array:
        own = np.array(slopes(np.array(point.theta))[0]).ravel()
        return (problem.w1 * own + problem.w2 * np.array(point.gradient)) * width

    gradient = gradient_at(sample)
    values = constraint_values(plant, theta)
    rows, labels, slack = [], [], []
    for value, row, name in zip(values, dlam.reshape(-1, theta.size), plant.constraint_names,
                                strict=True):  # fmt: skip
        if value >= -ACTIVE:
            rows.append(row * width)
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
    mu = nnls(A.T, -gradient)[0] if rows else np.zeros(0)
    residual, level, apart = gradient + A.T @ mu, np.zeros((0, theta.size)), 0.0
    equal = [own for own in sample.channels if own[0] <= (1.0 + KINK) * sample.bandwidth]
    if len(equal) > 1 and np.abs(residual).max() > STATIONARY * size:
        each = np.array([gradient_at(replace(sample, gradient=slope)) for _, slope in equal])
        share, mu = _combined(each, A, size)
        residual = share @ each + A.T @ mu
        held = np.array([slope for _, slope in equal])[share > 0.0] * width
        level = held[1:] - held[0]  # along the kink these stay equal
        past = np.array([value for value, _ in equal]) - sample.bandwidth
        apart = float(np.abs(problem.w2 * share * past).max())
    bound = np.vstack([A[mu > 0.0], level])
    Z = null_space(bound) if len(bound) else np.eye(theta.size)
    second: float | None = np.inf if Z.shape[1] == 0 else None
    if second is None and truth is not None and not len(level):
        second = _second(problem, truth, theta, Z, size, gradient_at)
    primal = max(0.0, *(-np.minimum(theta - lower, upper - theta) / width), *values, 0.0)
    return KktCertificate(
        stationarity=float(np.abs(residual).max()) / size,
        primal=float(primal),
        complementarity=float(np.abs(mu * np.array(slack)).max(initial=apart)) / size,
        multipliers={name: float(value) for name, value in zip(labels, mu, strict=True)},
        active=tuple(labels),
        second_order=second,
        objective_gradient=tuple(map(float, gradient)),
    )


def _combined(gradients: Array, A: Array, size: float) -> tuple[Array, Array]:
    """Shares α >= 0 of sum 1 and μ >= 0 with the least ‖Σ α_i ∇J_i + Aᵀμ‖."""
    heavy = 1e4 * size  # what a row of a least-squares problem weighs that has to be met
    columns = np.hstack([gradients.T, A.T])
    total = heavy * (np.arange(columns.shape[1]) < len(gradients))
    goal = np.append(np.zeros(len(columns)), heavy)
    found = nnls(np.vstack([columns, total]), goal)[0]
    share = found[: len(gradients)]
    return share / share.sum(), found[len(gradients) :] / share.sum()


def _second(
    problem: CoDesignProblem,
    truth: TrueBandwidth,
    theta: Array,
    Z: Array,
    size: float,
    gradient_at: Callable[[BandwidthSample], Array],
) -> float | None:
    """Least eigenvalue of Zᵀ∇²J Z by differences of true gradients; λ's own curvature is left out.

    None where a neighbour is outside the box or has no gradient.
    """
    lower, upper = box(problem)
    columns = []
    for direction in Z.T:
        ends = [theta + sign * 10.0 * STEP * direction * (upper - lower) for sign in (1.0, -1.0)]
        if any((end < lower).any() or (end > upper).any() for end in ends):
            return None
        slopes = [gradient_at(truth.at(end)) for end in ends]
        columns.append((slopes[0] - slopes[1]) / (20.0 * STEP))
    H = Z.T @ np.array(columns).T
    if not np.isfinite(H).all():
        return None
    return float(np.linalg.eigvalsh(0.5 * (H + H.T)).min()) / size
