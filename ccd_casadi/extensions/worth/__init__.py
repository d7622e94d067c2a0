"""What co-design gains over the sequential way, estimated in seconds."""

from ccd_casadi.support.extensions import Extension

EXTENSION = Extension(
    commands={
        "worth": (
            "ccd_casadi.extensions.worth.worth_command",
            "estimate in seconds what co-design gains",
        )
    }
)
