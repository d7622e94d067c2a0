"""k of m inputs: exact against enumeration, by bounds that no choice is below."""

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from oracles.helpers import few

from ccd_casadi.kernels.gamma import plant_gain
from ccd_casadi.plants.modal import ModalPlant
from ccd_casadi.plants.scaling import ScaledPlant, scale_plant
from ccd_casadi.support.errors import UserError
from ccd_casadi.support.text import HZ
from ccd_casadi.synthesis.choice import _squared_gamma, choose_inputs
from ccd_casadi.synthesis.synthesis import synthesise
from ccd_casadi.synthesis.weights import Weights

M_K = 1e6
WEIGHTS = Weights(M_S=2.0, A_S=1e-3, omega_S=40.0 * HZ, c_K=1e4, omega_K=1e3 * HZ, M_K=M_K,
                  A_l=1.0, A_u=1e-2, omega_T=60.0 * HZ)  # fmt: skip
INPUTS = 6


def plate(seed: int, outputs: int = 2) -> ScaledPlant:
    """Two suspended rigid modes and two flexible ones, that inputs drive by random strengths."""
    rng = np.random.default_rng(seed)
    natural = np.array([0.1, 0.1, *rng.uniform(100.0, 400.0, 2)]) * HZ
    zeta = np.array([0.7, 0.7, 0.02, 0.02])
    B, C = rng.normal(size=(4, INPUTS)), rng.normal(size=(outputs, 4))
    n, none = len(natural), np.zeros((0, 4, 4))
    modal = ModalPlant(
        K=np.diag(natural**2), D=np.diag(2.0 * zeta * natural), B=B, C=C, dM=none, dD=none,
        dK=none, dB=np.zeros((0, n, INPUTS)), dC=np.zeros((0, outputs, n)), natural=natural,
        rigid=natural < HZ, modes=np.eye(n),
    )  # fmt: skip
    return scale_plant(modal, M_K)


@pytest.mark.slow
@few(5)
@given(st.integers(0, 99))
def test_the_choice_is_that_of_enumeration(seed: int) -> None:
    plant = plate(seed)
    found = choose_inputs(plant, WEIGHTS, 3)
    every = {}
    for inputs in combinations(range(INPUTS), 3):
        own = _with(plant, inputs)
        figures = synthesise(own, WEIGHTS, omega_low=HZ).figures
        every[inputs] = figures.gamma_opt if figures.certified else np.inf
    assert found.gamma_opt == pytest.approx(min(every.values()), rel=1e-6)
    assert every[found.inputs] == pytest.approx(found.gamma_opt, rel=1e-6)
    assert found.syntheses <= len(every)


@few(10)
@given(st.integers(0, 99))
def test_a_synthesis_bounds_all_presences(seed: int) -> None:
    """γ_opt² lies above its tangents, and these are those of differences."""
    plant, rng = plate(seed), np.random.default_rng(seed)
    at, other = rng.dirichlet(np.ones(INPUTS), 2) * 3.0 + 0.01
    value, slope = _squared_gamma(plant, WEIGHTS, at)
    there = _squared_gamma(plant, WEIGHTS, other)[0]
    assert there >= value + slope @ (other - at) - 1e-6 * value
    step = 1e-4 * rng.normal(size=INPUTS) * at
    ends = [_squared_gamma(plant, WEIGHTS, at + sign * step)[0] for sign in (1.0, -1.0)]
    assert (ends[0] - ends[1]) / 2.0 == pytest.approx(slope @ step, rel=1e-4, abs=1e-8 * value)


def test_what_does_not_fit_is_one_sentence() -> None:
    with pytest.raises(UserError, match="give a number from 2 to 6"):
        choose_inputs(plate(0), WEIGHTS, 1)
    with pytest.raises(UserError, match="without an input disturbance"):
        choose_inputs(plate(0), replace(WEIGHTS, disturbance=1e3), 3)


def _with(plant: ScaledPlant, inputs: tuple[int, ...]) -> ScaledPlant:
    """The plant with some of its inputs, scaled anew from SI."""
    B = plant.B[:, list(inputs)]
    gain = plant_gain(plant.A, B, plant.C, plant.grid)
    return replace(plant, B=B, dB=plant.dB[:, :, list(inputs)], gain=gain, channels=())
