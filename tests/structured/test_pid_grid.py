"""PID by the search against a grid that shares nothing with it: oracles/pid_grid, coarser."""

import numpy as np
import pytest
from oracles import pid_grid

from ccd_casadi.fixed_structure.channel_design import synthesise_sections
from ccd_casadi.plants.modal import Suspension, modal_plant
from ccd_casadi.plants.plant import build_plant, mechanics
from ccd_casadi.plants.scaling import scale_plant

SMALL = pid_grid.GridOptions(coarse=(4, 7, 6, 5), gains=24, basins=2, samples=100, best=12)


def test_no_point_of_a_grid_is_better_than_the_search() -> None:
    """Two masses, force and sensor apart: the search loses nothing to the grid, nor cheats it."""
    case = pid_grid.CASES["ACC benchmark"]
    system = mechanics(build_plant(case.function, ("k",), {}), np.array([1.0]))
    suspension = Suspension(case.suspended_hz)
    plant = scale_plant(modal_plant(system, suspension), case.M_K)
    made = synthesise_sections([plant], pid_grid.PID, case.bounds, starts=4)
    assert made.certified
    loop = pid_grid.loop_of(system, suspension, (0.0,), case.bounds, case.expected_hz * pid_grid.HZ,
                         made.frequencies[0])  # fmt: skip
    own, over = pid_grid.judged(loop, made.kappa)
    assert over <= 1.0 + 1e-4
    assert own == pytest.approx(made.bandwidth, rel=1e-3)
    _, kappa, examined = pid_grid.refined(loop, SMALL)
    grid, over = pid_grid.judged(loop, kappa)
    assert examined > 10_000
    assert over < 1.01
    assert grid > 0.9 * made.bandwidth  # a grid that finds nothing shows nothing
    assert made.bandwidth >= grid * (1.0 - 5e-3 - (over - 1.0))
