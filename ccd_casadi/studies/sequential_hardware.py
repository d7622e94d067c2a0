"""The hardware of least cost f(θ) whose first resonance meets a rule of thumb."""

from dataclasses import dataclass
from functools import lru_cache, partial

import casadi as ca
import numpy as np

from ccd_casadi.codesign.outer_problem import NonlinearProgram, OuterFailure, solve_program
from ccd_casadi.inner_problem.objective import constraint_sizes, violated
from ccd_casadi.inner_problem.problem import CoDesignProblem, box, plant_of
from ccd_casadi.plants.modal import modal_plant
from ccd_casadi.plants.plant import Evaluate, hardware_cost, mechanics
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.casadi_callback import VectorCallback
from ccd_casadi.support.process_pool import Pool, results
from surrogates import design


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
    met = bool(omega >= resonance * (1.0 - options.tolerance)) and not violated(problem, point)
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
