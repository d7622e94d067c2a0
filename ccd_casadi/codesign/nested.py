"""The nested formulation: a surrogate of ω_b*(θ), IPOPT on it, truth, refit, until they agree.

ω_b*(θ) has kinks and jumps, which a smooth surrogate cannot follow everywhere. It does not have
to: each round fits the samples in a trust region around the best verified design, which shrinks
where the surrogate promised too much, until prediction and truth agree there.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ccd_casadi.codesign.gaussian_processes import best_left_out, kernels_of
from ccd_casadi.codesign.outer_problem import (
    FormulationResult,
    FormulationRound,
    KnownSamples,
    OuterFailure,
    OuterSolution,
    iterate_of,
    outer_program,
    solve_program,
)
from ccd_casadi.inner_problem.objective import objective, violations
from ccd_casadi.inner_problem.problem import CoDesignProblem, box
from ccd_casadi.optim.pieces import Box
from ccd_casadi.sampling.inner_samples import InnerSample
from ccd_casadi.sampling.sampler import Sampler
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.time_budget import ends_early
from surrogates import GaussianProcess, design, fit, to_casadi


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

    def sample_count(self, variables: int) -> int:
        """Return the number of designs of the plan."""
        return self.points**variables if self.plan == "grid" else self.points


@dataclass(frozen=True)
class NestedRegionOptions:
    """Numbers of the trust region of the nested formulation, in shares of the box of θ."""

    small_step: float = 1e-3  # below which a step counts as none
    least_radius: float = 1e-3
    inaccurate: float = 0.4  # factor of the radius where prediction and truth disagree
    inaccurate_better: float = 0.6  # the same where the truth is better all the same
    failed: float = 0.5  # where it agrees and is no better, or IPOPT does not converge
    grown: float = 2.0  # where it agrees and the region alone ends the step
    whole_step: float = 0.9  # of the radius: such a step is ended by the region


@dataclass(frozen=True)
class NestedState:
    """The state of the nested formulation before a round.

    Attributes
    ----------
    samples : tuple of InnerSample
        All true values.
    radius : float
        Of the region around the best of them, in shares of the box.
    iterates : tuple of FormulationRound
        The rounds so far.
    surrogate, solution : GaussianProcess, OuterSolution
        The last ones.
    agreed : bool
        Whether prediction and truth agreed in the last round.
    """

    samples: tuple[InnerSample, ...]
    radius: float = 1.0
    iterates: tuple[FormulationRound, ...] = ()
    surrogate: GaussianProcess | None = None
    solution: OuterSolution | None = None
    agreed: bool = False

    def with_radius(self, improved: bool, options: NestedRegionOptions) -> "NestedState":
        """After a round: a smaller region where the surrogate promised too much, or a larger one
        where that alone has ended the step; `improved`: whether the truth is better."""
        radius, step = self.radius, self.iterates[-1].step
        if not self.agreed:
            factor = options.inaccurate_better if improved else options.inaccurate
            radius = max(radius * factor, options.least_radius)
        elif not improved:
            radius *= options.failed
        elif step >= options.whole_step * radius:
            radius = min(1.0, options.grown * radius)
        return replace(self, radius=radius)


def solve_nested(
    sampler: Sampler,
    options: Nested,
    *,
    seed: int,
    given: KnownSamples | None = None,
    gradients: bool = False,
    region_options: NestedRegionOptions = NestedRegionOptions(),
) -> FormulationResult:
    """Sample a design over θ, then rounds of fit, IPOPT and truth; the best verified θ wins.

    With `given` samples the design is their θ; `gradients`: the surrogate is fitted to the
    envelope's gradients too.
    """
    problem = sampler.problem
    bounds, n = box(problem), len(problem.names)
    if given is None:
        plan = design(options.plan, *bounds, options.points, seed)
        thetas = _keep_allowed(problem, np.unique(np.vstack([plan, problem.start]), axis=0))
    else:
        thetas = np.array([sample.x[:n] for sample in given])
    state = NestedState(tuple(sampler.values(thetas)))
    if not any(sample.feasible for sample in state.samples):
        return FormulationResult(message="no sampled theta is feasible")

    def refined(state: NestedState, number: int) -> NestedState:
        """Add true inner problems spread over the region around the best θ."""
        region = bounds.around(_best(problem, state.samples).theta, state.radius)
        new = design("lhs", *region, 2 * n + 1, seed + number)
        with sampler.spent.on("rounds"):
            found = sampler.values(_keep_allowed(problem, new), f"refining round {number + 1}")
        return replace(state, samples=(*state.samples, *found))

    for number in range(options.max_refinements + 1):
        if ends_early("sampling round"):
            break
        state = replace(state, samples=tuple(sampler.latest(state.samples)))
        improvements, best = sampler.improvements, _best(problem, state.samples)
        region = bounds.around(best.theta, state.radius)
        local = _local(state.samples, region, bounds)
        if len(local) == 1:  # a feasible sliver: what is fitted has to be found first
            radius = max(region_options.inaccurate * state.radius, region_options.least_radius)
            state = refined(replace(state, radius=radius), number)
            continue
        surrogate = fit_bandwidth(problem, local, seed, options.kernel, gradients)
        state = replace(state, surrogate=surrogate)
        program = outer_program(problem, to_casadi(surrogate, std=False))
        program = replace(program, box=region)
        starts = _starts(problem, local, region, options.starts, seed + number)
        try:
            solution = solve_program(program, starts)
        except OuterFailure:
            state = replace(state, radius=region_options.failed * state.radius)
            continue
        theta = solution.best.x
        predicted = float(surrogate.predict(theta[None, :])[0])
        with sampler.spent.on("rounds"):
            sample = sampler.values(theta, f"verifying round {number + 1}")[0]
        error = float(abs(predicted / sample.value - 1.0)) if sample.feasible else np.inf
        step = float(bounds.away(theta, best.theta))
        figures = {"error": error, "step": step, "radius": state.radius}
        iterate = iterate_of(problem, sample.theta, predicted, sample.value, **figures)
        state = replace(
            state, samples=(*state.samples, sample), iterates=(*state.iterates, iterate),
            solution=solution, agreed=error <= options.tolerance,
        )  # fmt: skip
        if sampler.improvements > improvements:
            continue  # fitted to worse controllers than are known now
        change = iterate.objective - objective(problem, best.theta, best.value)
        settled = abs(change) <= options.tolerance * abs(iterate.objective)
        if state.agreed and (step <= region_options.small_step or settled):
            break
        state = state.with_radius(change < 0.0, region_options)
        if not state.agreed:
            state = refined(state, number)
    best = _best(problem, sampler.latest(state.samples))
    message = "" if state.agreed else "prediction and truth did not agree within the budget"
    surrogates = () if state.surrogate is None else (state.surrogate,)
    return FormulationResult(
        best.joint, state.iterates, surrogates, state.solution, state.agreed, message
    )


def fit_bandwidth(
    problem: CoDesignProblem,
    samples: list[InnerSample],
    seed: int,
    kind: str = "matern52",
    gradients: bool = False,
) -> GaussianProcess:
    """Fit an interpolating Gaussian process of v(θ) over the box.

    Parameters
    ----------
    problem : CoDesignProblem
        Its box of θ, SI.
    samples : list of InnerSample
        True values: ω_b in rad/s, or of another figure in its SI unit.
    seed : int
        Of the search for hyperparameters.
    kind : str
        "matern52", "rbf", or "auto", which predicts left-out samples best.
    gradients : bool
        Whether to fit the gradients of those samples that have one too, if most do.

    Returns
    -------
    GaussianProcess
        v over θ (n_θ,), SI.
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


def _keep_allowed(problem: CoDesignProblem, thetas: Array) -> Array:
    """The points with λ(θ) <= 0; all of them where none has."""
    keep = [not violations(problem, theta) for theta in thetas]
    return thetas[keep] if any(keep) else thetas


def _best(problem: CoDesignProblem, samples: Sequence[InnerSample]) -> InnerSample:
    feasible = [sample for sample in samples if sample.feasible]
    inside = [s for s in feasible if not violations(problem, s.theta)]
    return min(inside or feasible, key=lambda s: objective(problem, s.theta, s.value))


def _local(samples: Sequence[InnerSample], region: Box, bounds: Box) -> list[InnerSample]:
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
