"""The run folder's JSON files: result.json and controller.json."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

from ccd_casadi.analysis.loop_figures import loop_entry
from ccd_casadi.codesign.box_look import BoxLook
from ccd_casadi.codesign.budget_result import budget_entry
from ccd_casadi.codesign.formulation import FormulationResult
from ccd_casadi.codesign.kkt import KktCertificate
from ccd_casadi.codesign.mixed_verdict import verdict_of
from ccd_casadi.codesign.outer_problem import OuterSolution
from ccd_casadi.codesign.surrogate_quality import quality_dict
from ccd_casadi.codesign.verdict import KKT_LEVEL, reason, verdict_dict
from ccd_casadi.codesign.verify import VerifiedDesign
from ccd_casadi.inner_problem.problem import CoDesignProblem, plant_of, scaled_plant
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.sampling.spent import spent_entry
from ccd_casadi.support.json_files import clean
from ccd_casadi.support.units import HZ
from ccd_casadi.support.versions import versions
from ccd_casadi.synthesis.statics import compliance_words
from ccd_casadi.synthesis.synthesis import Design, DesignFigures
from surrogates import Quality


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


def result_dict(
    problem: CoDesignProblem,
    formulation: str,
    outcome: FormulationResult,
    verified: VerifiedDesign,
    *,
    tolerance: float,
    spent: Mapping[str, int],
    seconds: float,
    seed: int,
    quality: tuple[Quality, ...] = (),
    look: BoxLook | None = None,
) -> dict[str, Any]:
    """result.json of a solved run; `status` says whether it is verified, `reason` why not."""
    figures = verified.design.figures
    promised = predicted_bandwidth(outcome, verified)
    error = abs(promised / figures.bandwidth - 1.0)
    checks = {
        "certificate": figures.certified,
        "constraints": verified.feasible,
        "prediction": bool(error <= tolerance),
        "inner_optimum": bool(verified.inner_gap <= tolerance),
        "optimality": bool(verified.kkt.stationarity <= KKT_LEVEL),
    }
    if verified.robust is not None:
        checks["robust"] = verified.robust.passed
    if verified.references:
        checks["closer_models"] = all(
            check.figures.certificate.stable for check in verified.references
        )
    verdict = verdict_of(outcome, verified, problem, tolerance, error, quality, look)
    failed = [name for name, passed in checks.items() if not passed]
    why = "" if not failed else f"failed: {', '.join(failed)} ({reason(verdict)})"
    result = {
        **figures_dict(figures),
        **loop_of_design(problem, verified.theta, verified.design),
        **_compliance(verified),
        "status": "not_verified" if failed else "verified",
        "reason": "; ".join(part for part in (why, outcome.message) if part) if failed else "",
        "verdict": verdict_dict(verdict),
        "formulation": formulation,
        "theta": dict(zip(problem.names, verified.theta, strict=True)),
        "units": problem.parameter_units,
        "cost_unit": problem.cost_unit,
        **({"fixed": problem.source.held} if problem.source.fixed else {}),
        "objective": verified.objective,
        "hardware_cost": verified.hardware_cost,
        "surrogate_bandwidth_hz": promised / HZ,
        "verification_error": error,
        "checks": checks,
        "active": list(verified.active),
        "inner_gap": verified.inner_gap,
        "kkt": kkt_dict(verified.kkt),
        "globality": globality_dict(outcome.outer),
        "box_look": _box_look(look),
        "without_suspension": {
            "stable": verified.unsuspended.certificate.stable,
            "bandwidth_hz": verified.unsuspended.bandwidth / HZ,
            "sensitivity_peak": verified.unsuspended.sensitivity_peak,
        },
        "references": {
            check.name: {
                "certified": check.certified,
                "reason": check.outcome.value,
                "stable": check.figures.certificate.stable,
                "bandwidth_hz": check.figures.bandwidth / HZ,
                "sensitivity_peak": check.figures.sensitivity_peak,
                "gamma": check.figures.gamma,
            }
            for check in verified.references
        },
        **_robust(verified),
        "notes": list(plant_of(problem).notes(verified.theta)),
        "iterates": [asdict(iterate) for iterate in outcome.iterates],
        **spent_entry(spent, look is not None and look.moved),
        "seconds": seconds,
        "seed": seed,
        "versions": versions(),
    }
    result["surrogate_quality"] = quality_dict(quality)
    result |= budget_entry(problem, verified.theta, verified.design.controller)
    return clean(result)


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


def _compliance(verified: VerifiedDesign) -> dict[str, Any]:
    """Nothing where the loop is not certified."""
    if verified.survival is None:
        return {}
    rest = verified.survival.statics
    return compliance_dict(
        verified.design.figures.compliance, rest.compliance, rest.low, rest.low_hz
    )


def infeasible_dict(
    formulation: str, reason: str, *, spent: Mapping[str, int], seconds: float, seed: int
) -> dict[str, Any]:
    """result.json where no certified design meets the constraints."""
    return {
        "status": "infeasible",
        "reason": reason,
        "formulation": formulation,
        **spent_entry(spent),
        "seconds": seconds,
        "seed": seed,
        "versions": versions(),
    }


def predicted_bandwidth(outcome: FormulationResult, verified: VerifiedDesign) -> float:
    """What the last surrogate says at the verified design, rad/s.

    Without a surrogate: the truth at IPOPT's own optimum, or at the design itself where IPOPT
    found none.
    """
    if not outcome.surrogates:
        made = verified.design if outcome.design is None else outcome.design
        return made.figures.bandwidth
    process = outcome.surrogates[0]
    x = verified.x[: process.lower.size]
    return float(process.predict(x[None, :])[0])


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


def kkt_dict(certificate: KktCertificate) -> dict[str, Any]:
    """The optimality certificate; a vertex has no second-order figure, and says so."""
    second = certificate.second_order
    return asdict(certificate) | {
        "second_order": None if second is None or math.isinf(second) else second,
        "vertex": second is not None and math.isinf(second),
    }


def _robust(verified: VerifiedDesign) -> dict[str, Any]:
    """What a robust design does on its nominal plant and all along its set; nothing for others."""
    check = verified.robust
    if check is None:
        return {}
    return {
        "robust": {
            "nominal_sensitivity_peak": check.nominal,
            "stable": math.isfinite(check.peak),
            "worst_sensitivity_peak": check.peak,
            "worst_shift": check.at.shift,
            "worst_damping": check.at.damping,
            "plants": check.plants,
            **({} if verified.damping is None else verified.damping.entry),
        }
    }


def _box_look(look: BoxLook | None) -> dict[str, Any]:
    """What was looked at besides the formulation's own way; nothing where there was no look."""
    if look is None:
        return {}
    found = {key: value for key, value in vars(look).items() if key != "x"}
    return found | {"moved": look.moved}


def globality_dict(solution: OuterSolution | None) -> dict[str, Any]:
    """Starts tried, distinct local optima of the last problem solved, the best J of each."""
    if solution is None:
        return {"starts": 0, "optima": []}
    return {
        "starts": solution.starts,
        "optima": [
            {"objective": item.objective, "starts": item.starts, "x": item.x.tolist()}
            for item in solution.optima
        ],
    }
