"""Feedforward and shaper of a setpoint for every plant of a set, and what learns on the machine."""

from ccd_casadi.support.extensions import Extension

EXTENSION = Extension(
    commands={
        "feedforward": (
            "ccd_casadi.extensions.feedforward.feedforward_command",
            "feedforward and shaper of a move, for every plant of the set",
        )
    }
)
