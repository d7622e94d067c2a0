"""`python -m ccd_casadi.inner CASE.toml --theta m1=60,m2=60`: the true inner loop at one θ."""

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any

from ccd_casadi.support.command_line import ExitCode, parser, run, run_folder
from ccd_casadi.support.units import HZ
from surrogates.options import positive

if TYPE_CHECKING:  # what computes is imported once the options are known to be right
    from ccd_casadi.cases.measured_case import MeasuredCase
    from ccd_casadi.inner_problem.problem import CoDesignProblem
    from ccd_casadi.support.process_pool import Pool
    from ccd_casadi.synthesis.synthesis import DesignFigures


def command(options: argparse.Namespace) -> ExitCode:
    """Print one JSON object; with both break frequencies given, of that single synthesis."""
    from ccd_casadi.cases.case import CaseError, load_case, parse_theta
    from ccd_casadi.cases.case_problem import problem_of
    from ccd_casadi.cases.measured_case import measured_case
    from ccd_casadi.inner_problem.problem import best_choice, plant_of
    from ccd_casadi.plants.plant import hardware_cost
    from ccd_casadi.support.json_files import write_json

    measured = measured_case(options.case)
    if measured is not None:
        return _measured(measured, options)
    if options.theta is None:
        raise CaseError(
            f"{options.case}: --theta is missing; give the hardware, --theta m1=60,m2=60"
        )
    case = load_case(options.case)
    problem = problem_of(case)
    theta = parse_theta(case, options.theta)
    single = (options.omega_S_hz, options.omega_T_hz)
    if (single[0] is None) != (single[1] is None):
        raise CaseError(f"{case.path}: give both --omega-s-hz and --omega-t-hz, or neither")
    began = perf_counter()
    cost = hardware_cost(plant_of(problem), theta)
    if problem.sections is not None and single[0] is not None:
        raise CaseError(
            f"{case.path}: sections have no weights' frequencies; leave out --omega-s-hz and "
            "--omega-t-hz"
        )
    head: dict[str, Any] = {
        "theta": dict(zip(problem.names, theta, strict=True)),
        "hardware_cost": cost,
    }
    if problem.sections is None and options.begin_at is not None:
        raise CaseError(f'{case.path}: --begin-at is for structure = "sections"; leave it out')
    if problem.sections is not None:
        from ccd_casadi.support.process_pool import Workers

        with Workers(options.workers) as workers:
            return _sections(problem, theta, head, options, began, workers)
    rows: tuple[DesignFigures, ...] = ()
    if single[0] is not None:
        point = (HZ * single[0], HZ * single[1])
        problem = _best_at(problem, theta, point)
        syntheses, shortfall = 1, ""
    else:
        problem, found = best_choice(problem, theta)
        syntheses, shortfall, rows = found.syntheses, found.shortfall, found.rows
        if found.optimum is None:
            answer = head | {"status": "infeasible", "reason": shortfall, "syntheses": syntheses}
            _print(answer, rows, options, began)
            return ExitCode.INFEASIBLE
        point = (found.optimum.figures.omega_S, found.optimum.figures.omega_T)
    if problem.robust is not None:
        head["design_at"] = problem.robust.design_at
    code, answer, controller = _design(problem, theta, point)
    answer = head | answer | {"syntheses": syntheses}
    answer["objective"] = problem.w1 * cost + problem.w2 * HZ * (answer["bandwidth_hz"] or 0.0)
    if options.out is not None:  # before anything is printed: it may be refused
        folder = run_folder(options.case, options.out)
        write_json(folder / "controller.json", controller)
    _print(answer, rows, options, began)
    return code


def _measured(case: "MeasuredCase", options: argparse.Namespace) -> ExitCode:
    """Sections on a measured response: designed and judged on its lines."""
    from ccd_casadi.cases.case import CaseError
    from ccd_casadi.codesign.result import controller_dict
    from ccd_casadi.fixed_structure.measured_design import design_on_data
    from ccd_casadi.inner_problem.sections_words import sections_dict
    from ccd_casadi.support.json_files import write_json

    given = (options.theta, options.omega_S_hz, options.omega_T_hz, options.begin_at)
    if any(value is not None for value in given):
        words = 'plant.model = "measured" has no theta and no weights to place; leave out --theta'
        raise CaseError(f"{case.path}: {words}, --omega-s-hz, --omega-t-hz and --begin-at")
    began, hz = perf_counter(), case.response.hz
    tell = None if options.quiet else lambda words: print(words, file=sys.stderr, flush=True)
    made = design_on_data(
        case.response, case.structure, case.bounds, period=case.period,
        unstable_poles=case.unstable_poles, poles_at_zero=case.poles_at_zero, starts=case.starts,
        seed=options.seed, progress=tell,
    )  # fmt: skip
    plant = {"file": case.file, "lines": len(hz), "first_hz": hz[0], "last_hz": hz[-1]}
    answer: dict[str, Any] = {"plant": plant, "theta": {}, "words": made.words, "syntheses": 1}
    if made.controller is None or made.figures is None:
        _print(answer | {"status": "infeasible", "reason": made.words}, (), options, began)
        return ExitCode.INFEASIBLE
    f = made.figures
    parts = sections_dict(made.structure, made.kappa) | {"kappa": made.kappa.tolist()}
    answer |= {
        "status": "verified" if made.usable else "not_verified",
        "reason": "" if made.usable else made.words,
        "bandwidth_hz": made.bandwidth / HZ,
        "sensitivity_peak": f.S_peak,
        "sensitivity_peak_hz": f.S_peak_frequency / HZ,
        "sensitivity_peak_between_lines": f.S_between,
        "sensitivity_low": f.S_low,
        "compliance_max": f.GS,
        "KS_max": f.KS,
        "certificate": {
            "stable": f.stable,
            "sure": f.sure,
            "right_half_plane_poles": f.right_half_plane,
            "passed": made.usable,
            "figures_over_bounds": case.bounds.shares(f),
        },
        "controller": parts,
    }
    if options.out is not None:
        from ccd_casadi.reporting.measured_page import write_measured

        loop: dict[str, Any] = {} if case.period is None else {
            "loop": {"rate_hz": 1.0 / case.period, "delay_us": 0.0, "method": "tustin"}
        }  # fmt: skip
        folder = run_folder(options.case, options.out)
        controller = controller_dict(made.controller) | {"sections": parts | loop}
        write_json(folder / "controller.json", controller)
        if f.stable:
            write_measured(folder, case, made.controller, answer)
    _print(answer, (), options, began)
    return ExitCode.DONE if made.usable else ExitCode.NOT_VERIFIED


def _best_at(
    problem: "CoDesignProblem", theta: tuple[float, ...], point: tuple[float, float]
) -> "CoDesignProblem":
    """The problem with the design plant whose controller has the least peak of S there."""
    import numpy as np

    from ccd_casadi.inner_problem.problem import design_choices, true_design

    def peak(choice: "CoDesignProblem") -> float:
        return float(np.nan_to_num(true_design(choice, theta, *point).values[1], nan=np.inf))

    return min(design_choices(problem), key=peak)


def _sections(
    problem: "CoDesignProblem",
    theta: tuple[float, ...],
    head: dict[str, Any],
    options: argparse.Namespace,
    began: float,
    workers: "Pool",
) -> ExitCode:
    """A full race of a fixed structure at θ, worst plants added, judge and proof over the box."""
    import numpy as np

    from ccd_casadi.cases.run_folder import sections_kappa
    from ccd_casadi.codesign.budget_result import budget_entry
    from ccd_casadi.codesign.sections_result import (
        active_of,
        design_dict,
        proof_dict,
        sections_controller,
    )
    from ccd_casadi.inner_problem.sections_bandwidth import prepared, too_slow, with_range
    from ccd_casadi.inner_problem.sections_error import least_error_at
    from ccd_casadi.inner_problem.sections_plant_set import sections_of_problem, structure_of
    from ccd_casadi.inner_problem.sections_robustness import judged_widely, proof_of, worst_members
    from ccd_casadi.support.json_files import write_json

    sections = replace(sections_of_problem(problem), seed=options.seed)
    asked = replace(with_range(replace(problem, sections=sections)), start=theta)
    tell = None if options.quiet else lambda words: print(words, file=sys.stderr, flush=True)
    if options.begin_at is not None:
        anchors = (sections_kappa(options.begin_at, structure_of(asked)),)
        asked = replace(asked, sections=replace(sections_of_problem(asked), anchors=anchors))
    asked, made = prepared(asked, tell, workers, options.begin_at is not None)
    if not made.certified:
        answer = head | {"status": "infeasible", "reason": made.words, "syntheses": 1}
        _print(answer, (), options, began)
        return ExitCode.INFEASIBLE
    value = made.bandwidth
    if sections.of_error:
        if not too_slow(asked, made).certified:
            words = too_slow(asked, made).words
            answer = head | {"status": "infeasible", "reason": words, "syntheses": 1}
            _print(answer, (), options, began)
            return ExitCode.INFEASIBLE
        fastest = made.bandwidth
        asked, least = least_error_at(asked, theta, made, tell)
        made = least.design
        value = least.error if problem.w2 > 0.0 else made.bandwidth
        head["least_error"] = {
            "error_rms_of_set": least.error,
            "error_rms_at_largest_bandwidth": least.first_error,
            "largest_bandwidth_hz": fastest / HZ,
            "steps": least.steps,
        }
    worst = worst_members(asked, theta, made)[0]
    assert made.controller is not None
    wide, checked = judged_widely(asked, theta, made.controller, worst, workers)
    proof = proof_of(asked, theta, made)
    passed = wide.passed and not proof.refuted
    answer = head | {
        "status": "verified" if passed else "not_verified",
        **design_dict(asked, made),
        "active": active_of(made),
        "feasible": True,
        "objective": problem.w1 * head["hardware_cost"] + problem.w2 * value,
        "robust": {
            "plants": checked,
            "passed": wide.passed,
            "words": wide.words,
            "bandwidth_hz": wide.bandwidth / HZ,
            "worst_excess": float(np.expm1(worst.value)),
        },
        "proof": proof_dict(proof),
        "syntheses": 1,
        **budget_entry(asked, theta, made.controller),
    }
    if options.out is not None:
        folder = run_folder(options.case, options.out)
        write_json(folder / "controller.json", sections_controller(asked, made))
    _print(answer, (), options, began)
    return ExitCode.DONE if passed else ExitCode.NOT_VERIFIED


def _design(
    problem: "CoDesignProblem", theta: tuple[float, ...], point: tuple[float, float]
) -> tuple[ExitCode, dict[str, Any], dict[str, Any]]:
    from ccd_casadi.codesign.budget_result import budget_entry
    from ccd_casadi.codesign.result import compliance_dict, controller_dict, figures_dict
    from ccd_casadi.inner_problem.problem import scaled_plant
    from ccd_casadi.inner_problem.sweep import active_constraints
    from ccd_casadi.support.json_files import clean
    from ccd_casadi.synthesis.closed_loop import handed_out, local_peaks
    from ccd_casadi.synthesis.statics import statics
    from ccd_casadi.synthesis.synthesis import synthesise

    plant = scaled_plant(problem, theta)
    made = synthesise(
        plant,
        problem.weights.at(*point),
        omega_low=problem.inner.omega_low,
        gamma_backoff=problem.inner.gamma_backoff,
        compliance=True,
    )
    made = handed_out(plant, made, problem.inner.omega_low)
    figures = made.figures
    feasible = problem.inner.feasible(figures)
    compliance: dict[str, Any] = {}
    if figures.certified:
        rest = statics(
            plant.plant_si(), made.controller, bandwidth=figures.bandwidth,
            omega_low=problem.inner.omega_low,
        )  # fmt: skip
        compliance = compliance_dict(figures.compliance, rest.compliance, rest.low, rest.low_hz)
    status = "verified" if figures.certified else "not_verified"
    answer = {
        "status": status,
        **clean(figures_dict(figures)),
        **compliance,
        "active": list(active_constraints(problem.inner, figures)) if feasible else [],
        "feasible": feasible,
        "local_peaks": [
            {"hz": omega / HZ, "sensitivity": gain}
            for omega, gain in local_peaks(plant, made.controller)
        ],
        "natural_hz": [float(omega) / HZ for omega in plant.natural],
        **budget_entry(problem, theta, made.controller),
    }
    code = ExitCode.DONE if figures.certified else ExitCode.NOT_VERIFIED
    return code, answer, controller_dict(made.controller)


def _print(
    answer: dict[str, Any],
    rows: "tuple[DesignFigures, ...]",
    options: argparse.Namespace,
    began: float,
) -> None:
    from ccd_casadi.codesign.result import figures_dict
    from ccd_casadi.support.json_files import clean
    from ccd_casadi.support.versions import versions

    answer = answer | {
        "seconds": perf_counter() - began,
        "seed": options.seed,
        "formulation": "inner",
        "versions": versions(),
        "sweep": [clean(figures_dict(row)) for row in rows],
    }
    json.dump(clean(answer), sys.stdout, indent=2, allow_nan=False)
    print()


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point."""
    arguments = parser(
        "ccd_casadi.inner", "The true inner problem at one theta, as JSON on stdout."
    )
    arguments.add_argument(
        "--theta", metavar="m1=60,m2=60", help="the hardware; a measured plant has none"
    )
    arguments.add_argument(
        "--begin-at",
        metavar="FOLDER",
        type=Path,
        help="sections: search from the controller.json of a run alone, not from a race",
    )
    for name in ("S", "T"):
        arguments.add_argument(
            f"--omega-{name.lower()}-hz",
            dest=f"omega_{name}_hz",
            type=positive,
            metavar="X",
            help=f"with the other one: a single synthesis at this omega_{name}",
        )
    return run(command, arguments, argv, needs=["ccd_casadi.codesign.result"])


if __name__ == "__main__":
    raise SystemExit(main())
