"""The second engine on a design of a set: what it compares is what is stated."""

from dataclasses import replace

import pytest
from oracles.helpers import HZ, problem

from ccd_casadi.codesign.final_judgement import second_on_weighted
from ccd_casadi.inner_problem.controller_problem import RobustSet
from ccd_casadi.inner_problem.objective import final_design


@pytest.mark.parametrize("shift", [0.0, 0.005, 0.01])
def test_figures_of_the_whole_set_are_those_of_its_worst_plant(shift: float) -> None:
    """‖S‖∞ and ‖GS‖∞ of a set are the largest of its plants, of which the model is only one."""
    case = problem(robust=RobustSet(shift, 3, (), 0.0) if shift else None)
    case = replace(case, weights=replace(case.weights, disturbance=2e8))
    design = final_design(case, (60.0, 60.0), (100.0 * HZ, 25.0 * HZ))
    assert design.figures.certified
    found = second_on_weighted(case, (60.0, 60.0), design)
    assert found.agrees, found.words
    assert found.loops == (3 if shift else 1)
