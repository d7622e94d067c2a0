"""A controller for a plant that exists, on its measured responses."""

from ccd_casadi.support.extensions import Extension

EXTENSION = Extension(
    commands={
        "tune": (
            "ccd_casadi.extensions.measured.tune_command",
            "find the fastest PID with notches for a plant that exists",
        )
    },
    functions={
        "measured_answer": "ccd_casadi.extensions.measured.measured_answer:measured_answer",
        "measured_page": "ccd_casadi.extensions.measured.measured_answer:measured_page",
    },
)
