"""What is wrong, or worth knowing, with a plant before a design; and the report of it by `check`.

A plant is checked at the start of θ, the middle and the corners of the box. Errors are what no
design can be made with; warnings what a designer must know; notes what explains the bandwidth.
"""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from itertools import product
from typing import Any

import numpy as np

from ccd_casadi.analysis import MOTOR_LIMITS
from ccd_casadi.cases.findings import (
    CaseFinding,
    Severity,
    Topic,
    plausibility_findings,
    unit_findings,
)
from ccd_casadi.cases.plant_findings import (
    DiagnosisOptions,
    controller_findings,
    driven_away_findings,
    entry_findings,
    hidden_findings,
    loop_findings,
    most_limiting,
    outside_findings,
    rest_findings,
    rigid_findings,
    zero_findings,
)
from ccd_casadi.cases.tables import Case
from ccd_casadi.inner_problem.problem import CoDesignProblem, plant_of
from ccd_casadi.inner_problem.structured_bandwidth import motion_of
from ccd_casadi.inner_problem.structured_plant_set import with_ranges
from ccd_casadi.inner_problem.structured_problem import StructuredProblem
from ccd_casadi.plants.modal import modal_plant, require_damping, without_hidden_rigid_modes
from ccd_casadi.plants.plant import (
    Mechanics,
    Plant,
    constraint_values,
    hardware_cost,
    hardware_slopes,
    mechanics,
    named_values,
)
from ccd_casadi.plants.plant_facts import PlantFacts, facts_of
from ccd_casadi.plants.scaling import scale_plant
from ccd_casadi.support.errors import PlantError, UserError
from ccd_casadi.support.terminal import Progress
from ccd_casadi.support.text import is_force, number, of_newtons, plural, spoken


def points_to_check(
    problem: CoDesignProblem, seed: int = 0, *, options: DiagnosisOptions = DiagnosisOptions()
) -> list[tuple[float, ...]]:
    """Start, middle, and the corners of the box, of which some are drawn where they are many."""
    lower, upper = np.array(problem.lower), np.array(problem.upper)
    n = len(lower)
    if n <= np.log2(options.most_corners):
        sides = np.array(list(product((0.0, 1.0), repeat=n)))
    else:
        sides = np.random.default_rng(seed).integers(0, 2, (options.most_corners, n)).astype(float)
    corners = lower + (upper - lower) * sides
    rows = [problem.start, 0.5 * (lower + upper), *corners]
    return list(dict.fromkeys(tuple(float(value) for value in row) for row in rows))


@lru_cache(maxsize=4)
def diagnose(
    problem: CoDesignProblem,
    rigid_modes: int | None = None,
    seed: int = 0,
    *,
    options: DiagnosisOptions = DiagnosisOptions(),
) -> tuple[tuple[PlantFacts, ...], tuple[CaseFinding, ...]]:
    """Check the plant of a problem over its box.

    The plant is checked at `points_to_check`, where parameters that vary belong to θ. Repeated
    calls are answered from a cache.

    Parameters
    ----------
    problem : CoDesignProblem
    rigid_modes : int, optional
        Number of rigid-body modes that is expected.
    seed : int
        Of the corners that are drawn.
    options : DiagnosisOptions

    Returns
    -------
    facts : tuple of PlantFacts
        At the points where the matrices are those of a plant.
    findings : tuple of CaseFinding

    Raises
    ------
    PlantError
        The model's function fails.
    """
    own = problem
    if isinstance(problem.controller, StructuredProblem):
        problem = with_ranges(problem)
    plant = plant_of(problem)
    facts: list[PlantFacts] = []
    findings = list(outside_findings(problem, plant))
    if findings:
        return (), tuple(findings)
    points = points_to_check(problem, seed, options=options)
    with Progress(len(points), "checking the plant") as progress:
        for index, theta in enumerate(points):
            progress.advance(int(index > 0))
            place = f"at theta = {named_values(plant.names, theta)}" if index else "at the start"
            try:
                system = mechanics(plant, theta, derivatives=index == 0)
                modal = modal_plant(system, problem.suspension.free)
                require_damping(modal)
                scaled = scale_plant(without_hidden_rigid_modes(modal), problem.weights.M_K)
            except PlantError as error:
                words = str(error) if "at theta" in str(error) else f"{error} {place}"
                findings.append(CaseFinding(Severity.ERROR, Topic.MATRICES, words, index))
                continue
            found = facts_of(theta, modal, scaled)
            doubt = (
                plant.mismatch(theta) or plant.doubt(theta)
                if index < options.with_derivatives
                else ""
            )
            here = [CaseFinding(Severity.ERROR, Topic.DERIVATIVES, doubt)] if doubt else []
            here += rigid_findings(modal, problem.suspension, rigid_modes, place)
            here += [
                *driven_away_findings(found, modal.states is not None, place),
                *hidden_findings(modal, place, options),
                *zero_findings(problem, found, place),
            ]
            if index == 0:
                here += unit_findings(problem, found, scaled) + entry_findings(problem, system)
                here += plausibility_findings(problem, found)
                here += loop_findings(problem, found, modal) + controller_findings(problem)
                here += _unused_parameters(problem, plant, system)
            findings += [replace(item, index=index) for item in here]
            facts.append(found)
        progress.advance()
    findings = [*most_limiting(findings), *_unmet(plant, facts)]
    if not any(item.severity is Severity.ERROR for item in findings):
        findings += rest_findings(own, points_to_check(own, seed, options=options))
    counts = sorted({sum(mode.rigid for mode in item.modes) for item in facts})
    if len(counts) > 1 and rigid_modes is None:
        words = (
            f"from {counts[0]} to {counts[-1]} rigid-body modes over the bounds of theta: a mode "
            "that is free at one theta and held at another has no derivative between; narrow the "
            "bounds, or hold it everywhere"
        )
        findings.append(CaseFinding(Severity.WARNING, Topic.RIGID_MODES, words))
    return tuple(facts), tuple(findings)


def _unmet(plant: Plant, facts: Sequence[PlantFacts]) -> list[CaseFinding]:
    """Warn of constraints that none of the examined points meets."""
    if not facts or not plant.constraint_names:
        return []
    least = np.min([constraint_values(plant, item.theta) for item in facts], axis=0)
    found = []
    for name, value in zip(plant.constraint_names, least.tolist(), strict=True):
        if not value > 0.0:
            continue
        words = f"constraint {name} is met at none of {plural(len(facts), 'point')} of the box"
        size = f"its least value is {value:.4g}"
        if name in MOTOR_LIMITS:
            size = f"the move needs {value + 1.0:.4g} times what the motor allows, or more"
        found.append(CaseFinding(Severity.WARNING, Topic.UNITS, f"{words}: {size}; is a number in "
                                 "another unit, or are the bounds too narrow?"))  # fmt: skip
    return found


def _unused_parameters(
    problem: CoDesignProblem, plant: Plant, system: Mechanics
) -> list[CaseFinding]:
    """Parameters that change no matrix, cost or constraint, from end to end of their bounds."""
    of_cost = (np.moveaxis(of, -1, 0) for of in hardware_slopes(plant, problem.start))
    slopes = [*system.derivatives, *of_cost]
    found = []
    for i, name in enumerate(problem.names):
        if any(len(slope) and np.abs(slope[i]).max(initial=0.0) > 0.0 for slope in slopes):
            continue
        ends = [(*problem.start[:i], end, *problem.start[i + 1 :])
                for end in (problem.lower[i], problem.upper[i])]  # fmt: skip
        low, high = (
            [*mechanics(plant, end, derivatives=False).matrices, constraint_values(plant, end)]
            for end in ends
        )
        same = hardware_cost(plant, ends[0]) == hardware_cost(plant, ends[1])
        if same and all(np.array_equal(a, b) for a, b in zip(low, high, strict=True)):
            words = (
                f"theta.{name} changes nothing: neither matrices nor hardware_cost nor a "
                "constraint depend on it; use it in the plant function, or take it out of the case"
            )
            found.append(CaseFinding(Severity.WARNING, Topic.UNUSED, words))
    return found


def suspicions(
    problem: CoDesignProblem, rigid_modes: int | None = None, *, designed: bool = False
) -> list[str]:
    """List likely causes where no design is found: numbers in another unit, a sign, the loop, an
    unstable pole of the plant.

    Parameters
    ----------
    problem : CoDesignProblem
    rigid_modes : int, optional
        Number of rigid-body modes that is expected.
    designed : bool
        Whether there is a design, which is not verified: it stabilises the plant.

    Returns
    -------
    list of str
    """
    found = diagnose(problem, rigid_modes)[1]
    words = [item.words for item in found if item.topic in (Topic.UNITS, Topic.LOOP)]
    unstable = [item.words for item in found if item.topic is Topic.UNSTABLE]
    return words if designed else [*words, *unstable[:1]]


def first_seen(findings: Sequence[CaseFinding]) -> list[CaseFinding]:
    """Select the findings at the first θ where their topic occurs.

    A finding at one θ mostly holds, with other numbers, at the others, too.

    Parameters
    ----------
    findings : sequence of CaseFinding

    Returns
    -------
    list of CaseFinding
        The serious ones first.
    """
    first: dict[tuple[Topic, Severity], int] = {}
    for item in findings:
        first.setdefault((item.topic, item.severity), item.index)
    kept = [item for item in findings if item.index == first[item.topic, item.severity]]
    return sorted(kept, key=lambda item: list(Severity).index(item.severity))


@dataclass(frozen=True)
class PlantReportOptions:
    """Rules of thumb of the report.

    Attributes
    ----------
    window : tuple of float
        ω_b over the frequency at which M_K σ_min(G) = 1: 0.86 to 1.06 on case study 1, less
        with resonances nearby.
    shares : tuple of float
        Bandwidths over the first resonance, for each of which an M_K is given.
    velocities : tuple of float
        Velocity limits over the velocity that a move reaches, tried whether they shorten it.
    shorter : float
        Relative: by how much that is worth a line.
    """

    window: tuple[float, float] = (0.4, 1.1)
    shares: tuple[float, ...] = (0.2, 1.0 / 3.0, 0.5)
    velocities: tuple[float, ...] = (0.9, 0.8)
    shorter: float = 0.01


def plant_report(
    case: Case,
    problem: CoDesignProblem,
    facts: Sequence[PlantFacts],
    findings: Sequence[CaseFinding],
    *,
    options: PlantReportOptions = PlantReportOptions(),
) -> dict[str, Any]:
    """Write the diagnosis of a plant as plain values.

    Parameters
    ----------
    case : Case
    problem : CoDesignProblem
        Of the case.
    facts, findings : sequences
        As `diagnose` returns them.
    options : PlantReportOptions

    Returns
    -------
    dict
        Frequencies in Hz, M_K in N/m.
    """
    plant = plant_of(problem)
    start = facts[0]
    values = constraint_values(plant, problem.start)
    constraints = zip(plant.constraint_names, values, strict=True)
    start_of = dict(zip(problem.names, problem.start, strict=True))
    between = any(start_of[name] not in values for name, values in problem.listed)
    count = min(len(item.modes) for item in facts)
    hertz = np.array([[mode.frequency_hz for mode in item.modes[:count]] for item in facts])
    return {
        "plant": case.plant.name,
        "inputs": plant.inputs,
        "outputs": plant.outputs,
        "notes": list(plant.notes(problem.start)),
        "theta": dict(zip(problem.names, problem.start, strict=True)),
        "varies": {p.name: [p.lower, p.upper] for p in case.fixed if p.varies},
        "units": {parameter.name: parameter.unit for parameter in (*case.theta, *case.fixed)},
        "points": len(facts),
        "size": size_words(start, case, options=options),
        "inertia": start.inertia,
        "rigid_modes": sum(mode.rigid for mode in start.modes),
        "modes": [asdict(mode) for mode in start.modes],
        # least and largest of the i-th mode in order of frequency, over the points
        "frequency_ranges_hz": np.column_stack([hertz.min(axis=0), hertz.max(axis=0)]).tolist(),
        "zeros": [asdict(zero) for zero in start.zeros],
        "effort_hz": start.effort_hz,
        "bandwidth_window_hz": [share * start.effort_hz for share in options.window],
        "M_K": case.weights.M_K,
        "M_K_for_bandwidth": _suitable(problem, start, options.shares),
        "constraints": [
            {"name": name, "value": float(value), "met": bool(value <= 0.0), "open": between}
            for name, value in constraints
        ],
        "move": _move(problem),
        "slower_is_faster": _slower_velocity(problem, options),
        "budget": [  # each source by the RMS of its spectrum; None where it is white
            {"name": s.name, "kind": s.kind.value, "rms": s.spectrum.rms(), "unit": s.unit}
            for s in (problem.budget.sources if problem.budget else ())
        ],
        "findings": [
            {"severity": f.severity.value, "topic": f.topic.value, "words": f.words}
            for f in first_seen(findings)
        ],
    }


def _move(problem: CoDesignProblem) -> dict[str, Any] | None:
    """The move at the start of θ and what its rigid body needs on the worst plant, keys as in
    result.json; None where the case has none, or the plant cannot make it."""
    motion = problem.source.motion
    if motion is None:
        return None
    try:
        found = motion_of(problem, problem.start)
    except UserError:  # what designs a controller reports it
        return None
    cycle, motor, of_motor = found.cycle, motion.motor, {}
    if motor is not None:
        k, _, i_peak = map(float, motor.at(found.mass))
        of_motor = {
            "peak_current": cycle.peak_force / k, "rms_current": cycle.rms_force / k,
            "current_limit": i_peak if i_peak < motor.unlimited else None,
            "power": cycle.power, "power_limit": motor.rms_power,
        }  # fmt: skip
    return {
        "distance": motion.limits.stroke, "duration": cycle.profile.duration,
        "worst": len(found.inertia) > 1 or found.motion.loads.gain > 0.0,
        "limits": list(cycle.limits), "peak_force": float(cycle.peak_force),
        "rms_force": float(cycle.rms_force), **of_motor,
    }  # fmt: skip


def _slower_velocity(
    problem: CoDesignProblem, options: PlantReportOptions
) -> dict[str, float] | None:
    """The velocity limit, of a few below what the move at the start reaches, that shortens it most,
    and its duration; None where none does. Where heat limits, the setpoint is the fastest only of
    its form: with a lower velocity the same heat accelerates harder."""
    motion = problem.source.motion
    if motion is None:
        return None
    try:
        cycle = motion_of(problem, problem.start).cycle
    except UserError:  # what designs a controller reports it
        return None
    if "heat" not in cycle.limits:
        return None
    made, reached = [], float(np.real(cycle.profile.velocity))
    for share in options.velocities:
        limits = replace(motion.limits, velocity=share * reached)
        source = replace(problem.source, motion=replace(motion, limits=limits))
        at = motion_of(replace(problem, source=source), problem.start)
        made.append((at.cycle.profile.duration, share * reached))
    duration, velocity = min(made)
    worth = duration < (1.0 - options.shorter) * cycle.profile.duration
    return {"velocity": velocity, "duration": duration} if worth else None


def size_words(
    facts: PlantFacts, case: Case, *, options: PlantReportOptions = PlantReportOptions()
) -> str:
    """Write how large a plant is, which shows at a glance that numbers are not in SI.

    Parameters
    ----------
    facts : PlantFacts
    case : Case
    options : PlantReportOptions

    Returns
    -------
    str
    """
    parts = []
    if math.isfinite(facts.inertia) and is_force(case.units.input):
        felt = spoken(f"the mass felt by an actuator is {facts.inertia:.3g} kg")
        parts.append(felt + of_newtons(case.units.input))
    flexible = [mode.frequency_hz for mode in facts.modes if mode.resonant]
    parts += [f"the first resonance is at {flexible[0]:.3g} Hz"] if flexible else []
    if math.isfinite(facts.effort_hz) and not math.isnan(case.weights.M_K):
        low, high = (share * facts.effort_hz for share in options.window)
        parts.append(f"M_K suits a bandwidth of {number(low, 2)} to {number(high, 2)} Hz")
    return ", ".join(parts)


def _suitable(
    problem: CoDesignProblem, start: PlantFacts, shares: tuple[float, ...]
) -> list[dict[str, float]]:
    """M_K that moves `effort_hz` to shares of the first resonance, below which G falls as ω⁻²."""
    first = next((mode.frequency_hz for mode in start.modes if mode.resonant), math.nan)
    M_K, effort = problem.weights.M_K, start.effort_hz
    return [
        {"bandwidth_hz": share * first, "M_K": M_K * (share * first / effort) ** 2}
        for share in shares
        if math.isfinite(first / effort) and start.modes[0].rigid
    ]
