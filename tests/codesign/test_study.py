"""The heavier claims about case study 1, behind the `slow` marker."""

from pathlib import Path

import numpy as np
import pytest

from ccd_casadi.cases.case import load_case
from ccd_casadi.cases.case_problem import problem_of
from ccd_casadi.inner_problem.problem import plant_of, true_inner
from ccd_casadi.plants.plant import hardware_cost

CASE = Path(__file__).parents[2] / "runs" / "two_mass.toml"
BEST = -438.75639


@pytest.mark.slow
def test_no_theta_of_a_31_by_31_true_grid_beats_the_optimum() -> None:
    problem = problem_of(load_case(CASE))
    plant = plant_of(problem)
    axis = np.linspace(55.0, 70.0, 31)
    objectives = {}
    for m1 in axis:
        for m2 in axis:
            theta = (float(m1), float(m2))
            result = true_inner(problem, theta)
            objectives[theta] = (
                problem.w1 * hardware_cost(plant, theta) + problem.w2 * result.bandwidth
            )
    best = min(objectives, key=lambda theta: objectives[theta])
    assert best == (55.0, 55.0)
    assert objectives[best] == pytest.approx(BEST, rel=1e-7)
