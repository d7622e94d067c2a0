"""Plants that their stiffness drives away: derivatives, designs, proofs, and what is impossible.

The judge is `oracles.sampled_loop`.
"""

from functools import cache

import numpy as np
import pytest
from oracles.sampled_loop import sampled_loop
from scipy.linalg import solve

from ccd_casadi.cases.case import load_case
from ccd_casadi.cases.case_problem import problem_of
from ccd_casadi.cases.diagnosis import diagnose
from ccd_casadi.codesign.outer_problem import FormulationResult
from ccd_casadi.codesign.result_entries import IsoZones, iso_entry
from ccd_casadi.codesign.verified import Solution
from ccd_casadi.fixed_structure.bounds import Bounds
from ccd_casadi.fixed_structure.box_proof import ProofOutcome, prove
from ccd_casadi.fixed_structure.boxes import Boxes, Chart, axis_of
from ccd_casadi.fixed_structure.channel_design import synthesise_sections as synthesise
from ccd_casadi.fixed_structure.channel_structure import ChannelStructure, given_decoupling
from ccd_casadi.fixed_structure.design import SectionsDesign
from ccd_casadi.fixed_structure.discs import discs_of
from ccd_casadi.fixed_structure.plant_set import plant_set
from ccd_casadi.fixed_structure.structure import Structure
from ccd_casadi.fixed_structure.uncertainty import UncertainPlant, modal_sum
from ccd_casadi.lti.loop import Loop, Sampling
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.plants.as_written import as_written
from ccd_casadi.plants.modal import FREE, Perturbation, modal_plant
from ccd_casadi.plants.plant import Mechanics
from ccd_casadi.solve import with_causes

HZ = 2.0 * np.pi
RUN = Sampling(1e4, 100.0)
BOUNDS = Bounds(S_max=2.0, S_low=0.2, omega_low=2.0 * HZ, shape=4.0)


def levitated(pole_hz: float, mode_hz: float | None = None) -> Mechanics:
    """1 kg on a magnet, or 0.7 kg with 0.3 kg on a spring."""
    if mode_hz is None:
        M, K = np.eye(1), np.array([[-((HZ * pole_hz) ** 2)]])
        D, B = np.zeros((1, 1)), np.ones((1, 1))
    else:
        k = 0.21 * (HZ * mode_hz) ** 2
        M = np.diag([0.7, 0.3])
        K = np.array([[k - (HZ * pole_hz) ** 2, -k], [-k, k]])
        D = 0.02 * k / (HZ * mode_hz) * np.array([[1.0, -1.0], [-1.0, 1.0]])
        B = np.array([[1.0], [0.0]])
    none = tuple(np.zeros((0, *part.shape)) for part in (M, D, K, B, B.T))
    return Mechanics(M, D, K, B, B.T, None, none)


@cache
def box(mode_hz: float | None) -> UncertainPlant:
    return UncertainPlant((levitated(60.0, mode_hz),), 1e5, resonance_shift=0.05, gain=0.1)


@cache
def designed(mode_hz: float | None) -> SectionsDesign:
    plants = box(mode_hz).plants(box(mode_hz).corners())
    found = synthesise(plants, Structure(biquads=1), BOUNDS, sampling=RUN, starts=3)
    assert found.certified, found.outcome
    return found


@pytest.mark.parametrize("mode_hz", [None, 600.0])
def test_a_levitated_body_is_held_on_its_whole_set(mode_hz: float | None) -> None:
    design, rng = designed(mode_hz), np.random.default_rng(1)
    for shift, gain in rng.uniform(-1.0, 1.0, (12, 2)) * [0.05, 0.1]:
        own = levitated(60.0, mode_hz)
        M, D, K, B, C = own.matrices
        A = np.block([[0.0 * M, np.eye(len(M))], [-solve(M, (1.0 + shift) ** 2 * K), -solve(M, D)]])
        drive = np.vstack([0.0 * B, (1.0 + gain) * solve(M, B)])
        assert design.controller is not None
        radius, omega, S = sampled_loop(A, drive, np.hstack([C, 0.0 * C]), design.controller, RUN)
        assert radius < 1.0
        assert S.max() <= BOUNDS.S_max * (1.0 + 2e-3)  # corners were designed on, not the inside
        assert np.interp(BOUNDS.omega_low, omega, S) <= BOUNDS.S_low * (1.0 + 2e-3)
        below = S[omega <= design.bandwidth]
        assert below.max() <= np.sqrt(0.5) * (1.0 + 2e-3)


def test_the_set_is_proven_and_a_wider_one_is_not() -> None:
    """±5 % of the rate are ±10 % of the magnet's stiffness."""
    design = designed(None)
    of = (design.structure, design.kappa, design.bandwidth, BOUNDS, RUN)
    found = prove(box(None), *of, slack=5e-3)
    assert found.outcome is ProofOutcome.PROVEN, found
    wide = UncertainPlant((levitated(60.0),), 1e5, resonance_shift=0.5, gain=0.5)
    assert prove(wide, *of, slack=5e-3).outcome is ProofOutcome.REFUTED


def test_discs_hold_what_is_driven_away() -> None:
    """Points of boxes lie in the discs, and a box that is one point is the plant itself."""
    uncertain, rng = box(None), np.random.default_rng(2)
    modes = modal_sum(uncertain, 0, 1000.0)
    assert modes is not None
    scale = float(modes.drive[0, 0] * modes.reading[0, 0])
    for sampling, wide in ((RUN, 0.0), (RUN, 0.05), (Sampling(1e4, 130.0), 0.02), (None, 0.05)):
        T = 0.0 if sampling is None else 1000.0 * sampling.period
        top = np.pi if sampling else 1.0
        w = np.geomspace(1e-4, 0.99 * top, 40)
        middle = rng.uniform(-0.04, 0.04, (2, 40))
        low = np.array([w, *(middle - 0.5 * wide * 0.1)])
        high = np.array([w * (1.0 + 0.1 * wide), *(middle + 0.5 * wide * 0.1)])
        chart = Chart.LOW if sampling is None else Chart.SAMPLED
        delay = 0.0 if sampling is None else 1000.0 * sampling.delay
        axis = axis_of(Boxes(np.full(40, chart), low, high), T or None, delay)
        held, _, damped = discs_of(modes, uncertain.names, low[1:], high[1:], axis, True)
        assert damped.all()
        at = low + rng.uniform(0.0, 1.0, low.shape) * (high - low)
        for k in range(40):
            plant = uncertain.plant(at[1:, k])
            own = plant_set([plant], sampling)
            omega = at[0, k] * (1000.0 if sampling is None else 1.0 / (T / 1000.0))
            v = own.variable(np.array([omega / plant.omega_0]))
            G = own.responses(np.array([0]), v)[0][0, 0, 0] / plant.force
            off = abs(G - held.middle[0, k] * scale)
            assert off <= held.radius[0, k] * scale * (1.0 + 1e-9) + 1e-11 * abs(G)


@pytest.mark.parametrize(
    "off", [Perturbation(), Perturbation(0.1, 0.5), Perturbation(0.0, 1.0, (0.2,))]
)
def test_as_written_answers_as_the_modes_do(off: Perturbation) -> None:
    """Also the derivatives to the stiffness, where a damping ratio damps the other mode alone."""
    system = levitated(40.0, 300.0)
    slope = np.zeros((1, 2, 2))
    slope[0, 0, 0] = 1.0
    derivatives = (0.0 * slope, 0.0 * slope, slope, np.zeros((1, 2, 1)), np.zeros((1, 1, 2)))
    ratio = Mechanics(system.M, 0.0 * system.D, system.K, system.B, system.C, 0.01, derivatives)
    modal = modal_plant(ratio, FREE, off)
    assert modal.driven_away.tolist() == [True, False]
    written = as_written(ratio, shift=off.shift, modes=off.modes, damping=off.damping)
    s = 1j * HZ * np.geomspace(0.5, 2000.0, 60)
    np.testing.assert_allclose(modal.state_space.at(s), written.at(s), rtol=1e-9)
    h = 1e-5 * abs(system.K[0, 0])
    ends = []
    for sign in (-1.0, 1.0):
        K = system.K + sign * h * slope[0]
        own = Mechanics(ratio.M, ratio.D, K, ratio.B, ratio.C, 0.01, derivatives)
        ends.append(modal_plant(own, FREE, off).state_space.at(s)[:, 0, 0])
    stiff, damp = modal.dK[0], modal.dD[0]
    reading = [np.linalg.solve(x**2 * np.eye(2) + x * modal.D + modal.K, modal.B) for x in s]
    back = [np.linalg.solve((x**2 * np.eye(2) + x * modal.D + modal.K).T, modal.C.T) for x in s]
    exact = [
        -(b.T @ (stiff + x * damp) @ q)[0, 0] for x, q, b in zip(s, reading, back, strict=True)
    ]
    np.testing.assert_allclose((ends[1] - ends[0]) / (2.0 * h), exact, rtol=2e-5)


def test_a_pole_too_fast_for_the_delay_is_reported_before_a_search(tmp_path) -> None:
    plant = (
        "def axis(theta):\n"
        "    k = (2 * 3.141592653589793 * theta['pole']) ** 2\n"
        "    return {'mass': 1.0, 'stiffness': -k, 'damping': 0.0, 'input': 1.0, 'output': 1.0,\n"
        "            'hardware_cost': theta['pole']}\n"
    )
    (tmp_path / "plant.py").write_text(plant)
    case = (
        '[plant]\nfunction = "plant.py:axis"\n[theta]\n'
        'pole = { lower = 1.0, start = START, upper = 1500.0, unit = "1" }\n'
        '[controller]\nstructure = "sections"\n[inner]\nS_max = 2.0\nS_low = 0.5\n'
        "omega_low_hz = 1.0\n[objective]\nw1 = 0.0\nw2 = -1.0\n"
        "[loop]\nrate_hz = 10000.0\ndelay_us = 100.0\n"
    )
    path = tmp_path / "case.toml"
    for start, reported in (("50.0", False), ("1000.0", True)):
        path.write_text(case.replace("START", start))
        problem = problem_of(load_case(path))
        words = " ".join(found.words for found in diagnose(problem)[1])
        assert "the stiffness drives a motion away at the start" in words
        pole = f"as no spring makes): an unstable pole at +{float(start):g} Hz"
        for status, named in (("infeasible", True), ("not_verified", False), ("verified", False)):
            failed = Solution({"status": status, "reason": "none"}, FormulationResult(), None)
            why = with_causes(failed, load_case(path), problem).result["reason"]
            assert (pole in why) is named
        assert ("no controller has a peak of S below 2.51" in words) is reported


def test_a_levitated_plant_has_its_zone_of_iso_14839() -> None:
    zones = IsoZones()
    assert [zones.of(peak) for peak in (2.99, 3.0, 3.99, 4.5, 5.0)] == ["A", "B", "B", "C", "D"]
    case = load_case("examples/magnetic_axis/case.toml")
    problem = problem_of(case)
    of_set = {"sensitivity_peak": 2.0, "robust": {"worst_sensitivity_peak": 3.5}}
    found = iso_entry(problem, problem.start, of_set)["iso_14839_3"]
    assert found == {"zone": "B", "sensitivity_peak": 3.5}
    guided = problem_of(load_case("runs/two_mass.toml"))
    assert iso_entry(guided, guided.start, of_set) == {"iso_14839_3": None}


def test_two_bearings_hold_a_rotor_that_each_of_them_feels_whole() -> None:
    """4 kg, off centre between two magnets: two unstable motions, and both are in every channel, so
    that no channel is designed alone."""
    c, k_i, k_s = np.array([[1.0, -0.1], [1.0, 0.15]]), 40.0, np.array([1e5, 0.8e5])
    M, drive = np.diag([4.0, 0.05]), k_i * c.T
    K = -c.T @ np.diag(k_s) @ c
    none = tuple(np.zeros((0, *part.shape)) for part in (M, M, K, drive, c))
    rotor = UncertainPlant((Mechanics(M, 0.0 * M, K, drive, c, None, none),), 1e5, gain=0.1)
    own = Structure(lead=1, biquads=0, roll_off=2)
    structure = ChannelStructure(
        given_decoupling(("a", "b"), [[1, 0], [0, 1]], [[1, 0], [0, 1]]), (own, own)
    )
    plants = rotor.plants(rotor.corners())
    found = synthesise(plants, structure, BOUNDS, sampling=RUN, starts=3)
    assert found.certified, found.outcome
    for gain in (0.9, 1.0, 1.1):
        A = np.block([[0.0 * M, np.eye(2)], [-solve(M, K), 0.0 * M]])
        B, C = np.vstack([0.0 * M, gain * solve(M, drive)]), np.hstack([c, 0.0 * c])
        loop = Loop(StateSpace(A, B, C, np.zeros((2, 2))), found.controller, RUN)
        omega = np.geomspace(1.0, np.pi / RUN.period, 2000)
        G, K_z = (part.response(omega) for part in loop.as_run)
        S = np.linalg.norm(np.linalg.inv(np.eye(2) + G @ K_z), 2, axis=(1, 2))
        assert loop.stable
        assert S.max() <= BOUNDS.S_max * (1.0 + 2e-3)
