"""Fixed structures: the search, the judge, the envelope gradient and the box of plants."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from oracles.fixed_structure_loops import BOUNDS, FAST, WEIGHTS, loop, plant
from oracles.helpers import HZ, SUSPENSION, random_plant, responses, two_mass_model

from ccd_casadi.fixed_structure import certificate
from ccd_casadi.fixed_structure.bounds import Bounds, ShapeEnd
from ccd_casadi.fixed_structure.certificate import JudgeOptions, certify, judge_plants
from ccd_casadi.fixed_structure.channel_design import synthesise_sections
from ccd_casadi.fixed_structure.design import (
    SectionsOutcome,
    bandwidth_envelope,
    in_problem_units,
    problem_for,
)
from ccd_casadi.fixed_structure.figures import assess
from ccd_casadi.fixed_structure.local_search import Point, optimality
from ccd_casadi.fixed_structure.loop_problem import LoopCurve
from ccd_casadi.fixed_structure.starts import at_random, by_rules, stabilising
from ccd_casadi.fixed_structure.structure import Structure
from ccd_casadi.fixed_structure.uncertainty import UncertainPlant
from ccd_casadi.fixed_structure.worst_plant import (
    LoopOnBox,
    WorstPlantOptions,
    climb,
    lattice,
    worst_plants,
)
from ccd_casadi.lti.loop import Sampling
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.plants.modal import FREE, Perturbation, modal_plant
from ccd_casadi.plants.plant import Mechanics, mechanics
from ccd_casadi.plants.scaling import ScaledPlant, scale_plant, scale_state_space
from ccd_casadi.support.errors import PlantError
from ccd_casadi.support.process_pool import Workers
from ccd_casadi.synthesis.closed_loop import measure

# One notch and a first-order roll-off are quick to find and have every kind of bound.
SMALL = Structure(biquads=1, roll_off=2)
EASY = replace(BOUNDS, S_max=2.0, compliance_max=None)


@pytest.fixture(scope="module")
def design():
    """The small structure on case study 1, one plant."""
    return synthesise_sections([plant()], SMALL, EASY, starts=2, seed=1)


def test_a_design_is_certified_optimal_and_within_its_bounds(design) -> None:
    assert design.outcome is SectionsOutcome.CERTIFIED
    assert design.kkt_residual < 1e-4
    assert design.certificate.passed
    assert max(design.certificate.worst.values()) <= 1.0
    assert design.bandwidth > 20.0 * HZ
    assert sum(optimum.count for optimum in design.local_optima) >= 1
    poles = np.linalg.eigvals(design.controller.A)
    assert (poles.real < 0.0).sum() == SMALL.order - 1  # all but the integrator's


def test_the_judge_agrees_with_the_projects_own(design) -> None:
    """‖S‖∞, |S(jω_low)| and ω_b against `closed_loop.measure`, which is compiled and older."""
    own = measure(plant(), design.controller, WEIGHTS, gamma=1e9, omega_low=EASY.omega_low)
    judged = design.certificate.plants[0]
    assert own.certificate.stable
    assert judged.S_peak == pytest.approx(own.sensitivity_peak, rel=1e-6)
    assert judged.S_low == pytest.approx(own.sensitivity_low, rel=1e-5)
    assert judged.crossing == pytest.approx(own.bandwidth, rel=1e-6)


def test_no_small_change_of_the_parameters_is_better(design) -> None:
    """Local optimality by trial: feasible neighbours have no higher ω_b."""
    problem = problem_for([plant()], SMALL, EASY)
    kappa = in_problem_units(problem, design.kappa)
    tau = np.log(design.bandwidth / problem.plants.omega_0)
    rng = np.random.default_rng(0)
    for size in (1e-2, 1e-3):
        for _ in range(40):
            moved = np.clip(kappa + size * rng.normal(size=len(kappa)), *problem.box)
            assert assess(problem, moved, tau + 1e-2 * size).violation > 0.0


def test_no_zero_of_K_is_slower_than_required(design) -> None:
    least = 3.0
    assert np.abs(SMALL.roots(design.kappa)[0]).min() < 0.5 * least * HZ
    structure = replace(SMALL, slowest_zero_hz=least)
    found = synthesise_sections([plant()], structure, EASY, starts=2, seed=1)
    zeros = structure.roots(found.kappa)[0]
    assert found.certified
    assert np.abs(zeros).min() == pytest.approx(least * HZ, rel=1e-9)
    assert found.bandwidth < design.bandwidth
    gradient_is_of_optima(structure, found)
    with pytest.raises(PlantError, match="K has no root above"):
        problem_for([plant()], replace(SMALL, slowest_zero_hz=1e9), EASY)


def test_the_envelope_gradient_is_that_of_the_optimum(design) -> None:
    gradient_is_of_optima(SMALL, design)


def gradient_is_of_optima(structure: Structure, design) -> None:
    """The gradient over θ against differences of optima."""
    envelope = bandwidth_envelope([plant()], EASY, design)
    assert envelope is not None
    h = 0.02
    for i in range(2):
        ends = []
        for sign in (1.0, -1.0):
            theta = np.array([55.0, 55.0])
            theta[i] += sign * h
            made = synthesise_sections(
                [plant(theta=theta)], structure, EASY, initial=[design.kappa], only_initial=True,
                frequencies=design.frequencies,
            )  # fmt: skip
            assert made.certified
            ends.append(made.bandwidth)
        assert (ends[0] - ends[1]) / (2 * h) == pytest.approx(envelope.gradient[i], rel=2e-3)


def rigid(mass: float) -> ScaledPlant:
    """A body on its suspension."""
    M, D, K, B, C = (np.array([[value]]) for value in (mass, 0.0, 0.0, 1.0, 1.0))
    body = Mechanics(M, D, K, B, C, 0.01, (np.zeros((1, 1, 1)),) * 5)
    return scale_plant(modal_plant(body, SUSPENSION), WEIGHTS.M_K)


@pytest.mark.parametrize("gain", [0.994, 0.9995, 1.0005])
def test_a_narrow_peak_at_3_db_is_seen_by_the_judge_and_by_the_search(gain: float) -> None:
    """|S| touches -3 dB between two points of a grid, beside where the shape turns level.

    Random problems found it: both looked at the grid there, and a loop was certified that passed
    its shape by 0.04 %.
    """
    structure, sampling = Structure(biquads=1, roll_off=0), Sampling(3814.4)
    kappa = np.log([71379.0, 2.3485, 5.8627, 175.47, 173.77, 0.12104, 601.8, 0.52486])
    kappa[0] += np.log(gain * 0.92418)
    bounds = Bounds(S_max=4.7, S_low=0.1, omega_low=2.6, shape=1.2286, shape_ends=ShapeEnd.CROSSING)
    problem = problem_for([rigid(12.743)], structure, bounds, sampling)
    scaled, own = in_problem_units(problem, kappa), problem.plants
    omega = np.geomspace(20.0, 1100.0, 200_000)
    v = own.variable(omega / own.omega_0)
    G = own.responses(np.zeros(len(v), int), v)[0][:, 0, 0]
    S = np.abs(1.0 / (1.0 + G * structure.response(scaled, 1j * v)))
    judged = certify([rigid(12.743)], structure.state_space(kappa), bounds, sampling)
    first = omega[np.argmax(np.sqrt(2.0) * S > 1.0)]
    assert judged.plants[0].crossing == pytest.approx(first, rel=1e-3)
    bandwidth = 192.05
    shape = np.minimum(1.0, bounds.shape * omega / bandwidth)
    worst = (np.sqrt(2.0) * S / shape)[omega < bandwidth].max()
    peaks = assess(problem, scaled, float(np.log(bandwidth / own.omega_0))).peaks
    below = np.isin(peaks.curve, (LoopCurve.SHAPE, LoopCurve.LEVEL, LoopCurve.CROSSING))
    found = peaks.value[below].max() - problem.margin
    assert found == pytest.approx(np.log(worst), abs=1e-6)


def test_a_rigid_body_is_looked_at_far_above_its_suspension() -> None:
    """Its only pole is the suspension's; S, T and GS have their peaks a hundred times above it."""
    body = rigid(100.0)
    bounds = replace(EASY, weighted_level=None, weights=None)
    problem = problem_for([body], SMALL, bounds)
    rng = np.random.default_rng(0)
    kappa = stabilising(problem, at_random(problem, np.exp(rng.uniform(-2.0, -1.0, 20)), rng))[0]
    peaks = assess(problem, kappa, -2.0, depth=-np.inf).peaks
    unit = problem.plants
    controller = SMALL.state_space(SMALL.in_units(kappa, unit.omega_0, unit.force))
    judged = certify([body], controller, bounds).plants[0]
    found = (
        np.exp(peaks.value[peaks.curve == LoopCurve.S_MAX].max() - problem.margin) * bounds.S_max
    )
    assert found == pytest.approx(judged.S_peak, rel=1e-6)


def test_a_gradient_is_not_made_up_away_from_an_optimum(design) -> None:
    moved = replace(design, kappa=design.kappa + 0.01)
    assert bandwidth_envelope([plant()], EASY, moved) is None


def test_the_judge_refutes_what_is_unstable_or_passes_a_bound(design) -> None:
    louder = replace(design.controller, C=4.0 * design.controller.C)
    assert not certify([plant()], louder, EASY).passed
    S_max = 0.999 * design.certificate.plants[0].S_peak
    assert not certify([plant()], design.controller, replace(EASY, S_max=S_max)).passed
    turned = replace(design.controller, C=-design.controller.C, D=-design.controller.D)
    judged = certify([plant(), plant(0.03)], turned, EASY)
    assert not judged.passed
    assert "unstable on plant 1" in judged.words


def test_a_flat_shelf_is_no_bandwidth() -> None:
    """ω_b is the largest below which |S| keeps the shape, far below -3 dB where |S| is flat."""
    structure = Structure(integrator=True, lead=0, biquads=1, roll_off=0)
    problem = problem_for([plant()], structure, EASY)
    hz = HZ / problem.plants.omega_0
    # Zeros at 3 Hz make K G, a double integrator, flat up to the poles: |S| is near 1/2.1 there.
    kappa = np.log(np.array([1.0, 0.05 * hz, 3.0 * hz, 1.0, 90.0 * hz, 0.7]))
    at = np.array([20.0 * hz])
    G = problem.plants.responses(np.zeros(1, int), at)[0][:, 0, 0]
    kappa[0] += np.log(1.1 / np.abs(G * structure.response(kappa, 1j * at)))[0]
    si = structure.in_units(kappa, problem.plants.omega_0, problem.plants.force)
    K = structure.state_space(si)
    judged = certify([plant()], K, EASY).plants[0]
    assert judged.stable
    assert certify([plant()], K, replace(EASY, shape=None)).bandwidth == judged.crossing
    assert judged.bandwidth < 0.5 * judged.crossing
    omega = np.geomspace(1e-3 * judged.crossing, judged.crossing, 20001)
    S = np.abs(responses(plant(), K, omega)[2][:, 0, 0])
    for factor, holds in ((1.0 - 1e-6, True), (1.02, False)):
        end = factor * judged.bandwidth
        allowed = omega / end / np.sqrt(2.0)
        assert bool((allowed >= S)[omega <= end].all()) == holds


@pytest.mark.parametrize("sampling", [None, FAST, Sampling(3000.0, 700.0)])
def test_the_judge_finds_the_peaks_of_the_search(sampling: Sampling | None) -> None:
    for seed in range(3):
        problem, kappa = loop(seed, Structure(), sampling, (-0.02, 0.02))
        members = problem.plants
        tau = np.log(0.05)
        peaks = assess(problem, kappa, tau, depth=-60.0).peaks
        assert peaks is not None
        si = problem.structure.in_units(kappa, members.omega_0, members.force)
        K = problem.structure.state_space(si)
        judged = certify([plant(-0.02), plant(0.02)], K, BOUNDS, sampling)
        for i, figures in enumerate(judged.plants):
            over = BOUNDS.shares(figures)
            assert figures.stable
            assert figures.confirmed
            for code, name in enumerate(("S_max", None, "S_low", "KS", "T", "GS")):
                if name is not None:
                    own = peaks.value[(peaks.curve == code) & (peaks.plant == i)].max()
                    assert np.exp(own - problem.margin) == pytest.approx(over[name], rel=1e-5)


def test_pid_alone_is_the_best_of_a_grid() -> None:
    """Gain and lead against a grid of both zero and pole, the gain the best for each."""
    structure = Structure(integrator=False, lead=1, biquads=0, roll_off=0)
    bounds = Bounds(S_max=1.75, S_low=0.05, omega_low=HZ, shape=1.1, weighted_level=5.0,
                    weights=replace(WEIGHTS, c_K=10.0))  # fmt: skip
    made = synthesise_sections([plant()], structure, bounds, starts=2, seed=0)
    assert made.certified
    problem = problem_for([plant()], structure, bounds)
    centre = in_problem_units(problem, made.kappa)
    tau = np.log(made.bandwidth / problem.plants.omega_0)
    axes = [np.linspace(-0.4, 0.4, 5)] * 3
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    better = tau + np.log(1.005)
    values = [assess(problem, np.clip(centre + d, *problem.box), better).violation for d in grid]
    assert min(values) > 0.0


def test_what_cannot_be_had_is_said(design) -> None:
    none = synthesise_sections([plant()], SMALL, replace(EASY, S_low=1e-5), starts=1)
    assert none.outcome is SectionsOutcome.BOUND_NOT_MET
    assert "S_LOW" in none.short
    turned = replace(plant(), B=-plant().B)
    lost = synthesise_sections([turned], Structure(lead=0, biquads=0, roll_off=1), EASY, starts=1)
    assert lost.outcome is SectionsOutcome.NO_STABLE_START
    assert lost.controller is None


def test_a_set_of_unlike_plants_is_brought_to_common_units(design) -> None:
    """A plant scaled with another M_K, or given as a state space, is the same plant."""
    modal = modal_plant(mechanics(two_mass_model(), (55.0, 55.0)), SUSPENSION)
    one, other = (scale_plant(modal, M_K) for M_K in (WEIGHTS.M_K, 3e6))
    again = scale_state_space(one.plant_si(), 1e7)
    problem = problem_for([one, other, again], SMALL, EASY)
    kappa = in_problem_units(problem, design.kappa)
    found = assess(problem, kappa, float(np.log(design.bandwidth / problem.plants.omega_0))).peaks
    assert found is not None
    for code in np.unique(found.curve):
        tops = [found.value[(found.curve == code) & (found.plant == i)].max() for i in range(3)]
        np.testing.assert_allclose(tops, tops[0], atol=1e-6)


def uncertain(**changes: object) -> UncertainPlant:
    system = mechanics(two_mass_model(), (55.0, 55.0))
    return UncertainPlant((system,), WEIGHTS.M_K, **changes)


def test_the_box_holds_the_plants_that_it_names() -> None:
    box = uncertain(resonance_shift=0.03, mode_shift=0.02, damping=(0.5, 2.0), gain=0.05)
    assert box.names == ("resonance_shift", "mode_shift 1", "damping", "gain")
    nominal = box.plant(box.nominal)
    np.testing.assert_allclose(nominal.A, plant().A)
    common = box.plant(np.array([0.03, 0.0, 0.5, 0.0]))
    np.testing.assert_allclose(common.A, plant(0.03, 0.5).A, rtol=1e-12)
    own = box.plant(np.array([0.0, 0.02, 1.0, 0.05]))
    assert own.natural[-1] == pytest.approx(1.02 * nominal.natural[-1])
    assert own.natural[0] == nominal.natural[0]
    members = problem_for([nominal, own], SMALL, EASY).plants
    flexible = members.poles[:, np.abs(members.poles[0]).argmax()]
    assert abs(flexible[1]) == pytest.approx(1.02 * abs(flexible[0]), rel=1e-9)
    low = np.array([1e-4])
    G = [members.responses(np.array([i]), low)[0][0, 0, 0] for i in range(2)]
    assert abs(G[1] / G[0]) == pytest.approx(1.05, rel=1e-4)


def test_the_worst_plant_is_worse_than_any_of_a_lattice(design) -> None:
    box = uncertain(resonance_shift=0.02, gain=0.03)
    required = LoopOnBox(box, SMALL, design.kappa, design.bandwidth, EASY)
    heads, examined = worst_plants(required, count=40)
    values = required.excesses(lattice(box, 60, 7))
    assert examined > 40
    assert heads[0].value >= values.max() - 1e-6
    assert heads[0].value == pytest.approx(
        required.excesses([(heads[0].option, heads[0].point)])[0]
    )


def test_plants_are_assessed_alike_by_any_number_of_workers(design) -> None:
    box = uncertain(resonance_shift=0.02, gain=0.03)
    required = LoopOnBox(box, SMALL, design.kappa, design.bandwidth, EASY)
    points = lattice(box, 60, 7)
    assert len(points) > WorstPlantOptions.batch
    whole = required.assess(box.plants(points)).largest
    with Workers(2) as workers:
        spread = required.excesses(points, workers)
    assert (spread == required.excesses(points)).all()
    np.testing.assert_allclose(spread, whole, atol=1e-6)  # measured: 2e-9


def test_far_within_all_bounds_the_worst_plant_is_named_too(design) -> None:
    box = uncertain(mode_shift=1e-3, gain=1e-3)
    required = LoopOnBox(box, SMALL, design.kappa, 0.5 * design.bandwidth, EASY.looser(10.0))
    points = lattice(box, 12, 0)
    heads, _ = climb(required, points)
    assert heads[0].value < 0.0
    assert heads[0].value >= required.excesses(points).max() - 1e-6


@pytest.mark.parametrize("S_low", [EASY.S_low, 1e-3 * EASY.S_low])
def test_of_many_parameters_the_worst_plant_is_climbed_to(S_low: float) -> None:
    """Worse than a lattice and than every corner, of a box too large for one move each, also where
    all plants exceed another bound by more."""
    system = mechanics(random_plant(5, rigid=1, flexible=4, inputs=1, outputs=1), (0.5, 0.5))
    box = UncertainPlant((system,), 1e6, 0.01, 0.02, (0.5, 2.0), 0.05)
    assert len(box.names) == 7
    members = problem_for([box.plant(box.nominal)], SMALL, EASY)
    kappa = stabilising(members, by_rules(members, np.geomspace(0.01, 0.3, 8)))[0]
    units = members.plants
    kappa = SMALL.in_units(kappa, units.omega_0, units.force)
    required = LoopOnBox(box, SMALL, kappa, 0.01 * units.omega_0, EASY)
    masked = replace(required, bounds=replace(EASY, S_low=S_low))
    heads, examined = worst_plants(masked, count=12)
    ends = np.array(list(np.ndindex(*(2,) * 7)))
    corners = [(0, box.box[row, np.arange(7)]) for row in ends]
    values = required.excesses([*lattice(box, 12, 0), *corners])
    assert examined < len(corners)
    found = required.excesses([(head.option, head.point) for head in heads])
    assert found.max() >= values.max() - 1e-6


def test_stationarity_is_measured_not_assumed(design) -> None:
    problem = problem_for([plant()], SMALL, EASY)
    kappa = in_problem_units(problem, design.kappa)
    tau = float(np.log(design.bandwidth / problem.plants.omega_0))
    at = optimality(problem, Point(kappa, tau, assess(problem, kappa, tau)))
    off = optimality(problem, Point(kappa, tau - 0.05, assess(problem, kappa, tau - 0.05)))
    assert at.residual < 1e-4
    assert off.residual > 0.1


def test_shifted_plants_are_those_of_the_robust_set() -> None:
    system = mechanics(two_mass_model(), (55.0, 55.0))
    modal = modal_plant(system, FREE, Perturbation(-0.02))
    np.testing.assert_allclose(uncertain(resonance_shift=0.02).plant(np.array([-0.02])).A,
                               scale_plant(modal, WEIGHTS.M_K).A)  # fmt: skip


@pytest.mark.parametrize("sampling", [None, Sampling(2000.0, 100.0)])
def test_a_mode_without_damping_that_no_force_drives_is_never_stable(
    sampling: Sampling | None,
) -> None:
    """Its poles stay on the axis, and rounding, which coordinates change, takes no side of it."""
    rng = np.random.default_rng(5)
    modes = [(2.0, 0.7, 1.0), (60.0, 0.0, 0.0)]  # Hz, damping, driven
    A, B = np.zeros((4, 4)), np.zeros((4, 1))
    for i, (hz, zeta, driven) in enumerate(modes):
        w, k = HZ * hz, 2 * i
        A[k : k + 2, k : k + 2], B[k + 1] = [[0.0, 1.0], [-w * w, -2.0 * zeta * w]], driven
    C = np.array([[1.0, 0.0, 1.0, 0.0]])
    K = StateSpace(np.array([[-300.0]]), np.array([[1.0]]), np.array([[2e4]]), np.zeros((1, 1)))
    bounds = Bounds(S_max=3.0, S_low=0.9, omega_low=HZ, shape=None)
    alone = scale_state_space(StateSpace(A[:2, :2], B[:2], C[:, :2], np.zeros((1, 1))), 1.0)
    assert judge_plants([alone.plant_si()], K, bounds, sampling, False)[0].stable
    for _ in range(20):
        T = np.linalg.qr(rng.normal(size=(4, 4)))[0]
        turned = StateSpace(T @ A @ T.T, T @ B, C @ T.T, np.zeros((1, 1)))
        other = scale_state_space(turned, 1.0)
        assert not judge_plants([other.plant_si()], K, bounds, sampling, False)[0].stable


def test_plants_judged_together_are_each_as_alone(design) -> None:
    """Of several sizes and in batches, an unstable one among them, with one grid for each."""
    louder = replace(design.controller, C=3.0 * design.controller.C)
    plants = [plant(0.01 * i, 0.5 + 0.1 * i) for i in range(4)]
    plants[2:2] = [rigid(110.0), plant(-0.3, 1e-3)]
    together = certify(plants, louder, EASY, options=JudgeOptions(batch=3)).plants
    assert {one.stable for one in together} == {True, False}
    for own, one in zip(plants, together, strict=True):
        alone = certify([own], louder, EASY).plants[0]
        assert one.stable == alone.stable
        for name, value in vars(alone).items():
            if name != "channels":
                assert getattr(one, name) == pytest.approx(value, rel=1e-7, nan_ok=True)


def test_a_peak_that_the_grid_lost_is_not_confirmed(
    design, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The level test finds what lies above it, and the norm is the larger of both."""
    sought = design.certificate.plants[0].S_peak

    def lower(*given: Any) -> dict[str, Any]:
        found = peaks(*given)
        return found | {"S": (0.9 * found["S"][0], found["S"][1])}

    peaks = certificate.peaks
    monkeypatch.setattr(certificate, "peaks", lower)
    judged = certify([plant()], design.controller, EASY)
    assert not judged.passed
    assert not judged.plants[0].confirmed
    assert judged.plants[0].S_peak == pytest.approx(sought, rel=1e-8)
