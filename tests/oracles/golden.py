"""The twenty solves of benchmarks/golden.py, whose ends are in tests/data/golden.json.

A case is a kind of inner problem or a case file, by one formulation. `identity` is under what
its designs and its bandwidths are stored: where one moves, samples that people have are not found.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

import ccd_casadi as ccd
from ccd_casadi.inner_problem.problem import CoDesignProblem
from ccd_casadi.inner_problem.structured_problem import Uncertainty
from ccd_casadi.lti.loop import Sampling
from ccd_casadi.sampling.units import problem_hash
from oracles.kinds import kinds

ROOT = Path(__file__).parents[2]
FILE = ROOT / "tests/data/golden.json"
FILES = {
    "two_mass": "runs/two_mass.toml",
    "planar_stage": "examples/planar_stage/case.toml",
    "three_mass_axis": "examples/three_mass_axis/case.toml",
    "modal_table": "examples/modal_table/case.toml",
}
SMALL = {
    "nested": ccd.Nested(plan="sobol", points=4, box_points=4),
    "lifted": ccd.Lifted(points=8, box_points=4),
    "direct": ccd.Direct(starts=1, box_points=4),
}
WHOLE = {"nested": ccd.Nested(), "lifted": ccd.Lifted(), "direct": ccd.Direct()}
VALUE = 1e-3  # relative, of what J counts of the controller: [outer] tolerance
THETA = 2e-2  # of the box: J is flat there


def problems() -> dict[str, CoDesignProblem]:
    """By name, what is solved."""
    found = kinds()
    sections = found["sections"].controller
    assert sections is not None
    for name, changes in {
        "set": {"uncertainty": Uncertainty(resonance_shift=0.03)},
        "sampled": {"sampling": Sampling(8000.0, 80.0)},
    }.items():
        other = replace(sections, **changes)  # type: ignore[arg-type]
        found[f"sections, {name}"] = replace(found["sections"], controller=other)
    for name, path in FILES.items():
        found[name] = ccd.problem_of(ccd.load_case(ROOT / path))
    return found


def cases() -> dict[str, tuple[str, str]]:
    """Name of a case -> problem and formulation."""
    every = {"mixed", "disturbance", "sections", "error", "two_mass"}
    pairs = [
        (name, way) for name in problems() for way in SMALL if name in every or way == "lifted"
    ]
    return {f"{name}, {way}": (name, way) for name, way in pairs}


def identity(problem: CoDesignProblem) -> list[str]:
    """The store's hashes of what determines a design, and of what determines ω_b*(θ)."""
    designs = problem_hash(problem.identity())
    return [designs, problem_hash({"problem": designs, "inner": problem.inner_identity()})]


def solved(case: str) -> dict[str, Any]:
    """What a case ends with, and how far from it a solve elsewhere may end."""
    name, way = cases()[case]
    problem = problems()[name]
    result = ccd.solve(problem, (WHOLE if name in FILES else SMALL)[way]).result
    J, counted = result["objective"], result["objective"] - problem.w1 * result["hardware_cost"]
    width = [THETA * (b - a) for a, b in zip(problem.lower, problem.upper, strict=True)]
    return {
        "identity": identity(problem),
        "status": result["status"],
        "objective": J,
        "theta": result["theta"],
        "tolerance": {"objective": VALUE * abs(counted), "theta": width},
    }


def apart(one: dict[str, Any], other: dict[str, Any]) -> float:
    """The largest difference of J or a θ, as a share of what is tolerated."""
    width, theta = one["tolerance"], one["theta"]
    moved = [abs(other["theta"][key] - value) for key, value in theta.items()]
    shares = [part / whole for part, whole in zip(moved, width["theta"], strict=True)]
    return max(abs(other["objective"] - one["objective"]) / width["objective"], *shares)
