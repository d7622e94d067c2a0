"""What is wrong, or worth knowing, with a plant before anything is designed for it.

A plant is looked at in the start of θ, the middle and the corners of the box. Errors are what no
design can be made with; warnings what a designer must know; notes what explains the bandwidth.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import product

import numpy as np

from ccd_casadi.cases.findings import (
    CaseFinding,
    Severity,
    Topic,
    entry_findings,
    loop_findings,
    most_limiting,
    unit_findings,
    zero_findings,
)
from ccd_casadi.cases.plausibility import plausibility_findings
from ccd_casadi.inner_problem.problem import CoDesignProblem, plant_of
from ccd_casadi.inner_problem.structured_plant_set import with_ranges
from ccd_casadi.inner_problem.structured_problem import StructuredProblem
from ccd_casadi.plants.modal import (
    ModalPlant,
    Suspension,
    modal_plant,
    require_damping,
    without_hidden_rigid_modes,
)
from ccd_casadi.plants.plant import (
    Mechanics,
    Plant,
    constraint_values,
    hardware_cost,
    hardware_slopes,
    mechanics,
    named_values,
)
from ccd_casadi.plants.plant_facts import PlantFacts, facts_of
from ccd_casadi.plants.scaling import scale_plant
from ccd_casadi.support.errors import PlantError
from ccd_casadi.support.terminal import Progress
from ccd_casadi.support.text import HZ


@dataclass(frozen=True)
class DiagnosisOptions:
    """Numbers of the diagnosis of a plant.

    Attributes
    ----------
    most_corners : int
        Corners of the box; of more this many are drawn.
    with_derivatives : int
        Points at which derivatives by differences are checked: start and middle.
    hidden : float
        Share of the largest gain below which a mode is not driven, or not measured.
    coupled : float
        Share of the modes' damping above which a damper connects two modes.
    """

    most_corners: int = 16
    with_derivatives: int = 2
    hidden: float = 1e-6
    coupled: float = 1e-9


def points_to_check(
    problem: CoDesignProblem, seed: int = 0, *, options: DiagnosisOptions = DiagnosisOptions()
) -> list[tuple[float, ...]]:
    """Start, middle, and the corners of the box, of which some are drawn where they are many."""
    lower, upper = np.array(problem.lower), np.array(problem.upper)
    n = len(lower)
    if n <= np.log2(options.most_corners):
        sides = np.array(list(product((0.0, 1.0), repeat=n)))
    else:
        sides = np.random.default_rng(seed).integers(0, 2, (options.most_corners, n)).astype(float)
    corners = lower + (upper - lower) * sides
    rows = [problem.start, 0.5 * (lower + upper), *corners]
    return list(dict.fromkeys(tuple(float(value) for value in row) for row in rows))


@lru_cache(maxsize=4)
def diagnose(
    problem: CoDesignProblem,
    rigid_modes: int | None = None,
    seed: int = 0,
    *,
    options: DiagnosisOptions = DiagnosisOptions(),
) -> tuple[tuple[PlantFacts, ...], tuple[CaseFinding, ...]]:
    """Check the plant of a problem over its box.

    The plant is checked at `points_to_check`, where parameters that vary belong to θ. Repeated
    calls are answered from a cache.

    Parameters
    ----------
    problem : CoDesignProblem
    rigid_modes : int, optional
        Number of rigid-body modes that is expected.
    seed : int
        Of the corners that are drawn.
    options : DiagnosisOptions

    Returns
    -------
    facts : tuple of PlantFacts
        At the points where the matrices are those of a plant.
    findings : tuple of CaseFinding

    Raises
    ------
    PlantError
        The model's function fails.
    """
    if isinstance(problem.controller, StructuredProblem):
        problem = with_ranges(problem)
    plant = plant_of(problem)
    facts: list[PlantFacts] = []
    findings = list(_outside(problem, plant))
    if findings:
        return (), tuple(findings)
    points = points_to_check(problem, seed, options=options)
    with Progress(len(points), "checking the plant") as progress:
        for index, theta in enumerate(points):
            progress.advance(int(index > 0))
            place = f"at theta = {named_values(plant.names, theta)}" if index else "at the start"
            try:
                system = mechanics(plant, theta, derivatives=index == 0)
                modal = modal_plant(system, problem.suspension.free)
                require_damping(modal)
                scaled = scale_plant(without_hidden_rigid_modes(modal), problem.weights.M_K)
            except PlantError as error:
                words = str(error) if "at theta" in str(error) else f"{error} {place}"
                findings.append(CaseFinding(Severity.ERROR, Topic.MATRICES, words, index))
                continue
            found = facts_of(theta, modal, scaled)
            doubt = (
                plant.mismatch(theta) or plant.doubt(theta)
                if index < options.with_derivatives
                else ""
            )
            here = [CaseFinding(Severity.ERROR, Topic.DERIVATIVES, doubt)] if doubt else []
            here += _rigid(modal, problem.suspension, rigid_modes, place)
            here += [
                *_driven_away(found, modal.states is not None, place),
                *_hidden(modal, place, options),
                *zero_findings(found, problem.inner.S_max, place),
            ]
            if index == 0:
                here += unit_findings(problem, found, scaled) + entry_findings(problem, system)
                here += plausibility_findings(problem, found)
                here += loop_findings(problem, found, modal) + _unused(problem, plant, system)
            findings += [replace(item, index=index) for item in here]
            facts.append(found)
        progress.advance()
    findings = most_limiting(findings)
    counts = sorted({sum(mode.rigid for mode in item.modes) for item in facts})
    if len(counts) > 1 and rigid_modes is None:
        words = (
            f"from {counts[0]} to {counts[-1]} rigid-body modes over the bounds of theta: a mode "
            "that is free at one theta and held at another has no derivative between; narrow the "
            "bounds, or hold it everywhere"
        )
        findings.append(CaseFinding(Severity.WARNING, Topic.RIGID_MODES, words))
    return tuple(facts), tuple(findings)


def _unused(problem: CoDesignProblem, plant: Plant, system: Mechanics) -> list[CaseFinding]:
    """Parameters that change no matrix, cost or constraint, from end to end of their bounds."""
    of_cost = (np.moveaxis(of, -1, 0) for of in hardware_slopes(plant, problem.start))
    slopes = [*system.derivatives, *of_cost]
    found = []
    for i, name in enumerate(problem.names):
        if any(len(slope) and np.abs(slope[i]).max(initial=0.0) > 0.0 for slope in slopes):
            continue
        ends = [(*problem.start[:i], end, *problem.start[i + 1 :])
                for end in (problem.lower[i], problem.upper[i])]  # fmt: skip
        low, high = (
            [*mechanics(plant, end, derivatives=False).matrices, constraint_values(plant, end)]
            for end in ends
        )
        same = hardware_cost(plant, ends[0]) == hardware_cost(plant, ends[1])
        if same and all(np.array_equal(a, b) for a, b in zip(low, high, strict=True)):
            words = (
                f"theta.{name} changes nothing: neither matrices nor hardware_cost nor a "
                "constraint depend on it; use it in the plant function, or take it out of the case"
            )
            found.append(CaseFinding(Severity.WARNING, Topic.UNUSED, words))
    return found


def suspicions(problem: CoDesignProblem, rigid_modes: int | None = None) -> list[str]:
    """List likely causes where no design is found: numbers in another unit, a sign, the loop.

    Parameters
    ----------
    problem : CoDesignProblem
    rigid_modes : int, optional
        Number of rigid-body modes that is expected.

    Returns
    -------
    list of str
    """
    found = diagnose(problem, rigid_modes)[1]
    return [item.words for item in found if item.topic in (Topic.UNITS, Topic.LOOP)]


def first_seen(findings: Sequence[CaseFinding]) -> list[CaseFinding]:
    """Select the findings at the first θ where their topic occurs.

    A finding at one θ mostly holds, with other numbers, at the others, too.

    Parameters
    ----------
    findings : sequence of CaseFinding

    Returns
    -------
    list of CaseFinding
        The serious ones first.
    """
    first: dict[tuple[Topic, Severity], int] = {}
    for item in findings:
        first.setdefault((item.topic, item.severity), item.index)
    kept = [item for item in findings if item.index == first[item.topic, item.severity]]
    return sorted(kept, key=lambda item: list(Severity).index(item.severity))


def _outside(problem: CoDesignProblem, plant: Plant) -> list[CaseFinding]:
    unknown = plant.unknown_between
    found = [CaseFinding(Severity.ERROR, Topic.BETWEEN, unknown)] if unknown else []
    if plant.domain is None:
        return found
    box = zip(problem.names, problem.lower, problem.upper, *plant.domain, strict=True)
    for name, low, high, least, most in box:
        slack = 1e-9 * (most - least)
        if low < least - slack or high > most + slack:
            words = (
                f"theta.{name}: its bounds {low:g} to {high:g} go beyond the model's samples, "
                f"{least:g} to {most:g}; narrow them, or add samples"
            )
            found.append(CaseFinding(Severity.ERROR, Topic.DOMAIN, words))
    return found


def _hidden(modal: ModalPlant, place: str, options: DiagnosisOptions) -> list[CaseFinding]:
    """Directions of each eigenspace that no input drives, or no output measures (rank of B, C)."""
    D = np.abs(modal.D - np.diag(np.diag(modal.D)))
    coupled = (options.coupled * np.diag(modal.D).max() < D).any(axis=1)
    k, rigid, found = np.diag(modal.K), modal.rigid, []
    w = np.sign(k) * np.sqrt(np.abs(k))
    # modes of one frequency, whose shapes are one space; the rigid ones are one
    same = (rigid[1:] & rigid[:-1]) | (
        ~rigid[:-1] & (np.abs(np.diff(w)) <= options.hidden * np.abs(w[1:]))
    )
    for group in np.split(np.arange(len(w)), np.flatnonzero(~same) + 1):
        if coupled[group].any():
            continue  # a damper hands its motion on to others
        lacks = [
            name
            for name, gains in (("driven", modal.B), ("measured", modal.C.T))
            if np.linalg.matrix_rank(gains[group], tol=options.hidden * np.abs(gains).max())
            < len(group)
        ]
        if not lacks:
            continue
        missing = "not " + " and not ".join(lacks)
        if rigid[group[0]]:
            words = (
                f"of {len(group)} rigid-body motions {place} one or more are {missing}: no "
                "controller holds them, and they are left out of the loop; something else in the "
                "machine has to"
            )
        elif k[group[0]] < 0.0:
            words = (
                f"a motion that the stiffness drives away {place} is {missing}: no controller "
                "stabilises it; add an actuator that moves it and a sensor that sees it"
            )
            found.append(CaseFinding(Severity.ERROR, Topic.HIDDEN_MODE, words))
            continue
        else:
            formal = {"driven": "uncontrollable", "measured": "unobservable"}
            words = (
                f"the mode at {w[group[0]] / HZ:.5g} Hz {place} is {missing} "
                f"({', '.join(formal[name] for name in lacks)}): no controller damps it, and S "
                "does not show it"
            )
        found.append(CaseFinding(Severity.WARNING, Topic.HIDDEN_MODE, words))
    return found


def _driven_away(facts: PlantFacts, of_states: bool, place: str) -> list[CaseFinding]:
    growth = max((mode.growth_hz for mode in facts.modes), default=0.0)
    if not growth:
        return []
    what = "the stiffness drives a motion away"
    meant = "a spring was meant, correct the sign of stiffness"
    if of_states:
        what, meant = "A drives a motion away", "that is not meant, correct its signs"
    words = (
        f"{what} {place}: an unstable pole at +{growth:.4g} Hz, which "
        f"the crossover has to exceed; if {meant}"
    )
    return [CaseFinding(Severity.NOTE, Topic.UNSTABLE, words)]


def _rigid(
    modal: ModalPlant, suspension: Suspension, expected: int | None, place: str
) -> list[CaseFinding]:
    count = int(modal.rigid.sum())
    flexible = modal.natural[~modal.rigid & ~modal.driven_away] / HZ
    least = f"; the lowest frequency is {flexible[0]:.4g} Hz" if flexible.size else ""
    if expected is not None and count != expected:
        words = (
            f"{count} rigid-body modes {place}, where suspension.rigid_modes expects "
            f"{expected}{least}; correct the stiffness (K v = 0 for a rigid-body motion v), or "
            "suspension.rigid_modes"
        )
        return [CaseFinding(Severity.ERROR, Topic.RIGID_MODES, words)]
    slow = flexible[flexible < 10.0 * suspension.frequency_hz]
    if count and slow.size:
        words = (
            f"a flexible mode at {slow[0]:.3g} Hz {place} lies next to the suspension's "
            f"{suspension.frequency_hz:g} Hz: is it a rigid-body mode that K holds by mistake?"
        )
        return [CaseFinding(Severity.WARNING, Topic.RIGID_MODES, words)]
    return []
