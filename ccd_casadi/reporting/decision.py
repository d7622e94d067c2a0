"""What a decision adds to the five lines: the move at its force limit, and what must be known."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from ccd_casadi.codesign.verdict import State
from ccd_casadi.support.text import inwards, spoken, with_unit


@dataclass(frozen=True)
class ConditionOptions:
    """Numbers of the conditions.

    Attributes
    ----------
    identified : float
        Relative: how well resonances are known where nothing else is stated.
    """

    identified: float = 0.05


def limited_move(result: Mapping[str, Any]) -> str:
    """Why the simulated move of `deploy --saturation` speaks against the design.

    Parameters
    ----------
    result : mapping
        Of result.json.

    Returns
    -------
    str
        Words; empty where the move settles, and where no limit was given.
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
    """What to change where `limited_move` has words.

    Parameters
    ----------
    result : mapping
        Of result.json.

    Returns
    -------
    str
        A step.
    """
    if _move(result).get("settles_unlimited", True):
        return "deploy with a larger --saturation, or a slower move"
    return "deploy with a slower move or a wider --window: it does not settle unlimited either"


def _move(result: Mapping[str, Any]) -> Mapping[str, Any]:
    return (result.get("verdict", {}).get("deployable") or {}).get("move") or {}


def resonance_condition(
    result: Mapping[str, Any], *, options: ConditionOptions = ConditionOptions()
) -> str:
    """How well the resonances have to be known, where no set of the case holds such an error.

    Parameters
    ----------
    result : mapping
        Of result.json.
    options : ConditionOptions

    Returns
    -------
    str
        A sentence; empty where the loop has room, or the case names an error that it holds.
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
