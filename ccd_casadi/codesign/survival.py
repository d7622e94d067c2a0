"""What a finished loop survives: the loop on plants off its model, and the ranges that it keeps."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial

import numpy as np
import scipy

from ccd_casadi.codesign.reasons import Finding, Reason
from ccd_casadi.inner_problem.kinds import MixedSensitivity, design_loops, kind_of
from ccd_casadi.inner_problem.problem import CoDesignProblem, plant_of, with_ports
from ccd_casadi.inner_problem.structured_problem import StructuredProblem
from ccd_casadi.lti.loop import Loop, Sampling, tustin
from ccd_casadi.lti.ports import BreakPoint
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.lti.wiring import OwnPorts
from ccd_casadi.plants.modal import (
    FREE,
    ModalPlant,
    Perturbation,
    Suspension,
    modal_plant,
    without_hidden_rigid_modes,
)
from ccd_casadi.plants.plant import Mechanics, mechanics
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.text import HZ
from ccd_casadi.synthesis.closed_loop import least_margins, least_of
from ccd_casadi.synthesis.statics import Statics, StaticsOptions, statics_of

PEAK = MixedSensitivity.slack  # relative: by how much S_max may be exceeded within its range
STATED = 2.0 * PEAK  # the excess of S_max from which on the words state it


@dataclass(frozen=True)
class SurvivalOptions:
    """Numbers of the ranges that a loop survives."""

    reach: float = 0.5  # of the frequency: how far a shift is followed
    factors: tuple[float, float] = (0.1, 10.0)  # of the damping: as far as it is followed
    meeting_step: float = 0.3  # of the distance to a shift where a pole of G meets a root of K
    largest_step: float = 0.03  # of the frequency: far from all of these
    weak_gain: float = 1e-3  # at a resonance, below which its mode does nothing to the loop
    damping_step: float = 0.1  # of the logarithm of the damping
    first_step: float = 1e-4
    step_growth: float = 1.6
    end: float = 1e-4  # relative: to which the end of a range is known
    least_end: float = 1e-9  # absolute: to which it is known next to the model


@dataclass(frozen=True)
class LoopsOffModel:
    """The loops of one controller on a plant whose resonances and damping are not the model's.

    D is `rest` + damping (`matrix` + shift `grows`), a known function of both: the model is not
    evaluated again.

    Attributes
    ----------
    plant : ModalPlant
        The model with n modes, SI.
    controller : StateSpace
        e in and u out, SI: K(s), which runs by Tustin's rule where there is a `sampling`, or K(z).
    sampling : Sampling or None
        How the loop runs.
    rest, matrix, grows : (n, n) array
        Of the modal damping matrix, 1/s.
    given : bool
        Whether the plant's damping is a matrix, not ratios.
    places : tuple of BreakPoint
        Of several sensors on one actuator.
    ported : Loop or None
        That on the model where forces act, or the error counts, elsewhere.
    at_ports : LoopsOffModel or None
        Those of the plant with its ports, where the compliance between them is bounded.
    own : OwnPorts or None
        Which of its inputs and outputs are the loop's.
    options : SurvivalOptions
        Numbers of the ranges.
    known : dict
        Loops that were made.
    """

    plant: ModalPlant
    controller: StateSpace
    sampling: Sampling | None
    rest: Array
    matrix: Array
    grows: Array
    given: bool
    places: tuple[BreakPoint, ...] = ()
    ported: Loop | None = None
    at_ports: "LoopsOffModel | None" = None
    own: OwnPorts | None = None
    options: SurvivalOptions = SurvivalOptions()
    known: dict[Perturbation, Loop] = field(default_factory=dict, compare=False)

    @property
    def other(self) -> "LoopsOffModel":
        """The loops with the other rule of damping under a shift: instead of ratios the matrix is
        kept, instead of a matrix the ratios."""
        flexible = ~self.plant.rigid
        own = np.where(flexible[:, None] & flexible, self.matrix, 0.0)
        at_ports = self.at_ports and self.at_ports.other
        grows = own if self.given else np.zeros_like(own)
        return replace(self, grows=grows, known={}, at_ports=at_ports)

    def modal(self, off: Perturbation) -> ModalPlant:
        """The plant itself; single modes are not shifted."""
        if self.plant.states is not None:
            states = self.plant.states.off(off.shift, off.damping, ())
            return replace(self.plant, states=states)
        flexible = np.where(self.plant.rigid, 0.0, np.diag(self.plant.K))
        K = self.plant.K + np.diag(((1.0 + off.shift) ** 2 - 1.0) * flexible)
        D = self.rest + off.damping * (self.matrix + off.shift * self.grows)
        return replace(self.plant, K=K, D=D)

    def at(self, off: Perturbation) -> Loop:
        """The loop on a perturbed plant."""
        if off not in self.known:
            plant = self.modal(off).state_space
            self.known[off] = Loop(plant, self.run, self.sampling, self.places)
        return self.known[off]

    @cached_property
    def run(self) -> StateSpace:
        """The controller as it runs."""
        K = self.controller
        return K if self.sampling is None or K.period else tustin(K, self.sampling.period)

    @cached_property
    def _meetings(self) -> tuple[Array, Array]:
        """Shifts at which a resonance meets a pole or zero of K, and how wide such a meeting is.

        Along a resonance S changes as K does there: the distance to a root of K in the complex
        plane, over the frequency, is how far it is analytic in the shift.
        """
        k, d = np.diag(self.plant.K), np.diag(self.plant.D)
        strength = np.linalg.norm(self.plant.B, axis=1) * np.linalg.norm(self.plant.C, axis=0)
        flexible = np.flatnonzero(~self.plant.rigid & ~self.plant.driven_away)
        natural = np.sqrt(np.maximum(k, 0.0))
        gain = np.linalg.norm(self.run.sweep(natural[flexible]), axis=(1, 2))
        gain *= strength[flexible] / np.maximum((natural * d)[flexible], 1e-300)
        modes = flexible[gain > self.options.weak_gain]
        zeros = self.run.zeros(float(np.abs(self.run.poles).max(initial=0.0)))
        roots = np.concatenate([self.run.rates, self.run.rates_of(zeros)])
        roots, omega = roots[(roots.imag >= 0.0) & np.isfinite(roots), None], natural[modes]
        at = np.abs(roots.imag) / omega - 1.0
        width = np.abs(roots.real) / omega + (0.5 * d[modes] / omega) * (1.0 + at)
        return at.ravel(), width.ravel()

    def step(self, shift: float) -> float:
        """Return how far the next shift may be: a share of the distance to the nearest meeting in
        the complex plane."""
        at, width = self._meetings
        near = float(np.hypot(at - shift, width).min(initial=np.inf))
        return min(self.options.largest_step, self.options.meeting_step * max(near, 1e-4))


def loops_off_model(
    system: Mechanics,
    controller: StateSpace,
    sampling: Sampling | None = None,
    suspension: Suspension = FREE,
    places: tuple[BreakPoint, ...] = (),
) -> LoopsOffModel:
    """The loops of a controller on a plant given by its matrices.

    Parameters
    ----------
    system : Mechanics
        M, D, K, B, C at one θ, SI.
    controller : StateSpace
        e in and u out, SI.
    sampling : Sampling or None
        How the loop runs.
    suspension : Suspension
        What holds its free bodies.
    places : tuple of BreakPoint
        Of several sensors on one actuator.

    Returns
    -------
    LoopsOffModel
        With the plant in modal coordinates.
    """

    def modal(off: Perturbation) -> ModalPlant:
        return without_hidden_rigid_modes(modal_plant(system, suspension, off))

    def D(off: Perturbation) -> Array:
        return modal(off).D

    plant = modal(Perturbation())
    matrix = D(Perturbation(damping=2.0)) - plant.D
    grows = (D(Perturbation(shift=0.5)) - plant.D) / 0.5
    given = system.damping_ratio is None and not system.first_order
    rest = plant.D - matrix
    return LoopsOffModel(plant, controller, sampling, rest, matrix, grows, given, places)


Function = Callable[[float], float]


@dataclass(frozen=True)
class Survival:
    """The changes of a plant that a loop survives, and its margins.

    A range that ends at `reach` or `factors` of the options was not followed further. Margins are
    the least of all loops broken one at a time at the plant's inputs.

    Attributes
    ----------
    stable_shift, S_max_shift : (float, float)
        Ranges of relative shifts around the model.
    stable_damping : (float, float)
        Range of the factor of damping.
    gain : (float, float)
        Factors down and up.
    phase_deg, delay, modulus : float
        deg, s, and 1/‖S‖∞.
    unstable_poles_hz : tuple of float
        |p|/2π of the controller's poles in the right half plane.
    statics : Statics
    contradiction : Finding or None
        What this engine finds on the model itself that the certificate denies.
    S_max_slack : float
        Relative: by what ‖S‖∞ may exceed S_max within `S_max_shift`.
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
    contradiction: Finding | None = None
    S_max_slack: float = PEAK

    def within(self, low: float, high: float) -> bool:
        """Whether S_max holds for all resonance shifts from `low` to `high`."""
        return self.S_max_shift[0] <= low and high <= self.S_max_shift[1]


def loops_of(
    problem: CoDesignProblem, theta: Sequence[float], controller: StateSpace
) -> LoopsOffModel:
    """The loops of a controller of any kind on plants off the model at θ.

    Parameters
    ----------
    problem : CoDesignProblem
        With the plant and how the loop runs.
    theta : (n_θ,) sequence
        SI.
    controller : StateSpace
        e in and u out, SI.

    Returns
    -------
    LoopsOffModel
        Of the model at θ.
    """
    system = mechanics(plant_of(problem), theta)
    places = kind_of(problem).bounds().places
    found = loops_off_model(system, controller, problem.sampling, problem.suspension.free, places)
    if with_ports(problem) is problem:
        return found
    found = replace(found, ported=design_loops(problem, theta, controller)[0])
    if not isinstance(problem.controller, StructuredProblem):
        return found
    from ccd_casadi.inner_problem.structured_plant_set import bounded_ports

    wide, own = bounded_ports(problem)
    if own is None:
        return found
    system = mechanics(plant_of(wide), theta)
    at_ports = loops_off_model(system, controller, problem.sampling, problem.suspension.free)
    return replace(found, at_ports=at_ports, own=own)


def growth_of(loop: Loop) -> float:
    """The largest real part of a pole over its size, max Re(p)/|p|.

    Parameters
    ----------
    loop : Loop
        Closed.

    Returns
    -------
    float
        Below 0 where the loop is stable.
    """
    return float((loop.poles.real / np.maximum(np.abs(loop.poles), 1e-300)).max())


def excess_of(loop: Loop, level: float) -> float:
    """Return how far a loop exceeds a level of S: ln(‖S‖∞ / level).

    Parameters
    ----------
    loop : Loop
        Closed.
    level : float
        Of ‖S‖∞.

    Returns
    -------
    float
        1 where the loop is unstable.
    """
    return math.log(loop.peak / level) if loop.stable else 1.0


def shift_range(
    loops: LoopsOffModel,
    f: Callable[[Loop], float],
    limit: float | None = None,
    marks: Sequence[float] = (),
) -> tuple[float, float]:
    """The common resonance shifts around the model, to both sides, up to which f <= 0.

    Parameters
    ----------
    loops : LoopsOffModel
        Of the controller.
    f : function of Loop
        Not positive where the loop is good.
    limit : float
        Relative shift up to which it is followed; None: that of the options.
    marks : sequence of float
        Shifts that are evaluated too, on both sides.

    Returns
    -------
    tuple of float
        The lower and the upper end, relative; 0 where the model itself is not good.
    """
    most = loops.options.reach if limit is None else limit

    def end(sign: float) -> float:
        return sign * reach(
            lambda x: f(loops.at(Perturbation(shift=sign * x))),
            lambda x: loops.step(sign * x),
            most,
            marks,
            loops.options,
        )

    return end(-1.0), end(1.0)


def range_within(
    loops: LoopsOffModel,
    search: Callable[[Callable[[Loop], float]], tuple[float, float]],
    S_max: float,
    loose: float,
    held: tuple[float, float],
) -> tuple[tuple[float, float], float]:
    """The range within which ‖S‖∞ meets S_max, and by what it may exceed S_max there.

    That is `PEAK`. Only where the range would then end in the part that the design was searched to
    hold by `loose`, and does, it is `loose`.

    Parameters
    ----------
    loops : LoopsOffModel
        Of the controller.
    search : function
        Of a figure of Loop: the ends up to which it is not positive, as `shift_range`.
    S_max, loose : float
        Of ‖S‖∞; relative.
    held : (float, float)
        The ends of that part.

    Returns
    -------
    ends : tuple of float
    slack : float
        Relative.
    """
    model, found = loops.at(Perturbation()), list[tuple[float, float]]()
    for slack in (PEAK, max(PEAK, loose)):
        excess = partial(excess_of, level=S_max * (1.0 + slack))
        found.append(search(excess))
        if excess(model) <= 0.0 and found[-1][0] <= held[0] and held[1] <= found[-1][1]:
            return found[-1], slack
    return found[0], PEAK


def damping_range(
    loops: LoopsOffModel, f: Callable[[Loop], float], limits: tuple[float, float] | None = None
) -> tuple[float, float]:
    """The factors of damping around 1 up to which f <= 0.

    Parameters
    ----------
    loops : LoopsOffModel
        Of the controller.
    f : function of Loop
        Not positive where the loop is good.
    limits : tuple of float
        Factors up to which it is followed; None: those of the options.

    Returns
    -------
    tuple of float
        The lower and the upper end.
    """
    limits, step = limits or loops.options.factors, loops.options.damping_step

    def end(limit: float) -> float:
        size, sign = abs(math.log(limit)), math.copysign(1.0, math.log(limit))
        found = reach(
            lambda x: f(loops.at(Perturbation(damping=math.exp(sign * x)))),
            lambda x: step,
            size,
            options=loops.options,
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
    held: tuple[float, float] = (0.0, 0.0),
) -> Survival:
    """The figures of a loop that is stable on the model; ω_b in rad/s.

    `slack`: what S_max may be exceeded by, relative, on the model and from `held` to `held`;
    `marks`: shifts that are evaluated too, on both sides.
    """
    nominal, level = loops.at(Perturbation()), S_max * (1.0 + slack)
    own = replace(loops.ported or nominal, controller=loops.controller)
    denied = None if nominal.stable else Reason.MODEL_UNSTABLE()
    if nominal.stable and not nominal.peak <= level:
        denied = Reason.MODEL_PEAK(peak=nominal.peak)
    within, exceeded = range_within(
        loops, partial(shift_range, loops, marks=marks), S_max, slack, held
    )
    margins = least_of([least_margins(one.responses, one.grid()) for one in nominal.places])
    poles = loops.controller.rates
    sizes = np.abs(poles)  # of an integrator rounding alone
    size = np.maximum(1e-9 * sizes, StaticsOptions().integrator * bandwidth)
    unstable = poles[(poles.real > size) & (poles.imag >= 0.0)]
    return Survival(
        stable_shift=shift_range(loops, growth_of, marks=marks),
        S_max_shift=within,
        stable_damping=damping_range(loops, growth_of),
        gain=(margins.gain_down, margins.gain_up),
        phase_deg=margins.phase_deg,
        delay=margins.delay,
        modulus=1.0 / nominal.peak,
        unstable_poles_hz=tuple(sorted(float(abs(p)) / HZ for p in unstable)),
        statics=statics_of(own, bandwidth=bandwidth, omega_low=omega_low),
        contradiction=denied,
        S_max_slack=exceeded,
    )


def reach(
    f: Function,
    step: Function,
    limit: float,
    marks: Sequence[float] = (),
    options: SurvivalOptions = SurvivalOptions(),
) -> float:
    """The largest x in [0, `limit`] up to which f <= 0; 0 where f(0) is not.

    `step` at x is how far the next place may be; `marks` are places that are evaluated too.

    >>> round(reach(lambda x: 1e-6 - (x - 0.3) ** 2, lambda x: 0.05, 1.0), 4)
    0.299
    """
    ahead = sorted(mark for mark in {*marks, limit} if 0.0 < mark <= limit)
    before, x, fx, width = None, 0.0, f(0.0), options.first_step
    if not fx <= 0.0:
        return 0.0
    while x < limit:
        width = min(options.step_growth * width, step(x))
        place = min(x + width, next(mark for mark in ahead if mark > x))
        value = f(place)
        if not value <= 0.0:
            return _end(f, x, place, options)
        if before is not None:
            top = highest(f, (before[0], x, place), (before[1], fx, value))
            if top is not None and f(top) > 0.0:
                inside = max(y for y in (before[0], x) if y < top)
                return _end(f, inside, top, options)
        before, x, fx = (x, fx), place, value
    return limit


def highest(
    f: Function, places: Sequence[float], values: Sequence[float], least: float = 1e-9
) -> float | None:
    """Return the local maximum that three neighbours bracket, to `least`; None where it stays below
    zero.

    A parabola rises above its middle place by less than by what that is above the lower of the
    others.
    """
    left, middle, right = values
    if middle < max(left, right) or 2.0 * middle - min(left, right) <= 0.0:
        return None
    options = {"xatol": 1e-5 * (places[2] - places[0]) + least}
    found = scipy.optimize.minimize_scalar(lambda x: -f(float(x)), bounds=(places[0], places[2]),
                            method="bounded", options=options)  # fmt: skip
    return float(found.x) if -found.fun >= middle else places[1]


def _end(f: Function, inside: float, outside: float, options: SurvivalOptions) -> float:
    while outside - inside > max(options.least_end, options.end * outside):
        middle = 0.5 * (inside + outside)
        inside, outside = (middle, outside) if f(middle) <= 0.0 else (inside, middle)
    return inside
