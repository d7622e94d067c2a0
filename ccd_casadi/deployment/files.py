"""What a deployment leaves in its folder: deploy.json, controller.json, design.mat."""

from dataclasses import asdict
from pathlib import Path
from typing import Any

from ccd_casadi.cases.run_folder import FinishedRun
from ccd_casadi.deployment.on_hardware import OnHardware, hardware_dict
from ccd_casadi.deployment.outcome import ChannelOrders, Deployment
from ccd_casadi.deployment.robust_set import MemberLoop, SetPlace
from ccd_casadi.deployment.sections import sections_of
from ccd_casadi.inner_problem.sections_words import sections_dict
from ccd_casadi.robust.sampled import SampledFigures
from ccd_casadi.support.json_files import write_json
from ccd_casadi.support.units import HZ
from ccd_casadi.support.versions import versions
from ccd_casadi.synthesis.interchange import DesignFile, named_controller, named_plant, write_mat
from ccd_casadi.synthesis.synthesis import DesignFigures

DESIGN_FILES = ("controller.json", "design.mat")


def write_files(
    folder: Path, run: FinishedRun, found: Deployment, seed: int, moved: OnHardware | None = None
) -> None:
    """deploy.json always; controller and .mat file only of a loop that is stable everywhere."""
    machine = {"on_hardware": None if moved is None else hardware_dict(moved)}
    write_json(folder / "deploy.json", deployment_dict(run, found, seed) | machine)
    if not found.stable:
        return
    write_json(folder / "controller.json", controller_dict(found))
    systems = {
        "plant": named_plant(run.plant.plant_si()),
        "controller": named_controller(run.controller),
        "controller_reduced": named_controller(found.reduced),
        "controller_discrete": named_controller(found.realisation.system),
        "plant_discrete": named_plant(found.plant),
    }
    theta = dict(zip(run.problem.names, run.theta, strict=True))
    units = dict(zip(run.problem.names, run.problem.units, strict=True))
    write_mat(folder / "design.mat", DesignFile(systems, theta, units))


def controller_dict(found: Deployment) -> dict[str, Any]:
    """The deployed difference equation; matrices row-major, SI."""
    K, back = found.realisation.system, found.realisation.back_calculation
    return {
        **{name: getattr(K, name).tolist() for name in "ABCD"},
        "blocks": list(found.realisation.blocks),
        "period": K.period,
        "rate_hz": found.rate_hz,
        "delay": found.delay,
        "saturation": found.realisation.saturation,
        "back_calculation": None if back is None else back.tolist(),
        "input": "e = r - y",
        "output": "u",
        "equation": "v[k] = C x[k] + D e[k], u[k] = v[k] within +-saturation, "
        "x[k+1] = A x[k] + B e[k] + back_calculation (u[k] - v[k])",
        "units": "SI, time in s",
    }


def deployment_dict(run: FinishedRun, found: Deployment, seed: int) -> dict[str, Any]:
    """deploy.json: every figure of the way; frequencies in Hz."""
    inner, limits = run.problem.inner, found.limits
    unverified = f"the run is not verified: {found.unverified}" if found.unverified else ""
    robust = None if not found.members else {
        "plants": 1 + len(found.members), "stable": found.stable, "worst": _member(found.worst),
        "members": [_member(item) for item in found.members],
    }  # fmt: skip
    return {
        "status": "verified" if found.passed else "not_verified",
        "reason": "; ".join(filter(None, (unverified, *found.shortfalls[:1]))),
        "rate_hz": found.rate_hz,
        "needed_rate_hz": found.needed_hz,
        "delay": found.delay,
        "method": found.conversion.value,
        "order": found.order,
        "criterion": {
            "S_max": inner.S_max, "reduced_peak": limits.peak, "reduced_low": limits.low,
            "reduced_norm": limits.norm, "reduced_bandwidth_hz": limits.bandwidth / HZ,
            "compliance_max": found.compliance_max, "sampled_peak": found.target.peak,
            "sampled_bandwidth_tolerance": found.target.tolerance,
        },
        "full": _figures(run.figures),
        "reduced": _figures(found.reduced_figures),
        "sampled": _sampled(found.sampled) | {"bandwidth_hz": found.sampled.bandwidth / HZ},
        "compliance_peak": None if found.compliance is None else found.compliance[1],
        "static_stiffness": None if found.statics is None else found.statics.stiffness,
        "static_compliance": None if found.statics is None else found.statics.compliance,
        "robust": robust,
        "judge": None if found.judge is None else found.judge.entry,
        "channels": [_channel(item, run) for item in found.orders],
        "theta": dict(zip(run.problem.names, run.theta, strict=True)),
        "versions": versions(),
        "seed": seed,
    }  # fmt: skip


def _sampled(f: SampledFigures) -> dict[str, Any]:
    return {
        "stable": f.stable,
        "spectral_radius": f.spectral_radius,
        "sensitivity_peak": f.sensitivity_peak,
        "sensitivity_peak_hz": f.sensitivity_peak_frequency / HZ,
    }


def _member(item: MemberLoop) -> dict[str, Any]:
    place: dict[str, Any] = {"shift": item.at.shift, "damping": item.at.damping}
    if isinstance(item.at, SetPlace):
        place |= {"modes": list(item.at.modes), "gain": item.at.gain, "option": item.at.option}
        place |= {"varies": dict(item.at.varies)} if item.at.varies else {}
    return place | _sampled(item.figures)


def _figures(figures: DesignFigures) -> dict[str, Any]:
    return {
        "stable": figures.certificate.stable,
        "sensitivity_peak": figures.sensitivity_peak,
        "sensitivity_peak_hz": figures.sensitivity_peak_frequency / HZ,
        "sensitivity_low": figures.sensitivity_low,
        "bandwidth_hz": figures.bandwidth / HZ,
        "norm": figures.gamma,
    }


def _channel(item: ChannelOrders, run: FinishedRun) -> dict[str, Any]:
    return {
        "name": item.channel.name,
        "outputs": item.channel.outputs.tolist(),
        "inputs": item.channel.inputs.tolist(),
        "full_order": item.rows[0].order,
        "order": item.chosen.order,
        "method": item.chosen.method.value,
        "smallest_order_at_S_max": item.strict.order,
        "orders": [
            {"order": row.order, "method": row.method.value, "reason": row.figures.outcome.value}
            | _figures(row.figures)
            for row in item.rows
        ],
        "sections": _sections(item, run) if item.chosen.controller.D.shape == (1, 1) else None,
    }


def _sections(item: ChannelOrders, run: FinishedRun) -> dict[str, Any]:
    if item.designed is not None:
        return sections_dict(*item.designed)
    return asdict(sections_of(item.chosen.controller, run.figures.bandwidth))
