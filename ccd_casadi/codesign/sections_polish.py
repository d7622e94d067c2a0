"""A polish on the true value of a fixed structure: it passes kinks, and keeps its controller."""

from contextlib import suppress
from dataclasses import replace

import numpy as np

from ccd_casadi.codesign.outer_problem import OuterFailure, nested_program, solve_program
from ccd_casadi.codesign.sections_races import value_at
from ccd_casadi.codesign.theta_direct import PRECISE, SETTLED, TrueBandwidth, pieces_from
from ccd_casadi.codesign.theta_kkt import SMOOTH, theta_kkt
from ccd_casadi.inner_problem.objective import objective_of
from ccd_casadi.inner_problem.problem import box
from ccd_casadi.inner_problem.sections_bandwidth import joined
from ccd_casadi.sampling.sampler import Sampler
from ccd_casadi.sampling.samples import BandwidthSample
from ccd_casadi.support.arrays import Array

STATIONARY = 1e-5  # scaled residual below which a polish has nothing to do
LEVEL = 1e-9  # of J: what the pieces of a kink promise less than that is not known
FOLLOWED = 3  # times at most that a controller is taken along past a jump of ω_b*


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
    if theta_kkt(problem, best).stationarity > STATIONARY:
        truth, best = by_pieces(truth, best)
    sampler, problem = truth.sampler, truth.sampler.problem
    if theta_kkt(problem, best).stationarity <= SMOOTH or _on_a_kink(sampler, best):
        return sampler, best
    program = nested_program(problem, truth)
    program = replace(program, exact_hessian=False)
    with suppress(OuterFailure):  # what it has asked for on its way counts
        solve_program(program, np.array(best.theta), warm=True, tolerance=PRECISE, settled=SETTLED)
    return sampler, min(truth.known.values(), key=lambda s: objective_of(problem, s))


def _on_a_kink(sampler: Sampler, best: BandwidthSample) -> bool:
    """Whether a sample is optimal to first order by the gradients of several sides of it."""
    envelope = value_at(sampler, best.theta).envelope
    found = theta_kkt(sampler.problem, best, envelope=envelope)
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
