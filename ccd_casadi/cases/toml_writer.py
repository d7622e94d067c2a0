"""The resolved case, defaults included, back as TOML.

By hand: tomli-w lets marks through that turn the direction of a terminal's text, and cases come
from strangers.
"""

import re
from collections.abc import Mapping
from typing import Any

from ccd_casadi.cases.tables import TABLES, Case
from ccd_casadi.support.errors import UserError


def case_to_toml(case: Case) -> str:
    """The resolved case, defaults included, as TOML.

    Raises UserError where its plant is a Python callable.
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
