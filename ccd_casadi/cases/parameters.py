"""[theta.NAME]: the hardware parameters of a case: free within bounds, one of a list, or fixed."""

import math
from collections.abc import Mapping
from typing import Any

from ccd_casadi.cases.checks import ANY, Check, Fail, flag, listed, require_good, short_repr, text
from ccd_casadi.cases.tables import Parameter

MOST_VALUES = 100  # of a list: more are better taken as a range, and rounded

# Every key of a [theta.NAME], what is asked of it, and what it says.
KEYS: dict[str, tuple[Check, str]] = {
    "lower": (ANY, "least value, in `unit`"),
    "upper": (ANY, "largest value"),
    "start": (ANY, "start of searches; default: the middle"),
    "unit": (text, "unit, as the plant function takes it; shown in tables and on pages"),
    "values": (listed, "instead of bounds: a list of values, as in a catalogue"),
    "integer": (flag, "whole numbers between the bounds only; default false"),
    "fixed": (ANY, "instead of bounds: its value, which is not searched"),
    "varies": (
        flag,
        "with sections: true: not chosen; the loop holds at every value, as along a stroke; "
        "`start` is the model",
    ),
}


def parameters_of(
    table: Mapping[str, Any], fail: Fail
) -> tuple[tuple[Parameter, ...], tuple[Parameter, ...]]:
    """The parameters that are searched, and the fixed ones, with those that vary."""
    if not table:
        raise fail("theta", "names no parameter; add a table [theta.NAME]")
    found = [_parameter(name, entry, fail) for name, entry in table.items()]
    if all(parameter.values or parameter.varies for parameter in found):
        words = "has no parameter with a range: give one lower and upper, or ask inner for each"
        raise fail("theta", words)
    free = tuple(p for p in found if len(p.values) != 1 and not p.varies)
    return free, tuple(p for p in found if p not in free)


def _parameter(name: str, entry: Any, fail: Fail) -> Parameter:
    place = f"theta.{name}"
    if not name.isidentifier():
        raise fail(place, "is not an identifier; use letters, digits and _")
    if not isinstance(entry, Mapping):
        raise fail(place, f"is {short_repr(entry)}; write a table [theta.{name}]")
    require_good(place, entry, {key: check for key, (check, _) in KEYS.items()}, fail)
    unit = entry.get("unit", "")
    for key, others in (("fixed", ("values", "lower", "upper", "start", "integer", "varies")),
                        ("values", ("lower", "upper", "integer", "varies")),
                        ("integer", ("varies",))):  # fmt: skip
        beside = [other for other in others if key in entry and other in entry]
        if beside:
            raise fail(f"{place}.{beside[0]}", f"has no place beside {key}; drop it")
    if "fixed" in entry:
        value = float(entry["fixed"])
        return Parameter(name, value, value, value, unit, (value,))
    values = tuple(sorted({float(value) for value in entry.get("values", ())}))
    if "values" in entry and len(values) < 2:
        raise fail(f"{place}.values", "needs two different numbers or more; or give fixed")
    bounds = {"lower": values[0], "upper": values[-1]} if values else entry
    for key in ("lower", "upper"):
        if key not in bounds:
            raise fail(f"{place}.{key}", "is missing; add it")
    lower, upper = float(bounds["lower"]), float(bounds["upper"])
    if lower > upper:
        raise fail(f"{place}.lower", f"{lower:g} is above upper = {upper:g}; swap them")
    if lower == upper or not math.isfinite(upper - lower):
        words = f"{lower:g} to {upper:g} is not a range; widen it, or give fixed"
        raise fail(f"{place}.lower", words)
    start = float(entry.get("start", 0.5 * lower + 0.5 * upper))
    if not lower <= start <= upper:
        words = f"{start:g} is outside {lower:g} to {upper:g}; give a start within the bounds"
        raise fail(f"{place}.start", words)
    if entry.get("integer", False):
        first, last = math.ceil(lower), math.floor(upper)
        if last - first < 1 or last - first >= MOST_VALUES:
            words = f"{lower:g} to {upper:g} holds {max(0, last - first + 1)} whole numbers"
            raise fail(f"{place}.integer", f"{words}; give bounds with 2 to {MOST_VALUES}")
        values = tuple(float(value) for value in range(first, last + 1))
        lower, upper = values[0], values[-1]
        start = min(max(start, lower), upper)
    if len(values) > MOST_VALUES:
        raise fail(f"{place}.values", f"has more than {MOST_VALUES}; give lower and upper instead")
    return Parameter(name, lower, upper, start, unit, values, entry.get("varies", False))
