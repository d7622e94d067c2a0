"""A fixed structure's inner problem at one θ: search, worst plants, judge and proof; as JSON."""

from dataclasses import replace

import numpy as np

from ccd_casadi.cases.run_folder import sections_kappa
from ccd_casadi.codesign.design_entries import budget_entry, move_entry
from ccd_casadi.codesign.inner_answer import InnerAnswer, InnerOptions, head_of
from ccd_casadi.codesign.sections_entries import (
    active_of,
    design_dict,
    proof_dict,
    sections_controller,
)
from ccd_casadi.inner_problem.figure import BANDWIDTH
from ccd_casadi.inner_problem.objective import objective
from ccd_casadi.inner_problem.problem import CoDesignProblem
from ccd_casadi.inner_problem.sections_bandwidth import too_slow
from ccd_casadi.inner_problem.sections_plant_set import sections_of_problem, structure_of
from ccd_casadi.inner_problem.sections_robustness import judged_widely, proof_of, worst_members
from ccd_casadi.inner_problem.sections_search import least_value_at, prepared, with_range
from ccd_casadi.support.errors import UserError
from ccd_casadi.support.units import HZ


def sections_answer(
    problem: CoDesignProblem, theta: tuple[float, ...], options: InnerOptions
) -> InnerAnswer:
    """The largest bandwidth (or the least of another figure) at θ, judged over its box.

    From the controller of the folder `options.begin_at` alone, where there is one.
    """
    if options.point is not None:
        words = "sections have no weights' frequencies; leave out --omega-s-hz and --omega-t-hz"
        raise UserError(words)
    begin_at, progress, workers = options.begin_at, options.progress, options.workers
    head = head_of(problem, theta)
    sections = replace(sections_of_problem(problem), seed=options.seed)
    asked = replace(with_range(replace(problem, controller=sections)), start=theta)
    if begin_at is not None:
        anchors = (sections_kappa(begin_at, structure_of(asked)),)
        asked = replace(asked, controller=replace(sections_of_problem(asked), anchors=anchors))
    asked, made = prepared(asked, progress, workers, begin_at is not None)
    if not made.certified:
        return InnerAnswer("infeasible", head | {"reason": made.words, "syntheses": 1})
    value = made.bandwidth
    if problem.figure is not BANDWIDTH:
        slow = too_slow(asked, made)
        if not slow.certified:
            return InnerAnswer("infeasible", head | {"reason": slow.words, "syntheses": 1})
        fastest = made.bandwidth
        asked, least = least_value_at(asked, theta, made, progress)
        made = least.design
        value = least.value if problem.w2 > 0.0 else made.bandwidth
        entry = problem.figure.entry
        head["least_error" if entry == "error_rms" else f"least_{entry}"] = {
            f"{entry}_of_set": least.value,
            f"{entry}_at_largest_bandwidth": least.first_value,
            "largest_bandwidth_hz": fastest / HZ,
            "steps": least.steps,
        }
    worst = worst_members(asked, theta, made)[0]
    assert made.controller is not None
    wide, checked = judged_widely(asked, theta, made.controller, worst, workers)
    proof = proof_of(asked, theta, made)
    passed = wide.passed and not proof.refuted
    figures = head | {
        **design_dict(asked, theta, made),
        "active": active_of(made),
        "feasible": True,
        "objective": objective(problem, theta, value),
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
        **move_entry(asked, theta, made.controller),
    }
    status = "verified" if passed else "not_verified"
    return InnerAnswer(status, figures, sections_controller(asked, made))
