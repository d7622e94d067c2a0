"""A controller for a plant that exists, on its measured responses.

`python -m ccd_casadi.tune DATA...`: a controller for a plant that exists.
"""

import argparse
import sys
from pathlib import Path

from ccd_casadi.support.command_line import RUN, ExitCode, command, run_folder
from ccd_casadi.support.extensions import Extension
from ccd_casadi.support.options import integer, one_line, option, positive, real, take_value
from ccd_casadi.support.terminal import inform, say

EXTENSION = Extension(
    commands={
        "tune": (
            "ccd_casadi.extensions.measured",
            "find the fastest PID with notches for a plant that exists",
        )
    },
    functions={
        "measured_answer": "ccd_casadi.extensions.measured.measured_answer:measured_answer",
        "measured_page": "ccd_casadi.extensions.measured.measured_answer:measured_page",
    },
)


@command(
    "ccd_casadi.tune", "Find the fastest PID with notches for a plant that exists.",
    option("--rate-hz", metavar="X", type=positive,
           help="sampling rate; responses include the hold"),
    take_value("--delay", "SECONDS", real(), "delay in s besides that in DATA", 0.0),
    take_value("--s-max", "X", real(1.0, strict=True), "bound of |S|", 1.8),
    take_value("--shape", "X", real(1.0), "bound of |S| over ω/(√2 ω_b)", 1.1),
    take_value("--effort", "X", positive, "bound of |KS| over 1/|G| about ω_b", 20.0),
    take_value("--lead", "N", integer(0), "number of leads, with --biquads", 1),
    option("--biquads", metavar="N", type=integer(0),
           help="number of notches (default: by the resonances)"),
    option("--unstable-poles", metavar="N", type=integer(0),
           help="of a measured plant, in the right half plane (default: 0)"),
    option("--poles-at-zero", metavar="N", type=integer(0),
           help="of a measured plant (default: by the slope of the first lines)"),
    option("--least-damping", metavar="X", type=positive,
           help="damping ratio of a resonance that lines may hide, at least (default: 0.0005)"),
    take_value("--spread", "X", real(), "factor on the spread of DATA within which bounds hold",
               1.0),
    option("--controller", metavar="FILE", type=Path,
           help="the present controller (.json, .toml, .mat), judged beside the new one"),
    option("--rotary", action="store_true", help="the plant's output is in rad, its input in N m"),
    needs=["ccd_casadi.extensions.measured.tuning"],
    place=RUN | {"metavar": "DATA", "nargs": "+", "help": "responses (.csv, .mat, .npz) or models "
                 "(.mat with A, B, C, D); several are one set"},
)  # fmt: skip
def main(options: argparse.Namespace) -> ExitCode:
    """Tune, print a table, write result.json, controller.json, report.html and the C code."""
    from ccd_casadi.deployment.realisation import realise_blocks
    from ccd_casadi.deployment.source_code import write_c
    from ccd_casadi.drawing.paint import write_page
    from ccd_casadi.extensions.measured.measured_answer import answer_of, measured_page
    from ccd_casadi.extensions.measured.tuned_plants import present_loop
    from ccd_casadi.extensions.measured.tuning import tune
    from ccd_casadi.fixed_structure.structure import Structure
    from ccd_casadi.inner_problem.sections_words import SectionWords
    from ccd_casadi.inner_problem.structured_kind import FixedStructure
    from ccd_casadi.lti.loop import tustin
    from ccd_casadi.reporting.decision import advice
    from ccd_casadi.reporting.facts import loop_lines
    from ccd_casadi.support.json_files import json_values, write_json
    from ccd_casadi.support.process_pool import Workers
    from ccd_casadi.support.text import versions

    folder = run_folder(options.run[0], options.out)
    structure = None if options.biquads is None else Structure(
        lead=options.lead, biquads=options.biquads, least_damping=0.1
    )  # fmt: skip
    with Workers(options.workers) as workers:
        found = tune(
            options.run, rate_hz=options.rate_hz, delay=options.delay, S_max=options.s_max,
            shape=options.shape, effort=options.effort, structure=structure, seed=options.seed,
            unstable_poles=options.unstable_poles, poles_at_zero=options.poles_at_zero,
            least_damping=options.least_damping, rotary=options.rotary, spread=options.spread,
            progress=lambda words: inform(words, sys.stderr),
            workers=workers,
        )  # fmt: skip
    answer, case = answer_of(found.case, found.design), found.case
    present = None if options.controller is None else present_loop(
        options.controller, case.responses, case.bounds, case.period
    )  # fmt: skip
    result = json_values({
        "status": answer.status, **answer.figures, "seconds": options.seconds(),
        "models": [norm for norm in found.norms if norm is not None],  # ‖S‖∞ of each model's loop
        "judge": found.judge.entry,
        **({} if present is None else {"present": vars(present)}),
        "seed": options.seed, "formulation": "tune", "versions": versions(),
    })  # fmt: skip
    write_json(folder / "result.json", result)
    K, now = found.controller, []
    if present is not None:
        possible = f"possible {result.get('bandwidth_hz', 0.0):.4g} Hz ({answer.status})"
        now.append(f"{'present':14s}{present.words}; {possible}; what no controller exceeds is not "
                   "available: its bound is of models")  # fmt: skip
    if K is not None and "phase_margin_deg" in result:
        write_json(folder / "controller.json", answer.controller)
        write_page(folder / "report.html", measured_page(case, K, result))
        if case.period is not None:
            coded = realise_blocks(tustin(K, case.period))
            write_c(folder, coded, title=case.file, delay=options.delay,
                    verified=found.design.usable, kind=FixedStructure.title)  # fmt: skip
        lines = [
            *now,
            *(f"{'decision':14s}{words}" for words in (advice(result),) if words),
            f"{'bandwidth':14s}{result['bandwidth_hz']:.6g} Hz, |S| at most "
            f"{result['sensitivity_peak']:.4g} at {result['sensitivity_peak_hz']:.4g} Hz",
            *loop_lines(result),
            *(f"{'':14s}{SectionWords(**item).text}" for item in result["controller"]["sections"]),
            f"{'page':14s}{folder / 'report.html'}",
        ]
        inform("\n".join([f"{'status':14s}{answer.status}", *lines]))
    elif now:
        inform(now[0])
    if answer.status != "verified":
        say(one_line(f"{case.file}: {answer.status}: {result['reason']}"), sys.stderr)
    return ExitCode.of(answer.status)
