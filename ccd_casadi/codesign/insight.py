"""insight.json: the front around a design and the derivatives of its optimum, as plain values."""

from dataclasses import asdict
from typing import Any

from ccd_casadi.cases.run_folder import FinishedRun
from ccd_casadi.codesign.pareto import Front
from ccd_casadi.codesign.post_optimal import PostOptimal
from ccd_casadi.support.units import HZ
from ccd_casadi.support.versions import versions


def natural_hz(run: FinishedRun) -> tuple[float, ...]:
    """Natural frequencies of the flexible modes at the design, Hz."""
    modal = run.modal()
    return tuple(float(w) / HZ for w in modal.natural[~modal.rigid])


def bandwidth_of(run: FinishedRun) -> float:
    """ω_b in rad/s: with sections that of every plant of the set."""
    return HZ * float(run.result["bandwidth_hz"])


def insight_dict(run: FinishedRun, front: Front, responses: PostOptimal) -> dict[str, Any]:
    """insight.json: SI, and Hz where a key says so."""
    names = run.problem.names
    points = [
        {
            "theta": dict(zip(names, point.theta, strict=True)),
            "hardware_cost": point.hardware_cost,
            run.problem.figure.entry: point.value,
            "bandwidth_hz": point.bandwidth / HZ,
            "omega_S_hz": point.omega_S / HZ,  # NaN with sections
            "omega_T_hz": point.omega_T / HZ,
            "active": list(point.active),
            "status": "verified" if point.verified else "not_verified",
        }
        for point in front.points
    ]
    natural = natural_hz(run)
    return {
        "front": {"points": points, "whole": front.whole, "syntheses": front.syntheses},
        "optimum": {
            "responses": {item.parameter: asdict(item) for item in responses.responses},
            "determined": responses.determined,
            "weakly_active": list(responses.weak),
            "stationarity": responses.kkt.stationarity,
        },
        "natural_hz": list(natural),
        "first_resonance_over_bandwidth": (
            min(natural) * HZ / bandwidth_of(run) if natural else None
        ),
        "versions": versions(),
    }
