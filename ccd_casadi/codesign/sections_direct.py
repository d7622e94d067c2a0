"""IPOPT on the true ω_b*(θ) of a fixed structure, and a polish that passes its kinks."""

from contextlib import suppress

import numpy as np

from ccd_casadi.codesign.formulation import FormulationResult
from ccd_casadi.codesign.outer_problem import (
    OuterFailure,
    nested_program,
    solve_program,
)
from ccd_casadi.codesign.sections_kkt import SMOOTH, sections_kkt
from ccd_casadi.codesign.true_value import TrueBandwidth
from ccd_casadi.inner_problem.objective import hardware_at, objective_gradient, objective_of
from ccd_casadi.inner_problem.problem import CoDesignProblem, box
from ccd_casadi.inner_problem.sections_bandwidth import joined, sections_value
from ccd_casadi.optim.pieces import Local, descend, jumps
from ccd_casadi.sampling.sampler import Sampler
from ccd_casadi.sampling.samples import BandwidthSample
from ccd_casadi.support.arrays import Array
from surrogates import design

STATIONARY = 1e-5  # scaled residual below which a polish has nothing to do
PRECISE = 1e-6  # IPOPT's tolerance: ω_b* is known to about 1e-8
SETTLED = 1e-7  # of J: at a kink of ω_b* no residual falls, a hundred line searches gain no more
LEVEL = 1e-9  # of J: what the pieces of a kink promise less than that is not known
FOLLOWED = 3  # times at most that a controller is taken along past a jump of ω_b*
STEPS = 15  # per parameter, at most, to where pieces meet: from near by it takes half of that


def solve_direct_value(sampler: Sampler, starts: int, *, seed: int) -> FormulationResult:
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
        best = min((truth.at(p) for p in good), key=lambda s: objective_of(problem, s))
        if not np.isfinite(objective_of(problem, best)):
            return FormulationResult(None, None, (), (), None, False, str(error))
        return FormulationResult(np.array(best.theta), None, (), (), None, False, str(error))
    best = min(truth.known.values(), key=lambda s: objective_of(problem, s))
    return FormulationResult(np.array(best.theta), None, (), (), solution, True, "")


def polish_sections(sampler: Sampler, theta: Array) -> tuple[Sampler, BandwidthSample]:
    """From a design nearly optimal to the best θ that is found near it on the true problem, and
    the sampler of the problem that has it: with more anchors, where the given ones lose it.

    By pieces (`pieces`), which know kinks; by IPOPT where J has one gradient and that is not yet
    zero to what it is known to.
    """
    problem = sampler.problem
    lower, upper = box(problem)
    near = np.where(theta - lower <= 1e-3 * (upper - lower), lower, theta)
    near = np.where(upper - near <= 1e-3 * (upper - lower), upper, near)
    truth = TrueBandwidth(sampler, "polishing")
    candidates = [truth.at(point) for point in np.unique([near, theta], axis=0)]
    best = min(candidates, key=lambda s: objective_of(problem, s))
    if sections_kkt(problem, best).stationarity > STATIONARY:
        truth, best = by_pieces(truth, best)
    sampler, problem = truth.sampler, truth.sampler.problem
    if sections_kkt(problem, best).stationarity <= SMOOTH or _on_a_kink(problem, best):
        return sampler, best
    program = nested_program(problem, truth)
    program = type(program)(**{**vars(program), "exact_hessian": False})
    with suppress(OuterFailure):  # what it has asked for on its way counts
        solve_program(program, np.array(best.theta), warm=True, tolerance=PRECISE, settled=SETTLED)
    return sampler, min(truth.known.values(), key=lambda s: objective_of(problem, s))


def _on_a_kink(problem: CoDesignProblem, best: BandwidthSample) -> bool:
    """Whether a sample is optimal to first order by the gradients of several sides of it."""
    envelope = sections_value(problem, best.theta).envelope
    found = sections_kkt(problem, best, envelope=envelope)
    return found.kink is not None and found.stationarity <= SMOOTH


def by_pieces(
    truth: TrueBandwidth, best: BandwidthSample, settled: float = LEVEL
) -> tuple[TrueBandwidth, BandwidthSample]:
    """From a sample, and what was asked for near it, to where the pieces of J promise no more.

    Where ω_b* jumps beside the best θ the climbs from the anchors have lost its controller: that
    one becomes an anchor, and the search goes on.
    """
    for _ in range(FOLLOWED):
        best, jumped = pieces_from(truth, best, settled)
        if not jumped:
            break
        problem = joined(truth.sampler.problem, np.array(best.kappa), ())
        truth = TrueBandwidth(truth.sampler.of(problem), truth.label)
        best = truth.at(np.array(best.theta))
    return truth, best


def pieces_from(
    truth: TrueBandwidth, best: BandwidthSample, settled: float
) -> tuple[BandwidthSample, bool]:
    """The best sample of one function ω_b*, and whether that jumps beside it."""
    problem = truth.sampler.problem
    lower, upper = box(problem)
    width = upper - lower

    def at(z: Array) -> Local | None:
        return local(truth.at(np.clip(lower + width * z, lower, upper)))

    def local(sample: BandwidthSample) -> Local | None:
        J, gradient = objective_of(problem, sample), objective_gradient(problem, sample)
        if not (np.isfinite(J) and np.isfinite(gradient).all()):
            return None
        return Local((np.array(sample.theta) - lower) / width, J, gradient)

    def constraints(z: Array) -> tuple[Array, Array]:
        found = hardware_at(problem, lower + width * z)
        return found.constraints, found.slopes

    start = local(best)
    if start is None:
        return best, False
    others = [found for found in map(local, truth.known.values()) if found is not None]
    end = descend(at, start, others, constraints, steps=STEPS * len(lower), settled=settled)
    met = (found for found in map(local, truth.known.values()) if found is not None)
    jumped = any(found.value > end.value and jumps(end, found) for found in met)
    return min(truth.known.values(), key=lambda sample: objective_of(problem, sample)), jumped
