"""Gradients of the largest bandwidth to the hardware, at a design (envelope theorem)."""

from collections.abc import Sequence

import numpy as np

from ccd_casadi.fixed_structure.bounds import Bounds
from ccd_casadi.fixed_structure.design import problem_for
from ccd_casadi.fixed_structure.figures import assess
from ccd_casadi.fixed_structure.local_search import Point
from ccd_casadi.fixed_structure.loop_problem import LoopProblem
from ccd_casadi.fixed_structure.optimality import Envelope, envelope_of, optimality
from ccd_casadi.fixed_structure.sections_design import SectionsDesign, in_problem_units
from ccd_casadi.lti.hold import Sampling
from ccd_casadi.plants.scaling import ScaledPlant
from ccd_casadi.support.arrays import Array

LOWER_AT_MOST = 1e-3  # relative: what the judge's ω_b may be below the search's


def bandwidth_envelope(
    plants: Sequence[ScaledPlant],
    bounds: Bounds,
    design: SectionsDesign,
    sampling: Sampling | None = None,
) -> Envelope | None:
    """The gradients of ω_b*(θ) in rad/s at a design that is optimal on these plants.

    None where a loop is unstable or the point is not stationary to 1e-3. Plants carry dA, dB, dC.
    """
    problem = problem_for(plants, design.structure, bounds, sampling, design.frequencies)
    kappa = in_problem_units(problem, design.kappa)
    tau = float(np.log(design.bandwidth / problem.plants.omega_0))
    point = _at_the_bounds(problem, kappa, tau)
    if not point.assessment.stable:
        return None
    found = optimality(problem, point)
    envelope = envelope_of(problem, kappa, found)
    return None if envelope is None else envelope.times(design.bandwidth)


def _at_the_bounds(problem: LoopProblem, kappa: Array, tau: float) -> Point:
    """The point with the largest ω_b of this κ; the judge's is lower, by its own grid."""
    assessment = assess(problem, kappa, tau)
    peaks = assessment.peaks
    if peaks is not None:
        rising = peaks.to_tau > 0.0
        room = float((-peaks.value[rising] / peaks.to_tau[rising]).min(initial=np.inf))
        if abs(room) < LOWER_AT_MOST:
            tau += room
            assessment = assess(problem, kappa, tau)
    return Point(kappa, tau, assessment)
