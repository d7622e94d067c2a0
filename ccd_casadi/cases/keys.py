"""A key of a case file: its check, its default, one sentence for a person, and its unit."""

from dataclasses import MISSING, field
from typing import Any

from ccd_casadi.cases.checks import Check


def key(check: Check, default: Any = MISSING, *, says: str, unit: str = "") -> Any:
    """The field of a section's dataclass that a key is."""
    metadata = {"check": check, "says": says, "unit": unit}
    if default is MISSING:
        return field(metadata=metadata)
    return field(default=default, metadata=metadata)
