"""What a calculation in SI, apart from the package's own, says against a design called verified.

From controller.json and the plant's M, D, K, B, C: in double precision first; where that objects,
sixty digits decide, since matrix square roots lose half the digits of a nearly singular mass.
"""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from ccd_casadi.cases.case import load_case
from ccd_casadi.cases.case_problem import problem_of
from ccd_casadi.inner_problem.problem import plant_of
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.plants.plant import constraint_values, mechanics
from ccd_casadi.support.arrays import Array
from oracles.fuzz_exact import ExactLoop
from oracles.helpers import HZ, dense_grid, reference_plant, sensitivity_gain, stack_gain

CLOSE = 1e-4  # of a figure against the same from a grid
LEVEL = 1.0 / np.sqrt(2.0)


def refuted(case: Path, folder: Path, answer: dict[str, Any], optimum: bool) -> list[str]:
    """Every claim of the answer that does not hold, as a sentence."""
    problem = problem_of(load_case(folder / "case.toml" if optimum else case))
    theta = tuple(answer["theta"].values())
    system = mechanics(plant_of(problem), theta)
    plant = reference_plant(system, problem.suspension.free)
    data = json.loads((folder / "controller.json").read_text())
    K = StateSpace(*(np.array(data[name]) for name in "ABCD"))
    weights = problem.weights.at(HZ * answer["omega_S_hz"], HZ * answer["omega_T_hz"])
    exact = ExactLoop(system, problem.suspension.free, K, weights)
    grid = dense_grid(plant, K)
    gain = sensitivity_gain(plant, K, grid)
    stack = stack_gain(plant, K, weights, grid)
    wrong = []

    BK, KC = plant.B @ K.C, K.B @ plant.C
    loop = np.block([[plant.A - plant.B @ K.D @ plant.C, BK], [-KC, K.A]])
    pole = np.linalg.eigvals(loop).real.max()
    if not pole < 0.0:
        wrong.append(f"refuted: a pole at {pole:.3g} 1/s")

    def above(
        values: Array, where: Array, bound: float, confirm: Callable[[float], float], what: str
    ) -> None:
        for i in np.flatnonzero(~(values <= bound))[:: max(1, np.sum(~(values <= bound)) // 20)]:
            value = confirm(float(where[i]))
            if not value <= bound:
                at = where[i] / HZ
                wrong.append(f"refuted: {what} {value:.9g} above {bound:.9g} at {at:.6g} Hz")
                return

    def other(value: float, claim: float, omega: float, what: str) -> None:
        if not abs(value / claim - 1.0) <= CLOSE:
            value = exact.sensitivity(omega)
            if not abs(value / claim - 1.0) <= CLOSE:
                wrong.append(f"refuted: {what} {value:.7g}, not {claim:.7g}")

    bound = answer["certificate"]["norm_bound"] * (1.0 + 1e-6)
    above(stack, grid, bound, exact.stack, "norm")
    peak, low = answer["sensitivity_peak"], answer["sensitivity_low"]
    above(gain, grid, peak * (1.0 + CLOSE), exact.sensitivity, "|S|")
    bandwidth, omega_low = HZ * answer["bandwidth_hz"], problem.inner.omega_low
    before = grid < bandwidth
    above(gain[before], grid[before], LEVEL * (1.0 + CLOSE), exact.sensitivity, "|S| in the band")
    at, low_found = sensitivity_gain(plant, K, np.array([bandwidth, omega_low]))
    other(float(at), LEVEL, bandwidth, "|S| at the bandwidth")
    other(float(low_found), low, omega_low, "|S| at omega_low")
    if optimum:
        if not peak <= problem.inner.S_max * (1.0 + CLOSE):
            wrong.append(f"refuted: peak {peak:.7g} above S_max")
        if not low <= problem.inner.S_low * (1.0 + CLOSE):
            wrong.append(f"refuted: |S| at omega_low {low:.7g} above S_low")
        box = zip(problem.lower, theta, problem.upper, strict=True)
        if not all(a - 1e-9 * (c - a) <= b <= c + 1e-9 * (c - a) for a, b, c in box):
            wrong.append(f"refuted: theta {theta} outside its bounds")
        if not (constraint_values(plant_of(problem), theta) <= 1e-6).all():
            wrong.append("refuted: a constraint of the plant is not met")
    return wrong
