"""What happens if the machine is not its model, and what may go wrong: for the brief of a run."""

from collections.abc import Iterator, Mapping
from typing import Any

from ccd_casadi.codesign.verdict import State
from ccd_casadi.reporting.concerns import loop_concerns
from ccd_casadi.reporting.decision import lines_of, unproven
from ccd_casadi.support.text import number


def percent_words(share: float, digits: int) -> str:
    """A share in percent, without the sign of a zero."""
    rounded = round(100.0 * share, digits)
    return f"{rounded + 0.0:.{digits}f}"


def what_if(result: Mapping[str, Any], shift: float, gain: float) -> Iterator[tuple[str, str]]:
    """What becomes of the loop where the machine differs from its model.

    Parameters
    ----------
    result : mapping
        Of result.json.
    shift, gain : float
        Of all resonances, and of the whole plant, relative.

    Yields
    ------
    (str, str)
        If, then.
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
    """What may go wrong, the most serious first; what has no check is among them.

    Parameters
    ----------
    result : mapping
        Of result.json.
    identified, least_shift : float
        Relative: resonances are known that well; and below which none is known.

    Returns
    -------
    list of str
        Sentences.
    """
    found = [
        f"{line.name} {line.state}: {line.words}" for line in lines_of(result)
        if line.state == State.FAILED
    ]  # fmt: skip
    survives = result.get("verdict", {}).get("survives", {})
    if unproven(result) is not None:
        found.append(f"The [robust] set is {unproven(result)}.")
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
