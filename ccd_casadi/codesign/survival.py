"""What a finished loop survives, computed in every solve: figures from the loop itself.

Ranges of a common shift of all flexible resonances and of a factor of their damping in which the
loop stays stable (closed-loop eigenvalues) and ‖S‖∞ within S_max, classical margins,
right-half-plane poles of the controller, and what a static force moves (`statics`); of every kind
of controller, sampled or not. The `robustness` command looks closer; this is what no verdict
should be without.

A range ends where a walk does whose steps no narrow loss slips through (`reach`): the caller's
steps resolve what he knows of the function; a local maximum between two steps that might reach zero
is climbed, and what is found there is closed in on.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import scipy

from ccd_casadi.codesign.loops_off_model import LoopsOffModel, loops_off_model
from ccd_casadi.inner_problem.kinds import MixedSensitivity
from ccd_casadi.inner_problem.problem import CoDesignProblem, plant_of
from ccd_casadi.lti.loop import Loop
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.plants.modal import Perturbation
from ccd_casadi.plants.plant import mechanics
from ccd_casadi.support.units import HZ
from ccd_casadi.synthesis.classical_margins import least_margins
from ccd_casadi.synthesis.statics import INTEGRATOR, Statics, statics

REACH = 0.5  # of the frequency: how far a shift is followed
FACTORS = (0.1, 10.0)  # of the damping
PEAK = MixedSensitivity.slack  # relative: by how much S_max may be exceeded within its range
E_FOLD = 0.1  # step of the logarithm of the damping
FIRST = 1e-4  # the first step; then they grow to the caller's
GROWTH = 1.6
CLOSE = 1e-4  # relative: of an end, and how near to the model none is told from none
LEAST = 1e-9
Function = Callable[[float], float]


@dataclass(frozen=True)
class Survival:
    """Ranges as (low, high) around the model; relative shifts, factors of damping.

    A range that ends at `REACH` or `FACTORS` was not followed further. Margins are the least of
    all loops broken one at a time at the plant's inputs: `gain` up and down as factors,
    `phase_deg`, `delay` in s, and `modulus` = 1/‖S‖∞. `unstable_poles_hz`: |p|/2π of the
    controller's poles in the right half plane. `contradiction`: what this engine finds on the model
    itself that the certificate denies.
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
    contradiction: str = ""

    def within(self, low: float, high: float) -> bool:
        """Whether S_max holds for all resonance shifts from `low` to `high`."""
        return self.S_max_shift[0] <= low and high <= self.S_max_shift[1]


def loops_of(
    problem: CoDesignProblem, theta: Sequence[float], controller: StateSpace
) -> LoopsOffModel:
    """The loops of a controller in SI (e in, u out) of whatever kind on plants off the model at θ,
    sampled where the problem's loop is."""
    system = mechanics(plant_of(problem), theta)
    return loops_off_model(system, controller, problem.sampling, problem.suspension.free)


def growth_of(loop: Loop) -> float:
    """The largest real part of a pole over its size: below 0 where the loop is stable."""
    return float((loop.poles.real / np.maximum(np.abs(loop.poles), 1e-300)).max())


def excess_of(loop: Loop, level: float) -> float:
    """ln of ‖S‖∞ over a level; 1 where the loop is unstable."""
    return math.log(loop.peak / level) if loop.stable else 1.0


def shift_range(
    loops: LoopsOffModel,
    f: Callable[[Loop], float],
    limit: float = REACH,
    marks: Sequence[float] = (),
) -> tuple[float, float]:
    """The common resonance shifts around the model, to both sides, up to which f <= 0."""

    def end(sign: float) -> float:
        return sign * reach(
            lambda x: f(loops.at(Perturbation(shift=sign * x))),
            lambda x: loops.step(sign * x),
            limit,
            marks,
        )

    return end(-1.0), end(1.0)


def damping_range(
    loops: LoopsOffModel, f: Callable[[Loop], float], limits: tuple[float, float] = FACTORS
) -> tuple[float, float]:
    """The factors of damping around 1, within `limits`, up to which f <= 0."""

    def end(limit: float) -> float:
        size, sign = abs(math.log(limit)), math.copysign(1.0, math.log(limit))
        found = reach(
            lambda x: f(loops.at(Perturbation(damping=math.exp(sign * x)))), lambda x: E_FOLD, size
        )
        return limit if found == size else math.exp(sign * found)

    return end(limits[0]), end(limits[1])


def survival(
    loops: LoopsOffModel,
    *,
    S_max: float,
    bandwidth: float,
    omega_low: float,
    slack: float = PEAK,
    marks: Sequence[float] = (),
) -> Survival:
    """The figures of a loop that is stable on the model; ω_b in rad/s.

    `slack`: what S_max may be passed by, relative; `marks`: shifts that are asked on both sides.
    """
    nominal, level = loops.at(Perturbation()), S_max * (1.0 + slack)
    denied = "" if nominal.stable else "a second engine finds the loop unstable on the model itself"
    if nominal.stable and not nominal.peak <= level:
        denied = f"a second engine finds a peak of S of {nominal.peak:.6g} on the model itself"
    excess = partial(excess_of, level=level)
    margins = least_margins(nominal.responses, nominal.grid())
    poles = np.linalg.eigvals(loops.controller.A)
    sizes = np.abs(poles)  # of an integrator rounding alone
    unstable = poles[(poles.real > np.maximum(1e-9 * sizes, INTEGRATOR * bandwidth))
                     & (poles.imag >= 0.0)]  # fmt: skip
    return Survival(
        stable_shift=shift_range(loops, growth_of, marks=marks),
        S_max_shift=shift_range(loops, excess, marks=marks),
        stable_damping=damping_range(loops, growth_of),
        gain=(margins.gain_down, margins.gain_up),
        phase_deg=margins.phase_deg,
        delay=margins.delay,
        modulus=1.0 / nominal.peak,
        unstable_poles_hz=tuple(sorted(float(abs(p)) / HZ for p in unstable)),
        statics=statics(nominal.plant, loops.controller, bandwidth=bandwidth, omega_low=omega_low),
        contradiction=denied,
    )


def reach(f: Function, step: Function, limit: float, marks: Sequence[float] = ()) -> float:
    """The largest x in [0, `limit`] up to which f <= 0; 0 where f(0) is not.

    `step` at x is how far the next place may lie; `marks` are places that are asked besides.

    >>> round(reach(lambda x: 1e-6 - (x - 0.3) ** 2, lambda x: 0.05, 1.0), 4)
    0.299
    """
    ahead = sorted(mark for mark in {*marks, limit} if 0.0 < mark <= limit)
    before, x, fx, width = None, 0.0, f(0.0), FIRST
    if not fx <= 0.0:
        return 0.0
    while x < limit:
        width = min(GROWTH * width, step(x))
        place = min(x + width, next(mark for mark in ahead if mark > x))
        value = f(place)
        if not value <= 0.0:
            return _end(f, x, place)
        if before is not None:
            top = highest(f, (before[0], x, place), (before[1], fx, value))
            if top is not None and f(top) > 0.0:
                return _end(f, max(y for y in (before[0], x) if y < top), top)
        before, x, fx = (x, fx), place, value
    return limit


def highest(f: Function, places: Sequence[float], values: Sequence[float]) -> float | None:
    """Where the local maximum is that three neighbours bracket; None where it stays below zero.

    A parabola rises above its middle place by less than by what that is above the lower of the
    others.
    """
    left, middle, right = values
    if middle < max(left, right) or 2.0 * middle - min(left, right) <= 0.0:
        return None
    options = {"xatol": 1e-5 * (places[2] - places[0]) + LEAST}
    found = scipy.optimize.minimize_scalar(lambda x: -f(float(x)), bounds=(places[0], places[2]),
                            method="bounded", options=options)  # fmt: skip
    return float(found.x) if -found.fun >= middle else places[1]


def _end(f: Function, inside: float, outside: float) -> float:
    while outside - inside > max(LEAST, CLOSE * outside):
        middle = 0.5 * (inside + outside)
        inside, outside = (middle, outside) if f(middle) <= 0.0 else (inside, middle)
    return inside
