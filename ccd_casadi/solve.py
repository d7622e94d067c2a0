"""`python -m ccd_casadi.solve CASE.toml`: sample, fit, IPOPT, verify; writes the run folder."""

import argparse
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from ccd_casadi.cases import DRAWING, SAMPLING
from ccd_casadi.codesign import FORMULATIONS
from ccd_casadi.support.command_line import SCHEDULER, ExitCode, command, option, run_folder
from ccd_casadi.support.options import positive
from ccd_casadi.support.process_pool import PoolOptions, pool
from ccd_casadi.support.terminal import inform, say
from ccd_casadi.support.text import plural

if TYPE_CHECKING:  # what computes is imported once the options are known to be right
    from ccd_casadi.cases.tables import Case
    from ccd_casadi.codesign.verified import Solution
    from ccd_casadi.inner_problem.problem import CoDesignProblem


def summary(solution: "Solution") -> str:
    """The result in a few lines for the terminal."""
    from ccd_casadi.reporting.decision import decide
    from ccd_casadi.reporting.facts import (
        channel_words,
        cost_words,
        gain_words,
        loop_lines,
        requirement_lines,
        theta_words,
    )
    from ccd_casadi.reporting.run_verdict import detail_lines, terminal_lines
    from ccd_casadi.support.text import template

    r = solution.result
    words = template("templates/solve.txt", gain_words=gain_words, channel_words=channel_words)
    if r["status"] == "infeasible":
        return words.render(r=r).rstrip()
    sections: list[str] = []
    if found := r.get("controller", {}).get("sections"):
        from ccd_casadi.inner_problem.sections_words import SectionWords, sampled_words

        made = [SectionWords(**item) for item in found]
        moved = sampled_words(made, r["verdict"]["deployable"].get("rate_hz"))
        sections = [*(item.text for item in made), *filter(None, [moved])]
    return words.render(
        r=r, decision=decide(r), verdict=terminal_lines(r), details=detail_lines(r),
        theta=theta_words(r), hardware=cost_words(r, 6), inner_value=inner_value_lines(r),
        sections=sections,
        loop_lines=loop_lines(r), required=requirement_lines(r),
        design_plant=design_plant_lines(r.get("robust") or {}),
    ).rstrip()  # fmt: skip


def design_plant_lines(robust: Mapping[str, Any]) -> list[str]:
    """Describe which plant of a robust set the controller is made on, and the result on the
    others."""
    if "design_at" not in robust:
        return []
    others = [
        f"{name}: {item['status'].replace('_', ' ')}"
        + (f", J {item['objective']:.6g}" if item.get("objective") is not None else "")
        for name, item in robust.get("tried", {}).items()
        if name != robust["design_at"]
    ]
    beside = f" ({'; '.join(others)})" if others else ""
    return [f"design plant  {robust['design_at']}{beside}"]


def inner_value_lines(result: Mapping[str, Any]) -> list[str]:
    """Describe what J counts of the controller, and its prediction."""
    from ccd_casadi.inner_problem.controller_problem import BANDWIDTH, FIGURES
    from ccd_casadi.reporting.facts import prediction_words

    v = FIGURES[result.get("minimise", BANDWIDTH.key)]
    # of sections the least of all plants, and the frequency of the shape that |S| keeps
    where = " or more on every plant" if "plants" in result["certificate"] else ""
    bandwidth = f"bandwidth     {result['bandwidth_hz']:.4f} Hz{where}"
    if v is BANDWIDTH:
        lines, reported = [bandwidth], f"{result['surrogate_bandwidth_hz']:.4f} Hz"
    else:
        of, reported = (
            v.format_value(result[key], 6) for key in (f"{v.entry}_of_set", f"surrogate_{v.entry}")
        )
        lines = [f"{v.words:<13} {of} over the set", bandwidth]
    return [f"{lines[0]}   {prediction_words(result, reported)}".rstrip(), *lines[1:]]


def show_findings(case: "Case", problem: "CoDesignProblem") -> None:
    """Print on stderr what is serious about a plant of the user's own, and what it is made of."""
    from ccd_casadi.cases.findings import Severity, Topic, peak_words
    from ccd_casadi.inner_problem.problem import notes_of
    from ccd_casadi.plants.registry import model_named

    model = model_named(case.plant.model)
    if model is not None and model.sound:
        for words in peak_words(problem.inner.S_max):
            say(f"warning: {words}", sys.stderr)
        return
    from ccd_casadi.cases.diagnosis import diagnose, first_seen, size_words

    facts, findings = diagnose(problem, case.suspension.rigid_modes)
    if sizes := size_words(facts[0], case):
        say(f"note: in SI, at the start: {sizes}", sys.stderr)
    for item in first_seen(findings):
        if item.severity is not Severity.NOTE:
            of_case = item.topic in (Topic.UNITS, Topic.LOOP, Topic.UNUSED)
            subject = "" if of_case else "plant: "
            say(f"{item.severity.value}: {subject}{item.words}", sys.stderr)
    for words in notes_of(problem, problem.start):
        say(f"note: {words}", sys.stderr)


def with_causes(solution: "Solution", case: "Case", problem: "CoDesignProblem") -> "Solution":
    """The solution, a failed one's reason with what looks like a wrong unit, sign or loop; and with
    what a larger budget does, unless no examined theta can meet a bound."""
    result = solution.result
    if result["status"] == "verified":
        return solution
    from ccd_casadi.cases.diagnosis import diagnose, suspicions
    from ccd_casadi.codesign.reasons import Reason

    designed, modes = result["status"] != "infeasible", case.suspension.rigid_modes
    words = [result["reason"], *suspicions(problem, modes, designed=designed)]
    if not designed and result.get("time_budget", {}).get("ended"):
        impossible = any(item.everywhere for item in diagnose(problem, modes)[1])
        words += [] if impossible else [Reason.LARGER_BUDGET().words()]
    return replace(solution, result=result | {"reason": "; ".join(filter(None, words))})


def of_workers(options: argparse.Namespace) -> Sequence[str]:
    """Name the modules that worker processes will need, and draw pages with."""
    if options.scheduler:
        return ()
    return SAMPLING if options.no_report else (*SAMPLING, *DRAWING)


@command(
    "ccd_casadi.solve", "Design a stage and its controller together.",
    option("--formulation", choices=FORMULATIONS,
           help="default: nested, or direct with many parameters or lists"),
    option("--budget", metavar="MINUTES", type=positive,
           help="end with the best design found in this time (default: [outer] minutes, 5)"),
    option("--resume", action="store_true",
           help="print what the run folder holds; every run continues from it"),
    option("--no-report", action="store_true",
           help="write no pages, for jobs that only need result.json"),
    SCHEDULER, needs=["ccd_casadi.codesign.run"],
    early=of_workers,
)  # fmt: skip
def main(options: argparse.Namespace) -> ExitCode:
    """Run the command."""
    from ccd_casadi.cases.case import load_case
    from ccd_casadi.cases.case_problem import problem_of
    from ccd_casadi.codesign.formulations import formulation_of, slow_words, usual_name
    from ccd_casadi.codesign.result import resolve, write_run
    from ccd_casadi.codesign.run import within
    from ccd_casadi.inner_problem.problem import plant_of
    from ccd_casadi.kernels.compilation import ensure_compiled
    from ccd_casadi.sampling.sampler import Sampler
    from ccd_casadi.sampling.store import SampleStore

    case = load_case(options.case)
    problem = problem_of(case)
    plant_of(problem)  # a wrong plant is reported before anything is written
    of_page = () if options.no_report else ("synthesis",)  # the table of bandwidths
    if kernels := {*problem.controller.kernels, *of_page}:
        ensure_compiled(*sorted(kernels))  # all of them now: after the answer it would seem to hang
    folder = run_folder(options.case, options.out)
    name = options.formulation or usual_name(case, len(problem.names))
    formulation = formulation_of(case, name)
    if not options.quiet:
        show_findings(case, problem)
        slow = slow_words(formulation, len(problem.names))
        if slow:
            say(f"warning: {slow}", sys.stderr)
    store = folder / "samples.sqlite"
    with pool(options.scheduler, options.workers, PoolOptions.patience) as workers:
        with SampleStore(store) as samples:
            if options.resume:
                held = plural(samples.count(), "row") if samples.count() else "nothing yet"
                inform(f"resuming      {store} holds {held}", sys.stderr)
            sampler = Sampler(problem, samples, workers, quiet=options.quiet)
            minutes = options.budget or case.outer.minutes
            found = within(minutes, sampler, formulation, options.seed)
            solution = with_causes(found, case, problem)
            write_run(folder, case, solution)
        code = ExitCode.of(solution.result["status"])
        inform(summary(solution))
        inform(f"run folder    {folder}")
        if not options.no_report:
            from ccd_casadi.reporting.solve_page import write_report

            plant_case, solved = resolve(case, solution), solution.problem or problem
            write_report(folder, plant_case, solved, solution, workers)
            inform(f"page          {folder / 'index.html'}")
    if options.quiet and code is not ExitCode.DONE:
        say(f"{options.case}: {solution.result['reason']}", sys.stderr)
    return code


if __name__ == "__main__":
    raise SystemExit(main())
