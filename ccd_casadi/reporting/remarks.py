"""What a decision to build adds, and what is not an objection: bounds of θ that hold the design,
requirements with nothing left that another plant or rounding exceeds, and the worst plant's move.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from ccd_casadi.codesign.requirements import Evidence
from ccd_casadi.reporting.concerns import open_bound
from ccd_casadi.support.text import with_unit


@dataclass(frozen=True)
class RemarkOptions:
    """Limits of what is remarked."""

    left: float = 1e-3  # relative: a margin below it is none
    later: float = 1.05  # settling on the worst plant over that on the model, to be worth a word


def remarks(
    result: Mapping[str, Any], *, options: RemarkOptions = RemarkOptions()
) -> tuple[str, ...]:
    """List what whoever builds a design has to know besides, a sentence each.

    A requirement is at its limit at an optimum. It is named only where its figure is of plants
    that were searched, or of θ, which is rounded when it is made.

    Parameters
    ----------
    result : mapping
        Of result.json.
    options : RemarkOptions
        Numbers of the method.

    Returns
    -------
    tuple of str
    """
    return (*_worst_move(result, options), *_at_bounds(result), *_without_margin(result, options))


def _at_bounds(result: Mapping[str, Any]) -> Iterator[str]:
    theta, units = result.get("theta", {}), result.get("units", {})
    found: list[str] = []
    for held in result.get("active", ()):
        name, _, end = held.rpartition(" ")
        if name in theta and end in ("lower", "upper"):
            at = with_unit(theta[name], units.get(name, ""), 5).strip()
            found.append(f"{name} {'' if found else 'is '}at its {end} bound {at}")
    if found:
        yield f"{', '.join(found)}: a wider range may be better."


def _without_margin(result: Mapping[str, Any], options: RemarkOptions) -> Iterator[str]:
    tight = [
        one for one in result.get("requirements", ())
        if one["margin"] is not None and one["margin"] < options.left
    ]  # fmt: skip
    searched = [one["name"] for one in tight if one["evidence"] == Evidence.SEARCHED]
    if searched and not open_bound(result).words:  # which states how far they are proven
        yield (
            f"Nothing is left of {_listed(searched)} on the plants that were checked: another "
            "plant of the [robust] set may exceed it."
        )
    of_theta = [
        one["name"] for one in tight
        if one["required"] == 0.0 and one["evidence"] == Evidence.JUDGED
    ]  # fmt: skip
    if of_theta:
        what = "constraint {} binds: round theta so that it still holds."
        if len(of_theta) > 1:
            what = "constraints {} bind: round theta so that they still hold."
        yield f"The {what.format(_listed([f'“{name}”' for name in of_theta]))}"


def _worst_move(result: Mapping[str, Any], options: RemarkOptions) -> Iterator[str]:
    move = result.get("move") or {}
    if move.get("plants", 1) < 2 or move.get("settled") is None:
        return
    own, latest = move["settled"], move["settled_latest"]
    worst = f"on the worst of the {move['plants']} plants that it is designed on"
    words = f"The move settles after {with_unit(own, 's')} on the model"
    if latest is None:
        yield f"{words}, and {worst} not while it was followed."
    elif latest > options.later * own:
        yield f"{words}, and after {with_unit(latest, 's')} {worst}."


def _listed(names: list[str]) -> str:
    """Write names in a row, the last after "and"."""
    return " and ".join(filter(None, [", ".join(names[:-1]), names[-1]]))
