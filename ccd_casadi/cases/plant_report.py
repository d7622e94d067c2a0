"""What `check` finds of a plant over its box, as plain values."""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from ccd_casadi.cases.diagnosis import first_seen
from ccd_casadi.cases.findings import CaseFinding
from ccd_casadi.cases.tables import Case
from ccd_casadi.inner_problem.problem import CoDesignProblem, plant_of
from ccd_casadi.plants.plant import constraint_values
from ccd_casadi.plants.plant_facts import PlantFacts
from ccd_casadi.support.text import is_force, number, of_newtons, spoken


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
    """

    window: tuple[float, float] = (0.4, 1.1)
    shares: tuple[float, ...] = (0.2, 1.0 / 3.0, 0.5)


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
        "units": {parameter.name: parameter.unit for parameter in case.theta},
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
        "budget": [  # each source by the RMS of its spectrum; None where it is white
            {"name": s.name, "kind": s.kind.value, "rms": s.spectrum.rms(), "unit": s.unit}
            for s in (problem.budget.sources if problem.budget else ())
        ],
        "findings": [
            {"severity": f.severity.value, "topic": f.topic.value, "words": f.words}
            for f in first_seen(findings)
        ],
    }


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
