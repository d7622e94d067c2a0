"""The certificate refuses what it must and agrees with python-control where it accepts."""

import control
import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from oracles.helpers import (
    HZ,
    OMEGA_LOW,
    PAPER,
    assessed,
    dense_grid,
    few,
    flexible_case,
    in_time_unit,
    stack_gain,
    stack_system,
    two_mass,
)

from ccd_casadi.kernels.certified_design import certificate_grid
from ccd_casadi.kernels.frequency import prepare
from ccd_casadi.kernels.loop_certificate import level_test, stack_norm, weighted_loop
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.plants.scaling import ScaledPlant
from ccd_casadi.synthesis.synthesis import Outcome, synthesise
from ccd_casadi.synthesis.weights import Weights

masses = st.floats(55.0, 70.0)
exponents_S, exponents_T = st.floats(1.0, 3.25), st.floats(1.3, 3.0)
WEIGHTS = PAPER.at(800.0 * HZ, 40.0 * HZ)


def good(m1: float = 60.0, m2: float = 60.0, weights: Weights = WEIGHTS):
    plant = two_mass(m1, m2)
    design = synthesise(plant, weights, omega_low=OMEGA_LOW)
    assert design.figures.certified
    return plant, design


def changed(K: StateSpace, **matrices: np.ndarray) -> StateSpace:
    return StateSpace(**(vars(K) | matrices))


def independent(plant: ScaledPlant, K: StateSpace, weights: Weights) -> tuple[float, float]:
    """Largest real part of the poles over ω₀, and the norm (a dense grid), by python-control."""
    w0 = plant.omega_0
    G = in_time_unit(plant.plant_si(), w0)
    K = in_time_unit(K, w0)
    unit = weights_over(weights, w0)
    poles = stack_system(G, K, unit).poles()
    if poles.real.max() >= 0.0:
        return float(poles.real.max()), np.inf
    grid = np.unique(
        np.concatenate([dense_grid(G, K, per_decade=60), np.abs(poles), around(poles)])
    )
    return float(poles.real.max()), float(stack_gain(G, K, unit, grid).max())


def around(poles: np.ndarray) -> np.ndarray:
    flanks = np.linspace(-2.0, 2.0, 21)
    points = (poles.imag[:, None] + np.abs(poles.real)[:, None] * flanks).ravel()
    return points[points > 1e-9]


def weights_over(weights: Weights, omega_0: float) -> Weights:
    rates = {name: vars(weights)[name] / omega_0 for name in ("omega_S", "omega_K", "omega_T")}
    return Weights(**(vars(weights) | rates))


# ---- what must be refused ---------------------------------------------------------------------


def test_the_controller_as_it_is_passes() -> None:
    plant, design = good()
    figures = assessed(plant, design.controller, WEIGHTS, design.figures.certificate.norm_bound)
    assert figures.outcome is Outcome.CERTIFIED
    assert figures.bandwidth == pytest.approx(design.figures.bandwidth, rel=1e-12)
    assert figures.certificate.norm == pytest.approx(design.figures.certificate.norm, rel=1e-9)


@pytest.mark.parametrize(
    ("factor", "outcome"),
    [
        (-1.0, Outcome.UNSTABLE_LOOP),
        (30.0, Outcome.UNSTABLE_LOOP),
        (1.5, Outcome.NORM_EXCEEDED),
        (0.5, Outcome.NORM_EXCEEDED),
        (np.nan, Outcome.NOT_FINITE),
        (np.inf, Outcome.NOT_FINITE),
    ],
)
@few(max_examples=6)
@given(masses, masses)
def test_scaled_or_flipped_gain_is_refused(factor: float, outcome: Outcome, m1, m2) -> None:
    plant, design = good(m1, m2)
    K = design.controller
    with np.errstate(invalid="ignore"):
        K = changed(K, C=factor * K.C)
    figures = assessed(plant, K, WEIGHTS, design.figures.certificate.norm_bound)
    assert figures.outcome is outcome
    assert not figures.certificate.passed


@few(max_examples=10)
@given(masses, st.floats(0.01, 10.0))
def test_shifted_controller_pole_is_refused(m: float, shift: float) -> None:
    """The slow pole of K, near -ω_S A_S, pushed into the right half plane by `shift` rad/s·100."""
    plant, design = good(m, m)
    K = design.controller
    values, vectors = np.linalg.eig(K.A)
    slow = int(np.argmin(np.abs(values)))
    left = np.linalg.inv(vectors)[slow]
    A = K.A + 100.0 * shift * np.real(np.outer(vectors[:, slow], left))
    figures = assessed(plant, changed(K, A=A), WEIGHTS, design.figures.certificate.norm_bound)
    assert figures.outcome in (Outcome.UNSTABLE_LOOP, Outcome.NORM_EXCEEDED)
    fast = K.A + 2.0 * abs(values).max() * np.eye(len(values))
    figures = assessed(plant, changed(K, A=fast), WEIGHTS, 1e9)
    assert figures.outcome is Outcome.UNSTABLE_LOOP
    assert not figures.certificate.stable


@few(max_examples=10)
@given(masses, st.floats(1e-6, 1e-2))
def test_hidden_unstable_controller_pole_is_refused(m: float, rate: float) -> None:
    """A pole that no transfer function shows, but that makes the loop unstable all the same."""
    plant, design = good(m, m)
    K = design.controller
    n = K.A.shape[0]
    A = np.zeros((n + 1, n + 1))
    A[:n, :n], A[n, n] = K.A, rate * plant.omega_0
    hidden = StateSpace(A, np.vstack([K.B, [[0.0]]]), np.hstack([K.C, [[0.0]]]), K.D)
    figures = assessed(plant, hidden, WEIGHTS, 1e9)
    assert figures.outcome is Outcome.UNSTABLE_LOOP
    assert figures.certificate.max_real_pole == pytest.approx(rate * plant.omega_0, rel=1e-6)


def kernels_of(plant: ScaledPlant, controller: StateSpace, weights: Weights):
    K = in_time_unit(controller, plant.omega_0, plant.force)
    Ak, Bk, Ck, Dk = (np.ascontiguousarray(matrix) for matrix in (K.A, K.B, K.C, K.D))
    w = weights.scale(plant.omega_0)
    loop = weighted_loop(plant.A, plant.B, plant.C, Ak, Bk, Ck, Dk, w, 0.0)
    return prepare(plant.A, plant.B, plant.C), prepare(Ak, Bk, Ck), Dk, w, loop


def norms(plant: ScaledPlant, controller: StateSpace, weights: Weights):
    """The norm by the refined grid, and the level test as a function of the claim."""
    G, K, Dk, w, loop = kernels_of(plant, controller, weights)
    poles = np.linalg.eigvals(loop[0])
    norm, _ = stack_norm(G, K, Dk, w, 0.0, certificate_grid(poles.real.copy(), poles.imag.copy()))
    return norm, lambda claim: level_test(G, K, Dk, w, 0.0, loop, claim)


@few(max_examples=5)
@example(55.0, 55.56757267047337, 1.0, 2.625, -5.0)
@given(masses, masses, exponents_S, exponents_T, st.floats(-5.0, -0.5))
def test_claim_below_the_norm_is_refused_by_grid_and_level_test(m1, m2, S, T, exponent) -> None:
    """Where both see it; nearer to the norm than 1e-4 the level test alone may not.

    The eigenvalues of a loop that is nearly all-pass leave the axis there: in 4000 draws the level
    test passed 3 of the claims 1e-5 below the norm, one at 2e-5, none at 3e-5.
    """
    weights = PAPER.at(10.0**S * HZ, 10.0**T * HZ)
    plant, design = good(m1, m2, weights)
    norm, level = norms(plant, design.controller, weights)
    claim = norm * (1.0 - 10.0**exponent)
    assert norm > claim
    assert exponent < -4.0 or not level(claim)
    assert level(norm * (1.0 + 1e-6))
    figures = assessed(plant, design.controller, weights, claim)
    assert figures.outcome is Outcome.NORM_EXCEEDED


@pytest.mark.parametrize("seed", [0, 3, 6, 22, 30])
def test_claim_below_the_norm_is_refused_on_flexible_plants(seed: int) -> None:
    case = flexible_case(seed)
    design = synthesise(case.plant, case.weights, omega_low=OMEGA_LOW)
    norm, level = norms(case.plant, design.controller, case.weights)
    assert level(norm * (1.0 + 1e-5))
    for below in (1e-2, 1e-1):
        assert not level(norm * (1.0 - below))
    # nearer to the norm the eigenvalues of an all-pass loop may leave the axis: the grid decides
    for below in (1e-6, 1e-4, 1e-3, 1e-1):
        figures = assessed(case.plant, design.controller, case.weights, norm * (1.0 - below))
        assert figures.outcome is Outcome.NORM_EXCEEDED


# ---- the norm ---------------------------------------------------------------------------------


def ab13dd_norm(plant: ScaledPlant, controller: StateSpace, weights: Weights) -> float:
    """python-control's system_norm (SLICOT AB13DD) of the loop in units of ω₀ and M_K."""
    w0 = plant.omega_0
    G = StateSpace(plant.A, plant.B, plant.C, np.zeros((plant.C.shape[0], plant.B.shape[1])))
    unit = Weights(**(vars(weights_over(weights, w0)) | {"M_K": 1.0}))
    system = stack_system(G, in_time_unit(controller, w0, plant.force), unit)
    return float(control.system_norm(system, p="inf", tol=1e-9))


@few(max_examples=25)
@example(55.0, 55.0, 1.0, 1.3, 1.003)
@example(55.0, 55.0, 3.1789313979441296, 2.9244201505758287, 0.864006490846238)  # beside a pole
@given(masses, masses, exponents_S, exponents_T, st.floats(0.6, 1.2))
def test_norm_is_that_of_ab13dd(m1, m2, S, T, factor) -> None:
    """At the design, and off it where the norm is a plain peak."""
    weights = PAPER.at(10.0**S * HZ, 10.0**T * HZ)
    plant, design = good(m1, m2, weights)
    K = changed(design.controller, C=factor * design.controller.C)
    real, attained = independent(plant, K, weights)
    if real < 0.0:
        # AB13DD under-reads next to the axis, whatever its tolerance, by 4e-5 in the first example
        # (there a dense grid agrees with us to 1e-12), and a grid does so between its points.
        norm, _ = norms(plant, K, weights)
        other = max(ab13dd_norm(plant, K, weights), attained)
        assert other * (1.0 - 1e-6) <= norm <= other * (1.0 + 1e-5)


@pytest.mark.parametrize("seed", [1, 2, 23, 34])
def test_norm_is_that_of_ab13dd_on_flexible_plants(seed: int) -> None:
    case = flexible_case(seed)
    design = synthesise(case.plant, case.weights, omega_low=OMEGA_LOW)
    norm = ab13dd_norm(case.plant, design.controller, case.weights)
    assert design.figures.certificate.norm == pytest.approx(norm, rel=1e-6)


# ---- no false acceptance ----------------------------------------------------------------------


def check_perturbed(seed: int) -> bool:
    """A random controller near a good one and a random claim: accepted only if rightly so."""
    rng = np.random.default_rng(seed)
    weights = PAPER.at(10.0 ** rng.uniform(1, 3.25) * HZ, 10.0 ** rng.uniform(1.3, 3) * HZ)
    plant, design = good(*rng.uniform(55.0, 70.0, 2), weights)
    K = in_time_unit(design.controller, plant.omega_0)
    size = 10.0 ** rng.uniform(-6.0, -1.0)
    moved = {
        name: X * (1.0 + size * rng.normal(size=X.shape))
        for name, X in ((name, getattr(K, name)) for name in "ABCD")
    }
    K = in_time_unit(StateSpace(**moved), 1.0 / plant.omega_0)
    real, norm = independent(plant, K, weights)
    claim = design.figures.certificate.norm_bound * rng.choice([0.9, 1.0, 1.0, 1.1, 3.0, 10.0])
    figures = assessed(plant, K, weights, claim)
    if figures.certificate.passed:
        assert real < 0.0
        assert norm <= claim * (1.0 + 1e-9)
    elif real < -1e-9:
        # refused: the loop does exceed the claim, or all but
        assert norm > claim * (1.0 - 1e-3)
    return figures.certificate.passed


@pytest.mark.parametrize("count", [60, pytest.param(3000, marks=pytest.mark.slow)])
def test_no_perturbed_controller_is_accepted_wrongly(count: int) -> None:
    accepted = sum(check_perturbed(seed) for seed in range(count))
    assert 0.1 * count < accepted < 0.9 * count  # both answers are put to the test
