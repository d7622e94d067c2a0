"""The keys of a case file as JSON Schema and as text, and the resolved case as TOML."""

import json
import re
from collections.abc import Mapping
from dataclasses import MISSING, Field, fields
from typing import Any

from ccd_casadi.cases.budget import TABLE_CHECKS, UNITS
from ccd_casadi.cases.checks import check_of, unit_of
from ccd_casadi.cases.controller_tables import ChannelTable
from ccd_casadi.cases.measured_case import MODEL as MEASURED
from ccd_casadi.cases.plant_tables import KEYS as THETA
from ccd_casadi.cases.tables import REQUIRED, TABLES, Case
from ccd_casadi.plants.registry import model_names
from ccd_casadi.support.errors import UserError
from ccd_casadi.support.text import package_text, template


def case_to_toml(case: Case) -> str:
    """Write the resolved case, defaults included, as TOML.

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
        words = "is a Python callable, which no file can hold"
        raise UserError(f'plant.function: {words}; write "my_plant.py:model"')
    plant = {"model": case.plant.model} if case.plant.model else {"function": case.plant.function}
    lines = ["[plant]", *_pairs(plant | dict(case.plant.options))]
    for parameter in (*case.theta, *case.fixed):
        lines += ["", f"[theta.{_toml_key(parameter.name)}]", *_pairs(parameter.table)]
    for name in TABLES:
        entries = dict(vars(getattr(case, name)))
        tables = entries.pop("channel", ())
        lines += ["", f"[{name}]", *_pairs(entries)]
        for key, entry in tables:
            lines += ["", f"[{name}.channel.{_toml_key(key)}]", *_pairs(vars(entry))]
    return "\n".join(lines) + "\n"


def _pairs(table: Mapping[str, Any]) -> list[str]:
    given = {key: value for key, value in table.items() if value is not None and value == value}
    return [f"{_toml_key(key)} = {toml(value)}" for key, value in given.items()]


def _toml_key(key: str) -> str:
    return key if re.fullmatch("[A-Za-z0-9_-]+", key) else toml(key)


def toml(value: Any) -> str:
    """A value as TOML writes it; tables in one line."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        marked = re.sub(r'(["\\])', r"\\\1", value)
        shown = (c if c.isprintable() else f"\\U{ord(c):08X}" for c in marked)
        return f'"{"".join(shown)}"'
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(toml, value)) + "]"
    if isinstance(value, Mapping):
        return "{" + ", ".join(_pairs(value)) + "}"
    return repr(value)


def case_schema() -> dict[str, Any]:
    """The JSON Schema of a case file."""
    found: dict[str, Any] = json.loads(package_text("templates/case.schema.json"))
    tables = found["properties"]
    tables["plant"]["properties"]["model"]["enum"] = sorted({*model_names(), MEASURED})
    tables["theta"]["additionalProperties"]["properties"] = {
        key: {**check.schema, "description": says} for key, (check, says) in THETA.items()
    }
    tables |= {name: _table(kind) for name, kind in TABLES.items()}
    channels = tables["controller"]["properties"]["channel"]
    channels["additionalProperties"] = _table(ChannelTable)
    checks = {key: dict(check.schema) for key, check in TABLE_CHECKS.items()}
    for kind, units in UNITS.items():
        spectrum = {
            "type": "object",
            "properties": checks | {"unit": {"enum": list(units)}},
            "required": ["unit"],
            "additionalProperties": False,
        }
        entry = tables["budget"]["properties"][kind.value]
        entry["anyOf"] = [spectrum, {"type": "array", "items": spectrum}]
    needed = [name for name in REQUIRED if tables[name]["required"]]
    found["else"]["required"] += needed  # what was measured has no θ to choose
    return found


def keys_page() -> str:
    """Every key of a case file in tables, as Markdown."""
    required = ("lower", "upper")
    theta = ((key, "required" * (key in required), "", says) for key, (_, says) in THETA.items())
    kinds = {**TABLES, "controller.channel.NAME": ChannelTable}
    plant = case_schema()["properties"]["plant"]["properties"]
    return template("templates/keys.md").render(
        plant=((key, "", "", own["description"]) for key, own in plant.items()), theta=theta,
        tables={name: [_row(item) for item in fields(kind)] for name, kind in kinds.items()},
        spectrum=TABLE_CHECKS,
    )  # fmt: skip


def _table(kind: type) -> dict[str, Any]:
    found = {}
    for item in fields(kind):
        unit = unit_of(item)
        says = item.metadata["says"] + (f", in {unit}" if unit else "")
        found[item.name] = dict(check_of(item).schema) | {"description": says}
        if item.default not in (MISSING, None, ()):
            found[item.name]["default"] = item.default
    return {
        "type": "object",
        "properties": found,
        "required": [item.name for item in fields(kind) if _default(item) == "required"],
        "additionalProperties": False,
    }


def _default(item: Field[Any]) -> str:
    if item.default is MISSING:
        return "required" if item.metadata["idle"] is None else "required where it has an effect"
    return "absent" if item.default in (None, ()) else toml(item.default)


def _row(item: Field[Any]) -> tuple[str, str, str, str]:
    default = _default(item)
    names = ", ".join(map(toml, check_of(item).schema.get("enum", ())))
    says = item.metadata["says"] + (f" (one of {names})" if names else "")
    return item.name, default, unit_of(item), says
