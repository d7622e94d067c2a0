"""The H∞ norm against documented values, closed forms, and SLICOT's AB13DD."""

import json
from pathlib import Path

import control
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from oracles.helpers import few

from ccd_casadi.lti.norms import gains, hinf_norm
from ccd_casadi.lti.state_space import StateSpace, closed_loop

DATA = Path(__file__).parents[1] / "data"


def space(A: object, B: object, C: object, D: object) -> StateSpace:
    return StateSpace(*(np.array(part, dtype=float) for part in (A, B, C, D)))


def resonators(*pairs: tuple[float, float]) -> StateSpace:
    """Σ (s + d)/(s² + d s + k): the system of AB13DD's documented example."""
    n = 2 * len(pairs)
    A = np.zeros((n, n))
    for i, (k, d) in enumerate(pairs):
        A[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] = [[0.0, 1.0], [-k, -d]]
    B = np.tile([[1.0], [0.0]], (len(pairs), 1))
    return space(A, B, B.T, [[0.0]])


def random_system(seed: int) -> StateSpace:
    rng = np.random.default_rng(seed)
    n, m, p = rng.integers(1, 9), rng.integers(1, 4), rng.integers(1, 4)
    A = rng.standard_normal((n, n)) * 10.0 ** rng.uniform(-1, 1, (n, 1))
    A -= (np.linalg.eigvals(A).real.max() + 10.0 ** rng.uniform(-4, 0)) * np.eye(n)
    B, C = rng.standard_normal((n, m)), rng.standard_normal((p, n))
    return space(A, B, C, rng.standard_normal((p, m)) * rng.integers(0, 2))


def test_ab13dd_documented_example() -> None:
    """SLICOT's page of AB13DD: norm 0.5000000001D+06 at 0.1414213562D+01 rad/s."""
    norm, at = hinf_norm(resonators((0.5, 2e-4), (1.0, 2e-5), (2.0, 2e-6)))
    assert norm == pytest.approx(0.5000000001e6, rel=2e-10)
    assert at == pytest.approx(1.414213562, rel=1e-9)


def test_sensitivity_on_which_another_norm_did_not_converge() -> None:
    """ControlSystems.jl #1014, whose second routine says 1.3053326 at 5.806476 rad/s: too low."""
    zeros = [-101.47795511977208, -48.91219110762173, -7.282563985219324 + 7.114985406231401j,
             -7.282563985219324 - 7.114985406231401j, -7.96322290641594,
             -1.5268748507837735 + 1.2594070637611725j, -1.5268748507837735 - 1.2594070637611725j,
             -0.7114937019357614]  # fmt: skip
    poles = [-101.32273797977184, -49.510558929948274, -20.0, -11.82446898287247,
             -10.604444850836952, -5.297845964509693 + 6.146324852257861j,
             -5.297845964509693 - 6.146324852257861j, -1.4795349979133343 + 1.2376578249023653j,
             -1.4795349979133343 - 1.2376578249023653j, -0.6235091399063754,
             -0.2743617810110765]  # fmt: skip
    gain = 704.6392766532747
    loop = control.ss(control.zpk(zeros, poles, gain)) * control.ss(control.tf([0.6, 0.3], [1, 0]))
    S = control.feedback(control.ss([], [], [], [[1.0]]), loop)
    norm, at = hinf_norm(space(S.A, S.B, S.C, S.D))

    def from_factors(omega: float) -> float:
        s = 1j * omega
        P = gain * np.prod(s - np.array(zeros)) / np.prod(s - np.array(poles))
        return abs(1.0 / (1.0 + P * 0.6 * (s + 0.5) / s))

    assert from_factors(5.806476748719396) == pytest.approx(1.3053326074298346, rel=1e-12)
    assert norm == pytest.approx(max(map(from_factors, np.linspace(5.0, 6.0, 5001))), rel=1e-8)
    assert norm == pytest.approx(from_factors(at), rel=1e-9)


@pytest.mark.parametrize(
    ("A", "B", "C", "D", "norm"),
    [
        ([[-2.0]], [[3.0]], [[4.0]], [[0.0]], 6.0),  # at rest
        ([[-2.0]], [[-3.0]], [[4.0]], [[7.0]], 7.0),  # at infinite frequency
        ([[-1.0]], [[-2.0]], [[1.0]], [[1.0]], 1.0),  # all-pass
        ([[1.0]], [[1.0]], [[1.0]], [[0.0]], np.inf),  # unstable
        ([[0.0]], [[1.0]], [[1.0]], [[0.0]], np.inf),  # on the axis
        (np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((2, 0)), [[3.0], [4.0]], 5.0),
    ],
)
def test_closed_forms(A: object, B: object, C: object, D: object, norm: float) -> None:
    assert hinf_norm(space(A, B, C, D))[0] == pytest.approx(norm, rel=1e-9)


@few(max_examples=15)
@given(st.integers(0, 10**6))
def test_norm_is_attained_and_nothing_on_a_grid_is_above(seed: int) -> None:
    system = random_system(seed)
    norm, at = hinf_norm(system)
    assert gains(system, np.array([at]))[0] == pytest.approx(norm, rel=1e-9)
    poles = np.linalg.eigvals(system.A)
    grid = np.concatenate([[0.0, np.inf], np.geomspace(1e-4, 1e4, 200), np.abs(poles.imag)])
    assert gains(system, grid).max() <= norm * (1.0 + 1e-9)


@few(max_examples=15)
@given(st.integers(0, 10**6))
def test_norm_agrees_with_ab13dd(seed: int) -> None:
    import slycot

    system = random_system(seed)
    n, m, p = len(system.A), system.B.shape[1], system.C.shape[0]
    theirs, _ = slycot.ab13dd(
        "C", "I", "N", "D", n, m, p, system.A, np.eye(n), system.B, system.C, system.D, tol=1e-10
    )
    assert hinf_norm(system)[0] == pytest.approx(theirs, rel=1e-7)


def test_a_flat_maximum_far_below_the_other_poles() -> None:
    """GS of a light chain and almost a differentiator: its maximum is at 0.16 rad/s beside a pole
    of 1e6 rad/s, and rounding moves its eigenvalues of the Hamiltonian off the axis."""
    mass = np.array([1.27, 1.14, 1.95]) * 0.684
    K = sum(
        k * np.outer(e, e)
        for k, e in [
            (1.83744e6, np.array([1.0, -1.0, 0.0])),
            (2.22981e6, np.array([0.0, 1.0, -1.0])),
        ]
    )
    lam, shapes = np.linalg.eigh(K / np.sqrt(np.outer(mass, mass)))
    shapes *= np.sqrt(mass)[:, None]
    D = shapes @ np.diag(8e-4 * np.sqrt(np.maximum(lam, 0.0))) @ shapes.T
    A = np.block([[np.zeros((3, 3)), np.eye(3)], [-K / mass[:, None], -D / mass[:, None]]])
    B, C = np.zeros((6, 1)), np.zeros((1, 6))
    B[3], C[0, 0] = 1.0 / mass[0], 1.0
    G = StateSpace(A, B, C, np.zeros((1, 1)))
    stored = json.loads((DATA / "light_chain_controller.json").read_text())
    controller = space(*(stored[name] for name in "ABCD"))
    loop = closed_loop(G, controller).GS
    assert np.linalg.eigvals(loop.A).real.max() < 0.0
    most = gains(loop, np.geomspace(1e-3, 1e2, 4001)).max()
    assert hinf_norm(loop)[0] > most * (1.0 - 1e-9)
