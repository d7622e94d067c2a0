"""Designs as entries of result.json and controller.json."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from ccd_casadi.analysis.loop_figures import loop_entry
from ccd_casadi.inner_problem.kinds import (
    LoopBudget,
    design_loops,
    kind_of,
    loop_budget,
    member_loops,
)
from ccd_casadi.inner_problem.problem import CoDesignProblem, free_modal, plant_of
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.plants.plant import hardware_cost, mechanics
from ccd_casadi.sampling.sampler import Sampler
from ccd_casadi.support.text import HZ
from ccd_casadi.synthesis.statics import compliance_words, statics_of
from ccd_casadi.synthesis.synthesis import Design, DesignFigures

if TYPE_CHECKING:
    from ccd_casadi.budget.evaluation import BudgetFigures, SourceFigures


def figures_dict(figures: DesignFigures) -> dict[str, Any]:
    """One mixed-sensitivity design's figures under the contract's keys.

    Parameters
    ----------
    figures : DesignFigures
        SI.

    Returns
    -------
    dict
        SI, and Hz where a key says so.
    """
    return {
        "omega_S_hz": figures.omega_S / HZ,
        "omega_T_hz": figures.omega_T / HZ,
        "outcome": figures.outcome.name.lower(),
        "reason": figures.outcome.value,
        "bandwidth_hz": figures.bandwidth / HZ,
        "gamma_opt": figures.gamma_opt,
        "optimum": figures.optimum.value,
        "gamma": figures.gamma,
        "gamma_lower_bound": figures.gamma_lower_bound,
        "sensitivity_peak": figures.sensitivity_peak,
        "sensitivity_peak_hz": figures.sensitivity_peak_frequency / HZ,
        "sensitivity_low": figures.sensitivity_low,
        "compliance_max": figures.compliance,
        "certificate": asdict(figures.certificate),
    }


def compliance_dict(most: float, at_rest: float, low: float, low_hz: float) -> dict[str, Any]:
    """Write what a force moves, m/N: ‖GS‖∞, at rest (0: an integrator) and at ω_low; and in
    words."""
    return {
        "compliance_max": most,
        "static_compliance": at_rest,
        "low_compliance": low,
        "compliance_words": compliance_words(most, at_rest, low, low_hz),
    }


def mixed_dict(problem: CoDesignProblem, theta: Sequence[float], design: Design) -> dict[str, Any]:
    """A mixed-sensitivity design's figures, with compliance, margins and steps of a stable loop:
    these on the plant and those of its robust set."""
    figures = design.figures
    found = figures_dict(figures)
    if not figures.certified:
        return found
    loops, low = member_loops(problem, theta, design.controller), problem.inner.omega_low
    rest = statics_of(loops[0], bandwidth=figures.bandwidth, omega_low=low)
    most = max(one.compliance for one in loops) if loops[0].ported else figures.compliance
    return (
        found
        | loop_entry(loops, figures.bandwidth, figures.sensitivity_peak)
        | compliance_dict(most, rest.compliance, rest.low, rest.low_hz)
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
    from ccd_casadi.inner_problem.structured_bandwidth import exact_moves, motion_of

    motion = motion_of(problem, theta)
    cycle, own = motion.cycle, problem.source.motion
    seconds = cycle.profile.duration + own.dwell
    made = exact_moves(motion, design_loops(problem, theta, controller), 2.0 * seconds)
    times = np.maximum([move.settled for move in made], cycle.profile.duration)
    ahead = motion.forward_force(problem.sampling)
    most, given = (max(float(getattr(one, of).max()) for one in made)
                   for of in ("peak_force", "peak_command"))  # fmt: skip
    commanded = {} if made[0].command is None else {"needed_command": max(ahead, given)}
    needed = max(float(cycle.peak_force), most, 0.0 if commanded else ahead)
    strongest = int(np.argmax([one.peak_force.max() for one in made]))
    words = kind_of(problem).plant_words(theta)
    of_motor = () if own.motor is None else ("power", "peak_share", "heat_share")
    k, R, limit = (1.0, 0.0, np.inf) if own.motor is None else own.motor.at(motion.mass)
    squares = np.array([move.mean_squares(seconds) for move in made])  # of forces that currents
    hottest = int(squares.sum(axis=1).argmax())  # make: also with an error of the gain behind them
    power = float(R / k**2 * squares[hottest].sum())
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
            "peak_current": cycle.peak_force / k,
            "needed_current": needed / k,
            "needed_share": needed / (k * limit),
            "needed_power": power,
            "needed_heat_share": power / own.motor.rms_power if own.motor.rms_power else 0.0}),
        "feedforward_force": ahead,
        "needed_force": needed,
        "needed_rms_force": float(squares.max() ** 0.5),
        "needed_force_plant": words[strongest] if needed == most else "",
        "needed_heat_plant": words[hottest],
        **commanded,  # before the actuators
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


def _source(item: "SourceFigures", whole: "BudgetFigures") -> dict[str, Any]:
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


@dataclass(frozen=True)
class IsoZones:
    """ISO 14839-3: the peak of the sensitivity below which a rotor on magnets is in zone A
    (9.5 dB), B (12 dB) or C (14 dB); above that it is in zone D."""

    A: float = 3.0
    B: float = 4.0
    C: float = 5.0

    def of(self, peak: float) -> str:
        """The zone of a peak."""
        return next((name for name, most in vars(self).items() if peak < most), "D")


def iso_entry(
    problem: CoDesignProblem, theta: Sequence[float], result: Mapping[str, Any]
) -> dict[str, Any]:
    """The zone of ISO 14839-3 of a plant that its stiffness drives away, for result.json.

    Parameters
    ----------
    problem : CoDesignProblem
    theta : sequence of float
        SI.
    result : mapping
        `sensitivity_peak`, and `robust` of a set.

    Returns
    -------
    dict
        `iso_14839_3` with its zone and the peak of all plants; None of other plants.
    """
    system = mechanics(plant_of(problem), theta, derivatives=False)
    if not free_modal(problem, system).driven_away.any():
        return {"iso_14839_3": None}
    known = (result.get("robust") or {}).get("worst_sensitivity_peak")
    peak = max(result["sensitivity_peak"], known or 0.0)
    return {"iso_14839_3": {"zone": IsoZones().of(peak), "sensitivity_peak": peak}}


def start_entry(sampler: Sampler) -> dict[str, Any]:
    """The design at the start of θ as the run has met it, for result.json.

    Parameters
    ----------
    sampler : Sampler
        Of the run.

    Returns
    -------
    dict
        `theta`, `hardware_cost`, and `bandwidth_hz` of the best controller there, None where the
        run has searched none or found none.
    """
    problem = sampler.problem
    found = [entry.bandwidth for entry in sampler.trace
             if entry.theta == problem.start and math.isfinite(entry.bandwidth)]  # fmt: skip
    if sampler.bandwidth_at_start is not None:
        found.append(sampler.bandwidth_at_start)
    return {
        "theta": dict(zip(problem.names, problem.start, strict=True)),
        "hardware_cost": hardware_cost(plant_of(problem), problem.start),
        "bandwidth_hz": max(found) / HZ if found else None,
    }
