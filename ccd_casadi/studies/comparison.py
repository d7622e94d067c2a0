"""Methods side by side on one case; hardware of least cost f(θ) first in the sequential one."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from time import perf_counter
from typing import Any

import casadi as ca
import numpy as np

from ccd_casadi.cases.tables import Case
from ccd_casadi.codesign import FORMULATIONS
from ccd_casadi.codesign.formulations import formulation_of
from ccd_casadi.codesign.outer_problem import NonlinearProgram, OuterFailure, solve_program
from ccd_casadi.codesign.run import co_design
from ccd_casadi.codesign.verified import Solution
from ccd_casadi.inner_problem.objective import constraint_sizes, objective, violations
from ccd_casadi.inner_problem.problem import CoDesignProblem, box, plant_of
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.plants.modal import modal_plant
from ccd_casadi.plants.plant import Evaluate, hardware_cost, mechanics
from ccd_casadi.sampling.inner_samples import spent_entry
from ccd_casadi.sampling.sampler import Sampler, TraceEntry
from ccd_casadi.sampling.store import SampleStore
from ccd_casadi.studies.steepest_descent import (
    AnyDesign,
    Descent,
    Gradient,
    baseline_of,
    run_entry,
    steepest_descent,
)
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.casadi_callback import VectorCallback
from ccd_casadi.support.json_files import json_values
from ccd_casadi.support.process_pool import Pool, results
from ccd_casadi.support.terminal import Progress
from ccd_casadi.support.text import HZ, versions
from ccd_casadi.support.worker_process import one_blas_thread
from surrogates import design, latin_hypercube


@dataclass(frozen=True)
class HardwareOptions:
    """Numbers of the sequential hardware design, on cheap models of a plant of finite elements.

    Attributes
    ----------
    rounds : int
        Solves at most, each on a model through the last solutions.
    tolerance : float
        Relative difference of ω_1 between model and plant at which they end, and by which ω_1 may
        be below its bound.
    model_points : int
        The last θ at which the plant is evaluated, through which a model passes.
    """

    rounds: int = 8
    tolerance: float = 1e-6
    model_points: int = 3


@dataclass(frozen=True)
class HardwareDesign:
    """The hardware θ of least cost by the rule of thumb, its cost f(θ) and ω_1.

    `met`: whether it meets the rule and the constraints; if not, it has the largest ω_1 found.
    """

    theta: tuple[float, ...]
    hardware_cost: float
    first_resonance: float
    met: bool


def first_resonance(
    problem: CoDesignProblem, theta: Array, evaluate: Evaluate | None = None
) -> tuple[float, Array]:
    """Compute the first resonance ω_1 and its slope ∂ω_1/∂θ = φᵀ(K' - ω_1² M')φ/(2ω_1).

    Parameters
    ----------
    problem : CoDesignProblem
    theta : array (n,)
        SI.
    evaluate : callable or None
        A model in place of the plant.

    Returns
    -------
    float
        rad/s, of the first flexible mode; NaN where all modes are rigid.
    array (n,)
    """
    system = (evaluate or partial(mechanics, plant_of(problem)))(tuple(theta))
    modal = modal_plant(system, problem.suspension.free)
    flexible = np.flatnonzero(~modal.rigid & ~modal.driven_away)
    if flexible.size == 0:
        return np.nan, np.full(len(theta), np.nan)
    i = int(flexible[0])
    omega = float(modal.natural[i])
    eigenvalue_slope = modal.dK[:, i, i] - omega**2 * modal.dM[:, i, i]
    return omega, eigenvalue_slope / (2.0 * omega)


def design_hardware(
    problem: CoDesignProblem,
    resonance: float,
    *,
    starts: int = 8,
    seed: int = 0,
    workers: Pool | None = None,
    options: HardwareOptions = HardwareOptions(),
) -> HardwareDesign:
    """Minimise f(θ) over ω_1(θ) >= resonance, λ(θ) <= 0 and the box of θ, by IPOPT.

    Parameters
    ----------
    resonance : float
        rad/s.
    starts : int
        Sobol points from which it is solved besides the case's start. With none it is the local
        optimum next to that start, which need not be the least one (for the two masses it is the
        paper's equal-mass design).
    """
    points = [problem.start]
    if starts > 0:
        points += map(tuple, design("sobol", *box(problem), starts, seed).tolist())
    tasks = {start: (problem, resonance, start, options) for start in points}
    ends = [end for _, end in sorted(results(workers, _from_start, tasks))]
    highest = max(ends, key=lambda end: end.first_resonance)
    feasible = (end for end in ends if end.met)
    return min(feasible, key=lambda end: end.hardware_cost, default=highest)


def _from_start(
    problem: CoDesignProblem, resonance: float, start: tuple[float, ...], options: HardwareOptions
) -> HardwareDesign:
    """The local optimum next to a start; of an expensive plant by a sequence of models, each exact
    at the last solutions."""
    plant = plant_of(problem)
    solutions: tuple[tuple[float, ...], ...] = (start,)
    for _ in range(options.rounds):
        model = None if plant.nearby is None else plant.nearby(solutions)
        point, predicted = _least_cost(problem, resonance, solutions[-1], model)
        omega = predicted if model is None else first_resonance(problem, point)[0]
        theta = tuple(float(v) for v in point)
        if abs(predicted / omega - 1.0) <= options.tolerance or np.isnan(omega):
            break
        solutions = (*solutions[1 - options.model_points :], theta)
    met = bool(omega >= resonance * (1.0 - options.tolerance)) and not violations(problem, point)
    return HardwareDesign(theta, hardware_cost(plant, point), omega, met)


def _least_cost(
    problem: CoDesignProblem, resonance: float, start: tuple[float, ...], evaluate: Evaluate | None
) -> tuple[Array, float]:
    """Minimise f(θ)/|f(start)| over ln(resonance/ω_1) <= 0 and λ/size <= 0 from a start: θ and ω_1.

    The start where IPOPT fails. `evaluate`: a model in place of the plant.
    """
    plant = plant_of(problem)
    theta = ca.MX.sym("theta", len(start))
    cost, lam = plant.hardware(theta)
    resonance_at = lru_cache(maxsize=None)(
        lambda point: first_resonance(problem, np.array(point), evaluate)
    )
    log_ratio = VectorCallback(
        "first_resonance", len(start), 1,
        lambda x: np.array([np.log(resonance_at(tuple(x))[0] / resonance)]),
        lambda x: resonance_at(tuple(x))[1][None] / resonance_at(tuple(x))[0],
    )  # fmt: skip
    program = NonlinearProgram(
        x=theta,
        f=cost / (abs(hardware_cost(plant, start)) or 1.0),
        g=ca.vertcat(-log_ratio(theta), lam / ca.DM(constraint_sizes(problem))),
        box=box(problem),
        exact_hessian=False,
    )
    try:
        point = solve_program(program, np.array([start])).best.x
    except OuterFailure:
        point = np.array(start)
    return point, resonance_at(tuple(point))[0]


@dataclass(frozen=True)
class Method:
    """One method's entry: its JSON figures, its path over θ, and J against syntheses spent.

    `controller` (SI) is that of its design; None where it found none.
    """

    name: str
    figures: dict[str, Any]
    path: tuple[tuple[float, ...], ...]
    trace: tuple[TraceEntry, ...]
    solution: Solution | None = None
    controller: StateSpace | None = None


@dataclass(frozen=True)
class _Setting:
    """The setting that every method is given: stores go to `folder`."""

    case: Case
    problem: CoDesignProblem
    folder: Path
    workers: Pool
    seed: int
    quiet: bool

    def store(self, name: str) -> SampleStore:
        return SampleStore(self.folder / f"samples_{name}.sqlite")


@dataclass(frozen=True)
class Comparison:
    """All methods on one case.

    Attributes
    ----------
    case : Case
    problem : CoDesignProblem
    methods : tuple of Method
    descents : tuple of Descent
        Of which the best of each gradient is among the methods.
    seconds : float
    """

    case: Case
    problem: CoDesignProblem
    methods: tuple[Method, ...]
    descents: tuple[Descent, ...]
    seconds: float

    def method(self, name: str) -> Method:
        """The method of that name."""
        return next(method for method in self.methods if method.name == name)


@one_blas_thread
def compare(
    case: Case, problem: CoDesignProblem, folder: Path, workers: Pool, *, seed: int, quiet: bool
) -> Comparison:
    """Run every method, each with its own store and count.

    With a controller of fixed structure the descents and the sequential designs climb from the
    warm starts of the best formulation, and its search is not counted as theirs; the descent with K
    held fixed sweeps weights, which sections do not have, and is left out.

    Parameters
    ----------
    case, problem : Case, CoDesignProblem
        What is solved.
    folder, workers, seed, quiet : path, Pool, int, bool
        Of the stores; processes; of every random choice; whether without progress on stderr.

    Returns
    -------
    Comparison
    """
    began = perf_counter()
    given = _Setting(case, problem, folder, workers, seed, quiet)
    methods = [_formulation(given, name) for name in FORMULATIONS]
    problem = _choose_plant(problem, methods)
    given = replace(given, problem=problem)
    descents = _descents(given)
    methods += [_best_descent(problem, descents, each, workers)
                for each in baseline_of(problem).gradients]  # fmt: skip
    methods += [_sequential(given, "sequential", 0), _sequential(given, "sequential_global", 8)]
    return Comparison(case, problem, tuple(methods), tuple(descents), perf_counter() - began)


def _choose_plant(problem: CoDesignProblem, methods: Sequence[Method]) -> CoDesignProblem:
    """The problem with the design plant of the best formulation, where the case leaves it open.

    And with what its search has added: warm starts and plants of a fixed structure.
    """
    ends = [
        (method.figures["objective"], method.solution.verified.problem)
        for method in methods
        if method.solution is not None and method.solution.verified is not None
    ]
    return min(ends, key=lambda end: end[0])[1] if ends else problem


def _formulation(given: _Setting, name: str) -> Method:
    began = perf_counter()
    with given.store(name) as store:
        sampler = Sampler(given.problem, store, given.workers, quiet=given.quiet)
        solution = co_design(sampler, formulation_of(given.case, name), given.seed)
        trace = tuple(sampler.trace)
    figures = solution.result | {"seconds": perf_counter() - began}
    path = tuple(iterate.theta for iterate in solution.outcome.iterates)
    if solution.verified is not None:
        path = (*path, solution.verified.theta)
        figures["first_resonance_hz"] = _resonance(given.problem, solution.verified.theta)
    made = None if solution.verified is None else solution.verified.controller
    return Method(name, figures, path, trace, solution=solution, controller=made)


def _descents(given: _Setting) -> list[Descent]:
    """Both gradients from every start with every first step."""
    base, problem = given.case.baseline, given.problem
    lower, upper = box(problem)
    starts = [problem.start]
    if base.starts > 1:
        spread = latin_hypercube(lower, upper, base.starts - 1, given.seed)
        starts += [tuple(float(v) for v in theta) for theta in spread]
    tasks = {
        (gradient, start, step): (problem, start, gradient, step, base.max_iterations)
        for gradient in baseline_of(problem).gradients
        for start in starts
        for step in base.steps
    }
    bar = Progress(len(tasks), "steepest descent", quiet=given.quiet)
    return [run for _, run in sorted(bar.over(results(given.workers, steepest_descent, tasks)))]


def _best_descent(
    problem: CoDesignProblem, descents: Sequence[Descent], gradient: Gradient, workers: Pool
) -> Method:
    """The descent of that gradient with the best J, fewest syntheses among equals."""
    runs = [descent for descent in descents if descent.gradient is gradient]
    best = min(runs, key=lambda d: (round(d.objective, 9), d.syntheses))
    name = "steepest_descent" if gradient is Gradient.FIXED else "steepest_descent_total"
    extra = run_entry(best) | {
        "runs": len(runs),
        "syntheses_of_all_runs": sum(run.syntheses for run in runs),
        "history": [asdict(iterate) for iterate in best.iterates],
    }
    spent = {"descent": best.syntheses}
    if best.design is None:
        figures = {"status": "infeasible", "reason": best.stop.value, **spent_entry(spent)}
        return Method(name, json_values(figures | extra), (), ())
    theta = best.iterates[-1].theta
    made, figures = _figures(problem, theta, best.design, spent, best.seconds, workers)
    figures |= extra
    trace = tuple(
        TraceEntry(item.syntheses, item.theta, item.bandwidth, item.objective)
        for item in best.iterates
    )
    path = tuple(item.theta for item in best.iterates)
    return Method(name, json_values(figures), path, trace, controller=made)


def _sequential(given: _Setting, name: str, starts: int) -> Method:
    began, problem = perf_counter(), given.problem
    resonance = HZ * given.case.baseline.first_resonance_hz
    hardware: HardwareDesign = design_hardware(
        problem, resonance, starts=starts, seed=given.seed, workers=given.workers
    )
    with given.store(name) as store:
        sampler = Sampler(problem, store, given.workers)
        sample = sampler.values(np.array(hardware.theta))[0]
        trace = tuple(sampler.trace)
        spent = sampler.spent.by_purpose
        if not sample.feasible:
            figures = {"status": "infeasible", "reason": sample.shortfall, **spent_entry(spent)}
            return Method(name, figures, (hardware.theta,), trace)
    design = baseline_of(problem).design_of(sample)
    seconds = perf_counter() - began
    made, figures = _figures(problem, hardware.theta, design, spent, seconds, given.workers)
    figures |= {"resonance_met": hardware.met, "active": list(sample.active)}
    return Method(name, json_values(figures), (hardware.theta,), trace, controller=made)


def _figures(
    problem: CoDesignProblem,
    theta: tuple[float, ...],
    design: AnyDesign,
    spent: dict[str, int],
    seconds: float,
    workers: Pool,
) -> tuple[StateSpace, dict[str, Any]]:
    """The controller of a design that no formulation made, and the contract's keys for it, with
    what it survives: it may look better than a run's by not having been asked."""
    baseline = baseline_of(problem)
    own = baseline.figures(theta, design)
    made, line = baseline.judge(theta, design, workers)
    return made, {
        **own,
        "verdict": {"survives": line.entry},
        "theta": dict(zip(problem.names, theta, strict=True)),
        "hardware_cost": hardware_cost(plant_of(problem), theta),
        "objective": objective(problem, theta, HZ * own["bandwidth_hz"]),
        "first_resonance_hz": _resonance(problem, theta),
        "surrogate_bandwidth_hz": None,
        "verification_error": None,
        **spent_entry(spent),
        "seconds": seconds,
        "versions": versions(),
    }


def _resonance(problem: CoDesignProblem, theta: tuple[float, ...]) -> float:
    return first_resonance(problem, np.array(theta))[0] / HZ
