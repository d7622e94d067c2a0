"""Fixed structures: the controller, its loops, the peaks and their derivatives."""

from dataclasses import replace

import numpy as np
import pytest
from oracles.differences import slopes
from oracles.fixed_structure_channels import closed
from oracles.fixed_structure_loops import (
    BOUNDS,
    FAST,
    LATE,
    SLOW,
    by_curve,
    loop,
    plant,
    response_and_slopes,
)

from ccd_casadi.analysis.loop_channels import sampled_figures
from ccd_casadi.deployment.discretise import Conversion, discretise
from ccd_casadi.fixed_structure.bounds import ShapeEnd
from ccd_casadi.fixed_structure.certificate import certify
from ccd_casadi.fixed_structure.certificate_curves import grid_through
from ccd_casadi.fixed_structure.design import in_problem_units, problem_for
from ccd_casadi.fixed_structure.figures import (
    Brackets,
    PeakOptions,
    assess,
    constraints,
    evaluate_rows,
    hessians,
    to_theta,
)
from ccd_casadi.fixed_structure.loop_problem import LoopCurve, RowPlaces
from ccd_casadi.fixed_structure.plant_set import all_stable, closed_loops, plant_set
from ccd_casadi.fixed_structure.starts import at_random, stabilising
from ccd_casadi.fixed_structure.structure import Structure
from ccd_casadi.kernels import sections
from ccd_casadi.lti.loop import Sampling, in_w, tustin, zoh
from ccd_casadi.lti.norms import hinf_norm
from ccd_casadi.lti.state_space import StateSpace, closed_loop
from ccd_casadi.support.errors import PlantError
from ccd_casadi.support.text import HZ
from ccd_casadi.support.worker_process import threads_permitted

STRUCTURES = [
    Structure(),
    Structure(integrator=False, lead=2, biquads=1, roll_off=3),
    Structure(lead=0, biquads=0, roll_off=1),
    Structure(lead=1, biquads=3, roll_off=0),
]


@pytest.mark.parametrize("structure", STRUCTURES)
def test_state_space_roots_and_response_are_one_controller(structure: Structure) -> None:
    rng = np.random.default_rng(0)
    for _ in range(10):
        kappa = rng.normal(0.0, 0.8, len(structure.names))
        s = 1j * np.geomspace(0.01, 100.0, 25)
        K = structure.response(kappa, s)
        system = structure.state_space(kappa)
        solved = np.linalg.solve(s[:, None, None] * np.eye(len(system.A)) - system.A, system.B + 0j)
        np.testing.assert_allclose((system.C @ solved + system.D)[:, 0, 0], K, rtol=1e-9)
        zeros, poles = structure.roots(kappa)
        assert len(poles) == structure.order == len(system.A)
        assert (poles.real < 0.0).sum() == structure.order - structure.integrator
        assert (zeros.real < 0.0).all()
        ratio = K * np.prod(s[:, None] - poles, axis=1) / np.prod(s[:, None] - zeros, axis=1)
        np.testing.assert_allclose(ratio, ratio[0], rtol=1e-8)


@pytest.mark.parametrize("structure", STRUCTURES)
def test_derivatives_of_the_controller(structure: Structure) -> None:
    rng = np.random.default_rng(1)
    kappa = rng.normal(0.0, 0.5, len(structure.names))
    s = 1j * np.geomspace(0.05, 20.0, 9)
    _, slopes, slope = response_and_slopes(structure, kappa, s)
    h, bending = 1e-5, []
    for i, step in enumerate(h * np.eye(len(kappa))):
        up, down = (response_and_slopes(structure, kappa + x, s) for x in (step, -step))
        np.testing.assert_allclose(np.log(up[0] / down[0]) / (2 * h), slopes[:, i], atol=1e-7)
        bending.append((up[1] - down[1]) / (2 * h))
    ends = [structure.response(kappa, s * np.exp(x)) for x in (h, -h)]
    np.testing.assert_allclose(np.log(ends[0] / ends[1]) / (2 * h), slope, atol=1e-7)
    k, alone, ln_slope = np.empty((3, 1), complex)
    own, bend = np.empty(len(kappa), complex), np.empty((len(kappa),) * 2, complex)
    loop = problem_for([plant()], structure, BOUNDS).loop(kappa, 0.0)
    K = (loop.factors, loop.values)
    for i, at in enumerate(s):  # the kernel's
        sections.gains_and_slopes(*K, at, k, ln_slope, own)
        sections.gains(*K, at, alone)
        np.testing.assert_allclose(k, alone)
        np.testing.assert_allclose([k, ln_slope], [[structure.response(kappa, at)], [slope[i]]])
        np.testing.assert_allclose(own, slopes[i], atol=1e-12)
        sections.second_slopes(loop.factors, own, bend)
        np.testing.assert_allclose(bend, np.array(bending)[:, i], atol=1e-6)


@pytest.mark.parametrize("sampling", [None, FAST, SLOW])
def test_the_modal_response_is_that_of_the_matrices(sampling: Sampling | None) -> None:
    members = plant_set([plant(), plant(0.03, 0.5)], sampling)
    v = np.geomspace(1e-3, 10.0, 40)
    for i, member in enumerate(members.systems):
        if sampling is not None:  # by one exponential of the matrices
            own, T = members.plants[i].system, members.period
            held = in_w(zoh(own, T, members.delay))
            np.testing.assert_allclose(member.response(v), held.response(v), rtol=1e-8)
        G, slope = (part[:, 0, 0] for part in members.responses(np.full(len(v), i), v))
        solved = np.linalg.solve(1j * v[:, None, None] * np.eye(len(member.A)) - member.A,
                                 member.B + 0j)  # fmt: skip
        np.testing.assert_allclose((member.C @ solved + member.D)[:, 0, 0], G, rtol=1e-9)
        ends = [members.responses(np.full(len(v), i), v * np.exp(x))[0] for x in (1e-6, -1e-6)]
        np.testing.assert_allclose((ends[0] - ends[1])[:, 0, 0] / 2e-6, slope, rtol=1e-4, atol=1e-9)


@pytest.mark.parametrize("sampling", [FAST, SLOW, Sampling(4000.0), Sampling(4000.0, 250.0)])
def test_a_sampled_loop_is_the_one_that_is_deployed(sampling: Sampling) -> None:
    """Poles, ‖S‖∞ and ω_b against deploy's own sampled loop with Tustin's rule."""
    problem, kappa = loop(3, Structure(), sampling)
    members = problem.plants
    tau = np.log(0.1)
    found = assess(problem, kappa, tau, depth=-3.0)
    si = problem.structure.in_units(kappa, members.omega_0, members.force)
    conversion = Conversion.TUSTIN
    K = discretise(problem.structure.state_space(si), conversion, sampling.period, sampling.delay)
    S = closed_loop(zoh(plant().plant_si(), sampling.period, sampling.delay), K).S
    w = found.poles[0] * 0.5 * members.period
    z = np.sort(np.abs((1.0 + w) / (1.0 - w)))
    np.testing.assert_allclose(z, np.sort(np.abs(np.linalg.eigvals(S.A)))[-len(z) :], atol=1e-6)
    figures = sampled_figures(S)
    peaks = found.peaks
    assert figures.stable
    assert peaks is not None
    top = peaks.value[peaks.curve == LoopCurve.S_MAX].max()
    assert np.exp(top - problem.margin) * BOUNDS.S_max == pytest.approx(
        figures.sensitivity_peak, rel=1e-6
    )


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("sampling", [None, FAST])
@pytest.mark.parametrize("ends", ShapeEnd)
def test_peaks_are_the_suprema_of_dense_grids(
    seed: int, sampling: Sampling | None, ends: ShapeEnd
) -> None:
    problem, kappa = loop(seed, Structure(), sampling, (-0.03, 0.03))
    problem = replace(problem, bounds=replace(problem.bounds, shape_ends=ends))
    tau = np.log(0.08)
    found = assess(problem, kappa, tau, depth=-60.0).peaks
    assert found is not None
    edge = float(problem.plants.variable(np.array([np.exp(tau)]))[0])
    v = np.geomspace(problem.base[0], problem.base[-1], 60001)
    curves = (*problem.curves, LoopCurve.CROSSING)
    short = dict(zip(problem.curves, problem.short, strict=True))
    late = dict(zip(problem.curves, problem.late, strict=True))
    dense = by_curve(problem, kappa, tau, curves, np.tile(v, (2, 1)))
    for i in range(2):
        for curve in curves:
            kinds, values = [curve], dense[curve][i] + problem.margin
            if short.get(curve, True):
                values, kinds = values[v <= edge], [curve, LoopCurve.LEVEL, LoopCurve.CROSSING]
            if late.get(curve, False):
                values, kinds = values[v >= edge], [curve, LoopCurve.CROSSING]
            own = (found.plant == i) & np.isin(found.curve, kinds)
            assert found.value[own].max() >= values.max() - 1e-9
            if not short.get(curve, True):
                assert found.value[own].max() <= values.max() + 1e-2


@pytest.mark.parametrize("count", [1, 2, 5])
def test_halves_of_the_plants_in_threads_change_no_bit(count: int) -> None:
    shifts = tuple(0.02 * i for i in range(count))
    problem, kappa = loop(3, Structure(), FAST, shifts)
    with threads_permitted(2):
        ways = (PeakOptions(halved=1), PeakOptions(halved=10**9))
        found = [assess(problem, kappa, -2.0, options=way) for way in ways]
    (a, b), near = (one.peaks for one in found), [one.near for one in found]
    assert a is not None
    assert b is not None
    assert near[0] is not None
    assert near[1] is not None
    assert len(a.value) > count
    for name in ("curve", "plant", "v", "value", "to_kappa", "to_tau"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))
    np.testing.assert_array_equal(near[0].v, near[1].v)


@pytest.mark.parametrize("sampling", [None, FAST, SLOW, LATE])
def test_peaks_of_loops_faster_than_the_base_grid_are_those_of_the_judge(
    sampling: Sampling | None,
) -> None:
    """A search found a peak of 23 "within 2" where |S| rises past the last of its frequencies."""
    bounds = replace(BOUNDS, weighted_level=None, weights=None)
    plants = [plant(), plant(0.03, 0.5)]
    problem = problem_for(plants, Structure(lead=2, roll_off=0), bounds, sampling)
    rng, P = np.random.default_rng(5), problem.plants
    fastest = 3000.0 if P.period is None else 3.0 / P.period
    kappas = at_random(problem, np.exp(rng.uniform(0.0, np.log(fastest), 1000)), rng)
    kappas = stabilising(problem, kappas)[:8]
    assert len(kappas) > 2
    for kappa in kappas:
        found = assess(problem, kappa, -1.0, depth=-60.0).peaks
        assert found is not None
        si = problem.structure.in_units(kappa, P.omega_0, P.force)
        judged = certify(plants, problem.structure.state_space(si), bounds, sampling)
        for i, figures in enumerate(judged.plants):
            for curve, name in ((LoopCurve.S_MAX, "S_max"), (LoopCurve.GS, "GS")):
                own = found.value[(found.plant == i) & (found.curve == curve)] - problem.margin
                assert np.exp(own.max()) == pytest.approx(bounds.shares(figures)[name], rel=1e-5)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("sampling", [None, FAST])
def test_what_is_largest_at_rest_is_seen(seed: int, sampling: Sampling | None) -> None:
    """Without an integrator |GS| may be largest at 0 Hz: 1/K(0) of a free body, next to a root that
    is slow; a design was found that was 8e-5 above there, and the judge's figure 2.5e-5 below."""
    structure = Structure(integrator=False, lead=1, biquads=0, roll_off=1)
    problem = problem_for([plant()], structure, replace(BOUNDS, compliance_max=1.0), sampling)
    rng, P = np.random.default_rng(seed), problem.plants
    drawn = at_random(problem, np.exp(rng.uniform(-4.0, -2.0, 300)), rng)
    drawn[:, structure.names.index("lead 1 zero")] = problem.box[0, 1]
    kappa = stabilising(problem, drawn)[0]
    K = structure.state_space(structure.in_units(kappa, P.omega_0, P.force))
    largest = 1.0 / float((K.D - K.C @ np.linalg.solve(K.A, K.B)).item())  # of a free body
    peaks = assess(problem, kappa, -2.0, depth=-60.0).peaks
    assert peaks is not None
    found = np.exp(peaks.value[peaks.curve == LoopCurve.GS].max() - problem.margin)
    judged = certify([plant()], K, problem.bounds, sampling, integrator=False).plants[0]
    assert pytest.approx(judged.static_compliance, rel=1e-12) == judged.GS
    assert judged.static_compliance == pytest.approx(largest, rel=1e-6)
    assert found == pytest.approx(largest, rel=1e-7)


def test_the_peak_of_s_is_its_h_infinity_norm() -> None:
    for seed in range(5):
        problem, kappa = loop(seed, Structure())
        found = assess(problem, kappa, np.log(0.1), depth=-60.0).peaks
        G, K = problem.plants.systems[0], problem.structure.state_space(kappa)
        A = np.block([[G.A - G.B @ K.D @ G.C, G.B @ K.C], [-K.B @ G.C, K.A]])
        S = StateSpace(A, np.vstack([G.B @ K.D, K.B]),
                       np.hstack([-G.C, np.zeros((1, len(K.A)))]), np.eye(1))  # fmt: skip
        assert found is not None
        top = found.value[found.curve == LoopCurve.S_MAX].max() - problem.margin
        assert np.exp(top) * BOUNDS.S_max == pytest.approx(hinf_norm(S)[0], rel=1e-7)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("sampling", [None, LATE])
def test_derivatives_of_the_peaks(seed: int, sampling: Sampling | None) -> None:
    """To κ, τ and θ against central differences of fourth order."""
    problem, kappa = loop(seed, STRUCTURES[(0, 1, 3)[seed]], sampling)
    tau, theta = -2.2, np.array([55.0, 55.0])
    peaks = assess(problem, kappa, tau, depth=-3.0).peaks
    assert peaks is not None

    def values(problem, kappa, tau, which=peaks.plant):
        return constraints(problem, kappa, tau, replace(peaks, plant=which)).value

    size = np.abs(peaks.to_kappa).max(1, keepdims=True) + 1e-3
    to_kappa = slopes(lambda x: values(problem, x, tau), kappa, 1e-4)
    assert (np.abs(to_kappa - peaks.to_kappa) / size).max() < 1e-5
    rising = peaks.curve != LoopCurve.CROSSING
    slope = (values(problem, kappa, tau + 1e-6) - values(problem, kappa, tau - 1e-6)) / 2e-6
    np.testing.assert_allclose(slope[rising], peaks.to_tau[rising], atol=1e-6)
    exact = to_theta(problem, kappa, peaks)
    scale = np.abs(exact).max(1, keepdims=True) + 1e-3 * np.abs(exact).max()

    def moved(theta):
        pair = problem_for([plant(), plant(theta=theta)], problem.structure, problem.bounds,
                           sampling)  # fmt: skip
        return values(pair, kappa, tau, np.ones_like(peaks.plant))

    assert (np.abs(slopes(moved, theta, 2e-3) - exact) / scale).max() < 1e-5


@pytest.mark.parametrize("seed", [1, 4])  # of loops well inside stability: a needle's differences
def test_the_hessian_of_every_peak_moves_with_the_peak(seed: int) -> None:  # are not exact
    problem, kappa = loop(seed, Structure(), FAST)
    tau = -2.2
    peaks = assess(problem, kappa, tau).peaks
    assert peaks is not None
    chosen = np.unique(peaks.curve, return_index=True)[1]  # one of each kind
    assert len(chosen) > 4
    for j in chosen:
        one = peaks.only(np.array([j]))
        exact = hessians(problem, kappa, tau, one)[0]
        x = np.append(kappa, tau)
        rows = []
        for step in 1e-5 * np.eye(len(x)):
            ends = []
            for moved in (x + step, x - step):
                near = assess(problem, moved[:-1], moved[-1], depth=-3.0).peaks
                assert near is not None
                same = np.flatnonzero(near.curve == one.curve[0])
                k = same[np.argmin(np.abs(np.log(near.v[same] / one.v[0])))]
                ends.append(np.append(near.to_kappa[k], near.to_tau[k]))
            rows.append((ends[0] - ends[1]) / 2e-5)
        np.testing.assert_allclose(exact, rows, atol=1e-4 * (1.0 + np.abs(rows).max()))


def test_stability_is_that_of_the_closed_loops_characteristic_polynomial() -> None:
    """Against roots of the polynomial of 1 + GK, for stable and unstable random loops alike."""
    rng = np.random.default_rng(5)
    structure = Structure(lead=1, biquads=1, roll_off=1)
    problem = problem_for([plant()], structure, BOUNDS)
    kappa = at_random(problem, np.exp(rng.uniform(-4.0, 0.5, 200)), rng)
    member = problem.plants
    verdicts = all_stable(closed_loops(member, structure, kappa))[:, 0]
    for one, verdict in zip(kappa, verdicts, strict=True):
        zeros, poles = structure.roots(one)
        s0 = np.array([1.3j])
        lead = (structure.response(one, s0) * np.prod(s0 - poles) / np.prod(s0 - zeros))[0].real
        p, r = member.poles[0], member.residues[0, :, 0, 0]
        above = sum(r[i] * np.poly(np.delete(p, i)) for i in range(len(p)))
        joint = np.polyadd(np.polymul(np.poly(p), np.poly(poles)),
                           lead * np.polymul(above, np.poly(zeros)))  # fmt: skip
        margin = np.roots(joint.real).real.max()
        if abs(margin) > 1e-5:
            assert verdict == (margin < 0.0)
    assert 10 < verdicts.sum() < 190


def test_units_change_nothing() -> None:
    """The same plant in mm and mN, M_K accordingly: the same constraints, κ in its units."""
    problem, kappa = loop(1, Structure())
    modal_units = plant()
    other = replace(modal_units, force=modal_units.force * 7.0)
    bounds = replace(BOUNDS, weights=replace(BOUNDS.weights, M_K=BOUNDS.weights.M_K * 7.0),
                     compliance_max=BOUNDS.compliance_max / 7.0)  # fmt: skip
    again = problem_for([other], problem.structure, bounds)
    si = problem.structure.in_units(kappa, problem.plants.omega_0, problem.plants.force)
    moved = problem.structure.in_units(si, 1.0, 7.0)
    np.testing.assert_allclose(in_problem_units(again, moved), kappa, atol=1e-12)
    a, b = (assess(x, kappa, -2.0).peaks for x in (problem, again))
    assert a is not None
    assert b is not None
    np.testing.assert_allclose(a.value, b.value, atol=1e-9)


def test_plants_that_cannot_be_in_a_set_are_refused() -> None:
    with pytest.raises(PlantError, match="at least one"):
        plant_set([])
    good = plant()
    double = replace(good, B=np.hstack([good.B, good.B]))
    with pytest.raises(PlantError, match="SISO"):
        plant_set([double])


def test_grid_points_that_rounding_parts_count_as_one() -> None:
    """Two of them at a peak left the judge a bracket without it."""
    pair = np.array([-1.0 + 100.0j, (-1.0 + 100.0j) * (1.0 + 1e-13)])
    grid = grid_through([pair], None, 1.0, 100.0, 0.0)
    assert (np.diff(grid) > 1e-10 * grid[1:]).all()
    assert np.abs(grid - 100.0).min() < 1e-9


@pytest.mark.parametrize("power", [3, 9, 21])
@pytest.mark.parametrize("mirrored", [False, True])
def test_a_peak_is_closed_in_on_however_flat_one_side_of_it_is(
    power: int, mirrored: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A slope of 1e-4 at one end and of 1 at the other: false position alone stays at its end.

    The search took such a point for the peak of T, and the judge refused its best controller.
    """
    least = 1e-4

    def slope(v: float) -> float:
        return mirror * (least - (mirror * np.log(v)) ** power)

    mirror = -1.0 if mirrored else 1.0
    ends = np.exp(mirror * np.array([0.0, 1.0]))
    none = np.zeros(1, int)
    brackets = Brackets(none, none, ends[:1], np.exp([min(0.0, mirror)]),
                        np.exp([max(0.0, mirror)]))  # fmt: skip
    top, inside = closed(monkeypatch, slope, brackets)
    assert inside.all()
    assert mirror * np.log(top) == pytest.approx(least ** (1.0 / power), abs=1e-6)


def test_a_plant_that_answers_nothing_raises_nothing() -> None:
    """G = 0 at a frequency: curves of it are -inf, and no division is an error."""
    problem, kappa = loop(0, Structure())
    silence = replace(problem.plants, residues=0.0 * problem.plants.residues)
    silent = replace(problem, plants=silence)
    v = np.geomspace(0.01, 1.0, 5)
    found = by_curve(silent, kappa, 0.0, silent.curves, np.tile(v, (1, 1)))
    assert (found[LoopCurve.T] == -np.inf).all()
    rows = RowPlaces(np.full(5, int(LoopCurve.T)), np.zeros(5, int), v)
    assert not np.isfinite(evaluate_rows(silent, kappa, 0.0, rows)[1]).any()


def test_a_sampled_controller_is_as_exact_by_its_modes_as_by_its_matrices() -> None:
    """Tustin's rule puts poles of 2/T at z = 0, where LAPACK's eigenvectors of a balanced system
    erred by 1e-10: against the sections at the s of each z. 2e-4 of |K| was lost."""
    T, structure, rng = 1.25e-4, Structure(biquads=1), np.random.default_rng(0)
    omega = HZ * np.geomspace(0.1, 3500.0, 200)
    z = np.exp(1j * omega * T)
    for _ in range(10):
        values = {
            "gain": 1e5, "integrator": HZ * rng.uniform(0.2, 2.0),
            "lead 1 zero": HZ * rng.uniform(1.0, 20.0),
            "biquad 1 zeros": HZ * rng.uniform(100.0, 2000.0),
            "biquad 1 zeros damping": rng.uniform(0.1, 1.0),
            "biquad 1 poles damping": rng.uniform(0.1, 1.0),
            "roll-off 1": HZ * rng.uniform(200.0, 2500.0),
            "roll-off 1 damping": rng.uniform(0.3, 1.0),
        }  # fmt: skip
        kappa = np.log([values.get(name, 2.0 / T) for name in structure.names])
        exact = np.ravel(structure.response(kappa, 2.0 / T * (z - 1.0) / (z + 1.0)))
        found = tustin(structure.state_space(kappa).balance(), T).sweep(omega)[:, 0, 0]
        assert np.abs(found / exact - 1.0).max() < 1e-8
