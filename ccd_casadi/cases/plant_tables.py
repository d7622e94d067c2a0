"""The tables [plant] and [theta.NAME] of a case file, whose keys depend on the plant, checked."""

import inspect
import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

from ccd_casadi.cases import checks
from ccd_casadi.cases.checks import Fail, KeyCheck, short_repr
from ccd_casadi.cases.tables import Case, Parameter, PlantTable
from ccd_casadi.plants.registry import model_named, model_names
from ccd_casadi.support import extensions

MEASURED = "measured"  # the model of `measured_case`, which has no θ
# Checks of a model's options that its builder's annotations do not say, by their names.
_OPTIONS: dict[str, KeyCheck] = {
    "zeta": checks.FRACTION,
    "poisson": checks.number(0.0, 0.5, "give a number between 0 and 0.5"),
    "modes": checks.count(1),
}

# Every key of a [theta.NAME], what is asked of it, and what it says.
KEYS: dict[str, tuple[KeyCheck, str]] = {
    "lower": (checks.ANY, "least value, in `unit`"),
    "upper": (checks.ANY, "largest value"),
    "start": (checks.ANY, "start of searches; default: the middle"),
    "unit": (checks.text, "unit, as the plant function takes it; shown in tables and on pages"),
    "values": (checks.listed, "instead of bounds: a list of values, as in a catalogue"),
    "integer": (checks.flag, "whole numbers between the bounds only; default false"),
    "fixed": (checks.ANY, "instead of bounds: its value, which is not searched"),
    "varies": (
        checks.flag,
        "sections: true: the loop holds at every value, as along a stroke; `start` is the model",
    ),
}


def plant_table(table: Mapping[str, Any], path: Path, fail: Fail) -> PlantTable:
    """[plant], files in it as absolute paths."""
    model, function = table.get("model"), table.get("function")
    if (model is None) == (function is None):
        has = "has neither" if model is None else "has both"
        raise fail("plant", f"{has} model and function; give either model or function")
    known = model_named(model) if isinstance(model, str) else None
    if known is None and isinstance(model, str) and model in extensions.SHIPPED["plants"]:
        raise fail("plant.model", extensions.missing(short_repr(model), "plants", model))
    if model is not None and known is None:
        hint = checks.closest(str(model), model_names())
        words = f"is {short_repr(model)}, not a known model{hint}; or use function"
        raise fail("plant.model", words)
    if function is not None and not callable(function):
        parts = function.rsplit(":", 1) if isinstance(function, str) else []
        if len(parts) != 2 or not parts[0].endswith(".py") or not parts[1].isidentifier():
            raise fail("plant.function", f'is {short_repr(function)}; write "my_plant.py:model"')
        function = f"{_absolute(path, parts[0], 'plant.function', fail)}:{parts[1]}"
    options = {key: value for key, value in table.items() if key not in ("model", "function")}
    takes = {} if known is None else dict(inspect.signature(known.build).parameters)
    own_checks = {} if known is None else known.checks
    for key, value in options.items():
        if not key.isidentifier():
            raise fail(f"plant.{key}", "is not a keyword; use a Python identifier")
        own = list(takes)[1:]
        if takes and key not in own:
            raise fail(f"plant.{key}", f"is not an option of {model}{checks.closest(key, own)}")
        usual = _check_of(takes[key]) if known is not None and known.annotated else _option
        wrong = own_checks.get(key, usual)(value)
        if wrong is not None:
            raise fail(f"plant.{key}", wrong)
    data = "" if known is None else known.data
    if data:
        if data not in options:
            raise fail(f"plant.{data}", f"is missing; add it, which {model} needs")
        options[data] = _absolute(path, options[data], f"plant.{data}", fail)
    return PlantTable(model, function, options)


def _absolute(case: Path, name: str, key: str, fail: Fail) -> str:
    """A file or folder that a case names, so that the resolved case means the same elsewhere; of a
    run folder that was copied the one beside the case."""
    with suppress(OSError, ValueError):
        given = Path(name)
        for place in (given, given.name if given.is_absolute() else given):
            if (found := (case.parent / place).resolve()).exists():
                return str(found)
    raise fail(key, f"there is no {short_repr(name)}; give its path relative to the case file")


def _check_of(option: inspect.Parameter) -> checks.Test:
    """Return the check of a builder's option, by its name or its annotation."""
    usual = (
        checks.names
        if option.annotation == Sequence[str]
        else checks.USUAL.get(option.annotation, _option)
    )
    return _OPTIONS.get(option.name, usual)


def _option(value: Any) -> str | None:
    if isinstance(value, float) and not math.isfinite(value):
        return f"is {value}; give a finite number"
    if checks.too_large(value):
        return f"is {short_repr(value)}; write it as a float"
    if isinstance(value, list):
        return next(filter(None, map(_option, value)), None)
    if isinstance(value, str | bool | int | float):
        return None
    return f"is {short_repr(value)}; give a number, text, true or false, or a list of them"


def theta_tables(
    table: Mapping[str, Any], model: str | None, of_case: tuple[str, ...], fail: Fail
) -> tuple[tuple[Parameter, ...], tuple[Parameter, ...]]:
    """[theta.NAME] of every parameter: searched ones; fixed ones, with those that vary.

    Those that a model of the package needs, those that [places] and [motor] name, and no other.
    """
    if not table:
        raise fail("theta", "names no parameter; add a table [theta.NAME]")
    found = [_parameter(name, entry, fail) for name, entry in table.items()]
    if all(parameter.values or parameter.varies for parameter in found):
        words = "has no parameter with a range: give one lower and upper, or ask inner for each"
        raise fail("theta", words)
    known = model_named(model)
    own = None if known is None else known.theta
    needed = (*(own or ()), *of_case)
    for name in () if own is None else table:
        if name not in needed:
            raise fail(
                f"theta.{name}", f"is not a parameter of {model}{checks.closest(name, needed)}"
            )
    for name in needed:
        if name not in table:
            which = "[places] or [motor] names" if name in of_case else f"{model} needs"
            words = f"is missing; add a table [theta.{name}], which {which}"
            raise fail(f"theta.{name}", words)
    free = tuple(p for p in found if len(p.values) != 1 and not p.varies)
    return free, tuple(p for p in found if p not in free)


def _parameter(name: str, entry: Any, fail: Fail, *, most_values: int = 100) -> Parameter:
    place = f"theta.{name}"
    if not name.isidentifier():
        raise fail(place, "is not an identifier; use letters, digits and _")
    if not isinstance(entry, Mapping):
        raise fail(place, f"is {short_repr(entry)}; write a table [theta.{name}]")
    checks.require_good(place, entry, {key: check for key, (check, _) in KEYS.items()}, fail)
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
        if last - first < 1 or last - first >= most_values:
            words = f"{lower:g} to {upper:g} holds {max(0, last - first + 1)} whole numbers"
            raise fail(f"{place}.integer", f"{words}; give bounds with 2 to {most_values}")
        values = tuple(float(value) for value in range(first, last + 1))
        lower, upper = values[0], values[-1]
        start = min(max(start, lower), upper)
    if len(values) > most_values:
        raise fail(f"{place}.values", f"has more than {most_values}; give lower and upper instead")
    return Parameter(name, lower, upper, start, unit, values, entry.get("varies", False))


def parse_theta(case: Case, text: str) -> tuple[float, ...]:
    """Read θ from a text.

    Parameters
    ----------
    case : Case
    text : str
        `m1=60,m2=60`.

    Returns
    -------
    tuple of float (n,)
        In the order of the case.

    Raises
    ------
    CaseError
        A name or a value is wrong or missing.
    """

    fail = partial(Fail(case.path), "--theta")
    names = [parameter.name for parameter in case.theta]
    found: dict[str, float] = {}
    for part in text.split(","):
        name, equals, value = (item.strip() for item in part.partition("="))
        if not equals:
            raise fail(
                f"{short_repr(part)} is not of the form name=value; give {'=..,'.join(names)}=.."
            )
        if held := next((p for p in case.fixed if p.name == name), None):
            how = "varies: every design holds at all of its values" if held.varies else "is fixed"
            raise fail(f"{name} {how}; leave it out, and give {'=..,'.join(names)}=..")
        if name not in names:
            raise fail(
                f"{short_repr(name)} is not a parameter of the case{checks.closest(name, names)}"
            )
        if name in found:
            raise fail(f"{name} is given twice; give it once")
        try:
            found[name] = float(value)
        except ValueError:
            raise fail(f"{name} = {short_repr(value)} is not a number; give one") from None
    for parameter in case.theta:
        if parameter.name not in found:
            raise fail(f"{parameter.name} is missing; give all of {', '.join(names)}")
        number = found[parameter.name]
        if not parameter.lower <= number <= parameter.upper:
            bounds = f"{parameter.lower:g} to {parameter.upper:g}"
            raise fail(f"{parameter.name} = {number:g} is outside its bounds; give {bounds}")
    return tuple(found[name] for name in names)
