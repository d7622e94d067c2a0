"""Controllers in the form that an industrial drive accepts: a cascade with its filters, rounded as
the drive rounds, judged and proven as it runs."""

from ccd_casadi.support.extensions import Extension

EXTENSION = Extension(
    commands={
        "drive": (
            "ccd_casadi.extensions.drives.drive_command",
            "design an industrial drive's cascade, rounded and proven",
        )
    }
)
