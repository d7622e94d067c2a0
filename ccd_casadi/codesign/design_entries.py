"""A synthesis, its controller and its error budget as values of result.json and controller.json."""

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from ccd_casadi.analysis.loop_figures import loop_entry
from ccd_casadi.budget import BudgetFigures, SourceFigures
from ccd_casadi.inner_problem.design_loops import LoopBudget, loop_budget
from ccd_casadi.inner_problem.kinds import kind_of
from ccd_casadi.inner_problem.move_figures import exact_times, motion_of
from ccd_casadi.inner_problem.problem import CoDesignProblem, scaled_plant
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.support.units import HZ
from ccd_casadi.synthesis.statics import compliance_words, statics
from ccd_casadi.synthesis.synthesis import Design, DesignFigures


def figures_dict(figures: DesignFigures) -> dict[str, Any]:
    """One design's figures under the contract's keys."""
    return {
        "omega_S_hz": figures.omega_S / HZ,
        "omega_T_hz": figures.omega_T / HZ,
        "outcome": figures.outcome.name.lower(),
        "reason": figures.outcome.value,
        "bandwidth_hz": figures.bandwidth / HZ,
        "gamma_opt": figures.gamma_opt,
        "gamma": figures.gamma,
        "gamma_lower_bound": figures.gamma_lower_bound,
        "sensitivity_peak": figures.sensitivity_peak,
        "sensitivity_peak_hz": figures.sensitivity_peak_frequency / HZ,
        "sensitivity_low": figures.sensitivity_low,
        "compliance_max": figures.compliance,
        "certificate": asdict(figures.certificate),
    }


def compliance_dict(most: float, at_rest: float, low: float, low_hz: float) -> dict[str, Any]:
    """What a force moves, m/N: ‖GS‖∞, at rest (0: an integrator) and at ω_low; and in words."""
    return {
        "compliance_max": most,
        "static_compliance": at_rest,
        "low_compliance": low,
        "compliance_words": compliance_words(most, at_rest, low, low_hz),
    }


def mixed_dict(problem: CoDesignProblem, theta: Sequence[float], design: Design) -> dict[str, Any]:
    """A mixed-sensitivity design's figures, with compliance, margins and steps of a stable loop:
    these on the plant and those of its robust set."""
    figures, plant = design.figures, scaled_plant(problem, theta)
    found = figures_dict(figures)
    if not figures.certified:
        return found
    plants = [one.plant_si() for one in plant.members]
    rest = statics(plants[0], design.controller, bandwidth=figures.bandwidth,
                   omega_low=problem.inner.omega_low)  # fmt: skip
    return (
        found
        | loop_entry(plants, design.controller, None, figures.bandwidth, figures.sensitivity_peak)
        | compliance_dict(figures.compliance, rest.compliance, rest.low, rest.low_hz)
    )


def controller_dict(controller: StateSpace) -> dict[str, Any]:
    """controller.json: row-major lists, SI, input e = r - y, output u."""
    return {
        **{name: getattr(controller, name).tolist() for name in "ABCD"},
        "input": "e = r - y",
        "output": "u",
        "units": "SI, time in s",
    }


def budget_entry(
    problem: CoDesignProblem, theta: Sequence[float], controller: StateSpace
) -> dict[str, Any]:
    """`budget` as the one key of a mapping; nothing where the problem has none."""
    found = loop_budget(problem, theta, controller)
    return {} if found is None else {"budget": budget_dict(found)}


def move_entry(
    problem: CoDesignProblem, theta: Sequence[float], controller: StateSpace
) -> dict[str, Any]:
    """`move` as the one key of a mapping, SI; nothing where the problem has none."""
    if problem.source.motion is None:
        return {}
    motion = motion_of(problem, theta)
    times = exact_times(problem, motion, kind_of(problem).plants(theta), controller)
    cycle, own = motion.cycle, problem.source.motion
    of_motor = () if own.motor is None else ("power", "peak_share", "heat_share")
    return {"move": {
        "duration": cycle.profile.duration,
        "settled": float(times[0]),
        "settled_latest": float(times.max()),
        "plants": len(times),
        "window": own.window,
        "dwell": own.dwell,
        "reached": {key: float(getattr(cycle.profile, key))
                    for key in ("velocity", "acceleration", "jerk")},
        "limits": list(cycle.limits),
        **{key: float(getattr(cycle, key)) for key in ("peak_force", "rms_force", *of_motor)},
        **({} if own.motor is None else {
            "peak_current": cycle.peak_force / own.motor.at(motion.mass)[0]}),
        "feedforward": motion.forward.tolist(),
    }}  # fmt: skip


def budget_dict(budget: LoopBudget) -> dict[str, Any]:
    """The figures on the model, and the largest of all plants; m, N, s; null where infinite."""
    model = budget.model
    head: dict[str, Any] = {
        "sampled": budget.sampled,
        "plants": budget.plants,
        "error_rms_largest": budget.largest_error,
        "force_rms_largest": budget.largest_force,
    }
    if model is None:
        return head | {"reason": "the loop with the model is not stable", "sources": []}
    return head | {
        "error_rms": model.error,
        "error_ma": None if model.window is None else model.average,
        "error_msd": None if model.window is None else model.deviation,
        "force_rms": model.force,
        "window_s": model.window,
        "disagreement": model.disagreement,
        "sources": [_source(item, model) for item in model.sources],
    }


def _source(item: SourceFigures, whole: BudgetFigures) -> dict[str, Any]:
    windowed = whole.window is not None
    return {
        "name": item.source.name,
        "kind": item.source.kind.value,
        "spectrum": "filter" if item.source.shaped else "table",
        "error_rms": item.error,
        "share": (item.error / whole.error) ** 2 if whole.error > 0.0 else 0.0,
        "error_ma": item.average if windowed else None,
        "error_msd": item.deviation if windowed else None,
        "force_rms": item.force,
        "disagreement": item.disagreement,
    }
