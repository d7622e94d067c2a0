"""`compliance_max` where forces act and errors count: against the dynamic stiffness of the loop."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.linalg import expm

from ccd_casadi.cases.case import load_case
from ccd_casadi.cases.case_problem import problem_of
from ccd_casadi.cases.checks import CaseError
from ccd_casadi.cases.diagnosis import diagnose, suspicions
from ccd_casadi.codesign.final_judgement import other_damping, plants_of_set
from ccd_casadi.codesign.joint_model import JointModel, JointPoint
from ccd_casadi.codesign.outer_problem import FormulationResult
from ccd_casadi.codesign.survival import loops_of
from ccd_casadi.codesign.verified import Solution
from ccd_casadi.fixed_structure.bounds import Bounds
from ccd_casadi.fixed_structure.box_proof import BoxProofOptions, ProofOutcome, _families, prove
from ccd_casadi.fixed_structure.boxes import Boxes, Chart
from ccd_casadi.fixed_structure.certificate import SetCertificate, certify
from ccd_casadi.fixed_structure.channel_design import synthesise_sections
from ccd_casadi.fixed_structure.design import SectionsDesign, problem_for
from ccd_casadi.fixed_structure.figures import constraints, hessians, to_theta
from ccd_casadi.fixed_structure.loop_problem import LoopProblem, RowPlaces
from ccd_casadi.fixed_structure.structure import Structure
from ccd_casadi.fixed_structure.uncertainty import UncertainPlant
from ccd_casadi.inner_problem.kinds import loop_on
from ccd_casadi.inner_problem.problem import CoDesignProblem
from ccd_casadi.inner_problem.structured_plant_set import nearby, plants_of, uncertain_plant
from ccd_casadi.inner_problem.structured_problem import with_structured
from ccd_casadi.kernels.sections import LoopCurve
from ccd_casadi.lti.loop import Sampling, tustin, zoh
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.lti.wiring import Filters, ForcedPlant, OwnPorts, Wiring
from ccd_casadi.plants.plant import Mechanics
from ccd_casadi.robust.perturbed import sampled_compliance
from ccd_casadi.solve import main as solve
from ccd_casadi.solve import with_causes
from ccd_casadi.support.command_line import ExitCode
from ccd_casadi.support.text import HZ

RATE, DELAY, M0, M1, SPRING, ZETA = 10_000.0, 130e-6, 2.0, 0.4, 3e5, 0.03
RUNS = [None, Sampling(RATE, 1e6 * DELAY)]
STRUCTURE = Structure(biquads=0)
BOUNDS = Bounds(S_max=2.0, S_low=0.3, omega_low=2.0 * HZ, shape=4.0, compliance_max=3e-5)
BARE, AMPLIFIER, BOTH = range(3)  # with an amplifier, and a filter
Key = tuple[int, int, int]  # forces, errors, and one of these
PORTS: list[Key] = [(1, 0, BARE), (2, 0, BARE), (0, 1, BARE), (2, 1, BARE), (1, 2, BARE),
                    (1, 0, AMPLIFIER), (2, 1, AMPLIFIER), (1, 0, BOTH), (2, 1, BOTH)]  # fmt: skip


def matrices(t: float, forces: int, errors: int) -> tuple[np.ndarray, ...]:
    """A table and its tool on a spring; t moves masses, spring, forces and readings."""
    M, K = np.diag([M0 + t, M1]), SPRING * (1.0 + 0.2 * t) * np.array([[1.0, -1.0], [-1.0, 1.0]])
    B, C = np.array([[1.0 + 0.3 * t], [0.0]]), np.array([[1.0, 0.1 * t]])
    E = np.array([[0.1 * t, 0.2], [1.0, 0.3 + t]])[:, :forces] if forces else B
    F = np.array([[0.1 * t, 1.2], [0.5, 0.5 - t]])[:errors] if errors else C
    return M, K, B, C, E, F


def system(t: float, forces: int, errors: int, wired: int) -> Mechanics:
    def wide(t: float) -> tuple[np.ndarray, ...]:
        M, K, B, C, E, F = matrices(t, forces, errors)
        B = np.hstack([B, E]) if forces or wired else B
        return M, 0.0 * K, K, B, np.vstack([C, F]) if errors or wired == BOTH else C

    h = 1e-6
    slopes = tuple(
        ((a - b) / (2.0 * h))[None] for a, b in zip(wide(t + h), wide(t - h), strict=True)
    )
    amplifier = Filters((), (2000.0,), (0.7,)) if wired else Filters()
    wiring = Wiring(amplifier, Filters((5000.0,)) if wired == BOTH else Filters(), (1, 1))
    return Mechanics(*wide(t), ZETA, slopes, wiring)  # type: ignore[arg-type]


def box_of(forces: int, errors: int, wired: int, t: float = 0.0, **box: float) -> UncertainPlant:
    own = OwnPorts(1, 1, errors or int(wired == BOTH))
    return UncertainPlant((system(t, forces, errors, wired),), 1e6, own=own, **box)  # type: ignore[arg-type]


def first_order(
    forces: int, errors: int, wired: int, shift: float = 0.0, gain: float = 0.0
) -> tuple[np.ndarray, ...]:
    """A, B of u and of forces, C of the sensor and of what counts."""
    M, K, B, C, E, F = matrices(0.0, forces, errors)
    K = K * (1.0 + shift) ** 2
    root = np.sqrt(np.diag(M))
    squares, V = np.linalg.eigh(K / np.outer(root, root))
    omega = np.sqrt(np.maximum(squares, 0.0)) * (np.arange(2) > 0)
    D = (root[:, None] * V) @ np.diag(2.0 * ZETA * omega) @ (root[:, None] * V).T
    a, s, n = HZ * 2000.0, HZ * 5000.0, 7 if wired else 4
    A, Bu, Bd = np.zeros((n, n)), np.zeros((n, 1)), np.zeros((n, E.shape[1]))
    y, z = np.zeros((1, n)), np.zeros((len(F), n))
    A[:2, 2:4] = np.eye(2)
    A[2:4, :2], A[2:4, 2:4] = -np.linalg.solve(M, K), -np.linalg.solve(M, D)
    Bd[2:4], z[:, :2] = np.linalg.solve(M, E), F
    if wired:
        A[2:4, [4]] = np.linalg.solve(M, B)
        A[4, 5], A[5, 4], A[5, 5], Bu[5] = 1.0, -(a**2), -1.4 * a, a**2
        A[6, :2], A[6, 6] = s * C[0], -s
    else:
        Bu[2:4] = np.linalg.solve(M, B)
    if wired == BOTH:
        y[0, 6] = 1.0
    else:
        y[:, :2] = C
    return A, (1.0 + gain) * Bu, Bd, y, z


def moved(
    plant: tuple[np.ndarray, ...], K: StateSpace, run: Sampling | None, omega: np.ndarray
) -> np.ndarray:
    """σ_max of what counts per force."""
    (A, Bu, Bd, y, z), n = plant, len(plant[0])
    d = np.linalg.solve(1j * omega[:, None, None] * np.eye(n) - A, Bd + 0j)
    if run is None:
        u = np.linalg.solve(1j * omega[:, None, None] * np.eye(n) - A, Bu + 0j)
        k = K.at(1j * omega)
    else:

        def over(t: float) -> tuple[np.ndarray, np.ndarray]:
            whole = expm(np.block([[A, Bu], [np.zeros((1, n + 1))]]) * t)
            return whole[:n, :n], whole[:n, n:]

        T = run.period
        late = int(run.delay / T + 1e-9)
        (Phi, now), (_, early) = over(T - (run.delay - late * T)), over(run.delay - late * T)
        turn = np.exp(1j * omega * T)[:, None, None]
        u = np.linalg.solve(turn * np.eye(n) - over(T)[0], now + Phi @ early / turn) / turn**late
        k = tustin(K, T).at(turn[:, 0, 0])
    return np.asarray(
        np.linalg.norm(z @ d - z @ u * k / (1.0 + y @ u * k) * (y @ d), 2, axis=(1, 2))
    )


def peak_of(plant: tuple[np.ndarray, ...], K: StateSpace, run: Sampling | None) -> float:
    omega = np.geomspace(0.05, 0.999 * np.pi * RATE, 4000)
    for _ in range(5):
        value = moved(plant, K, run, omega)
        i = int(value.argmax())
        omega = np.linspace(omega[max(i - 1, 0)], omega[min(i + 1, len(omega) - 1)], 101)
    return float(value.max())


def a_controller() -> np.ndarray:
    """κ in SI of a lead with an integrator around 30 Hz."""
    at = {"gain": 6e4, "integrator": HZ * 3.0, "lead 1 zero": HZ * 12.0, "roll-off 1 damping": 0.7}
    return np.log([at.get(name, HZ * 900.0) for name in STRUCTURE.names])


def row_at(
    ports: Key, run: Sampling | None, kappa: np.ndarray, hz: float, t: float = 0.0
) -> tuple[LoopProblem, np.ndarray, RowPlaces]:
    problem = problem_for(box_of(*ports, t).plants([(0, np.zeros(0))]), STRUCTURE, BOUNDS, run)
    P = problem.plants
    inside = STRUCTURE.in_units(kappa, 1.0 / P.omega_0, 1.0 / P.force)
    v = P.variable(np.array([HZ * hz / P.omega_0]))
    return problem, inside, RowPlaces(np.array([LoopCurve.GS]), np.zeros(1, int), v)


@pytest.mark.parametrize("run", RUNS)
@pytest.mark.parametrize("ports", PORTS)
def test_the_row_and_its_slopes_are_those_of_the_stiffness(
    ports: Key, run: Sampling | None
) -> None:
    kappa, h = a_controller(), 1e-5
    K = STRUCTURE.state_space(kappa)

    def at(hz: float, t: float = 0.0, step: np.ndarray | float = 0.0) -> tuple[float, np.ndarray]:
        problem, inside, place = row_at(ports, run, kappa + step, hz, t)
        row = constraints(problem, inside, 0.0, place)
        return float(row.value[0]) - problem.margin, row.to_kappa[0]

    for hz in (3.0, 60.0, 140.0):
        (own,) = moved(first_order(*ports), K, run, np.array([HZ * hz]))
        value, to_kappa = at(hz)
        assert value == pytest.approx(np.log(own / 3e-5), abs=1e-9)
        problem, inside, place = row_at(ports, run, kappa, hz)
        row = constraints(problem, inside, 0.0, place)
        slope = (at(hz, 1e-4)[0] - at(hz, -1e-4)[0]) / 2e-4
        assert to_theta(problem, inside, row)[0, 0] == pytest.approx(slope, abs=1e-7)
        ends = [(at(hz, 0.0, h * e), at(hz, 0.0, -h * e)) for e in np.eye(len(kappa))]
        steps = [(up[0] - down[0]) / (2.0 * h) for up, down in ends]
        np.testing.assert_allclose(to_kappa, steps, rtol=0, atol=1e-8)
        bends = [(up[1] - down[1]) / (2.0 * h) for up, down in ends]
        curvature = hessians(problem, inside, 0.0, row)[0][:-1, :-1]
        np.testing.assert_allclose(curvature, bends, rtol=0, atol=1e-8)


def test_towards_rest_free_bodies_cancel_nowhere() -> None:
    """An integrator holds the table; the tool yields by the spring's 1.2/k per force on it. Of
    G_zd, 10^13 times as large at 10 µHz, no digit would be left."""
    kappa = a_controller()
    for ports in ((1, 1, BARE), (1, 1, BOTH)):
        problem, inside, place = row_at(ports, None, kappa, 1e-5)
        value = constraints(problem, inside, 0.0, place).value[0] - problem.margin
        assert np.exp(value) * 3e-5 == pytest.approx(1.2 / SPRING, rel=1e-6)
        plants = box_of(*ports).as_written([(0, np.zeros(0))])
        K = STRUCTURE.state_space(kappa)
        for integrator in (True, False):
            found = certify(plants, K, BOUNDS, integrator=integrator).plants[0]
            assert found.static_compliance == pytest.approx(1.2 / SPRING, rel=2e-3)


@pytest.fixture(scope="module")
def designs() -> dict[tuple[bool, Key], tuple[SectionsDesign, SectionsDesign, Bounds]]:
    return {}


Known = dict[tuple[bool, Key], tuple[SectionsDesign, SectionsDesign, Bounds]]


def designed(
    known: Known, ports: Key, run: Sampling | None
) -> tuple[SectionsDesign, SectionsDesign, Bounds]:
    """Without a bound of the compliance, with one below what that design has, and the bounds."""
    if (key := (run is None, ports)) not in known:
        box = box_of(*ports, resonance_shift=0.02)
        plants, bounds = box.plants(box.corners()), replace(BOUNDS, compliance_max=None)
        free = synthesise_sections(plants, STRUCTURE, bounds, sampling=run, starts=1)
        assert free.certificate is not None
        most = 0.85 * max(one.GS for one in free.certificate.plants)
        bounds = replace(BOUNDS, compliance_max=most)
        bound = synthesise_sections(plants, STRUCTURE, bounds, sampling=run, starts=1)
        known[key] = free, bound, bounds
    return known[key]


@pytest.mark.parametrize("run", RUNS)
@pytest.mark.parametrize("ports", [(1, 0, AMPLIFIER), (1, 1, BARE), (2, 1, BOTH)])
def test_the_bound_is_kept_and_binds_on_the_set(
    designs: Known, ports: Key, run: Sampling | None
) -> None:
    """50 plants of the set by their own matrices, at peaks that a zoom finds; measured 1e-9."""
    free, design, bounds = designed(designs, ports, run)
    assert design.certified
    K, box = design.controller, box_of(*ports, resonance_shift=0.02)
    assert K is not None
    assert bounds.compliance_max is not None
    assert design.multipliers.get("GS", 0.0) > 1e-4
    assert design.bandwidth < free.bandwidth
    shifts = [0.0, *np.linspace(-0.02, 0.02, 49).tolist()]
    judged = certify(box.as_written([(0, np.array([s])) for s in shifts]), K, bounds, run)
    own = np.array([peak_of(first_order(*ports, s), K, run) for s in shifts])
    np.testing.assert_allclose([one.GS for one in judged.plants], own, rtol=1e-6)
    assert own.max() == pytest.approx(bounds.compliance_max, rel=1e-5)
    assert ("GS" in judged.grid_only) == (run is not None)  # else a Hamiltonian matrix confirms it


@pytest.mark.parametrize("run", RUNS)
@pytest.mark.parametrize(
    "ports", [(2, 0, BARE), (1, 0, AMPLIFIER), (1, 1, BARE), (2, 1, AMPLIFIER)]
)
def test_forces_and_errors_elsewhere_are_proven_and_refuted(
    designs: Known, ports: Key, run: Sampling | None
) -> None:
    _, design, bounds = designed(designs, ports, run)
    assert design.certified
    box = box_of(*ports, resonance_shift=0.02)
    of = (design.structure, design.kappa, design.bandwidth)
    proof = prove(box, *of, bounds, run)
    assert proof.outcome is ProofOutcome.PROVEN, proof
    assert proof.levels["GS"] == pytest.approx(1.0, abs=2e-3)
    assert proof.conclusive
    loose = replace(bounds, compliance_max=0.9 * bounds.compliance_max)  # type: ignore[operator]
    assert prove(box, *of, loose, run).outcome is ProofOutcome.REFUTED


@pytest.mark.parametrize("run", RUNS)
@pytest.mark.parametrize("integrator", [True, False])
@pytest.mark.parametrize("ports", [(1, 0, BARE), (1, 1, BARE), (2, 1, AMPLIFIER), (1, 2, BARE)])
def test_boxes_enclose_what_forces_move(ports: Key, integrator: bool, run: Sampling | None) -> None:
    """Boxes of frequency, shift, damping and gain, some from rest on: plants inside them by the
    matrices as they are written."""
    structure = Structure(integrator=integrator, biquads=0)
    kappa = a_controller()[[i for i, name in enumerate(STRUCTURE.names) if name in structure.names]]
    box, K = (
        box_of(*ports, resonance_shift=0.1, damping=(0.5, 2.0), gain=0.1),
        structure.state_space(kappa),
    )
    of = (structure, kappa, HZ * 20.0, BOUNDS, run)
    families = _families(box, *of, BoxProofOptions())
    assert not isinstance(families, ProofOutcome)
    (family,) = families
    rng, unit, seen = np.random.default_rng(0), family.unit, 0
    scale = 1.0 if run is None else family.period
    for begin in [0.0, *np.geomspace(0.5, HZ * 900.0, 60).tolist()]:
        ends = np.array([begin, begin * rng.uniform(1.001, 1.1) if begin else 3.0]) / unit
        low, high = box.box
        inner = np.sort(low[:, None] + rng.uniform(0, 1, (3, 2)) * (high - low)[:, None], axis=1)
        inner[:, 1] = inner[:, 0] + rng.uniform(0.0, 0.1) * (inner[:, 1] - inner[:, 0])
        chart = Chart.LOW if run is None else Chart.SAMPLED
        one = Boxes(np.array([chart]), np.vstack([ends * scale, inner])[:, :1],
                    np.vstack([ends * scale, inner])[:, 1:])  # fmt: skip
        with np.errstate(all="ignore"):
            found = family.enclose(one)
        k = found.names.index("GS")
        for share in rng.uniform(0, 1, (4, 4)):
            at = one.low[:, 0] + share * (one.high - one.low)[:, 0]
            (plant,) = box.as_written([(0, at[1:])])
            assert isinstance(plant, ForcedPlant)
            forced, driven = plant.mechanics, plant.counted or plant
            rows = slice(0 if plant.counted is None else 1, None)
            parts = (plant.A, driven.B, forced.B, plant.C, forced.C[rows])
            (value,) = moved(parts, K, run, np.array([max(at[0] / scale * unit, 0.02)])) / 3e-5
            assert found.lowest[k, 0] * (1.0 - 1e-6) <= value <= found.highest[k, 0] * (1.0 + 1e-6)
        seen += bool(found.highest[k, 0] < 1.5 * value)
    assert seen > 20  # so that they are not infinite


AT_U = (0, 0, BARE)


@pytest.mark.parametrize("run", RUNS)
@pytest.mark.parametrize("ports", [AT_U, (1, 0, BARE), (0, 1, BARE), (2, 1, AMPLIFIER)])
def test_an_error_of_the_gain_moves_what_u_moves_alone(ports: Key, run: Sampling | None) -> None:
    """A motor 10 % weak: the same force meets a softer loop. Of what u moves alone the peak grows,
    and is proven as closely as without an error; rows have slopes to it."""
    kappa, K = a_controller(), STRUCTURE.state_space(a_controller())
    box = box_of(*ports, gain=0.1)
    if ports == AT_U:
        box = replace(box, own=None)
    gains = np.linspace(-0.1, 0.1, 9)
    own = np.array([peak_of(first_order(*ports, gain=g), K, run) for g in gains])
    judged = certify(box.as_written([(0, np.array([g])) for g in gains]), K, BOUNDS, run)
    np.testing.assert_allclose([one.GS for one in judged.plants], own, rtol=1e-6)
    assert own.argmax() == 0

    def row(g: float) -> tuple[float, float]:
        plant = box.with_slopes(np.array([g]))
        problem = problem_for([plant], STRUCTURE, BOUNDS, run)
        P = problem.plants
        inside = STRUCTURE.in_units(kappa, 1.0 / P.omega_0, 1.0 / P.force)
        v = P.variable(np.array([HZ * 60.0 / P.omega_0]))
        place = RowPlaces(np.array([LoopCurve.GS]), np.zeros(1, int), v)
        found = constraints(problem, inside, 0.0, place)
        return float(found.value[0]), float(to_theta(problem, inside, found)[0, 0])

    for g in (-0.1, 0.05):
        assert row(g)[1] == pytest.approx((row(g + 1e-5)[0] - row(g - 1e-5)[0]) / 2e-5, abs=1e-6)
    of = (STRUCTURE, kappa, HZ * 5.0)
    loose = replace(BOUNDS, S_max=20.0, S_low=5.0, shape=None)
    for share, outcome in ((1.005, ProofOutcome.PROVEN), (0.99, ProofOutcome.REFUTED)):
        bounds = replace(loose, compliance_max=share * float(own.max()))
        assert prove(box, *of, bounds, run).outcome is outcome


def test_a_peak_near_rest_is_proven_over_an_error_of_the_gain() -> None:
    """Below ω_low all figures fall with frequency, which alone was divided: 1.1/0.9 was left."""
    values = {"gain": 3e4, "integrator": HZ * 0.5, "lead 1 zero": HZ * 5.0,
              "roll-off 1 damping": 0.7}  # fmt: skip
    kappa = np.log([values.get(name, HZ * 900.0) for name in STRUCTURE.names])
    K, box = STRUCTURE.state_space(kappa), box_of(1, 1, BARE, gain=0.1, resonance_shift=0.02)
    bounds = replace(BOUNDS, S_max=20.0, S_low=20.0, omega_low=HZ * 8.0, shape=None)
    judged = certify(box.as_written(box.corners()), K, bounds, RUNS[1])
    peak = max(one.GS for one in judged.plants)
    assert all(one.low_compliance < 0.9 * peak for one in judged.plants)  # it lies below ω_low
    proof = prove(box, STRUCTURE, kappa, HZ * 2.0, replace(bounds, compliance_max=1.005 * peak),
                  RUNS[1])  # fmt: skip
    assert proof.outcome is ProofOutcome.PROVEN, proof


def test_a_member_behind_an_amplifier_has_its_own_forces(tmp_path: Path) -> None:
    """What disturbing forces move has no states of the amplifier: loops of the set are made."""
    more = "gain = 0.1\n[actuator]\nlag_hz = 2000.0"
    problem = problem_in(tmp_path, 'ports = "none"', more)
    problem = with_structured(problem, structure=STRUCTURE)
    K, uncertain = STRUCTURE.state_space(a_controller()), uncertain_plant(problem, problem.start)
    points = uncertain.corners()
    judged = certify(uncertain.as_written(points), K, BOUNDS, problem.sampling)
    for (option, point), own in zip(points, judged.plants, strict=True):
        loop = loop_on(problem, uncertain.plant(point, option).plant_si(), K)
        assert loop.stable
        assert loop.peak == pytest.approx(own.S_peak, rel=1e-6)


@pytest.mark.parametrize("run", RUNS)
def test_an_error_before_a_filter_is_judged_not_proven(
    designs: Known, run: Sampling | None
) -> None:
    ports: Key = (2, 1, BOTH)
    _, design, bounds = designed(designs, ports, run)
    box = box_of(*ports, resonance_shift=0.02)
    proof = prove(box, design.structure, design.kappa, design.bandwidth, bounds, run)
    assert proof.outcome is ProofOutcome.PROVEN
    assert proof.unproven == "compliance_max is judged, not proven"
    assert "GS" not in proof.levels
    assert not proof.conclusive  # so that random plants are drawn, too


PLANT = '''
import casadi as ca

def stage(theta, ports="both", sensors=1):
    """A table, its tool on a spring: forces act at the tool, and its position counts."""
    m, k = theta["m"], 3e5 * theta["t"]
    found = {"mass": ca.diag(ca.vertcat(m, 0.4)), "stiffness": k * ca.DM([[1, -1], [-1, 1]]),
             "damping_ratio": 0.03, "input": ca.DM([1, 0]), "output": ca.DM.eye(2)[:sensors, :],
             "hardware_cost": m + theta["t"]}
    if sensors == 2:
        found["input"] = ca.DM.eye(2)
    if ports in ("both", "disturbance", "many"):
        found["disturbance"] = ca.DM.eye(2) if ports == "many" else ca.DM([0, 1])
    if ports in ("both", "performance", "many"):
        found["performance"] = ca.DM.eye(2) if ports == "many" else ca.DM([[0, 1]])
    return found
'''
CASE = """
[plant]
function = "plant.py:stage"
OPTIONS
[theta.m]
lower = 1.5
upper = 2.5
start = 2.0
unit = "kg"
[theta.t]
lower = 0.7
upper = 1.5
start = 1.0
unit = "1"
[objective]
w1 = 1.0
w2 = -0.01
[controller]
structure = "sections"
[loop]
rate_hz = 10000.0
delay_us = 130.0
[inner]
S_max = 2.0
S_low = 0.3
omega_low_hz = 2.0
compliance_max = 3e-5
[robust]
resonance_shift = 0.02
MORE
"""


def problem_in(folder: Path, options: str = "", more: str = "") -> CoDesignProblem:
    (folder / "plant.py").write_text(PLANT)
    text = CASE.replace("OPTIONS", options).replace("MORE", more)
    (folder / "case.toml").write_text(text)
    return problem_of(load_case(folder / "case.toml"))


@pytest.mark.parametrize("wired", [BARE, AMPLIFIER, BOTH])
@pytest.mark.parametrize("shift", [-0.1, 0.0, 0.2])
def test_the_spring_yields_however_stiff_the_loop_is(wired: int, shift: float) -> None:
    """A held table and a force at its tool: 1/k, the same as of any loop with an integrator."""
    box = box_of(1, 1, wired, resonance_shift=0.3, gain=0.3)
    found = box.plant(np.array([shift, -0.2])).held_compliance
    assert found == pytest.approx(1.2 / (SPRING * (1.0 + shift) ** 2), rel=1e-9)  # 1e-14 found
    K = StateSpace(*(np.array([[x]]) for x in (0.0, 1.0, 1e7, 0.0)))  # an integrator alone
    at_rest = moved(first_order(1, 1, wired, shift), K, None, np.array([0.1]))
    assert at_rest[0] == pytest.approx(found, rel=1e-5)
    at_sensor = box_of(1, 0, wired).plant(np.zeros(0)).held_compliance
    assert at_sensor == pytest.approx(0.0, abs=1e-9 * found)


@pytest.mark.parametrize(
    ("most", "severity", "count"),
    [("2.0e-6", "warning", 6), ("3.4e-6", "warning", 3), ("4.0e-6", "note", 2), ("6e-6", "", 0)],
)
def test_a_compliance_below_that_of_the_held_sensor_is_a_warning(
    tmp_path: Path, most: str, severity: str, count: int
) -> None:
    """1/k is 3.33 um/N at the start and 3.47 on the softest plant of its set, 2.31 to 4.96 over
    the box."""
    problem_in(tmp_path)
    case = tmp_path / "case.toml"
    case.write_text(case.read_text().replace("compliance_max = 3e-5", f"compliance_max = {most}"))
    found = diagnose(problem := problem_of(load_case(case)))[1]
    words = [item for item in found if "compliance_max" in item.words]
    assert [item.severity.value for item in words] == [severity] * bool(severity)
    assert not words or f"of 6 points of the box {count} exceed it" in words[0].words
    assert not words or "the least is 2.31 µm/N at theta" in words[0].words
    assert bool(words) == any("sensor held still" in cause for cause in suspicions(problem))
    loose = with_structured(problem, structure=Structure(integrator=False))
    assert not [item for item in diagnose(loose)[1] if "compliance_max" in item.words]
    ended = {"status": "infeasible", "reason": "none", "time_budget": {"ended": True}}
    failed = Solution(ended, FormulationResult(), None)
    reason = str(with_causes(failed, load_case(case), problem).result["reason"])
    assert ("a larger --budget" in reason) == (count < 6)  # which no time changes


@pytest.mark.parametrize("more", ["", "[actuator]\nlag_hz = 2000.0"])
@pytest.mark.parametrize("ports", ["both", "disturbance", "performance"])
def test_plants_near_a_theta_carry_their_ports(tmp_path: Path, ports: str, more: str) -> None:
    """Of the joint search: values and slopes to θ's shares, by differences of a whole plant."""
    problem = problem_in(tmp_path, f'ports = "{ports}"', more)
    theta, kappa = problem.start, a_controller()
    problem = with_structured(problem, structure=STRUCTURE)
    models = nearby(problem, (), theta)
    point = JointPoint(theta, tuple(kappa), 100.0)
    joint = JointModel(problem, models, point, 0.5)
    (z, inside, _), hz = joint.parts(joint.beginning.x), 60.0  # type: ignore[union-attr]

    def at(z: np.ndarray) -> tuple[float, np.ndarray]:
        loops = joint.loops(z)
        v = loops.plants.variable(np.array([HZ * hz / loops.plants.omega_0]))
        row = constraints(
            loops, inside, 0.0, RowPlaces(np.array([LoopCurve.GS]), np.zeros(1, int), v)
        )
        return float(row.value[0]), to_theta(loops, inside, row)[0]

    h = 1e-5
    steps = [(at(z + h * e)[0] - at(z - h * e)[0]) / (2.0 * h) for e in np.eye(2)]
    np.testing.assert_allclose(at(z)[1], steps, rtol=0, atol=1e-6)


def test_the_other_damping_and_code_are_judged_at_the_ports(tmp_path: Path) -> None:
    problem = problem_in(tmp_path)
    problem = with_structured(problem, structure=STRUCTURE)
    kappa = a_controller()
    K, run = STRUCTURE.state_space(kappa), problem.sampling
    assert run is not None

    def shares(judged: SetCertificate) -> float:
        return judged.worst["GS"]

    found = other_damping(problem, loops_of(problem, problem.start, K))
    assert found is not None
    corners = uncertain_plant(problem, problem.start).corners()[1:]
    own = uncertain_plant(problem, problem.start).as_written(corners)
    assert found.own["GS"] == pytest.approx(shares(certify(own, K, BOUNDS, run)), rel=1e-6)
    plant = plants_of(problem, problem.start)[0].plant_si()
    moves = sampled_compliance(plant, zoh(plant, run.period, run.delay), tustin(K, run.period),
                               delay=run.delay)  # fmt: skip
    judged = certify(plants_of_set(problem, problem.start)[:1], K, BOUNDS, run)
    assert moves == pytest.approx(judged.plants[0].GS, rel=1e-6)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ('ports = "many"', "several forces and several errors"),
        ("sensors = 2", "several sensors or actuators"),
    ],
)
def test_what_is_not_bounded_is_named(tmp_path: Path, options: str, words: str) -> None:
    with pytest.raises(CaseError, match=words):
        problem_in(tmp_path, options)


@pytest.mark.slow
def test_a_solved_case_is_verified_at_its_ports(tmp_path: Path) -> None:
    """Behind an amplifier, with a bound that is active."""
    (tmp_path / "plant.py").write_text(PLANT)
    text = CASE.replace("OPTIONS", "").replace("MORE", "[actuator]\nlag_hz = 2000.0")
    one = text.replace("lower = 0.7\nupper = 1.5\nstart = 1.0", "fixed = 1.0")
    one = one.replace('"sections"', '"sections"\nstarts = 2\nbiquads = 0')
    (tmp_path / "case.toml").write_text(one.replace("3e-5", "1.5e-5"))
    out = tmp_path / "run"
    options = [str(tmp_path / "case.toml"), "--out", str(out), "--workers", "1", "--no-report"]
    assert solve(options) == ExitCode.DONE
    result = json.loads((out / "result.json").read_text())
    assert "compliance_max" in result["active"]
    required = {one["name"]: one for one in result["requirements"]}
    assert required["compliance_max"]["evidence"] == "proven"
    assert result["compliance_max"] == pytest.approx(1.5e-5, rel=1e-4)
