"""The sequential baseline: hardware first, by a rule of thumb, then the controller once.

    min f(θ)  s.t.  first resonance >= f_1,  θ_min <= θ <= θ_max,  λ(θ) <= 0

with exact eigenvalue derivatives dλ_1 = φᵀ(dK - λ_1 dM)φ, and then the inner problem at that θ.
Where each θ is a finite-element model, IPOPT runs on what is known near the last end (`nearby`),
until the elements agree there.
"""

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

ROUNDS, AGREED, KNOWN = 8, 1e-6, 3  # of a solve on what is known; relative in ω_1; θ that are known


@dataclass(frozen=True)
class HardwareDesign:
    """The hardware that the rule of thumb gives; resonance in rad/s; `met` False: none meets it."""

    theta: tuple[float, ...]
    hardware_cost: float
    first_resonance: float
    met: bool


def first_resonance(
    problem: CoDesignProblem, theta: Array, evaluate: Evaluate | None = None
) -> tuple[float, Array]:
    """ω_1 of the first flexible mode, rad/s, and its gradient to θ; NaN where all is rigid."""
    system = (evaluate or partial(mechanics, plant_of(problem)))(tuple(theta))
    modal = modal_plant(system, problem.suspension.free)
    flexible = np.flatnonzero(~modal.rigid)
    if flexible.size == 0:
        return np.nan, np.full(len(theta), np.nan)
    i = int(flexible[0])
    omega = float(modal.natural[i])
    slope = modal.dK[:, i, i] - omega**2 * modal.dM[:, i, i]
    return omega, slope / (2.0 * omega)


def design_hardware(
    problem: CoDesignProblem,
    resonance: float,
    *,
    starts: int = 8,
    seed: int = 0,
    workers: Pool | None = None,
) -> HardwareDesign:
    """The least hardware cost with ω_1 >= `resonance` (rad/s), by IPOPT.

    From the case's start and `starts` more: with none, the local solution next to the start,
    which need not be the least one (for the two masses it is the paper's equal-mass design).
    """
    points = [problem.start]
    if starts > 0:
        points += map(tuple, design("sobol", *box(problem), starts, seed).tolist())
    tasks = {start: (problem, resonance, start) for start in points}
    found = [design for _, design in sorted(results(workers, _from_start, tasks))]
    nearest = max(found, key=lambda item: item.first_resonance)
    meeting = (item for item in found if item.met)
    return min(meeting, key=lambda item: item.hardware_cost, default=nearest)


def _from_start(
    problem: CoDesignProblem, resonance: float, start: tuple[float, ...]
) -> HardwareDesign:
    plant = plant_of(problem)
    known: tuple[tuple[float, ...], ...] = (start,)
    for _ in range(ROUNDS):
        evaluate = None if plant.nearby is None else plant.nearby(known)
        point, predicted = _least_cost(problem, resonance, known[-1], evaluate)
        omega = predicted if evaluate is None else first_resonance(problem, point)[0]
        theta = tuple(float(v) for v in point)
        if abs(predicted / omega - 1.0) <= AGREED or np.isnan(omega):
            break
        known = (*known[1 - KNOWN :], theta)
    met = bool(omega >= resonance * (1.0 - AGREED)) and not violated(problem, point)
    return HardwareDesign(theta, hardware_cost(plant, point), omega, met)


def _least_cost(
    problem: CoDesignProblem, resonance: float, start: tuple[float, ...], evaluate: Evaluate | None
) -> tuple[Array, float]:
    """θ of the least cost near a start, and ω_1 there, by one way to evaluate the plant."""
    plant = plant_of(problem)
    theta = ca.MX.sym("theta", len(start))
    cost, lam = plant.hardware(theta)
    at = lru_cache(maxsize=None)(lambda point: first_resonance(problem, np.array(point), evaluate))
    callback = VectorCallback(
        "first_resonance", len(start), 1,
        lambda x: np.array([np.log(at(tuple(x))[0] / resonance)]),
        lambda x: at(tuple(x))[1][None] / at(tuple(x))[0],
    )  # fmt: skip
    program = NonlinearProgram(
        x=theta,
        f=cost / (abs(hardware_cost(plant, start)) or 1.0),
        g=ca.vertcat(-callback(theta), lam / ca.DM(constraint_sizes(problem))),
        box=box(problem),
        exact_hessian=False,
    )
    try:
        point = solve_program(program, np.array([start])).best.x
    except OuterFailure:
        point = np.array(start)
    return point, at(tuple(point))[0]
