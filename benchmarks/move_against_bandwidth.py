"""The stage of the shortest move against the stage of the largest bandwidth, at the same watts.

    python benchmarks/move_against_bandwidth.py [--rib]

The linear-motor axis of examples/ with one motor of its catalogue, over the thickness of the arm;
or the z channel of the rib stage, over the height of its ribs. At each the largest bandwidth, how
long a move takes on the set with that controller, and with the one of the least time within the
same bounds. Heat and force are those that [motor] allows, at every one.
"""

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np

from ccd_casadi.cases.case import load_case
from ccd_casadi.cases.case_problem import problem_of
from ccd_casadi.inner_problem.move_figures import FREE, exact_times, motion_of
from ccd_casadi.inner_problem.problem import plant_of
from ccd_casadi.inner_problem.structured_bandwidth import structured_value
from ccd_casadi.inner_problem.structured_plant_set import plants_of, with_structured
from ccd_casadi.inner_problem.structured_search import least_from, prepared
from ccd_casadi.plants.plant import hardware_cost
from ccd_casadi.support.units import HZ

EXAMPLES = Path(__file__).parents[1] / "examples"
# case, the parameter that varies, its values, where the search starts and what else is changed
AXIS = ("linear_motor_axis", "h", np.geomspace(8e-3, 30e-3, 8), {"h": 0.015, "motor": 0.62})
RIB = ("rib_stage_moves", "H", np.linspace(6e-3, 20e-3, 8), {})


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rib", action="store_true")
    name, varied, values, start = RIB if parser.parse_args().rib else AXIS
    case = problem_of(load_case(EXAMPLES / name / "case.toml"))
    at = dict(zip(case.names, case.start, strict=True)) | start
    case = replace(case, start=tuple(at.values()))
    anchored, made = prepared(case)
    anchored, made, _ = least_from(anchored, case.start, made)
    print(
        f"   {varied} mm   mass kg   Hz    move ms at that   Hz of the least   least ms   "
        "setpoint ms   W"
    )
    for value in values.tolist():
        theta = tuple((at | {varied: value}).values())
        fast = structured_value(with_structured(anchored, minimise="bandwidth"), theta).design
        least = structured_value(anchored, theta)
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
            f"{1e3 * value:7.2f} {hardware_cost(plant_of(case), theta):9.3f} {hz[0]:6.2f} "
            f"{times[0]:14.2f} {hz[1]:14.2f} {times[1]:13.2f} {setpoint:12.2f} {cycle.power:8.1f}",
            flush=True,
        )


if __name__ == "__main__":
    main()
