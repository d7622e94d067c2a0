"""Tolerances bought: a design for a share of machines, and what each tolerance costs."""

from ccd_casadi.support.extensions import Extension

EXTENSION = Extension(
    commands={
        "tolerances": (
            "ccd_casadi.extensions.tolerances.tolerances_command",
            "design for a share of machines; price the tolerances of a run",
        )
    }
)
