"""What a deployment leaves in its folder, and a scalar controller as sections in it."""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ccd_casadi.analysis.loop_channels import SampledFigures
from ccd_casadi.cases.run_folder import FinishedRun
from ccd_casadi.deployment.on_hardware import OnHardware, hardware_dict
from ccd_casadi.deployment.outcome import ChannelOrders, Deployment
from ccd_casadi.deployment.robust_set import MemberLoop, SetPlace
from ccd_casadi.inner_problem.sections_words import sections_dict
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.support.json_files import write_json
from ccd_casadi.support.text import HZ, versions
from ccd_casadi.synthesis.interchange import DesignFile, named_controller, named_plant, write_mat
from ccd_casadi.synthesis.synthesis import DesignFigures


@dataclass(frozen=True)
class SectionOptions:
    """Limits between kinds of sections."""

    notch_ratio: float = 1.5  # of zero to pole frequency, up to which a pair is a notch
    pair_ratio: float = 5.0  # beyond it a pair of zeros and one of poles are not one section
    resonant: float = 0.3  # damping ratio of a pole pair under which it is not a roll-off
    slow: float = 0.02  # share of ω_b under which a pole acts as an integrator


@dataclass(frozen=True)
class Root:
    """A real root, 1 + s/ω, or a pair of roots, 1 + 2ζ s/ω + s²/ω².

    Attributes
    ----------
    hz : float
        ω/2π, Hz; negative of an unstable real root.
    damping : float or None
        ζ; None of a real root.
    """

    hz: float
    damping: float | None = None

    def response(self, s: np.ndarray) -> np.ndarray:
        """The polynomial at s."""
        x = s / (HZ * self.hz)
        return 1.0 + x if self.damping is None else 1.0 + 2.0 * self.damping * x + x * x


@dataclass(frozen=True)
class Section:
    """One section: what it is, its zero, its pole (either may be missing), its depth.

    `depth_db` is the gain at the zero's frequency over that at s = 0, of notches only.
    """

    kind: str
    zero: Root | None
    pole: Root | None
    depth_db: float | None = None


@dataclass(frozen=True)
class Sections:
    """K₀ = K(0) in N/m, |K(jω_b)|, and the sections, slowest pole first."""

    gain: float
    gain_at_bandwidth: float
    sections: tuple[Section, ...]


def sections_of(
    K: StateSpace, bandwidth: float, options: SectionOptions = SectionOptions()
) -> Sections:
    """The sections of a scalar controller.

    Complex zeros are paired with the complex poles nearest to them on a logarithmic scale, those
    left over with two real poles, real zeros with real poles; the rest remains single, far zeros
    (which reduction puts above every frequency of use) among it.

    Parameters
    ----------
    K : StateSpace
        K(s) in SI; K(0) is finite and not zero.
    bandwidth : float
        ω_b in rad/s, by which poles are slow.
    options : SectionOptions
        Numbers of the method.

    Returns
    -------
    Sections
        Slowest pole first.
    """
    poles, zeros = _roots(K.poles), _roots(K.zeros(float(np.abs(K.poles).max())))
    gain = float((K.D - K.C @ np.linalg.solve(K.A, K.B))[0, 0])
    pairs: list[tuple[Root | None, Root | None]] = [*_match(zeros, poles, True, options.pair_ratio)]
    for zero in [z for z in zeros if z.damping is not None]:
        partner = _two_real(poles)
        if partner is not None:
            zeros.remove(zero)
            pairs.append((zero, partner))
    pairs += _match(zeros, poles, False)
    pairs += [*((zero, None) for zero in zeros), *((None, pole) for pole in poles)]
    found = [_section(zero, pole, bandwidth / HZ, options) for zero, pole in pairs]
    found.sort(key=lambda s: abs((s.pole or s.zero or Root(0.0)).hz))
    at = K.response(np.array([bandwidth]))[0]
    return Sections(gain, float(abs(at[0, 0])), tuple(found))


def _roots(values: np.ndarray) -> list[Root]:
    found = []
    for value in values:
        if abs(value.imag) <= 1e-9 * abs(value):
            found.append(Root(float(-value.real) / HZ))
        elif value.imag > 0.0:
            size = float(abs(value))
            found.append(Root(size / HZ, float(-value.real) / size))
    return found


def _match(
    zeros: list[Root], poles: list[Root], paired: bool, most: float = np.inf
) -> list[tuple[Root, Root]]:
    """Pairs of a zero and a pole, both complex (`paired`) or both real, the nearest first and none
    further apart than the ratio `most`; taken out of both lists."""
    apart = sorted(
        (abs(np.log(abs(z.hz / p.hz))), i, j)
        for i, z in enumerate(zeros)
        for j, p in enumerate(poles)
        if (z.damping is not None) == (p.damping is not None) == paired
    )
    taken: dict[int, int] = {}
    for distance, i, j in apart:
        if distance <= np.log(most) and i not in taken and j not in taken.values():
            taken[i] = j
    found = [(zeros[i], poles[j]) for i, j in taken.items()]
    zeros[:] = [z for i, z in enumerate(zeros) if i not in taken]
    poles[:] = [p for j, p in enumerate(poles) if j not in taken.values()]
    return found


def _two_real(roots: list[Root]) -> Root | None:
    """The two fastest real roots of one sign as a pair, taken out of `roots`; None if none."""
    real = sorted((r for r in roots if r.damping is None), key=lambda r: -abs(r.hz))
    for i, first in enumerate(real):
        for second in real[i + 1 :]:
            if first.hz * second.hz > 0.0:
                roots.remove(first)
                roots.remove(second)
                hz = float(np.sqrt(first.hz * second.hz))
                return Root(hz, float(0.5 * (first.hz + second.hz) / hz))
    return None


def _section(
    zero: Root | None, pole: Root | None, bandwidth_hz: float, options: SectionOptions
) -> Section:
    if zero is None or pole is None:
        root = zero or pole
        assert root is not None
        order = "first-order" if root.damping is None else "second-order"
        if pole is None:
            return Section(f"{order} zero", zero, None)
        if root.damping is not None and abs(root.damping) < options.resonant:
            return Section("resonance", None, pole)
        slow = root.damping is None and abs(root.hz) < options.slow * bandwidth_hz
        return Section("integrator" if slow else f"{order} roll-off", None, pole)
    if zero.damping is None or pole.damping is None:
        if abs(pole.hz) < options.slow * bandwidth_hz:
            return Section("integrator with zero", zero, pole)
        return Section("lead" if abs(zero.hz) < abs(pole.hz) else "lag", zero, pole)
    at_zero = 1j * HZ * np.array([zero.hz])
    depth = abs(zero.response(at_zero) / pole.response(at_zero))[0]
    if 1.0 / options.notch_ratio < zero.hz / pole.hz < options.notch_ratio:
        kind = "notch" if abs(zero.damping) < abs(pole.damping) else "inverse notch"
        return Section(kind, zero, pole, float(20.0 * np.log10(max(depth, 1e-300))))
    return Section("complex lead" if zero.hz < pole.hz else "complex lag", zero, pole)


DESIGN_FILES = ("controller.json", "design.mat")


def write_files(
    folder: Path, run: FinishedRun, found: Deployment, seed: int, moved: OnHardware | None = None
) -> None:
    """Write deploy.json, and controller and .mat file of a loop that is stable on every plant.

    Parameters
    ----------
    folder : Path
    run, found : FinishedRun, Deployment
        The run and what was deployed of it.
    seed : int
    moved : OnHardware or None
        The move with the compiled controller.
    """
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
        "precision": found.realisation.precision,
        "fixed": None if found.realisation.fixed is None else asdict(found.realisation.fixed),
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
        "rounding": None if found.rounding is None else asdict(found.rounding),
        "between_samples": None if found.between is None else found.between.entry,
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
    return asdict(sections_of(item.chosen.controller, run.bandwidth))
