"""Random gantries: two motors, two encoders, three positions in the set, two θ; all verified?

    OPENBLAS_NUM_THREADS=1 python benchmarks/gantries.py [--cases N] [--first SEED] [--workers N]
        [--formulation NAME]

A beam on two driven carriages, a slide on it that stands left, in the middle and right: three
coupled plants of two channels. θ are the height of the beam and the mass of the carriages. A seed
draws masses, span, stiffness of the guides, damping, rate, delay, S_max and the worth of a hertz.
Each is solved as `solve` would, by the formulation that it takes or the one that is named. One line
of JSON each: status, J, seconds of the wall and of the processor, workers included. Raises nothing;
the exit status is 1 where one is not verified.
"""

import argparse
import json
import resource
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

ROOT = Path(__file__).resolve().parent.parent
CASE = """
[plant]
function = "gantries.py:gantry"
span = {span}
slide = {slide}
guide = {guide}
damping = {damping}

[theta.h]
lower = 0.04
upper = 0.12
start = 0.08
unit = "m"

[theta.m]
lower = 3.0
upper = 10.0
start = 6.0
unit = "kg"

[objective]
w1 = 1.0
w2 = {w2}
cost_unit = "kg"

[weights]
M_S = 2.0
A_S = 1e-4
c_K = 1e4
omega_K_hz = 200.0
M_K = 4e6
A_l = 1.0
A_u = 1e-2

[inner]
S_max = {S_max}
S_low = 0.1
omega_low_hz = 1.0
omega_S_hz = [10.0, 2000.0]
omega_T_hz = [60.0, 1000.0]

[controller]
structure = "sections"
biquads = {biquads}
{least}weighted_level = 20.0

[loop]
rate_hz = {rate}
delay_us = {delay}

[robust]
plants = ["left.toml", "right.toml"]
"""


def gantry(
    theta: Any,
    span: float = 1.0,
    slide: float = 12.0,
    guide: float = 2e7,
    damping: float = 0.01,
    at: float = 0.0,
) -> dict[str, Any]:
    """Both carriages, then the beam: its ends and its bending; the slide stands `at` (m)."""
    E, rho, width = 70e9, 2700.0, 0.08
    h, m = theta["h"], theta["m"]
    beam, stiffness = 0.5 * rho * width * h * span, 0.5 * E * width * h**3 / 12.0

    def shape(x: float) -> ca.DM:
        return ca.DM([[0.5 - x, 0.5 + x, np.cos(np.pi * x)]])

    along = np.linspace(-0.5, 0.5, 41)
    spread = sum(shape(x).T @ shape(x) for x in along) / 41.0
    own = beam * spread + slide * shape(at / span).T @ shape(at / span)
    bending = 0.5 * stiffness * (np.pi / span) ** 4 * span
    ends = ca.DM([[1.0, 0.0, -1.0, 0.0, 0.0], [0.0, 1.0, 0.0, -1.0, 0.0]])
    drives = ca.DM([[1.0, 0.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0, 0.0]])
    return {
        "mass": ca.diagcat(ca.diag(ca.vertcat(m, m)), own),
        "stiffness": guide * ends.T @ ends + ca.diagcat(ca.DM.zeros(4, 4), bending),
        "damping_ratio": damping,
        "input": drives.T,
        "output": drives,
        "hardware_cost": beam + 2.0 * m,
    }


def written(seed: int, folder: Path) -> Path:
    """The case of a seed."""
    rng = np.random.default_rng(seed)
    span = float(rng.uniform(0.6, 1.4))
    drawn = {
        "span": span, "slide": float(rng.uniform(4.0, 20.0)),
        "guide": float(np.exp(rng.uniform(np.log(1e7), np.log(1e8)))),
        "damping": float(rng.uniform(0.005, 0.02)), "w2": -float(rng.uniform(0.02, 0.08)),
        "S_max": float(rng.uniform(1.7, 2.0)), "biquads": int(rng.integers(0, 2)),
        "rate": float(rng.choice([4000.0, 8000.0])), "delay": float(rng.choice([60.0, 125.0])),
    }  # fmt: skip
    drawn["least"] = "least_damping = 0.05\n" if drawn["biquads"] else ""  # of biquads alone
    (folder / "gantries.py").write_text(Path(__file__).read_text())
    for name, side in (("left", -0.3), ("right", 0.3)):
        (folder / f"{name}.toml").write_text(f"at = {side * span}\n")
    path = folder / "case.toml"
    path.write_text(CASE.format(**drawn))
    return path


def processor_seconds() -> float:
    """Of this process and of those that it has ended."""
    return sum(use.ru_utime + use.ru_stime for use in map(resource.getrusage, (
        resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)))  # fmt: skip


def main() -> int:
    """Every case, a line each."""
    from ccd_casadi.cases.case import load_case
    from ccd_casadi.cases.case_problem import problem_of
    from ccd_casadi.codesign.formulations import formulation_of, usual_name
    from ccd_casadi.codesign.run import solve

    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cases", type=int, default=4)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--formulation", choices=("nested", "lifted", "direct"))
    options = parser.parse_args()
    failed = 0
    for seed in range(options.first, options.first + options.cases):
        with tempfile.TemporaryDirectory() as folder:
            path = written(seed, Path(folder))
            began, spent = time.perf_counter(), processor_seconds()
            case = load_case(path)
            name = options.formulation or usual_name(case, len(case.theta))
            formulation = formulation_of(case, name)
            solution = solve(problem_of(case), formulation, workers=options.workers)
        result = solution.result
        failed += result["status"] != "verified"
        row = {"seed": seed, "formulation": name, "status": result["status"],
               "reason": result.get("reason", "")}  # fmt: skip
        if solution.verified is not None:
            row |= {"J": result["objective"], "bandwidth_hz": result["bandwidth_hz"],
                    "theta": result["theta"], "syntheses": result["syntheses"]}  # fmt: skip
        row |= {"seconds": round(time.perf_counter() - began, 1),
                "processor_seconds": round(processor_seconds() - spent, 1)}  # fmt: skip
        print(json.dumps(row), flush=True)
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main())
