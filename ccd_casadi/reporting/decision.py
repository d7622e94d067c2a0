"""Whether to build a design: a decision as a value, derived from result.json and never stored.

A decision has a state (`Build`), concerns with enumerated reasons, and what to do next. Its words
are rendered from these and never read back. It rests on the five lines of the verdict and on
`concerns`.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from itertools import accumulate
from typing import Any

from ccd_casadi.codesign.reasons import Reason
from ccd_casadi.codesign.verdict import Check, OwnSet, State, VerdictOptions
from ccd_casadi.reporting.concerns import (
    Concern,
    ConcernKind,
    limited_move,
    limited_move_remedy,
    lines_of,
    loop_concerns,
    motor_remedies,
    open_bound,
    resonance_condition,
    why_unproven,
)
from ccd_casadi.reporting.remarks import remarks

NEXT = {  # what to do about a line that failed, or about what the decision names
    "certified": "make the run again",
    "optimal": "more starts or box_points in [outer]",
    "predicted": "retrain, or more points in [sampling]",
    "survives": "a [robust] set in the case",
    "wider": "a wider resonance_shift or damping in [robust]",
    "narrower": "a smaller [robust] set, or looser bounds",
    "deployable": "a higher rate or less delay",
    "unproven": "a smaller [robust] set, or fewer parameters in it",
    "budget": "solve again with a larger --budget, which resumes this search",
    "current": "a larger peak_current, or less jerk or acceleration in [move]",
    "heat": "less acceleration in [move], a longer dwell or a larger rms_power",
    "late": "`ccd feedforward` for the set, a longer dwell, or more bandwidth",
    "loop": "with sections least_damping, weighted_level or bandwidth_least_hz; a smaller S_max",
}


class Build(StrEnum):
    """The state of a decision.

    Attributes
    ----------
    YES, AFTER_DEPLOY
        Every line passed; hold and delay are not judged yet.
    IF_ACCEPTED
        The concerns are for the reader to weigh.
    NOT_YET, NO
        What it survives is not known, or a move does not settle; a line failed.
    EXAMINE, NOT_VERIFIED, NOTHING
        Of a loop without a verdict, as `tune` makes it: concerns, no certificate, nothing to say.
    """

    YES = "yes"
    AFTER_DEPLOY = "after_deploy"
    IF_ACCEPTED = "if_accepted"
    NOT_YET = "not_yet"
    NO = "no"
    EXAMINE = "examine"
    NOT_VERIFIED = "not_verified"
    NOTHING = "nothing"


# Lines that may fail with every bound kept, the checks behind them, and what is to be accepted.
BOUNDS_KEPT = {
    "optimal": (("optimality", "inner_optimum"), ConcernKind.NOT_OPTIMAL, "it is not the optimum"),
    "predicted": (("prediction",), ConcernKind.MISPREDICTED, "the surrogate mispredicts it"),
}
WARNINGS = (  # with those that fail `optimal`, which only warn where a budget ended the search
    Reason.ON_GRID_ALONE, Reason.NOT_CONFIRMED, Reason.ENGINE_UNKNOWN, Reason.NOT_CHALLENGED,
    Reason.SADDLE, Reason.NO_GRADIENT, Reason.NOT_STATIONARY, Reason.BOUND_EXCEEDED,
    Reason.KINK_FALLS, Reason.CONTROLLER_BETTER, Reason.WEIGHTS_BETTER, Reason.MISPREDICTED,
    Reason.EXTRAPOLATES, Reason.LEFT_OUT_TOO_FAR, Reason.SHARE_ALONE, Reason.PEAK_ABOVE,
    Reason.WEIGHTED_ABOVE, Reason.BETWEEN_ABOVE,
)  # fmt: skip
MOTOR = (ConcernKind.CURRENT, ConcernKind.HEAT, ConcernKind.LATE)  # of the move and its motor
SENTENCES = {
    Build.YES: "Build this.",
    Build.AFTER_DEPLOY: "Build this after deploy: hold and delay are not judged yet.",
    Build.IF_ACCEPTED: "Build this only if you accept: {}.",
    Build.NOT_YET: "Do not build this yet: {}.",
    Build.NO: "Do not build this: {}.",
    Build.EXAMINE: "Look at the loop before you run it: {}.",
    Build.NOT_VERIFIED: "Do not run this: it is not verified.",
    Build.NOTHING: "",
}


@dataclass(frozen=True)
class DecisionOptions:
    """What the first paragraph of a page, and of the terminal, has of a decision."""

    most_reasons: int = 3
    most_words: int = 50


@dataclass(frozen=True)
class Decision:
    """Whether to build a design."""

    build: Build
    concerns: tuple[Concern, ...] = ()  # the first is the most important
    steps: tuple[str, ...] = ()  # what to do next, in the order of the concerns
    beside: tuple[Concern, ...] = ()  # what else speaks against a design that must not be built
    unjudged: bool = False  # hold and delay are not judged yet
    condition: str = ""  # what must be known of the resonances, in a sentence; empty: nothing
    remarks: tuple[str, ...] = ()  # what whoever builds it has to know besides, a sentence each

    @property
    def words(self) -> str:
        """The decision with its strongest reasons, for terminal and pages."""
        return " ".join(self._split()[0])

    @property
    def also(self) -> tuple[str, ...]:
        """What the words leave out, a sentence each."""
        return tuple(self._split()[1])

    def _split(self, options: DecisionOptions = DecisionOptions()) -> tuple[list[str], list[str]]:
        """The sentences of the first paragraph, and the others: of reasons and steps the first is
        always in it, and never a later one without those before."""
        most = options.most_words
        sentence = SENTENCES[self.build]
        reasons = [one.words for one in self.concerns]
        count = _fitting(reasons, most - _length(sentence))
        count = max(min(count, options.most_reasons), 1)
        first = [sentence.format("; ".join(reasons[:count]))]
        first += [f"Besides, {one.words}." for one in self.beside]
        last = [self.condition] if self.condition else []
        if self.unjudged and self.build is Build.IF_ACCEPTED:
            last.insert(0, "Deploy it first: hold and delay are not judged yet.")
        left = most - _length(*first, *last, "Next:")
        ahead = max(_fitting(self.steps, left), 1)
        if self.steps:
            first.append(f"Next: {'; '.join(self.steps[:ahead])}.")
            left -= _length(first[-1])
        shown = 0 if len(reasons) > count else _fitting(self.remarks, left)
        rest = [f"{words}." for words in reasons[count:]]
        rest += [f"Then: {'; '.join(self.steps[ahead:])}."] if self.steps[ahead:] else []
        first = [words for words in first if words]
        return [*first, *last, *self.remarks[:shown]], [*rest, *self.remarks[shown:]]

    @property
    def builds(self) -> bool:
        """Whether the design may be built, if under conditions."""
        return self.build in (Build.YES, Build.AFTER_DEPLOY, Build.IF_ACCEPTED)

    @property
    def refuses(self) -> bool:
        """Whether the design must not be built, or not yet."""
        return self.build in (Build.NO, Build.NOT_YET, Build.NOT_VERIFIED)


def _length(*texts: str) -> int:
    return sum(len(text.split()) for text in texts)


def _fitting(texts: Sequence[str], most: int) -> int:
    """How many of the first texts have at most this many words together."""
    held = list(accumulate(map(_length, texts)))
    return sum(count <= most for count in held)


def decide(result: Mapping[str, Any]) -> Decision:
    """Decide whether to build a design, and what comes next.

    Parameters
    ----------
    result : mapping
        Of result.json. Without a verdict only concerns about the loop count.

    Returns
    -------
    Decision
    """
    states = {line.name: line.state for line in lines_of(result)}
    if not states:
        return _decide_loop(result)
    failed = [name for name, state in states.items() if state == State.FAILED]
    move = limited_move(result)
    beside = (Concern(ConcernKind.MOVE, move),) if move else ()
    kept = [name for name in failed if name in BOUNDS_KEPT]
    excused = {check for name in kept for check in BOUNDS_KEPT[name][0]}
    denied = {name for name, good in result.get("checks", {}).items() if good is False}
    if kept != failed or denied - excused or not (failed or result.get("status") == "verified"):
        why = Concern(ConcernKind.NOT_VERIFIED, "it is not verified")
        if failed:
            why = Concern(ConcernKind.LINE_FAILED, f"{' and '.join(failed)} failed")
        step = _next_of_failed(failed[0], result) if failed else "see why"
        return Decision(Build.NO, (why,), (step,), beside)
    if states.get("certified") == State.UNKNOWN:
        why = Concern(ConcernKind.LINE_UNKNOWN, "whether it is certified is not known")
        return Decision(Build.NOT_YET, (why,), (NEXT["certified"],), beside)
    survival = _survival_concerns(result, states.get("survives"))
    against = {ConcernKind.SMALL_ERRORS: Build.NO, ConcernKind.MODEL_ALONE: Build.NOT_YET,
               ConcernKind.SURVIVAL_UNKNOWN: Build.NOT_YET}  # fmt: skip
    for concern in survival:
        if concern.reason in against:
            step = _next_of_survival(result["verdict"]["survives"])
            return Decision(against[concern.reason], (concern,), (step,), beside)
    if move:
        return Decision(Build.NOT_YET, beside, (limited_move_remedy(result),))
    warned = {
        name: _warning(Check.read(name, result["verdict"][name]))
        for name, state in states.items()
        if state == State.WARNED and name != "survives"
    }
    of_search = [warned.pop(name) for name in BOUNDS_KEPT if name in warned]
    missed = [Concern(*BOUNDS_KEPT[name][1:]) for name in kept]
    budget = result.get("time_budget", {})
    if budget.get("ended"):
        words = f"the search was ended by its budget of {budget['minutes']:g} min"
        if "share" in budget:
            words += f" ({100.0 * budget['share']:.3g} % of it are for the search)"
        of_search.append(Concern(ConcernKind.BUDGET, words))
    elif states.get("optimal") == State.UNKNOWN:
        words = "whether it is an optimum is not known"
        of_search.append(Concern(ConcernKind.LINE_UNKNOWN, words))
    # the machine first, then what is not known of its bounds, then what a longer search may change
    loop = loop_concerns(result)
    motor = [one for one in loop if one.reason in MOTOR]
    loop = [one for one in loop if one not in motor]
    concerns = [*missed, *motor, *survival, *warned.values(), *loop, *of_search]
    unjudged = states.get("deployable") == State.UNKNOWN
    condition, besides = resonance_condition(result), remarks(result)
    if not concerns:
        build = Build.AFTER_DEPLOY if unjudged else Build.YES
        return Decision(build, unjudged=unjudged, condition=condition, remarks=besides)
    remedies = {
        ConcernKind.NOT_OPTIMAL: "optimal",
        ConcernKind.SET_UNPROVEN: "unproven",
        ConcernKind.MISPREDICTED: "predicted",
        ConcernKind.CURRENT: "current",
        ConcernKind.HEAT: "heat",
        ConcernKind.LATE: "late",
        ConcernKind.LOOP: "loop",
        ConcernKind.BETWEEN_LINES: "loop",
        ConcernKind.BUDGET: "budget",
    }
    next_ = NEXT | {"unproven": open_bound(result).remedy or NEXT["unproven"]}
    next_ |= {remedies[kind]: words for kind, words in motor_remedies(result).items()}
    named = (remedies[one.reason] for one in concerns if one.reason in remedies)
    steps = tuple(dict.fromkeys(next_[name] for name in named))
    return Decision(Build.IF_ACCEPTED, tuple(concerns), steps, (), unjudged, condition, besides)


def advice(result: Mapping[str, Any]) -> str:
    """Write all of the decision on a design (`decide`) in words.

    Parameters
    ----------
    result : mapping
        Of result.json.

    Returns
    -------
    str
        Empty where there is nothing to decide.
    """
    found = decide(result)
    return " ".join([found.words, *(["Also:", *found.also] if found.also else [])])


def _decide_loop(result: Mapping[str, Any]) -> Decision:
    """Decide on a loop without a verdict: `tune` and baselines."""
    if result.get("status", "verified") != "verified":
        return Decision(Build.NOT_VERIFIED, steps=("see why",))
    concerns = loop_concerns(result)
    if not concerns:
        return Decision(Build.NOTHING)
    step = "a smaller S_max"
    if all(one.reason is ConcernKind.BETWEEN_LINES for one in concerns):
        step = "more lines there, or more averages"
    for own in (ConcernKind.CURRENT, ConcernKind.HEAT):
        if all(one.reason is own for one in concerns):
            step = NEXT[own]
    return Decision(Build.EXAMINE, tuple(concerns), (step,))


def _warning(line: Check) -> Concern:
    """Return what a line that warned warns of: among its findings there are good ones too, and what
    is known in part, as of a kink, is its first."""
    of = ConcernKind.MISPREDICTED if line.name == "predicted" else ConcernKind.LINE_WARNED
    known = [one for one in line.findings if one.reason in WARNINGS] or line.findings[:1]
    words = [one.words(line.figures) for one in known if one.reason is not Reason.QUOTED]
    return Concern(of, "; ".join(words) or f"{line.name} warned")


def _survival_concerns(result: Mapping[str, Any], state: str | None) -> list[Concern]:
    """List what the line `survives` adds; nothing where it passed."""
    own = result["verdict"].get("survives", {}).get("set")
    if state == State.WARNED:
        if own == OwnSet.UNPROVEN:
            open_ = "the bounds are not proven on the whole [robust] set"
            return [Concern(ConcernKind.SET_UNPROVEN, open_bound(result).words or open_)]
        if own == OwnSet.KEPT and (doubt := _unstable_controller(result)):
            return [Concern(ConcernKind.UNSTABLE_CONTROLLER, doubt)]
        if own == OwnSet.NONE:
            return [Concern(ConcernKind.MODEL_ALONE, "it was judged on the model alone")]
        return [Concern(ConcernKind.SMALL_ERRORS, "it does not survive small errors of its model")]
    if state == State.UNKNOWN:
        if own == OwnSet.SEARCHED:
            return [
                Concern(ConcernKind.SET_SEARCHED, f"the [robust] set is {why_unproven(result)}")
            ]
        return [Concern(ConcernKind.SURVIVAL_UNKNOWN, "what it survives is not known")]
    return []


def _next_of_failed(name: str, result: Mapping[str, Any]) -> str:
    """Describe what to do about a line that failed; where a rate is not enough at this delay, the
    delay."""
    line = result["verdict"][name]
    if name == "survives":
        return _next_of_survival(line)
    rate_helps = line.get("needed_hz", 0.0) is not None
    return NEXT[name] if name != "deployable" or rate_helps else "less delay"


def _next_of_survival(line: Mapping[str, Any]) -> str:
    """A set where the case names none; a smaller one where it is broken, also by a share of
    machines; else a wider one."""
    own = line.get("set") or (OwnSet.BROKEN if "share" in line else OwnSet.NONE)
    names = {OwnSet.NONE: "survives", OwnSet.BROKEN: "narrower"}
    return NEXT[names.get(own, "wider")]


def _unstable_controller(result: Mapping[str, Any]) -> str:
    """Explain why `survives` warns of a loop that keeps its [robust] set and small errors beyond
    it; empty where it does not survive the latter."""
    line = result["verdict"]["survives"]
    shift, least = line.get("stable_shift"), line.get("least_shift", 0.0)
    if shift is None or not (shift[0] <= -least and shift[1] >= least):
        return ""
    damping, least_factors = line.get("stable_damping"), VerdictOptions().least_factors
    if line.get("closer_models") or damping is None:
        return ""
    if not (damping[0] <= least_factors[0] and damping[1] >= least_factors[1]):
        return ""
    poles = line.get("unstable_controller_poles_hz") or []
    at = ", ".join(f"{hz:.4g}" for hz in poles[:3])
    return f"the controller is unstable by itself (poles at {at} Hz)" if poles else ""
