"""What a plant shows by itself: transmission zeros, signs, lags, entries, rigid, hidden modes."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ccd_casadi.cases.findings import (
    SI,
    CaseFinding,
    FindingOptions,
    Severity,
    Topic,
    states_effort,
)
from ccd_casadi.fixed_structure.structure import Structure
from ccd_casadi.inner_problem.problem import CoDesignProblem
from ccd_casadi.inner_problem.structured_plant_set import bounded_ports, uncertain_plant
from ccd_casadi.inner_problem.structured_problem import StructuredProblem
from ccd_casadi.lti.loop import Sampling
from ccd_casadi.plants.modal import ModalPlant, Suspension
from ccd_casadi.plants.plant import Mechanics, Plant, named_values
from ccd_casadi.plants.plant_facts import PlantFacts, Zero, bandwidth_limit_hz
from ccd_casadi.support.text import HZ, spoken, with_unit


@dataclass(frozen=True)
class DiagnosisOptions:
    """Numbers of the diagnosis of a plant."""

    most_corners: int = 16  # of the box; of more this many are drawn
    with_derivatives: int = 2  # points with derivatives by differences checked: start and middle
    hidden: float = 1e-6  # share of the largest gain below which a mode is not driven or measured
    coupled: float = 1e-9  # share of the modes' damping above which a damper connects two modes


# in SI, by how a person writes them
MASS = {"t": 1e3, "kg": 1.0, "g": 1e-3, "mg": 1e-6}
STIFFNESS = {"MN/m": 1e6, "kN/mm": 1e6, "N/um": 1e6, "N/µm": 1e6, "kN/m": 1e3, "N/mm": 1e3,
             "N/m": 1.0}  # fmt: skip


def zero_findings(
    problem: CoDesignProblem,
    facts: PlantFacts,
    place: str,
    *,
    options: FindingOptions = FindingOptions(),
) -> list[CaseFinding]:
    """The right half-plane zero that limits most, and the dips; `place` names the θ."""
    found = []
    right = [zero for zero in facts.zeros if zero.damping_ratio < 0.0]
    if right:
        nearest = min(right, key=lambda z: z.frequency_hz)
        found.append(_right(nearest, facts, problem.inner.S_max, place))
    return found + [
        _dip(zero, place, states_effort(problem))
        for zero in facts.zeros
        if 0.0 <= zero.damping_ratio < options.light
    ]


def _right(zero: Zero, facts: PlantFacts, S_max: float, place: str) -> CaseFinding:
    z, limit = zero.frequency_hz, bandwidth_limit_hz(zero, S_max)
    words = (
        f"a transmission zero in the right half-plane at {z:.4g} Hz {place}: with a peak of S of "
        f"{S_max:g} no bandwidth above {limit:.3g} Hz is possible there (Poisson integral), and "
        f"well before it, from about {0.5 * z:.3g} Hz on, robustness is lost; move sensor and "
        "actuator closer together"
    )
    severity = Severity.WARNING if z < 2.0 * facts.effort_hz else Severity.NOTE
    return CaseFinding(severity, Topic.ZERO, words, limit_hz=limit)


def _dip(zero: Zero, place: str, effort: bool) -> CaseFinding:
    words = f"an anti-resonance (transmission zero) at {zero.frequency_hz:.4g} Hz {place}, "
    if zero.dip < FindingOptions.blind:
        words += "undamped, caps the bandwidth there: no force moves the sensor at it"
    else:
        words += (
            f"damping {100 * zero.damping_ratio:.2g} %: |G| dips there, so a bandwidth just above "
            f"it needs {float(f'{1.0 / zero.dip:.2g}'):g} times the gain"
        ) + ("; raise M_K if the actuator can give it" if effort else "")
    return CaseFinding(Severity.NOTE, Topic.ZERO, words)


def most_limiting(findings: Sequence[CaseFinding]) -> list[CaseFinding]:
    """All findings, of the right half-plane warnings only that with the lowest limit."""
    severe = [f for f in findings if f.severity is Severity.WARNING and f.limit_hz < np.inf]
    worst = min(severe, key=lambda f: f.limit_hz, default=None)
    return [f for f in findings if f is worst or f not in severe]


def loop_findings(
    problem: CoDesignProblem,
    facts: PlantFacts,
    modal: ModalPlant,
    *,
    options: FindingOptions = FindingOptions(),
) -> list[CaseFinding]:
    """Warnings about signs of sensors and actuators, and about the delay and the rate of the
    loop."""
    words = _sign_words(problem, modal) + _unit_words(problem, modal, options)
    growth = max((mode.growth_hz for mode in facts.modes), default=0.0)
    if (run := problem.sampling) is not None:
        meant = facts.effort_hz if states_effort(problem) else np.nan
        words += _lag_words(run, meant, options)
        words += _unstable_words(run, growth, problem.inner.S_max)
    return [CaseFinding(Severity.WARNING, Topic.LOOP, item) for item in words]


def controller_findings(problem: CoDesignProblem) -> list[CaseFinding]:
    """Notes of what a search may choose for sections since no bound of the case forbids it.

    Parameters
    ----------
    problem : CoDesignProblem

    Returns
    -------
    list of CaseFinding
        Empty for other controllers.
    """
    controller, words = problem.controller, []
    if not isinstance(controller, StructuredProblem):
        return []
    structures = [controller.structure, *(one.structure for one in controller.channels)]
    if any(one.biquads and not one.least_damping for one in structures):
        words.append(
            "controller.least_damping is not given: a notch of K may be as narrow as a damping "
            f"ratio of {Structure.dampings[0]:g} allows, which few machines keep; 0.05 suits most"
        )
    if any(one.integrator and not one.slowest_zero_hz for one in structures):
        words.append(
            "controller.slowest_zero_hz is not given: what a force moved may take seconds to "
            "decay; 2 Hz cost 4 % of the bandwidth of 47 Hz on a shipped case"
        )
    return [CaseFinding(Severity.NOTE, Topic.CONTROLLER, item) for item in words]


def rest_findings(problem: CoDesignProblem, points: Sequence[Sequence[float]]) -> list[CaseFinding]:
    """Warn of a bound of the compliance that no controller with an integrator meets, as what is
    between its sensor and where the error counts moves further at rest.

    Parameters
    ----------
    problem : CoDesignProblem
    points : sequence of sequences of float
        θ to examine, the start first: there over the corners of the [robust] set, and on the worst
        of these at the others.

    Returns
    -------
    list of CaseFinding
        A warning of the start; a note where the start alone meets it.
    """
    own = problem.controller
    if not isinstance(own, StructuredProblem) or not own.structure.integrator:
        return []
    most, ports = own.compliance_max, bounded_ports(problem)[1]
    if most is None or ports is None or not ports.counted:
        return []
    start = uncertain_plant(problem, points[0])
    corners = start.corners()
    found = [start.plant(point, option).held_compliance for option, point in corners]
    if np.isnan(found).all():  # u holds the sensor at rest nowhere: nothing is claimed
        return []
    option, point = corners[int(np.nanargmax(found))]
    moved = np.array([
        np.nanmax(found),
        *(uncertain_plant(problem, at).plant(point, option).held_compliance for at in points[1:]),
    ])  # fmt: skip
    over, least = moved > most, int(np.nanargmin(moved))
    if not over.any():
        return []
    worst = 0 if over[0] else int(np.nanargmax(moved))
    unit = spoken("m/N").removeprefix(spoken("m"))

    def size(value: float) -> str:
        return with_unit(value, spoken("m")) + unit

    def place(index: int) -> str:
        return "at the start" if index == 0 else (
            f"at theta = {named_values(problem.names, points[index])}"
        )  # fmt: skip

    words = (
        f"inner.compliance_max: {size(most)} is below {size(moved[worst])}, which a force at rest "
        f"moves where the error counts with the sensor held still, {place(worst)}: no controller "
        f"with an integrator changes that; of {len(points)} points of the box {int(over.sum())} "
        f"exceed it, and the least is {size(moved[least])} {place(least)}; raise compliance_max, "
        "or stiffen what lies between sensor and performance"
    )
    severity = Severity.WARNING if over[0] else Severity.NOTE
    return [CaseFinding(severity, Topic.LOOP, words, everywhere=bool(over.all()))]


def _sign_words(problem: CoDesignProblem, modal: ModalPlant, *, nothing: float = 1e-6) -> list[str]:
    """Warn of each channel whose sensor a positive force moves to negative values, by more than
    `nothing` of what its modes could; a design that finds its own directions knows their signs."""
    p, m = len(modal.C), modal.B.shape[1]
    controller = problem.controller
    given = controller.channels if isinstance(controller, StructuredProblem) else ()
    if p == 1 == m:
        pairs = [("the sensor", np.ones(1), np.ones(1))]
    elif given and given[0].outputs is not None:
        pairs = [(f"the sensor of channel {one.name}", np.array(one.outputs),
                  np.ones(1) if m == 1 else np.array(one.inputs)) for one in given]  # fmt: skip
    else:  # each sensor alone where they share the actuator
        pairs = [(f"the sensor of output {i + 1}", row, np.ones(1))
                 for i, row in enumerate(np.eye(p)) if m == 1]  # fmt: skip
    rigid, away = modal.rigid, bool(modal.driven_away.any())
    pushed = None if modal.states is None else modal.states.pushed
    words = []
    for sensor, out, into in pairs:
        gains = (out @ modal.C) * (modal.B @ into)
        # of a free or driven-away body as it accelerates, else at rest
        moved = gains[rigid] if rigid.any() else gains if away else gains / np.diag(modal.K)
        if pushed is not None:
            moved = np.atleast_1d(out @ pushed @ into)
        largest = np.linalg.norm(out @ modal.C) * np.linalg.norm(modal.B @ into)
        if not largest > 0.0:
            words.append(
                f"{sensor} reads nothing that the actuator moves: no design is made with it; "
                "correct its row of output, or leave it out"
            )
        if pushed is not None:
            largest = np.minimum(largest, np.abs(pushed).max())
        elif not rigid.any() and not away:
            largest /= float(np.abs(np.diag(modal.K)).max())
        if moved.sum() < -nothing * largest:
            words.append(
                f"a positive force moves {sensor} to negative values, so that a controller of "
                "positive gain is unstable: is the sign of output or input as it is wired? "
                "If not, correct the row or the column"
            )
    return words


def _unit_words(problem: CoDesignProblem, modal: ModalPlant, options: FindingOptions) -> list[str]:
    """Whether sensors on one actuator read in one unit, where one bound is on all their gains."""
    if modal.B.shape[1] != 1 or len(modal.C) < 2 or not states_effort(problem):
        return []
    sizes = np.linalg.norm(modal.C, axis=1)
    least, most = int(sizes.argmin()), int(sizes.argmax())
    if not sizes[most] > options.unlike * sizes[least] > 0.0:
        return []
    return [
        f"output {most + 1} moves {sizes[most] / sizes[least]:.3g} times as far as output "
        f"{least + 1}: do they have one unit? weighted_level bounds KS of all sensors together, "
        "so scale each row of output to the same unit (a motor's angle by the lead over 2 pi)"
    ]


def _lag_words(run: Sampling, meant: float, options: FindingOptions) -> list[str]:
    """Whether delay and rate are in other units, `meant` in Hz being what M_K suits."""
    words, seconds, period = [], run.delay_us, run.period
    short = 0.0 < run.delay < options.least_delay * period
    if short and seconds < options.most_delay * period:
        words.append(
            f"loop.delay_us = {run.delay_us:g} is {1e9 * run.delay:.3g} ns: were seconds meant? "
            f"Then write {1e6 * seconds:g}"
        )
    lag = run.delay + 0.5 * period
    limit = 1.0 / (HZ * lag)
    if meant > options.mismatch * limit:
        why = f"delay_us = {run.delay_us:g} and rate_hz = {run.rate_hz:g}"
        hint = "rate_hz is in Hz" if run.delay < 0.5 * period else "delay_us is in microseconds"
        words.append(
            f"loop: {why} delay the force by {1e3 * lag:.3g} ms, which leaves no bandwidth above "
            f"some {limit:.2g} Hz, and M_K suits {meant:.3g} Hz: {hint}"
        )
    return words


def _unstable_words(run: Sampling, growth_hz: float, S_max: float) -> list[str]:
    """Whether a pole is too fast for the loop's delay.

    At a pole p of G in the right half-plane every stable loop has T = 1. From e to y it passes no
    less than d whole periods of delay and one of the hold, so T z^(d+1) is analytic outside the
    unit circle, and by the maximum principle

        ‖T‖∞ >= e^(p T (d + 1)),   ‖S‖∞ >= ‖T‖∞ - 1.
    """
    steps = int(run.delay / run.period * (1.0 + 1e-9)) + 1
    least = np.exp(min(HZ * growth_hz * run.period * steps, 700.0)) - 1.0
    if least <= S_max:
        return []
    return [
        f"loop: the plant grows as exp(2π {growth_hz:.4g} t) and the force comes {steps} periods "
        f"of {1e6 * run.period:.4g} us late, so that no controller has a peak of S below "
        f"{least:.3g}; S_max is {S_max:g}: raise rate_hz, lower delay_us, or hold the plant"
    ]


def entry_findings(problem: CoDesignProblem, system: Mechanics) -> list[CaseFinding]:
    """Warnings of a θ in a unit of mass or stiffness that stands in the matrix in that unit.

    The entries' slopes show it: of a mass in g that is stated in kg they are 0.001.
    """
    found = []
    for key, units, slopes in (
        ("mass", MASS, system.derivatives[0]),
        ("stiffness", STIFFNESS, system.derivatives[2]),
    ):
        for name, unit, slope in zip(problem.names, problem.units, slopes, strict=True):
            entries = np.abs(slope[np.abs(slope) > 1e-6 * np.abs(slope).max(initial=0.0)])
            if unit not in units or not entries.size:
                continue
            powers = np.log10(entries / units[unit]) / 3.0
            times = round(float(powers[0]))
            if times == 0 or not np.allclose(powers, times, atol=1e-4):
                continue
            words = (
                f"theta.{name} is in {unit}, and {key} grows by {entries[0]:.4g} with each, where "
                f"{units[unit]:g} is meant: is the matrix in another unit? {SI}"
            )
            found.append(CaseFinding(Severity.WARNING, Topic.UNITS, words))
    return found


def outside_findings(problem: CoDesignProblem, plant: Plant) -> list[CaseFinding]:
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


def hidden_findings(modal: ModalPlant, place: str, options: DiagnosisOptions) -> list[CaseFinding]:
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


def driven_away_findings(facts: PlantFacts, of_states: bool, place: str) -> list[CaseFinding]:
    growth = max((mode.growth_hz for mode in facts.modes), default=0.0)
    if not growth:
        return []
    what, why = "the stiffness drives a motion away", " (a negative eigenvalue, as no spring makes)"
    meant = "a spring was meant, correct the sign of stiffness"
    if of_states:
        what, why, meant = "A drives a motion away", "", "that is not meant, correct its signs"
    words = (
        f"{what} {place}{why}: an unstable pole at +{growth:.4g} Hz, which "
        f"the crossover has to exceed; if {meant}"
    )
    return [CaseFinding(Severity.NOTE, Topic.UNSTABLE, words)]


def rigid_findings(
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
