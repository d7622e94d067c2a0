"""The keys of a case file as JSON Schema and as a page of Markdown, and a case as TOML.

Schema and page are made from the fields of `TABLES`: their types, defaults and metadata (`says`,
`unit`, `check`, `idle`), with which a case is also read and checked.
"""

import json
import re
from collections.abc import Mapping
from dataclasses import MISSING, Field, fields
from typing import Any

from ccd_casadi.cases.checks import check_of, unit_of
from ccd_casadi.cases.controller_tables import ChannelTable
from ccd_casadi.cases.plant_tables import KEYS as THETA
from ccd_casadi.cases.plant_tables import MEASURED
from ccd_casadi.cases.tables import REQUIRED, TABLES, Case
from ccd_casadi.plants.registry import model_names
from ccd_casadi.support.errors import UserError
from ccd_casadi.support.text import package_text, template


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
    return "–" if item.default in (None, ()) else toml(item.default)


def _row(item: Field[Any]) -> tuple[str, str, str, str]:
    """Key, default, unit and meaning of a row of the page."""
    choices = ", ".join(map(toml, check_of(item).schema.get("enum", ())))
    meaning = item.metadata["says"] + (f" (one of {choices})" if choices else "")
    return item.name, _default(item), unit_of(item), meaning
