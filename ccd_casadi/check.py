"""`python -m ccd_casadi.check CASE.toml`: the plant over its box before anything is designed."""

import argparse
import json
import math
import sys
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from ccd_casadi.case import load_case, problem_of
from ccd_casadi.case_sections import Case
from ccd_casadi.command_line import ExitCode, parser, run
from ccd_casadi.diagnosis import Finding, Severity, diagnose, first_seen
from ccd_casadi.plant_facts import PlantFacts
from ccd_casadi.problem import CoDesignProblem, plant_of
from ccd_casadi.results import clean

# ω_b over the frequency at which M_K σ_min(G) = 1: 0.86 to 1.06 on case study 1, less where
# resonances stand in the way.
WINDOW = (0.4, 1.1)
SHARES = (0.2, 1.0 / 3.0, 0.5)  # of the first resonance: the rule of thumb, and beyond it


def report(
    case: Case, problem: CoDesignProblem, facts: Sequence[PlantFacts], findings: Sequence[Finding]
) -> dict[str, Any]:
    """The diagnosis as plain values; frequencies in Hz, M_K in force over displacement."""
    plant = plant_of(problem)
    start = facts[0]
    ranges = _ranges(facts)
    return {
        "plant": case.plant.model or case.plant.function,
        "inputs": plant.inputs,
        "outputs": plant.outputs,
        "notes": list(plant.notes(problem.start)),
        "theta": dict(zip(problem.names, problem.start, strict=True)),
        "points": len(facts),
        "rigid_modes": sum(mode.rigid for mode in start.modes),
        "modes": [asdict(mode) for mode in start.modes],
        "frequency_ranges_hz": ranges,
        "zeros": [asdict(zero) for zero in start.zeros],
        "effort_hz": start.effort_hz,
        "bandwidth_window_hz": [share * start.effort_hz for share in WINDOW],
        "M_K": problem.weights.M_K,
        "M_K_for_bandwidth": _suitable(problem, start),
        "findings": [
            {"severity": f.severity.value, "topic": f.topic.value, "words": f.words}
            for f in first_seen(findings)
        ],
    }


def _ranges(facts: Sequence[PlantFacts]) -> list[list[float]]:
    """Least and largest frequency of the i-th mode in order of frequency, over the points."""
    count = min(len(item.modes) for item in facts)
    table = np.array([[mode.frequency_hz for mode in item.modes[:count]] for item in facts])
    return [[float(low), float(high)] for low, high in zip(table.min(0), table.max(0), strict=True)]


def _suitable(problem: CoDesignProblem, start: PlantFacts) -> list[dict[str, float]]:
    """M_K that moves `effort_hz` to shares of the first resonance, below which G falls as ω⁻²."""
    first = next((mode.frequency_hz for mode in start.modes if not mode.rigid), math.nan)
    M_K, effort = problem.weights.M_K, start.effort_hz
    return [
        {"bandwidth_hz": share * first, "M_K": M_K * (share * first / effort) ** 2}
        for share in SHARES
        if math.isfinite(first / effort) and start.modes[0].rigid
    ]


def text(found: dict[str, Any]) -> str:
    """The diagnosis for a terminal."""
    theta = ", ".join(f"{name} = {value:.6g}" for name, value in found["theta"].items())
    lines = [
        f"plant         {found['plant']}: {found['inputs']} inputs, {found['outputs']} outputs",
        *(f"note          {words}" for words in found["notes"]),
        f"looked at     {found['points']} points: start, middle and corners of the bounds",
        f"start         {theta}",
        "",
        "  mode          Hz  damping   driven  measured   over the bounds",
    ]
    rows = zip(found["modes"], found["frequency_ranges_hz"], strict=False)
    for i, (mode, (low, high)) in enumerate(rows, 1):
        where = "rigid body, on the suspension" if mode["rigid"] else f"{low:.4g} to {high:.4g} Hz"
        lines.append(
            f"{i:6d}  {mode['frequency_hz']:10.4g}  {100 * mode['damping_ratio']:5.3g} %"
            f"  {mode['driven']:7.2g}  {mode['measured']:8.2g}   {where}"
        )
    low, high = found["bandwidth_window_hz"]
    window = "ω_b cannot be told: the plant falls through 1/M_K nowhere"
    if low is not None:
        window = f"ω_b about {low:.3g} to {high:.3g} Hz"
    lines += ["", f"M_K           {found['M_K']:.3g}: {window}"]
    lines += [
        f"              {item['M_K']:.2g} would suit {item['bandwidth_hz']:.3g} Hz, "
        f"{share:.2g} of the first resonance"
        for item, share in zip(found["M_K_for_bandwidth"], SHARES, strict=False)
    ]
    lines += [f"{item['severity']:13s} {item['words']}" for item in found["findings"]]
    if not found["findings"]:
        lines.append("findings      none")
    return "\n".join(lines)


def command(options: argparse.Namespace) -> ExitCode:
    """The command itself."""
    case = load_case(options.case)
    problem = problem_of(case)
    facts, findings = diagnose(problem, case.suspension.rigid_modes)
    errors = [f for f in findings if f.severity is Severity.ERROR]
    for item in errors:
        print(f"{options.case}: plant: {item.words}", file=sys.stderr)
    if errors:
        return ExitCode.BAD_INPUT
    found = clean(report(case, problem, facts, findings))
    print(json.dumps(found, indent=2, allow_nan=False) if options.json else text(found))
    return ExitCode.DONE


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point."""
    arguments = parser("ccd_casadi.check", "Look at a case's plant before designing anything.")
    arguments.add_argument("--json", action="store_true", help="the diagnosis as JSON")
    return run(command, arguments, argv)


if __name__ == "__main__":
    raise SystemExit(main())
