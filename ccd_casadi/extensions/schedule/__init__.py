"""A controller for each part of a stroke, proven there, and what hands over between them.

`python -m ccd_casadi.schedule CASE.toml`: controllers for parts of a stroke.
"""

import argparse
import sys
from functools import partial

from ccd_casadi.support.command_line import ExitCode, command, run_folder
from ccd_casadi.support.errors import UserError
from ccd_casadi.support.extensions import Extension
from ccd_casadi.support.options import integer, one_line, option, real, take_value
from ccd_casadi.support.process_pool import Workers
from ccd_casadi.support.terminal import inform, remark, say

EXTENSION = Extension(
    commands={
        "schedule": (
            "ccd_casadi.extensions.schedule",
            "controllers for parts of a stroke, each proven on its part",
        )
    }
)


@command(
    "ccd_casadi.schedule",
    "Design a controller for each part of the range of a measured parameter.",
    option("--theta", metavar="m1=60,m2=60", help="the hardware (default: the case's start)"),
    option("--by", metavar="NAME", help="the parameter, where several vary"),
    take_value("--share", "X", real(0.1, 1.0),
           "of the bandwidth that a position has alone, which its part has at least", 0.9),
    take_value("--parts", "N", integer(1, 64), "at most", 8),
    take_value("--positions", "N", integer(2), "at which the schedule is judged", 1001),
    needs=["ccd_casadi.extensions.schedule.schedule_files", "ccd_casadi.codesign.result"],
)  # fmt: skip
def main(options: argparse.Namespace) -> ExitCode:
    """Design, judge, simulate the way, write schedule.json, C code and the page."""
    from ccd_casadi.cases.case import load_case
    from ccd_casadi.cases.case_problem import problem_of
    from ccd_casadi.cases.plant_tables import parse_theta
    from ccd_casadi.drawing.paint import write_page
    from ccd_casadi.extensions.schedule.handover import cross, rate_bound_of, rates_tried, way_of
    from ccd_casadi.extensions.schedule.schedule_files import (
        Schedule,
        entry,
        keep_at_positions,
        schedule_page,
        summary,
        write_code,
    )
    from ccd_casadi.extensions.schedule.segments import (
        ScheduleOptions,
        judge_parts,
        scheduled_name,
        segments_of,
    )
    from ccd_casadi.inner_problem.structured_problem import structured_of
    from ccd_casadi.support.json_files import write_json
    from ccd_casadi.support.text import versions

    case = load_case(options.case)
    problem = problem_of(case, at_a_sample=True)
    name = scheduled_name(problem, options.by)
    sampling = structured_of(problem).sampling
    if sampling is None:
        raise UserError(f"{case.path}: loop.rate_hz: is missing; a schedule runs sampled")
    theta = problem.start if options.theta is None else parse_theta(case, options.theta)
    folder = run_folder(
        options.case, options.out or options.case.with_name(options.case.stem + "_schedule")
    )
    log = partial(remark, quiet=options.quiet)
    limits = ScheduleOptions(share=options.share, most=options.parts)
    with Workers(options.workers) as workers:
        parts, alone, whole = segments_of(
            problem, theta, name, log=log, workers=workers, options=limits
        )
        parts, frozen = keep_at_positions(
            problem, theta, name, parts, options.positions, workers=workers, log=log
        )
        segments = judge_parts(parts, theta, workers=workers, log=log, options=limits)
    log("the way over the range is simulated")
    way = way_of(problem, theta, name, segments)
    rates = rates_tried(way, seed=options.seed)
    log("the allowed rate is bounded")
    bound = rate_bound_of(problem, theta, name, segments)
    found = Schedule(
        name, problem.parameter_units[name], tuple(segments), tuple(alone), whole,
        tuple(frozen), tuple(rates), bound, cross(way, bound.rate, seed=options.seed),
    )  # fmt: skip
    answer = entry(found) | {
        "theta": dict(zip(problem.names, theta, strict=True)), "seed": options.seed,
        "versions": versions(), "seconds": options.seconds(),
    }  # fmt: skip
    write_json(folder / "schedule.json", answer)
    write_code(folder, found, sampling)
    inform("\n".join(summary(found)))
    write_page(folder / "report.html", schedule_page(options.case.stem, found))
    inform(f"page          {folder / 'report.html'}")
    if found.verified:
        return ExitCode.DONE
    lost = [f"{one.low:.4g} to {one.high:.4g}" for one in found.segments if not one.passed]
    words = f"part {', '.join(lost)} fails" if lost else "see the lines above"
    say(one_line(f"not verified: {words}"), sys.stderr)
    return ExitCode.NOT_VERIFIED
