"""The stage of the shortest move against the stage of the largest bandwidth, at the same watts.

    python benchmarks/move_against_bandwidth.py

The linear-motor axis of examples/ with one motor of its catalogue: over the thickness of the arm
the largest bandwidth, how long a move takes on the set with that controller, and with the one of
the least time within the same bounds. Heat and force are those that [motor] allows, at every one.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np

from ccd_casadi.cases.case import load_case
from ccd_casadi.cases.case_problem import problem_of
from ccd_casadi.inner_problem.move_figures import FREE, exact_times, motion_of
from ccd_casadi.inner_problem.sections_bandwidth import sections_value
from ccd_casadi.inner_problem.sections_plant_set import plants_of, with_sections
from ccd_casadi.inner_problem.sections_search import least_from, prepared
from ccd_casadi.support.units import HZ

CASE = Path(__file__).parents[1] / "examples" / "linear_motor_axis" / "case.toml"
MOTOR = 0.62  # kg, of the catalogue
THICKNESS = np.geomspace(8e-3, 30e-3, 8)


def main() -> None:
    case = replace(problem_of(load_case(CASE)), start=(0.015, MOTOR))
    anchored, made = prepared(case)
    anchored, made = least_from(anchored, case.start, made)
    print(
        "   h mm   mass kg   Hz    move ms at that   Hz of the least   least ms   setpoint ms   W"
    )
    for h in THICKNESS:
        theta = (float(h), MOTOR)
        fast = sections_value(with_sections(anchored, minimise="bandwidth"), theta).design
        least = sections_value(anchored, theta)
        motion, free = motion_of(anchored, theta), replace(anchored, suspension=FREE)
        times = [
            1e3 * exact_times(anchored, motion, plants_of(free, theta), design.controller).max()
            if design.certified and design.controller is not None
            else np.nan
            for design in (fast, least.design)
        ]
        cycle, hz = motion.cycle, (fast.bandwidth / HZ, least.design.bandwidth / HZ)
        setpoint = 1e3 * cycle.profile.duration
        print(
            f"{1e3 * h:7.2f} {motion.forward[2, 0]:9.3f} {hz[0]:6.2f} {times[0]:14.2f} "
            f"{hz[1]:14.2f} {times[1]:13.2f} {setpoint:12.2f} {cycle.power:8.1f}",
            flush=True,
        )


if __name__ == "__main__":
    main()
