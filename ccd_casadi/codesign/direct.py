"""The direct formulation, and the polish of a mixed-sensitivity design that every solve ends with.

Nothing is approximated: each step is a certified synthesis with its total derivatives.
"""

from dataclasses import dataclass
from functools import cached_property

from ccd_casadi.codesign.kinked import descend
from ccd_casadi.codesign.kkt import kkt_certificate, newton_step
from ccd_casadi.codesign.peak_constraints import other_peaks
from ccd_casadi.inner_problem.objective import objective_terms, violated
from ccd_casadi.inner_problem.problem import CoDesignProblem
from ccd_casadi.optim.kkt import KktCertificate
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
        The start of the case, and a Sobol set over the box.
    tolerance : float
        Of the inner problem.
    box_points : int
        True inner problems over the box in the global check at the end.
    """

    starts: int = 4
    tolerance: float = 1e-3
    box_points: int = 32


@dataclass(frozen=True)
class TrueDesign:
    """The true design at x = (θ, ln ω_S, ln ω_T), and by what it is held against others."""

    problem: CoDesignProblem
    x: Array
    design: Sensitivities

    @property
    def theta(self) -> Array:
        """θ of x."""
        return self.x[: len(self.problem.names)]

    @property
    def acceptable(self) -> bool:
        """Certified, within S_max and S_low as given (no slack), and λ(θ) <= 0 to rounding."""
        met = self.problem.inner.feasible(self.design.figures)
        return met and not violated(self.problem, self.theta)

    @cached_property
    def terms(self) -> tuple[float, float]:
        """Those of J."""
        return objective_terms(self.problem, self.theta, self.design.figures.bandwidth)

    @property
    def objective(self) -> float:
        """J."""
        return sum(self.terms)

    @cached_property
    def kkt(self) -> KktCertificate:
        """Its first-order certificate."""
        return kkt_certificate(self.problem, self.x, self.design)

    @property
    def residual(self) -> float:
        """Of the optimality conditions, scaled."""
        return max(self.kkt.stationarity, self.kkt.complementarity)

    def rise(self, other: "TrueDesign") -> float:
        """By how much another J is larger, over what J may differ by and still be the same."""
        return (other.objective - self.objective) / (LEVEL * sum(map(abs, self.terms)))


def polish(sampler: Sampler, x: Array) -> TrueDesign:
    """From a design nearly optimal to the nearest stationary point of the true problem.

    A descent past kinks, every peak of S a constraint of its own (some ten designs where IPOPT
    takes a hundred), then Newton's steps as long as the residual falls, where no other peak is
    near. Returns the start itself where neither finds better that is certified and feasible.
    """
    problem, truth = sampler.problem, sampler.truth

    def at(x: Array) -> TrueDesign:
        return TrueDesign(problem, x, truth.at(x))

    here = at(x)
    if not (here.acceptable and here.residual <= STATIONARY):
        end = at(descend(problem, truth, x, steps=80, settled=1e-13))
        if end.acceptable and (not here.acceptable or _improves(here, end)):
            here = end
    for _ in range(3 if here.acceptable else 0):
        near = SETTLED < here.kkt.stationarity <= NEWTON
        if not near or other_peaks(problem, here.x, here.design, ON_EDGE):
            break
        step = newton_step(problem, truth, here.x, here.kkt)
        end = here if step is None else at(step)
        falls = end.acceptable and end.kkt.stationarity < here.kkt.stationarity
        if not falls or here.rise(end) > 1.0:
            break
        here = end
    return here


def _improves(here: TrueDesign, end: TrueDesign) -> bool:
    """Whether J falls, or stays and the residual falls."""
    rise = here.rise(end)
    return rise < -1.0 or (rise <= 1.0 and end.residual < here.residual)
