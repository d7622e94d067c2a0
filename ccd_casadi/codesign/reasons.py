"""Why a line of the verdict is as it is: enumerated reasons, and the one place of their words.

A finding is a reason with figures. Its words are the reason's sentence with these figures and those
of its line (`Finding.words`), for terminal, files and pages; no program reads them back.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from string import Formatter
from typing import Any, Self

from ccd_casadi.inner_problem.controller_problem import FIGURES
from ccd_casadi.support.text import (
    distinct_texts,
    inwards,
    number,
    plural,
    small_share,
    spoken,
    with_unit,
)

AT = "at {rate_hz:.6g} Hz with a delay of {delay:1e6*.4g} us: "
LOOP = "bandwidth {bandwidth_hz:.4g} Hz, peak of S {sensitivity_peak:.5g}"


class Reason(Enum):
    """The reason for the state of a line of the verdict; called with figures it makes a `Finding`.

    Its sentence has fields: figures of the finding or of its line, in SI and in what their names
    say, and what `DERIVED` makes of these. They are formatted by `FORMATS` or by Python, with
    `100*.2g` after a product. `words` quotes what another result of the run says of itself.
    """

    sentence: str

    def __new__(cls, sentence: str) -> Self:
        """Two may have the same sentence."""
        made = object.__new__(cls)
        made._value_, made.sentence = len(cls.__members__), sentence
        return made

    def __call__(self, **figures: Any) -> "Finding":
        """Make a finding of the reason with its figures."""
        return Finding(self, figures)

    @property
    def key(self) -> str:
        """The key of result.json."""
        return self.name.lower()

    QUOTED = "{words}"
    # certified
    BOUNDS_MET = "closed loop stable, every bound and constraint met"
    NOT_CERTIFIED = "the closed loop is not certified"
    BOUND_NOT_MET = "certified, but {bounds:list} or a constraint on theta is not met"
    CONSTRAINT_NOT_MET = "certified, but a constraint on theta is not met"
    COMPLIANCE = "compliance at most {compliance_max:1e6*.4g} um/N"
    NORM = "norm {norm:.6g} <= {norm_bound:.6g}"
    JUDGED_ON_MODEL = "stable and within every bound on the model that it was designed on"
    JUDGED_ON_PLANTS = (
        "stable and within every bound on the {plants} plants of its set that the search kept"
    )
    ON_GRID_ALONE = "{on_grid_alone:list}: judged on a grid of frequencies alone"
    DESIGNED_ON = "{words}, on which it was designed"
    JUDGED = "{words}"
    ENGINE_AGREES = "SLICOT agrees on {loops:count loop}"
    ENGINE_DENIES = "{words}"
    ENGINE_UNKNOWN = "{words}"
    NOT_CONFIRMED = "not confirmed: {words}"
    # optimal
    WEIGHTS_BETTER = (
        "not optimal: other weights at the same theta give {inner_gap:100*.2g} % more bandwidth"
    )
    CONTROLLER_BETTER = (
        "not optimal: a multi-start search at this theta found a controller with {better_shown} "
        "instead of {own_shown}"
    )
    BOUND_EXCEEDED = (
        "not optimal: a constraint or bound of theta is exceeded by {primal:.2g} of its size"
    )
    NOT_STATIONARY = "not optimal: KKT residual {kkt_residual:.3g} over theta, above {kkt_level:g}"
    KINK_FALLS = "not optimal: J has a kink and falls on a side of it"
    NO_GRADIENT = (
        "no gradient over theta, since the search over the controller ended "
        "{controller_residual:.1e} from its optimum: a limit of the program"
    )
    SADDLE = "a stationary point, but J curves downwards there ({least_curvature:.2g})"
    LOCALLY_OPTIMAL = "locally optimal: {evidence_words}"
    OPTIMAL_AT_KINK = "locally optimal to first order at a kink: J {sides}"
    LEAST_SLOPE = "the least slope there is {least_slope:.2g} of the gradient"
    CLIMBED = "by climbs of its controller, {step:g} of the box away"
    STATIONARY = "KKT residual {kkt_residual:.2g} over theta"
    STATIONARY_AT_KINK = (
        "KKT residual {kkt_residual:.2g} over theta and the controller together "
        "({kkt_residual_one_gradient:.2g} by the gradient of one side)"
    )
    NOT_CHALLENGED = "the second search for a controller at this theta found none to compare with"
    STARTED = "{tried}"
    NO_GLOBAL_CHECK = "{tried}, no global check over the box"
    NONE_BETTER = "{tried}, none better at {checked_at}"
    MOVED = "moved by the global check: the formulation ended at J = {objective_before:.6g}"
    CHECKED = "checked at {checked_at}"
    NOT_REPEATED = (
        "only {best_found} of {multistart:count controller start} ended at its controller"
    )
    MULTISTART = "a multi-start search at this theta ended at {local_optima_hz:distinct} Hz"
    MULTISTART_OF = (
        "a multi-start search for bandwidth at this theta ended at {local_optima_hz:distinct} Hz; "
        "from there the search of this figure ended at {value_shown}"
    )
    GAP_UNKNOWN = "gap not known"
    NO_GAP = "no bound on every controller, gap not known"
    GAP = (
        "no controller of any order exceeds {bandwidth_bound_hz:digits 4} Hz on {plants} here "
        "(gap at most {relative:100*.0f} %), gap over theta not known"
    )
    BUDGET = (
        "the search ended with its budget of {minutes:g} min, not searched: {not_searched:counts}"
    )
    LARGER_BUDGET = "a larger --budget continues from what is stored"
    # predicted
    NOT_PREDICTED = "not applicable: nothing was predicted: the search used true values"
    MISPREDICTED = "prediction and truth differ by {error:100*.2g} %, more than {tolerance:100*g} %"
    LEARNT = "the surrogate has learnt the design since"
    PREDICTED = "{what} predicted, error {error:share}"
    EXTRAPOLATES = "the surrogate extrapolates there: {outside}"
    LEFT_OUT = (
        "a surrogate without this design misses its {what} by {size:.2g} {unit} "
        "({left_out:100*.2g} %), {left_out_sigmas:.1f} times the error it expects"
    )
    LEFT_OUT_TOO_FAR = f"{LEFT_OUT}: do not use it here"
    COMPUTED = "the {what} itself is computed, not predicted"
    # survives
    NOT_PERTURBED = "the loop could not be perturbed"
    MODEL_UNSTABLE = "a second engine finds the loop unstable on the model itself"
    MODEL_PEAK = "a second engine finds a peak of S of {peak:.6g} on the model itself"
    STABLE_SHIFT = "stable for resonances {stable_range}"
    NARROW_SHIFT = f"{STABLE_SHIFT}, and +-{{least_shift:100*g}} % is the least to accept"
    NARROW_DAMPING = (
        "unstable where damping is not between {stable_damping[0]:.3g} and "
        "{stable_damping[1]:.3g} times the model's"
    )
    CONTROLLER_UNSTABLE = (
        "the controller by itself is unstable (poles at {unstable_controller_poles_hz:hz} Hz)"
    )
    CLOSER_UNSTABLE = "unstable on {model}"
    CLOSER_PEAK = "peak of S {peak:.3g} on {model}"
    WITHIN = "within S_max {S_max_range}"
    WITHIN_LOOSER = "within {factor:.6g} S_max {S_max_range}"
    SET_UNSTABLE = (
        "unstable within the [robust] set, at {shift:100*+.2g} %, damping x {damping:.3g}"
    )
    SET_KEPT = (
        "the [robust] set is kept ({plants} plants checked, worst peak of S {peak:.4g} at "
        "{shift:100*+.2g} %, damping x {damping:.3g})"
    )
    SET_NOT_KEPT = (
        "the [robust] set is not kept: peak of S {peak:.4g} at {shift:100*+.2g} %, "
        "damping x {damping:.3g}"
    )
    MODEL_ALONE = "judged on the model alone: [robust] names no plant"
    SET_WITHIN = "{within} on the [robust] set: {proof_of_set}"
    TRIED_WITHIN = "{within} on {plants:count plant} checked of the [robust] set"
    JUDGED_ON = (
        "checked on {plants:count plant} of the [robust] set: those that the search kept, its "
        "corners and points between"
    )
    ON_PLANTS = "on {plants:count plant} checked of the [robust] set"
    PROOF = "{words}"
    DRAWN = "of the [robust] set {words}"
    OTHER_DAMPING = "{words}"
    WORST_FOUND = "worst plant that a search found: {percent:.6g} % of a bound"
    NOT_ALONG = "the [robust] set is not kept all along its common resonance shift"
    DIFFERENTIATES = (
        "almost a differentiator: 1 N at rest moves the stage {static_compliance:in m 2}"
    )
    STATIC_SHARE = "|K(0)| is {static_share:100*.2g} % of |K| at the bandwidth"
    ROBUSTNESS_STABLE = "stable on all plants that robustness tried"
    ROBUSTNESS_UNSTABLE = "not stable on all plants that robustness tried"
    SHIFTS_UNSTABLE = "unstable for resonance shifts {unstable_shifts}"
    HARDWARE_UNSTABLE = (
        "{unstable} of {plants} plants with hardware within +-{tolerance:100*g} % unstable"
    )
    WORST_HARDWARE_UNSTABLE = f"{HARDWARE_UNSTABLE}, the worst that was searched is"
    ROBUSTNESS_TRIED = (
        "robustness tried shifts of +-{shift:100*g} %, damping times {damping[0]:g} to "
        "{damping[1]:g}, hardware within +-{tolerance:100*g} %"
    )
    # of a share of machines
    SHARE_SHOWN = "{claim}: judged on {draws:,} fresh draws, {failed} failed"
    SHARE_NOT_SHOWN = f"not shown {SHARE_SHOWN}"
    SHARE_LEAST = "{least:percent} % is shown"
    MAY_FAIL = "{allowed} may fail"
    BOX_NOT_JUDGED = "the whole box is not judged"
    # deployable
    DESIGNED_SAMPLED = (
        "designed and judged at {rate_hz:g} Hz with a delay of {delay_us:g} us, hold and delay "
        "exact; run deploy for the code"
    )
    BETWEEN = "S is {between_peak:.5g} at most between its samples"
    BETWEEN_ABOVE = (
        "S is {between_peak:.5g} between its samples, {beyond:100*.2g} % above S_max: sample faster"
    )
    NOT_DEPLOYED = "not judged yet: run deploy"
    DELAY_MARGIN = (
        "below {unstable_below_rate_hz:round 3} Hz hold and one sample of delay use up the delay "
        "margin of {delay_margin:in s 3}"
    )
    SHORTFALL = AT + "{words}"
    DEPLOYED = AT + LOOP
    DEPLOYED_ON_MODEL = AT + "on the model " + LOOP
    WORST_PLANT = "on the worst plant ({plant}) " + LOOP
    RUN_NOT_VERIFIED = "the run itself is not verified: {words}"
    SHARE_ALONE = "{claim}: judged here on the {plants} that it has kept alone"
    PEAK_ABOVE = (
        "hold and delay bring the peak of S {over:.2f} % above S_max = {S_max:g}{where}; "
        "a deployment may exceed it by {excess:100*.2g} %"
    )
    WEIGHTED_ABOVE = "|W_{name} {name}| of the code is {level:.3g} times weighted_level"
    MOVE_NOT_SETTLED = "a move within {force_limit:.4g} N does not settle"
    MOVE_UNKNOWN = "a move within {force_limit:.4g} N could not be simulated"
    ROUNDING = "rounding to {bits} bits moves y by {largest:in m 3} at most"
    ROUNDING_UNKNOWN = "no bound was found of what rounding to {bits} bits adds"


@dataclass(frozen=True)
class Finding:
    """A reason with the figures that its line does not have.

    Attributes
    ----------
    reason : Reason
    figures : mapping
        By name; None is a figure that is not finite, as result.json has it.
    """

    reason: Reason
    figures: Mapping[str, Any] = field(default_factory=dict)

    def words(self, line: Mapping[str, Any] | None = None) -> str:
        """Render the sentence with the figures.

        Parameters
        ----------
        line : mapping, optional
            Figures of its line.

        Returns
        -------
        str

        Examples
        --------
        >>> Reason.NORM(norm=1.5, norm_bound=2.0).words()
        'norm 1.5 <= 2'
        >>> Reason.LOCALLY_OPTIMAL(evidence="gap_unknown").words()
        'locally optimal: gap not known'
        """
        known = _Known({**(line or {}), **self.figures})
        return _Words().vformat(spoken(self.reason.sentence), (), known)

    @property
    def entry(self) -> dict[str, Any]:
        """The entry of `findings` in result.json."""
        return {"reason": self.reason.key, **self.figures}


class _Known(dict[str, Any]):
    """Figures, and what is derived from them."""

    def __missing__(self, name: str) -> str:
        return DERIVED[name](self)


class _Words(Formatter):
    def get_value(self, key: int | str, args: Sequence[Any], known: Mapping[str, Any]) -> Any:
        return known[str(key)]

    def format_field(self, value: Any, spec: str) -> str:
        name, _, more = spec.partition(" ")
        if name in FORMATS:
            return FORMATS[name](value, more)
        factor, product, own = spec.rpartition("*")
        value = math.nan if value is None else value
        return format(float(factor) * value if product else value, own)


def _quantity(value: float, more: str) -> str:
    unit, _, digits = more.rpartition(" ")
    return with_unit(value, unit, int(digits))


FORMATS: dict[str, Callable[[Any, str], str]] = {
    "count": plural,
    "counts": lambda counts, _: ", ".join(plural(n, name) for name, n in counts.items()),
    "digits": lambda value, more: number(value, int(more)),
    "distinct": lambda values, _: ", ".join(distinct_texts(values)),
    "hz": lambda values, _: ", ".join(f"{hz:.4g}" for hz in values[:3]),
    "in": _quantity,
    "list": lambda names, _: ", ".join(names),
    "percent": lambda share, _: f"{int(1e6 * share) / 1e4:g}",  # rounded down
    "round": lambda value, more: f"{float(f'{value:.{more}g}'):g}",
    "share": lambda share, _: small_share(share),
}


def within_words(excess: float, looseness: float) -> str:
    """Write which bounds hold on a box whose judge is loose, by its worst plant to six digits.

    Parameters
    ----------
    excess, looseness : float
        Of a bound, relative: on the worst plant, and what the judge allows.

    Returns
    -------
    str
    """
    if float(f"{100.0 + 100.0 * excess:.6g}") <= 100.0:
        return "within every bound"
    return f"no bound exceeded by more than {100.0 * looseness:g} %"


def _tried(known: Mapping[str, Any]) -> str:
    starts, optima = known["starts"], known["distinct_optima"]
    words = f"best of {plural(starts, 'start')}" if starts else "from one start"
    return f"{words}, {optima} distinct optima" if optima > 1 else words


def _checked_at(known: Mapping[str, Any]) -> str:
    fresh, own = known["box_fresh"], known["box_points"] - known["box_fresh"]
    found = [f"{fresh} other theta of the box"] * bool(fresh or not own)
    return " and ".join(found + [f"{own} of the run"] * bool(own))


def _sides(known: Mapping[str, Any]) -> str:
    """Describe the values beside a kink."""
    pairs = known["slopes"]
    if not pairs:
        return "was not evaluated beside it: bounds alone hold theta"
    found = [slope for pair in pairs for slope in pair]
    count = sum(slope is not None and math.isfinite(slope) for slope in found)
    if not count:
        return "is not known beside it"
    where = "both sides" if count == len(found) else f"the {count} known sides of {len(found)}"
    of = f" of {plural(len(pairs), 'direction')}" if len(pairs) > 1 else ""
    rises = "rises" if known["least_slope"] > 0.0 else "rises or stays"
    return f"{rises} on {where}{of}"


def _range(known: Mapping[str, Any], name: str) -> str:
    """Describe a range of resonance shifts in %; one that was not followed further has a "<" or
    ">"."""
    ends = [math.nan if end is None else end for end in known[name]]
    most = 0.999 * known["shift_followed_to"]
    beyond = [mark if abs(end) >= most else "" for mark, end in zip("<>", ends, strict=True)]
    shown = [inwards(100.0 * end, 2, 3) for end in ends]  # less is none
    return f"{beyond[0]}{shown[0]:+g} to {beyond[1]}{shown[1]:+g} %"


def _unstable_shifts(known: Mapping[str, Any]) -> str:
    (low, high), most = known["stable_between"], known["shift"]
    ends = [f"below {100.0 * low:+.2g} %"] * (low > -most)
    return " and ".join(ends + [f"above {100.0 * high:+.2g} %"] * (high < most))


PROVEN = {
    "kept": "proven",
    "unproven": "not every bound is proven",
    "searched": "searched, not proven",
}
DERIVED: dict[str, Callable[[Mapping[str, Any]], str]] = {
    "better_shown": lambda known: FIGURES[known["merit"]].format_value(known["better"]),
    "checked_at": _checked_at,
    "evidence_words": lambda known: Reason[known["evidence"].upper()]().words(known),
    "own_shown": lambda known: FIGURES[known["merit"]].format_value(known["own"]),
    "proof_of_set": lambda known: PROVEN[known["set"]],
    "S_max_range": lambda known: _range(known, "S_max_shift"),
    "sides": _sides,
    "stable_range": lambda known: _range(known, "stable_shift"),
    "tried": _tried,
    "unstable_shifts": _unstable_shifts,
    "value_shown": lambda known: FIGURES[known["merit"]].format_value(known["value"]),
    "where": lambda known: f" ({known['plant']})" if known["plant"] else "",
    "within": lambda known: within_words(known["worst_excess"], known["looseness"]),
}
