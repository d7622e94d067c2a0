"""The weights' realisations and the generalized plant against their transfer functions."""

from dataclasses import astuple

import control
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from oracles.helpers import (
    HZ,
    PAPER,
    control_weights,
    few,
    random_plant,
    relative,
    scaled,
    state_response,
)

from ccd_casadi.kernels.generalized_plant import (
    first_order_weights,
    generalized_plant,
    squared_weights,
)
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.plants.plant import mechanics
from ccd_casadi.synthesis.weights import Weights

weights = st.builds(
    Weights,
    M_S=st.floats(1.1, 4.0),
    A_S=st.floats(1e-6, 1e-2),
    omega_S=st.floats(1e1, 1e4),
    c_K=st.floats(2.0, 1e5),
    omega_K=st.floats(1e1, 1e4),
    M_K=st.floats(1e2, 1e9),
    A_l=st.floats(0.5, 5.0),
    A_u=st.floats(1e-3, 0.1),
    omega_T=st.floats(1e1, 1e4),
)
OMEGA = np.geomspace(1e-4, 1e4, 50)  # over ω₀


@few(max_examples=60)
@given(weights, st.floats(10.0, 1e4))
def test_realisations_are_the_transfer_functions(w: Weights, omega_0: float) -> None:
    expected = w.responses(OMEGA * omega_0)
    table = first_order_weights(w.scale(omega_0))
    for i, (a, b, c, d) in enumerate(table):
        found = d + c * b / (1j * OMEGA + a)
        scale = w.M_K if i == 1 else 1.0  # M_K is absorbed in the unit of force
        # d + cb/(s + a) loses what cancels between d and cb/a
        bound = 1e-14 * (abs(d) + abs(c * b) / np.hypot(OMEGA, a))
        assert (np.abs(found - scale * expected[i]) <= bound).all()
    found = np.sqrt([squared_weights(w.scale(omega_0), omega) for omega in OMEGA]).T
    np.testing.assert_allclose(found / [[1.0], [w.M_K], [1.0]], np.abs(expected), rtol=1e-13)


@few(max_examples=30)
@given(weights)
def test_responses_are_those_of_python_control(w: Weights) -> None:
    omega = OMEGA * 100.0 * HZ
    expected = np.array([system(1j * omega) for system in control_weights(w)])
    np.testing.assert_allclose(w.responses(omega), expected, rtol=1e-13)


def test_limits_and_crossings_of_the_paper() -> None:
    zero, high = PAPER.responses(np.array([1e-9]))[:, 0], PAPER.responses(np.array([1e15]))[:, 0]
    w = PAPER
    np.testing.assert_allclose(np.abs(zero), [1 / w.A_S, 1 / w.M_K, 1 / w.A_l], rtol=1e-9)
    np.testing.assert_allclose(np.abs(high), [1 / w.M_S, w.c_K / w.M_K, 1 / w.A_u], rtol=1e-6)
    at = PAPER.at(1.0, 2.0)
    assert (at.omega_S, at.omega_T) == (1.0, 2.0)
    assert astuple(at)[:2] == astuple(PAPER)[:2]


@few(max_examples=20)
@given(st.integers(0, 10**6), weights, st.integers(1, 3), st.integers(1, 3))
def test_generalized_plant_is_the_mixed_sensitivity_one(
    seed: int, w: Weights, inputs: int, outputs: int
) -> None:
    """[W1, -W1 G; 0, W2; 0, W3 G; I, -G], block by block."""
    model = random_plant(seed, rigid=1, flexible=3, inputs=inputs, outputs=outputs)
    plant = scaled(mechanics(model, (0.5, 0.5)), w.M_K)
    A, B1, B2, C1, C2, d1, d2 = generalized_plant(
        plant.A, plant.B, plant.C, w.scale(plant.omega_0)
    )
    p, m = outputs, inputs
    D = np.zeros((2 * p + m + p, p + m))
    D[:p, :p] = d1 * np.eye(p)
    D[p : p + m, p:] = d2 * np.eye(m)
    D[2 * p + m :, :p] = np.eye(p)
    omega = np.geomspace(1e-3, 1e3, 30)
    whole = StateSpace(A, np.hstack([B1, B2]), np.vstack([C1, C2]), D)
    found = state_response(whole, omega)
    scaled_plant = StateSpace(plant.A, plant.B, plant.C, np.zeros((p, m)))
    G = state_response(scaled_plant, omega)
    W1, W2, W3 = (v[:, None, None] for v in w.responses(omega * plant.omega_0))
    W2 = W2 * w.M_K
    one = np.broadcast_to(np.eye(p), (len(omega), p, p))
    blocks = {
        "W1": (slice(0, p), slice(0, p), W1 * one),
        "-W1 G": (slice(0, p), slice(p, None), -W1 * G),
        "W2": (slice(p, p + m), slice(p, None), W2 * np.eye(m)),
        "W3 G": (slice(p + m, 2 * p + m), slice(p, None), W3 * G),
        "I": (slice(2 * p + m, None), slice(0, p), one),
        "-G": (slice(2 * p + m, None), slice(p, None), -G),
    }
    for name, (rows, columns, expected) in blocks.items():
        assert relative(found[:, rows, columns], expected) < 1e-8, name
    # r reaches neither u nor y: C A^k B = 0 for every k < n, in exact zeros (Cayley-Hamilton)
    reached = B1
    for _ in range(len(A)):
        assert (C1[p:] @ reached == 0.0).all()
        reached = A @ reached


def test_generalized_plant_of_the_paper_by_python_control() -> None:
    """The same by python-control's augw, one channel, in units where M_K = 1 and ω₀ = 1."""
    model = random_plant(3, rigid=1, flexible=2, inputs=1, outputs=1)
    plant = scaled(mechanics(model, (0.5, 0.5)), PAPER.M_K)
    w0 = plant.omega_0
    A, B1, B2, C1, C2, d1, d2 = generalized_plant(plant.A, plant.B, plant.C, PAPER.scale(w0))
    unit = Weights(2.0, 1e-4, 800 * HZ / w0, 1e4, 100 * HZ / w0, 1.0, 1.0, 1e-2, 40 * HZ / w0)
    W = [control.ss(system) for system in control_weights(unit)]
    with pytest.warns(FutureWarning, match="connect"):
        expected = control.augw(control.ss(plant.A, plant.B, plant.C, 0.0), *W)
    D = np.array([[d1, 0.0], [0.0, d2], [0.0, 0.0], [1.0, 0.0]])
    found = StateSpace(A, np.hstack([B1, B2]), np.vstack([C1, C2]), D)
    for omega in (1e-2, 0.3, 1.0, 7.0, 100.0):
        ours = state_response(found, omega)[0]
        theirs = expected(1j * omega)
        np.testing.assert_allclose(ours, theirs, rtol=1e-8, atol=1e-10 * np.abs(theirs).max())
