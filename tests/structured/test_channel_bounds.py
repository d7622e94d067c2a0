"""Bounds that single channels keep for themselves, of plants that fall apart and of others."""

from dataclasses import replace
from functools import lru_cache

import casadi as ca
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from oracles.fixed_structure_channels import (
    BOUNDS,
    FAST,
    M_K,
    STRUCTURE,
    assert_derivatives,
    loop,
    plant,
    structure,
)
from oracles.helpers import HZ, SUSPENSION, few, scaled

from ccd_casadi.fixed_structure.bounds import Bounds
from ccd_casadi.fixed_structure.certificate import certify
from ccd_casadi.fixed_structure.channel_design import synthesise_sections as synthesise
from ccd_casadi.fixed_structure.channel_structure import (
    ChannelStructure,
    channel_bounds,
    given_decoupling,
)
from ccd_casadi.fixed_structure.composite import composite_problem
from ccd_casadi.fixed_structure.design import SectionsDesign, SectionsOutcome
from ccd_casadi.fixed_structure.figures import assess, constraints, hessians
from ccd_casadi.fixed_structure.loop_problem import LoopCurve, LoopProblem
from ccd_casadi.fixed_structure.plant_set import plant_set
from ccd_casadi.fixed_structure.structure import Structure
from ccd_casadi.lti.loop import Sampling
from ccd_casadi.plants.plant import build_plant, mechanics
from ccd_casadi.plants.scaling import ScaledPlant
from ccd_casadi.support.arrays import Array

TAU = -1.5
SKEWED = given_decoupling(("1", "2", "3"), [[1, 0.2, 0], [0, 1, 0.1], [0.1, 0, 1]],
                          [[1, 0, 0.1], [0.1, 1, 0], [0, 0.1, 1]])  # fmt: skip
OWN = {"1": {"S_max": 1.5, "bandwidth_ratio": 1.6}, "3": {"S_max": 1.6, "M_K": 0.4 * M_K}}


def with_own(whole: ChannelStructure, bounds: Bounds = BOUNDS) -> Bounds:
    return replace(bounds, channels=channel_bounds(whole.decoupling, OWN))


def as_one(whole: ChannelStructure, sampling: Sampling | None, off: float, theta=(1.0, 1.0)):
    """The stage with a load off centre beside the empty one, never taken apart."""
    members = plant_set([plant(), plant(theta, off)], sampling, whole.decoupling)
    box = whole.bounds((1e-3, 1e4), (1e-6, 1e6), 1.0)
    return LoopProblem(members, whole, with_own(whole), box)


# ---- the constraints ----------------------------------------------------------------------------


@pytest.mark.parametrize(("seed", "sampling", "skewed", "lacks"), [
    (0, None, False, LoopCurve.SHAPE), (4, None, False, LoopCurve.LEVEL), (3, FAST, True, None),
])  # fmt: skip
def test_derivatives_of_the_rows(
    seed: int, sampling: Sampling | None, skewed: bool, lacks: LoopCurve | None
) -> None:
    """To κ, τ and θ against differences, in orthogonal coordinates and in others."""
    kappa = loop(seed, (0.0, 0.3), sampling)[1]
    whole = structure() if not skewed else ChannelStructure(SKEWED, (STRUCTURE,) * 3)
    model = as_one(whole, sampling, 0.3)
    peaks = assess(model, kappa, TAU, depth=-2.0).peaks
    assert peaks is not None
    alone = peaks.plant // 2 >= model.first
    kinds = {LoopCurve.S_MAX, LoopCurve.LEVEL, LoopCurve.SHAPE, LoopCurve.CROSSING, LoopCurve.KS}
    kinds -= {lacks}
    assert set(peaks.curve[alone]) == kinds
    seen = assert_derivatives(
        lambda theta: as_one(whole, sampling, 0.3, theta), kappa,
        lambda row: (row % 2 == 1) & (row // 2 >= model.first),
    )  # fmt: skip
    assert seen == kinds


def test_the_hessian_of_the_rows_is_the_difference_of_gradients() -> None:
    """In random directions; peaks move with κ."""
    problem, kappa = loop(1, (0.3,))
    problem = composite_problem([plant(off=0.3)], problem.structure, with_own(problem.structure))
    peaks = assess(problem, kappa, TAU).peaks
    assert peaks is not None
    rows = np.flatnonzero(peaks.plant >= problem.parts[0].problem.first)
    assert len(rows) >= 4
    rng = np.random.default_rng(0)
    for _ in range(3):
        direction = rng.normal(0.0, 1.0, len(kappa))
        direction /= np.linalg.norm(direction)
        ends = [assess(problem, kappa + x * direction, TAU).peaks for x in (1e-5, -1e-5)]
        for j in rows:
            one, slopes = peaks.only(np.array([j])), []
            for end in ends:
                same = np.flatnonzero((end.curve == one.curve[0]) & (end.plant == one.plant[0]))
                slopes.append(end.to_kappa[same[np.abs(np.log(end.v[same] / one.v[0])).argmin()]])
            numeric = (slopes[0] - slopes[1]) / 2e-5
            exact = hessians(problem, kappa, TAU, one)[0, :-1, :-1] @ direction
            np.testing.assert_allclose(exact, numeric, atol=2e-4 * (1.0 + np.abs(numeric).max()))


@pytest.mark.parametrize("sampling", [None, FAST])
def test_where_plants_fall_apart_the_parts_have_the_rows(sampling: Sampling | None) -> None:
    """A channel's own SISO problem and its row of the whole: the same constraints."""
    problem, kappa = loop(0, (0.0,), sampling)
    whole = problem.structure
    apart = composite_problem([plant()], whole, with_own(whole), sampling)
    joint = as_one(whole, sampling, 0.0)
    peaks = assess(apart, kappa, TAU, depth=-3.0).peaks
    assert peaks is not None
    for (part, _, rows), i in zip(apart.split(peaks), range(3), strict=True):
        assert part.channel == i
        for one in (rows.only(np.array([j])) for j in range(len(rows.v))):
            own = np.isfinite(joint.limits[one.curve[0], joint.first + i])
            numbers = [joint.first + i] if own else range(joint.first)
            places = (replace(one, plant=np.array([2 * number])) for number in numbers)
            found = [constraints(joint, kappa, TAU, place) for place in places]
            row = min(found, key=lambda row: abs(row.value[0] - one.value[0]))
            assert row.value[0] == pytest.approx(one.value[0], abs=1e-8)
            own = [each.to_kappa[:, part.place] for each in (row, one)]
            np.testing.assert_allclose(*own, atol=1e-7)
            assert row.to_tau[0] == pytest.approx(one.to_tau[0], abs=1e-7)
    assert {"S_MAX of 1", "S_MAX of 3", "KS of 3"} <= set(apart.kinds_of(peaks))


def test_peaks_of_the_rows_are_those_of_dense_grids() -> None:
    problem, kappa = loop(2, (0.3,))
    first, whole = plant(off=0.3), problem.structure
    problem = composite_problem([first], whole, with_own(whole))
    peaks = assess(problem, kappa, TAU, depth=-3.0).peaks
    assert peaks is not None
    K = whole.state_space(whole.in_units(kappa, first.omega_0, first.force))
    omega = np.geomspace(1e-2, 1e4, 20001) * first.omega_0
    S, KS = loop_responses(first, K, omega)
    own = problem.bounds.channels
    for i, gain in (
        (0, np.linalg.norm(np.array(own[0].output) @ S, axis=-1) / 1.5),
        (2, np.linalg.norm(np.array(own[2].output) @ S, axis=-1) / 1.6),
    ):
        value = peaks.value[(peaks.plant == 3 + i) & (peaks.curve == LoopCurve.S_MAX)].max()
        assert np.exp(value) == pytest.approx(gain.max(), rel=1e-3)
    size = np.abs(BOUNDS.weights.responses(omega)[1]) * np.linalg.norm(own[2].force @ KS, axis=-1)
    value = peaks.value[(peaks.plant == 5) & (peaks.curve == LoopCurve.KS)].max()
    assert np.exp(value) * BOUNDS.weighted_level == pytest.approx(size.max() / 0.4, rel=1e-3)


def loop_responses(of: ScaledPlant, K, omega: Array) -> tuple[np.ndarray, np.ndarray]:
    """S and KS at jω in SI, by NumPy alone."""

    def response(system) -> np.ndarray:
        s = 1j * omega[:, None, None] * np.eye(len(system.A))
        return system.C @ np.linalg.solve(s - system.A, system.B + 0j) + system.D

    g, k = response(of.plant_si()), response(K)
    S = np.linalg.inv(np.eye(g.shape[1]) + g @ k)
    return S, k @ S


# ---- designs ------------------------------------------------------------------------------------

LIGHT = Structure(lead=1, biquads=0, roll_off=1)


@lru_cache
def designed(off: tuple[float, ...], bounds: Bounds) -> SectionsDesign:
    return synthesise([plant(off=x) for x in off], structure(LIGHT), bounds, starts=2)


@pytest.mark.parametrize("off", [0.0, 0.3])
def test_what_the_whole_asks_anyway_is_never_what_holds_a_step(off: float) -> None:
    """Equal S_max, a ratio of 1 and the weights' M_K: no row is above those of the whole."""
    problem, kappa = loop(2, (off,))
    whole = problem.structure
    same = {"S_max": BOUNDS.S_max, "M_K": BOUNDS.weights.M_K}
    given = channel_bounds(whole.decoupling, dict.fromkeys(whole.decoupling.names, same))
    owned = composite_problem([plant(off=off)], whole, replace(BOUNDS, channels=given))
    compared = 0
    for shift in np.random.default_rng(0).normal(0.0, 0.02, (5, len(kappa))):
        plain, own = (assess(one, kappa + shift, TAU, depth=-2.0) for one in (problem, owned))
        assert own.stable == plain.stable
        if not plain.stable:
            continue
        for curve in (LoopCurve.S_MAX, LoopCurve.KS):
            tops = [found.peaks.value[found.peaks.curve == curve].max() for found in (plain, own)]
            assert tops[1] == pytest.approx(tops[0], abs=1e-9)
            compared += 1
    assert compared >= 4


@pytest.mark.slow
@pytest.mark.parametrize("off", [(0.0,), (0.0, 0.2)])
def test_what_the_whole_asks_anyway_changes_nothing(off: tuple[float, ...]) -> None:
    """Equal S_max, a ratio of 1 and the weights' M_K: the design without them."""
    same = {"S_max": BOUNDS.S_max, "M_K": BOUNDS.weights.M_K}
    given = channel_bounds(structure().decoupling, dict.fromkeys("123", same))
    plain = designed(off, BOUNDS)
    own = designed(off, replace(BOUNDS, channels=given))
    assert plain.certified
    assert own.certified
    assert own.bandwidth == pytest.approx(plain.bandwidth, rel=1e-6)
    peaks = [one.S_peak for one in own.certificate.plants[0].channels]
    assert max(peaks) <= own.certificate.plants[0].S_peak * (1.0 + 1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("off", [(0.0,), (0.0, 0.2)])
def test_a_dense_grid_sees_every_channels_bounds_held(off: tuple[float, ...]) -> None:
    """On uncoupled and on coupled plants; they cost bandwidth, so that they do something."""
    required = {"1": {"bandwidth_ratio": 1.5}, "2": {"S_max": 1.3}, "3": {"M_K": 0.05 * M_K}}
    own = channel_bounds(structure().decoupling, required)
    bounds = replace(BOUNDS, channels=own)
    made, plain = designed(off, bounds), designed(off, BOUNDS)
    assert made.certified, made.words
    assert made.bandwidth < 0.98 * plain.bandwidth
    assert {"S_MAX of 2", "KS of 3"} & set(made.multipliers)
    slack = 1.0 + 1e-4
    for x in off:
        member = plant(off=x)
        omega = np.geomspace(1e-2 * HZ, 1e5 * HZ, 20001)
        S, KS = loop_responses(member, made.controller, omega)
        rows = [np.linalg.norm(np.array(one.output) @ S, axis=-1) for one in own]
        assert np.linalg.norm(S, 2, axis=(1, 2)).max() <= BOUNDS.S_max * slack
        assert rows[1].max() <= 1.3 * slack
        for row, ratio in zip(rows, (1.5, 1.0, 1.0), strict=True):
            below = omega <= ratio * made.bandwidth
            shape = np.minimum(1.0, 1.1 * omega / (ratio * made.bandwidth)) / np.sqrt(2.0)
            assert (row[below] <= shape[below] * slack).all()
        W = np.abs(BOUNDS.weights.responses(omega)[1])
        effort = W * np.linalg.norm(np.array(own[2].force) @ KS, axis=-1)
        assert effort.max() <= 0.05 * BOUNDS.weighted_level * slack


def test_the_judge_refuses_what_passes_a_channels_bound_alone() -> None:
    """One loop, judged with the S_max of one channel just below and just above its own peak."""
    problem, kappa = loop(2, (0.0,))
    of, channels = plant(), problem.structure.decoupling
    K = problem.structure.state_space(problem.structure.in_units(kappa, of.omega_0, of.force))
    wide = replace(BOUNDS, S_max=50.0, S_low=0.5, weighted_level=1e3, compliance_max=1.0)

    def judged(required):
        return certify([of], K, replace(wide, channels=channel_bounds(channels, required)))

    name = channels.names[1]
    peak = judged({name: {"S_max": 49.0}}).plants[0].channels[1].S_peak
    assert judged({name: {"S_max": peak * 1.001}}).passed
    found = judged({name: {"S_max": peak * 0.999}})
    assert not found.passed
    assert f"S_max of channel {name}" in found.words
    slower = judged({name: {"bandwidth_ratio": 50.0}})
    assert slower.bandwidth < 0.5 * found.bandwidth


# ---- two axes that do not touch, one like the other in other units ------------------------------

# force to displacement of two masses, sensor and motor on either: nothing but S bounds them
FREE = Bounds(S_max=1.8, S_low=0.9, omega_low=0.2 * HZ, shape=1.1)
PLAIN = Structure(integrator=True, lead=1, biquads=0, roll_off=1)


def axes(speed: float, unit: float) -> ScaledPlant:
    """Axis 2 as axis 1 with every frequency times `speed`, its output counted in `unit` of it."""
    masses, hz = np.array([4.0, 1.0]), 60.0

    def model(theta: dict) -> dict:
        k = masses[1] * (HZ * hz) ** 2
        one = np.array([[k + masses.sum() * (2.0 * HZ) ** 2, -k], [-k, k]])
        stiffness = ca.diagcat(ca.DM(one), ca.DM(speed**2 * one))
        drive, sensor = np.array([[1.0], [0.0]]), np.array([[0.0, 1.0]])
        return {
            "mass": ca.diag(ca.DM([*masses, *masses])),
            "stiffness": stiffness,
            "damping_ratio": 0.05,
            "input": ca.diagcat(ca.DM(drive), ca.DM(drive)),
            "output": ca.diagcat(ca.DM(sensor), ca.DM(sensor / unit)),
            "hardware_cost": theta["m"],
        }

    return scaled(mechanics(build_plant(model, ("m",), {}), (1.0,)), 1e5, SUSPENSION)


AXES = given_decoupling(("a", "b"), [[1, 0], [0, 1]], [[1, 0], [0, 1]])
SPAN = (0.02 * HZ, 2e4 * HZ)


def on_axes(of: ScaledPlant, bounds: Bounds) -> SectionsDesign:
    whole = ChannelStructure(AXES, (PLAIN, PLAIN))
    return synthesise([of], whole, bounds, starts=4, frequencies=SPAN)


@pytest.mark.slow
@few(max_examples=3)
@given(speed=st.floats(1.2, 3.0), unit=st.floats(0.05, 20.0))
def test_a_faster_axis_in_other_units_has_the_same_design(speed: float, unit: float) -> None:
    """Axis b is axis a with time and displacement counted otherwise: its sections come out so.

    With a bandwidth_ratio of the frequencies' ratio both channels reach their best together.
    """
    own = channel_bounds(AXES, {"b": {"bandwidth_ratio": speed}})
    made = on_axes(axes(speed, unit), replace(FREE, channels=own))
    alike = on_axes(axes(1.0, 1.0), FREE)
    assert made.certified, made.words
    assert made.bandwidth == pytest.approx(alike.bandwidth, rel=1e-4)
    rows = made.certificate.plants[0].channels
    assert rows[1].bandwidth == pytest.approx(speed * alike.bandwidth, rel=1e-4)
    assert rows[1].S_peak == pytest.approx(1.8, rel=1e-4)


@pytest.mark.slow
def test_the_slow_axis_of_two_loses_nothing_to_the_fast_one() -> None:
    """With axis b twice as fast ω_b is that of axis a for every ratio up to 2, then b's over it."""
    of, found = axes(2.0, 1.0), {}
    for ratio in (1.0, 2.0, 2.5):
        own = channel_bounds(AXES, {"b": {"bandwidth_ratio": ratio}})
        made = on_axes(of, replace(FREE, channels=own))
        assert made.certified
        found[ratio] = made.bandwidth
    assert found[2.0] == pytest.approx(found[1.0], rel=1e-4)
    assert found[2.5] == pytest.approx(found[1.0] * 2.0 / 2.5, rel=1e-4)


def test_bounds_that_are_no_tighter_are_refused() -> None:
    own = channel_bounds(AXES, {"a": {"S_max": 1.9}})
    with pytest.raises(ValueError, match="at most that of the whole"):
        replace(FREE, channels=own)
    with pytest.raises(ValueError, match="the slowest"):
        replace(FREE, channels=channel_bounds(AXES, {"a": {"bandwidth_ratio": 0.5}}))
    with pytest.raises(ValueError, match="needs a weighted_level"):
        replace(FREE, channels=channel_bounds(AXES, {"a": {"M_K": 1.0}}))
    with pytest.raises(ValueError, match="that of the weights"):
        replace(BOUNDS, channels=channel_bounds(AXES, {"a": {"M_K": 2.0 * M_K}}))


def test_a_known_controller_that_no_plant_takes_is_a_failure_and_no_error() -> None:
    """Where nothing but known controllers is to be tried there are no starts to draw."""
    wanted = [plant(off=x) for x in (0.3, 0.2)]
    whole = structure(LIGHT)
    unstable = np.full(len(whole.names), 3.0)
    made = synthesise(wanted, whole, BOUNDS, starts=0, initial=[unstable], only_initial=True)
    assert not made.certified
    assert made.outcome is SectionsOutcome.NO_STABLE_START
