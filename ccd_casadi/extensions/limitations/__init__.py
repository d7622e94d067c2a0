"""What no controller of any order can do on a plant: bounds on its bandwidth."""

from ccd_casadi.support.extensions import Extension

EXTENSION = Extension(
    commands={
        "gap": (
            "ccd_casadi.extensions.limitations.gap_command",
            "bound what any controller reaches at one theta, as JSON",
        )
    },
    functions={
        "known_gap": "ccd_casadi.extensions.limitations.of_problem:known_gap",
        "none_reaches": "ccd_casadi.extensions.limitations.of_problem:none_reaches",
    },
)
