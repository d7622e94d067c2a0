"""λ(θ) <= 0 in whatever unit a user writes it: the same designs are allowed, active and optimal."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from oracles.helpers import few, problem

from ccd_casadi.codesign.formulations import Direct
from ccd_casadi.codesign.optimality import TrueDesign
from ccd_casadi.codesign.outer_problem import unmet_constraint
from ccd_casadi.codesign.run import solve
from ccd_casadi.inner_problem.objective import (
    ConstraintOptions,
    TrueQuantities,
    binding,
    constraint_shares,
    violations,
)
from ccd_casadi.inner_problem.plant_source import PlantSource
from ccd_casadi.inner_problem.problem import CoDesignProblem

MODEL = """
from ccd_casadi.plants.registry import two_mass

def model(theta, least, unit, zeta=0.01):
    m1, m2 = theta["m1"], theta["m2"]
    # the second is zero at both ends of the box, and at its middle
    given = {"least mass": unit * (least - m1 - m2), "order": unit * (m1 - m2)}
    return two_mass(theta, zeta) | {"hardware_cost": m1 + m2, "constraints": given}
"""
UNITS = (1e-9, 1.0, 1e9)


@pytest.fixture(scope="module")
def in_unit(tmp_path_factory):
    """The problem with its constraints in a unit, and a least mass."""
    file: Path = tmp_path_factory.mktemp("units") / "plant.py"
    file.write_text(MODEL)

    def made(unit: float, least: float = 130.0) -> CoDesignProblem:
        options = (("least", least), ("unit", unit))
        source = PlantSource(None, str(file), "model", options)
        return problem(source=source, start=(62.5, 62.5))

    return made


@few(max_examples=20)
@given(
    m1=st.floats(55.0, 70.0),
    share=st.sampled_from((-1e-3, -1e-5, -1e-7, -1e-8, 0.0, 1e-8, 1e-7, 1e-5, 1e-3)),
)
def test_what_is_met_and_what_is_active_is_the_same_in_every_unit(
    in_unit, m1: float, share: float
) -> None:
    """`share` of 30 kg, by which the sum may change in the box, past the least mass."""
    theta = (m1, 130.0 - m1 - 30.0 * share)
    found = []
    for unit in UNITS:
        case = in_unit(unit)
        shares = constraint_shares(case, theta)
        assert shares[0] == pytest.approx(share, rel=1e-3, abs=1e-13)
        assert shares[1] == pytest.approx((theta[0] - theta[1]) / 30.0, rel=1e-9, abs=1e-13)
        found.append((violations(case, theta), binding(case, theta)))
    assert found[0] == found[1] == found[2]
    assert ("least mass" in found[0][0]) == (share > ConstraintOptions.met)
    assert ("least mass" in found[0][1]) == (share >= -ConstraintOptions.active)


def test_a_constraint_that_nothing_meets_is_named_in_every_unit(in_unit) -> None:
    for unit in UNITS:
        assert "least mass" in unmet_constraint(in_unit(unit, 141.0), 4, 0)
        assert unmet_constraint(in_unit(unit, 139.0), 4, 0) == ""


def test_an_optimum_is_the_same_in_every_unit(in_unit) -> None:
    """In units of 1e9 rounding broke an active constraint, in 1e-9 any was met."""
    ends = []
    for unit in UNITS:
        case = in_unit(unit)
        solution = solve(case, Direct(starts=1, box_points=0))
        assert solution.verified is not None
        assert solution.result["status"] == "verified"
        x, kkt = solution.verified.x, solution.verified.kkt
        assert "least mass" in solution.verified.active
        assert "least mass" in kkt.active
        assert kkt.primal <= ConstraintOptions.met
        assert TrueDesign(TrueQuantities(case), x).acceptable
        mu = kkt.multipliers["least mass"] * unit
        ends.append((*solution.verified.theta, mu))
        again = TrueDesign(TrueQuantities(case), x).kkt
        assert again.stationarity <= 1e-6
    np.testing.assert_allclose(ends[0], ends[1], rtol=1e-5)
    np.testing.assert_allclose(ends[2], ends[1], rtol=1e-5)
