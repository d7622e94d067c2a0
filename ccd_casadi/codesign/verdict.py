"""One verdict on a finished design in five lines, the same for the terminal, files and pages.

certified: the true closed loop meets its certificate and the constraints. optimal: the true
optimality conditions hold and nothing better is known. predicted: what the surrogate said is true.
survives: the loop stands a plant a little off its model. deployable: it can run on a computer.

Every line is passed, warned, failed or unknown, in words and with the figures that it rests on.
A design is verified when no line failed; a warning is for the reader to weigh. What could not be
checked is unknown and never passed.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, Self

from ccd_casadi.codesign.formulation import GlobalCheck
from ccd_casadi.codesign.survival import STATED, Survival, SurvivalOptions
from ccd_casadi.inner_problem.controller_problem import FigureOfMerit
from ccd_casadi.lti.loop import Sampling
from ccd_casadi.optim.kkt import Kink, KktCertificate, KktOptions
from ccd_casadi.support.text import counted, inwards, small_share, spoken, with_unit
from ccd_casadi.synthesis.second_engine import EngineComparison
from surrogates import Quality


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
    most_words: int = 25


class State(StrEnum):
    """The state of a line of the verdict: every line has one of these four."""

    PASSED = "passed"
    WARNED = "warned"
    FAILED = "failed"
    UNKNOWN = "unknown"


class OwnSet(StrEnum):
    """What is known of the loop on the case's own set of plants: `set` of the line `survives`.

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
class VerdictLine:
    """One line of the verdict.

    Attributes
    ----------
    state : State
        Passed, warned, failed or unknown.
    words : str
        Why, in one sentence of at most `most_words`.
    figures : mapping
        On which it rests, by keys of result.json.
    details : tuple of str
        What else is known, a clause each.
    """

    state: State
    words: str
    figures: Mapping[str, Any]
    details: tuple[str, ...] = ()

    @classmethod
    def of(cls, state: State, clauses: Iterable[str], figures: Mapping[str, Any]) -> Self:
        """A line of clauses in the order of their importance (`split`)."""
        words, details = split(clauses)
        return cls(state, words, figures, details)

    @property
    def clauses(self) -> tuple[str, ...]:
        """The sentence and the details."""
        return (self.words, *self.details)

    @property
    def entry(self) -> dict[str, Any]:
        """Of `verdict` in result.json."""
        said = {"words": self.words, "details": list(self.details)}
        return {"state": self.state.value, **said, **self.figures}


def split(
    clauses: Iterable[str], options: VerdictOptions = VerdictOptions()
) -> tuple[str, tuple[str, ...]]:
    """As many clauses as `most_words` hold as a sentence, and the others. Empty ones are left out;
    a first one that is longer is cut, and whole among the others."""
    given = [clause for clause in clauses if clause]
    held, count = 0, 0
    for clause in given:
        held += len(clause.split())
        if held > options.most_words:
            break
        count += 1
    words = "; ".join(given[:count])
    if given and not count:
        words = f"{' '.join(given[0].split()[: options.most_words - 1])} ..."
    return words, tuple(given[count:])


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


def confirmed(line: VerdictLine, second: EngineComparison) -> VerdictLine:
    """`certified` with what a second engine says of the same loops."""
    state, clauses = line.state, (*line.clauses, second.words)
    if second.agrees is False:
        state, clauses = State.FAILED, (second.words, *line.clauses)
    elif second.agrees is None and state is State.PASSED:
        state, clauses = State.WARNED, (f"not confirmed: {second.words}", *line.clauses)
    return VerdictLine.of(state, clauses, {**line.figures, "second_engine": second.entry})


def optimal(
    kkt: KktCertificate,
    *,
    level: float,
    gap: float,
    tolerance: float,
    better: str,
    searched: tuple[Sequence[str], Mapping[str, Any]],
    unknown: str = "",
    saddle: float | None = None,
    options: VerdictOptions = VerdictOptions(),
) -> VerdictLine:
    """KKT residual over θ up to `level`, and the whole inner problem at θ, `better` by `gap`.

    `searched`: where something better was searched for, in words and figures; `unknown`: why there
    may be no gradient, in words. A `gap` of NaN: nothing was found to set against the design.
    """
    saddle = options.saddle if saddle is None else saddle
    residual, kink, (known, found) = kkt.stationarity, kkt.kink, searched
    figures = {"kkt_residual": residual, "kkt_level": level, "inner_gap": gap, **found}
    if gap > tolerance:
        return VerdictLine.of(State.FAILED, (f"not optimal: {better}", *known), figures)
    if not kkt.primal <= options.primal:
        words = f"not optimal: a constraint or bound of theta is exceeded by {kkt.primal:.2g}"
        return VerdictLine.of(State.FAILED, (words, *known), figures | {"primal": kkt.primal})
    if not math.isfinite(gap):
        known = ("the search at this theta that was to challenge it found nothing", *known)
    sound = State.PASSED if math.isfinite(gap) else State.WARNED
    if unknown and not math.isfinite(residual):
        words = f"{unknown}: a limit of the program"
        return VerdictLine.of(State.WARNED, (words, *known), figures)
    if not residual <= level:
        words = f"not optimal: KKT residual {residual:.3g} over theta, above {level:g}"
        return VerdictLine.of(State.FAILED, (words, *known), figures)
    if kink is None:
        stationary = f"KKT residual {residual:.2g} over theta"
        if kkt.second_order is not None and kkt.second_order < saddle:
            figures["least_curvature"] = kkt.second_order
            words = f"a stationary point, but J curves downwards there ({kkt.second_order:.2g})"
            return VerdictLine.of(State.WARNED, (words, *known, stationary), figures)
        best = f"locally optimal: {known[0]}"
        return VerdictLine.of(sound, (best, *known[1:], stationary), figures)
    figures |= {"kkt_residual_one_gradient": kink.one_gradient, "slopes": kink.slopes}
    if kink.least_slope < -level:
        words = "not optimal: J has a kink and falls on a side of it"
        return VerdictLine.of(State.FAILED, (words, *_sides(kink)[1:], *known), figures)
    beside, *rest = _sides(kink)
    if kink.first_order and kink.slopes:
        rest.append(f"by climbs of its controller, {KktOptions.step:g} of the box away")
    rest.append(
        f"KKT residual {residual:.2g} over theta and the controller together "
        f"({kink.one_gradient:.2g} by the gradient of one side)"
    )
    known_all = all(math.isfinite(slope) for pair in kink.slopes for slope in pair)
    clauses = (f"locally optimal to first order at a kink: J {beside}", *known, *rest)
    return VerdictLine.of(sound if known_all else State.WARNED, clauses, figures)


def _sides(kink: Kink) -> list[str]:
    """What values beside a kink say, and by how much."""
    if not kink.slopes:
        return ["was not evaluated beside it: bounds alone hold theta"]
    found = [slope for pair in kink.slopes for slope in pair]
    known = sum(map(math.isfinite, found))
    if not known:
        return ["is not known beside it"]
    where = "both sides" if known == len(found) else f"the {known} known sides of {len(found)}"
    of = f" of {counted(len(kink.slopes), 'direction')}" if len(kink.slopes) > 1 else ""
    least = f"the least slope there is {kink.least_slope:.2g} of the gradient"
    rises = "rises" if kink.least_slope > 0.0 else "rises or stays"
    return [f"{rises} on {where}{of}", least]


def search_evidence(
    starts: int, optima: int, global_check: GlobalCheck | None, gap: str = "gap not known"
) -> tuple[tuple[str, ...], dict[str, Any]]:
    """What IPOPT's starts, the global check over the box and bounds say, in clauses and figures."""
    figures: dict[str, Any] = {"starts": starts, "distinct_optima": optima}
    known = f"best of {counted(starts, 'start')}" if starts else "from one start"
    if optima > 1:
        known += f", {optima} distinct optima"
    if global_check is None or not global_check.points:
        return (f"{known}, no global check over the box", gap), figures
    counted_up = ("points", "fresh", "feasible", "better", "starts", "seed")
    figures |= {f"box_{name}": getattr(global_check, name) for name in counted_up}
    figures["objective_before"] = global_check.before
    own = global_check.points - global_check.fresh
    how = " and ".join(
        [f"{global_check.fresh} other theta of the box"] * bool(global_check.fresh or not own)
        + [f"{own} of the run"] * bool(own)
    )
    if global_check.moved:
        moved = f"moved by the global check: the formulation ended at J = {global_check.before:.6g}"
        return (known, moved, f"checked at {how}", gap), figures
    return (f"{known}, none better at {how}", gap), figures


def predicted(
    error: float, tolerance: float, value: float, of: FigureOfMerit, quality: Quality | None,
    learnt: bool = False, options: VerdictOptions = VerdictOptions(),
) -> VerdictLine:  # fmt: skip
    """Surrogate against truth at the design, whose `value` of a figure `of` merit is in SI.

    Where the design is itself one of the samples the surrogate reproduces it and `error` (relative)
    shows nothing: its `quality` (None: no surrogate) has the error there without it. `learnt`: the
    surrogate had `error` there, and has the design among its samples since.
    """
    what, unit = of.words, of.unit
    figures: dict[str, Any] = {"error": error, "tolerance": tolerance}
    if quality is None:
        words = "nothing was predicted: the search used true values"
        return VerdictLine.of(State.UNKNOWN, (f"not applicable: {words}",), figures)
    left_out = quality.at_point
    if left_out is not None:
        size, sigmas = abs(left_out[0]), left_out[1]
        share = size / (of.factor * value)
        figures |= {"left_out": share, f"left_out_{unit.lower()}": size, "left_out_sigmas": sigmas}
    if not error <= tolerance:
        words = (
            f"prediction and truth differ by {100 * error:.2g} %, more than {100 * tolerance:g} %"
        )
        if learnt and math.isfinite(error):
            learnt_words = "the surrogate has learnt the design since"
            return VerdictLine.of(State.WARNED, (words, learnt_words), figures | {"learnt": True})
        return VerdictLine.of(State.FAILED, (words,), figures)
    if left_out is None:
        words = f"{what} predicted, error {small_share(error)}"
        if quality.extrapolates:
            beyond = f"the surrogate extrapolates there: {quality.extrapolates[0]}"
            return VerdictLine.of(State.WARNED, (words, beyond), figures)
        return VerdictLine.of(State.PASSED, (words,), figures)
    missed = f"{size:.2g} {unit} ({100 * share:.2g} %, {sigmas:.1f} sigma)"
    words = f"the surrogate without this design misses its {what} by {missed}"
    computed = f"the {what} itself is computed, not predicted"
    if share <= tolerance or (sigmas <= options.sigmas and share <= options.left_out):
        return VerdictLine.of(State.PASSED, (words, computed), figures)
    return VerdictLine.of(State.WARNED, (f"{words}: do not use it here", computed), figures)


def survives(
    survival: Survival | None,
    *,
    S_max: float,
    own: OwnSet | None = None,
    own_words: Sequence[str] = (),
    other_damping: str = "",
    closer: Sequence[tuple[str, bool, float]] = (),
    figures: Mapping[str, Any] | None = None,
    options: VerdictOptions = VerdictOptions(),
) -> VerdictLine:
    """The line `survives`: a loop on plants off its model. A figure that is NaN meets no limit.

    Parameters
    ----------
    survival : Survival or None
        The ranges of the loop; None where it is not certified.
    S_max : float
        Bound of ‖S‖∞.
    own, own_words : OwnSet or None, sequence of str
        What is known of the loop on the case's own set, and why, in clauses; None: its kind has no
        set.
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
    VerdictLine
        Failed, warned, unknown or passed.
    """
    figures = {**(figures or {}), **({} if own is None else {"set": own.value})}
    if survival is None:
        if own is OwnSet.BROKEN:
            return VerdictLine.of(State.FAILED, own_words, figures)
        return VerdictLine.of(State.UNKNOWN, ("the loop could not be perturbed",), figures)
    (low, high), damping = survival.stable_shift, survival.stable_damping
    failed, warned = own is OwnSet.BROKEN, own in (OwnSet.UNPROVEN, OwnSet.NONE)
    said = [survival.contradiction, *own_words[:1], f"stable for resonances {_range(low, high)}"]
    if not (low <= -options.least_shift and high >= options.least_shift):
        warned = True
        said[-1] += f", and +-{100 * options.least_shift:g} % is the least to accept"
    if not (damping[0] <= options.least_factors[0] and damping[1] >= options.least_factors[1]):
        warned = True
        between = f"between {damping[0]:.3g} and {damping[1]:.3g} times the model's"
        said.append(f"unstable where damping is not {between}")
    if survival.unstable_poles_hz:
        warned = True
        at = ", ".join(f"{hz:.4g}" for hz in survival.unstable_poles_hz[:3])
        said.append(f"the controller by itself is unstable (poles at {at} Hz)")
    for name, stable, peak in closer:
        if not stable:
            failed = True
            said.insert(0, f"unstable on {name}")
        elif not peak <= (1.0 + options.closer_peak) * S_max:
            warned = True
            said.append(f"peak of S {peak:.3g} on {name}")
    more = "" if survival.S_max_slack < STATED else f"{1.0 + survival.S_max_slack:.6g} "
    said.append(f"within {more}S_max {_range(*survival.S_max_shift)}")
    said += [*own_words[1:], other_damping]
    failed = failed or bool(survival.contradiction)
    state = State.FAILED if failed else State.WARNED if warned else State.PASSED
    if own is OwnSet.SEARCHED and state is State.PASSED:
        state = State.UNKNOWN
    rest, followed = survival.statics, SurvivalOptions()
    if rest.differentiates:
        said += [
            f"almost a differentiator: {spoken('1 N')} at rest moves the stage "
            f"{with_unit(rest.compliance, spoken('m'), 2)}",
            f"|K(0)| is {100 * rest.share:.2g} % of |K| at the bandwidth",
        ]
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
    return VerdictLine.of(state, said, figures)


def deployable(survival: Survival | None, sampling: Sampling | None = None) -> VerdictLine:
    """Write the line `deployable` before `deploy`.

    Parameters
    ----------
    survival : Survival or None
    sampling : Sampling or None

    Returns
    -------
    VerdictLine
        Whether it is designed as it runs, or what delay its margins leave.
    """
    figures: dict[str, float] = {}
    if survival is not None:
        figures = {"delay_margin": survival.delay, "phase_margin_deg": survival.phase_deg}
    if sampling is not None and survival is not None and not survival.contradiction:
        words = (
            f"designed and judged at {sampling.rate_hz:g} Hz with a delay of "
            f"{sampling.delay_us:g} us, hold and delay exact; run deploy for the code"
        )
        figures |= {"rate_hz": sampling.rate_hz, "delay_us": sampling.delay_us}
        return VerdictLine.of(State.PASSED, (words,), figures)
    if survival is None or sampling is not None or not math.isfinite(survival.delay):
        return VerdictLine.of(State.UNKNOWN, ("not judged yet: run deploy",), figures)
    rate = 1.5 / survival.delay  # one period of delay, and half a period of hold
    words = (
        f"below {float(f'{rate:.3g}'):g} Hz hold and one sample of delay use up the delay margin "
        f"of {with_unit(survival.delay, 's')}"
    )
    clauses = ("not judged yet: run deploy", words)
    return VerdictLine.of(State.UNKNOWN, clauses, figures | {"unstable_below_rate_hz": rate})


def _range(low: float, high: float) -> str:
    beyond = [">" if abs(end) >= 0.999 * SurvivalOptions().reach else "" for end in (low, high)]
    shown = [inwards(100.0 * end, 2, 3) for end in (low, high)]  # less is none
    return f"{beyond[0]}{shown[0]:+g} to {beyond[1]}{shown[1]:+g} %"
