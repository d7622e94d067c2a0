"""A controller of fixed structure as values of result.json and controller.json."""

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from ccd_casadi.analysis.loop_figures import loop_entry
from ccd_casadi.codesign.design_entries import compliance_dict, controller_dict
from ccd_casadi.fixed_structure import Bounds, Sampling, SectionsDesign, SetCertificate
from ccd_casadi.fixed_structure.bounds import BINDS, kind_and_channel
from ccd_casadi.fixed_structure.box_proof import Proof
from ccd_casadi.fixed_structure.certificate import TOLERANCE
from ccd_casadi.fixed_structure.loop_on_box import Excess
from ccd_casadi.fixed_structure.measured_design import MeasuredDesign
from ccd_casadi.inner_problem.problem import CoDesignProblem
from ccd_casadi.inner_problem.sections_words import sections_dict
from ccd_casadi.inner_problem.structured_plant_set import bounds_of, plants_of
from ccd_casadi.inner_problem.structured_robustness import LOOSE
from ccd_casadi.support.units import HZ, counted

WORST = 1.0 + TOLERANCE  # figure over bound up to which the judge counts a bound as met


def design_dict(
    problem: CoDesignProblem, theta: Sequence[float], design: SectionsDesign
) -> dict[str, Any]:
    """A certified design's figures under the contract's keys, the worst of its plants."""
    judged = design.certificate
    assert judged is not None
    highest = max(judged.plants, key=lambda plant: plant.S_peak)
    sampling, loop = problem.sampling, dict[str, Any]()
    if all(plant.stable for plant in judged.plants):  # else there are no margins and steps
        assert design.controller is not None
        plants = [plant.plant_si() for plant in plants_of(problem, theta)]
        loop = loop_entry(plants, design.controller, sampling, design.bandwidth, highest.S_peak)
    grown = max(plant.stability for plant in judged.plants)
    if sampling is not None:  # of the spectral radius: the real part that it comes from
        grown = float(np.log1p(grown)) / sampling.period
    ratios = judged.worst
    return {
        **dict.fromkeys(("omega_S_hz", "omega_T_hz")),
        "outcome": design.outcome.name.lower(),
        "reason": "" if design.certified else design.words,
        "bandwidth_hz": design.bandwidth / HZ,
        **dict.fromkeys(("gamma_opt", "gamma", "gamma_lower_bound")),
        "sensitivity_peak": highest.S_peak,
        "sensitivity_peak_hz": highest.S_peak_frequency / HZ,
        "sensitivity_low": max(plant.S_low for plant in judged.plants),
        **compliance_dict(
            max(plant.GS for plant in judged.plants),
            max(plant.static_compliance for plant in judged.plants),
            max(plant.low_compliance for plant in judged.plants),
            problem.inner.omega_low / HZ,
        ),
        "KS_max": max(plant.KS for plant in judged.plants),
        **loop,
        **_channel_entry(bounds_of(problem), judged),
        "certificate": {
            "stable": all(plant.stable for plant in judged.plants),
            "max_real_pole": grown,
            "norm": max(ratios.values()),
            "norm_bound": WORST,
            "passed": judged.passed,
            "plants": len(judged.plants),
            "figures_over_bounds": ratios,
        },
        "controller": sections_dict(design.structure, design.kappa)
        | {
            "kappa": design.kappa.tolist(),
            "local_optima": [
                {"bandwidth_hz": item.bandwidth / HZ, "searches": item.count}
                for item in design.local_optima
            ],
            "starts": design.starts,
            "best_found": design.found,
            "multipliers": design.multipliers,
            "at_range": [f"{name} {end}" for name, end, _ in design.at_box],
            "kkt_residual": design.kkt_residual,
        },
    }


def active_of(design: SectionsDesign) -> list[str]:
    """What binds the controller."""
    return bound_words(name for name, mu in design.multipliers.items() if mu > 1e-6)


def bound_words(names: Iterable[str]) -> list[str]:
    """Bounds on the loop as a reader knows them, of rows by kind and channel.

    >>> bound_words(["KS", "CROSSING", "S_MAX of z"])
    ['S_max of channel z', 'weighted_level of KS']
    """
    order = list(BINDS)
    found = [kind_and_channel(name) for name in names]
    bounds = [(order.index(kind), channel) for kind, channel in found if kind in BINDS]
    return [
        BINDS[order[kind]] + (f" of channel {channel}" if channel else "")
        for kind, channel in sorted(bounds)
    ]


def _channel_entry(bounds: Bounds, judged: SetCertificate) -> dict[str, Any]:
    """`channel_bounds`: what channels keep for themselves, the worst of the judge's plants."""
    found = []
    for i, own in enumerate(bounds.channels):
        rows = [plant.channels[i] for plant in judged.plants if plant.channels]
        if not own.given or not rows:
            continue
        top = max(rows, key=lambda row: row.S_peak)
        entry = {
            "name": own.name,
            "sensitivity_peak": top.S_peak,
            "sensitivity_peak_hz": top.S_peak_frequency / HZ,
            "S_max": own.S_max,
            "bandwidth_hz": min(row.bandwidth for row in rows) / HZ,
            "bandwidth_ratio": own.bandwidth_ratio,
        }
        if own.M_K is not None:
            entry |= {"M_K": own.M_K, "weighted_KS": max(row.weighted_KS for row in rows)}
        found.append(entry)
    return {"channel_bounds": found} if found else {}


def kept_words(worst: Excess) -> str:
    """Which bounds hold on a box whose judge allows `LOOSE`, by its worst plant to six digits."""
    if float(f"{100.0 + 100.0 * np.expm1(worst.value):.6g}") <= 100.0:
        return "within every bound"
    return f"no bound exceeded by more than {100.0 * LOOSE:g} %"


def robust_dict(wide: SetCertificate, plants: int, worst: Excess) -> dict[str, Any]:
    """`robust`: the judge on so many plants of the box, and the worst that was searched."""
    words = f"stable, {kept_words(worst)} on {counted(plants, 'plant')}"
    return {
        "plants": plants,
        "passed": wide.passed,
        "words": words if wide.passed else wide.words,
        "bandwidth_hz": wide.bandwidth / HZ,
        "worst_excess": float(np.expm1(worst.value)),
    }


def proof_dict(proof: Proof) -> dict[str, Any]:
    """`proof`: what holds on the whole box; `levels` are figures over bounds by kind."""
    found: dict[str, Any] = {
        "outcome": proof.outcome.name.lower(),
        "words": proof.words,
        "slack": proof.slack,
        "parameters": list(proof.parameters),
        "levels": {BINDS[name]: level for name, level in proof.levels.items()},
        "boxes": proof.boxes,
    }
    if proof.refuted:
        found |= {
            "option": proof.option,
            "point": list(proof.point),
            "passed": [BINDS[proof.passed[0]], proof.passed[1]],
        }
    return found


def sections_controller(
    design: SectionsDesign | MeasuredDesign, sampling: Sampling | None
) -> dict[str, Any]:
    """controller.json: the state space in SI, the sections, and how they run."""
    assert design.controller is not None
    words = sections_dict(design.structure, design.kappa) | {"kappa": design.kappa.tolist()}
    if isinstance(design, MeasuredDesign):
        words["sign"] = design.sign
    if sampling is not None:
        words["loop"] = vars(sampling) | {"method": "tustin"}
    return controller_dict(design.controller) | {"sections": words}
