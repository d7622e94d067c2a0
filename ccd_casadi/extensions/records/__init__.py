"""Time series of a machine, in open or closed loop, and the plant's frequency response of them."""

from ccd_casadi.support.extensions import Extension

EXTENSION = Extension(
    commands={
        "record": (
            "ccd_casadi.extensions.records.record_command",
            "estimate a plant's response from records of its loop",
        )
    }
)
