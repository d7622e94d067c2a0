"""A synthesis and its controller as values of result.json and controller.json."""

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from ccd_casadi.analysis.loop_figures import loop_entry
from ccd_casadi.inner_problem.problem import CoDesignProblem, scaled_plant
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.support.units import HZ
from ccd_casadi.synthesis.statics import compliance_words
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


def loop_of_design(
    problem: CoDesignProblem, theta: Sequence[float], design: Design
) -> dict[str, Any]:
    """Margins and steps on the plant and those of its robust set; nothing of an unstable loop."""
    figures = design.figures
    if not figures.certified:
        return {}
    plant = scaled_plant(problem, theta)
    members = (plant, *(() if plant.family is None else plant.family.perturbed))
    return loop_entry(
        [member.plant_si() for member in members], design.controller, None, figures.bandwidth,
        figures.sensitivity_peak,
    )  # fmt: skip


def controller_dict(controller: StateSpace) -> dict[str, Any]:
    """controller.json: row-major lists, SI, input e = r - y, output u."""
    return {
        "A": controller.A.tolist(),
        "B": controller.B.tolist(),
        "C": controller.C.tolist(),
        "D": controller.D.tolist(),
        "input": "e = r - y",
        "output": "u",
        "units": "SI, time in s",
    }
