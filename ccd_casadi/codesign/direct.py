"""The direct formulation, and the polish of a mixed-sensitivity design that every solve ends with.

Nothing is approximated: each step is a certified synthesis with its total derivatives.
"""

from dataclasses import dataclass

from ccd_casadi.codesign.kinked import descend
from ccd_casadi.codesign.kkt import kkt_certificate, newton_step
from ccd_casadi.codesign.peak_constraints import other_peaks
from ccd_casadi.inner_problem.constraints import violated
from ccd_casadi.inner_problem.objective import objective, objective_terms
from ccd_casadi.inner_problem.problem import CoDesignProblem
from ccd_casadi.inner_problem.true_function import TrueQuantities
from ccd_casadi.sampling.sampler import Sampler
from ccd_casadi.support.arrays import Array
from ccd_casadi.synthesis.derivatives import Sensitivities

ON_EDGE = 1e-4  # ln: so close to a kink or a jump IPOPT, which knows one gradient alone, stalls
STATIONARY = 1e-7  # scaled KKT residual below which a descent has nothing to do
SETTLED = 1e-9  # stationarity below which Newton's steps, led by gradients alone, have nothing
NEWTON = 1e-4  # the largest residual that they start from
LEVEL = 1e-8  # of the terms of J, which may cancel: what ω_b is good to


@dataclass(frozen=True)
class Direct:
    """Options of the direct formulation: local solves on the truth.

    Parameters
    ----------
    starts : int
        The case's own and a Sobol set over the box.
    tolerance : float
        Of the inner problem.
    box_points : int
        True inner problems over the box in the global check at the end.
    """

    starts: int = 4
    tolerance: float = 1e-3
    box_points: int = 32


def polish(sampler: Sampler, x: Array) -> tuple[Array, Sensitivities]:
    """From a design nearly optimal to the nearest stationary point of the true problem.

    A descent past kinks, then Newton's steps. Returns the start itself where neither finds better
    that is certified and feasible.
    """
    problem, truth = sampler.problem, sampler.truth
    design = truth.at(x)
    if not (acceptable(problem, x, design) and _residual(problem, x, design) <= STATIONARY):
        x, design = _past_kinks(problem, truth, x, design)
    return _settled(problem, truth, x, design)


def _settled(
    problem: CoDesignProblem, quantities: TrueQuantities, x: Array, design: Sensitivities
) -> tuple[Array, Sensitivities]:
    """Newton's steps as long as the residual falls, where no other peak is near."""
    if not acceptable(problem, x, design):
        return x, design
    kkt = kkt_certificate(problem, x, design)
    for _ in range(3):
        if not SETTLED < kkt.stationarity <= NEWTON or other_peaks(problem, x, design, ON_EDGE):
            break
        end = newton_step(problem, quantities, x, kkt)
        found = None if end is None else quantities.at(end)
        if end is None or found is None or not acceptable(problem, end, found):
            break
        after = kkt_certificate(problem, end, found)
        rise = true_objective(problem, end, found) - true_objective(problem, x, design)
        if after.stationarity >= kkt.stationarity or rise > _level(problem, x, design):
            break
        x, design, kkt = end, found, after
    return x, design


def _past_kinks(
    problem: CoDesignProblem, quantities: TrueQuantities, x: Array, design: Sensitivities
) -> tuple[Array, Sensitivities]:
    """Every peak of S a constraint of its own: some ten designs where IPOPT takes a hundred."""
    end = descend(problem, quantities, x, steps=80, settled=1e-13)
    found = quantities.at(end)
    if not acceptable(problem, end, found):
        return x, design
    if acceptable(problem, x, design):
        rise = true_objective(problem, end, found) - true_objective(problem, x, design)
        level = _level(problem, x, design)
        nearer = _residual(problem, end, found) < _residual(problem, x, design)
        if not (rise < -level or (rise <= level and nearer)):
            return x, design
    return end, found


def true_objective(problem: CoDesignProblem, x: Array, design: Sensitivities) -> float:
    """J of a true design at x = (θ, ln ω_S, ln ω_T)."""
    return objective(problem, x[: len(problem.names)], design.figures.bandwidth)


def acceptable(problem: CoDesignProblem, x: Array, design: Sensitivities) -> bool:
    """Certified, within S_max and S_low as given (no slack), and λ(θ) <= 0 to rounding."""
    return problem.inner.feasible(design.figures) and not violated(problem, x[: len(problem.names)])


def _residual(problem: CoDesignProblem, x: Array, design: Sensitivities) -> float:
    kkt = kkt_certificate(problem, x, design)
    return max(kkt.stationarity, kkt.complementarity)


def _level(problem: CoDesignProblem, x: Array, design: Sensitivities) -> float:
    """What J may differ by and still be the same."""
    terms = objective_terms(problem, x[: len(problem.names)], design.figures.bandwidth)
    return LEVEL * sum(map(abs, terms))
