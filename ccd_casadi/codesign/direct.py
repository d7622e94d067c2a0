"""The direct formulation, and the polish of a mixed-sensitivity design that every solve ends with.

Nothing is approximated: each step is a certified synthesis with its total derivatives.
"""

from dataclasses import dataclass

from ccd_casadi.codesign.kinked import descend
from ccd_casadi.codesign.kkt import TrueDesign, newton_step
from ccd_casadi.codesign.peak_constraints import other_peaks
from ccd_casadi.inner_problem.true_function import TrueQuantities
from ccd_casadi.support.arrays import Array

ON_EDGE = 1e-4  # ln: so close to a kink or a jump IPOPT, which knows one gradient alone, stalls
STATIONARY = 1e-7  # scaled KKT residual below which a descent has nothing to do
SETTLED = 1e-9  # stationarity below which Newton's steps, led by gradients alone, have nothing
NEWTON = 1e-4  # the largest residual that they start from


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

    def sampled(self, variables: int) -> int:
        """How many designs the plan has."""
        return self.starts


def polish(truth: TrueQuantities, x: Array) -> TrueDesign:
    """From a design nearly optimal to the nearest stationary point of the true problem.

    A descent past kinks, every peak of S a constraint of its own (some ten designs where IPOPT
    takes a hundred), then Newton's steps as long as the residual falls, where no other peak is
    near. Returns the start itself where neither finds better that is certified and feasible.
    """
    here = TrueDesign(truth, x)
    if not (here.acceptable and here.residual <= STATIONARY):
        end = TrueDesign(truth, descend(truth, x, steps=80, settled=1e-13))
        if end.acceptable and (not here.acceptable or _improves(here, end)):
            here = end
    for _ in range(3 if here.acceptable else 0):
        near = SETTLED < here.kkt.stationarity <= NEWTON
        if not near or other_peaks(here.problem, here.x, here.design, ON_EDGE):
            break
        step = newton_step(here)
        end = here if step is None else TrueDesign(truth, step)
        falls = end.acceptable and end.kkt.stationarity < here.kkt.stationarity
        if not falls or here.rise(end) > 1.0:
            break
        here = end
    return here


def _improves(here: TrueDesign, end: TrueDesign) -> bool:
    """Whether J falls, or stays and the residual falls."""
    rise = here.rise(end)
    return rise < -1.0 or (rise <= 1.0 and end.residual < here.residual)
