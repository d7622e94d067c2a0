"""The inner problem at one θ under the contract's keys, as JSON, for each kind of controller."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ccd_casadi.analysis.loop_view import peaks_of
from ccd_casadi.cases.run_folder import sections_kappa
from ccd_casadi.codesign.final_judgement import judge_on_model, second_on_set, second_on_weighted
from ccd_casadi.codesign.result_entries import budget_entry, controller_dict, mixed_dict, move_entry
from ccd_casadi.codesign.structured_entries import (
    active_of,
    design_dict,
    proof_dict,
    robust_dict,
    sections_controller,
)
from ccd_casadi.fixed_structure.judgement import judgement_of
from ccd_casadi.inner_problem.objective import final_design, objective
from ccd_casadi.inner_problem.problem import (
    CoDesignProblem,
    best_choice,
    design_choices,
    notes_of,
    plant_of,
    scaled_plant,
    true_design,
)
from ccd_casadi.inner_problem.searched_problem import with_state
from ccd_casadi.inner_problem.structured_plant_set import structure_of
from ccd_casadi.inner_problem.structured_robustness import DesignOnBox
from ccd_casadi.inner_problem.structured_search import least_from, prepare_search, with_range
from ccd_casadi.inner_problem.sweep import active_constraints, missed_bounds
from ccd_casadi.lti.loop import Loop
from ccd_casadi.plants.plant import hardware_cost
from ccd_casadi.support.errors import UserError
from ccd_casadi.support.json_files import json_values
from ccd_casadi.support.process_pool import Pool
from ccd_casadi.support.terminal import Log, silent
from ccd_casadi.support.text import HZ
from ccd_casadi.synthesis.synthesis import DesignFigures


@dataclass(frozen=True)
class InnerAnswer:
    """The result of the command `inner`, as it is printed and written.

    Attributes
    ----------
    status : str
        "verified", "not_verified" or "infeasible".
    figures : dict
        JSON values by the keys of result.json.
    controller : dict or None
        controller.json; None where the problem is infeasible.
    rows : tuple of DesignFigures
        Of a sweep over (ω_S, ω_T).
    """

    status: str
    figures: dict[str, Any]
    controller: dict[str, Any] | None = None
    rows: tuple[DesignFigures, ...] = ()


@dataclass(frozen=True)
class InnerOptions:
    """Options of the search of an inner problem.

    Attributes
    ----------
    seed, workers : int, Pool
        Of random choices, and the processes.
    log : function of str
        Takes lines of progress.
    point : tuple of float or None
        (ω_S, ω_T) in rad/s of a single mixed-sensitivity synthesis.
    begin_at : Path or None
        A run folder with whose controller of fixed structure the search starts.
    """

    seed: int
    workers: Pool
    log: Log = silent
    point: tuple[float, float] | None = None
    begin_at: Path | None = None


def _common_entries(problem: CoDesignProblem, theta: Sequence[float]) -> dict[str, Any]:
    """θ by name, what the hardware costs, and what a reader must know of the plant there."""
    return {
        "notes": list(notes_of(problem, theta)),
        "theta": dict(zip(problem.names, theta, strict=True)),
        "hardware_cost": hardware_cost(plant_of(problem), theta),
    }


def mixed_answer(
    problem: CoDesignProblem, theta: tuple[float, ...], options: InnerOptions
) -> InnerAnswer:
    """The true ω_b*(θ) by mixed sensitivity; at `options.point` that synthesis alone.

    Parameters
    ----------
    problem : CoDesignProblem
        With mixed-sensitivity controllers.
    theta : tuple of float
        SI.
    options : InnerOptions
        How it is searched.

    Returns
    -------
    InnerAnswer
        With the best design, judged.

    Raises
    ------
    UserError
        `options.begin_at` is given.
    """
    if options.begin_at is not None:
        raise UserError('--begin-at is for structure = "sections"; leave it out')
    point = options.point
    head = _common_entries(problem, theta)
    rows: tuple[DesignFigures, ...] = ()
    if point is not None:
        problem, syntheses = _best_design_plant(problem, theta, point), 1
    else:
        problem, found = best_choice(problem, theta)
        syntheses, rows = found.syntheses, found.rows
        if found.optimum is None:
            head |= {"reason": found.shortfall, "syntheses": syntheses}
            return InnerAnswer("infeasible", head, rows=rows)
        point = (found.optimum.figures.omega_S, found.optimum.figures.omega_T)
    if problem.robust is not None:
        head["design_at"] = problem.robust.design_at
    plant, made = scaled_plant(problem, theta), final_design(problem, theta, point)
    feasible = problem.inner.feasible(made.figures)
    judged = judge_on_model(problem, theta, made.controller)
    second = second_on_weighted(problem, theta, made)
    answer = head | {
        **json_values(mixed_dict(problem, theta, made)),
        "active": list(active_constraints(problem.inner, made.figures)) if feasible else [],
        "feasible": feasible,
        "local_peaks": [
            {"hz": hz, "sensitivity": gain}
            for hz, gain in peaks_of(Loop(plant.plant_si(), made.controller))
        ],
        "natural_hz": [float(omega) / HZ for omega in plant.natural],
        **budget_entry(problem, theta, made.controller),
        **move_entry(problem, theta, made.controller),
        "syntheses": syntheses,
        "objective": objective(problem, theta, np.nan_to_num(made.figures.bandwidth)),
        "judge": judged.entry,
        "second_engine": second.entry,
    }
    # At given frequencies a bound may be missed, but a loop without figures is unstable or unknown.
    held = judged.passed or (not feasible and bool(judged.figures))
    good = made.figures.certified and held and second.agrees is not False
    status = "verified" if good else "not_verified"
    if good and not feasible:
        missed = " and ".join(missed_bounds(problem.inner, made.figures))
        answer["reason"] = f"one certified synthesis, which misses bounds of the case: {missed}"
    return InnerAnswer(status, answer, controller_dict(made.controller), rows)


def _best_design_plant(
    problem: CoDesignProblem, theta: Sequence[float], point: tuple[float, float]
) -> CoDesignProblem:
    """The problem with that design plant whose synthesis at `point` has the lowest peak of S."""

    def peak(choice: CoDesignProblem) -> float:
        found = true_design(choice, theta, *point).figures.sensitivity_peak
        return float(np.nan_to_num(found, nan=np.inf))

    return min(design_choices(problem), key=peak)


def structured_answer(
    problem: CoDesignProblem, theta: tuple[float, ...], options: InnerOptions
) -> InnerAnswer:
    """The largest bandwidth (or least of another figure) at θ, judged over its box of plants.

    Parameters
    ----------
    problem : CoDesignProblem
        With controllers of fixed structure.
    theta : tuple of float
        SI.
    options : InnerOptions
        With `begin_at` that controller is the only start.

    Returns
    -------
    InnerAnswer
        With the best design, judged.

    Raises
    ------
    UserError
        `options.point` is given.
    """
    if options.point is not None:
        words = "sections have no weights' frequencies; leave out --omega-s-hz and --omega-t-hz"
        raise UserError(words)
    begin_at, log, workers = options.begin_at, options.log, options.workers
    head = _common_entries(problem, theta)
    searched = replace(with_range(with_state(problem, seed=options.seed)), start=theta)
    if begin_at is not None:
        kappa = sections_kappa(begin_at, structure_of(searched))
        searched = with_state(searched, warm_starts=(kappa,))
    searched, made, worst = prepare_search(searched, log, workers, begin_at is not None)
    fastest = made.bandwidth
    searched, made, least = least_from(searched, theta, made, log, workers)
    if not made.certified:
        return InnerAnswer("infeasible", head | {"reason": made.words, "syntheses": 1})
    value = made.bandwidth
    if least is not None:
        if problem.w2 > 0.0:  # a negative one, which `solve` refuses, is of the bandwidth
            value = least.value
        entry = problem.figure.entry
        head["least_error" if entry == "error_rms" else f"least_{entry}"] = {
            f"{entry}_of_set": least.value,
            f"{entry}_at_largest_bandwidth": least.first_value,
            "largest_bandwidth_hz": fastest / HZ,
            "steps": least.steps,
        }
    on_box = DesignOnBox(searched, theta, made)
    if worst is None or least is not None:  # `worst` is of the fastest design
        worst = on_box.worst(workers=workers)[0]
    wide, checked, proof = on_box.judge(worst, workers)
    assert made.controller is not None
    second = second_on_set(searched, theta, made)
    passed = wide.passed and not proof.refuted and second.agrees is not False
    figures = head | {
        **design_dict(searched, theta, made),
        "active": active_of(made),
        "feasible": True,
        "objective": objective(problem, theta, value),
        "robust": robust_dict(wide, checked, worst),
        "proof": proof_dict(proof),
        "judge": judgement_of(wide, checked).entry,
        "second_engine": second.entry,
        "syntheses": 1,
        **budget_entry(searched, theta, made.controller),
        **move_entry(searched, theta, made.controller),
    }
    status = "verified" if passed else "not_verified"
    return InnerAnswer(status, figures, sections_controller(made, searched.sampling))
