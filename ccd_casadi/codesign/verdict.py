"""One verdict on a finished design in five lines, the same for the terminal, files and pages.

certified: the true closed loop meets its certificate and the constraints. optimal: the true
optimality conditions hold and nothing better is known. predicted: what the surrogate said is true.
survives: the loop stands a plant a little off its model. deployable: it can run on a computer.

Every line is passed, warned, failed or unknown, in words and with the figures that it rests on.
A design is verified when no line failed; a warning is for the reader to weigh. What could not be
checked is unknown and never passed.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from functools import partial
from typing import TYPE_CHECKING, Any, Self

from ccd_casadi.codesign.outer_problem import GlobalCheck
from ccd_casadi.codesign.reasons import Finding, Reason
from ccd_casadi.codesign.survival import STATED, Survival, SurvivalOptions
from ccd_casadi.inner_problem.controller_problem import FigureOfMerit
from ccd_casadi.lti.loop import Sampling
from ccd_casadi.optim.kkt import KktCertificate, KktOptions
from ccd_casadi.synthesis.second_engine import EngineComparison
from surrogates import Quality

if TYPE_CHECKING:
    from ccd_casadi.lti.norms import BetweenSamples


@dataclass(frozen=True)
class VerdictOptions:
    """Limits between the states of a verdict's lines.

    Attributes
    ----------
    saddle : float
        Least scaled eigenvalue of the reduced Hessian; less is a saddle.
    least_shift : float
        Of all flexible resonances, relative: the accuracy of a finite-element model at best.
    least_factors : (float, float)
        Of their damping, which is known no better.
    closer_peak : float
        Relative: peak of S above S_max on a closer model, beyond which the line warns.
    primal : float
        Of its size: what a constraint may be exceeded by at an optimum.
    sigmas, left_out : float
        Left-out error at the design, in predicted deviations and relative, up to which it passes.
    between_excess : float
        Relative: of S_max, by which S may exceed it between the samples.
    most_words : int
        Of a line's sentence; what else is known follows as details.
    """

    saddle: float = -1e-3
    least_shift: float = 0.02
    least_factors: tuple[float, float] = (0.5, 2.0)
    closer_peak: float = 0.10
    primal: float = 1e-6
    sigmas: float = 3.0
    left_out: float = 0.01
    between_excess: float = 0.01
    most_words: int = 25


class State(StrEnum):
    """The state of a line of the verdict: every line has one of these four."""

    PASSED = "passed"
    WARNED = "warned"
    FAILED = "failed"
    UNKNOWN = "unknown"


class OwnSet(StrEnum):
    """The knowledge of the loop on the case's own set of plants: `set` of the line `survives`.

    Attributes
    ----------
    KEPT, BROKEN
        Every plant meets the bounds, on a box by proof; a plant exceeds one, or the proof denies.
    UNPROVEN
        All plants that were tried meet the bounds; the proof left some open.
    SEARCHED
        All plants that were tried meet them; no proof applies to all.
    NONE
        The case names no plant but the model.
    """

    KEPT = "kept"
    BROKEN = "broken"
    UNPROVEN = "unproven"
    SEARCHED = "searched"
    NONE = "none"


@dataclass(frozen=True)
class Check:
    """One line of the verdict.

    Attributes
    ----------
    name : str
        Its key in result.json.
    state : State
        Passed, warned, failed or unknown.
    findings : tuple of Finding
        Why, the most important first.
    figures : mapping
        On which it rests, by keys of result.json.
    """

    name: str
    state: State
    findings: tuple[Finding, ...]
    figures: Mapping[str, Any]

    @property
    def reason(self) -> Reason:
        """The most important one."""
        return self.findings[0].reason

    @property
    def clauses(self) -> tuple[str, ...]:
        """The words of all findings."""
        return tuple(one.words(self.figures) for one in self.findings)

    @property
    def words(self) -> str:
        """Why, in one sentence of at most `most_words`."""
        return split(self.clauses)[0]

    @property
    def details(self) -> tuple[str, ...]:
        """The clauses beyond the sentence, one each."""
        return split(self.clauses)[1]

    @property
    def entry(self) -> dict[str, Any]:
        """The entry of `verdict` in result.json."""
        words, details = split(self.clauses)
        return {
            "state": self.state.value, "reason": self.reason.key, "words": words,
            "details": list(details), **self.figures,
            "findings": [one.entry for one in self.findings],
        }  # fmt: skip

    @classmethod
    def read(cls, name: str, entry: Mapping[str, Any]) -> Self:
        """Read a line of result.json; one of an earlier version has words alone.

        Parameters
        ----------
        name, entry : str, mapping
            Of the line; the entry may be empty.

        Returns
        -------
        Check
        """
        own = ("state", "reason", "words", "details", "findings", "at_solve")
        figures = {key: value for key, value in entry.items() if key not in own}
        found = tuple(
            Reason[str(one["reason"]).upper()](**{k: v for k, v in one.items() if k != "reason"})
            for one in entry.get("findings", ())
        )
        quoted = (Reason.QUOTED(words=words) for words in clauses_of(entry) if words)
        state = State(entry.get("state", State.UNKNOWN))
        return cls(name, state, found or tuple(quoted), figures)


def split(
    clauses: Sequence[str], options: VerdictOptions = VerdictOptions()
) -> tuple[str, tuple[str, ...]]:
    """Split clauses into a sentence of at most `most_words` and the others; a first one that is
    longer is cut, and whole among the others."""
    held, count = 0, 0
    for clause in clauses:
        held += len(clause.split())
        if held > options.most_words:
            break
        count += 1
    words = "; ".join(clauses[:count])
    if clauses and not count:
        words = f"{' '.join(clauses[0].split()[: options.most_words - 1])} ..."
    return words, tuple(clauses[count:])


def clauses_of(entry: Mapping[str, Any]) -> tuple[str, ...]:
    """Read the clauses of a line of the verdict.

    Parameters
    ----------
    entry : mapping
        As result.json has it; may be empty.

    Returns
    -------
    tuple of str
        The line's words, then its details.
    """
    return (str(entry.get("words", "")), *map(str, entry.get("details", ())))


def confirm(line: Check, second: EngineComparison) -> Check:
    """`certified` with what a second engine says of the same loops."""
    state, found = line.state, (*line.findings, Reason.ENGINE_AGREES(loops=second.loops))
    if second.agrees is False:
        state, found = State.FAILED, (Reason.ENGINE_DENIES(words=second.words), *line.findings)
    elif second.agrees is None and state is State.PASSED:
        state, found = State.WARNED, (Reason.NOT_CONFIRMED(words=second.words), *line.findings)
    elif second.agrees is None:
        found = (*line.findings, Reason.ENGINE_UNKNOWN(words=second.words))
    return Check(line.name, state, found, {**line.figures, "second_engine": second.entry})


def optimal(
    kkt: KktCertificate,
    *,
    level: float,
    gap: float,
    tolerance: float,
    better: Finding,
    searched: tuple[Sequence[Finding], Mapping[str, Any]],
    unknown: Finding | None = None,
    saddle: float | None = None,
    options: VerdictOptions = VerdictOptions(),
) -> Check:
    """KKT residual over θ up to `level`, and the whole inner problem at θ, `better` by `gap`.

    `searched`: where something better was searched for; `unknown`: why there may be no gradient. A
    `gap` of NaN: nothing was found to set against the design.
    """
    saddle = options.saddle if saddle is None else saddle
    residual, kink, (known, found) = kkt.stationarity, kkt.kink, searched
    figures = {"kkt_residual": residual, "kkt_level": level, "inner_gap": gap, **found}
    line = partial(Check, "optimal", figures=figures)
    if gap > tolerance:
        return line(State.FAILED, (better, *known))
    if not kkt.primal <= options.primal:
        figures["primal"] = kkt.primal
        return line(State.FAILED, (Reason.BOUND_EXCEEDED(), *known))
    sound = State.PASSED
    if not math.isfinite(gap):
        sound, known = State.WARNED, (Reason.NOT_CHALLENGED(), *known)
    if unknown is not None and not math.isfinite(residual):
        return line(State.WARNED, (unknown, *known))
    if not residual <= level:
        return line(State.FAILED, (Reason.NOT_STATIONARY(), *known))
    if kink is None:
        if kkt.second_order is not None and kkt.second_order < saddle:
            figures["least_curvature"] = kkt.second_order
            return line(State.WARNED, (Reason.SADDLE(), *known, Reason.STATIONARY()))
        best = Reason.LOCALLY_OPTIMAL(evidence=known[0].reason.key, **known[0].figures)
        return line(sound, (best, *known[1:], Reason.STATIONARY()))
    figures |= {"kkt_residual_one_gradient": kink.one_gradient, "slopes": kink.slopes}
    figures["least_slope"] = kink.least_slope
    finite = [math.isfinite(slope) for pair in kink.slopes for slope in pair]
    least = [Reason.LEAST_SLOPE()] if any(finite) else []
    if kink.least_slope < -level:
        return line(State.FAILED, (Reason.KINK_FALLS(), *least, *known))
    if kink.first_order and kink.slopes:
        least.append(Reason.CLIMBED(step=KktOptions.step))
    clauses = (Reason.OPTIMAL_AT_KINK(), *known, *least, Reason.STATIONARY_AT_KINK())
    return line(sound if all(finite) else State.WARNED, clauses)


def search_evidence(
    starts: int, optima: int, global_check: GlobalCheck | None, gap: Finding | None = None
) -> tuple[tuple[Finding, ...], dict[str, Any]]:
    """Write the evidence of IPOPT's starts, the global check over the box and bounds, and its
    figures."""
    gap = Reason.GAP_UNKNOWN() if gap is None else gap
    figures: dict[str, Any] = {"starts": starts, "distinct_optima": optima}
    if global_check is None or not global_check.points:
        return (Reason.NO_GLOBAL_CHECK(), gap), figures
    counted_up = ("points", "fresh", "feasible", "better", "starts", "seed")
    figures |= {f"box_{name}": getattr(global_check, name) for name in counted_up}
    figures["objective_before"] = global_check.before
    if global_check.moved:
        return (Reason.STARTED(), Reason.MOVED(), Reason.CHECKED(), gap), figures
    return (Reason.NONE_BETTER(), gap), figures


def judge_prediction(
    error: float, tolerance: float, value: float, of: FigureOfMerit, quality: Quality | None,
    learnt: bool = False, options: VerdictOptions = VerdictOptions(),
) -> Check:  # fmt: skip
    """Surrogate against truth at the design, whose `value` of a figure `of` merit is in SI.

    Where the design is itself one of the samples the surrogate reproduces it and `error` (relative)
    shows nothing: its `quality` (None: no surrogate) has the error there without it. `learnt`: the
    surrogate had `error` there, and has the design among its samples since.
    """
    figures: dict[str, Any] = {"error": error, "tolerance": tolerance}
    line = partial(Check, "predicted", figures=figures)
    if quality is None:
        return line(State.UNKNOWN, (Reason.NOT_PREDICTED(),))
    left_out = quality.at_point
    if left_out is not None:
        size, sigmas = abs(left_out[0]), left_out[1]
        share = size / (of.factor * value)
        figures |= {
            "left_out": share, f"left_out_{of.unit.lower()}": size, "left_out_sigmas": sigmas
        }  # fmt: skip
    if not error <= tolerance:
        if learnt and math.isfinite(error):
            figures["learnt"] = True
            return line(State.WARNED, (Reason.MISPREDICTED(), Reason.LEARNT()))
        return line(State.FAILED, (Reason.MISPREDICTED(),))
    if left_out is None:
        found = Reason.PREDICTED(what=of.words)
        if quality.extrapolates:
            return line(State.WARNED, (found, Reason.EXTRAPOLATES(outside=quality.extrapolates[0])))
        return line(State.PASSED, (found,))
    good = share <= tolerance or (sigmas <= options.sigmas and share <= options.left_out)
    state, why = (
        (State.PASSED, Reason.LEFT_OUT) if good else (State.WARNED, Reason.LEFT_OUT_TOO_FAR)
    )
    missed = why(what=of.words, size=size, unit=of.unit)
    return line(state, (missed, Reason.COMPUTED(what=of.words)))


def survives(
    survival: Survival | None,
    *,
    S_max: float,
    own: OwnSet | None = None,
    own_findings: Sequence[Finding] = (),
    other_damping: str = "",
    closer: Sequence[tuple[str, bool, float]] = (),
    figures: Mapping[str, Any] | None = None,
    options: VerdictOptions = VerdictOptions(),
) -> Check:
    """The line `survives`: a loop on plants off its model. A figure that is NaN meets no limit.

    Parameters
    ----------
    survival : Survival or None
        The ranges of the loop; None where it is not certified.
    S_max : float
        Bound of ‖S‖∞.
    own, own_findings : OwnSet or None, sequence of Finding
        What is known of the loop on the case's own set, and why; None: its kind has no set.
    other_damping : str
        What that set does not keep, in words.
    closer : sequence of (name, stable, peak)
        ‖S‖∞ on closer models of the plant.
    figures : mapping
        More of them.
    options : VerdictOptions
        Numbers of the method.

    Returns
    -------
    Check
        Failed, warned, unknown or passed.
    """
    figures = {**(figures or {}), **({} if own is None else {"set": own.value})}
    line = partial(Check, "survives", figures=figures)
    if survival is None:
        broken = own is OwnSet.BROKEN
        known = tuple(own_findings) if broken else ()
        return line(State.FAILED if broken else State.UNKNOWN, known or (Reason.NOT_PERTURBED(),))
    (low, high), damping = survival.stable_shift, survival.stable_damping
    denied, rest, followed = survival.contradiction, survival.statics, SurvivalOptions()
    failed, warned = own is OwnSet.BROKEN, own in (OwnSet.UNPROVEN, OwnSet.NONE)
    found = [*([] if denied is None else [denied]), *own_findings[:1]]
    if low <= -options.least_shift and high >= options.least_shift:
        found.append(Reason.STABLE_SHIFT())
    else:
        warned = True
        found.append(Reason.NARROW_SHIFT())
    if not (damping[0] <= options.least_factors[0] and damping[1] >= options.least_factors[1]):
        warned = True
        found.append(Reason.NARROW_DAMPING())
    if survival.unstable_poles_hz:
        warned = True
        found.append(Reason.CONTROLLER_UNSTABLE())
    for name, stable, peak in closer:
        if not stable:
            failed = True
            found.insert(0, Reason.CLOSER_UNSTABLE(model=name))
        elif not peak <= (1.0 + options.closer_peak) * S_max:
            warned = True
            found.append(Reason.CLOSER_PEAK(model=name, peak=peak))
    loose = survival.S_max_slack >= STATED
    found.append(Reason.WITHIN_LOOSER(factor=1.0 + survival.S_max_slack) if loose
                 else Reason.WITHIN())  # fmt: skip
    found += own_findings[1:]
    if other_damping:
        found.append(Reason.OTHER_DAMPING(words=other_damping))
    if rest.differentiates:
        found += [Reason.DIFFERENTIATES(), Reason.STATIC_SHARE()]
    failed = failed or denied is not None
    state = State.FAILED if failed else State.WARNED if warned else State.PASSED
    if own is OwnSet.SEARCHED and state is State.PASSED:
        state = State.UNKNOWN
    figures |= {
        "stable_shift": list(survival.stable_shift),
        "S_max_shift": list(survival.S_max_shift),
        "S_max_shift_slack": survival.S_max_slack,
        "shift_followed_to": followed.reach,
        "least_shift": options.least_shift,
        "stable_damping": list(survival.stable_damping),
        "damping_followed_to": list(followed.factors),
        "gain_margin": list(survival.gain),
        "phase_margin_deg": survival.phase_deg,
        "modulus_margin": survival.modulus,
        "unstable_controller_poles_hz": list(survival.unstable_poles_hz),
        "static_stiffness": rest.stiffness,
        "static_compliance": rest.compliance,
        "static_share": rest.share,
        "robust_set": {OwnSet.KEPT: True, OwnSet.BROKEN: False}.get(own) if own else None,
        "closer_models": {name: {"stable": good, "peak": peak} for name, good, peak in closer},
    }
    return line(state, tuple(found))


def between_finding(found: "BetweenSamples", S_max: float, excess: float) -> tuple[bool, Finding]:
    """Say what S is between the samples.

    Parameters
    ----------
    found : BetweenSamples
        On the plants with the largest peaks at the instants.
    S_max, excess : float
        The bound, and by how much of it S may exceed it there.

    Returns
    -------
    bool
        Whether it exceeds the bound by more.
    Finding
    """
    beyond = found.peak / S_max - 1.0
    reason = Reason.BETWEEN_ABOVE if beyond > excess else Reason.BETWEEN
    return beyond > excess, reason(between_peak=found.peak, beyond=beyond)


def deployable(
    survival: Survival | None, sampling: Sampling | None = None,
    between: "BetweenSamples | None" = None, S_max: float = math.inf,
    options: VerdictOptions = VerdictOptions(),
) -> Check:  # fmt: skip
    """Write the line `deployable` before `deploy`.

    Parameters
    ----------
    survival : Survival or None
    sampling : Sampling or None
    between : BetweenSamples or None
        Of a loop that was designed as sampled.
    S_max : float
    options : VerdictOptions

    Returns
    -------
    Check
        Whether it is designed as it runs, or what delay its margins leave.
    """
    figures: dict[str, float] = {}
    line = partial(Check, "deployable", figures=figures)
    if survival is not None:
        figures |= {"delay_margin": survival.delay, "phase_margin_deg": survival.phase_deg}
    if sampling is not None and survival is not None and survival.contradiction is None:
        figures |= {"rate_hz": sampling.rate_hz, "delay_us": sampling.delay_us}
        if between is None:
            return line(State.PASSED, (Reason.DESIGNED_SAMPLED(),))
        above, finding = between_finding(between, S_max, options.between_excess)
        state = State.WARNED if above else State.PASSED
        return line(state, (Reason.DESIGNED_SAMPLED(), finding))
    if survival is None or sampling is not None or not math.isfinite(survival.delay):
        return line(State.UNKNOWN, (Reason.NOT_DEPLOYED(),))
    # one period of delay, and half a period of hold
    figures["unstable_below_rate_hz"] = 1.5 / survival.delay
    return line(State.UNKNOWN, (Reason.NOT_DEPLOYED(), Reason.DELAY_MARGIN()))
