"""Questions about a motor, a move and S_low that hardly any machine has: never a refusal.

Each compares a number of the case with what the plant has, or with the limits of machines that
exist. A number in another unit is a factor of 1000 away, and the question names it.
"""

from dataclasses import dataclass

import numpy as np

from ccd_casadi.analysis.motor import Motion
from ccd_casadi.cases.findings import CaseFinding, FindingOptions, Severity, Topic, states_effort
from ccd_casadi.inner_problem.problem import CoDesignProblem
from ccd_casadi.inner_problem.structured_bandwidth import motion_of
from ccd_casadi.plants.plant_facts import PlantFacts
from ccd_casadi.support.errors import UserError
from ccd_casadi.support.text import HZ, is_force, spoken


@dataclass(frozen=True)
class MoveScale:
    """What moves of machines stay below, in the unit of y and s.

    Attributes
    ----------
    stroke, velocity, acceleration : float
        Of a move.
    """

    stroke: float
    velocity: float
    acceleration: float


@dataclass(frozen=True)
class PlausibilityOptions:
    """Limits beyond which a question is written.

    Attributes
    ----------
    linear : MoveScale
        m, m/s and m/s²: a long gantry, a fast linear motor, 100 times gravity.
    rotary : MoveScale
        rad, rad/s and rad/s²: 16 turns, 10,000 turns a minute, a galvanometer scanner.
    longest : float
        Of a move, s.
    lightest, heaviest : float
        Moving mass of a motor, over what it moves besides.
    suits : float
        Largest ω_b over the frequency at which M_K |G| = 1.
    steepest : float
        Power of the frequency with which |S| falls below ω_b: a free mass and an integrator have 3.
    """

    linear: MoveScale = MoveScale(5.0, 20.0, 1e3)
    rotary: MoveScale = MoveScale(100.0, 1e3, 1e6)
    longest: float = 60.0
    lightest: float = 3e-3
    heaviest: float = 10.0
    suits: float = 1.1
    steepest: float = 3.0


def plausibility_findings(
    problem: CoDesignProblem,
    facts: PlantFacts,
    *,
    options: PlausibilityOptions = PlausibilityOptions(),
) -> list[CaseFinding]:
    """Ask about a motor, a move and S_low of a problem that hardly any machine has.

    Parameters
    ----------
    problem : CoDesignProblem
    facts : PlantFacts
        At the start.
    options : PlausibilityOptions

    Returns
    -------
    list of CaseFinding
        Warnings.
    """
    words = _low_words(problem, facts, options)
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
    except UserError:  # such as of a spring: what makes the move reports it
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
    if seconds > options.longest:
        words.append(f"[move] takes {seconds:.3g} s: is a limit of it in another unit?")
    if motion.window >= limits.stroke:
        words.append(
            f"move.settle_band = {motion.window:g} is not less than move.distance = "
            f"{limits.stroke:g}, so that nothing has to move: is one in another unit?"
        )
    return words


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
