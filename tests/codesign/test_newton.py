"""The last steps of a polish: θ to where its gradient's rounding leaves it, not J's."""

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from oracles.helpers import few, problem
from scipy.linalg import null_space
from test_kkt import MODEL, point

from ccd_casadi.codesign.kinked import newton_step, polish
from ccd_casadi.codesign.optimality import LiftedKktOptions, TrueDesign, active_at
from ccd_casadi.codesign.outer_problem import lifted_bounds
from ccd_casadi.inner_problem.objective import TrueQuantities
from ccd_casadi.inner_problem.plant_source import PlantSource
from ccd_casadi.inner_problem.problem import CoDesignProblem
from ccd_casadi.sampling.sampler import Sampler
from ccd_casadi.sampling.store import SampleStore
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.process_pool import Workers

Optimum = tuple[CoDesignProblem, Sampler, Array, Array]


@pytest.fixture(scope="module")
def inside_the_box(tmp_path_factory):
    """A polished optimum with S_max and λ(θ) in force, and the direction that they leave free."""
    folder = tmp_path_factory.mktemp("bowl")
    (folder / "plant.py").write_text(MODEL)
    source = PlantSource(None, str(folder / "plant.py"), "model", (("least", 124.5),))
    case = problem(source=source, w1=10.0)
    with SampleStore(folder / "samples.sqlite") as store:
        sampler = Sampler(case, store, Workers(1))
        x = polish(sampler.truth, point(62.0, 62.0, 600.0, 60.0)).x
        quantities = TrueQuantities(case)
        here = active_at(TrueDesign(quantities, x))
        mu = TrueDesign(quantities, x).kkt.multipliers
        strong = here.rows[[mu[name] > 0.0 for name in here.labels]]
        free = null_space(strong)[:, 0]
        yield case, sampler, x, free


def away(optimum: Optimum, size: float) -> Array:
    """`size` of the box along the free direction."""
    case, _, x, free = optimum
    lower, upper = lifted_bounds(case)
    return np.clip(x + (upper - lower) * size * free, lower, upper)


def distance(optimum: Optimum, x: Array) -> float:
    lower, upper = lifted_bounds(optimum[0])
    return float((np.abs(x - optimum[2]) / (upper - lower)).max())


def test_the_polish_ends_where_nothing_is_left(inside_the_box) -> None:
    case, _, x, _ = inside_the_box
    here = TrueDesign(TrueQuantities(case), x)
    assert here.acceptable
    assert here.kkt.stationarity < 1e-8


@few(max_examples=6)
@given(power=st.floats(-6.0, -4.0), sign=st.sampled_from([-1.0, 1.0]))
def test_a_step_ends_nearer_by_the_square(inside_the_box, power: float, sign: float) -> None:
    case = inside_the_box[0]
    size = 10.0**power
    x = away(inside_the_box, sign * size)
    quantities = TrueQuantities(case)
    end = newton_step(TrueDesign(quantities, x))
    assert end is not None
    # met: 0.6 of the square, and 4e-10 by the rounding of gradients
    assert distance(inside_the_box, end) < 3.0 * size**2 + 5e-9


@few(max_examples=3)
@example(power=-8.4, sign=1.0)  # where a descent has nothing to do: residual 5e-8
@given(power=st.floats(-9.0, -3.0), sign=st.sampled_from([-1.0, 1.0]))
def test_a_polish_from_near_by_finds_the_same_design(
    inside_the_box, power: float, sign: float
) -> None:
    case, sampler, x, _ = inside_the_box
    start = away(inside_the_box, sign * 10.0**power)
    found = polish(sampler.truth, start)
    end = found.x
    assert found.acceptable
    assert found.kkt.stationarity < 1e-8
    assert distance(inside_the_box, end) < 1e-8
    J = TrueDesign(TrueQuantities(case), x).objective
    assert found.objective == pytest.approx(J, rel=1e-8)


def test_a_step_past_the_basin_is_none(inside_the_box) -> None:
    case = inside_the_box[0]
    x = away(inside_the_box, 20.0 * LiftedKktOptions().longest_newton_step)
    quantities = TrueQuantities(case)
    assert newton_step(TrueDesign(quantities, x)) is None
