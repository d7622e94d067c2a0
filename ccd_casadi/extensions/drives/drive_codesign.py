"""Machine and cascade together: θ by a search without derivatives, the cascade carried along.

    min w1 f(θ) + w2 ω_b(θ)   s.t.  lower <= θ <= upper,  λ(θ) <= 0

ω_b(θ) is that of the fastest cascade before rounding. At the first θ it is searched from every
start, at each further one from the parameters at the best θ so far, scaled by what the mass that
the force moves has become; so it is a lower estimate of ω_b(θ) there. Parameters from lists are
tried value by value. COBYQA (Ragonneau and Zhang, SciPy) moves the others.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.optimize import Bounds as Box
from scipy.optimize import NonlinearConstraint, minimize

from ccd_casadi.extensions.drives.cascade_search import Candidate, Search
from ccd_casadi.extensions.drives.drive_case import DriveProblem
from ccd_casadi.extensions.drives.drive_design import (
    NO_CASCADE,
    DriveOptions,
    first_points,
    plants_at,
)
from ccd_casadi.inner_problem.problem import CoDesignProblem, plant_of, with_ports
from ccd_casadi.inner_problem.structured_bandwidth import require_bandwidth
from ccd_casadi.inner_problem.structured_plant_set import uncertain_plant
from ccd_casadi.plants.plant import constraint_values, hardware_cost
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import UserError
from ccd_casadi.support.terminal import Tell, silent
from ccd_casadi.support.text import HZ, number


@dataclass(frozen=True)
class DriveCodesignOptions:
    """Numbers of the search over θ.

    Attributes
    ----------
    evaluations : int
        θ that are tried for each combination of listed values, at most.
    first, last : float
        Steps of θ at the start and at the end, as shares of the box.
    penalty : float
        J of a θ without a cascade, over |J| of the first one.
    met : float
        λ that counts as met.
    drive : DriveOptions
    """

    evaluations: int = 20
    first: float = 0.2
    last: float = 0.02
    penalty: float = 10.0
    met: float = 1e-9
    drive: DriveOptions = field(default_factory=DriveOptions)


@dataclass(frozen=True)
class DriveAt:
    """The fastest cascade at one θ, before rounding.

    Attributes
    ----------
    theta : tuple of float
        In the case's units.
    cost, objective : float
        f(θ) and J.
    candidate : Candidate
    mass : float
        kg that the force moves.
    """

    theta: tuple[float, ...]
    cost: float
    objective: float
    candidate: Candidate
    mass: float


def codesign_drive(
    drive: DriveProblem, seed: int = 0, progress: Tell = silent,
    options: DriveCodesignOptions = DriveCodesignOptions(),
) -> tuple[DriveAt, DriveAt]:  # fmt: skip
    """Find the best θ for a drive's cascade, from the case's start, which has to have one.

    Raises UserError where no θ that was tried has a cascade and meets the constraints, or J counts
    another figure than ω_b. Returns what is at the start, and at the best θ.
    """
    problem = drive.problem
    require_bandwidth(problem, "ccd drive --codesign")
    first = _designed(drive, problem.start, None, seed, options)
    if first is None:
        raise UserError(NO_CASCADE)
    best = first
    listed = dict(problem.listed)
    lists = [listed.get(name, (value,)) for name, value in
             zip(problem.names, problem.start, strict=True)]  # fmt: skip
    free = [i for i, name in enumerate(problem.names)
            if name not in listed and problem.upper[i] > problem.lower[i]]  # fmt: skip
    lower, upper = np.array(problem.lower)[free], np.array(problem.upper)[free]
    tried, allowed = 0, meets_constraints(problem, problem.start, options)
    for chosen in itertools.product(*lists):

        def theta_of(share: Array, chosen: Sequence[float] = chosen) -> tuple[float, ...]:
            theta = list(map(float, chosen))
            for i, value in zip(free, lower + share * (upper - lower), strict=True):
                theta[i] = float(value)
            return tuple(theta)

        def objective(share: Array, theta_of=theta_of) -> float:  # type: ignore[no-untyped-def]
            nonlocal best, tried, allowed
            theta = theta_of(share)
            found = _designed(drive, theta, best, seed, options)
            tried += 1
            if (
                found is not None
                and (found.objective < best.objective or not allowed)
                and meets_constraints(problem, theta, options)
            ):
                allowed = True
                best = found
                progress(f"{tried} theta: J {number(best.objective, 6)}, "
                         f"{number(best.candidate.bandwidth / HZ, 4)} Hz")  # fmt: skip
            return options.penalty * abs(first.objective) if found is None else found.objective

        begin = (np.array(best.theta)[free] - lower) / (upper - lower)
        if not free:
            if meets_constraints(problem, theta_of(begin), options):
                objective(begin)
            continue
        limits = NonlinearConstraint(
            lambda share, theta_of=theta_of: constraint_values(plant_of(problem), theta_of(share)),
            -np.inf, 0.0,
        )  # fmt: skip
        minimize(objective, begin, method="COBYQA", bounds=Box(np.zeros(len(free)), 1.0),
                 constraints=[limits] if plant_of(problem).constraint_names else [],
                 options={"maxfev": options.evaluations, "initial_tr_radius": options.first,
                          "final_tr_radius": options.last})  # fmt: skip
    if not allowed:
        raise UserError(f"no theta of {tried} tried meets the constraints; start nearer to one")
    return first, best


def meets_constraints(
    problem: CoDesignProblem, theta: Sequence[float],
    options: DriveCodesignOptions = DriveCodesignOptions(),
) -> bool:  # fmt: skip
    """Whether θ meets the constraints of the plant."""
    values = constraint_values(plant_of(problem), theta)
    return bool((values <= options.met).all())


def _designed(
    drive: DriveProblem, theta: tuple[float, ...], near: DriveAt | None, seed: int,
    options: DriveCodesignOptions,
) -> DriveAt | None:  # fmt: skip
    """The cascade at a θ, from that at another one; None where none meets the bounds."""
    problem, own = drive.problem, options.drive.search
    of = problem if drive.ported is None else with_ports(problem)
    uncertain = uncertain_plant(of, theta)
    plants = plants_at(uncertain, first_points(uncertain))
    search = Search(drive.cascade, drive.bounds, drive.sampling, plants, own)
    if near is None:
        found = search.fastest(seed)
    else:
        values = near.candidate.values * np.where(
            np.arange(len(near.candidate.values)) == 1, search.mass / near.mass, 1.0
        )
        values = np.clip(values, *np.exp([search.low, search.high]))
        found = None
        if search.stable(values):
            found = search.settled(replace(near.candidate, values=values))
        if found is None or not found.excess < own.met:
            few = replace(own, starts=max(1, own.starts // 6))
            found = Search(drive.cascade, drive.bounds, drive.sampling, plants, few).fastest(seed)
    if found is None:
        return None
    cost = hardware_cost(plant_of(problem), theta)
    J = problem.w1 * cost + problem.w2 * found.bandwidth
    return DriveAt(theta, cost, J, found, search.mass)
