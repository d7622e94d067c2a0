"""What speaks against a design: the lines of its verdict, concerns, and what may go wrong.

A loop may meet the bounds of its case and still exceed usual limits, lack the force for its move,
or the current of its motor; what must be known of its resonances; what if the machine is not its
model.
"""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

from ccd_casadi.analysis.loop_figures import LoopFigureOptions
from ccd_casadi.codesign.verdict import OwnSet, State, clauses_of
from ccd_casadi.drawing.content import VerdictRow
from ccd_casadi.fixed_structure.bounds import key_words, kind_and_channel
from ccd_casadi.support.text import inwards, number, plural, spoken, with_unit

LINES = ("certified", "optimal", "predicted", "survives", "deployable")


TIGHTENED = ("S_MAX", "S_LOW", "KS", "T", "GS")  # bounds that a key of the case states


class ConcernKind(StrEnum):
    """The reason why a decision is not an unconditional yes."""

    LINE_FAILED = "line_failed"
    LINE_WARNED = "line_warned"
    LINE_UNKNOWN = "line_unknown"
    NOT_VERIFIED = "not_verified"
    NOT_OPTIMAL = "not_optimal"
    MISPREDICTED = "mispredicted"
    MODEL_ALONE = "model_alone"
    SMALL_ERRORS = "small_errors"
    SURVIVAL_UNKNOWN = "survival_unknown"
    SET_UNPROVEN = "set_unproven"
    SET_SEARCHED = "set_searched"
    UNSTABLE_CONTROLLER = "unstable_controller"
    MOVE = "move"
    LATE = "late"
    CURRENT = "current"
    HEAT = "heat"
    LOOP = "loop"
    BETWEEN_LINES = "between_lines"
    BUDGET = "budget"


@dataclass(frozen=True)
class Concern:
    """A reason, in words for this design."""

    reason: ConcernKind
    words: str


USUAL = (  # figure of result.json, its usual least value, words; docs/verdict.md has the sources
    ("modulus_margin", 0.5, "the modulus margin is {:.3g} (usual: at least 0.5)"),
    ("phase_margin_deg", 30.0, "the phase margin is {:.3g} deg (usual: at least 30)"),
    ("gain_margin", 2.0, "the gain margin is {:.3g} (usual: at least 2)"),
)


@dataclass(frozen=True)
class ConcernOptions:
    """Usual limits of a loop beside those of `USUAL`."""

    slack: float = 0.01  # relative: a design lies on its bounds, and 2 is the usual S_max
    overshoot: float = 0.5  # of a step without feedforward
    between_lines: float = 1.1  # what |S| may reach between lines, over the largest on them
    identified: float = 0.05  # relative: how well resonances are known where nothing else is stated
    closed: float = 1e-3  # relative: above a bound, what counts as its proof
    open_by: float = 0.05  # relative: up to which a proof that did not close is worth its figure


def limited_move(result: Mapping[str, Any]) -> str:
    """Why the simulated move of `deploy --saturation` speaks against the design; empty where it
    settles.
    """
    move = _move(result)
    limit = spoken(f"{move.get('force_limit', 0.0):.4g} N")
    if move.get("state") == State.UNKNOWN:
        return f"whether the move settles within a limit of {limit} is not known"
    if move.get("state") != State.FAILED:
        return ""
    left = with_unit(move["left"], spoken("m"))
    words = f"limited to {limit} the move has not settled after {with_unit(move['time'], 's')}"
    return f"{words} ({left} left)"


def limited_move_remedy(result: Mapping[str, Any]) -> str:
    """Describe what to change where `limited_move` has words."""
    if _move(result).get("settles_unlimited", True):
        return "deploy with a larger --saturation, or a slower move"
    return "deploy with a slower move or a wider --window: it does not settle unlimited either"


def _move(result: Mapping[str, Any]) -> Mapping[str, Any]:
    return (result.get("verdict", {}).get("deployable") or {}).get("move") or {}


def resonance_condition(
    result: Mapping[str, Any], *, options: ConcernOptions = ConcernOptions()
) -> str:
    """How well the resonances have to be known, where no set of the case holds such an error; empty
    where the loop has room.
    """
    line = result.get("verdict", {}).get("survives", {})
    kept, held = line.get("S_max_shift"), line.get("set_shift")
    if kept is None or held is None:  # of an older run it is not known what its set holds
        return ""
    near = [
        abs(end) < options.identified and own == 0.0 for end, own in zip(kept, held, strict=True)
    ]
    low, high = (inwards(100.0 * end, 2, 3) for end in kept)
    if all(near):
        where = f"resonances lie within {low:+g} to {high:+g} % of their model"
    elif near[0]:
        where = f"no resonance is {f'more than {-low:g} % ' if low else ''}below its model"
    elif near[1]:
        where = f"no resonance is {f'more than {high:g} % ' if high else ''}above its model"
    else:
        return ""
    return f"Condition: {where}; else |S| exceeds S_max."


def loop_concerns(
    result: Mapping[str, Any], *, options: ConcernOptions = ConcernOptions()
) -> list[Concern]:
    """List what an engineer would object to in a loop that keeps the bounds of its case: its
    margins, its step and what is narrow or rings near the bandwidth, against the usual limits of
    the field.

    The step does not count where the case names the move that the stage makes.
    """
    found = [
        words.format(result[key])
        for key, least, words in USUAL
        if result.get(key) is not None and result[key] < (1.0 - options.slack) * least
    ]
    if "step_overshoot" in result and "move" not in result:
        overshoot = result["step_overshoot"]
        if overshoot > options.overshoot:
            usual = f"usual: at most {100.0 * options.overshoot:g}"
            found.append(f"a step overshoots by {100.0 * overshoot:.3g} % ({usual})")
        settled, followed = result["settling_ms"], LoopFigureOptions().periods
        if settled is None:
            found.append("a step does not settle within 2 %")
        elif settled * 1e-3 * result.get("bandwidth_hz", 0.0) > followed:
            late = f"only after {with_unit(1e-3 * settled, 's')}"
            found.append(f"a step settles {late}, {followed:g} periods of the bandwidth or more")
    own, warned = (
        [Concern(ConcernKind.LOOP, words) for words in each]
        for each in (found, result.get("loop_warnings", ()))
    )
    motor = (*current_concern(result), *heat_concern(result), *late_move_concern(result))
    return [*own, *line_concern(result, options), *motor, *warned]


def line_concern(
    result: Mapping[str, Any], options: ConcernOptions = ConcernOptions()
) -> list[Concern]:
    """List what |S| of a measured response may reach between its lines; empty where that is
    little."""
    reach = result.get("sensitivity_peak_between_lines")
    if reach is None or reach <= max(1.0, options.between_lines * result["sensitivity_peak"]):
        return []
    where = result.get("sensitivity_peak_between_lines_hz")
    at = "" if where is None else f" about {where:.4g} Hz"
    words = f"|S| may reach {reach:.3g} between two lines{at}"
    return [Concern(ConcernKind.BETWEEN_LINES, words)]


def current_concern(
    result: Mapping[str, Any], *, options: ConcernOptions = ConcernOptions()
) -> list[Concern]:
    """List what a move needs beyond the peak current of its motor; empty where it is enough."""
    move = result.get("move") or {}
    share = move.get("needed_share")
    if share is None or not share > 1.0 + options.slack:
        return []
    most, where = move["needed_current"] / share, ""
    if move["plants"] > 1 and move.get("needed_force_plant"):
        where = f" on the worst of {move['plants']} plants ({move['needed_force_plant']})"
    words = f"the move needs {move['needed_current']:.4g} A with feedforward and feedback{where}"
    return [Concern(ConcernKind.CURRENT, f"{words}, and peak_current is {most:.4g} A")]


def heat_concern(
    result: Mapping[str, Any], *, options: ConcernOptions = ConcernOptions()
) -> list[Concern]:
    """List what a move heats its motor by beyond what it allows, on the worst plant; empty where it
    allows it."""
    move = result.get("move") or {}
    share = move.get("needed_heat_share", 0.0)
    if share is None or not math.isfinite(share):
        return [Concern(ConcernKind.HEAT, "the heat that the move needs is not known")]
    if not share > 1.0 + options.slack:
        return []
    power, where = move["needed_power"], ""
    if move["plants"] > 1:
        where = f" on the worst of {move['plants']} plants ({move['needed_heat_plant']})"
    words = f"the move needs {power:.4g} W with feedforward and feedback{where}"
    return [Concern(ConcernKind.HEAT, f"{words}, and rms_power is {power / share:.4g} W")]


def late_move_concern(result: Mapping[str, Any]) -> list[Concern]:
    """List a move that settles, on the worst plant, only when the next one has begun; empty where
    it settles before, or where moves do not follow each other."""
    move = result.get("move") or {}
    if not move.get("dwell"):
        return []
    cycle, latest = move["duration"] + move["dwell"], move["settled_latest"]
    if latest is not None and latest <= cycle:
        return []
    when = "does not settle" if latest is None else f"settles after {with_unit(latest, 's')}"
    where = f" on the worst of {move['plants']} plants" if move["plants"] > 1 else ""
    words = f"the move {when}{where}, and the next one begins after {with_unit(cycle, 's')}"
    return [Concern(ConcernKind.LATE, words)]


def motor_remedies(result: Mapping[str, Any]) -> dict[ConcernKind, str]:
    """Say how a move leaves its motor what feedback needs, where the motor sets the acceleration:
    with limits stated lower by the share that is missing."""
    move = result.get("move") or {}
    limits, found = move.get("limits", ()), dict[ConcernKind, str]()
    heat, current = move.get("needed_heat_share"), move.get("needed_share")
    stated = "{} = {:g} in [motor], which leaves feedback its share"
    if "heat" in limits and heat:
        least = inwards(move["needed_power"] / heat**2, 3, 3)
        found[ConcernKind.HEAT] = stated.format("rms_power", least)
    if "peak force" in limits and current:
        least = inwards(move["needed_current"] / current**2, 3, 3)
        found[ConcernKind.CURRENT] = stated.format("peak_current", least)
    return found


def lines_of(result: Mapping[str, Any]) -> tuple[VerdictRow, ...]:
    """Read the lines of the verdict of result.json.

    Parameters
    ----------
    result : mapping

    Returns
    -------
    tuple of VerdictRow
        Empty for a run without a design, or older than verdicts.
    """
    verdict = result.get("verdict")
    if not isinstance(verdict, Mapping):
        return ()
    found = []
    for name in LINES:
        line = verdict.get(name)
        if isinstance(line, Mapping) and line.get("state") in set(State):
            words, *details = clauses_of(line)
            found.append(VerdictRow(name, str(line["state"]), words, tuple(details)))
    return tuple(found)


def worst_state(result: Mapping[str, Any]) -> State:
    """Find the worst state of a verdict: failed, then warned, then passed.

    Parameters
    ----------
    result : mapping
        Of result.json; an unknown line counts as none of them.

    Returns
    -------
    State
    """
    states = {line.state for line in lines_of(result)}
    return next((s for s in (State.FAILED, State.WARNED) if s in states), State.PASSED)


def why_unproven(result: Mapping[str, Any]) -> str | None:
    """Explain why `survives` is neither passed nor warned; None where it is one of them."""
    line = next((line for line in lines_of(result) if line.name == "survives"), None)
    if line is None or line.state != State.UNKNOWN:
        return None
    own = result["verdict"]["survives"].get("set")
    return "searched, not proven" if own == OwnSet.SEARCHED else "not known"


@dataclass(frozen=True)
class OpenBound:
    """What a proof over a set leaves open of its bounds, in words; empty where it is much."""

    words: str = ""
    remedy: str = ""


def open_bound(
    result: Mapping[str, Any], *, options: ConcernOptions = ConcernOptions()
) -> OpenBound:
    """Describe by how much the proof over the [robust] set misses bounds, and what closes it.

    A bound that is stated tighter by that share ends with a proof of the one that is needed: the
    search ends at its bounds, and the proof as far above them.

    Parameters
    ----------
    result : mapping
        Of result.json.
    options : ConcernOptions
        Numbers of the method.

    Returns
    -------
    OpenBound
    """
    line = result.get("verdict", {}).get("survives", {})
    levels = {key: math.inf if level is None else level
              for key, level in (line.get("proven") or {}).items()}  # fmt: skip
    over = max(levels.values(), default=math.inf) - 1.0
    if line.get("proof") != "looser" or not 0.0 < over <= options.open_by:
        return OpenBound()
    share = f"{math.ceil(1e5 * over - 1e-6) / 1e3:g} %"  # never less than it is
    least = min(1.0 + options.closed, max(levels.values()))
    above = [name for name, level in levels.items() if level >= least]
    many = len(above) > 1
    words = (
        f"on the whole [robust] set {', '.join(map(key_words, above))} {'are' if many else 'is'} "
        f"proven only up to {share} above {'their bounds' if many else 'its bound'} (the "
        f"{plural(line['plants'], 'plant')} checked of it keep their bounds)"
    )
    accept = f"accept these {share}"
    keys = [key_words(name) for name in above if kind_and_channel(name)[0] in TIGHTENED]
    if keys:
        accept += f", or state {', '.join(keys)} {share} tighter than you need"
    return OpenBound(words, f"{accept}; a smaller [robust] set needs fewer boxes of the proof")


def percent_words(share: float, digits: int) -> str:
    """A share in percent, without the sign of a zero."""
    rounded = round(100.0 * share, digits)
    return f"{rounded + 0.0:.{digits}f}"


def what_if(result: Mapping[str, Any], shift: float, gain: float) -> Iterator[tuple[str, str]]:
    """If and then: the loop where all resonances, or the plant's gain, are off their model by these
    shares.
    """
    line = result.get("verdict", {}).get("survives", {})
    percent = f"{100.0 * shift:g} %"
    for word, end, sign in (("lower", 0, -1.0), ("higher", 1, 1.0)):
        stable, kept = line.get("stable_shift"), line.get("S_max_shift")
        if stable is not None and kept is not None:
            then = f"unstable: it is stable to {100.0 * stable[end]:+.3g} %"
            if sign * stable[end] >= shift:
                kept_to = percent_words(abs(kept[end]), 1)
                then = "stable, and |S| exceeds S_max"
                then += f" from {kept_to} % on" if float(kept_to) else " at once"
            if sign * kept[end] >= shift:
                then = "stable and within S_max"
            yield f"all resonances are {percent} {word}", then
    margin = line.get("gain_margin")
    if margin is not None:
        low, high = margin
        fails = not low <= 1.0 - gain <= 1.0 + gain <= high
        then = "unstable" if fails else "stable"
        most = f"; on the model it may be {number(low, 2)} to {number(high, 3)} times as large"
        yield f"the plant's gain is off by {100.0 * gain:g} %", then + most
    late, deploy = result.get("delay_margin_us"), result.get("verdict", {}).get("deployable", {})
    rate = deploy.get("rate_hz")
    if late is not None and rate:
        period = 1e6 / rate
        then = "stable" if late > period else "unstable"
        yield (
            "one sample more of delay",
            f"{then}; the delay margin is {number(late / period, 3)} samples",
        )


def risks(
    result: Mapping[str, Any], *, identified: float = 0.1, least_shift: float = 0.005
) -> list[str]:
    """What may go wrong, the most serious first; what has no check is among them. Resonances are
    taken to be known to `identified`, and none better than to `least_shift`, relative.
    """
    found = [
        f"{line.name} {line.state}: {line.words}" for line in lines_of(result)
        if line.state == State.FAILED
    ]  # fmt: skip
    survives = result.get("verdict", {}).get("survives", {})
    if why_unproven(result) is not None:
        found.append(f"The [robust] set is {why_unproven(result)}.")
    elif survives.get("set") == "unproven":
        found.append("The bounds are kept on all plants that were drawn from the [robust] set, and "
                     "are not proven on all of it.")  # fmt: skip
    elif not survives.get("robust_set"):
        found.append("The case names no [robust] set: the loop is judged on its model alone.")
    found += [f"{one.words[:1].upper()}{one.words[1:]}." for one in loop_concerns(result)]
    if (result.get("time_budget") or {}).get("ended"):
        found.append("The search was ended by its time budget: a better design may exist.")
    if "deployable" in result.get("verdict", {}):
        unknown = result["verdict"]["deployable"]["state"] == State.UNKNOWN
        found += ["Hold and delay of the real-time system are not judged yet."] * unknown
    shift = survives.get("S_max_shift")
    if shift is not None and min(abs(end) for end in shift) < identified:
        ends = f"{percent_words(shift[0], 1)} to +{percent_words(shift[1], 1)} %"
        at_once = min(abs(end) for end in shift) < least_shift
        words = f"|S| stays within S_max for resonances {ends} off their model"
        if at_once:
            words = "|S| exceeds S_max as soon as a resonance is off its model to one side"
        found.insert(0 if at_once else len(found), f"{words}: identify them that well.")
    phase, gain = result.get("phase_margin_deg"), result.get("gain_margin")
    if phase is not None and gain is not None:
        margins = f"{number(phase, 3)}° of phase and a gain of {number(gain, 3)}, up or down"
        found.append(f"The least margins are {margins}; unmodelled dynamics use them up.")
    found.append("Friction, saturation and noise are in no figure of this page unless [move] or "
                 "[budget] names them.")  # fmt: skip
    return found
