"""The formulations of the outer problem under one name, and the lifted one.

It has smooth surrogates over (θ, ω_S, ω_T), the bounds on S explicit: ω_b, ln‖S‖∞ and ln
σ_max(S(jω_low)) are smooth where ω_b*(θ) is not, so a few dozen designs with their exact gradients
determine them; the same samples answer any S_max, S_low, w1, w2, bounds and λ with no new
synthesis.

The nested one is in `nested`; the direct one has no surrogate.
"""

from dataclasses import dataclass

import numpy as np

from ccd_casadi.cases.controller_tables import OuterTable, SamplingTable
from ccd_casadi.cases.tables import Case
from ccd_casadi.codesign.gaussian_processes import best_left_out, interpolating, kernels_of
from ccd_casadi.codesign.nested import Nested
from ccd_casadi.codesign.outer_problem import (
    FormulationResult,
    FormulationRound,
    KnownSamples,
    OuterFailure,
    OuterSolution,
    iterate_of,
    lifted_bounds,
    outer_program,
    solve_program,
)
from ccd_casadi.inner_problem.objective import constraint_shares, objective
from ccd_casadi.inner_problem.problem import CoDesignProblem
from ccd_casadi.inner_problem.structured_problem import StructuredProblem
from ccd_casadi.sampling.inner_samples import QuantitySample
from ccd_casadi.sampling.sampler import Sampler
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.time_budget import ends_early
from surrogates import GaussianProcess, design, fit_outputs, to_casadi


@dataclass(frozen=True)
class Lifted:
    """Options of the lifted formulation; the defaults are those of a case file.

    Parameters
    ----------
    points : int
        Designs of (θ, ω_S, ω_T); 0: 6 (n_θ + 2). A quadratic in n variables has (n + 1)(n + 2)/2
        coefficients, a sample with gradients n + 1 numbers: 6 n samples are twelve times what it
        needs at n = 4, six times at n = 8.
    starts, tolerance, max_refinements, kernel, box_points
        As for `Nested`.
    """

    points: int = 0
    starts: int = 16
    tolerance: float = 1e-3
    max_refinements: int = 12
    kernel: str = "matern52"
    box_points: int = 32

    def sample_count(self, variables: int) -> int:
        """Return the number of designs of the plan."""
        return self.points or 6 * variables


@dataclass(frozen=True)
class LiftedRoundOptions:
    """Numbers of the rounds of the lifted formulation."""

    small_step: float = 1e-4  # share of the box below which a step counts as none
    settled: float = 0.1  # of the tolerance: a change of J below it counts as none
    refit_growth: float = 1.25  # of the samples, at which hyperparameters are estimated anew
    # ln: how far inside S_max and S_low IPOPT aims: about the surrogates' error at the end, so
    # that the truth is feasible there and the polish has nothing to correct.
    margin: float = 1e-7
    fresh: int = 4  # one in this many starts is new, in a round after the first
    slack: float = 1e-6  # ln: of S_max and S_low, which the polish then corrects


def solve_lifted(
    sampler: Sampler,
    options: Lifted,
    *,
    seed: int,
    given: KnownSamples | None = None,
    rounds: LiftedRoundOptions = LiftedRoundOptions(),
) -> FormulationResult:
    """Sample x = (θ, ln ω_S, ln ω_T), then rounds of fit, IPOPT and one true synthesis.

    With `given` samples the rounds start from these.
    """
    problem = sampler.problem
    bounds, n = lifted_bounds(problem), len(problem.names) + 2
    points = options.sample_count(n)
    if given is None:
        X = design("sobol", *bounds, points, seed)
        samples = [s for s in sampler.quantities(X) if s.certified]
    else:
        samples = [sample for sample in given if isinstance(sample, QuantitySample)]
    if len(samples) < n + 1:
        message = f"only {len(samples)} of {points} designs in the box were certified"
        return FormulationResult(message=message)
    iterates: list[FormulationRound] = []
    incumbent: QuantitySample | None = None
    processes: tuple[GaussianProcess, ...] = ()
    solution: OuterSolution | None = None
    agreed, fitted = False, 0
    for round_number in range(options.max_refinements + 1):
        if incumbent is not None and ends_early("sampling round"):
            break
        if len(samples) >= rounds.refit_growth * fitted:
            processes = fit_quantities(problem, samples, seed, kind=options.kernel)
            fitted = len(samples)
        elif len(samples) > len(processes[0].X):
            processes = update_quantities(samples, processes)
        program = outer_program(problem, to_casadi(processes, std=False), margin=rounds.margin)
        spread = design("sobol", *bounds, options.starts, seed + round_number)
        if incumbent is not None:
            # One sample moves the surrogates' optima, and seldom makes one: the last round's lead.
            known = [] if solution is None else [optimum.x for optimum in solution.optima]
            spread = np.vstack([incumbent.x, *known, spread[: options.starts // rounds.fresh]])
        try:
            solution = solve_program(program, spread)
        except OuterFailure as error:
            return FormulationResult(None, tuple(iterates), processes, None, False, str(error))
        x = solution.best.x
        predicted = np.array([float(process.predict(x[None, :])[0]) for process in processes])
        with sampler.spent.on("rounds"):
            sample = sampler.quantities(x, f"verifying round {round_number + 1}")[0]
        errors = np.abs(sample.values[:-1] - predicted)  # of ω_b relative, of ln of the bounded
        errors[0] /= sample.values[0]
        iterate = iterate_of(
            problem, sample.x[: len(problem.names)], float(predicted[0]), float(sample.values[0]),
            error=float(errors.max()) if sample.certified else np.inf,
            step=np.inf if incumbent is None else float(bounds.away(x, incumbent.x)),
        )  # fmt: skip
        iterates.append(iterate)
        settled = incumbent is not None and abs(
            iterate.objective - _objective(problem, incumbent)
        ) <= rounds.settled * options.tolerance * abs(iterate.objective)
        if sample.certified:
            samples.append(sample)
            incumbent = _better(problem, incumbent, sample, rounds)
        agreed = iterate.error <= options.tolerance
        if agreed and (iterate.step <= rounds.small_step or settled):
            break
    if incumbent is None:
        message = "no design near the predicted optima meets " + ", ".join(problem.inner.bounds)
        return FormulationResult(None, tuple(iterates), processes, solution, False, message)
    x = np.array(incumbent.x)
    message = "" if agreed else "prediction and truth did not agree within the budget"
    return FormulationResult(x, tuple(iterates), processes, solution, agreed, message)


def fit_quantities(
    problem: CoDesignProblem, samples: list[QuantitySample], seed: int, kind: str = "matern52"
) -> tuple[GaussianProcess, ...]:
    """Processes of ω_b (rad/s) and ln of each bounded figure over x = (θ, ln ω_S, ln ω_T)."""
    lower, upper = lifted_bounds(problem)
    X, Y, dY = _arrays(samples)
    found = [
        fit_outputs(X, Y, lower=lower, upper=upper, dY=dY, seed=seed, starts=1, kernel=kernel)
        for kernel in kernels_of(kind)
    ]
    return tuple(best_left_out(each) for each in zip(*found, strict=True))


def update_quantities(
    samples: list[QuantitySample], processes: tuple[GaussianProcess, ...]
) -> tuple[GaussianProcess, ...]:
    """The same processes on more samples."""
    X, Y, dY = _arrays(samples)
    return tuple(interpolating(each, X, Y[:, i], dY[:, i]) for i, each in enumerate(processes))


def _arrays(samples: list[QuantitySample]) -> tuple[Array, Array, Array]:
    """x (N, n), outputs (N, k) and their slopes (N, k, n): ω_b and ln of each bounded figure."""
    rows = [(sample.x, sample.values[:-1], sample.gradients[:-1]) for sample in samples]
    X, Y, dY = map(np.array, zip(*rows, strict=True))
    return X, Y, dY


def _objective(problem: CoDesignProblem, sample: QuantitySample) -> float:
    return objective(problem, sample.x[: len(problem.names)], sample.values[0])


def _better(
    problem: CoDesignProblem, incumbent: QuantitySample | None, sample: QuantitySample,
    options: LiftedRoundOptions,
) -> QuantitySample:  # fmt: skip
    """The sample with less violation beyond the slack, of λ in shares of its size, of a bound in
    ln; among feasible ones the better J."""

    def rank(s: QuantitySample) -> tuple[float, float]:
        lam = constraint_shares(problem, s.x[: len(problem.names)])
        over = np.concatenate([s.values[1:-1] - problem.inner.levels + options.margin, lam]).max()
        return max(0.0, float(over) - options.slack), _objective(problem, s)

    return sample if incumbent is None else min(incumbent, sample, key=rank)


@dataclass(frozen=True)
class SurrogateLimits:
    """Limits up to which surrogates are fast: docs/development/method.md."""

    parameters: int = 12  # that a fit pays for
    samples: int = 1000  # inner problems of a plan over θ, some minutes


@dataclass(frozen=True)
class Direct:
    """Options of the direct formulation: local solves on the truth.

    Parameters
    ----------
    starts : int
        The start of the case, and a Sobol set over the box.
    tolerance : float
        Of the inner problem.
    box_points : int
        True inner problems over the box in the global check at the end.
    """

    starts: int = 4
    tolerance: float = 1e-3
    box_points: int = 32

    def sample_count(self, variables: int) -> int:
        """Return the number of designs of the plan."""
        return self.starts


Formulation = Nested | Lifted | Direct


def formulation_of(case: Case | None, name: str) -> Formulation:
    """The formulation of that name.

    Parameters
    ----------
    case : Case or None
        Whose [sampling] and [outer] give the options; without one they are the defaults.
    name : str
        "nested", "lifted" or "direct".

    Returns
    -------
    Nested, Lifted or Direct
        The options by which it is solved.
    """
    outer = OuterTable() if case is None else case.outer
    sampling = SamplingTable() if case is None else case.sampling
    rounds = (outer.starts, outer.tolerance, outer.max_refinements, outer.surrogate)
    if name == "nested":
        return Nested(sampling.design, sampling.points, *rounds, outer.box_points)
    if name == "lifted":
        return Lifted(sampling.lifted_points, *rounds, outer.box_points)
    return Direct(outer.direct_starts, outer.tolerance, outer.box_points)


def usual_name(case: Case, parameters: int) -> str:
    """The formulation where the user names none: nested, or direct where nested is too slow.

    With sections, of which each θ takes a second, it is lifted where that samples fewer θ;
    `direct_starts = 1` says that each θ is expensive: none is sampled.

    Parameters
    ----------
    case : Case
        The case file.
    parameters : int
        n_θ.

    Returns
    -------
    str
        "nested", "lifted" or "direct".
    """
    listed = any(len(one.values) > 1 for one in case.theta)
    return _usual(case, parameters, case.controller.structure == "sections", listed)


def usual_formulation(problem: CoDesignProblem) -> Formulation:
    """The same of a problem, whose case's [sampling] and [outer] are not known: with defaults."""
    sections = isinstance(problem.controller, StructuredProblem)
    return formulation_of(None, _usual(None, len(problem.names), sections, bool(problem.listed)))


def _usual(case: Case | None, parameters: int, sections: bool, listed: bool) -> str:
    nested, lifted = formulation_of(case, "nested"), formulation_of(case, "lifted")
    dear = listed or (case is not None and case.outer.direct_starts == 1)
    if (sections and dear) or slow_words(nested, parameters):
        return "direct"
    fewer = nested.sample_count(parameters) > lifted.sample_count(parameters)
    return "lifted" if sections and fewer else "nested"


def slow_words(
    formulation: Formulation, parameters: int, limits: SurrogateLimits = SurrogateLimits()
) -> str:
    """Explain why a formulation is slow.

    Parameters
    ----------
    formulation : Nested, Lifted or Direct
        With its plan of samples.
    parameters : int
        n_θ.
    limits : SurrogateLimits
        Up to where surrogates are fast.

    Returns
    -------
    str
        One line; empty where it is not slow.
    """
    why = ""
    if isinstance(formulation, Direct):
        return why
    if isinstance(formulation, Nested) and formulation.plan == "grid":
        count = formulation.sample_count(parameters)
        why = f"its grid is {count:.3g} inner problems" if count > limits.samples else ""
    if not why and parameters > limits.parameters:
        why = f"its surrogates are for {limits.parameters} at most"
    name = type(formulation).__name__.lower()
    return f"{name} is slow with {parameters} parameters: {why}; direct is not" if why else ""
