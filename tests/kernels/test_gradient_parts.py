"""Pull-backs and the bound's gradient against adjoints and differences, at one frequency."""

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from oracles.differences import difference
from oracles.helpers import HZ, PAPER, few, flexible_case, random_plant, scaled

from ccd_casadi.kernels import adjoint
from ccd_casadi.kernels.frequency import prepare
from ccd_casadi.kernels.gamma import gamma_lower_bound, lower_bound_squared, plant_gain
from ccd_casadi.kernels.generalized_plant import (
    generalized_plant,
    squared_weights,
    unstable_modes,
    unstable_plant,
)
from ccd_casadi.plants.plant import mechanics
from ccd_casadi.plants.scaling import ScaledPlant
from ccd_casadi.synthesis.weights import Weights

# what is compiled takes floating-point numbers only
plain_weights = getattr(squared_weights, "py_func", squared_weights)
seeds = st.integers(0, 10**6)
sizes = st.integers(1, 3)


def small_plant(seed: int, p: int) -> tuple[ScaledPlant, np.ndarray]:
    """A plant of p channels and scaled weights of which each counts."""
    model = random_plant(seed, rigid=1, flexible=2, inputs=p, outputs=p)
    plant = scaled(mechanics(model, (0.5, 0.5)), 1e5)
    w0 = plant.omega_0
    weights = Weights(2.0, 0.3, 0.8 * w0, 4.0, 0.7 * w0, 1e5, 0.9, 0.3, 1.3 * w0)
    return plant, weights.scale(w0)


@few(max_examples=20)
@given(seeds, sizes, sizes)
def test_the_pull_back_is_the_adjoint_of_building_the_plant(seed: int, m: int, p: int) -> None:
    """⟨Ā, dA_g⟩ + ⟨B̄2, dB2⟩ + ⟨C̄1, dC1⟩ + ⟨C̄2, dC2⟩ = ⟨pulled back, (dA, dB, dC)⟩."""
    rng = np.random.default_rng(seed)
    n = 4
    A, B, C = (rng.normal(size=shape) for shape in ((n, n), (n, m), (p, n)))
    dA, dB, dC = (rng.normal(size=matrix.shape) for matrix in (A, B, C))
    w = PAPER.scale(100.0 * HZ)
    w[3] = 3.0
    before, after = generalized_plant(A, B, C, w), generalized_plant(A + dA, B + dB, C + dC, w)
    changes = [after[i] - before[i] for i in (0, 2, 3, 4)]
    cotangents = [rng.normal(size=change.shape) for change in changes]
    A_g, B2, C1, C2 = (part[None] for part in cotangents)
    B1 = np.zeros_like(before[1])[None]
    of = adjoint.PlantGradients(A_g, 0.0 * A_g, B1, B2, C1, 0.0 * C1, C2)
    A_, B_, C_, _ = adjoint.MixedPullback(A, B, C, w).to_plant_and_weights(of)
    there = sum(np.sum(x * y) for x, y in zip(cotangents, changes, strict=True))
    back = np.sum(A_ * dA) + np.sum(B_ * dB) + np.sum(C_ * dC)
    size = sum(np.abs(x * y).sum() for x, y in zip(cotangents, changes, strict=True))
    assert there == pytest.approx(back, abs=1e-12 * size)


@few(max_examples=20)
@given(seeds, sizes, st.integers(1, 2))
def test_the_pull_back_of_an_unstable_plant(seed: int, p: int, count: int) -> None:
    """The same, V of the moved plant turned to the old one; 1.3e-6 at most of 2,100 draws."""
    rng, n, m = np.random.default_rng(seed), 4, 2
    T = np.linalg.qr(rng.normal(size=(n, n)))[0]
    A = T @ np.diag(np.where(np.arange(n) < count, 1.0, -1.0) * (1.0 + np.arange(n))) @ T.T
    B, C = rng.normal(size=(n, m)), rng.normal(size=(p, n))
    dA, dB, dC = (0.1 * rng.normal(size=matrix.shape) for matrix in (A, B, C))
    w = PAPER.scale(100.0 * HZ)
    w[3] = 3.0
    here = unstable_modes(A, C)
    assert here is not None

    def built(h: float) -> list[np.ndarray]:
        plant = A + h * dA, B + h * dB, C + h * dC
        there = unstable_modes(plant[0], plant[2])
        assert there is not None
        U, _, Vt = np.linalg.svd(there.V.T @ here.V)
        return list(unstable_plant(*plant, w, there._replace(V=there.V @ U @ Vt))[:5])

    changes = [difference(lambda h, i=i: built(h)[i], 3e-4) for i in range(5)]
    A_g, B1, B2, C1, C2 = cotangents = [rng.normal(size=(1, *change.shape)) for change in changes]
    of = adjoint.PlantGradients(A_g, 0.0 * A_g, B1, B2, C1, 0.0 * C1, C2)
    A_, B_, C_, _ = adjoint.UnstablePullback(A, B, C, w, here).to_plant_and_weights(of)
    there = sum(np.sum(x * y) for x, y in zip(cotangents, changes, strict=True))
    back = np.sum(A_ * dA) + np.sum(B_ * dB) + np.sum(C_ * dC)
    size = sum(np.abs(x * y).sum() for x, y in zip(cotangents, changes, strict=True))
    assert there == pytest.approx(back, abs=1e-4 * size)


@few(max_examples=40)
@given(seeds, st.floats(-6.0, 6.0))
def test_the_slopes_of_the_squared_weights(seed: int, at: float) -> None:
    """To all digits, far from the break frequencies too: against differences of exact fractions."""
    rng, omega = np.random.default_rng(seed), 10.0**at
    # M_S, A_S, ω_S, c_K, ω_K, A_l, A_u, ω_T
    w = np.array([2.0, 1e-4, 1.0, 1e4, 1.0, 0.9, 1e-2, 1.0]) * np.exp(rng.uniform(-1.0, 1.0, 8))
    found, h = adjoint.squared_weight_slopes(w, omega), Fraction(1, 10**40)
    exact = [Fraction(value) for value in w]
    for k in range(8):
        moved = exact.copy()
        moved[k] += h
        high, low = (sum(plain_weights(of, Fraction(omega))) for of in (moved, exact))
        assert found[k] == pytest.approx(float((high - low) / h), rel=1e-13, abs=0.0)


@few(max_examples=25)
@given(seeds, sizes, st.floats(-1.0, 1.0))
def test_the_gradient_of_the_bound_at_one_frequency(seed: int, p: int, at: float) -> None:
    """Along random directions of A, B, C together, and to the logarithm of each weight."""
    plant, w = small_plant(seed, p)
    rng, omega = np.random.default_rng(seed), 10.0**at
    A, B, C = plant.A, plant.B, plant.C
    dA, dB, dC = (matrix * rng.uniform(-1.0, 1.0, matrix.shape) for matrix in (A, B, C))

    def bound(h: float, k: int = -1) -> float:
        moved, x = w.copy(), 0.0 if k >= 0 else h
        if k >= 0:
            moved[k] *= np.exp(h)
        gain = plant_gain(A + x * dA, B + x * dB, C + x * dC, np.array([omega]))[0]
        return float(np.sqrt(lower_bound_squared(moved, gain, omega)))

    A_, B_, C_, w_, _ = adjoint.bound_gradient(A, B, C, w, 0.0, omega)
    found = np.sum(A_ * dA) + np.sum(B_ * dB) + np.sum(C_ * dC)
    size = bound(0.0)
    assert found == pytest.approx(difference(bound, 1e-5), rel=1e-5, abs=1e-7 * size)
    for k in range(8):
        expected = difference(lambda h, k=k: bound(h, k), 1e-3)
        assert w_[k] * w[k] == pytest.approx(expected, rel=1e-7, abs=1e-9 * size)


@few(max_examples=25)
@given(seeds, sizes, st.floats(-1.0, 1.0))
def test_the_slope_of_the_bound_over_frequency(seed: int, p: int, at: float) -> None:
    plant, w = small_plant(seed, p)
    omega = 10.0**at

    def squared(h: float) -> float:
        x = omega * np.exp(h)
        gain = plant_gain(plant.A, plant.B, plant.C, np.array([x]))[0]
        return float(lower_bound_squared(w, gain, x))

    slope = adjoint.bound_slope(plant.A, plant.B, plant.C, w, 0.0, omega) * omega
    assert slope == pytest.approx(difference(squared, 1e-5), rel=1e-6, abs=1e-7 * squared(0.0))


@pytest.mark.parametrize("off", [-3e-3, -1e-6, 1e-5, 2e-3])
def test_the_place_of_the_bound_is_found_from_either_side(off: float) -> None:
    """Next to a sharp transmission zero; from too far away it is left where it is."""
    case = flexible_case(30)
    arguments = (case.plant.A, case.plant.B, case.plant.C, case.weights.scale(case.plant.omega_0))
    start = gamma_lower_bound(
        prepare(*arguments[:3]), arguments[3], case.plant.grid, case.plant.gain
    )[1]
    top = adjoint.bound_peak(*arguments, 0.0, start)
    above, here, below = (
        adjoint.bound_slope(*arguments, 0.0, top * (1.0 + h)) for h in (1e-7, 0.0, -1e-7)
    )
    curve = (above - below) / 2e-7
    assert curve < 0.0  # dslope/dln ω
    assert abs(here) < 1e-10 * abs(curve)
    near = 1e-2 * off  # the peak is some 1e-3 of its frequency wide
    assert adjoint.bound_peak(*arguments, 0.0, top * (1.0 + near)) == pytest.approx(
        top, rel=1e-10
    )
    assert adjoint.bound_peak(*arguments, 0.0, 0.2 * top) == 0.2 * top
