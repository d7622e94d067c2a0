"""The stage of the shortest move against the stage of the largest bandwidth, at the same watts.

    python benchmarks/move_against_bandwidth.py [--rib] [--search]

The linear-motor axis of examples/ with one motor of its catalogue, over the thickness of the arm;
or the z channel of the rib stage, over the height of its ribs. At each the largest bandwidth, how
long a move takes on the set with that controller, and with the one of the least time within the
same bounds. Heat and force are those that [motor] allows, at every one.

With --search over all parameters instead: the stage of the largest bandwidth (the joint search,
whatever the mass), with its own controller and with the one of the least time there, and the stage
of the least time by a local search that begins at it, on the same plants. What the second has
gained over the first is the controller's share, what the third has over the second is the stage's.
"""

import argparse
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

from ccd_casadi.cases.case import load_case
from ccd_casadi.cases.case_problem import problem_of
from ccd_casadi.codesign.outer_theta import SETTLED, pieces_from
from ccd_casadi.codesign.stored_searches import multistart_at
from ccd_casadi.codesign.theta_joint import joint_search
from ccd_casadi.fixed_structure import SectionsDesign
from ccd_casadi.inner_problem.move_figures import exact_times, motion_of
from ccd_casadi.inner_problem.problem import CoDesignProblem, plant_of
from ccd_casadi.inner_problem.structured_bandwidth import ProblemAt, structured_value
from ccd_casadi.inner_problem.structured_plant_set import plants_of, with_structured
from ccd_casadi.inner_problem.structured_search import least_from, prepared
from ccd_casadi.plants.modal import FREE
from ccd_casadi.plants.plant import hardware_cost
from ccd_casadi.sampling.neighbours import from_controller
from ccd_casadi.sampling.sampler import Sampler
from ccd_casadi.sampling.store import SampleStore
from ccd_casadi.support.process_pool import Workers
from ccd_casadi.support.units import HZ

EXAMPLES = Path(__file__).parents[1] / "examples"
# case, the parameter that varies, its values, where the search starts and what else is changed
AXIS = ("linear_motor_axis", "h", np.geomspace(8e-3, 30e-3, 8), {"h": 0.015, "motor": 0.62})
RIB = ("rib_stage_moves", "H", np.linspace(6e-3, 20e-3, 8), {})


def stage_row(
    words: str, problem: CoDesignProblem, theta: tuple[float, ...], design: SectionsDesign
) -> None:
    """A stage with a controller: times on the set, and what limits its setpoint."""
    motion = motion_of(problem, theta)
    assert design.controller is not None
    smooth = 1e3 * np.exp(ProblemAt(problem, theta).goal.at(design.kappa)[0])
    free = plants_of(replace(problem, suspension=FREE), theta)
    exact = 1e3 * exact_times(problem, motion, free, design.controller).max()
    cycle, mass = motion.cycle, hardware_cost(plant_of(problem), theta)
    print(
        f"{words:40s} {mass:7.3f} kg {design.bandwidth / HZ:7.2f} Hz "
        f"{smooth:8.2f} ms, exact {exact:7.2f}, setpoint {1e3 * cycle.profile.duration:6.2f}, "
        f"{cycle.peak_force:6.2f} N, {cycle.power:6.3f} W, {', '.join(cycle.limits)}; "
        f"{', '.join(f'{1e3 * v:.3f}' for v in theta)} mm",
        flush=True,
    )  # fmt: skip


def searched_stages(case: CoDesignProblem) -> None:
    """The stage of the largest bandwidth beside that of the least time."""
    anchored, made, _ = prepared(case)
    anchored, made, _ = least_from(anchored, case.start, made)
    with tempfile.TemporaryDirectory() as name, SampleStore(Path(name) / "s.sqlite") as store:
        fast = replace(with_structured(anchored, minimise="bandwidth"), w1=0.0, w2=-1.0)
        sampler, best, _ = joint_search(Sampler(fast, store, Workers(1)), np.array(case.start))
        own = structured_value(from_controller(sampler.problem, best.kappa), best.theta).design
        problem = with_structured(sampler.problem, minimise=case.figure.key)
        problem = replace(problem, w1=case.w1, w2=case.w2)
        stage_row("largest bandwidth", problem, best.theta, own)
        sampler = Sampler(problem, store, Workers(1))
        first = sampler.values(np.array(best.theta))[0]
        again = multistart_at(sampler, first).design
        stage_row("the same stage, controller of least time", problem, best.theta, again)
        least = pieces_from(sampler, sampler.value_from(best.theta, again.kappa), 1e3 * SETTLED)
        design = structured_value(from_controller(problem, least.kappa), least.theta).design
        stage_row("stage and controller of least time", problem, least.theta, design)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rib", action="store_true")
    parser.add_argument("--search", action="store_true")
    options = parser.parse_args()
    name, varied, values, start = RIB if options.rib else AXIS
    case = problem_of(load_case(EXAMPLES / name / "case.toml"))
    if options.search:
        searched_stages(case)
        return
    at = dict(zip(case.names, case.start, strict=True)) | start
    case = replace(case, start=tuple(at.values()))
    anchored, made, _ = prepared(case)
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
