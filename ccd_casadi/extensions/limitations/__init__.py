"""What no controller of any order can do on a plant: bounds on its bandwidth.

`python -m ccd_casadi.gap CASE.toml [--theta m1=60,m2=60]`: what no controller can reach.
"""

import argparse
from typing import Any

from ccd_casadi.support.command_line import ExitCode, command, option
from ccd_casadi.support.extensions import Extension
from ccd_casadi.support.text import HZ

EXTENSION = Extension(
    commands={
        "gap": (
            "ccd_casadi.extensions.limitations",
            "bound what any controller reaches at one theta, as JSON",
        )
    },
    functions={
        "known_gap": "ccd_casadi.extensions.limitations.of_problem:known_gap",
        "none_reaches": "ccd_casadi.extensions.limitations.of_problem:none_reaches",
    },
)


@command(
    "ccd_casadi.gap",
    "Bound the bandwidth of every controller on the model at one theta; print JSON. "
    "CASE.toml may be the folder of a finished solve.",
    option("--theta", metavar="m1=60,m2=60", help="the hardware (default: the case's start)"),
    needs=["ccd_casadi.extensions.limitations.of_problem"],
    without_effect=("--out", "--workers", "--seed", "--quiet"),
)  # fmt: skip
def main(options: argparse.Namespace) -> ExitCode:
    """Print one JSON object; of a run's folder at its θ, beside its own bandwidth."""
    from ccd_casadi.cases.run_folder import problem_at
    from ccd_casadi.extensions.limitations.of_problem import gap_of
    from ccd_casadi.support.json_files import json_text
    from ccd_casadi.support.text import versions

    problem, theta, finished = problem_at(options.case, options.theta)
    theta = problem.start if theta is None else theta
    bandwidth = finished and finished.result.get("bandwidth_hz")
    found = gap_of(problem, theta)
    answer: dict[str, Any] = {
        "theta": dict(zip(problem.names, theta, strict=True)),
        "bandwidth_hz": bandwidth,
        "gap": found.entry(HZ * (bandwidth or float("nan"))),
        "seconds": options.seconds(),
        "versions": versions(),
    }
    print(json_text(answer))
    return ExitCode.DONE
