"""A controller for each part of a stroke, proven there, and what hands over between them."""

from ccd_casadi.support.extensions import Extension

EXTENSION = Extension(
    commands={
        "schedule": (
            "ccd_casadi.extensions.schedule.schedule_command",
            "controllers for parts of a stroke, each proven on its part",
        )
    }
)
