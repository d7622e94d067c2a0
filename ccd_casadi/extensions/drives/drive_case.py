"""What `ccd drive` designs: the cascade, plants and bounds of a case with [drive], and its θ.

With --codesign θ is searched without derivatives, and the cascade carried along:

    min w1 f(θ) + w2 ω_b(θ)   s.t.  lower <= θ <= upper,  λ(θ) <= 0

ω_b(θ) is that of the fastest cascade before rounding. At the first θ it is searched from every
start, at each further one from the parameters at the best θ so far, scaled by what the mass that
the force moves has become; so it is a lower estimate of ω_b(θ) there. Parameters from lists are
tried value by value. COBYQA (Ragonneau and Zhang, SciPy) moves the others.
"""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy.optimize import Bounds as Box
from scipy.optimize import NonlinearConstraint, minimize

from ccd_casadi.cases.case import Case
from ccd_casadi.cases.case_problem import plain_case, problem_of
from ccd_casadi.cases.checks import CaseError
from ccd_casadi.cases.controller_tables import DriveTable, FiltersTable
from ccd_casadi.extensions.drives.cascade import Cascade
from ccd_casadi.extensions.drives.cascade_search import Candidate, Search
from ccd_casadi.extensions.drives.drive_data import Drive, Setting, Slot, read_drive
from ccd_casadi.extensions.drives.drive_design import (
    NO_CASCADE,
    DriveOptions,
    first_points,
    plants_at,
    require_known,
)
from ccd_casadi.fixed_structure.bounds import Bounds
from ccd_casadi.fixed_structure.uncertainty import UncertainPlant
from ccd_casadi.inner_problem.problem import CoDesignProblem, plant_of, refuse_ports, with_ports
from ccd_casadi.inner_problem.structured_bandwidth import require_bandwidth
from ccd_casadi.inner_problem.structured_plant_set import bounds_of, uncertain_plant
from ccd_casadi.inner_problem.structured_problem import StructuredProblem
from ccd_casadi.lti.loop import Sampling
from ccd_casadi.plants.plant import constraint_values, hardware_cost
from ccd_casadi.reporting.facts import theta_words
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import UserError
from ccd_casadi.support.terminal import Log, silent
from ccd_casadi.support.text import HZ, number


@dataclass(frozen=True)
class DriveProblem:
    """A cascade, its plants at one θ of a co-design problem, and what its loops have to keep;
    `ported`: the plants with their ports, where compliance_max bounds what a force moves."""

    problem: CoDesignProblem
    theta: tuple[float, ...]  # in the case's units
    cascade: Cascade
    uncertain: UncertainPlant
    bounds: Bounds
    sampling: Sampling
    ported: UncertainPlant | None = None


def drive_problem(case: Case, theta: Sequence[float] | None = None) -> DriveProblem:
    """The problem of a case at a θ, or at its start; UserError: what does not go with a drive."""
    table = case.drive
    if table.name is None:
        words = "drive.name: is missing; add a table [drive] with the drive's name"
        raise CaseError(f"{case.path}: {words}")
    try:
        drive = read_drive(table.name, case.path.parent)
        if drive.loop != "cascade":
            words = f"{drive.title} has no cascade; its PID is not designed yet"
            raise UserError(f"{words}: use `ccd tune`, or another drive")
        most = case.inner.compliance_max
        plain, current = plain_case(case), tuple[tuple[Setting, float], ...]()
        if table.coil:
            if case.actuator != FiltersTable():
                raise UserError("coil designs what [actuator] states; give one of both")
            plain, current = _with_current_loop(plain, drive, table.coil)
        problem = problem_of(plain)
        if not isinstance(problem.controller, StructuredProblem):
            raise UserError('controller.structure is not "sections"; a drive needs that')
        if problem.sampling is None:
            raise UserError("loop.rate_hz is missing; a drive is sampled, give its rate")
        if most is None:
            refuse_ports(problem, "[drive] without inner.compliance_max")
        elif problem.source.wiring:
            words = "inner.compliance_max beside [actuator] or [sensor] is not known to it"
            raise UserError(f"{words}; drop one of the two")
        bounds = replace(bounds_of(problem), compliance_max=most)
        at = problem.start if theta is None else tuple(theta)
        if (travel := _travel(table.lead_mm, problem, at)) is not None:
            drive = drive.behind_screw(travel)
        filters: list[Slot] = []
        for place, count in (("current", table.filters), ("setpoint", table.setpoint_filters)):
            there = drive.places(place)
            if count > len(there):
                words = f"has {len(there)} filters of the {place}, not {count}"
                raise UserError(f"{drive.title} {words}; use that many at most")
            filters += there[:count]
        position, velocity, count = _sensors(bounds, table.velocity)
        cascade = Cascade(drive, problem.sampling.period, tuple(filters), position, velocity, count,
                          table.filter_gain, table.filters_above, table.decay,
                          _slower(table, problem.sampling, bounds.omega_low),
                          HZ * (table.compliance_hz or np.inf), current)  # fmt: skip
        require_known(cascade, bounds)
        uncertain, ported = uncertain_plant(problem, at), None
        if most is not None:
            ported = uncertain_plant(with_ports(problem), at)
            wide = ported.options[0]
            if wide.B.shape[1] > 2 or len(wide.C) > count + 1:
                words = "disturbance and performance are several"
                raise UserError(f"{words}; [drive] bounds what one force moves: return one of each")
    except CaseError:
        raise
    except UserError as error:
        raise CaseError(f"{case.path}: drive: {error}") from None
    return DriveProblem(problem, at, cascade, uncertain, bounds, problem.sampling, ported)


def _with_current_loop(
    case: Case, drive: Drive, coil: Sequence[float]
) -> tuple[Case, tuple[tuple[Setting, float], ...]]:
    """The case with the loop of a current controller as its actuator, and the controller.

    By the magnitude optimum Kp = L/(2σ), Tn = L/R, σ = 1.5 of its periods: one to compute, a half
    of the hold. Tn cancels the coil's pole; with Kp as it is rounded, σ as a lag, and without the
    motor's EMF, the current follows as 1/(1 + sL/Kp (1 + σs)).
    """
    R, L, rate = coil
    gain, time = drive.current, drive.current_integral
    if gain is None or time is None:
        raise UserError(f"{drive.title} has no parameters of a current controller; drop coil")
    sigma = 1.5 / rate
    Kp, Tn = gain.round_value(L / (2.0 * sigma)), time.round_value(L / R)
    if not Kp > 0.0 or abs(Tn * R / L - 1.0) > 0.05:
        words = f"coil needs Kp {L / (2.0 * sigma):g} V/A and Tn {L / R:g} s"
        raise UserError(f"{words}, which the drive has not; correct it, or give [actuator] instead")
    omega = np.sqrt(Kp / (L * sigma))
    lag = FiltersTable(second_order_hz=float(omega / HZ), damping=float(0.5 / (sigma * omega)))
    return replace(case, actuator=lag), ((gain, Kp), (time, Tn))


def _travel(
    lead: float | str | None, problem: CoDesignProblem, theta: Sequence[float]
) -> float | None:
    """m of travel per rad of a rotary motor; None of a linear one."""
    if lead is None:
        return 1.0 if problem.spoken[0] == "rad" else None
    if isinstance(lead, str):
        if dict(zip(problem.names, problem.units, strict=True)).get(lead) != "mm":
            raise UserError(f"lead_mm is {lead!r}; give a number, or the name of a [theta] in mm")
        lead = dict(zip(problem.names, theta, strict=True))[lead]
    if not lead > 0.0 or problem.spoken[0] == "rad":
        raise UserError(f"lead_mm is {lead:g}; give mm above 0 per turn, of a plant in m")
    return 1e-3 * lead / HZ


def _slower(table: DriveTable, sampling: Sampling, omega_low: float) -> int:
    """Instants of the loop's rate to one of the position's."""
    if table.position_rate_hz is None:
        return 1
    ratio = sampling.rate_hz / table.position_rate_hz
    slower = round(ratio)
    if slower < 1 or abs(ratio - slower) > 1e-9 * ratio:
        words = f"position_rate_hz is {table.position_rate_hz:g}, no whole part of loop.rate_hz"
        raise UserError(f"{words}; give {sampling.rate_hz:g} over 1, 2, 3, ...")
    if HZ * table.position_rate_hz <= 2.0 * omega_low:
        words = f"position_rate_hz is {table.position_rate_hz:g}, at most twice inner.omega_low_hz"
        raise UserError(f"{words}, below which a loop has to act; give it in Hz, and larger")
    return slower


def _sensors(bounds: Bounds, velocity: str | None) -> tuple[int, int, int]:
    """The sensors of position and of velocity, and how many there are."""
    if bounds.error is None:
        if velocity is not None:
            words = f"velocity is {velocity!r}, and there is one sensor"
            raise UserError(f"{words}; give channels and controller.bandwidth_of, or drop it")
        return 0, 0, 1
    sensors = bounds.channels[:-1]
    names = [one.name for one in sensors]
    if not all(np.count_nonzero(one.output) == 1 and max(one.output) == 1.0 for one in sensors):
        raise UserError("channels mix sensors; a drive takes each by itself: outputs = [1, 0]")
    if velocity not in names:
        there = ", ".join(names)
        raise UserError(f"velocity is {velocity!r}; name the motor's channel, one of {there}")
    order = [one.output.index(1.0) for one in sensors]
    if order != list(range(len(order))):
        raise UserError("channels are not in the order of the plant's outputs; reorder them")
    return bounds.error, names.index(velocity), len(names)


@dataclass(frozen=True)
class DriveCodesignOptions:
    """Numbers of the search over θ."""

    evaluations: int = 20  # θ that are tried for each combination of listed values, at most
    first: float = 0.2  # step of θ at the start, as a share of the box
    last: float = 0.02  # and at the end
    penalty: float = 10.0  # J of a θ without a cascade, over |J| of the first one
    met: float = 1e-9  # λ that counts as met
    drive: DriveOptions = field(default_factory=DriveOptions)


@dataclass(frozen=True)
class DriveAt:
    """The fastest cascade at one θ, before rounding."""

    theta: tuple[float, ...]  # in the case's units
    cost: float  # f(θ)
    objective: float  # J
    candidate: Candidate
    mass: float  # kg that the force moves


def codesign_drive(
    drive: DriveProblem, seed: int = 0, progress: Log = silent,
    options: DriveCodesignOptions = DriveCodesignOptions(),
) -> tuple[DriveAt, DriveAt]:  # fmt: skip
    """Find the best θ for a drive's cascade, from the case's start, which has to have one.

    Raises UserError where no θ that was tried has a cascade and meets the constraints, or J counts
    another figure than ω_b. Returns what is at the start, and at the best θ.
    """
    problem = drive.problem
    require_bandwidth(problem, "ccd drive --codesign")
    first = _design(drive, problem.start, None, seed, options)
    if first is None:
        raise UserError(NO_CASCADE)
    best = first
    listed = dict(problem.listed)
    lists = [listed.get(name, (value,)) for name, value in
             zip(problem.names, problem.start, strict=True)]  # fmt: skip
    free = [i for i, name in enumerate(problem.names)
            if name not in listed and problem.upper[i] > problem.lower[i]]  # fmt: skip
    lower, upper = np.array(problem.lower)[free], np.array(problem.upper)[free]
    tried, allowed = 0, meets_constraints(problem, problem.start, options)
    for chosen in itertools.product(*lists):

        def theta_of(share: Array, chosen: Sequence[float] = chosen) -> tuple[float, ...]:
            theta = list(map(float, chosen))
            for i, value in zip(free, lower + share * (upper - lower), strict=True):
                theta[i] = float(value)
            return tuple(theta)

        def objective(share: Array, theta_of=theta_of) -> float:  # type: ignore[no-untyped-def]
            nonlocal best, tried, allowed
            theta = theta_of(share)
            found = _design(drive, theta, best, seed, options)
            tried += 1
            if (
                found is not None
                and (found.objective < best.objective or not allowed)
                and meets_constraints(problem, theta, options)
            ):
                allowed = True
                best = found
                progress(f"{tried} theta: J {number(best.objective, 6)}, "
                         f"{number(best.candidate.bandwidth / HZ, 4)} Hz")  # fmt: skip
            return options.penalty * abs(first.objective) if found is None else found.objective

        begin = (np.array(best.theta)[free] - lower) / (upper - lower)
        if not free:
            if meets_constraints(problem, theta_of(begin), options):
                objective(begin)
            continue
        limits = NonlinearConstraint(
            lambda share, theta_of=theta_of: constraint_values(plant_of(problem), theta_of(share)),
            -np.inf, 0.0,
        )  # fmt: skip
        minimize(objective, begin, method="COBYQA", bounds=Box(np.zeros(len(free)), 1.0),
                 constraints=[limits] if plant_of(problem).constraint_names else [],
                 options={"maxfev": options.evaluations, "initial_tr_radius": options.first,
                          "final_tr_radius": options.last})  # fmt: skip
    if not allowed:
        raise UserError(f"no theta of {tried} tried meets the constraints; start nearer to one")
    return first, best


def meets_constraints(
    problem: CoDesignProblem, theta: Sequence[float],
    options: DriveCodesignOptions = DriveCodesignOptions(),
) -> bool:  # fmt: skip
    """Whether θ meets the constraints of the plant."""
    values = constraint_values(plant_of(problem), theta)
    return bool((values <= options.met).all())


def _design(
    drive: DriveProblem, theta: tuple[float, ...], near: DriveAt | None, seed: int,
    options: DriveCodesignOptions,
) -> DriveAt | None:  # fmt: skip
    """The cascade at a θ, from that at another one; None where none meets the bounds."""
    problem, own = drive.problem, options.drive.search
    of = problem if drive.ported is None else with_ports(problem)
    uncertain = uncertain_plant(of, theta)
    plants = plants_at(uncertain, first_points(uncertain))
    search = Search(drive.cascade, drive.bounds, drive.sampling, plants, own)
    if near is None:
        found = search.fastest(seed)
    else:
        values = near.candidate.values * np.where(
            np.arange(len(near.candidate.values)) == 1, search.mass / near.mass, 1.0
        )
        values = np.clip(values, *np.exp([search.low, search.high]))
        found = None
        if search.stable(values):
            found = search.settle(replace(near.candidate, values=values))
        if found is None or not found.excess < own.met:
            few = replace(own, starts=max(1, own.starts // 6))
            found = Search(drive.cascade, drive.bounds, drive.sampling, plants, few).fastest(seed)
    if found is None:
        return None
    cost = hardware_cost(plant_of(problem), theta)
    J = problem.w1 * cost + problem.w2 * found.bandwidth
    return DriveAt(theta, cost, J, found, search.mass)


def named_theta(problem: DriveProblem, theta: Sequence[float]) -> dict[str, float]:
    """θ by name, in the case's units."""
    return dict(zip(problem.problem.names, theta, strict=True))


def figures_of(problem: DriveProblem, at: DriveAt) -> dict[str, Any]:
    """Write the figures of a θ before rounding."""
    return {"theta": named_theta(problem, at.theta), "bandwidth_hz": at.candidate.bandwidth / HZ,
            "hardware_cost": at.cost, "objective": at.objective}  # fmt: skip


def codesign_words(problem: DriveProblem, entry: Mapping[str, Any]) -> str:
    """Both designs of a co-design, a line each."""
    units = problem.problem.parameter_units
    return "\n".join(
        f"{name:14s}J {number(one['objective'], 5)}, {number(one['bandwidth_hz'], 4)} Hz, cost "
        f"{number(one['hardware_cost'], 4)} {problem.problem.cost_unit}".rstrip()
        + f" at {theta_words({'theta': one['theta'], 'units': units})}"
        for name, one in entry.items()
    )
