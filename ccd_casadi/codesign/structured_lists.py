"""Searches over lists of values with a controller of fixed structure, each near another's end.

All take local steps: of θ and controller together where J counts the bandwidth, else on the true
function. The first begins with a full multi-start search, every other one at the nearest θ and
controller that are known; where that finds no design a few starts are tried at the θ themselves: a
part is not empty for that. What is found so is good for its J; the best combination is then
designed as any other case, from that controller.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import cast

import casadi as ca
import numpy as np

from ccd_casadi.codesign.formulations import Formulation
from ccd_casadi.codesign.outer import ThetaDescentOptions, pieces_from
from ccd_casadi.codesign.outer_problem import (
    FormulationResult,
    NonlinearProgram,
    OuterFailure,
    solve_program,
    unmet_constraint,
)
from ccd_casadi.codesign.outer_structured import StructuredOuter
from ccd_casadi.codesign.stored_searches import printer
from ccd_casadi.codesign.theta_joint import JointSearchOptions, joint_search
from ccd_casadi.codesign.verified import Solution
from ccd_casadi.codesign.verified_structured import VerifiedStructured
from ccd_casadi.inner_problem.controller_problem import BANDWIDTH
from ccd_casadi.inner_problem.objective import (
    ConstraintOptions,
    constraint_shares,
    objective_of,
    objective_terms,
    violations,
)
from ccd_casadi.inner_problem.problem import CoDesignProblem, box, plant_of
from ccd_casadi.inner_problem.searched_problem import (
    Scenario,
    state_of,
    with_state,
    with_warm_start,
)
from ccd_casadi.inner_problem.structured_plant_set import (
    bounds_of,
    plants_of,
    structure_of,
    warm_starts_at,
)
from ccd_casadi.inner_problem.structured_search import with_range
from ccd_casadi.plants.plant import hardware_cost
from ccd_casadi.sampling.sampler import Sampler
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.text import HZ
from surrogates import design


@dataclass(frozen=True)
class ListedOptions:
    """Numbers of the searches over lists.

    Attributes
    ----------
    settled : float
        Share of |w1 f| + |w2 v|, of which J may be a small difference: between the values of a list
        a step that promises less is not taken, as no design is there.
    inside : float
        Of λ, in its unit: by how much a search begins within λ(θ) <= 0.
    """

    settled: float = 1e-3
    inside: float = 1e-7


@dataclass
class ListedStructured:
    """`between`, `search` and `judge` as `best_of_lists` requires them.

    `solve` continues from a θ to a whole co-design. `scenarios`: all plants that were found worse
    than those of the set, at any of the θ; each search adds its own, and the next begins with them.
    """

    formulation: Formulation
    seed: int
    solve: Callable[[Sampler, Array], Solution]
    scenarios: tuple[Scenario, ...] = ()
    options: ListedOptions = ListedOptions()

    def between(self, sampler: Sampler, near: Solution | None) -> Solution:
        """Search as `search` does, to the accuracy that the bound of a part needs."""
        return self.search(sampler, near, self.options.settled)

    def search(
        self, sampler: Sampler, near: Solution | None, settled: float | None = None
    ) -> Solution:
        """The least J that is found with every value in the ranges of the sampler's problem."""
        problem = sampler.problem
        forbidden = unmet_constraint(problem, self.formulation.starts, self.seed)
        if forbidden:
            return _infeasible(forbidden)
        if near is None:
            found = self._search_anew(sampler, settled)
        else:
            found = self._search_near(sampler, near, settled)
        if found.problem is not None:
            self.scenarios = state_of(found.problem).scenarios
        return found

    def _search_anew(self, sampler: Sampler, settled: float | None) -> Solution:
        """From the problem's start by many controllers; from a Sobol set while nothing is found."""
        outer = StructuredOuter(sampler).prepare(self.seed)
        found = _descend(outer.sampler, np.array(sampler.problem.start), settled)
        for theta in design("sobol", *box(sampler.problem), self.formulation.starts, self.seed):
            if "objective" in found.result:
                break
            allowed = nearest_allowed(sampler.problem, theta, self.options)
            if allowed is not None:
                found = _descend(outer.sampler, allowed, settled)
        return found

    def _search_near(self, sampler: Sampler, near: Solution, settled: float | None) -> Solution:
        """From the θ of a solution, as near as this part has one, and from its controller."""
        problem, known = sampler.problem, _problem_from(near)
        values = known.source.held | dict(zip(known.names, known.start, strict=True))
        begin = np.array([values[name] for name in problem.names])
        theta = nearest_allowed(problem, begin, self.options)
        if theta is None:
            return _infeasible("no theta within the constraints was found")
        return _descend(sampler.of(carry_over(known, problem, self.scenarios)), theta, settled)

    def judge(self, sampler: Sampler, solution: Solution) -> Solution:
        """The whole co-design of a combination, from the controller that was found for it."""
        near = _problem_from(solution)
        started = carry_over(near, replace(sampler.problem, start=near.start), self.scenarios)
        whole = self.solve(sampler.of(started), np.array(near.start))
        if whole.verified is not None:
            self.scenarios = state_of(whole.verified.problem).scenarios
        return whole


def _descend(sampler: Sampler, theta: Array, settled: float | None = None) -> Solution:
    """Descend from θ to the least J near by; by steps along the truth where the joint search breaks
    λ.

    `settled`: as in `ListedOptions`; None: as near as any joint search.
    """
    best = first = sampler.values(theta, "nearby designs")[0]
    own, options = sampler, JointSearchOptions()
    J = objective_of(sampler.problem, first)
    if settled is not None and J and np.isfinite(J):  # of |J|, as the joint search counts it
        terms = objective_terms(sampler.problem, first.theta, first.value)
        share = settled * sum(map(abs, terms)) / abs(J)
        options = replace(options, model=replace(options.model, settled=share))
    if sampler.problem.figure is BANDWIDTH:
        log = printer("nearby designs", sampler.quiet)
        own, best, _ = joint_search(sampler, theta, log, ends=(), options=options)
    if best.theta == first.theta or violations(own.problem, best.theta):
        descent = ThetaDescentOptions()
        best = pieces_from(sampler, first, descent.settled, descent.far_radius)
        own = sampler
    problem = own.problem
    J = objective_of(problem, best)
    if not np.isfinite(J):
        return _infeasible(best.shortfall)
    result = {
        "status": "searched",
        "objective": J,
        "theta": dict(zip(problem.names, best.theta, strict=True)),
        "hardware_cost": hardware_cost(plant_of(problem), best.theta),
        "bandwidth_hz": best.bandwidth / HZ,
        f"{problem.figure.entry}_of_set": best.value,
    }
    outcome = FormulationResult(np.array(best.theta), agreed=True)
    return Solution(result, outcome, None, problem=_begin_at(problem, best.theta, best.kappa))


def carry_over(
    near: CoDesignProblem, problem: CoDesignProblem, scenarios: tuple[Scenario, ...]
) -> CoDesignProblem:
    """A problem with the warm starts of one like it, moved from that one's start to its own."""
    problem = with_state(problem, seed=state_of(near).seed, scenarios=scenarios)
    problem = with_range(problem)
    plants, bounds = plants_of(problem, problem.start), bounds_of(problem)
    moved = {}
    for name in ("warm_starts", "error_warm_starts"):
        of = with_state(near, warm_starts=getattr(state_of(near), name))
        kappas = warm_starts_at(of, structure_of(problem), plants, bounds)
        moved[name] = tuple(tuple(map(float, kappa)) for kappa in kappas)
    return with_state(problem, **moved)


def _problem_from(solution: Solution) -> CoDesignProblem:
    """The problem of a solution with its θ as the start and its controller as the warm start."""
    if solution.verified is None:
        assert solution.problem is not None
        return solution.problem
    verified = cast(VerifiedStructured, solution.verified)
    return _begin_at(verified.problem, verified.theta, tuple(map(float, verified.design.kappa)))


def _begin_at(
    problem: CoDesignProblem, theta: tuple[float, ...], kappa: tuple[float, ...]
) -> CoDesignProblem:
    """A problem whose searches begin at θ with the controller κ, and no other."""
    alone = with_state(problem, warm_starts=(kappa,), error_warm_starts=())
    return replace(with_warm_start(alone, kappa, 1), start=theta)


def _infeasible(words: str) -> Solution:
    result = {"status": "infeasible", "reason": words, "syntheses": 0}
    return Solution(result, FormulationResult(message=words), None)


def nearest_allowed(
    problem: CoDesignProblem, theta: Array, options: ListedOptions = ListedOptions()
) -> Array | None:
    """The nearest θ, in shares of the box, within it and λ(θ) <= -`inside`; None where none is
    found.

    A constraint on listed values alone does not depend on θ here. It is a number, which may be 0,
    as where this many places are to be chosen.
    """
    bounds, plant, x = box(problem), plant_of(problem), ca.MX.sym("theta", len(theta))
    lam, theta = plant.hardware(x)[1], np.clip(theta, *bounds)
    if not lam.numel():
        return theta
    moves = np.array(ca.which_depends(lam, x, 1, True))
    if (constraint_shares(problem, theta)[~moves] > ConstraintOptions.met).any():
        return None
    rows = np.flatnonzero(moves).tolist()
    if not rows:
        return theta
    f = ca.sumsqr((x - theta) / bounds.width)
    program = NonlinearProgram(x, f, lam[rows] + options.inside, bounds, plant.exact_hessian)
    try:
        return np.clip(solve_program(program, theta).best.x, *bounds)
    except OuterFailure:
        return None
