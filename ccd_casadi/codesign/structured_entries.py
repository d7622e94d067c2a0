"""Designs with controllers of fixed structure as entries of result.json and controller.json."""

import math
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from ccd_casadi.analysis.loop_figures import compliance_of, loop_entry
from ccd_casadi.analysis.yield_bound import Yield
from ccd_casadi.codesign.reasons import Finding, Reason, within_words
from ccd_casadi.codesign.result_entries import compliance_dict, controller_dict
from ccd_casadi.codesign.verdict import OwnSet
from ccd_casadi.fixed_structure.bounds import BINDS, Bounds, BrokenAt, key_words, kind_and_channel
from ccd_casadi.fixed_structure.certificate import JudgeOptions, SetCertificate
from ccd_casadi.fixed_structure.channel_structure import ChannelStructure
from ccd_casadi.fixed_structure.design import SectionsDesign
from ccd_casadi.fixed_structure.structure import Structure
from ccd_casadi.fixed_structure.worst_plant import Excess
from ccd_casadi.inner_problem.kinds import design_loops
from ccd_casadi.inner_problem.problem import CoDesignProblem, plant_of
from ccd_casadi.inner_problem.sections_words import sections_dict
from ccd_casadi.inner_problem.structured_plant_set import bounds_of
from ccd_casadi.inner_problem.structured_robustness import BoxCheckOptions
from ccd_casadi.lti.loop import Sampling
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.text import HZ, plural

if TYPE_CHECKING:
    from ccd_casadi.fixed_structure.box_proof import Proof


WORST = 1.0 + JudgeOptions.tolerance  # figure over bound that the judge counts as met


def design_dict(
    problem: CoDesignProblem, theta: Sequence[float], design: SectionsDesign
) -> dict[str, Any]:
    """A certified design's figures under the contract's keys, the worst of its plants.

    Parameters
    ----------
    problem : CoDesignProblem
        With the set of plants.
    theta : (n_θ,) sequence
        SI.
    design : SectionsDesign
        With its certificate.

    Returns
    -------
    dict
        SI, and Hz where a key says so.
    """
    judged = design.certificate
    assert judged is not None
    highest = max(judged.plants, key=lambda plant: plant.S_peak)
    sampling, loop = problem.sampling, dict[str, Any]()
    if all(plant.stable for plant in judged.plants):  # else there are no margins and steps
        assert design.controller is not None
        loops = design_loops(problem, theta, design.controller)
        loop = loop_entry(loops, design.bandwidth, highest.S_peak)
    grown = max(plant.stability for plant in judged.plants)
    if sampling is not None:  # of the spectral radius: the real part that it comes from
        grown = float(np.log1p(grown)) / sampling.period
    ratios, ported = judged.worst, {}
    if loop and loops[0].ported:
        ported = compliance_dict(*compliance_of(loops, problem.inner.omega_low))
        if (plant := plant_of(problem)).ports:  # behind an amplifier alone it is the machine's own
            ported["compliance_words"] += f", {plant.between}"
    return {
        **dict.fromkeys(("omega_S_hz", "omega_T_hz")),
        "outcome": design.outcome.name.lower(),
        "reason": "" if design.certified else design.words,
        "bandwidth_hz": design.bandwidth / HZ,
        **dict.fromkeys(("gamma_opt", "gamma", "gamma_lower_bound", "optimum")),
        "sensitivity_peak": highest.S_peak,
        "sensitivity_peak_hz": highest.S_peak_frequency / HZ,
        "sensitivity_low": max(plant.S_low for plant in judged.plants),
        **compliance_dict(
            max(plant.GS for plant in judged.plants),
            max(plant.static_compliance for plant in judged.plants),
            max(plant.low_compliance for plant in judged.plants),
            problem.inner.omega_low / HZ,
        ),
        **ported,  # of other forces, and of what counts
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
    """The bounds on the loop that bind a controller of fixed structure.

    Parameters
    ----------
    design : SectionsDesign
        With its multipliers.

    Returns
    -------
    list of str
        Keys of the case file.
    """
    return bound_words(name for name, mu in design.multipliers.items() if mu > 1e-6)


def bound_words(names: Iterable[str]) -> list[str]:
    """Bounds on the loop as a reader knows them, of rows by kind and channel.

    >>> bound_words(["KS", "CROSSING", "S_MAX of z"])
    ['S_max of channel z', 'weighted_level of KS']
    """
    order = list(BINDS)
    found = [(kind_and_channel(name), name) for name in names]
    bounds = [(order.index(kind), of, name) for (kind, of), name in found if kind in BINDS]
    return [key_words(name) for *_, name in sorted(bounds)]


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
        if own.place is not BrokenAt.WHOLE:  # |S| where the loop is broken there alone
            del entry["bandwidth_hz"], entry["bandwidth_ratio"]
            entry["place"] = own.place.value
        if own.M_K is not None:
            entry |= {"M_K": own.M_K, "weighted_KS": max(row.weighted_KS for row in rows)}
        found.append(entry)
    return {"channel_bounds": found} if found else {}


def robust_dict(wide: SetCertificate, plants: int, worst: Excess) -> dict[str, Any]:
    """`robust`: the judge on so many plants of the box, and the worst that was searched."""
    excess = float(np.expm1(worst.value))
    within = within_words(excess, BoxCheckOptions.looseness)
    return {
        "plants": plants,
        "passed": wide.passed,
        "words": f"stable, {within} on {plural(plants, 'plant')} checked"
        if wide.passed
        else wide.words,
        "bandwidth_hz": wide.bandwidth / HZ,
        "worst_excess": excess,
    }


def proof_dict(proof: "Proof") -> dict[str, Any]:
    """Write the entry `proof`: what holds on the whole box.

    Parameters
    ----------
    proof : Proof

    Returns
    -------
    dict
        `levels` are figures over their bounds by kind; a refuted proof names the plant.
    """
    found: dict[str, Any] = {
        "outcome": proof.outcome.name.lower(),
        "words": proof.words,
        "slack": proof.slack,
        "parameters": list(proof.parameters),
        "levels": {key_words(name): level for name, level in proof.levels.items()},
        "boxes": proof.boxes,
    }
    if proof.refuted:
        found |= {
            "option": proof.option,
            "point": list(proof.point),
            "passed": [key_words(proof.exceeded[0]), proof.exceeded[1]],
        }
    return found


class WithSections(Protocol):
    """A design that may have a controller of sections."""

    @property
    def structure(self) -> Structure | ChannelStructure: ...

    @property
    def kappa(self) -> Array: ...

    @property
    def controller(self) -> StateSpace | None: ...


def sections_controller(design: WithSections, sampling: Sampling | None) -> dict[str, Any]:
    """The content of controller.json: the state space, the sections, and how they run.

    Parameters
    ----------
    design : WithSections
        With a controller.
    sampling : Sampling or None
        Of the loop.

    Returns
    -------
    dict
        JSON values, SI.
    """
    assert design.controller is not None
    words = sections_dict(design.structure, design.kappa) | {"kappa": design.kappa.tolist()}
    if sampling is not None:
        words["loop"] = vars(sampling) | {"method": "tustin"}
    return controller_dict(design.controller) | {"sections": words}


def box_findings(
    wide: SetCertificate, checked: int, proof: "Proof", worst: Excess, drawn: Yield | None,
    *, along: bool,
) -> dict[str, Any]:  # fmt: skip
    """Arguments of `survives` for a loop on its box of plants.

    Parameters
    ----------
    wide, checked : SetCertificate, int
        The judge's certificate, on this number of plants of the box.
    proof : Proof
        For the whole box.
    worst : Excess
        The worst plant that a search found.
    drawn : Yield or None
        Random plants.
    along : bool
        Whether the common shift is kept.

    Returns
    -------
    dict
        `own`, `own_findings` and `figures`.
    """
    excess = math.expm1(worst.value)
    figures = {
        "plants": checked,
        "worst_excess": excess,
        "proof": proof.outcome.name.lower(),
        "proven": proof.levels,
        "unproven": proof.unproven,
        "looseness": BoxCheckOptions.looseness,
    }
    fresh = () if drawn is None else (Reason.DRAWN(words=drawn.words, **drawn.entry),)
    proven = tuple(Reason.PROOF(words=words) for words in proof.clauses)
    worst_found = Reason.WORST_FOUND(percent=100.0 + 100.0 * excess)
    own = OwnSet.BROKEN
    found: tuple[Finding, ...] = (Reason.TRIED_WITHIN(), worst_found)
    if not wide.passed:
        found = (Reason.JUDGED(words=wide.words), Reason.ON_PLANTS())
    elif proof.denies:
        found = (*proven, *found)
    elif checked <= 1:
        own, found = OwnSet.NONE, (Reason.MODEL_ALONE(),)
    elif drawn is not None and drawn.survived < drawn.draws:
        found = (*fresh, *found)
    elif along:
        own = OwnSet.SEARCHED if proof.unproven else OwnSet.KEPT
        own = OwnSet.UNPROVEN if proof.unclosed else own
        found = (Reason.SET_WITHIN(), *proven, Reason.JUDGED_ON(), worst_found, *fresh)
    else:
        found = (Reason.NOT_ALONG(), *found)
    return {"own": own, "own_findings": found, "figures": figures}
