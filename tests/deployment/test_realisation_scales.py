"""The difference equation of the code does not hang on the scales of a controller's states."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import block_diag

from ccd_casadi.deployment.realisation import block_diagonal
from ccd_casadi.lti.state_space import StateSpace


def controller(decades: list[float]) -> StateSpace:
    """Two near-double pairs, a light pole pair, an integrator and a pole at 0, in one chain whose
    states differ by these decades."""
    pairs = [(0.385, 0.79), (0.999, 1.57), (0.38500002, 0.79)]
    parts = [r * np.array([[np.cos(a), np.sin(a)], [-np.sin(a), np.cos(a)]]) for r, a in pairs]
    A = block_diag(*parts, 1e-15, 1.0) + np.diag(np.full(7, 0.3), -1) * (np.arange(8) > 0)[:, None]
    scale = 10.0 ** np.array(decades)
    B, C = np.zeros((8, 1)), np.zeros((1, 8))
    B[0], C[0, -1] = 1.0, 1.0
    return StateSpace(A / scale * scale[:, None], B * scale[:, None], C / scale, np.ones((1, 1)),
                      period=0.05)  # fmt: skip


@settings(max_examples=20, deadline=None)
@given(st.lists(st.floats(-9.0, 9.0), min_size=8, max_size=8))
def test_blocks_are_the_controller_whatever_the_scales_of_its_states(decades: list[float]) -> None:
    K = controller(decades)
    found, sizes = block_diagonal(K)
    assert sum(sizes) == 8
    omega = np.geomspace(1e-2, 0.99 * np.pi / 0.05, 200)
    exact = controller([0.0] * 8).response(omega)
    made = StateSpace(found.A, found.B, found.C, found.D, period=0.05).response(omega)
    assert np.abs(made / exact - 1.0).max() < 1e-6
