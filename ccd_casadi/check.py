"""`python -m ccd_casadi.check CASE.toml`: the plant over its box before anything is designed."""

import argparse
import sys
from collections.abc import Sequence
from typing import Any

from ccd_casadi.support.command_line import ExitCode, parser, program, run, run_folder
from ccd_casadi.support.terminal import inform, say
from ccd_casadi.support.units import counted


def text(found: dict[str, Any]) -> str:
    """The diagnosis for a terminal."""
    from ccd_casadi.cases.plant_report import SHARES
    from ccd_casadi.reporting.facts import theta_words

    lines = [
        f"plant         {found['plant']}: {counted(found['inputs'], 'input')}, "
        f"{counted(found['outputs'], 'output')}",
        *(f"note          {words}" for words in found["notes"]),
        f"checked       {found['points']} points: start, middle and corners of the bounds",
        f"start         {theta_words(found)}",
        f"in SI         {found['size']}",
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
    window = "no ω_b follows: |G| crosses 1/M_K nowhere"
    if low is not None:
        window = f"ω_b about {low:.3g} to {high:.3g} Hz"
    lines += ["", f"M_K           {found['M_K']:.3g}: {window}"]
    lines += [
        f"              {item['M_K']:.2g} would suit {item['bandwidth_hz']:.3g} Hz, "
        f"{share:.2g} of the first resonance"
        for item, share in zip(found["M_K_for_bandwidth"], SHARES, strict=False)
    ]
    lines += [
        f"constraint    {item['name']}: {item['value']:.4g} at the start, "
        + ("met (0 or less)" if item["met"] else "NOT met (required: 0 or less)")
        for item in found["constraints"]
    ]
    lines += [
        f"budget        {item['name']} ({item['kind'].replace('_', ' ')}): "
        + ("white" if item["rms"] is None else f"{item['rms']:.4g} {item['unit']} RMS")
        for item in found["budget"]
    ]
    lines += [f"{item['severity']:13s} {item['words']}" for item in found["findings"]]
    if not found["findings"]:
        lines.append("findings      none")
    return "\n".join(lines)


def command(options: argparse.Namespace) -> ExitCode:
    """The command itself."""
    from ccd_casadi.cases.case import load_case
    from ccd_casadi.cases.case_problem import problem_of
    from ccd_casadi.cases.diagnosis import diagnose
    from ccd_casadi.cases.findings import Severity
    from ccd_casadi.cases.plant_report import plant_report
    from ccd_casadi.support.json_files import json_text, json_values, write_json

    case = load_case(options.case)
    problem = problem_of(case)
    facts, findings = diagnose(problem, case.suspension.rigid_modes, options.seed)
    errors = [f for f in findings if f.severity is Severity.ERROR]
    for item in errors:
        say(f"{options.case}: plant: {item.words}", sys.stderr)
    if errors:
        return ExitCode.BAD_INPUT
    found = json_values(plant_report(case, problem, facts, findings))
    if options.out is not None:
        write_json(run_folder(options.case, options.out) / "check.json", found)
    say(json_text(found) if options.json else text(found))
    if not options.json:
        inform(f"next          {program('ccd_casadi.solve')} {options.case}")
    return ExitCode.DONE


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point."""
    arguments = parser("ccd_casadi.check", "Look at a case's plant before designing anything.")
    arguments.add_argument("--json", action="store_true", help="the diagnosis as JSON")
    return run(command, arguments, argv, needs=["ccd_casadi.codesign.result"])


if __name__ == "__main__":
    raise SystemExit(main())
