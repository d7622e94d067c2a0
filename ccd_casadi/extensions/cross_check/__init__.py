"""One synthesis by every back end, the certificate as the judge.

`python -m ccd_casadi.cross_check CASE.toml --theta m1=60,m2=60`: one synthesis, every back end.

The certificate is the judge: a γ_opt below the bound γ_jω that no controller passes is wrong, a
design that is not certified does not count, and among those that are the lowest γ_opt is right.
"""

import argparse
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

from ccd_casadi.support.command_line import ExitCode, command, option, run_folder
from ccd_casadi.support.errors import UserError
from ccd_casadi.support.extensions import Extension
from ccd_casadi.support.options import (
    break_frequencies,
    break_frequency_options,
    positive,
    take_value,
)
from ccd_casadi.support.terminal import say
from ccd_casadi.support.text import HZ

if TYPE_CHECKING:
    from ccd_casadi.extensions.cross_check.backends import BackendResult
    from ccd_casadi.inner_problem.problem import CoDesignProblem


EXTENSION = Extension(
    commands={
        "cross_check": (
            "ccd_casadi.extensions.cross_check",
            "compare one synthesis by every back end",
        )
    }
)


def _problem(
    options: argparse.Namespace,
) -> "tuple[CoDesignProblem, tuple[float, ...], tuple[float, float]]":
    """Problem, θ and (ω_S, ω_T) in rad/s of a case file with --theta, or of a finished run."""
    from ccd_casadi.cases.run_folder import problem_at
    from ccd_casadi.inner_problem.problem import true_inner

    point = break_frequencies(options)
    problem, theta, done = problem_at(options.case, options.theta)
    if theta is None:
        raise UserError(f"{options.case}: give --theta, or a run folder in place of the case")
    if done is not None:
        point = point or (done.weights.omega_S, done.weights.omega_T)
        if done.kappa is not None:
            words = 'cross_check is for controller.structure = "h_infinity" so far'
            remedy = "result.json holds the judge's own figures"
            raise UserError(f"{done.folder}/case.toml: controller.structure: {words}; {remedy}")
    if point is None:
        found = true_inner(problem, theta)
        if found.optimum is None:
            raise UserError(f"{options.case}: {found.shortfall}; give --omega-s-hz, --omega-t-hz")
        point = (found.optimum.figures.omega_S, found.optimum.figures.omega_T)
    return problem, theta, point


@command(
    "ccd_casadi.cross_check",
    "Compare one synthesis by every back end. CASE.toml may be the folder of a finished solve.",
    option("--theta", metavar="m1=60,m2=60", help="the hardware, with a case file"),
    *break_frequency_options("of a weight (default: the best at theta, or the run's)"),
    take_value("--limit", "SECONDS", positive, "time limit of each optional back end", 60.0),
    needs=["ccd_casadi.codesign.result", "ccd_casadi.extensions.cross_check.backends"],
    without_effect=["--seed"],
)  # fmt: skip
def main(options: argparse.Namespace) -> ExitCode:
    """Synthesise with every back end, print the table, and say who is right."""
    from ccd_casadi.codesign.result_entries import figures_dict
    from ccd_casadi.extensions.cross_check.backends import (
        RICCATI,
        TITLES,
        synthesise_with,
        verdicts,
    )
    from ccd_casadi.inner_problem.problem import scaled_plant
    from ccd_casadi.support.json_files import write_json
    from ccd_casadi.support.text import versions
    from ccd_casadi.support.worker_process import Runner

    problem, theta, point = _problem(options)
    plant, weights, inner = scaled_plant(problem, theta), problem.weights.at(*point), problem.inner
    with Runner() as runner:
        found = verdicts([
            synthesise_with(name, plant, weights, omega_low=inner.omega_low, runner=runner,
                            gamma_backoff=inner.gamma_backoff, limit=options.limit)
            for name in TITLES
        ])  # fmt: skip
    if not options.quiet:
        names = ", ".join(f"{k} = {v:.6g}" for k, v in zip(problem.names, theta, strict=True))
        say(f"{names}; omega_S {point[0] / HZ:.6g} Hz, omega_T {point[1] / HZ:.6g} Hz")
        say(_table(found))
        say(_conclusion(found))
    if options.out is not None:
        folder = run_folder(options.case, options.out)
        backends = {
            item.backend: {
                "gamma_claimed": item.gamma_opt, "holds": item.holds, "verdict": item.words,
                "seconds": item.seconds,
                "figures": item.design and figures_dict(item.design.figures),
            }
            for item in found
        }  # fmt: skip
        answer = {
            "theta": dict(zip(problem.names, theta, strict=True)),
            "omega_S_hz": point[0] / HZ,
            "omega_T_hz": point[1] / HZ,
            "backends": backends,
            "versions": versions(),
        }
        write_json(folder / "cross_check.json", answer)
    own = next(item for item in found if item.backend == RICCATI)
    return ExitCode.DONE if own.holds else ExitCode.NOT_VERIFIED


def _table(found: "Sequence[BackendResult]") -> str:
    from ccd_casadi.extensions.cross_check.backends import TITLES

    lines = [
        f"{'back end':18s} {'gamma':>9s} {'certified':>9s} {'bandwidth':>11s} {'peak of S':>9s} "
        f"{'s':>6s}  verdict"
    ]
    for item in found:
        norm = bandwidth = peak = math.nan
        if item.design is not None:
            figures = item.design.figures
            norm = figures.certificate.norm if figures.certificate.passed else math.nan
            bandwidth, peak = figures.bandwidth / HZ, figures.sensitivity_peak
        cells = (f"{item.gamma_opt:9.6g}", f"{norm:9.6g}", f"{bandwidth:8.3f} Hz", f"{peak:9.4f}")
        shown = " ".join(f"{'-':>{len(c)}s}" if "nan" in c else c for c in cells)
        lines.append(f"{TITLES[item.backend]:18s} {shown} {item.seconds:6.3f}  {item.words}")
    return "\n".join(lines)


def _conclusion(found: "Sequence[BackendResult]") -> str:
    from ccd_casadi.extensions.cross_check.backends import TITLES, BackendOptions

    right = [TITLES[item.backend] for item in found if item.holds]
    wrong = [TITLES[item.backend] for item in found if item.holds is False]
    if not right:
        return "no back end has a certified design"
    if not wrong:
        return f"agree to {100 * BackendOptions.agree:g} %: {', '.join(right)}"
    return f"disagree; the certificate is with {', '.join(right)}, not with {', '.join(wrong)}"
