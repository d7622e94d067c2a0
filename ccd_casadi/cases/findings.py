"""What is said of a plant before anything is designed for it: severity, topic, one sentence.

Here are the findings of numbers that look like those of another unit: M_K, stiffness, S_max, by
name. For these frequencies are compared that a consistent case has close together: where the plant
falls through 1/M_K, its first resonance, and where [inner] looks. Questions about a motor, a move
and S_low, never a refusal, compare a number of the case with what the plant has, or with the limits
of machines that exist: a number in another unit is a factor of 1000 away.
"""

from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from ccd_casadi.analysis.motor import Motion
from ccd_casadi.inner_problem.kinds import kind_of
from ccd_casadi.inner_problem.problem import CoDesignProblem, plant_of
from ccd_casadi.inner_problem.structured_bandwidth import motion_of
from ccd_casadi.lti.state_space import sigma_max
from ccd_casadi.plants.plant_facts import PlantFacts
from ccd_casadi.plants.scaling import ScaledPlant
from ccd_casadi.support.errors import UserError
from ccd_casadi.support.text import HZ, is_force, number, of_newtons, spoken


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
    CONTROLLER = "controller"
    UNUSED = "unused parameter"
    UNSTABLE = "unstable pole"


@dataclass(frozen=True)
class CaseFinding:
    """One sentence about the plant; `index` of the θ where it was seen, among those looked at.

    `limit_hz`: the bandwidth above which none is possible there. `everywhere`: no examined θ admits
    a design.
    """

    severity: Severity
    topic: Topic
    words: str
    index: int = 0
    limit_hz: float = np.inf
    everywhere: bool = False


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


def states_effort(problem: CoDesignProblem) -> bool:
    """Whether the case has an M_K; sections without weighted_level are scaled by one of ours."""
    kind = kind_of(problem)
    return not kind.as_designed or kind.bounds().weighted_level is not None


def _searched_range(problem: CoDesignProblem) -> tuple[float, float]:
    """Return the range in Hz in which a bandwidth can be meant."""
    inner = problem.inner
    low = max(inner.omega_low, inner.omega_T[0] / 4.0)
    return low / HZ, max(inner.omega_S[1], inner.omega_T[1]) / HZ


def suitable_effort(problem: CoDesignProblem, plant: ScaledPlant) -> float:
    """M_K for a third of the first resonance, where nothing else asks for one."""
    return plant.force / _at_a_third(problem, plant)[1]


def _at_a_third(problem: CoDesignProblem, plant: ScaledPlant) -> tuple[float, float]:
    """A third of the first resonance in Hz, within what [inner] searches, and M_K |G| there."""
    low, high = _searched_range(problem)
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
    low, high = _searched_range(problem)
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
        f"weights.M_K = {M_K:.3g} looks {number(max(gain, 1.0 / gain), 1)} times too {side}: "
        f"{where}, and [inner] searches {low:.3g} to {high:.3g} Hz; {M_K / gain:.2g} would suit "
        f"a bandwidth of {aim:.3g} Hz. Check the units of {units}"
    ]


def _resonances(problem: CoDesignProblem, facts: PlantFacts, options: FindingOptions) -> list[str]:
    """The first resonance that shows, against the bandwidth that M_K suits without resonances."""
    least = options.shown
    shown = (m for m in facts.modes if m.resonant and min(m.driven, m.measured) > least)
    first = next((mode.frequency_hz for mode in shown), np.nan)  # which compares with nothing
    suits = float(np.sqrt(problem.weights.M_K / facts.inertia)) / HZ  # 0: nothing moves freely
    high = _searched_range(problem)[1]
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
    units = SI
    if problem.spoken[0] == "rad":
        units = f"It is in N m/rad: one per degree is {np.degrees(1.0):.3g} times smaller"
    return [f"{words}: is the stiffness in another unit? {units}{undeclared}"]


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


@dataclass(frozen=True)
class MoveScale:
    """Limits, in the unit of y and s, that moves of machines stay below."""

    stroke: float
    velocity: float
    acceleration: float


@dataclass(frozen=True)
class PlausibilityOptions:
    """Limits beyond which a question is written."""

    linear: MoveScale = MoveScale(5.0, 20.0, 1e3)  # m, m/s, m/s²: gantry, fast motor, 100 g
    rotary: MoveScale = MoveScale(100.0, 1e3, 1e6)  # rad, ...: 16 turns, 10,000/min, scanner
    longest: float = 60.0  # of a move, s
    lightest: float = 3e-3  # moving mass of a motor, over what it moves besides
    heaviest: float = 10.0  # the same
    suits: float = 1.1  # largest ω_b over the frequency at which M_K |G| = 1
    steepest: float = 3.0  # power of ω with which |S| falls below ω_b: free mass and integrator, 3


def plausibility_findings(
    problem: CoDesignProblem,
    facts: PlantFacts,
    *,
    options: PlausibilityOptions = PlausibilityOptions(),
) -> list[CaseFinding]:
    """Ask about a motor, a move and S_low of a problem that hardly any machine has; facts at the
    start.
    """
    words = [*_low_words(problem, facts, options), *_compliance_words(problem, facts)]
    if (motion := problem.source.motion) is not None:
        words += [*_motor_words(problem, motion, facts, options)]
        words += [*_move_words(problem, motion, options)]
    return [CaseFinding(Severity.WARNING, Topic.UNITS, item) for item in words]


def _motor_words(
    problem: CoDesignProblem, motion: Motion, facts: PlantFacts, options: PlausibilityOptions
) -> list[str]:
    """The motor's own mass, beside what it moves."""
    motor = motion.motor
    if motor is None or not np.isfinite(facts.inertia) or not is_force(problem.spoken[1]):
        return []
    known = {**problem.source.held, **dict(zip(problem.names, problem.start, strict=True))}
    mass = float(known.get(motor.size, motor.moving_mass[0]))
    rest = max(facts.inertia - mass, 1e-12 * facts.inertia)
    if mass == 0.0 or options.lightest <= mass / rest <= options.heaviest:
        return []
    key = f"theta.{motor.size}" if motor.size else "motor.moving_mass"
    times = 1e-3 if mass > rest else 1e3
    moved, own = (spoken(f"{value:.3g} kg") for value in (rest, mass))
    size = f"{mass / rest:.2g} times the {moved} that it moves besides"
    return [f"{key}: {own} is {size}: is it in another unit? In SI it may be {times * mass:.3g}"]


def _move_words(
    problem: CoDesignProblem, motion: Motion, options: PlausibilityOptions
) -> list[str]:
    """The move that is named, and the setpoint that is made of it."""
    limits, words = motion.limits, []
    most = options.rotary if problem.spoken[0] == "rad" else options.linear
    made = {"velocity": limits.velocity, "acceleration": limits.acceleration}
    seconds = 0.0
    try:
        profile = motion_of(problem, problem.start).cycle.profile
        made["acceleration"] = float(np.real(profile.acceleration))
        seconds = profile.duration
    except UserError:  # such as of a held output: what makes the move reports it
        pass
    for key, value, limit, unit in (
        ("distance", limits.stroke, most.stroke, "m"),
        ("velocity", made["velocity"], most.velocity, "m/s"),
        ("acceleration", made["acceleration"], most.acceleration, "m/s²"),
    ):
        if limit < value < np.inf:
            found = (
                f"{value:.4g} {unit} is more than the {limit:g} {unit} of most machines: was "
                f"{value:.4g} m{unit} meant? Then write {1e-3 * value:.4g}"
            )
            words.append(f"move.{key}: {spoken(found)}")
    far = limits.stroke
    if problem.spoken[0] == "rad" and 2.0 * np.pi < far < np.inf:
        found = f"{far:.4g} rad is more than a turn: was {far:.4g} deg meant? Then write"
        words.append(f"move.distance: {found} {np.radians(far):.4g}")
    if seconds > options.longest:
        words.append(f"[move] takes {seconds:.3g} s: is a limit of it in another unit?")
    if motion.window >= limits.stroke:
        words.append(
            f"move.settle_band = {motion.window:g} is not less than move.distance = "
            f"{limits.stroke:g}, so that nothing has to move: is one in another unit?"
        )
    return words


def _compliance_words(problem: CoDesignProblem, facts: PlantFacts) -> list[str]:
    """A bound of what a newton moves that holds without a controller."""
    most, low = kind_of(problem).bounds().compliance_max, problem.inner.omega_low
    own = plant_of(problem).ports  # then other forces or places count
    if most is None or own or not np.isfinite(facts.inertia) or not is_force(problem.spoken[1]):
        return []
    free = 1.0 / (facts.inertia * low**2)
    if not most > free:
        return []
    bound = spoken(f"{most:.4g} m/N")
    return [
        f"inner.compliance_max = {most:g}: {bound} bounds nothing, since {spoken('1 N')} moves the "
        f"free mass by {free:.2g} {spoken('m')} at omega_low_hz: was {most:g} {spoken('µm/N')} "
        f"meant? Then write {1e-6 * most:g}"
    ]


def _low_words(
    problem: CoDesignProblem, facts: PlantFacts, options: PlausibilityOptions
) -> list[str]:
    """The bandwidth that S_low needs at omega_low, against what limits one."""
    inner, findings = problem.inner, FindingOptions()
    low = inner.omega_low / HZ
    least = low * max(2.0**-0.5 / inner.S_low, 1.0) ** (1.0 / options.steepest)
    shown = (
        mode.frequency_hz for mode in facts.modes
        if mode.resonant and min(mode.driven, mode.measured) > findings.shown
    )  # fmt: skip
    first, effort = min(shown, default=np.inf), np.nan
    if states_effort(problem):
        effort = options.suits * facts.effort_hz
    limits = [(first, "the first resonance is at")]
    limits += [(effort, "M_K suits a bandwidth of at most")] if np.isfinite(effort) else []
    hz, what = min(limits)
    if inner.S_low >= 2.0**-0.5 or not least > hz:
        return []
    return [
        f"inner.omega_low_hz = {low:g}: |S| <= {inner.S_low:g} there needs a bandwidth of "
        f"{least:.3g} Hz or more, and {what} {hz:.3g} Hz: was a lower frequency meant?"
    ]
