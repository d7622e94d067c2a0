"""Several actuators on one sensor: S, KS, T and S G of 1 x 2 plants, and the disk drive."""

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from oracles.fixed_structure_channels import BOUNDS, FAST, assert_derivatives, plant
from scipy.linalg import block_diag
from scipy.signal import cont2discrete

from ccd_casadi.fixed_structure.bounds import Bounds
from ccd_casadi.fixed_structure.certificate import certify
from ccd_casadi.fixed_structure.channel_design import synthesise_sections as synthesise
from ccd_casadi.fixed_structure.channel_structure import (
    ChannelStructure,
    find_decoupling,
    given_decoupling,
)
from ccd_casadi.fixed_structure.composite import composite_problem
from ccd_casadi.fixed_structure.figures import assess, hessians
from ccd_casadi.fixed_structure.loop_problem import LoopCurve, LoopProblem
from ccd_casadi.fixed_structure.plant_set import plant_set
from ccd_casadi.fixed_structure.starts import actuator_starts
from ccd_casadi.fixed_structure.structure import Structure
from ccd_casadi.lti.loop import Sampling
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.plants.scaling import ScaledPlant, scale_state_space
from ccd_casadi.support.errors import PlantError
from ccd_casadi.support.text import HZ

ROOT = Path(__file__).resolve().parents[2]
BOTH = given_decoupling(("coarse", "fine"), [[1], [1]], [[1, 0], [0, 1]])
STRUCTURE = ChannelStructure(
    BOTH, (Structure(biquads=1, roll_off=1), Structure(integrator=False, biquads=0, roll_off=1))
)


def one_sensor(theta: tuple[float, float] = (1.0, 1.0), off: float = 0.3) -> ScaledPlant:
    """The first output of the stage of three channels, its first two inputs."""
    whole = plant(theta, off)
    B, dB, C, dC = whole.B[:, :2], whole.dB[:, :, :2], whole.C[:1], whole.dC[:, :1]
    return replace(whole, B=B, dB=dB, C=C, dC=dC, channels=())


def problem(theta: tuple[float, float], sampling: Sampling | None) -> LoopProblem:
    """Of the plants at (1, 1) and at θ."""
    first = [one_sensor(), one_sensor(theta, 0.2)]
    box = composite_problem(first[:1], STRUCTURE, BOUNDS, sampling).box
    return LoopProblem(plant_set(first, sampling, BOTH), STRUCTURE, BOUNDS, box)


def start(sampling: Sampling | None) -> np.ndarray:
    """A random κ that both plants are stable with."""
    plants = [one_sensor(), one_sensor(off=0.2)]
    whole = composite_problem(plants, STRUCTURE, BOUNDS, sampling)
    found = actuator_starts(whole, STRUCTURE, plants, sampling, 1, np.random.default_rng(0))
    assert len(found) == 1
    return found[0]


def test_a_channel_like_another_adds_no_parameters_to_a_start() -> None:
    """It has those of its owner; a rotor's second plane like its first ended in a traceback."""
    alike = replace(STRUCTURE, structures=STRUCTURE.structures[1:] * 2, owners=(0, 0))
    plants = [one_sensor()]
    whole = composite_problem(plants, alike, BOUNDS, FAST)
    found = actuator_starts(whole, alike, plants, FAST, 1, np.random.default_rng(0))
    assert [len(kappa) for kappa in found] == [len(alike.names)]


@pytest.mark.parametrize("sampling", [None, FAST])
def test_derivatives_of_gains_of_1_by_2_plants(sampling: Sampling | None) -> None:
    kappa = start(sampling)
    seen = assert_derivatives(
        lambda theta: problem(theta, sampling), kappa, lambda row: row % 2 == 1
    )
    assert seen >= {LoopCurve.S_MAX, LoopCurve.S_LOW, LoopCurve.CROSSING}
    assert seen & {LoopCurve.KS, LoopCurve.GS}


def test_second_derivatives_of_1_by_2_plants() -> None:
    """At fixed frequencies, of every curve: |S|, |T| and the singular values of KS and S G."""
    kappa, model = start(FAST), problem((1.0, 1.0), FAST)
    peaks = assess(model, kappa, -1.5, depth=-2.0).peaks
    rng = np.random.default_rng(1)
    direction = rng.normal(0.0, 1.0, len(kappa))
    direction /= np.linalg.norm(direction)
    ends = [assess(model, kappa + x * direction, -1.5, depth=-2.5).peaks for x in (1e-5, -1e-5)]
    for j in range(len(peaks.v)):
        one = peaks.only(np.array([j]))
        exact = hessians(model, kappa, -1.5, one)[0, :-1, :-1] @ direction
        slopes = []
        for end in ends:
            same = np.flatnonzero((end.curve == one.curve[0]) & (end.plant == one.plant[0]))
            slopes.append(end.to_kappa[same[np.argmin(np.abs(np.log(end.v[same] / one.v[0])))]])
        numeric = (slopes[0] - slopes[1]) / 2e-5
        np.testing.assert_allclose(exact, numeric, atol=2e-4 * (1.0 + np.abs(numeric).max()))


def test_the_peak_of_s_is_that_of_the_sum_of_both_loops() -> None:
    kappa, model = start(None), problem((1.0, 1.0), None)
    first = one_sensor()
    K = STRUCTURE.state_space(STRUCTURE.in_units(kappa, first.omega_0, first.force))
    s = 1j * first.omega_0 * np.geomspace(1e-2, 1e4, 20001)[:, None, None]
    G = first.plant_si()
    k = K.C @ np.linalg.solve(s * np.eye(len(K.A)) - K.A, K.B + 0j) + K.D
    g = G.C @ np.linalg.solve(s * np.eye(len(G.A)) - G.A, G.B + 0j)
    loops = g[:, 0, 0] * k[:, 0, 0] + g[:, 0, 1] * k[:, 1, 0]
    peaks = assess(model, kappa, -1.5).peaks
    own = peaks.value[(peaks.plant == 0) & (peaks.curve == LoopCurve.S_MAX)].max()
    assert np.exp(own) * BOUNDS.S_max == pytest.approx(np.abs(1.0 / (1.0 + loops)).max(), rel=1e-3)


@pytest.mark.parametrize("sampling", [None, FAST])
def test_the_judge_sees_a_loop_at_rest_with_one_integrator_of_two(
    sampling: Sampling | None,
) -> None:
    """K has a pole at 0 Hz then, S G goes to 0; with no integrator it goes to G/(1 + L)."""
    first, kappa = one_sensor(), start(sampling)
    own = STRUCTURE.in_units(kappa, first.omega_0, first.force)
    K = STRUCTURE.state_space(own)
    found = certify([first], K, BOUNDS, sampling, integrator=STRUCTURE.integrator).plants[0]
    assert 0.0 < found.static_compliance < 1e-3 * found.low_compliance
    G = first.plant_si()
    g = G.C @ np.linalg.solve(-G.A, G.B)
    k = np.array([[0.1], [0.2]]) / np.abs(g).max()
    still = StateSpace(np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((2, 0)), k)
    found = certify([first], still, BOUNDS, sampling, integrator=False).plants[0]
    expected = np.linalg.norm(g) / abs(1.0 + (g @ k).item())
    assert found.static_compliance == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("sampling", [None, Sampling(1e4, 100.0)])
@pytest.mark.parametrize("inertia", [0.3, 1.0])
def test_at_rest_a_channel_keeps_its_digits_beside_one_of_a_free_body(
    sampling: Sampling | None, inertia: float
) -> None:
    """|L| of a free channel with an integrator is 1e20 at a microhertz: rounding of it was all that
    was left of a sprung one without, and |T| 20 where it is 1.5. Channels alone know no other."""
    U = np.array([[1.0, 1.0], [1.0, -1.0]]) / np.sqrt(2.0)
    twist = StateSpace(np.array([[0.0, 1.0], [-((HZ * 40.0) ** 2), -10.0]]),
                       np.array([[0.0], [1.0 / inertia]]), np.array([[1.0, 0.0]]),
                       np.zeros((1, 1)))  # fmt: skip
    free = StateSpace(np.array([[0.0, 1.0], [0.0, 0.0]]), np.array([[0.0], [1.0]]),
                      np.array([[1.0, 0.0]]), np.zeros((1, 1)))  # fmt: skip
    A, B, C = (block_diag(getattr(free, n), getattr(twist, n)) for n in "ABC")
    whole = StateSpace(A, B @ U.T, U @ C, np.zeros((2, 2)))
    lead = Structure(lead=1, biquads=0, roll_off=1)
    slow = Structure(integrator=False, lead=0, biquads=0, roll_off=1)
    gain = (HZ * 30.0) ** 2
    kappas = (np.log([gain / 3.0, HZ * 0.5, HZ * 10.0, HZ * 300.0, HZ * 900.0]),
              np.log([50.0 * inertia * (HZ * 40.0) ** 2 / 400.0, HZ * 3.0]))  # fmt: skip
    K = [one.state_space(kappa) for one, kappa in zip((lead, slow), kappas, strict=True)]
    parts = [block_diag(*(getattr(one, n) for one in K)) for n in "ABCD"]
    joint = StateSpace(parts[0], parts[1] @ U.T, U @ parts[2], U @ parts[3] @ U.T)
    bounds = Bounds(S_max=4.0, S_low=1.0, omega_low=HZ, shape=None)
    together = certify([whole], joint, bounds, sampling, integrator=False).plants[0]
    each = [certify([G], k, bounds, sampling, integrator=own.integrator).plants[0]
            for G, k, own in zip((free, twist), K, (lead, slow), strict=True)]  # fmt: skip
    assert together.stable
    assert all(one.stable for one in each)
    for name in ("S_peak", "KS", "T"):
        assert getattr(together, name) == pytest.approx(
            max(getattr(one, name) for one in each), rel=1e-4
        )
    assert together.static_compliance == pytest.approx(each[1].static_compliance, rel=1e-3)


@pytest.mark.slow
def test_a_coarse_and_a_fine_actuator_are_designed_together() -> None:
    """From nothing but their bounds; judged by the sum of both loops at the sampling instants."""
    HZ = 2.0 * np.pi
    rows = [(0.1, 0.7, 30.0**2), (200.0, 0.01, -0.9 * 30.0**2), (2000.0, 0.05, 2000.0**2)]
    A, B = np.zeros((6, 6)), np.zeros((6, 2))
    for i, (hz, zeta, gain) in enumerate(rows):
        w = HZ * hz
        A[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] = [[0.0, w], [-w, -2.0 * zeta * w]]
        B[2 * i + 1, int(i == 2)] = HZ**2 * gain / w
    both = StateSpace(A, B, np.tile([1.0, 0.0], 3)[None], np.zeros((1, 2)))
    bounds = Bounds(S_max=2.0, S_low=0.01, omega_low=HZ, shape=1.1)
    own = Structure(biquads=0, roll_off=1)
    structure = ChannelStructure(BOTH, (own, replace(own, integrator=False)))
    made = synthesise([scale_state_space(both, 1e-3)], structure, bounds, sampling=Sampling(8000.0),
                      starts=2)  # fmt: skip
    assert made.certified, made.words
    K = made.controller
    loop = (
        cont2discrete((A, B, both.C, both.D), 1.0 / 8000.0, "zoh"),
        cont2discrete((K.A, K.B, K.C, K.D), 1.0 / 8000.0, "bilinear"),
    )
    omega = HZ * np.geomspace(0.1, 4000.0, 4000)
    z = np.exp(1j * omega / 8000.0)[:, None, None]
    g, k = (
        np.asarray(c @ np.linalg.solve(z * np.eye(len(a)) - a, b + 0j) + d)
        for a, b, c, d, _ in loop
    )
    S = np.abs(1.0 / (1.0 + (g @ k)[:, 0, 0]))
    assert S.max() <= 2.0 * (1.0 + 1e-5)
    assert (S[omega < made.bandwidth] <= np.sqrt(0.5) * (1.0 + 1e-5)).all()


def test_channels_that_do_not_fit_the_plant_are_refused() -> None:
    with pytest.raises(PlantError, match="need a channel each"):
        given_decoupling(("a", "b"), [[1, 0, 0], [0, 1, 0]], [[1, 0], [0, 1]])
    with pytest.raises(PlantError, match="1 outputs and 2 inputs"):
        plant_set([one_sensor()], None, find_decoupling(plant()))
    whole = plant()
    fewer = replace(whole, B=whole.B[:, :2], dB=whole.dB[:, :, :2], channels=())
    directions = given_decoupling(("a", "b"), [[1, 0], [0, 1]], [[1, 0], [0, 1]])
    with pytest.raises(PlantError, match="3 outputs and 2 inputs"):
        plant_set([fewer], None, directions)


@pytest.fixture
def drive(monkeypatch: pytest.MonkeyPatch):
    """The benchmark of the disk drive, and its example."""
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    monkeypatch.syspath_prepend(str(ROOT / "examples" / "disk_drive"))
    for name in ("plant", "design", "disk_drive"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    import disk_drive

    yield disk_drive
    for name in ("plant", "design", "disk_drive"):
        sys.modules.pop(name, None)


@pytest.mark.parametrize("name", ["largest bandwidth", "least error"])
def test_the_kept_controllers_of_the_disk_drive_keep_what_the_page_says(drive, name: str) -> None:
    """Three of the nine plants: each is stable, and within what the table of all nine says."""
    kept = json.loads((ROOT / "benchmarks" / "disk_drive.json").read_text())
    branches, nine = drive.ours(kept["sections"][name]), kept["results"][name]["nine"]
    assert nine["stable"] == nine["plants"] == 9
    for temperature, gain in ((-1.0, 0.95), (0.0, 1.0), (1.0, 1.05)):
        found = drive.judge(branches, temperature, gain)
        assert found["stable"]
        assert found["S_peak"] <= nine["S_peak"] * (1.0 + 1e-5)
        low, high = nine["bandwidth_hz"]
        assert low * (1.0 - 1e-4) <= found["bandwidth_hz"] <= high * (1.0 + 1e-4)
