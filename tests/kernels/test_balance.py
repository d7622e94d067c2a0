"""Balanced coordinates: the same optimum and controller, and designs that rounding would lose."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, example, given
from hypothesis import strategies as st
from oracles.bound_error import gamma_error
from oracles.helpers import OMEGA_LOW, PAPER, flexible_case, stack_gain, two_mass

from ccd_casadi.kernels import certified_design as module
from ccd_casadi.kernels.certified_design import design
from ccd_casadi.kernels.gamma import plant_gain
from ccd_casadi.kernels.generalized_plant import generalized_plant
from ccd_casadi.kernels.riccati import RiccatiOptions, balancing, lqr_hamiltonian, rounding_noise
from ccd_casadi.kernels.riccati_synthesis import synthesise
from ccd_casadi.kernels.sensitivity import Code, Column
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.support.arrays import Array
from ccd_casadi.synthesis.weights import Weights

LOST: list[dict[str, Any]] = json.loads(
    (Path(__file__).parents[1] / "data" / "badly_scaled.json").read_text()
)
PASSED = (Code.CERTIFIED, Code.NO_BANDWIDTH)
BACKOFF = 1.02


def arguments(item: dict[str, Any]) -> tuple[Array, Array, Array, Array, Array, Array]:
    """Scaled A, B, C and weights of a stored case, with a grid through its poles."""
    A, B, C, w = (np.array(item[name]) for name in ("A", "B", "C", "w"))
    poles = np.abs(np.linalg.eigvals(A))
    grid = np.unique(np.concatenate([np.geomspace(1e-5, 1e6, 400), poles]))
    return A, B, C, w, grid, plant_gain(A, B, C, grid)


def check_certified(item: dict[str, Any], row: Array, controller: list[Array]) -> None:
    """Judged apart from the kernels: stable, and the norm below its bound."""
    A, B, C, w, *_ = arguments(item)
    Ak, Bk, Ck = controller
    loop = np.block([[A, B @ Ck], [-Bk @ C, Ak]])
    poles = np.linalg.eigvals(loop)
    assert poles.real.max() < 0.0
    G = StateSpace(A, B, C, np.zeros((len(C), B.shape[1])))
    K = StateSpace(Ak, Bk, Ck, np.zeros((B.shape[1], len(C))))
    M_S, A_S, omega_S, c_K, omega_K, A_l, A_u, omega_T = w
    weights = Weights(M_S, A_S, omega_S, c_K, omega_K, 1.0, A_l, A_u, omega_T)
    omega = np.concatenate([np.geomspace(1e-6, 1e6, 2000), np.abs(poles)])
    gains = stack_gain(G, K, weights, omega)
    assert gains.max() <= BACKOFF * row[Column.GAMMA_OPT] * (1.0 + 1e-6)
    assert gains.max() >= 0.5 * row[Column.GAMMA_OPT]


def test_designs_lost_in_the_plants_own_coordinates_are_certified(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """How one is lost in its own coordinates, and whether, is up to the processor; not the cure.

    What is not cured has no γ_opt to within the back-off, and its figures say so.
    """
    certified = saved = 0
    for item in LOST:
        A, B, C, w, *grid = arguments(item)
        numbers = (A, B, C, w, *grid, BACKOFF, 1e-3, 0.0)
        row, *controller = design(*numbers)
        with monkeypatch.context() as patch:
            patch.setattr(module, "_PASSED", tuple(Code))  # the first attempt alone
            alone = design(*numbers)[0]
        assert not alone[Column.BALANCED]
        if row[Column.CODE] in PASSED:
            check_certified(item, row, controller)
            certified += 1
            saved += alone[Column.CODE] not in PASSED
            assert row[Column.BALANCED] == (alone[Column.CODE] not in PASSED)
        else:
            other = synthesise(A, B, C, w, *grid, BACKOFF, 0.0, True)[0]
            assert other[Column.GAMMA_ERROR] > BACKOFF - 1.0
    assert len(LOST) == 5
    assert certified >= 4  # five with some kernels of OpenBLAS
    assert saved >= 1  # the others were lost while γ_jω did not count rest


@example(81, 3.0, 0.5)  # made in the plant's own coordinates K(s) would be 6e-3 off
@example(43, 1.0, 2.5)  # balanced coordinates tell 2.4e-6
@example(141, 2.0, 2.5)  # and here 6e-5 under Haswell's kernels
@given(st.integers(0, 200), st.floats(1.0, 3.0), st.floats(0.5, 2.5))
def test_the_optimum_is_the_same_in_any_coordinates(seed: int, log_S: float, log_T: float) -> None:
    """γ_opt and K(s) do not know in which coordinates they were found, but for the errors told."""
    plant = flexible_case(seed).plant if seed % 2 else two_mass(55.0 + 0.05 * seed, 60.0)
    w = PAPER.at(plant.omega_0 * 10.0 ** (log_S - 2.0), plant.omega_0 * 10.0 ** (log_T - 1.5))
    data = (plant.A, plant.B, plant.C, w.scale(plant.omega_0), plant.grid, plant.gain)
    (row, *own), (other, *balanced) = (synthesise(*data, BACKOFF, 0.0, x) for x in (False, True))
    assume(row[Column.CODE] == Code.CERTIFIED)
    assert other[Column.CODE] == Code.CERTIFIED
    # In 15,000 designs under three sets of kernels the plant's own coordinates told 3e-7 at most,
    # balanced ones 2e-6 and once 6e-5; γ_opt differed by 1e-8.
    assert gamma_error(row, *data) < 6e-7
    reported = min(gamma_error(row, *data) + gamma_error(other, *data), 1e-6)
    assert other[Column.GAMMA_OPT] == pytest.approx(row[Column.GAMMA_OPT], rel=reported)
    s = 1j * np.array([OMEGA_LOW / plant.omega_0, 0.3, 1.0, 3.0])[:, None, None]
    K, L = (
        C @ np.linalg.solve(s * np.eye(len(A)) - A, B.astype(complex))
        for A, B, C in (own, balanced)
    )
    # X has a pole at γ_opt: what is left in γ_opt counts 1/(back-off - 1) times
    assert np.abs(K - L).max() <= max(1e-6, reported / (BACKOFF - 1.0)) * np.abs(K).max()


@given(st.integers(0, 10_000), st.integers(1, 12))
def test_balancing_takes_a_bad_scaling_back(seed: int, N: int) -> None:
    """Doubling or halving any one scale makes the sum of the entries no smaller."""
    rng = np.random.default_rng(seed)
    H = rng.standard_normal((2 * N, 2 * N))
    scale = 2.0 ** rng.integers(-20, 20, N)
    both = np.concatenate([scale, 1.0 / scale])
    H = H * (both / both[:, None])
    tau = balancing(H)
    assert (np.log2(tau) == np.round(np.log2(tau))).all()

    def size(tau: Array) -> float:
        both = np.concatenate([tau, 1.0 / tau])
        M = np.abs(H * (both / both[:, None]))
        return float(M.sum() - M.trace())

    for i in range(N):
        for factor in (0.5, 2.0):
            other = tau.copy()
            other[i] *= factor
            assert size(other) >= size(tau) * (1.0 - 1e-12)


@given(st.integers(1, 5), st.data())
def test_balancing_of_few_entries_of_few_sizes(N: int, data: st.DataObject) -> None:
    """Ties and zeros: a scale that only shrinks, or only grows, the entries is left at one."""
    count = 4 * N * N
    entries = st.lists(st.sampled_from([0.0, 0.0, 1.0, 16.0]), min_size=count, max_size=count)
    H = np.array(data.draw(entries)).reshape(2 * N, 2 * N)
    tau = balancing(H)

    def entries_of(tau: Array) -> Array:
        both = np.concatenate([tau, 1.0 / tau])
        M = np.abs(H * (both / both[:, None]))
        return M - np.diag(np.diag(M))

    M = entries_of(tau)
    for i in range(N):
        k = N + i
        down, up = M[i].sum() + M[:, k].sum(), M[:, i].sum() + M[k].sum()
        if down == 0.0 or up == 0.0:
            assert tau[i] == 1.0
            continue
        for factor in (0.5, 2.0):
            other = tau.copy()
            other[i] *= factor
            assert entries_of(other).sum() >= M.sum() * (1.0 - 1e-12)


def test_balancing_by_hand() -> None:
    """The sum is 1/τ + 16 τ + 16 τ²: 33, 14, 9, 10.25 for τ = 1, 1/2, 1/4, 1/8."""
    H = np.zeros((4, 4))
    H[0, 3], H[1, 0], H[2, 0] = 1.0, -16.0, 16.0
    assert balancing(H).tolist() == [0.25, 1.0]  # the second state's entries would only shrink


def test_noise_is_what_rounding_leaves_of_a_positive_matrix() -> None:
    for item in LOST:
        A, B, C, w, *_ = arguments(item)
        gp = generalized_plant(A, B, C, w)
        noise = rounding_noise(lqr_hamiltonian(gp))
        assert RiccatiOptions.noise <= noise < 1e-2
