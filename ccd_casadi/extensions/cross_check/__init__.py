"""One synthesis by every back end, the certificate as the judge."""

from ccd_casadi.support.extensions import Extension

EXTENSION = Extension(
    commands={
        "cross_check": (
            "ccd_casadi.extensions.cross_check.cross_check_command",
            "compare one synthesis by every back end",
        )
    }
)
