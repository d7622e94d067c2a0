"""What is told of a plant before anything is designed for it: severity, topic, one sentence.

What its transmission zeros say about the bandwidth, and numbers that look like those of another
unit: M_K, stiffness, S_max, told by name. For these frequencies are compared that a consistent case
has close together: where the plant falls through 1/M_K, its first resonance, and where [inner]
looks.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from ccd_casadi.inner_problem.kinds import kind_of
from ccd_casadi.inner_problem.problem import CoDesignProblem
from ccd_casadi.inner_problem.structured_problem import StructuredProblem
from ccd_casadi.lti.loop import Sampling
from ccd_casadi.lti.state_space import sigma_max
from ccd_casadi.plants.modal import ModalPlant
from ccd_casadi.plants.plant import Mechanics
from ccd_casadi.plants.plant_facts import PlantFacts, Zero, bandwidth_limit_hz
from ccd_casadi.plants.scaling import ScaledPlant
from ccd_casadi.support.text import HZ, is_force, of_newtons, spoken


@dataclass(frozen=True)
class FindingOptions:
    """Thresholds of the findings.

    Attributes
    ----------
    light : float
        Damping ratio below which a zero is a dip in the frequency response.
    effort_margin : float
        Factor above the frequencies that [inner] searches at which effort may end.
    mismatch : float
        Factor between two frequencies beyond which a unit may be wrong: M_K suits 0.1 to 1.5
        times the first resonance on the shipped cases.
    shown : float
        Share of the largest gain from which a mode shows in the loop.
    least_delay, most_delay : float
        Delays in periods: a shorter one may have been written in seconds, a longer one not.
    decibel : float
        From here on a peak of S is more likely one in dB.
    unlike : float
        Factor between the motions of two sensors of one actuator beyond which a bound on KS counts
        the noise of one of them alone: their units differ.
    blind : float
        Share of the gain that a zero leaves, below which it is rounding.
    """

    light: float = 0.3
    effort_margin: float = 3.0
    mismatch: float = 2.0
    shown: float = 0.1
    least_delay: float = 1e-3
    most_delay: float = 100.0
    decibel: float = 3.0
    unlike: float = 30.0
    blind: float = 1e-9


# in SI, by how a person writes them
MASS = {"t": 1e3, "kg": 1.0, "g": 1e-3, "mg": 1e-6}
STIFFNESS = {"MN/m": 1e6, "kN/mm": 1e6, "N/um": 1e6, "N/µm": 1e6, "kN/m": 1e3, "N/mm": 1e3,
             "N/m": 1.0}  # fmt: skip
SI = "all values are in SI (kg, N/m, m; 1 N/um is 1e6 N/m, 1 N/mm is 1e3 N/m)"


class Severity(StrEnum):
    """The weight of a finding: an error prevents a design, a note only informs."""

    ERROR = "error"
    WARNING = "warning"
    NOTE = "note"


class Topic(StrEnum):
    """The subject of a finding."""

    MATRICES = "matrices"
    RIGID_MODES = "rigid modes"
    HIDDEN_MODE = "hidden mode"
    ZERO = "transmission zero"
    DOMAIN = "domain"
    BETWEEN = "between samples"
    UNITS = "units"
    DERIVATIVES = "derivatives"
    LOOP = "loop"
    UNUSED = "unused parameter"
    UNSTABLE = "unstable pole"


@dataclass(frozen=True)
class CaseFinding:
    """One sentence about the plant; `index` of the θ where it was seen, among those looked at.

    `limit_hz`: the bandwidth above which none is possible there.
    """

    severity: Severity
    topic: Topic
    words: str
    index: int = 0
    limit_hz: float = np.inf


def zero_findings(
    facts: PlantFacts, S_max: float, place: str, *, options: FindingOptions = FindingOptions()
) -> list[CaseFinding]:
    """The right half-plane zero that limits most, and the dips; `place` names the θ."""
    found = []
    right = [zero for zero in facts.zeros if zero.damping_ratio < 0.0]
    if right:
        found.append(_right(min(right, key=lambda z: z.frequency_hz), facts, S_max, place))
    return found + [
        _dip(zero, place) for zero in facts.zeros if 0.0 <= zero.damping_ratio < options.light
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


def _dip(zero: Zero, place: str) -> CaseFinding:
    words = f"an anti-resonance (transmission zero) at {zero.frequency_hz:.4g} Hz {place}, "
    if zero.dip < FindingOptions.blind:
        words += "undamped, caps the bandwidth there: no force moves the sensor at it"
    else:
        words += (
            f"damping {100 * zero.damping_ratio:.2g} %, caps the bandwidth there: control through "
            f"it needs {1.0 / zero.dip:.2g} times the force; raise M_K if the actuator can give it"
        )
    return CaseFinding(Severity.NOTE, Topic.ZERO, words)


def most_limiting(findings: Sequence[CaseFinding]) -> list[CaseFinding]:
    """All findings, of the right half-plane warnings only that with the lowest limit."""
    severe = [f for f in findings if f.severity is Severity.WARNING and f.limit_hz < np.inf]
    worst = min(severe, key=lambda f: f.limit_hz, default=None)
    return [f for f in findings if f is worst or f not in severe]


def unit_findings(
    problem: CoDesignProblem,
    facts: PlantFacts,
    plant: ScaledPlant,
    *,
    options: FindingOptions = FindingOptions(),
) -> list[CaseFinding]:
    """Warnings about M_K, the resonances and S_max, from the plant at the start."""
    words = [
        *_effort(problem, facts, plant, options),
        *(_resonances(problem, facts, options) if states_effort(problem) else []),
        *peak_words(problem.inner.S_max, options=options),
    ]
    return [CaseFinding(Severity.WARNING, Topic.UNITS, item) for item in words]


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


def _sign_words(problem: CoDesignProblem, modal: ModalPlant, *, nothing: float = 1e-6) -> list[str]:
    """Of each channel whose sensor a positive force moves to negative values, but for `nothing` of
    what its modes could; of the directions that a design finds itself signs are known."""
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


def states_effort(problem: CoDesignProblem) -> bool:
    """Whether the case has an M_K; sections without weighted_level are scaled by one of ours.

    Parameters
    ----------
    problem : CoDesignProblem

    Returns
    -------
    bool
    """
    kind = kind_of(problem)
    return not kind.as_designed or kind.bounds().weighted_level is not None


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

    The entries' slopes tell: of a mass in g that is told in kg they are 0.001.
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


def _searched(problem: CoDesignProblem) -> tuple[float, float]:
    """From where to where, in Hz, a bandwidth can be meant."""
    inner = problem.inner
    low = max(inner.omega_low, inner.omega_T[0] / 4.0)
    return low / HZ, max(inner.omega_S[1], inner.omega_T[1]) / HZ


def suitable_effort(problem: CoDesignProblem, plant: ScaledPlant) -> float:
    """M_K for a third of the first resonance, where nothing else asks for one."""
    return plant.force / _at_a_third(problem, plant)[1]


def _at_a_third(problem: CoDesignProblem, plant: ScaledPlant) -> tuple[float, float]:
    """A third of the first resonance in Hz, within what [inner] searches, and M_K |G| there."""
    low, high = _searched(problem)
    flexible = plant.natural[plant.natural > 0.0] / HZ
    aim = float(np.clip(flexible[0] / 3.0 if flexible.size else np.sqrt(low * high), low, high))
    gain = plant.gain  # the least of all directions: 0 where sensors share an actuator
    if not gain.any():
        gain = sigma_max(plant.system.response(plant.grid))
    level = np.log(np.maximum(gain, 1e-300))
    return aim, float(np.exp(np.interp(
        np.log(aim * HZ / plant.omega_0), np.log(plant.grid), level)))  # fmt: skip


def _effort(
    problem: CoDesignProblem, facts: PlantFacts, plant: ScaledPlant, options: FindingOptions
) -> list[str]:
    low, high = _searched(problem)
    M_K, effort = problem.weights.M_K, facts.effort_hz
    if np.isfinite(effort) and low <= effort <= options.effort_margin * high:
        return []
    aim, gain = _at_a_third(problem, plant)
    if 1.0 / options.effort_margin < gain < options.effort_margin:
        return []  # it is not M_K that is far off
    where = (
        f"the plant's gain falls through 1/M_K at {effort:.3g} Hz"
        if np.isfinite(effort)
        else "the plant's gain falls through 1/M_K nowhere"
    )
    side = "small" if gain < 1.0 else "large"
    units = f"M_K (force over displacement) and of mass and stiffness: {SI}"
    if not is_force(problem.spoken[1]):
        units = spoken("M_K, which is in N/m, and of the plant's input and output")
    return [
        f"weights.M_K = {M_K:.3g} looks {max(gain, 1.0 / gain):.1g} times too {side}: {where}, "
        f"and [inner] searches {low:.3g} to {high:.3g} Hz; {M_K / gain:.2g} would suit a bandwidth "
        f"of {aim:.3g} Hz. Check the units of {units}"
    ]


def _resonances(problem: CoDesignProblem, facts: PlantFacts, options: FindingOptions) -> list[str]:
    """The first resonance that shows, against the bandwidth that M_K suits without resonances."""
    least = options.shown
    shown = (m for m in facts.modes if m.resonant and min(m.driven, m.measured) > least)
    first = next((mode.frequency_hz for mode in shown), np.nan)  # which compares with nothing
    suits = float(np.sqrt(problem.weights.M_K / facts.inertia)) / HZ  # 0: nothing moves freely
    high = _searched(problem)[1]
    if suits > options.mismatch * first:
        against = f"M_K suits {suits:.3g} Hz"
        if is_force(problem.spoken[1]):  # of a voltage 1/(b²) is not a mass
            moved = spoken(f"{facts.inertia:.3g} kg")
            against += f" for the {moved} that an actuator feels{of_newtons(problem.spoken[1])}"
    elif suits > 0.0 and first > 100.0 * high:
        against = f"[inner] searches up to {high:.3g} Hz"
    else:
        return []
    words = f"the first resonance is at {first:.3g} Hz, and {against}"
    if not is_force(problem.spoken[1]):
        return [f"{words}: is M_K in another unit?"]
    undeclared = "; what is no force is declared in [units]" if problem.spoken[1] == "N" else ""
    return [f"{words}: is the stiffness in another unit? {SI}{undeclared}"]


def peak_words(S_max: float, *, options: FindingOptions = FindingOptions()) -> list[str]:
    """Warn of an S_max that looks like one in dB.

    Parameters
    ----------
    S_max : float
    options : FindingOptions

    Returns
    -------
    list of str
        Empty where it looks right.
    """
    if S_max <= options.decibel:
        return []
    factor = 10.0 ** (S_max / 20.0)
    return [
        f"inner.S_max = {S_max:g} is a factor: was {S_max:g} dB meant? Then write {factor:.4g}; "
        "loops on hardware have 1.4 to 2"
    ]
