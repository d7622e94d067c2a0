"""The case file: TOML into frozen dataclasses, every mistake in one line that says the remedy.

And back: a case as TOML, its keys as JSON Schema and as a page of Markdown. Schema and page are
made from the fields of `TABLES`: their types, defaults and metadata (`says`, `unit`, `check`,
`idle`), with which a case is also read and checked. `case_problem` makes of a case the
problem in SI that the lower layers take.
"""

import json
import re
import tomllib
from collections.abc import Collection, Mapping
from dataclasses import MISSING, Field, fields, replace
from functools import partial
from pathlib import Path
from typing import Any

from ccd_casadi.cases import checks
from ccd_casadi.cases.checks import CaseError, Fail, check_of, short_repr, unit_of
from ccd_casadi.cases.controller_kinds import check_kind, idle_keys
from ccd_casadi.cases.controller_tables import ChannelTable, check_filters, check_motion
from ccd_casadi.cases.plant_tables import KEYS as THETA
from ccd_casadi.cases.plant_tables import MEASURED, plant_table, theta_tables
from ccd_casadi.cases.tables import REQUIRED, TABLES, BudgetTable, Case, PlacesTable
from ccd_casadi.plants.registry import model_names
from ccd_casadi.support.errors import UserError
from ccd_casadi.support.options import DEFAULT_CASE, one_line
from ccd_casadi.support.text import package_text, template

TWO_MASS = Path(__file__).parents[1] / "templates" / "two_mass.toml"  # ships with the package
EXAMPLE = "ccd solve my_case.toml (docs/tutorial.md writes one)"


# Which weight must lie below which: else it asks for nothing (W_S) or for the opposite (W_T).
_ORDERED_WEIGHTS = (
    ("A_S", "M_S", "W_S asks for more at low frequency"),
    ("A_u", "A_l", "W_T asks for a roll-off"),
)
# What is one number for all channels, and where those of single channels go.
_OF_THE_WHOLE = ("S_max", "weighted_level", *(item.name for item in fields(TABLES["weights"])))
_PER_CHANNEL = (
    "give a number, the whole loop's: S_max, M_K and bandwidth_ratio of a channel go in a table "
    '[controller.channel.NAME] with controller.structure = "sections"'
)


def load_case(path: str | Path) -> Case:
    """Read and check a case file.

    Parameters
    ----------
    path : path
        The TOML file.

    Returns
    -------
    Case

    Raises
    ------
    CaseError
        On the first mistake, with its key and what is wrong.

    Examples
    --------
    >>> load_case(TWO_MASS).theta[0].table
    {'lower': 55.0, 'upper': 70.0, 'start': 67.56, 'unit': 'kg'}
    """
    path = Path(path)
    return parse_case(read_toml(path), path)


def read_toml(path: Path) -> dict[str, Any]:
    """Read the tables of a case file, unchecked.

    Parameters
    ----------
    path : Path

    Returns
    -------
    dict

    Raises
    ------
    CaseError
        It is not TOML.
    """

    def fail(words: str) -> CaseError:
        return CaseError(one_line(f"{path}: {words}"))

    try:
        text = path.read_bytes().decode("utf-8-sig")  # some editors write a byte-order mark
    except FileNotFoundError:
        words = "there is no such file; name a case file (TOML)"
        if str(path) == DEFAULT_CASE:
            words = (
                f"there is no such file: it is the default in a clone of the project, and none was "
                f"named; name a case file of your own: {EXAMPLE}"
            )
        raise fail(words) from None
    except UnicodeDecodeError as error:
        line = error.object.count(b"\n", 0, error.start) + 1
        raise fail(f"line {line} is not UTF-8 text; save the file as UTF-8") from None
    except IsADirectoryError:
        raise fail(f"is a folder; name a case file in it, such as {path / 'case.toml'}") from None
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise fail(f"cannot be read: {reason}; name a readable file") from None
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise fail(f"is not valid TOML: {error}; correct that line") from None
    except RecursionError:
        raise fail("is not valid TOML: nested too deeply; flatten its arrays") from None
    except ValueError:
        raise fail("holds an integer of thousands of digits; write it as a float") from None


def parse_case(data: Mapping[str, Any], path: Path = Path("case")) -> Case:
    """Check the tables of a case file, as TOML reads them.

    Parameters
    ----------
    data : mapping
        The tables by name.
    path : path
        What files in them are relative to.

    Returns
    -------
    Case

    Raises
    ------
    CaseError
        On the first mistake.

    Examples
    --------
    >>> parse_case({"plant": {"model": "two_mas"}, "theta": {}})
    Traceback (most recent call last):
    ccd_casadi.cases.checks.CaseError: case: objective: is missing; add a table [objective]
    """

    fail = Fail(path)
    known = ("plant", "theta", *TABLES)
    for name, table in data.items():
        if name not in known:
            raise fail(name, f"unknown table{checks.closest(name, known)}")
        if not isinstance(table, Mapping):
            raise fail(name, f"is {short_repr(table)}; write a table [{name}]")
    idle = idle_keys(data)
    if data.get("plant", {}).get("model") == "measured":
        words = "is one frequency response and has no theta: it goes with the command inner alone"
        raise fail("plant.model", words)
    for name in ("plant", "theta", *REQUIRED):
        if name not in data and f"{name}.M_K" not in idle:
            raise fail(name, f"is missing; add a table [{name}]")
    tables = {
        name: table_of(kind, name, data.get(name, {}), fail, idle) for name, kind in TABLES.items()
    }
    controller = tables["controller"]
    if controller.channel:
        own = data["controller"]["channel"]
        channel = tuple(
            (key, table_of(ChannelTable, f"controller.channel.{key}", own[key], fail))
            for key in own
        )
        tables["controller"] = replace(controller, channel=channel)
    for low, high, why in _ORDERED_WEIGHTS:
        below, above = getattr(tables["weights"], low), getattr(tables["weights"], high)
        if not below < above:
            words = f"is {above:g}, not above {low} = {below:g}; give {high} > {low}, so that {why}"
            raise fail(f"weights.{high}", words)
    check_kind(tables, fail)
    placed = tables["places"] != PlacesTable()
    if placed or tables["budget"] != BudgetTable():  # few cases have these
        from ccd_casadi.cases import budget

        tables["budget"] = budget.check_budget(tables["budget"], path.parent, fail)
        tables["places"] = budget.check_places(tables["places"], path.parent, fail)
    plant = plant_table(data["plant"], path, fail)
    own = dict(data["plant"])
    plants = tuple(_options_of(one, own, path, fail) for one in tables["robust"].plants)
    tables["robust"] = replace(tables["robust"], plants=plants)
    places, size = tables["places"], tables["motor"].size
    of_case = (*(budget.names_of(places) if placed else ()), *filter(None, [size]))
    theta, fixed = theta_tables(data["theta"], plant.model, of_case, fail)
    for parameter in fixed:
        if parameter.varies and controller.structure != "sections":
            words = 'needs controller.structure = "sections"; choose that, or drop it'
            raise fail(f"theta.{parameter.name}.varies", words)
    several = bool(plants) or any(parameter.varies for parameter in fixed)
    if placed:
        budget.check_directions(places, several, fail)
        budget.check_present(places, (*theta, *fixed), fail)
    check_filters(tables, fail)
    check_motion(tables, {p.name: (p.lower, p.upper) for p in (*theta, *fixed)}, fail)
    return Case(path=path, plant=plant, theta=theta, fixed=fixed, **tables)


def table_of(
    kind: type, name: str, table: Mapping[str, Any], fail: Fail, idle: Collection[str] = ()
) -> Any:
    """A table as its dataclass, every key checked; the keys `idle` need not be there."""
    tests: dict[str, checks.Test] = {item.name: checks.check_of(item) for item in fields(kind)}
    if kind is not ChannelTable:
        whole = tests.keys() & set(_OF_THE_WHOLE)
        tests |= {key: partial(_number_of_the_whole, tests[key]) for key in whole}
    checks.require_good(name, table, tests, fail)
    values = {}
    for item in fields(kind):
        key = item.name
        if key not in table:
            if f"{name}.{key}" in idle:
                values[key] = item.metadata["idle"]
            elif item.default is MISSING:
                raise fail(f"{name}.{key}", "is missing; add it")
            continue
        value = table[key]
        if isinstance(value, list):
            numbers = all(isinstance(v, int | float) for v in value)
            kept = item.type in (tuple[int, int], tuple[int, ...]) or not numbers
            value = tuple(v if kept else float(v) for v in value)
        elif item.type in (float, float | None):
            value = float(value)
        values[key] = value
    return kind(**values)


def _number_of_the_whole(check: checks.Test, value: Any) -> str | None:
    return f"is {short_repr(value)}; {_PER_CHANNEL}" if isinstance(value, list) else check(value)


def _options_of(
    one: str | Mapping[str, Any], own: dict[str, Any], path: Path, fail: Fail
) -> dict[str, Any]:
    """The plant options in a file that [robust] names, or in a table of it, checked."""
    try:
        found = one if isinstance(one, Mapping) else read_toml(path.parent / one)
    except CaseError as error:
        raise fail("robust.plants", str(error)) from None
    for key in ("model", "function"):
        if key in found:
            words = f"{short_repr(one)}: {key} is not an option of a plant; drop it"
            raise fail("robust.plants", words)
    checked = plant_table({**own, **found}, path, fail).options
    return {key: checked[key] for key in found}


def case_to_toml(case: Case) -> str:
    """Write the resolved case, defaults included, as TOML: to read it again gives the same case.

    Parameters
    ----------
    case : Case

    Returns
    -------
    str

    Raises
    ------
    UserError
        Its plant is a Python callable.
    """
    if callable(case.plant.function):
        message = "is a Python callable, which no file can hold"
        raise UserError(f'plant.function: {message}; write "my_plant.py:model"')
    plant = {"model": case.plant.model} if case.plant.model else {"function": case.plant.function}
    lines = ["[plant]", *_pairs(plant | dict(case.plant.options))]
    for parameter in (*case.theta, *case.fixed):
        lines += ["", f"[theta.{_toml_key(parameter.name)}]", *_pairs(parameter.table)]
    for name in TABLES:
        values = dict(vars(getattr(case, name)))
        channels = values.pop("channel", ())
        lines += ["", f"[{name}]", *_pairs(values)]
        for channel, table in channels:
            lines += ["", f"[{name}.channel.{_toml_key(channel)}]", *_pairs(vars(table))]
    return "\n".join(lines) + "\n"


def _pairs(table: Mapping[str, Any]) -> list[str]:
    """Lines `key = value`. None and NaN stand for an absent key and are left out."""
    present = {key: value for key, value in table.items() if value is not None and value == value}
    return [f"{_toml_key(key)} = {toml(value)}" for key, value in present.items()]


def _toml_key(key: str) -> str:
    """A bare key where TOML allows it, else a quoted one."""
    return key if re.fullmatch("[A-Za-z0-9_-]+", key) else toml(key)


def toml(value: Any) -> str:
    """A value in the syntax of TOML; a mapping is an inline table."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        quoted = re.sub(r'(["\\])', r"\\\1", value)
        escaped = (c if c.isprintable() else f"\\U{ord(c):08X}" for c in quoted)
        return f'"{"".join(escaped)}"'
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(toml, value)) + "]"
    if isinstance(value, Mapping):
        return "{" + ", ".join(_pairs(value)) + "}"
    return repr(value)


def case_schema() -> dict[str, Any]:
    """The JSON Schema of a case file: the template, with the properties of every table added."""
    from ccd_casadi.cases.budget import TABLE_CHECKS, UNITS  # a solve needs none

    schema: dict[str, Any] = json.loads(package_text("templates/case.schema.json"))
    tables = schema["properties"]
    tables["plant"]["properties"]["model"]["enum"] = sorted({*model_names(), MEASURED})
    tables["theta"]["additionalProperties"]["properties"] = {
        key: {**check.schema, "description": says} for key, (check, says) in THETA.items()
    }
    tables |= {name: _table_schema(table) for name, table in TABLES.items()}
    channels = tables["controller"]["properties"]["channel"]
    channels["additionalProperties"] = _table_schema(ChannelTable)
    spectrum_keys = {key: dict(check.schema) for key, check in TABLE_CHECKS.items()}
    for kind, units in UNITS.items():
        spectrum = {
            "type": "object",
            "properties": spectrum_keys | {"unit": {"enum": list(units)}},
            "required": ["unit"],
            "additionalProperties": False,
        }
        entry = tables["budget"]["properties"][kind.value]
        entry["anyOf"] = [spectrum, {"type": "array", "items": spectrum}]
    # "if" the plant is measured there is no θ to choose, and none of these tables is required
    schema["else"]["required"] += [name for name in REQUIRED if tables[name]["required"]]
    return schema


def keys_page() -> str:
    """Every key of a case file in tables, as Markdown."""
    from ccd_casadi.cases.budget import TABLE_CHECKS

    required = ("lower", "upper")
    theta = ((key, "required" * (key in required), "", says) for key, (_, says) in THETA.items())
    tables = {**TABLES, "controller.channel.NAME": ChannelTable}
    plant = case_schema()["properties"]["plant"]["properties"]
    return template("templates/keys.md").render(
        plant=((key, "", "", entry["description"]) for key, entry in plant.items()), theta=theta,
        tables={name: [_row(item) for item in fields(table)] for name, table in tables.items()},
        spectrum=TABLE_CHECKS,
    )  # fmt: skip


def _table_schema(table: type) -> dict[str, Any]:
    """JSON Schema of one table, from the dataclass whose fields are its keys."""
    properties = {}
    for item in fields(table):
        unit = unit_of(item)
        description = item.metadata["says"] + (f", in {unit}" if unit else "")
        properties[item.name] = dict(check_of(item).schema) | {"description": description}
        if item.default not in (MISSING, None, ()):
            properties[item.name]["default"] = item.default
    return {
        "type": "object",
        "properties": properties,
        "required": [item.name for item in fields(table) if _default(item) == "required"],
        "additionalProperties": False,
    }


def _default(item: Field[Any]) -> str:
    """The default of a key in words. `idle` is the value of a required key where another key makes
    it of no effect, so that it need not be given there."""
    if item.default is MISSING:
        return "required" if item.metadata["idle"] is None else "required*"
    if item.metadata["needed"]:
        return "required*"
    return "–" if item.default in (None, ()) else toml(item.default)


def _row(item: Field[Any]) -> tuple[str, str, str, str]:
    """Key, default, unit and meaning of a row of the page."""
    choices = ", ".join(map(toml, check_of(item).schema.get("enum", ())))
    meaning = item.metadata["says"] + (f" (one of {choices})" if choices else "")
    return item.name, _default(item), unit_of(item), meaning
