"""The kind with reference and input disturbance: theorems, other solvers, differences, cases."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from oracles.case_documents import TWO_MASS
from oracles.differences import difference
from oracles.hard_plants import close
from oracles.helpers import HZ, PAPER, few, random_plant, scaled, two_mass
from scipy.linalg import schur

from ccd_casadi.cases.case import CaseError, load_case
from ccd_casadi.cases.case_problem import problem_of
from ccd_casadi.extensions.cross_check.backends import balance, mixed_sensitivity
from ccd_casadi.inner_problem.problem import true_inner
from ccd_casadi.kernels.certified_design import design, judge
from ccd_casadi.kernels.linear_algebra import stable_subspace
from ccd_casadi.kernels.riccati import level_hamiltonian, lqr_hamiltonian
from ccd_casadi.kernels.riccati_synthesis import filter_solution, innovations_plant
from ccd_casadi.kernels.sensitivity import Code, Column
from ccd_casadi.lti.norms import hinf_norm
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.plants.plant import mechanics
from ccd_casadi.plants.scaling import ScaledPlant, scale_state_space
from ccd_casadi.synthesis.derivatives import sensitivities
from ccd_casadi.synthesis.statics import statics
from ccd_casadi.synthesis.synthesis import Design, synthesise
from ccd_casadi.synthesis.weights import Weights

seeds = st.integers(0, 10**6)
sizes = st.integers(1, 2)
TABLE = '[controller]\nstructure = "h_infinity_disturbance"\n'


def drawn(seed: int, p: int = 1) -> tuple[ScaledPlant, Weights]:
    """A stage of p channels, weights around its ω₀, W_d from 0.1 to 30 times M_K."""
    rng = np.random.default_rng(seed)
    model = random_plant(seed, rigid=1, flexible=2, inputs=p, outputs=p)
    plant = scaled(mechanics(model, (0.5, 0.5)), 1e5)
    w0 = plant.omega_0
    weights = replace(
        PAPER.at(w0 * 10.0 ** rng.uniform(-1.0, 1.0), w0 * 10.0 ** rng.uniform(-1.0, 1.0)),
        M_K=1e5, c_K=1e3, omega_K=w0, disturbance=1e5 * 10.0 ** rng.uniform(-1.0, 1.5),
    )  # fmt: skip
    return plant, weights


def in_plant_units(plant: ScaledPlant, K: StateSpace) -> StateSpace:
    w0, force = plant.omega_0, plant.force
    return StateSpace(K.A / w0, K.B / w0, K.C / force, K.D / force)


def norm_of(plant: ScaledPlant, weights: Weights, K: StateSpace) -> float:
    """The four blocks' norm by the standard plant, closed and taken to SciPy's eigenvalues."""
    standard = balance(mixed_sensitivity(plant, weights))
    return hinf_norm(close(standard, in_plant_units(plant, K)))[0]


def made(plant: ScaledPlant, weights: Weights, **options: float) -> Design:
    return synthesise(plant, weights, omega_low=1e-3 * plant.omega_0, **options)


@few(max_examples=8)
@example(326, 1)  # a peak between two uneven points of the grid, 0.5 % higher than a parabola says
@given(seeds, sizes)
def test_what_is_certified_keeps_its_norm_in_a_loop_built_otherwise(seed: int, p: int) -> None:
    plant, weights = drawn(seed, p)
    done = made(plant, weights)
    figures = done.figures
    assert figures.certificate.passed, figures.outcome
    norm = norm_of(plant, weights, done.controller)
    assert norm <= figures.certificate.norm_bound * (1.0 + 1e-9)
    # peaks that cannot pass 0.9999 of the highest are left as they are; in 6,400 draws under two
    # sets of kernels the norm was 3e-9 below to 5.5e-5 above the one named
    assert -1e-8 <= norm / figures.gamma - 1.0 <= 1.1e-4
    assert figures.gamma_lower_bound <= figures.gamma_opt * (1.0 + 1e-9)
    # a controller of another problem cannot pass the bound either
    other = made(plant, replace(weights, disturbance=0.0)).controller
    assert norm_of(plant, weights, other) >= figures.gamma_lower_bound * (1.0 - 1e-9)


def stable_solution(H: np.ndarray) -> np.ndarray | None:
    """None where eigenvalues lie on the axis, which rounding may well part N to N."""
    poles = np.linalg.eigvals(H)
    _, Z, count = schur(H, sort="lhp")
    N = len(H) // 2
    if count != N or (np.abs(poles.real) <= 1e-9 * np.abs(poles)).any():
        return None
    return np.asarray(Z[N:, :N] @ np.linalg.inv(Z[:N, :N]))


@few(max_examples=6)
@example(543, 2)  # below γ_opt four eigenvalues on the axis, parted N to N
@given(seeds, sizes)
def test_one_riccati_equation_stands_for_two_and_their_coupling(seed: int, p: int) -> None:
    """X̂ = X(I - YX/γ²)⁻¹ with X of the four-block problem; ρ(XY) < γ² above γ_opt only."""
    plant, weights = drawn(seed, p)
    A, B, C = plant.A, plant.B, plant.C
    w, delta = weights.scale(plant.omega_0), weights.delta
    Y, ok = filter_solution(A, B, C, delta)
    assert ok
    residual = A @ Y + Y @ A.T + delta**2 * B @ B.T - Y @ C.T @ C @ Y
    assert np.abs(residual).max() <= 1e-9 * max(1.0, np.abs(Y).max()) ** 2
    assert np.linalg.eigvalsh(Y).min() >= -1e-10 * np.abs(Y).max()
    gp = innovations_plant(A, B, C, w, Y)
    H0 = lqr_hamiltonian(gp)
    figures = made(plant, weights).figures
    standard, n = mixed_sensitivity(plant, weights), len(A)
    N = len(standard.A)
    whole = np.zeros((N, N))
    whole[:n, :n] = Y
    D1 = np.hstack([standard.D11, standard.D12])
    B_ = np.hstack([standard.B1, standard.B2])

    def four_block(gamma: float) -> np.ndarray | None:
        R = D1.T @ D1
        R[: 2 * p, : 2 * p] -= gamma**2 * np.eye(2 * p)
        S = np.linalg.solve(R, np.hstack([D1.T @ standard.C1, B_.T]))
        F = standard.A - B_ @ S[:, :N]
        Q = standard.C1.T @ standard.C1 - standard.C1.T @ D1 @ S[:, :N]
        return stable_solution(np.block([[F, -B_ @ S[:, N:]], [-Q, -F.T]]))

    gamma = 1.05 * figures.gamma_opt
    X = four_block(gamma)
    assert X is not None
    coupling = np.abs(np.linalg.eigvals(X @ whole)).max()
    assert coupling < gamma**2
    t = gamma**2 - gp[5] ** 2
    _, U1, U2, _, ok = stable_subspace(level_hamiltonian(H0, gp[1], gp[3], gp[5], t))
    assert ok
    hat = X @ np.linalg.inv(np.eye(N) - whole @ X / gamma**2)
    assert np.abs(U2 @ np.linalg.inv(U1) - hat).max() <= 1e-4 * np.abs(hat).max()
    if not figures.limited_by_bound:
        below = 0.995 * figures.gamma_opt
        X = four_block(below)
        lost = X is None or np.linalg.eigvalsh(0.5 * (X + X.T)).min() < -1e-6 * np.abs(X).max()
        assert lost or np.abs(np.linalg.eigvals(X @ whole)).max() >= below**2


def test_gamma_opt_is_that_of_sb10ad() -> None:
    from ccd_casadi.extensions.cross_check.backends import solve_slicot

    compared = 0
    for seed in range(6):
        plant, weights = drawn(seed, 1 + seed % 2)
        figures = made(plant, weights).figures
        if figures.limited_by_bound:  # which SB10AD decides by rounding
            continue
        standard = mixed_sensitivity(plant, weights)
        s = 1e3 / figures.gamma_opt  # below 67 SB10AD claims 67 for one channel
        standard = replace(standard, C1=s * standard.C1, D11=s * standard.D11, D12=s * standard.D12)
        assert solve_slicot(standard).gamma_opt == pytest.approx(1e3, rel=1e-6)
        compared += 1
    assert compared >= 3


def test_rigid_bodies_need_no_suspension_and_stand_stiffly() -> None:
    """A free mass with a mode: |GS(0)| <= γ/(|W_S(0)| W_d) by the norm of its block."""
    A = np.zeros((4, 4))
    A[0, 1], A[2, 3], A[3, 2], A[3, 3] = 1.0, 1.0, -(600.0**2), -2.0 * 0.01 * 600.0
    B, C = np.array([[0.0], [0.01], [0.0], [0.01]]), np.array([[1.0, 0.0, -0.8, 0.0]])
    plant = scale_state_space(StateSpace(A, B, C, np.zeros((1, 1))), 1e7)
    weights = replace(PAPER.at(300.0, 6000.0), M_K=1e7, disturbance=1e8)
    done = made(plant, weights)
    assert done.figures.certified
    softer = plant.plant_si()
    softer.A[1, 0] -= 1e-9  # G(0) itself is infinite
    rest = statics(softer, done.controller, bandwidth=300.0, omega_low=HZ)
    assert rest.compliance <= done.figures.gamma * weights.A_S / weights.disturbance * 1.01
    assert rest.stiffness > 1e3 * weights.M_K


def test_the_certificate_refuses_a_bound_below_the_norm_and_a_loop_without_its_disturbance() -> (
    None
):
    plant = two_mass(60.0, 60.0)
    weights = replace(PAPER.at(100.0 * HZ, 1000.0 * HZ), disturbance=2e8)
    done = made(plant, weights)
    K = in_plant_units(plant, done.controller)
    arguments = (plant.A, plant.B, plant.C, K.A, K.B, K.C, K.D, weights.scale(plant.omega_0))

    def code(delta: float, gamma: float) -> Code:
        row = np.full(int(Column.COUNT), np.nan)
        judge(*arguments, delta, gamma, 1e-3, row)
        return Code(int(row[Column.CODE]))

    norm = done.figures.gamma
    assert code(weights.delta, norm * (1.0 + 1e-6)) is Code.CERTIFIED
    assert code(weights.delta, norm * (1.0 - 1e-3)) is Code.NORM_EXCEEDED
    assert code(2.0 * weights.delta, norm * (1.0 + 1e-6)) is Code.NORM_EXCEEDED


def test_an_undamped_mode_that_no_force_drives_is_never_passed() -> None:
    """The loop keeps its pole on the axis, whatever rounding makes of the filter's Hamiltonian."""
    A = np.zeros((4, 4))
    A[0, 1], A[1, 0], A[1, 1] = 1.0, -1.0, -0.1
    A[2, 3], A[3, 2] = 1.0, -4.0
    B, C = np.array([[0.0], [1.0], [0.0], [0.0]]), np.array([[1.0, 0.0, 1.0, 0.0]])
    w = np.array([2.0, 1e-4, 1.0, 1e2, 1.0, 1.0, 1e-2, 10.0])
    grid = np.geomspace(1e-3, 1e3, 62)
    row = design(A, B, C, w, grid, np.ones(62), 1.02, 1e-2, 0.0, (), 1.0)[0]
    assert Code(int(row[Column.CODE])) in (
        Code.FILTER_FAILED, Code.UNSTABLE_LOOP, Code.RICCATI_FAILED, Code.GAMMA_NOT_CONVERGED
    )  # fmt: skip


NAMES = ("M_S", "omega_S", "omega_K", "A_l", "omega_T", "disturbance")
# seed, channels, factors of ω_S and W_d, whether γ_jω limits
POINTS = ((3, 1, 1.0, 1.0, False), (8, 2, 1.0, 1.0, False), (25, 1, 1.0, 10.0, True),
          (6, 2, 0.1, 10.0, True))  # fmt: skip


@pytest.mark.parametrize(("seed", "p", "of_S", "of_d", "limited"), POINTS)
def test_derivatives_are_those_of_differences(
    seed: int, p: int, of_S: float, of_d: float, limited: bool
) -> None:
    """ω_b, ln‖S‖∞, ln|S(jω_low)| and γ_opt to θ and the weights; fourth-order differences."""
    model = random_plant(seed, rigid=1, flexible=2, inputs=p, outputs=p)
    plant, weights = drawn(seed, p)
    weights = replace(
        weights, omega_S=of_S * weights.omega_S, disturbance=of_d * weights.disturbance
    )  # fmt: skip
    theta = np.array([0.5, 0.5])
    low = 0.1 * plant.omega_0

    def at(theta: np.ndarray, w: Weights) -> ScaledPlant:
        return scaled(mechanics(model, tuple(theta)), w.M_K)

    done = sensitivities(at(theta, weights), weights, omega_low=low)
    assert done.figures.certificate.passed
    assert done.figures.limited_by_bound == limited
    moves = [("theta", i) for i in range(2)] + [(name, 0) for name in NAMES]
    worst = 0.0
    for name, i in moves:

        def value(h: float, name: str = name, i: int = i) -> np.ndarray:
            if name == "theta":
                moved = theta + h * np.eye(2)[i]
                return sensitivities(at(moved, weights), weights, omega_low=low).values
            w = replace(weights, **{name: getattr(weights, name) * np.exp(h)})
            return sensitivities(at(theta, w), w, omega_low=low).values

        exact = done.to_theta[:, i] if name == "theta" else done.to_weights[name]
        size = np.array([done.values[0], 1.0, 1.0, done.values[3]])
        found = difference(value, 2e-3)
        error = np.abs(found - exact) / np.maximum(np.abs(exact), 1e-2 * size)
        worst = max(worst, float(error.max()))
    assert worst < 1e-5


# ---- cases --------------------------------------------------------------------------------------


def case(folder: Path, table: str, weights: str = "") -> Path:
    path = folder / "case.toml"
    text = TWO_MASS.read_text().replace("[weights]", f"[weights]\n{weights}")
    path.write_text(f"{text}\n{table}")
    return path


def test_a_case_asks_for_the_kind_and_gets_its_inner_optimum(tmp_path: Path) -> None:
    """The same plant and bounds: a hundredth of the compliance, ω_b* as the search finds it."""
    problem = problem_of(load_case(case(tmp_path, TABLE)))
    assert problem.weights.disturbance == 10.0 * problem.weights.M_K
    found = true_inner(problem, (60.0, 60.0))
    assert found.optimum is not None
    assert problem.inner.feasible(found.optimum.figures)
    assert "S_max" in found.active
    given = problem_of(load_case(case(tmp_path, TABLE, "disturbance = 3e7")))
    assert given.weights.disturbance == 3e7
    assert given.identity() != problem.identity()


def test_a_disturbance_without_its_kind_is_a_mistake(tmp_path: Path) -> None:
    with pytest.raises(CaseError, match=r"weights\.disturbance.*h_infinity_disturbance"):
        load_case(case(tmp_path, "", "disturbance = 3e7"))
    with pytest.raises(CaseError, match=r"controller\.biquads"):
        load_case(case(tmp_path, TABLE + "biquads = 3"))
