"""The nested formulation: a surrogate of ω_b*(θ), IPOPT on it, truth, refit, until they agree.

ω_b*(θ) has kinks and jumps, which a smooth surrogate cannot follow everywhere. It does not have
to: each round fits the samples in a trust region around the best verified design, which shrinks
where the surrogate promised too much, until prediction and truth agree there.
"""

from dataclasses import dataclass, replace

import numpy as np

from ccd_casadi.codesign.formulation import FormulationResult, Iterate, KnownSamples, iterate_of
from ccd_casadi.codesign.gaussian_processes import best_left_out, kernels_of
from ccd_casadi.codesign.outer_problem import (
    OuterFailure,
    OuterSolution,
    outer_program,
    solve_program,
)
from ccd_casadi.inner_problem.objective import objective, violated
from ccd_casadi.inner_problem.problem import CoDesignProblem, box
from ccd_casadi.optim.pieces import Box
from ccd_casadi.sampling.sampler import Sampler
from ccd_casadi.sampling.samples import InnerSample
from ccd_casadi.support.arrays import Array
from surrogates import GaussianProcess, design, fit, to_casadi

STEP = 1e-3  # share of the box below which a step counts as small


@dataclass(frozen=True)
class Nested:
    """Options of the nested formulation; the defaults are those of a case file.

    Parameters
    ----------
    plan : str
        "grid", "sobol" or "lhs" over θ.
    points : int
        Along each axis of a grid, else in all.
    starts : int
        Of IPOPT in a round.
    tolerance, max_refinements : float, int
        Prediction and truth agree within it (relative), or after this many rounds at the latest.
    kernel : str
        "matern52", "rbf", or "auto", which predicts left-out samples best.
    box_points : int
        True inner problems over the box in the global check at the end.
    """

    plan: str = "grid"
    points: int = 5
    starts: int = 16
    tolerance: float = 1e-3
    max_refinements: int = 12
    kernel: str = "matern52"
    box_points: int = 32

    def sampled(self, variables: int) -> int:
        """How many designs the plan has."""
        return self.points**variables if self.plan == "grid" else self.points


def solve_nested(
    sampler: Sampler,
    options: Nested,
    *,
    seed: int,
    given: KnownSamples | None = None,
    gradients: bool = False,
) -> FormulationResult:
    """Sample a design over θ, then rounds of fit, IPOPT and truth; the best verified θ wins.

    With `given` samples the design is their θ; `gradients`: the surrogate is fitted to the
    envelope's gradients too.
    """
    problem = sampler.problem
    bounds, n = box(problem), len(problem.names)
    if given is None:
        plan = design(options.plan, *bounds, options.points, seed)
        thetas = _allowed(problem, np.unique(np.vstack([plan, problem.start]), axis=0))
    else:
        thetas = np.array([sample.x[:n] for sample in given])
    samples = sampler.values(thetas)
    if not any(sample.feasible for sample in samples):
        return FormulationResult(message="no sampled theta is feasible")
    iterates: list[Iterate] = []

    def refine(number: int) -> None:
        """True inner problems spread over the region around the best θ."""
        region = bounds.around(_best(problem, samples).theta, radius)
        new = design("lhs", *region, 2 * n + 1, seed + number)
        with sampler.spent.on("rounds"):
            samples.extend(sampler.values(_allowed(problem, new), f"refining round {number + 1}"))

    radius, agreed = 1.0, False
    surrogate: GaussianProcess | None = None
    solution: OuterSolution | None = None
    for round_number in range(options.max_refinements + 1):
        samples, improvements = sampler.latest(samples), sampler.improvements
        best = _best(problem, samples)
        region = bounds.around(best.theta, radius)
        local = _local(samples, region, bounds)
        if len(local) == 1:  # a feasible sliver: what is fitted has to be found first
            radius = max(0.4 * radius, 1e-3)
            refine(round_number)
            continue
        surrogate = fit_bandwidth(problem, local, seed, options.kernel, gradients)
        program = outer_program(problem, to_casadi(surrogate, std=False))
        program = replace(program, box=region)
        starts = _starts(problem, local, region, options.starts, seed + round_number)
        try:
            solution = solve_program(program, starts)
        except OuterFailure:
            radius *= 0.5
            continue
        theta = solution.best.x
        predicted = float(surrogate.predict(theta[None, :])[0])
        with sampler.spent.on("rounds"):
            sample = sampler.values(theta, f"verifying round {round_number + 1}")[0]
        error = float(abs(predicted / sample.value - 1.0)) if sample.feasible else np.inf
        step = float(bounds.away(theta, best.theta))
        figures = {"error": error, "step": step, "radius": radius}
        iterate = iterate_of(problem, sample.theta, predicted, sample.value, **figures)
        iterates.append(iterate)
        samples.append(sample)
        change = iterate.objective - objective(problem, best.theta, best.value)
        improved = change < 0.0
        agreed = iterate.error <= options.tolerance
        settled = abs(change) <= options.tolerance * abs(iterate.objective)
        if sampler.improvements > improvements:
            continue  # fitted to worse controllers than are known now
        if agreed and (iterate.step <= STEP or settled):
            break
        if not agreed:
            radius = max(radius * (0.6 if improved else 0.4), 1e-3)
            refine(round_number)
        elif not improved:
            radius *= 0.5
        elif iterate.step >= 0.9 * radius:  # trusted, and stopped by the region alone
            radius = min(1.0, 2.0 * radius)
    best = _best(problem, sampler.latest(samples))
    message = "" if agreed else "prediction and truth did not agree within the budget"
    surrogates = () if surrogate is None else (surrogate,)
    return FormulationResult(best.joint, tuple(iterates), surrogates, solution, agreed, message)


def fit_bandwidth(
    problem: CoDesignProblem,
    samples: list[InnerSample],
    seed: int,
    kind: str = "matern52",
    gradients: bool = False,
) -> GaussianProcess:
    """An interpolating Gaussian process of ω_b*(θ) in rad/s (or the error in m) over the box.

    With `gradients` of those samples that have one, if most do.
    """
    sloped = [sample for sample in samples if np.isfinite(sample.gradient).all()]
    gradients = gradients and len(sloped) > len(samples) // 2
    samples = sloped if gradients else samples
    dY = np.array([sample.gradient for sample in samples]) if gradients else None
    X = np.array([sample.theta for sample in samples])
    Y = np.array([sample.value for sample in samples])
    lower, upper = box(problem)
    noise = 1e-7 * float(np.abs(Y).max())
    return best_left_out(
        fit(X, Y, dY, lower=lower, upper=upper, noise=noise, seed=seed, kernel=kernel)
        for kernel in kernels_of(kind)
    )


def _allowed(problem: CoDesignProblem, thetas: Array) -> Array:
    """The points with λ(θ) <= 0; all of them where none has."""
    keep = [not violated(problem, theta) for theta in thetas]
    return thetas[keep] if any(keep) else thetas


def _best(problem: CoDesignProblem, samples: list[InnerSample]) -> InnerSample:
    feasible = [sample for sample in samples if sample.feasible]
    inside = [s for s in feasible if not violated(problem, s.theta)]
    return min(inside or feasible, key=lambda s: objective(problem, s.theta, s.value))


def _local(samples: list[InnerSample], region: Box, bounds: Box) -> list[InnerSample]:
    """Feasible samples in the region and a margin; the nearest ones where these are too few."""
    feasible = list({s.theta: s for s in samples if s.feasible}.values())
    centre = 0.5 * (region.lower + region.upper)

    def distance(sample: InnerSample) -> float:
        return float(bounds.away(sample.theta, centre))

    reach = 0.75 * float(bounds.away(region.upper, region.lower))
    near = [sample for sample in feasible if distance(sample) <= reach]
    enough = 3 * len(centre) + 2
    return near if len(near) >= enough else sorted(feasible, key=distance)[:enough]


def _starts(
    problem: CoDesignProblem, samples: list[InnerSample], region: Box, count: int, seed: int
) -> Array:
    """The best samples inside the region and a Sobol set over it."""
    low, high = region
    inside = [s for s in samples if (low <= s.theta).all() and (s.theta <= high).all()]
    top = sorted(inside, key=lambda s: problem.w2 * s.value)[: max(1, count // 4)]
    spread = design("sobol", low, high, max(count - len(top), 1), seed)
    return np.vstack([np.array([s.theta for s in top]).reshape(-1, len(low)), spread])
