"""`python -m ccd_casadi.tune DATA...`: a controller for a plant that exists."""

import argparse
import sys
from dataclasses import replace
from time import perf_counter

from ccd_casadi.support.command_line import ExitCode, command, option, run_folder, run_parser
from ccd_casadi.support.options import integer, one_line, positive, real
from ccd_casadi.support.terminal import inform, say


@command(
    "ccd_casadi.tune", "Find the fastest PID with notches for a plant that exists.",
    *(option(name, metavar=metavar, type=kind, default=default,
             help=words if default is None else f"{words} (default: {default:g})")
      for name, metavar, kind, default, words in (
          ("--rate-hz", "X", positive, None, "sampling rate; responses include the hold"),
          ("--delay", "SECONDS", real(), 0.0, "delay in s besides that in DATA"),
          ("--s-max", "X", real(1.0, strict=True), 1.8, "bound of |S|"),
          ("--shape", "X", real(1.0), 1.1, "bound of |S| over ω/(√2 ω_b)"),
          ("--effort", "X", positive, 20.0, "bound of |KS| over 1/|G| about ω_b"),
          ("--lead", "N", integer(0), 1, "number of leads, with --biquads"),
          ("--biquads", "N", integer(0), None, "number of notches (default: by the resonances)"))),
    needs=["ccd_casadi.codesign.tuning"], make=run_parser, metavar="DATA", nargs="+",
    about="responses (.csv, .mat, .npz) or models (.mat with A, B, C, D); several are one set",
)  # fmt: skip
def main(options: argparse.Namespace) -> ExitCode:
    """Tune, print a table, write result.json, controller.json, report.html and the C code."""
    from ccd_casadi.codesign.inner_answer import answer_of
    from ccd_casadi.codesign.tuning import tune
    from ccd_casadi.deployment.c_code import write_c
    from ccd_casadi.deployment.realisation import Realisation, block_diagonal
    from ccd_casadi.drawing.stored import write_page
    from ccd_casadi.fixed_structure import Structure
    from ccd_casadi.inner_problem.sections_words import SectionWords
    from ccd_casadi.lti.hold import tustin
    from ccd_casadi.reporting.facts import loop_lines
    from ccd_casadi.reporting.measured_page import measured_page
    from ccd_casadi.reporting.verdict import advice
    from ccd_casadi.support.json_files import json_values, write_json
    from ccd_casadi.support.process_pool import Workers
    from ccd_casadi.support.versions import versions

    began = perf_counter()
    folder = run_folder(options.run[0], options.out)
    structure = None if options.biquads is None else Structure(
        lead=options.lead, biquads=options.biquads, least_damping=0.1
    )  # fmt: skip
    with Workers(options.workers) as workers:
        found = tune(
            options.run, rate_hz=options.rate_hz, delay=options.delay, S_max=options.s_max,
            shape=options.shape, effort=options.effort, structure=structure, seed=options.seed,
            progress=lambda words: inform(words, sys.stderr),
            workers=workers,
        )  # fmt: skip
    answer, case = answer_of(found.case, found.design), found.case
    result = json_values({
        "status": answer.status, **answer.figures, "seconds": perf_counter() - began,
        "models": [norm for norm in found.norms if norm is not None],  # ‖S‖∞ of each model's loop
        "seed": options.seed, "formulation": "tune", "versions": versions(),
    })  # fmt: skip
    write_json(folder / "result.json", result)
    K = found.controller
    if K is not None and "phase_margin_deg" in result:
        write_json(folder / "controller.json", answer.controller)
        write_page(folder / "report.html", measured_page(case, K, result))
        if case.period is not None:
            system, blocks = block_diagonal(tustin(K, case.period))
            realised = Realisation(replace(system, period=case.period), tuple(blocks))
            write_c(folder, realised, title=case.file, delay=options.delay,
                    verified=found.design.usable)  # fmt: skip
        lines = [
            *(f"{'decision':14s}{words}" for words in (advice(result),) if words),
            f"{'bandwidth':14s}{result['bandwidth_hz']:.6g} Hz, |S| at most "
            f"{result['sensitivity_peak']:.4g} at {result['sensitivity_peak_hz']:.4g} Hz",
            *loop_lines(result),
            *(f"{'':14s}{SectionWords(**item).text}" for item in result["controller"]["sections"]),
            f"{'page':14s}{folder / 'report.html'}",
        ]
        inform("\n".join([f"{'status':14s}{answer.status}", *lines]))
    if answer.status != "verified":
        say(one_line(f"{case.file}: {answer.status}: {result['reason']}"), sys.stderr)
    return ExitCode.of(answer.status)


if __name__ == "__main__":
    raise SystemExit(main())
