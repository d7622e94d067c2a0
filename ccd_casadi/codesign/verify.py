"""Verification of an optimum by the true synthesis, its controller, and optimality of the truth."""

from dataclasses import replace

import numpy as np

from ccd_casadi.codesign.closer_models import check_references
from ccd_casadi.codesign.direct import acceptable, polish
from ccd_casadi.codesign.kkt import kkt_certificate
from ccd_casadi.codesign.outer_problem import active_bounds, lifted_bounds, lifted_program
from ccd_casadi.codesign.robust_check import check_robust, other_damping, survived
from ccd_casadi.codesign.survival import loops_of
from ccd_casadi.codesign.verified_mixed import VerifiedDesign
from ccd_casadi.inner_problem.constraints import touched
from ccd_casadi.inner_problem.objective import objective
from ccd_casadi.inner_problem.problem import CoDesignProblem, plant_of, scaled_plant
from ccd_casadi.inner_problem.sweep import active_constraints
from ccd_casadi.inner_problem.true_function import TrueQuantities
from ccd_casadi.plants.modal import Suspension
from ccd_casadi.plants.plant import hardware_cost
from ccd_casadi.sampling.sampler import Sampler
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.progress import Progress
from ccd_casadi.synthesis.closed_loop import handed_out, measure
from ccd_casadi.synthesis.synthesis import UNBOUNDED, DesignFigures, synthesise

POLISH_ROUNDS = 3
INNER_GAP = 1e-6  # relative; the global inner problem may not beat the design by more


def verify(sampler: Sampler, x: Array) -> VerifiedDesign:
    """Polish x on the true problem, ask the global inner problem there, certify what results."""
    with sampler.spent.on("checks"):
        return _verified(sampler, x)


def _verified(sampler: Sampler, x: Array) -> VerifiedDesign:
    problem = sampler.problem
    count = len(problem.names)
    quantities = sampler.truth
    gap = np.inf
    design = None
    for _ in range(POLISH_ROUNDS):
        polishing = Progress(1, "polishing on the truth", quiet=sampler.quiet)
        with polishing as progress, sampler.spent.on("polish"):
            x, design, _ = polish(sampler, x)
            progress.advance()
        at_bounds = _snapped(problem, x)
        if acceptable(problem, at_bounds, quantities.at(at_bounds)):
            x, design = at_bounds, quantities.at(at_bounds)
        inner = sampler.bandwidths(x[:count], "verifying")[0]
        gap = inner.bandwidth / design.figures.bandwidth - 1.0 if inner.feasible else 0.0
        if gap <= INNER_GAP:
            break
        # the inner problem has a better design at this θ: go on from there
        x = np.array([*inner.theta, np.log(inner.omega_S), np.log(inner.omega_T)])
    assert design is not None
    theta = tuple(float(v) for v in x[:count])
    figures = design.figures
    plant = scaled_plant(problem, theta)
    final = synthesise(
        plant,
        problem.weights.at(figures.omega_S, figures.omega_T),
        omega_low=problem.inner.omega_low,
        gamma_backoff=problem.inner.gamma_backoff,
        compliance=True,
    )
    final = handed_out(plant, final, problem.inner.omega_low)
    free = replace(problem, suspension=Suspension(0.0, 0.0))
    unsuspended = measure(
        scaled_plant(free, theta),
        final.controller,
        final.weights,
        gamma=UNBOUNDED,
        omega_low=problem.inner.omega_low,
    )
    loops = loops_of(problem, theta, final.controller)
    found, robust = None, check_robust(problem, loops)
    if final.figures.certified:
        found, robust = survived(problem, loops, final.figures.bandwidth)
    return VerifiedDesign(
        problem=problem,
        x=x,
        theta=theta,
        design=final,
        value=final.figures.bandwidth,
        objective=objective(problem, theta, final.figures.bandwidth),
        hardware_cost=hardware_cost(plant_of(problem), theta),
        binding=_active(problem, quantities, x, final.figures),
        kkt=kkt_certificate(problem, x, quantities.at(x), quantities.at),
        inner_gap=float(gap),
        feasible=final.figures.certified and acceptable(problem, x, design),
        unsuspended=unsuspended,
        references=check_references(
            problem, theta, final, workers=sampler.workers, quiet=sampler.quiet
        ),
        robust=robust,
        damping=other_damping(problem, loops),
        survival=found,
    )


def _snapped(problem: CoDesignProblem, x: Array) -> Array:
    """Put variables that IPOPT left within rounding of a bound onto it."""
    lower, upper = lifted_bounds(problem)
    width = upper - lower
    x = np.where(np.abs(x - lower) <= 1e-9 * width, lower, x)
    return np.where(np.abs(x - upper) <= 1e-9 * width, upper, x)


def _active(
    problem: CoDesignProblem, quantities: TrueQuantities, x: Array, figures: DesignFigures
) -> tuple[str, ...]:
    program = lifted_program(problem, quantities, exact_hessian=False)
    bounds = [name for name in active_bounds(program, x) if not name.startswith("omega_")]
    extra = touched(problem, x[: len(problem.names)])
    return (*bounds, *active_constraints(problem.inner, figures), *extra)
