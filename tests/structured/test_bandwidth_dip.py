"""No pair of a zero and a pole at ω_b buys bandwidth: the shape leaves no room for a dip of |S|."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from oracles.fixed_structure_loops import BOUNDS, FAST, loop, plant

from ccd_casadi.analysis.loop_figures import loop_entry
from ccd_casadi.analysis.loop_warnings import LoopWarningOptions, bandwidth_dip, dip_of
from ccd_casadi.fixed_structure.bounds import ShapeEnd
from ccd_casadi.fixed_structure.certificate import certify
from ccd_casadi.fixed_structure.channel_design import synthesise_sections
from ccd_casadi.fixed_structure.structure import Structure
from ccd_casadi.lti.loop import Loop
from ccd_casadi.support.text import HZ

AROUND, HALF_POWER = LoopWarningOptions().places, 2.0**-0.5
EASY = replace(BOUNDS, S_max=2.0, compliance_max=None)


@given(st.floats(1.0, 1.6), st.floats(-3.0, 3.0), st.sampled_from(list(ShapeEnd)))
def test_where_a_size_is_reached_is_the_inverse_of_what_is_allowed(
    shape: float, log_x: float, ends: ShapeEnd
) -> None:
    bounds = replace(BOUNDS, shape=shape, shape_ends=ends)
    x = np.exp(log_x + np.array([0.0, 1e-3]))
    allowed = bounds.room(x) * x
    assert allowed[1] > allowed[0]
    np.testing.assert_allclose(bounds.reached(allowed), x, rtol=1e-12)


@given(st.floats(1.0, 1.6))
def test_the_room_of_a_shape_has_no_step_at_the_bandwidth(shape: float) -> None:
    bounds = replace(BOUNDS, shape=shape)
    x = np.geomspace(0.1, 100.0, 2001)
    room = bounds.room(x)
    assert (room[x <= 1.0] == 1.0).all()
    assert room[-1] == pytest.approx(shape, rel=1e-3)
    assert (np.diff(np.log(room)) <= 2.001 * (shape - 1.0) * np.diff(np.log(x)) + 1e-12).all()


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("sampling", [None, FAST])
def test_the_judges_bandwidth_is_the_largest_within_the_shape(seed, sampling) -> None:
    problem, kappa = loop(seed, Structure(), sampling)
    P = problem.plants
    K = problem.structure.state_space(problem.structure.in_units(kappa, P.omega_0, P.force))
    figures = certify([plant()], K, BOUNDS, sampling).plants[0]
    omega = np.append(np.geomspace(0.1, 400.0, 40001) * HZ, figures.S_peak_frequency)
    S = np.abs(Loop(plant().plant_si(), K, sampling).sensitivity(omega)[:, 0, 0])

    def room(bandwidth: float) -> float:
        x = omega / bandwidth
        above = BOUNDS.shape * x - (BOUNDS.shape - 1.0) / x
        return float((HALF_POWER * np.where(x < 1.0, x, above) / S).min())

    assert room(figures.bandwidth * (1.0 - 1e-6)) >= 1.0 - 1e-6
    assert room(figures.bandwidth * (1.0 + 1e-3)) < 1.0


@given(st.floats(0.3, 2.0), st.floats(0.02, 0.3), st.floats(0.02, 0.4))
def test_a_dip_is_found_by_its_depth_and_a_slope_is_none(slope, depth, width) -> None:
    line = HALF_POWER * AROUND**slope
    assert dip_of([line]) == pytest.approx(1.0, abs=1e-12)
    narrow = HALF_POWER * AROUND * (1.0 + depth * np.tanh(np.abs(np.log(AROUND)) / (0.1 * width)))
    assert dip_of([narrow]) == pytest.approx(1.0 + depth, rel=1e-2)
    step = HALF_POWER * AROUND * np.where(AROUND > 1.0, 1.0 + depth, 1.0)
    assert dip_of([step]) == pytest.approx(1.0, abs=1e-12)


@pytest.mark.slow
def test_a_search_leaves_no_dip_at_the_bandwidth_unless_the_shape_ends_there() -> None:
    found = {}
    for ends in ShapeEnd:
        bounds = replace(EASY, shape_ends=ends)
        made = synthesise_sections([plant()], Structure(), bounds, sampling=FAST, starts=4)
        assert made.certified
        loops = [Loop(plant().plant_si(), made.controller, FAST)]
        entry = loop_entry([Loop(plant().plant_si(), made.controller, FAST)], made.bandwidth, 2.0)
        bought = [words for words in entry["loop_warnings"] if "buys" in words]
        found[ends] = bandwidth_dip(loops, made.bandwidth), made.bandwidth, len(bought)
    assert found[ShapeEnd.S_MAX][0] == pytest.approx(1.0, abs=1e-4)
    assert found[ShapeEnd.S_MAX][2] == 0
    assert found[ShapeEnd.CROSSING][0] > 1.03
    assert found[ShapeEnd.CROSSING][2] == 1
    assert found[ShapeEnd.CROSSING][1] > found[ShapeEnd.S_MAX][1]
