"""Margins, steps and warnings of a loop against what they mean."""

from dataclasses import replace

import control as ct
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles.fixed_structure_loops import FAST, LATE, loop, plant
from scipy.optimize import brentq

from ccd_casadi.analysis import LIMITS
from ccd_casadi.analysis.loop_figures import (
    LoopFigureOptions,
    largest_force_step,
    loop_entry,
    measured_entry,
    step_figures,
)
from ccd_casadi.analysis.loop_warnings import light_roots, ringing, second_crossover
from ccd_casadi.analysis.move import simulate
from ccd_casadi.analysis.setpoint import setpoint
from ccd_casadi.fixed_structure.structure import Structure
from ccd_casadi.lti.loop import Loop, Sampling, tustin
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.synthesis.closed_loop import classical_margins

HZ = 2.0 * np.pi


def pair(seed: int, sampling: Sampling | None) -> tuple[StateSpace, StateSpace]:
    """Case study 1 with a stable random controller, SI."""
    problem, kappa = loop(seed, Structure(), sampling)
    unit = problem.plants
    si = problem.structure.in_units(kappa, unit.omega_0, unit.force)
    return plant().plant_si(), problem.structure.state_space(si)


def turned(K: StateSpace, factor: float) -> StateSpace:
    return StateSpace(K.A, K.B, factor * K.C, factor * K.D)


def is_stable(G: StateSpace, K: StateSpace, sampling: Sampling | None) -> bool:
    return bool(Loop(G, K, sampling).poles.real.max() < 0.0)


@pytest.mark.parametrize("sampling", [None, FAST, LATE])
@pytest.mark.parametrize("seed", range(3))
def test_stability_is_lost_at_the_margins(seed: int, sampling: Sampling | None) -> None:
    """The gain margin by eigenvalues; a delay added to the loop likewise, sampled where it is."""
    G, K = pair(seed, sampling)
    found = loop_entry([Loop(G, K, sampling)], 20.0 * HZ, 1.5)
    assert is_stable(G, K, sampling)
    gain = found["gain_margin"]
    beyond, inside = (1.001 * gain, 0.999 / gain), (0.999 * gain, 1.001 / gain)
    assert not all(is_stable(G, turned(K, f), sampling) for f in beyond)
    assert all(is_stable(G, turned(K, f), sampling) for f in inside)
    if sampling is not None:
        late = [
            Sampling(sampling.rate_hz, sampling.delay_us + f * found["delay_margin_us"])
            for f in (0.999, 1.001)
        ]
        assert [is_stable(G, K, other) for other in late] == [True, False]


@pytest.mark.parametrize("sampling", [None, LATE])
def test_responses_are_those_of_the_matrices(sampling: Sampling | None) -> None:
    """S by the modal forms against the closed loop over a step, in z."""
    G, K = pair(1, sampling)
    made = Loop(G, K, sampling)
    step = 1e-5 if sampling is None else sampling.period
    steps = made.over_a_step(step)
    omega = np.geomspace(1.0, 0.9 * np.pi / step if sampling else 2000.0, 50)
    T = steps.T.response(omega)[:, 0, 0]
    # A continuous loop's reference is held over a step here: half a step late, to first order.
    late = 1.0 if sampling else np.exp(-0.5j * omega * step) * np.sinc(0.5 * omega * step / np.pi)
    size = np.abs(T).max()
    np.testing.assert_allclose(1.0 - made.sensitivity(omega)[:, 0, 0],
                               T / late, atol=size * (1e-9 if sampling else 1e-2))  # fmt: skip


@given(st.floats(0.3, 0.9), st.floats(5.0, 50.0))
def test_a_second_order_loop_has_the_textbook_s_step(damping: float, hz: float) -> None:
    """T = ω²/(s² + 2ζωs + ω²): overshoot exp(-πζ/√(1 - ζ²)); 1 N moves 1/(m ω²) and overshoots."""
    w, mass = hz * HZ, 3.0
    # G = 1/(m s (s + 2ζω)), K = m ω²: the plant's pole at 0 is a soft one here
    soft = 1e-4 * w
    A = np.array([[0.0, 1.0], [-soft * 2.0 * damping * w, -2.0 * damping * w - soft]])
    G = StateSpace(A, np.array([[0.0], [1.0 / mass]]), np.eye(1, 2), np.zeros((1, 1)))
    K = StateSpace(np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((1, 0)), np.array([[mass * w**2]]))
    overshoot, settling = step_figures(Loop(G, K), w)
    by_force = largest_force_step([Loop(G, K)], w).size
    expected = np.exp(-np.pi * damping / np.sqrt(1.0 - damping**2))
    assert overshoot == pytest.approx(expected, abs=1e-3)
    assert by_force == pytest.approx((1.0 + expected) / (mass * w**2), rel=2e-3)
    # the envelope exp(-ζωt)/√(1-ζ²) is inside 2 % then, and was outside half an oscillation ago
    inside = np.log(0.02 * np.sqrt(1.0 - damping**2)) / (-damping * w)
    assert settling <= inside * 1.01
    assert settling >= inside - np.pi / (w * np.sqrt(1.0 - damping**2)) - 0.02 / hz


@pytest.mark.parametrize("sampling", [None, FAST])
@pytest.mark.parametrize("soft_hz", [0.05, 0.3])
def test_a_force_step_is_followed_to_its_largest(soft_hz: float, sampling: Sampling | None) -> None:
    """Two masses that are apart: a stiff loop, and a soft light spring whose overshoot comes long
    after 160 periods of ω_b; by the closed form k⁻¹(1 + exp(-πζ/√(1 - ζ²))) of the spring."""
    w, soft, damping = 50.0 * HZ, soft_hz * HZ, 0.05
    A = np.zeros((4, 4))
    A[0, 1] = A[2, 3] = 1.0
    A[1] = [-(w**2), -w, 0.0, 0.0]
    A[3] = [0.0, 0.0, -(soft**2), -2.0 * damping * soft]
    B, C = np.zeros((4, 2)), np.zeros((2, 4))
    B[1, 0], B[3, 1], C[1, 0], C[0, 2] = 1.0, 1.0, 1.0, 1.0
    none = np.zeros((2, 2))
    K = StateSpace(-np.eye(1), np.zeros((1, 2)), np.zeros((2, 1)), none)
    stiff = StateSpace(A[:2, :2], B[:2, :1], np.eye(1, 2), none[:1, :1])
    one = StateSpace(-np.eye(1), np.zeros((1, 1)), np.zeros((1, 1)), none[:1, :1])
    found = largest_force_step([Loop(StateSpace(A, B, C, none), K, sampling)], w)
    over = np.exp(-np.pi * damping / np.sqrt(1.0 - damping**2))
    assert found.size == pytest.approx((1.0 + over) / soft**2, rel=1e-3)
    assert found.seconds == pytest.approx(0.5 / soft_hz, rel=0.05)
    periods = LoopFigureOptions().periods
    assert found.seconds > (periods if soft_hz < 0.1 else 0.1 * periods) / 50.0
    assert found.pair == "output 1 by actuator 2"
    both = [Loop(stiff, one, sampling), Loop(turned(stiff, 3.0), one, sampling)]
    assert largest_force_step(both, w).plant == 1


@pytest.mark.parametrize("slow", [0.3, 3.0])
def test_what_a_force_moved_decays_with_the_slow_pole(slow: float) -> None:
    """ẏ = u + d under a PI controller: y = (exp(-at) - exp(-bt))/(b - a) after a unit step of d."""
    a, b = slow, 100.0
    G = StateSpace(*(np.array([[x]]) for x in (0.0, 1.0, 1.0, 0.0)))
    K = StateSpace(*(np.array([[x]]) for x in (0.0, 1.0, a * b, a + b)))
    largest = np.log(b / a) / (b - a)
    moved = lambda t: (np.exp(-a * t) - np.exp(-b * t)) / (b - a)  # noqa: E731
    decay = brentq(lambda t: moved(t) - 0.1 * moved(largest), largest, 100.0 / a)
    found = largest_force_step([Loop(G, K)], b)
    assert found.decay == pytest.approx(decay, abs=0.02 / a + HZ / b)
    held = largest_force_step([Loop(G, replace(K, C=0.0 * K.C))], b)
    assert held.decay == np.inf
    assert "decay_seconds" not in held.entry(scalar=True)


def test_what_two_axes_that_are_apart_move_of_each_other_by_rounding_does_not_count() -> None:
    """Two masses along turned axes: the decay is the slower one's of both alone."""
    c, s = np.cos(0.5), np.sin(0.5)
    R, one, none = np.array([[c, -s], [s, c]]), np.eye(2), np.zeros((2, 2))
    inverse = R @ np.diag([0.5, 0.25]) @ R.T
    A, C = np.block([[none, one], [none, -0.01 * one]]), np.hstack([R.T, none])
    G = StateSpace(A, np.vstack([none, inverse @ R]), C, none)
    K = StateSpace(*ss_of_pid([300.0, 8e3, 8e4, 1e3]))

    def both(each: np.ndarray) -> np.ndarray:
        return np.kron(one, each)

    whole = largest_force_step([Loop(G, StateSpace(*map(both, (K.A, K.B, K.C, K.D))))], 60.0)
    alone = [largest_force_step([Loop(StateSpace(A[::2, ::2], np.array([[0.0], [1.0 / mass]]),
                                                 np.eye(1, 2), np.zeros((1, 1))), K)], 60.0).decay
             for mass in (2.0, 4.0)]  # fmt: skip
    assert whole.decay == pytest.approx(max(alone), rel=0.05)


def ss_of_pid(values: list[float]) -> tuple[np.ndarray, ...]:
    """A, B, C, D of k_p + k_i/s + k_d s/(s/w + 1) by (k_d, k_p, k_i, w)."""
    kd, kp, ki, w = values
    A, B = np.diag([0.0, -w]), np.ones((2, 1))
    return A, B, np.array([[ki, -kd * w * w]]), np.array([[kp + kd * w]])


@pytest.mark.parametrize("sampling", [None, FAST])
def test_the_error_that_stays_is_that_of_a_long_move(sampling: Sampling | None) -> None:
    """A spring of k and a gain of 3 k: a quarter of the way is left; a free mass: nothing."""
    w, m, gain = 20.0 * HZ, 3.0, 3.0 * 3.0 * (20.0 * HZ) ** 2
    none = np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((1, 0))
    for stiffness, left in ((w**2, 0.25 * LIMITS.stroke), (0.0, 0.0)):
        A = np.array([[0.0, 1.0], [-stiffness, -2.0 * w]])
        G = StateSpace(A, np.array([[0.0], [1.0 / m]]), np.eye(1, 2), np.zeros((1, 1)))
        own = Loop(G, StateSpace(*none, np.array([[gain]])), sampling)
        made = simulate(own, setpoint(LIMITS), axis=0, forces=None, window=1e-9, bandwidth_hz=20.0)
        assert made.rest == pytest.approx(left, abs=1e-12)
        assert abs(made.error[-1]) == pytest.approx(left, abs=1e-8)
        assert np.isinf(made.settled) == (left > 0.0)


def test_zeros_and_poles_near_the_bandwidth_are_named() -> None:
    """A filter at ω_b is met by its roots and by the growth of |S| above ω_b."""
    structure = Structure()
    rng = np.random.default_rng(0)
    for _ in range(10):
        kappa = rng.normal(4.0, 0.8, len(structure.names))
        K = structure.state_space(kappa)
        expected = structure.roots(kappa)[0]
        found = np.sort(np.abs(K.zeros(50.0)))
        np.testing.assert_allclose(found, np.sort(np.abs(expected)), rtol=1e-5)
    G, K = pair(0, None)
    w = 20.0 * HZ
    A = np.array([[0.0, 1.0], [-(w**2), -2.0 * 0.05 * w]])
    C = np.array([[0.0, 2.0 * (0.02 - 0.05) * w]])  # (s² + 0.04 ws + w²)/(s² + 0.1 ws + w²)
    narrow = StateSpace(A, np.array([[0.0], [1.0]]), C, np.eye(1))
    series = StateSpace(
        np.block([[K.A, K.B @ narrow.C], [np.zeros((2, len(K.A))), narrow.A]]),
        np.vstack([K.B @ narrow.D, narrow.B]), np.hstack([K.C, K.D @ narrow.C]), K.D @ narrow.D,
    )  # fmt: skip
    before, after = light_roots(K, w), light_roots(series, w)
    new = [root for root in after if abs(root[0] / w - 1.0) < 1e-6]
    assert len(after) - len(before) == len(new) == 2
    named = {(word, round(damping, 6)) for _, damping, word in new}
    assert named == {("pole", 0.05), ("zero", 0.02)}
    of_controller = [
        sum(words.startswith("the controller") for words in entry["loop_warnings"])
        for entry in (loop_entry([Loop(G, each)], w, 1.5) for each in (K, series))
    ]  # what rings of the closed loop is told besides
    assert of_controller[1] == of_controller[0] + 2


def test_tustin_keeps_the_response_at_the_warped_frequency() -> None:
    _, K = pair(2, None)
    T = 1e-4
    k = tustin(K, T)
    omega = np.geomspace(1.0, 0.9 * np.pi / T, 40)
    z = np.exp(1j * omega * T)
    at = 2j / T * np.tan(0.5 * omega * T)

    def response(system: StateSpace, s: np.ndarray) -> np.ndarray:
        shape = s[:, None, None] * np.eye(len(system.A)) - system.A
        return (system.C @ np.linalg.solve(shape, system.B + 0j) + system.D)[:, 0, 0]

    np.testing.assert_allclose(response(k, z), response(K, at), rtol=1e-6)


def test_margins_on_dense_lines_are_those_of_the_model() -> None:
    G, K = pair(0, None)
    made, w = Loop(G, K), 20.0 * HZ
    omega = np.geomspace(1.0, 3000.0, 20_000)
    plant, controller = made.responses(omega)
    L = controller @ plant
    lines = measured_entry([(omega, L[:, 0, 0], np.abs(plant[:, 0, 0]))], K, w, 1.5)
    exact = loop_entry([Loop(G, K)], w, 1.5)
    assert lines["phase_margin_deg"] == pytest.approx(exact["phase_margin_deg"], abs=0.05)
    assert lines["gain_margin"] == pytest.approx(exact["gain_margin"], rel=1e-3)
    assert lines["delay_margin_us"] == pytest.approx(exact["delay_margin_us"], rel=1e-3)


@pytest.mark.parametrize("sampling", [None, FAST])
def test_a_loop_that_rings_near_its_bandwidth_is_reported(sampling: Sampling | None) -> None:
    """K = ω²m turns a free mass with little damping into an oscillator at ω: damping and place."""
    w, mass = 20.0 * HZ, 3.0

    def found(damping: float, bandwidth: float) -> tuple[float, float] | None:
        A = np.array([[0.0, 1.0], [0.0, -2.0 * damping * w]])
        G = StateSpace(A, np.array([[0.0], [1.0 / mass]]), np.eye(1, 2), np.zeros((1, 1)))
        gain = np.array([[mass * w**2]])
        K = StateSpace(np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((1, 0)), gain)
        return ringing(Loop(G, K, sampling).poles, bandwidth)

    lag = 0.0 if sampling is None else w * (sampling.delay + 0.5 * sampling.period) / 2.0
    at, size = found(0.03 + lag, w) or (np.nan, np.nan)
    assert at == pytest.approx(w, rel=0.01)
    assert size == pytest.approx(0.03, rel=0.01 if sampling is None else 0.1)
    assert found(0.03 + lag, 0.45 * w) is None
    assert found(0.03 + lag, 2.2 * w) is None
    assert found(0.06 + lag, w) is None


@given(st.floats(1.5, 3.0), st.floats(1.2, 3.0), st.floats(1.0, 4.0), st.booleans())
def test_the_crossover_is_where_the_loop_falls_not_where_it_grazes(
    decades: float, above: float, depth: float, rises: bool
) -> None:
    """A notch far below that takes |L| under 1, a resonance above that takes it over, and a plant
    without integrator whose loop begins under 1."""

    def smooth(w: np.ndarray) -> np.ndarray:
        s = 1j * w
        begin = (s / (s + 1e-3)) ** 3 if rises else 1.0
        return np.asarray(begin / s / (0.1 * s + 1.0))

    def response(w: np.ndarray) -> np.ndarray:
        s = 1j * w
        low, high = 10.0**-decades, 3.0 * above
        width = 0.1 / depth * low  # at the notch |L| is 1/depth of what takes it to 1
        notch = (s**2 + 2.0 * width * low * s + low**2) / (s**2 + 0.2 * low * s + low**2)
        mode = 1.0 + 1.0 / ((s / high) ** 2 + 2e-3 * s / high + 1.0)
        return np.asarray(smooth(w) * notch * mode / 2.0)

    omega = np.geomspace(1e-6, 1e3, 20001)
    found = classical_margins(response, omega).crossover
    L = np.abs(response(omega))
    falls = omega[1:][(L[:-1] > 1.0) & (L[1:] <= 1.0)]
    alone = omega[np.flatnonzero(np.abs(smooth(omega)) > 1.0)[-1]]
    assert len(falls) > 1, "the case has something to choose from"
    assert found == pytest.approx(alone, rel=0.15)


def stage_and_lead(w: float, plant_mode: float, controller_mode: float) -> tuple[StateSpace, ...]:
    """A mass with a collocated mode, PD with its crossover at w rad/s, and a resonance of K.

    The modes are at 15 w and lightly damped; a size of 0 leaves one out.
    """
    s, mode_at = ct.tf("s"), 15.0 * w
    band = 2.0 * 0.02 * mode_at * s / (s**2 + 2.0 * 0.02 * mode_at * s + mode_at**2)
    plant = 1.0 / s**2 + plant_mode * band / (s * 2.0 * 0.02 * mode_at)
    lead = w**2 / 3.0 * (3.0 * s / w + 1.0) / (s / (10.0 * w) + 1.0)
    # of this sign L at its resonance is on the right-hand side, far from -1
    return tuple(
        StateSpace(each.A, each.B, each.C, each.D)
        for each in map(ct.ss, (plant, lead * (1.0 - controller_mode * band)))
    )


@pytest.mark.parametrize("sampling", [None, Sampling(4000.0, 50.0)])
@given(w=st.floats(20.0, 100.0))
@settings(max_examples=10, deadline=None)
def test_a_crossover_that_the_controller_adds_is_warned_of(
    w: float, sampling: Sampling | None
) -> None:
    """By a resonance of K: a warning; by one of the plant, or by none: no word."""
    entries = [
        loop_entry([Loop(G, K, sampling)], w / 2.0, 1.5)
        for G, K in (stage_and_lead(w, *sizes) for sizes in ((0.0, 60.0), (2.0, 0.0), (0.0, 0.0)))
    ]
    again = [[x for x in e["loop_warnings"] if "exceeds 1 again" in x] for e in entries]
    assert [len(one) for one in again] == [1, 0, 0]


def test_lines_warn_of_the_second_crossover_of_the_model() -> None:
    omega, w = np.geomspace(5.0, 5000.0, 20_000), 60.0
    for sizes, count in (((0.0, 60.0), 1), ((2.0, 0.0), 0)):
        G, K = stage_and_lead(w, *sizes)
        plant, controller = (x[:, 0, 0] for x in Loop(G, K).responses(omega))
        entry = measured_entry([(omega, plant * controller, np.abs(plant))], K, w / 2.0, 1.5)
        assert sum("exceeds 1 again" in x for x in entry["loop_warnings"]) == count


def test_a_light_pole_of_the_controller_is_not_excused_by_a_rising_plant() -> None:
    """Between an antiresonance and a resonance |G| rises; a resonance's far flank falls."""
    omega = np.geomspace(1.0, 1e3, 4001)
    s = 1j * omega
    plant = (s**2 + 0.8 * s + 80.0**2) / (s**2 * (s**2 + 1.5 * s + 160.0**2))
    lead = 300.0**2 / 80.0**2 * 160.0**2 / 3.0 * (3.0 * s / 30.0 + 1.0) / (s / 300.0 + 1.0) / 100.0
    band = 0.01 * 100.0 * s / (s**2 + 0.01 * 100.0 * s + 100.0**2)
    L, sizes = plant * lead, np.abs(plant)
    none, light = np.zeros(0), np.array([100.0])
    (crossover,) = omega[:-1][np.diff(np.sign(np.abs(L) - 1.0)) < 0.0][:1]
    above = np.abs(L) * (omega > 1.01 * crossover) > 1.0
    assert above.any()  # by the resonance of the plant, which is no concern
    assert second_crossover(omega, L, sizes, float(crossover), none) is None
    found = second_crossover(omega, L * (1.0 - 2e3 * band), sizes, float(crossover), light)
    assert found is not None
    assert found.low < 100.0 < found.high


@pytest.mark.parametrize("sampling", [None, Sampling(500.0)])
def test_a_slow_loop_is_followed_until_it_settles(sampling: Sampling | None) -> None:
    """By its slow pole: the error falls as e^{-rate t}; where an error stays, none waits."""
    rate, window = 0.2, 1e-7
    A, none = np.array([[0.0, 1.0], [0.0, -100.0]]), (np.zeros((0, 0)), np.zeros((0, 1)))
    G = StateSpace(A, np.eye(2, 1, -1), np.eye(1, 2), np.zeros((1, 1)))
    gain = StateSpace(*none, np.zeros((1, 0)), np.array([[rate * (100.0 - rate)]]))
    how = {"axis": 0, "forces": None, "window": window, "bandwidth_hz": 20.0}
    made = simulate(Loop(G, gain, sampling), setpoint(LIMITS), **how)
    assert made.settled == pytest.approx(np.log(LIMITS.stroke / window) / rate, rel=0.05)
    sprung = replace(G, A=A - np.array([[0.0, 0.0], [rate, 0.0]]))
    assert np.isinf(simulate(Loop(sprung, gain, sampling), setpoint(LIMITS), **how).settled)
