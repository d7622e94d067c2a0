"""The bound on every controller for a structured problem, at one θ."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ccd_casadi.codesign.reasons import Finding, Reason
from ccd_casadi.extensions.limitations.bound import (
    forbids,
    forbids_most,
    lower_bound,
    pointwise,
    upper_bound,
)
from ccd_casadi.extensions.limitations.multiplier import Limits, response_of
from ccd_casadi.fixed_structure.bounds import Bounds
from ccd_casadi.fixed_structure.channel_structure import ChannelStructure
from ccd_casadi.fixed_structure.uncertainty import UncertainPlant
from ccd_casadi.inner_problem.controller_problem import BANDWIDTH
from ccd_casadi.inner_problem.problem import CoDesignProblem
from ccd_casadi.inner_problem.structured_plant_set import bounds_of, structure_of, uncertain_plant
from ccd_casadi.inner_problem.structured_problem import StructuredProblem, structured_of
from ccd_casadi.lti.loop import Sampling, zoh
from ccd_casadi.lti.state_space import StateSpace, strictly_proper
from ccd_casadi.plants.plant_facts import Zero, bandwidth_limit_hz
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import PlantError, UserError
from ccd_casadi.support.json_files import json_values
from ccd_casadi.support.text import HZ, number


def limits_of(
    plant: StateSpace,
    bounds: Bounds,
    sampling: Sampling | None,
    name: str = "",
    direction: Array | None = None,
    ratio: float = 1.0,
    integrator: bool = True,
    outside: float = 1e-3,
) -> Limits:
    """Find the limits of a SI plant in a direction of outputs (one output: None).

    `bounds` are its own. Free bodies and unstable poles make S vanish there; what is used here, T
    analytic with zeros of G, holds with them too. A root whose real part is `outside` of its size
    counts as one of the right half plane.
    """
    if sampling is None:
        held, period = plant, 0.0
    else:
        held, period = zoh(plant, sampling.period, sampling.delay), sampling.period
    u = np.ones((1, 1)) if direction is None else np.asarray(direction)[None, :]
    parts = (
        response_of(
            StateSpace(held.A, held.B[:, [j]], u @ held.C, u @ held.D[:, [j]], period=period)
        )
        for j in range(held.B.shape[1])
    )
    row = tuple(part for part in parts if part is not None)
    one = plant.B.shape[1] == 1 and len(plant.C) == 1
    roots = (row[0].zeros, row[0].poles) if one else (np.empty(0, complex),) * 2
    beyond, growing = (tuple(part[part.real > outside * np.abs(part)].tolist()) for part in roots)
    free = None
    forced = getattr(plant, "mechanics", plant)  # on which disturbing forces act
    alone = forced.B.shape[1] == len(forced.C) == 1  # what they move is S times it
    if one and alone and bounds.compliance_max is not None:
        free = response_of(forced)
    return Limits(name, bounds, row, free, period, beyond, ratio, integrator, unstable=growing)


MODEL = "the model"


@dataclass(frozen=True)
class BandwidthGap:
    """Bounds on the bandwidth of every controller that keeps the bounds on the loop."""

    upper_bound: float  # rad/s that no controller on `plants` has; infinite: nothing bounds it
    lower_bound: float = 0.0  # rad/s that one on the model has; 0: not computed
    channel: str = ""  # that binds
    plants: str = MODEL  # in words
    model_bound: float = 0.0  # rad/s that none on the model has; 0: not computed
    limits: tuple[str, ...] = ()  # what unstable poles and zeros do to every loop, in words

    def finding(self, bandwidth: float) -> Finding:
        """Make the finding of the verdict, with a design's ω_b in rad/s."""
        if not np.isfinite(self.upper_bound):
            return Reason.NO_GAP()
        gap = self.upper_bound / bandwidth - 1.0
        bound = self.upper_bound / HZ
        return Reason.GAP(bandwidth_bound_hz=bound, plants=self.plants, relative=gap)

    def entry(self, bandwidth: float = np.nan) -> dict[str, Any]:
        """Write the entry of result.json: Hz, and the bound over a design's ω_b (rad/s) less 1;
        null: not known.

        `objective_bound`, of J over θ, is not known yet.
        """
        found = {
            "bandwidth_bound_hz": self.upper_bound / HZ,
            "plants": self.plants,
            "model_bound_hz": self.model_bound / HZ or np.nan,
            "inside_hz": self.lower_bound / HZ or np.nan,
            "relative": self.upper_bound / bandwidth - 1.0,
            "channel": self.channel,
            "objective_bound": np.nan,
            "limits": list(self.limits),
            "words": self.finding(bandwidth).words() if np.isfinite(bandwidth) else "",
        }
        return json_values(found)


def gap_of(problem: CoDesignProblem, theta: Sequence[float], within: bool = True) -> BandwidthGap:
    """The bound in rad/s on every controller at θ (SI), of a problem with a fixed structure.

    On the model it holds for every set that has the model in it; `within`: whether to bound it
    there from both sides too, of one channel. Raises UserError where the problem is of another
    kind.
    """
    loops = sorted(limits_of_problem(problem, theta), key=pointwise)
    if loops[0].name:
        found, channel = np.inf, ""
        for limits in loops:
            bound = upper_bound(limits, found)
            if bound < found:
                found, channel = bound, limits.name
        return BandwidthGap(found, channel=channel)
    (model,) = loops
    words = classic_limits(model)
    if bounds_of(problem).error is not None:
        return BandwidthGap(upper_bound(model), limits=words)
    pairs = opposite_corners(
        uncertain_plant(problem, theta), bounds_of(problem), structured_of(problem).sampling,
        integrator=model.integrator,
    )  # fmt: skip
    limits = forbids_most([model, *pairs])
    on = "the set" if limits.others else MODEL
    gap = BandwidthGap(upper_bound(limits), plants=on, limits=words)
    if not within:
        return gap
    most = upper_bound(model)
    if model.unstable:  # a T that keeps the bounds need not be 1 at these poles
        return replace(gap, model_bound=most)
    return replace(gap, model_bound=most, lower_bound=lower_bound(model, most))


def of_counted_sensor(plant: StateSpace, bounds: Bounds, sampling: Sampling | None,
                      integrator: bool) -> Limits:  # fmt: skip
    """Find the limits of the loop of the sensor whose error counts, of several on one actuator.

        1 - uᵀS r = uᵀG q,   q = K S r,   uᵀr = 1

    Whatever the other sensors add, q is stable and |q| at most ‖KS‖ ‖r‖. S G has no bound here.
    """
    own = bounds.channels[bounds.error or 0]
    C, B = np.array([own.output]) @ plant.C, plant.B * np.linalg.norm(own.reference)
    bounds = replace(bounds.of_channel(bounds.error or 0), weights=bounds.weights,
                     compliance_max=None)  # fmt: skip
    one = strictly_proper(plant.A, B, C)
    return limits_of(one, bounds, sampling, integrator=integrator)


def classic_limits(limits: Limits) -> tuple[str, ...]:
    """Describe what holds for every controller of one channel, with figures; z and p in v.

        S(z) = 1, S(p) = 0:   ‖S‖∞ >= Π_p |z + p̄|/|z - p|
        T(p) = 1, T(z) = 0:   ‖T‖∞ >= Π_z |p + z̄|/|p - z|,   ‖S‖∞ >= ‖T‖∞ - 1

    Hold and delay are zeros at 2/T. By Poisson's integral at a real p, with |T| <= 1 + S_max,
    |T| is above 1/√2 somewhere from p tan(π/2 ln √2/(ln √2 + ln(1 + S_max))) on.
    """
    z, p = np.array(limits.beyond, complex), np.array(limits.unstable, complex)
    S_max, period = limits.bounds.S_max, limits.period
    words = []
    for zero in z[(z.imag >= 0.0) & (np.abs(z) < 1.9 / period if period else True)]:
        found = Zero(abs(zero) / HZ, -zero.real / abs(zero), 1.0)
        words.append(
            f"a zero in the right half plane at {number(abs(zero) / HZ, 3)} Hz: no bandwidth above "
            f"{number(bandwidth_limit_hz(found, S_max), 3)} Hz within S_max"
        )
    if not len(p):
        return tuple(words)
    pairs = np.abs(z[:, None] + p.conj()) / np.abs(z[:, None] - p)
    least_T = float(pairs.prod(axis=0).max())
    least_S = max(float(pairs.prod(axis=1).max(initial=1.0)), least_T - 1.0)
    share = np.log(2.0) / (np.log(2.0) + 2.0 * np.log(1.0 + S_max))
    fastest = p[p.real.argmax()]
    said = (
        f"an unstable pole at {number(abs(fastest) / HZ, 3)} Hz: no controller has a peak of S "
        f"below {number(least_S, 4)}, of T below {number(least_T, 4)}"
    )
    if fastest.imag == 0.0:
        from_on = limits.omega(np.array(fastest.real * np.tan(0.5 * np.pi * share)))
        said += f", and |T| exceeds 0.707 beyond {number(float(from_on) / HZ, 3)} Hz"
    return (*words, said)


def opposite_corners(
    uncertain: UncertainPlant, bounds: Bounds, sampling: Sampling | None, integrator: bool
) -> list[Limits]:
    """List the limits at each corner of the box with the least damping, and at the one opposite;
    one input and output.

    One controller serves both, so that both plants' bounds count; T is the first one's.
    """

    def limits(point: Array) -> Limits:
        return limits_of(uncertain.plant(point).plant_si(), bounds, sampling, integrator=integrator)

    found: list[Limits] = []
    box, model = uncertain.box, uncertain.plant(uncertain.nominal)
    several = model.B.shape[1] > 1
    damping = np.array([name == "damping" for name in uncertain.names], bool)
    for option, point in uncertain.corners()[len(uncertain.options) :]:
        if option or several or (point > box[0])[damping].any():
            continue
        opposite = np.where(damping, point, box.sum(axis=0) - point)
        with suppress(PlantError):
            found.append(replace(limits(point), others=(limits(opposite),)))
    return found


def known_gap(problem: CoDesignProblem, theta: Sequence[float]) -> BandwidthGap | None:
    """The upper bound alone, which takes seconds.

    Parameters
    ----------
    problem, theta : CoDesignProblem, (n_θ,) sequence
        As of `gap_of`.

    Returns
    -------
    BandwidthGap or None
        None for a problem of another kind.
    """
    try:
        return gap_of(problem, theta, within=False)
    except UserError:
        return None


def none_reaches(problem: CoDesignProblem, theta: Sequence[float], omega_b: float) -> bool:
    """Whether it is shown, in a fraction of a second, that no controller has a bandwidth.

    Parameters
    ----------
    problem, theta : CoDesignProblem, (n_θ,) sequence
        As of `gap_of`; the model alone counts.
    omega_b : float
        rad/s.

    Returns
    -------
    bool
        False where nothing is known.
    """
    if not omega_b > 0.0:
        return False
    try:
        loops = limits_of_problem(problem, theta)
    except (UserError, PlantError):
        return False
    return any(forbids(limits, omega_b) for limits in loops)


def limits_of_problem(problem: CoDesignProblem, theta: Sequence[float]) -> list[Limits]:
    """One loop of a plant with one output; else one for each channel's direction of outputs."""
    if not isinstance(problem.controller, StructuredProblem):
        raise UserError('gap: is known for controller.structure = "sections" alone')
    if problem.figure is not BANDWIDTH:
        raise UserError("gap: is known for the bandwidth alone; drop inner.minimise")
    uncertain, structure = uncertain_plant(problem, theta), structure_of(problem)
    plant = uncertain.plant(uncertain.nominal).plant_si()
    bounds, sampling = bounds_of(problem), structured_of(problem).sampling
    if bounds.error is not None:
        return [of_counted_sensor(plant, bounds, sampling, structure.integrator)]
    if not isinstance(structure, ChannelStructure):
        return [limits_of(plant, bounds, sampling, integrator=structure.integrator)]
    whole = bounds.weights  # a channel's own M_K bounds one direction of its forces alone
    return [
        limits_of(
            plant, replace(bounds.of_channel(i), weights=whole), sampling, name,
            structure.decoupling.outputs[:, i], ratio=float(np.exp(bounds.lead(i))),
            integrator=structure.integrator,
        )
        for i, name in enumerate(structure.decoupling.names)
    ]  # fmt: skip
