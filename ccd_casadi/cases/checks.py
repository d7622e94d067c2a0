"""Checks of single values in a case file: None where a value is good, else what is wrong and what
to give instead. Each carries what JSON Schema can say of the same, for editors (`schema`)."""

import difflib
import math
from collections.abc import Callable, Collection, Mapping
from dataclasses import MISSING, Field, dataclass, field
from pathlib import Path
from typing import Any, get_args

from ccd_casadi.support.errors import UserError
from ccd_casadi.support.options import one_line

LARGEST, SMALLEST = 1e30, 1e-30  # beyond them squares and products leave double precision
Test = Callable[[Any], str | None]  # what is wrong with a value; None where nothing is


class CaseError(UserError):
    """One line: file, key, what is wrong, what to do."""


@dataclass(frozen=True)
class Fail:
    """Make the error of a case file from a key and what is wrong.

    Attributes
    ----------
    path : Path
        The case file.
    """

    path: Path

    def __call__(self, key: str, words: str) -> CaseError:
        return CaseError(one_line(f"{self.path}: {key}: {words}"))


@dataclass(frozen=True)
class KeyCheck:
    """A check, called with a value, and its JSON Schema, which may let more pass."""

    test: Test
    schema: Mapping[str, Any] = field(default_factory=dict)

    def __call__(self, value: Any) -> str | None:
        """Return what is wrong with the value, None where nothing is."""
        return self.test(value)


def _good(schema: Mapping[str, Any], good: Callable[[Any], bool], remedy: str) -> KeyCheck:
    """A check whose message is the value and the remedy."""
    return KeyCheck(
        lambda value: None if good(value) else f"is {short_repr(value)}; {remedy}", schema
    )


def _list(items: Mapping[str, Any], least: int = 0, most: int | None = None) -> dict[str, Any]:
    schema: dict[str, Any] = {"type": "array", "items": items, "minItems": least}
    return schema if most is None else schema | {"maxItems": most}


def several(value: Any) -> Any:
    """A list as it is, another value as the only one of a list."""
    return value if isinstance(value, list | tuple) else [value]


def number(low: float, high: float, remedy: str, *, closed: bool = False) -> KeyCheck:
    """Make the check of a number.

    Parameters
    ----------
    low, high : float
        Bounds, exclusive.
    remedy : str
        What to give.
    closed : bool
        Include `low`.

    Returns
    -------
    KeyCheck
    """

    def check(value: Any) -> str | None:
        if isinstance(value, bool) or not isinstance(value, int | float):
            return f"is {short_repr(value)}, not a number; {remedy}"
        if too_large(value) or not math.isfinite(value):
            return f"is {short_repr(value)}; {remedy}"
        if not (low < value < high or (closed and value == low)):
            return f"is {value:g}; {remedy}"
        if abs(value) > LARGEST or (not closed and 0.0 in (low, high) and abs(value) < SMALLEST):
            return f"is {value:g}; give a size from {SMALLEST:g} to {LARGEST:g}, in another unit"
        return None

    schema: dict[str, Any] = {"type": "number"}
    if math.isfinite(low):
        schema["minimum" if closed else "exclusiveMinimum"] = low
    if math.isfinite(high):
        schema["exclusiveMaximum"] = high
    return KeyCheck(check, schema)


def signed(remedy: str) -> KeyCheck:
    """A number of either sign, but none that is lost beside others."""
    finite = number(-math.inf, math.inf, remedy)

    def check(value: Any) -> str | None:
        wrong = finite(value)
        if wrong is not None or not 0.0 < abs(value) < SMALLEST:
            return wrong
        return f"is {value:g}; give a size from {SMALLEST:g} to {LARGEST:g}, in another unit"

    return KeyCheck(check, finite.schema)


def count(least: int) -> KeyCheck:
    """A whole number, which `true` is not."""
    return _good(
        {"type": "integer", "minimum": least},
        lambda value: type(value) is int and least <= value and not too_large(value),
        f"give a whole number of at least {least}",
    )


def choice(*names: str) -> KeyCheck:
    """Make the check of one of some texts.

    Parameters
    ----------
    *names : str

    Returns
    -------
    KeyCheck
    """
    return _good({"enum": list(names)}, names.__contains__, f"choose one of {', '.join(names)}")


text = _good({"type": "string"}, lambda v: isinstance(v, str), "give a text in quotes")
flag = _good({"type": "boolean"}, lambda v: isinstance(v, bool), "give true or false")
table = _good(
    {"type": "object"},
    lambda value: (
        isinstance(value, Mapping) and all(isinstance(v, Mapping) for v in value.values())
    ),
    "write tables of that name",
)
tables = _good(
    {"anyOf": [{"type": "object"}, _list({"type": "object"})]},
    lambda value: all(isinstance(item, Mapping) for item in several(value)),
    "write a table, or several in double brackets",
)


def every(item: KeyCheck, remedy: str, least: int = 0, most: int | None = None) -> KeyCheck:
    """A list of so many items that all pass a check; `remedy` says what to give."""

    def good(value: Any) -> bool:
        if not isinstance(value, list | tuple) or any(item(each) is not None for each in value):
            return False
        return least <= len(value) <= (math.inf if most is None else most)

    return _good(_list(item.schema, least, most), good, remedy)


def too_large(value: Any) -> bool:
    """TOML's integers have 64 bits; Python's parser takes any, and neither float nor repr do."""
    return isinstance(value, int) and abs(value) >= 2**63


def short_repr(value: Any) -> str:
    if too_large(value):
        return "an integer of more than 64 bits"
    try:
        text = repr(list(value) if isinstance(value, tuple) else value)
    except (ValueError, RecursionError):  # a huge integer or a very deep array inside
        return "a value too long to show"
    return text if len(text) < 60 else text[:57] + "..."


ANY = number(-math.inf, math.inf, "give a finite number")
POSITIVE = number(0.0, math.inf, "give a number above 0")
NOT_NEGATIVE = number(0.0, math.inf, "give 0 or more", closed=True)
FRACTION = number(0.0, 1.0, "give a number between 0 and 1, both exclusive")
DAMPING = number(0.0, 1.0, "give a damping ratio from 0 to below 1", closed=True)
ABOVE_ONE = number(1.0, 1e7, "give a number above 1 and below 1e7")


def _one_or_more(remedy: str, low: float = 0.0, high: float = math.inf) -> KeyCheck:
    """A number above 0 from `low` to `high`, or a list of them."""

    def good(value: Any) -> bool:
        all_of = several(value)
        return bool(all_of) and all(POSITIVE(v) is None and low <= v <= high for v in all_of)

    return _good({"anyOf": [POSITIVE.schema, _list(POSITIVE.schema, 1)]}, good, remedy)


one_or_more = _one_or_more("give a number above 0, or a list of them")
corners_hz = _one_or_more(
    "give Hz from 0.01 to 1e7, or a list of them; leave out what is faster", 1e-2, 1e7
)
damping_ratios = _one_or_more(
    "give a damping ratio from 0.001 to 100, or a list of them", 1e-3, 100.0
)
_pair = every(POSITIVE, "", 2, 2)
interval = _good(
    _pair.schema,
    lambda value: _pair(value) is None and value[0] < value[1],
    "give two positive numbers [low, high] with low < high",
)
points = every(count(2), "give two whole numbers of at least 2", 2, 2)
steps = every(FRACTION, "give a list of numbers between 0 and 1, both exclusive", 1)
factors = every(
    number(0.01, 20.0, ""), "give factors between 0.01 and 20, such as [0.5, 2] for half to twice"
)
numbers = every(ANY, "give a list of numbers", 1)
direction = _good(
    numbers.schema,
    lambda value: numbers(value) is None and any(value),
    "give a list of numbers, one for each, that are not all 0",
)
listed = KeyCheck(numbers.test, _list(ANY.schema, 2))
named = _good({"type": "string", "minLength": 1}, lambda v: bool(v) and isinstance(v, str), "")
_named_or_table = KeyCheck(
    lambda value: None if isinstance(value, Mapping) else named(value),
    {"type": ["string", "object"], "minLength": 1},
)
plant_options = every(_named_or_table, "give a list of file names in quotes, or of tables")
names = every(KeyCheck(text.test, named.schema), "give a list of texts in quotes", 1)
coordinate = KeyCheck(
    lambda value: (
        None if isinstance(value, str) and value.removeprefix("-").isidentifier() else ANY(value)
    ),
    {"type": ["number", "string"]},
)
places = every(
    every(coordinate, "", 1, 3), 'give rows of numbers and names of [theta], as [["x", 0.1]]'
)
names_of_theta = every(named, "give a list of names of [theta] in quotes")
numbers_of_modes = every(count(1), "give a list of whole numbers from 1")


def by_name(item: KeyCheck) -> KeyCheck:
    """Make the check of a table whose values all pass a check."""

    def check(value: Any) -> str | None:
        if not isinstance(value, Mapping) or not value:
            return f"is {short_repr(value)}; give a table of values by name"
        wrong = ((name, item(each)) for name, each in value.items())
        return next((f"{name} {words}" for name, words in wrong if words is not None), None)

    return KeyCheck(check, {"type": "object", "additionalProperties": dict(item.schema)})


def rows(width: int) -> KeyCheck:
    """Make the check of a list of rows of numbers.

    Parameters
    ----------
    width : int
        Numbers of a row.

    Returns
    -------
    KeyCheck
    """
    return every(every(ANY, "", width, width), f"give a list of rows of {width} numbers")


def _text_or_rows(value: Any) -> str | None:
    first = value[0] if isinstance(value, list | tuple) and value else None
    width = len(first) if isinstance(first, list | tuple) and first else 1
    return None if isinstance(value, str) else rows(width)(value)


text_or_rows = KeyCheck(
    _text_or_rows, {"anyOf": [{"type": "string"}, _list(_list({"type": "number"}, 1, 3))]}
)


def closest(name: str, known: Collection[str]) -> str:
    """The end of a message: the known name nearest to a mistyped one, else all of them."""
    near = difflib.get_close_matches(name, known, 1)
    return f"; did you mean {near[0]}?" if near else f"; known are {', '.join(known)}"


USUAL = {float: POSITIVE, int: count(0), bool: flag, str: text}  # checks of a key, by its type
SUFFIXES = {"_hz": "Hz", "_us": "µs", "_ms": "ms"}


def key(
    says: str, default: Any = MISSING, *, check: KeyCheck | None = None, unit: str = "",
    idle: Any = None, needed: bool = False,
) -> Any:  # fmt: skip
    """The field of a table's dataclass that a key is; `check` where its type has another one.

    `idle`: what a required key is where it has no effect, and is not given. `needed`: a table that
    is given needs this key of no default.
    """
    metadata = {"check": check, "says": says, "unit": unit, "idle": idle, "needed": needed}
    if default is MISSING:
        return field(metadata=metadata)
    return field(default=default, metadata=metadata)


def check_of(item: Field[Any]) -> KeyCheck:
    """Return a key's own check, or the usual one of its type: a number above 0, a count, true or
    false, a text."""
    kind: Any = (*get_args(item.type), item.type)[0]
    return item.metadata["check"] or USUAL[kind]


def unit_of(item: Field[Any]) -> str:
    """Return a key's own unit, or the one that its name ends with."""
    return item.metadata["unit"] or SUFFIXES.get(item.name[-3:], "")


def require_good(
    place: str, table: Mapping[str, Any], checks: Mapping[str, Test], fail: Fail
) -> None:
    """Check every key of a table.

    Parameters
    ----------
    place : str
        Name of the table; empty for a whole file.
    table : mapping
    checks : mapping
        Key -> check.
    fail : Fail

    Raises
    ------
    CaseError
        Of the first key that is unknown, or whose value is wrong.
    """
    for name, value in table.items():
        key = f"{place}.{name}" if place else name
        if name not in checks:
            raise fail(key, f"unknown key{closest(name, checks)}")
        wrong = checks[name](value)
        if wrong is not None:
            raise fail(key, wrong)
