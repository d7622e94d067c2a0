"""What a finished loop survives, computed in every solve: figures from the loop itself.

Ranges of a common shift of all flexible resonances and of a factor of their damping in which the
loop stays stable (closed-loop eigenvalues) and ‖S‖∞ within S_max, classical margins,
right-half-plane poles of the controller, and what a static force moves (`statics`); of every kind
of controller, sampled or not. The `robustness` command looks closer; this is what no verdict
should be without.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from ccd_casadi.codesign.loops_off_model import Controller, Loop, LoopsOffModel, loops_off_model
from ccd_casadi.codesign.reach import reach
from ccd_casadi.inner_problem.kinds import MixedSensitivity, kind_of
from ccd_casadi.inner_problem.problem import CoDesignProblem, plant_of
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.plants.modal import Perturbation
from ccd_casadi.plants.plant import mechanics
from ccd_casadi.plants.scaling import scale_plant
from ccd_casadi.support.units import HZ
from ccd_casadi.synthesis.classical_margins import least_margins
from ccd_casadi.synthesis.statics import INTEGRATOR, Statics, statics

REACH = 0.5  # of the frequency: how far a shift is followed
FACTORS = (0.1, 10.0)  # of the damping
PEAK = MixedSensitivity.slack  # relative: by how much S_max may be exceeded within its range
E_FOLD = 0.1  # step of the logarithm of the damping


@dataclass(frozen=True)
class Survival:
    """Ranges as (low, high) around the model; relative shifts, factors of damping.

    A range that ends at `REACH` or `FACTORS` was not followed further. Margins are the least of
    all loops broken one at a time at the plant's inputs: `gain` up and down as factors,
    `phase_deg`, `delay` in s, and `modulus` = 1/‖S‖∞. `unstable_poles_hz`: |p|/2π of the
    controller's poles in the right half plane.
    """

    stable_shift: tuple[float, float]
    S_max_shift: tuple[float, float]
    stable_damping: tuple[float, float]
    gain: tuple[float, float]
    phase_deg: float
    delay: float
    modulus: float
    unstable_poles_hz: tuple[float, ...]
    statics: Statics

    def within(self, low: float, high: float) -> bool:
        """Whether S_max holds for all resonance shifts from `low` to `high`."""
        return self.S_max_shift[0] <= low and high <= self.S_max_shift[1]


def loops_of(
    problem: CoDesignProblem, theta: Sequence[float], controller: StateSpace
) -> LoopsOffModel:
    """The loops of a controller in SI (e in, u out) of whatever kind on plants off the model at θ,
    sampled where the problem's loop is."""
    system = mechanics(plant_of(problem), theta)
    return loops_off_model(system, problem.suspension, Controller(controller, problem.sampling))


def survival_of(
    problem: CoDesignProblem,
    loops: LoopsOffModel,
    bandwidth: float,
    marks: Sequence[float] = (),
) -> Survival:
    """The figures of a problem's finished loop."""
    return survival(
        loops,
        S_max=problem.inner.S_max,
        bandwidth=bandwidth,
        omega_low=problem.inner.omega_low,
        M_K=problem.weights.M_K,
        slack=kind_of(problem).slack,
        marks=marks,
    )


def survival(
    loops: LoopsOffModel,
    *,
    S_max: float,
    bandwidth: float,
    omega_low: float,
    M_K: float,
    slack: float = PEAK,
    marks: Sequence[float] = (),
) -> Survival:
    """The figures of a loop that is stable on the model; ω_b in rad/s, M_K in N/m.

    `slack`: what S_max may be passed by, relative; `marks`: shifts that are asked on both sides.
    """
    nominal = loops.at(Perturbation())
    level = math.log(max(S_max, nominal.peak) * (1.0 + slack))

    def excess(loop: Loop) -> float:
        return math.log(loop.peak) - level if loop.stable else 1.0

    def shifts(f: Callable[[Loop], float]) -> tuple[float, float]:
        def end(sign: float) -> float:
            return sign * reach(
                lambda x: f(loops.at(Perturbation(shift=sign * x))),
                lambda x: loops.step(sign * x),
                REACH,
                marks,
            )

        return end(-1.0), end(1.0)

    def factor(end: float) -> float:
        size, sign = abs(math.log(end)), math.copysign(1.0, math.log(end))
        found = reach(
            lambda x: loops.at(Perturbation(damping=math.exp(sign * x))).growth,
            lambda x: E_FOLD,
            size,
        )
        return end if found == size else math.exp(sign * found)

    margins = least_margins(nominal.responses, nominal.grid)
    poles = np.linalg.eigvals(loops.controller.continuous.A)
    sizes = np.abs(poles)  # of an integrator rounding alone
    unstable = poles[(poles.real > np.maximum(1e-9 * sizes, INTEGRATOR * bandwidth))
                     & (poles.imag >= 0.0)]  # fmt: skip
    return Survival(
        stable_shift=shifts(lambda loop: loop.growth),
        S_max_shift=shifts(excess),
        stable_damping=(factor(FACTORS[0]), factor(FACTORS[1])),
        gain=(margins.gain_down, margins.gain_up),
        phase_deg=margins.phase_deg,
        delay=margins.delay,
        modulus=1.0 / nominal.peak,
        unstable_poles_hz=tuple(sorted(float(abs(p)) / HZ for p in unstable)),
        statics=statics(
            scale_plant(loops.plant, M_K).plant_si(),
            loops.controller.continuous,
            bandwidth=bandwidth,
            omega_low=omega_low,
        ),
    )
