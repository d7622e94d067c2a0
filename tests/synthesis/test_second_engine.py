"""SLICOT against this package's own norms, and what it says of claims that are not true."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles.helpers import HZ, problem

from ccd_casadi.inner_problem.problem import scaled_plant
from ccd_casadi.lti.loop import Sampling, tustin, zoh
from ccd_casadi.lti.norms import hinf_norm
from ccd_casadi.lti.state_space import StateSpace, closed_loop
from ccd_casadi.synthesis import second_engine
from ccd_casadi.synthesis.second_engine import SecondEngineOptions, second_opinion, weighted_loop
from ccd_casadi.synthesis.synthesis import Design, synthesise

THETA = (60.0, 62.0)
AGREEMENT = SecondEngineOptions().agreement


def made(disturbance: float = 0.0, point: tuple[float, float] = (300.0, 60.0)) -> Design:
    weights = replace(problem().weights.at(*(HZ * hz for hz in point)), disturbance=disturbance)
    return synthesise(scaled_plant(problem(), THETA), weights, omega_low=problem().inner.omega_low)


@given(st.floats(100.0, 1500.0), st.floats(30.0, 100.0), st.sampled_from([0.0, 2e6]))
@settings(max_examples=10, deadline=None)
def test_it_confirms_what_is_certified(S: float, T: float, disturbance: float) -> None:
    design = made(disturbance, (S, T))
    if not design.figures.certified:
        return
    plant = scaled_plant(problem(), THETA).plant_si()
    found = second_opinion(plant, design.controller, weights=design.weights)
    assert found.norms
    assert not found.reason
    assert not found.contradictions(
        S=design.figures.sensitivity_peak, weighted_loop=design.figures.certificate.norm
    )
    assert found.max_real_pole < 0.0


@pytest.mark.parametrize("delay_us", [0.0, 30.0, 250.0])
def test_a_sampled_loop_has_the_norm_of_the_bilinear_one(delay_us: float) -> None:
    design, sampling = made(), Sampling(20e3, delay_us)
    plant = scaled_plant(problem(), THETA).plant_si()
    found = second_opinion(plant, design.controller, sampling)
    T = sampling.period
    loop = closed_loop(zoh(plant, T, sampling.delay), tustin(design.controller, T))
    assert found.stable == (np.abs(loop.S.poles).max() < 1.0)
    if found.stable:
        assert found.norms["S"] == pytest.approx(hinf_norm(loop.S)[0], rel=AGREEMENT)


@pytest.mark.parametrize("disturbance", [0.0, 3e6])
def test_the_weighted_loop_is_that_of_the_weights(disturbance: float) -> None:
    """Block by block, from responses of the loop and of the weights."""
    design = made(disturbance)
    plant = scaled_plant(problem(), THETA).plant_si()
    loop, omega = closed_loop(plant, design.controller), np.geomspace(1.0, 1e5, 60)
    W = design.weights.responses(omega)
    S, T, GS, KS = (one.response(omega)[:, 0, 0] for one in (loop.S, loop.T, loop.GS, loop.KS))
    found = np.abs(weighted_loop(loop, design.weights).response(omega))
    last = KS / (design.weights.delta * design.weights.M_K) if disturbance else T
    of_reference = np.abs(W * np.array([S, KS, last]))
    np.testing.assert_allclose(found[:, :, 0].T, of_reference, rtol=1e-8, atol=1e-11)
    if disturbance:
        of_force = disturbance * np.abs(W[:2] * np.array([GS, T]))
        np.testing.assert_allclose(found[:, :2, 1].T, of_force, rtol=1e-8, atol=1e-11)


def test_a_false_claim_an_unstable_loop_and_no_answer_are_reported_apart(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    design, plant = made(), scaled_plant(problem(), THETA).plant_si()
    found = second_opinion(plant, design.controller)
    peak = design.figures.sensitivity_peak
    assert found.contradictions(S=peak * (1.0 + 3.0 * AGREEMENT))
    assert found.contradictions(S=float("nan"))
    turned = replace(design.controller, C=-design.controller.C)
    lost = second_opinion(plant, turned)
    assert not lost.stable
    assert lost.contradictions(S=peak)

    def fails(*_: object, **__: object) -> None:
        raise second_engine.slycot.exceptions.SlycotArithmeticError("no", 3)

    for answer in (fails, lambda *_, **__: (float("nan"), 0.0)):
        monkeypatch.setattr(second_engine.slycot, "ab13dd", answer)
        unknown = second_opinion(plant, design.controller)
        assert "SLICOT has no" in unknown.reason


@pytest.mark.parametrize("seed", range(4))
def test_a_stiff_link_hides_no_peak(seed: int) -> None:
    """A speck of mass on a stiff spring: the second engine meets what a dense grid meets."""
    rng = np.random.default_rng(seed)
    mass = np.array([5.0, 7.0, 10.0 ** rng.uniform(-6.0, -4.0)])
    springs = (5e4, 1e6, 10.0 ** rng.uniform(8.0, 10.0))  # to ground, between, the link
    K = np.diag([springs[0], 0.0, 0.0])
    for i, k in enumerate(springs[1:]):
        K[i : i + 2, i : i + 2] += k * np.array([[1.0, -1.0], [-1.0, 1.0]])
    D = 1e-5 * K + np.diag([5.0, 5.0, 0.0])
    A = np.block([[np.zeros((3, 3)), np.eye(3)], [-K / mass[:, None], -D / mass[:, None]]])
    B = np.concatenate([np.zeros(3), [1.0 / mass[0], 0.0, 0.0]])[:, None]
    plant = StateSpace(A, B, np.eye(6)[:1], np.zeros((1, 1)))
    pole = 2e3  # a lead: k (1 + s/40)/(1 + s/pole)
    gain = 2e4 * rng.uniform(0.5, 2.0)
    lead = StateSpace(
        np.array([[-pole]]), np.array([[1.0]]),
        np.array([[gain * pole * (1.0 - pole / 40.0)]]), np.array([[gain * pole / 40.0]]),
    )  # fmt: skip
    opinion = second_opinion(plant, lead)
    assert opinion.stable
    omega = np.geomspace(1.0, 3e3, 20_000)
    s = 1j * omega
    G = np.array([np.linalg.solve(K + x * D + x * x * np.diag(mass), np.eye(3)[0])[0] for x in s])
    S = 1.0 / (1.0 + G * gain * (1.0 + s / 40.0) / (1.0 + s / pole))
    assert opinion.norms["S"] >= np.abs(S).max() * (1.0 - 1e-6)
