"""Plant, modal form and scaling against responses formed directly from the SI matrices."""

import re
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from oracles.differences import difference
from oracles.helpers import (
    HZ,
    STIFF_SUSPENSION,
    few,
    random_plant,
    reference_matrices,
    reference_response,
    relative,
    scaled,
    state_response,
    two_mass,
    two_mass_model,
)

from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.plants.modal import Perturbation, Suspension, modal_plant
from ccd_casadi.plants.plant import Mechanics, build_plant, mechanics
from ccd_casadi.plants.scaling import ScaledPlant, scale_plant
from ccd_casadi.support.errors import PlantError

GRID = np.geomspace(0.05, 1000.0, 200) * HZ
shapes = st.fixed_dictionaries(
    {
        "rigid": st.integers(0, 3),
        "flexible": st.integers(1, 5),
        "inputs": st.integers(1, 3),
        "outputs": st.integers(1, 3),
        "modal": st.booleans(),
    }
)
seeds = st.integers(0, 10**6)
thetas = st.lists(st.floats(0.1, 0.9), min_size=2, max_size=2)


def scaled_system(plant: ScaledPlant) -> StateSpace:
    return StateSpace(plant.A, plant.B, plant.C, np.zeros((plant.C.shape[0], plant.B.shape[1])))


# ---- frequency response -----------------------------------------------------------------------


def rounding_of_stiffness(system: Mechanics, omega: np.ndarray) -> np.ndarray:
    """What eps ‖K‖ in K changes of G, relative, to first order: ‖C Z⁻¹‖ ‖Z⁻¹ B‖/|G| of it, (k,).

    Soft suspensions stand beside stiff bodies: this is up to 6e-10. In 7,400 draws under two sets
    of kernels it was met to three quarters.
    """
    M, D, K = reference_matrices(system, STIFF_SUSPENSION)
    s = 1j * omega[:, None, None]
    inverse = np.linalg.inv(s**2 * M + s * D + K)
    left = np.linalg.norm(system.C @ inverse, 2, axis=(1, 2))
    right = np.linalg.norm(inverse @ system.B, 2, axis=(1, 2))
    size = np.abs(system.C @ inverse @ system.B).max(axis=(1, 2))
    return np.finfo(float).eps * np.linalg.norm(K, 2) * left * right / size


@few(max_examples=20)
@example(1, {"rigid": 2, "flexible": 5, "inputs": 1, "outputs": 1, "modal": False}, [0.5, 0.5], 3.0)
@given(seeds, shapes, thetas, st.floats(3.0, 8.0))
def test_scaled_plant_has_the_response_of_the_si_matrices(seed, shape, theta, exponent) -> None:
    system = mechanics(random_plant(seed, **shape), theta)
    M_K = 10.0**exponent
    plant = scaled(system, M_K, STIFF_SUSPENSION)
    expected = reference_response(system, GRID, STIFF_SUSPENSION)
    allowed = 1e-12 + 2.0 * rounding_of_stiffness(system, GRID)
    scaled_response = state_response(scaled_system(plant), GRID / plant.omega_0) / M_K
    for response in (scaled_response, state_response(plant.plant_si(), GRID)):
        error = np.abs(response - expected).max(axis=(1, 2)) / np.abs(expected).max(axis=(1, 2))
        assert (error < allowed).all()


@few(max_examples=25)
@given(st.floats(55.0, 70.0), st.floats(55.0, 70.0))
def test_two_mass_plant_has_the_response_of_its_si_matrices(m1: float, m2: float) -> None:
    system = mechanics(two_mass_model(), (m1, m2))
    expected = reference_response(system, GRID)
    # rounding of K moves the 0.1 Hz suspension: eps (209/0.1)² at 0.05 Hz, far less above
    found = state_response(two_mass(m1, m2).plant_si(), GRID)
    assert relative(found, expected) < 2e-9
    assert relative(found[GRID > HZ], expected[GRID > HZ]) < 1e-10


@few(max_examples=20)
@given(seeds, shapes)
def test_states_are_stable_and_inputs_weigh_as_outputs(seed, shape) -> None:
    plant = scaled(mechanics(random_plant(seed, **shape), (0.2, 0.4)), 1e5)
    assert np.linalg.eigvals(plant.A).real.max() < 0.0
    n = plant.A.shape[0] // 2
    driven = np.linalg.norm(plant.B[n:], axis=1)
    measured = np.linalg.norm(plant.C[:, :n], axis=0)
    both = measured > 0.0  # where fewer are measured than rigid, one stands alone with c = 0
    assert both.sum() >= min(n, plant.C.shape[0])
    np.testing.assert_allclose(driven[both], measured[both], rtol=1e-12)


@few(max_examples=4)
@given(seeds, st.integers(1, 3))
def test_grid_resolves_every_resonance_and_zero(seed: int, rigid: int) -> None:
    model = random_plant(seed, rigid=rigid, flexible=4, inputs=2, outputs=2)
    plant = scaled(mechanics(model, (0.5, 0.5)), 1e5)
    system = scaled_system(plant)
    fine = np.geomspace(1e-3, 1e3, 20_001)
    gain = np.linalg.svd(state_response(system, fine), compute_uv=False)[:, -1]
    at_grid = np.linalg.svd(state_response(system, plant.grid), compute_uv=False)[:, -1]
    np.testing.assert_allclose(plant.gain, at_grid, rtol=1e-6)
    # a minimum of the least singular value between grid points must show on the grid as well
    interior = np.flatnonzero((gain[1:-1] < gain[:-2]) & (gain[1:-1] <= gain[2:])) + 1
    for i in interior:
        near = np.abs(np.log(plant.grid / fine[i])) < 0.15
        assert plant.gain[near].min() < 1.5 * gain[i]


@pytest.mark.parametrize("damping_ratio", [0.0, 1e-6, 0.01])
def test_the_grid_has_nine_points_about_each_root(damping_ratio: float) -> None:
    """Within 4.5 times the distance to the axis, or 1e-9 of the frequency for a root on it."""
    system = masses_on_springs(20.0, 70.0, 300.0, outputs=np.ones((1, 3)))
    plant = scaled(replace(system, damping_ratio=damping_ratio), 1e5)
    poles = np.linalg.eigvals(plant.A)
    roots = np.concatenate([poles, plant.system.zeros()])
    roots = roots[(roots.imag > 0.0) & (np.abs(roots) < 1e5)]
    assert len(roots) > len(poles) / 2
    for root in roots:
        half = max(abs(root.real), 1e-9 * root.imag)
        assert (np.abs(plant.grid - root.imag) <= 4.5 * half).sum() >= 9


@pytest.mark.parametrize(
    ("theta", "zero_hz", "pole_hz"),
    [((60.0, 60.0), 147.9, 209.2), ((67.56, 67.56), None, 250.0), ((58.33, 55.0), None, 192.6)],
)
def test_resonances_of_the_paper(theta, zero_hz: float | None, pole_hz: float) -> None:
    system = mechanics(two_mass_model(), theta)
    modal = modal_plant(system, Suspension())
    assert modal.natural[-1] / HZ == pytest.approx(pole_hz, abs=0.05)
    assert list(modal.rigid) == [True, False]
    grid = np.linspace(100.0, 300.0, 200_001)
    gain = np.abs(state_response(two_mass(*theta).plant_si(), grid * HZ)[:, 0, 0])
    assert grid[np.argmax(gain * (grid > 170.0))] == pytest.approx(pole_hz, abs=0.1)
    if zero_hz is not None:
        assert grid[np.argmin(gain)] == pytest.approx(zero_hz, abs=0.1)


def test_suspension_puts_the_rigid_poles_where_it_says() -> None:
    system = mechanics(two_mass_model(), (60.0, 60.0))
    for suspension in (Suspension(), Suspension(1.5, 0.3)):
        poles = np.linalg.eigvals(scaled(system, 2e7, suspension).plant_si().A)
        pole = min(poles, key=abs)
        assert abs(pole) / HZ == pytest.approx(suspension.frequency_hz, rel=1e-8)
        assert -pole.real / abs(pole) == pytest.approx(suspension.damping_ratio, rel=1e-8)


def masses_on_springs(*hz: float, outputs: np.ndarray) -> Mechanics:
    """Independent unit masses, each on a spring of its own; all are driven alike."""
    n, p = len(hz), len(outputs)
    square, none = np.zeros((0, n, n)), np.zeros((n, n))
    return Mechanics(
        np.eye(n), none, np.diag((HZ * np.array(hz)) ** 2), np.ones((n, 1)), outputs, 0.01,
        (square, square, square, np.zeros((0, n, 1)), np.zeros((0, p, n))),
    )  # fmt: skip


@pytest.mark.parametrize("top", [1e3, 1.0])
def test_what_counts_as_rigid(top: float) -> None:
    """What no spring holds, however slow a mode is that one holds."""
    for slow, rigid in ((0.0, True), (1e-7 * top, False)):
        system = masses_on_springs(slow, top, outputs=np.ones((1, 2)))
        assert list(modal_plant(system, Suspension()).rigid) == [rigid, False]


def test_a_shift_of_one_mode_stays_with_it_where_frequencies_cross() -> None:
    """In a model whose coordinates are its modes: the plant does not jump there."""
    zero, shift = np.zeros((1, 2, 2)), Perturbation(modes=(0.02, -0.02))

    def response(k: float) -> np.ndarray:
        K = np.diag([k, 4.0])
        C = np.array([[1.0, 0.3], [0.2, 1.0]])
        system = Mechanics(np.eye(2), 0.0 * K, K, C.T, C, 0.01, (zero,) * 5)
        return modal_plant(system, Suspension(), shift).state_space.response(np.linspace(1.8, 2.2))

    before, after = response(4.0 - 1e-7), response(4.0 + 1e-7)
    assert np.abs(after - before).max() <= 1e-4 * np.abs(before).max()


def test_of_two_modes_at_one_frequency_the_one_that_no_sensor_sees_stands_alone() -> None:
    system = masses_on_springs(100.0, 100.0, 170.0, outputs=np.array([[0.6, 0.8, 1.0]]))
    C = modal_plant(system, Suspension()).C
    assert sorted(np.abs(C[0])) == pytest.approx([0.0, 1.0, 1.0], abs=1e-14)
    assert (C == 0.0).sum() == 1
    apart = masses_on_springs(100.0, 100.1, 170.0, outputs=np.array([[0.6, 0.8, 1.0]]))
    assert sorted(np.abs(modal_plant(apart, Suspension()).C[0])) == pytest.approx([0.6, 0.8, 1.0])


# ---- derivatives ------------------------------------------------------------------------------


@few(max_examples=20)
@given(seeds, shapes, thetas)
def test_matrix_derivatives_are_those_of_the_matrices(seed, shape, theta) -> None:
    model = random_plant(seed, **shape)
    for i in range(2):

        def at(h: float, i: int = i) -> Mechanics:
            return mechanics(model, np.array(theta) + h * np.eye(2)[i])

        exact = at(0.0).derivatives
        for name, slope in zip("MDKBC", exact, strict=True):
            found = difference(lambda h, name=name: getattr(at(h), name), 1e-3)
            size = max(np.abs(getattr(at(0.0), name)).max(), 1e-300)
            np.testing.assert_allclose(slope[i] / size, found / size, atol=1e-11)


def response_slopes(plant: ScaledPlant, omega: np.ndarray) -> np.ndarray:
    """dG/dθ of the scaled plant at ω over ω₀ from dA, dB, dC, (n_θ, len(ω), p, m)."""
    s = 1j * omega[:, None, None]
    inverse = np.linalg.inv(s * np.eye(plant.A.shape[0]) - plant.A)
    right, left = inverse @ plant.B, plant.C @ inverse
    return np.array(
        [
            left @ dA @ right + left @ dB + dC @ right
            for dA, dB, dC in zip(plant.dA, plant.dB, plant.dC, strict=True)
        ]
    )


def check_response_slopes(model, theta, M_K: float, h: float) -> float:
    """Worst error of dG/dθ relative to |G|, against differences of the SI reference."""
    omega = np.geomspace(1.0, 500.0, 60) * HZ
    plant = scaled(mechanics(model, theta), M_K, STIFF_SUSPENSION)
    slopes = response_slopes(plant, omega / plant.omega_0) / M_K
    worst = 0.0
    for i in range(len(theta)):

        def at(step: float, i: int = i) -> np.ndarray:
            moved = np.array(theta) + step * np.eye(len(theta))[i]
            return reference_response(mechanics(model, moved), omega, STIFF_SUSPENSION)

        size = np.abs(at(0.0)).max(axis=(1, 2)) + np.abs(slopes[i]).max(axis=(1, 2))
        error = np.abs(slopes[i] - difference(at, h)).max(axis=(1, 2)) / size
        worst = max(worst, float(error.max()))
    return worst


@few(max_examples=20)
@given(seeds, shapes, thetas)
def test_response_derivatives_match_differences_of_the_si_response(seed, shape, theta) -> None:
    assert check_response_slopes(random_plant(seed, **shape), theta, 1e5, 5e-5) < 1e-6


@pytest.mark.parametrize("modal", [True, False])
@few(max_examples=4)
@given(seeds)
def test_response_derivatives_are_exact_at_double_eigenvalues(modal: bool, seed: int) -> None:
    """At θ = 0 two flexible modes coincide, and two rigid modes always do; θ splits the former."""
    rng = np.random.default_rng(seed)
    T = np.linalg.qr(rng.normal(size=(5, 5)))[0] * rng.uniform(0.7, 1.4, 5)
    coupling = rng.uniform(-1.0, 1.0, (3, 3))
    B, C = rng.normal(size=(5, 2)), rng.normal(size=(2, 5))
    stiff = np.diag([0.0, 0.0, 1.0, 1.0, 4.0]) * (100.0 * HZ) ** 2
    move = np.zeros((5, 5))
    move[2:, 2:] = (coupling + coupling.T) * 0.2 * (100.0 * HZ) ** 2

    def model(theta):
        K = ca.DM(T.T) @ (ca.DM(stiff) + ca.DM(move) * theta["t"]) @ ca.DM(T)
        out = {
            "mass": ca.DM(T.T @ T) * (1 + 0.1 * theta["t"]),
            "stiffness": 0.5 * (K + K.T),
            "input": ca.DM(B) * (1 + theta["t"]),
            "output": ca.DM(C),
            "hardware_cost": theta["t"],
        }
        return out | ({"damping_ratio": 0.02} if modal else {"damping": 1e-5 * out["stiffness"]})

    plant = build_plant(model, ["t"], {})
    natural = modal_plant(mechanics(plant, [0.0]), STIFF_SUSPENSION).natural
    assert natural[2] == pytest.approx(natural[3], rel=1e-9)  # the case is the one meant
    assert check_response_slopes(plant, [0.0], 1e5, 1e-4) < 1e-6


# ---- bad plants -------------------------------------------------------------------------------

GOOD = {
    "mass": np.diag([1.0, 2.0]),
    "stiffness": np.array([[3.0, -3.0], [-3.0, 3.0]]),
    "damping_ratio": 0.01,
    "input": np.array([[1.0], [0.0]]),
    "output": np.array([[1.0, 0.0]]),
    "hardware_cost": 1.0,
}


def model_of(changes: dict, drop: tuple[str, ...] = ()):
    result = {key: value for key, value in (GOOD | changes).items() if key not in drop}

    def model(theta: dict) -> dict:
        out = {k: ca.DM(v) if isinstance(v, np.ndarray) else v for k, v in result.items()}
        return out | {"mass": out["mass"] * theta["t"]} if "mass" in out else out

    return model


@pytest.mark.parametrize(
    ("changes", "drop", "words"),
    [
        ({}, ("mass",), "returns no mass; add it"),
        ({}, ("input", "output"), "returns no input, output; add it"),
        ({"mess": 1.0}, (), "unknown mess; drop it"),
        ({"hardware_costs": 1.0}, ("hardware_cost",),
         "returns no hardware_cost; rename hardware_costs to hardware_cost"),
        ({"Mass": 1.0}, ("mass", "output"), "rename Mass to mass, add output"),
        ({"damping_ratios": 1.0}, ("damping_ratio",), "did you mean damping_ratio?"),
        ({"damping_ratio": (0.01,)}, (), "damping_ratio is a tuple; give one number between 0"),
        ({"damping_ratio": [0.01, 0.02]}, (), "damping_ratio is a list; give one number"),
        ({"damping_ratio": ca.SX.sym("z")}, (), "damping_ratio depends on theta; return damping"),
        ({"damping": np.zeros((2, 2))}, (), "either damping or damping_ratio"),
        ({}, ("damping_ratio",), "either damping or damping_ratio"),
        ({"stiffness": np.eye(3)}, (), "stiffness is (3, 3), the mass matrix (2, 2)"),
        ({"mass": np.ones((2, 3))}, (), "mass is (2, 3)"),
        ({"input": np.ones((3, 1))}, (), "input is (3, 1)"),
        ({"output": np.ones((1, 3))}, (), "output is (1, 3); expected (p, 2), a row a sensor"),
        ({"output": np.ones((2, 1))}, (), "as mass is (2, 2): transpose it"),
        ({"input": np.ones((1, 2))}, (), "input is (1, 2); expected (2, m), a column a force"),
        ({"damping_ratio": 1.5}, (), "damping_ratio is 1.5; give a number between 0 and 1"),
        ({"damping_ratio": -0.1}, (), "damping_ratio is -0.1"),
    ],
)  # fmt: skip
def test_wrong_model_is_named_when_it_is_built(changes, drop, words: str) -> None:
    with pytest.raises(PlantError, match=re.escape(words)):
        build_plant(model_of(changes, drop), ["t"], {})


def test_unknown_option_and_missing_theta_are_named() -> None:
    with pytest.raises(PlantError, match=r"does not take its options.*zeta"):
        build_plant(model_of({}), ["t"], {"zeta": 1.0})
    with pytest.raises(PlantError, match="a theta that the case lacks: 't'"):
        build_plant(model_of({}), ["other"], {})


@pytest.mark.parametrize(
    ("changes", "theta", "words"),
    [
        ({"mass": np.array([[1.0, 0.5], [0.0, 1.0]])}, 1.0, "mass is not symmetric at theta = t=1"),
        ({"stiffness": np.array([[1.0, 2.0], [0.0, 1.0]])}, 1.0, "stiffness is not symmetric"),
        ({}, -1.0, "mass is not positive definite at theta = t=-1"),
        ({}, np.inf, "not finite at theta = t=inf"),
        ({"stiffness": np.full((2, 2), np.nan)}, 2.0, "not finite at theta = t=2"),
        ({"stiffness": np.diag([1.0, np.nan])}, 2.0, r"stiffness is nan in row 2, column 2; keep"),
        ({"input": np.array([[0.0], [np.inf]])}, 2.0, "input is inf in row 2, column 1; keep"),
        ({"output": np.array([[0.0, 1e300]])}, 2.0, "output is 1e.300 in row 1, column 2; choose"),
        ({"input": np.zeros((2, 1))}, 1.0, "input or output is zero"),
        ({"output": np.zeros((1, 2))}, 1.0, "input or output is zero"),
    ],
)
def test_wrong_matrices_are_named_at_theta(changes, theta: float, words: str) -> None:
    plant = build_plant(model_of(changes), ["t"], {})
    with pytest.raises(PlantError, match=words):
        scale_plant(modal_plant(mechanics(plant, [theta]), Suspension()), 1e3)


def test_a_slope_that_is_not_finite_is_named() -> None:
    def model(theta: dict) -> dict:
        K = ca.diag(ca.vertcat(1.0, ca.sqrt(theta["t"] - 1.0)))
        return model_of({})(theta) | {"stiffness": K}

    plant = build_plant(model, ["t"], {})
    words = "derivative of stiffness to t is inf in row 2, column 2; its value is finite"
    with pytest.raises(PlantError, match=words):
        mechanics(plant, [1.0])


def test_good_plant_of_the_bad_ones_is_accepted() -> None:
    plant = build_plant(model_of({}), ["t"], {})
    assert scaled(mechanics(plant, [1.0]), 1e3).A.shape == (4, 4)
