"""Amplifiers and sensor filters in the loop: exact responses, derivatives, designs, and a judge."""

from dataclasses import replace

import numpy as np
import pytest
from oracles.sampled_loop import sampled_loop

from ccd_casadi.cases.case import load_case
from ccd_casadi.cases.case_problem import problem_of
from ccd_casadi.cases.checks import CaseError
from ccd_casadi.fixed_structure.bounds import Bounds
from ccd_casadi.fixed_structure.box_proof import ProofOutcome, prove
from ccd_casadi.fixed_structure.channel_design import synthesise_sections
from ccd_casadi.fixed_structure.plant_set import plant_set
from ccd_casadi.fixed_structure.structure import Structure
from ccd_casadi.fixed_structure.uncertainty import UncertainPlant
from ccd_casadi.kernels.modes import form_slopes
from ccd_casadi.lti.loop import Sampling, zoh
from ccd_casadi.lti.wiring import Filters, Wiring
from ccd_casadi.plants.as_written import as_written
from ccd_casadi.plants.modal import FREE, modal_plant
from ccd_casadi.plants.plant import Mechanics
from ccd_casadi.plants.scaling import ScaledPlant, scale_plant

HZ = 2.0 * np.pi
AMPLIFIER = Filters((), (500.0,), (0.7,))
WIRINGS = {
    "actuator": Wiring(actuator=Filters((200.0,))),
    "sensor": Wiring(sensor=Filters((300.0,))),
    "both": Wiring(Filters((200.0,), (500.0,), (0.7,)), Filters((300.0,), (800.0,), (0.3,))),
}


def chain(t: float, wiring: Wiring, braked: float = 0.0) -> Mechanics:
    """Three masses, free or braked; t moves masses, stiffness, force and reading."""

    def matrices(t: float) -> tuple[np.ndarray, ...]:
        link = np.array([[1.0, -1.0], [-1.0, 1.0]])
        K = np.zeros((3, 3))
        K[:2, :2] += 3e4 * link
        K[1:, 1:] += 2e5 * (1.0 + 0.1 * t) * link
        M = np.diag([4.0 + t, 1.0, 0.5])
        B, C = np.array([[1.0 + 0.3 * t], [0.0], [0.0]]), np.array([[1.0, 0.2 + 0.1 * t, 0.0]])
        return M, 1e-4 * K + braked * M, K, B, C

    h = 1e-6
    ends = zip(matrices(t + h), matrices(t - h), strict=True)
    slopes = tuple(((a - b) / (2.0 * h))[None] for a, b in ends)
    return Mechanics(*matrices(t), None, slopes, wiring)  # type: ignore[arg-type]


def scaled(system: Mechanics) -> ScaledPlant:
    return scale_plant(modal_plant(system, FREE), 1e5, bare=True)


@pytest.mark.parametrize("run", [None, Sampling(2000.0, 0.0), Sampling(2000.0, 600.0)])
@pytest.mark.parametrize("name", WIRINGS)
def test_responses_and_their_slopes_are_those_of_the_matrices(name: str, run: Sampling) -> None:
    """Free bodies behind a lag have a pole 0 twice, and 1/s beside 1/s²; braked ones once."""
    for braked in (0.0, 30.0):
        wiring = WIRINGS[name]
        plant = scaled(chain(0.0, wiring, braked))
        assert plant.free
        P = plant_set([plant], run)
        omega = HZ * np.geomspace(0.5, 900.0, 30)
        at, which = P.variable(omega / plant.omega_0), np.zeros(30, int)
        written = as_written(chain(0.0, wiring, braked))
        held = written if run is None else zoh(written, run.period, run.delay)
        G = P.responses(which, at)[0][:, 0, 0] / plant.force
        np.testing.assert_allclose(G, held.response(omega)[:, 0, 0], rtol=1e-9)

        def moved(t: float, braked: float = braked, omega: np.ndarray = omega) -> np.ndarray:
            own = scaled(chain(t, WIRINGS[name], braked)).plant_si()
            own = own if run is None else zoh(own, run.period, run.delay)
            return own.response(omega)[:, 0, 0]

        slope = (moved(1e-5) - moved(-1e-5)) / 2e-5
        one = np.ones((30, 1), complex)
        for turn in (1.0, 1.0j):
            found = form_slopes(P.slopes, which, at, turn * one, one, False)[:, 0] / plant.force
            assert np.abs(found - (turn * slope).real).max() < 1e-6 * np.abs(slope).max()
            assert (np.abs(found - (turn * slope).real) < 1e-4 * np.abs(slope)).all()


@pytest.mark.parametrize("pole_hz", [0.0, 30.0])
def test_an_amplifier_that_is_stated_is_designed_for(pole_hz: float) -> None:
    """1 kg, free or on a magnet, with 500 Hz in front: the judge has it in its own matrices."""
    run, bounds = (
        Sampling(4000.0, 250.0),
        Bounds(S_max=2.0, S_low=0.2, omega_low=2.0 * HZ, shape=4.0),
    )
    square = (HZ * pole_hz) ** 2
    none = tuple(np.zeros((0, *shape)) for shape in ((1, 1),) * 5)
    bare = Mechanics(np.eye(1), np.zeros((1, 1)), np.array([[-square]]), np.eye(1), np.eye(1), None,
                     none)  # type: ignore[arg-type]  # fmt: skip
    wired = replace(bare, wiring=Wiring(actuator=AMPLIFIER))
    box = UncertainPlant((wired,), 1e5, gain=0.1)
    design = synthesise_sections(box.plants(box.corners()), Structure(biquads=1), bounds,
                                 sampling=run, starts=3)  # fmt: skip
    assert design.certified
    assert design.controller is not None
    w = 500.0 * HZ
    A = np.array([[0.0, w, 0.0, 0.0], [-w, -1.4 * w, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0],
                  [1.0, 0.0, square, 0.0]])  # fmt: skip
    C = np.array([[0.0, 0.0, 1.0, 0.0]])
    for gain in (0.9, 1.0, 1.1):
        radius, omega, S = sampled_loop(
            A, gain * np.array([[0.0], [w], [0.0], [0.0]]), C, design.controller, run
        )
        assert radius < 1.0
        assert S.max() <= bounds.S_max * (1.0 + 1e-3)
        assert S[omega <= design.bandwidth].max() <= np.sqrt(0.5) * (1.0 + 1e-3)
    of = (design.structure, design.kappa, design.bandwidth, bounds, run)
    proof = prove(box, *of, slack=5e-3)  # corners were designed on, not the inside
    assert proof.outcome is ProofOutcome.PROVEN, proof
    assert max(proof.levels.values()) > 0.99
    wide = UncertainPlant((wired,), 1e5, gain=0.5)
    assert prove(wide, *of, slack=5e-3).outcome is ProofOutcome.REFUTED
    twice = replace(wired, wiring=Wiring(actuator=Filters((900.0,)), sensor=Filters((900.0,))))
    both = UncertainPlant((twice,), 1e5, gain=0.01)
    assert prove(both, *of, slack=5e-3).outcome in (ProofOutcome.WIRED, ProofOutcome.UNSTABLE)
    without = np.array([[0.0, 1.0], [square, 0.0]])
    _, _, S = sampled_loop(without, np.array([[0.0], [1.0]]), C[:, 2:], design.controller, run)
    assert abs(S.max() / bounds.S_max - 1.0) > 0.01  # it is no other loop's controller


CASE = """
[plant]
model = "two_mass"
[theta]
m1 = { lower = 50.0, start = 55.0, upper = 70.0, unit = "kg" }
m2 = { lower = 50.0, start = 55.0, upper = 70.0, unit = "kg" }
[objective]
w1 = 1.0
w2 = -1.0
[controller]
structure = "sections"
[inner]
S_max = 2.0
S_low = 0.1
omega_low_hz = 1.0
"""


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ("[actuator]\nlag_hz = [100.0, 200.0]", "actuator.lag_hz has 2 entries for 1 channels"),
        ("[sensor]\ndamping = 0.5", "sensor.damping: has no effect without second_order_hz"),
        ("[sensor]\nlag_hz = 0.0", "sensor.lag_hz: is 0.0; give Hz from 0.01 to 1e7"),
        ("[sensor]\nlag_hz = 1e12", "sensor.lag_hz: is 1000000000000.0; give Hz from 0.01 to 1e7"),
        ("[sensor]\nsecond_order_hz = 1e3\ndamping = 1e9", "give a damping ratio from 0.001"),
    ],
)
def test_what_a_wiring_cannot_be_is_reported_by_key(tmp_path, table: str, words: str) -> None:
    path = tmp_path / "case.toml"
    path.write_text(f"{CASE}{table}\n")
    with pytest.raises(CaseError) as caught:
        problem_of(load_case(path))
    assert words in str(caught.value)


def test_a_wiring_is_part_of_the_plants_identity(tmp_path) -> None:
    path = tmp_path / "case.toml"
    problems = []
    for table in ("", "[actuator]\nlag_hz = 100.0", "[sensor]\nlag_hz = 100.0"):
        path.write_text(f"{CASE}{table}\n")
        problems.append(problem_of(load_case(path)))
    identities = [str(problem.identity()) for problem in problems]
    assert len(set(identities)) == 3
    assert "wiring" not in identities[0]  # what was stored before stays valid


@pytest.mark.parametrize(
    "filters",
    [Filters((2e3,)), Filters((), (5e3,), (0.7,)), Filters((2e3, 1e3), (5e3, 4e3), (0.7,))],
)
def test_the_delay_of_a_filter_is_its_slope_of_phase_at_rest(filters: Filters) -> None:
    count, slow = len(filters.lag_hz or filters.second_order_hz), 1.0
    response = filters.system(count, "sensor").response(np.array([slow]))[0]
    late = -np.angle(np.diag(response)) / slow
    assert late == pytest.approx(filters.delays, rel=1e-6)
    words = Wiring(sensor=filters).words
    assert all(f"{1e6 * delay:.3g}" in words for delay in filters.delays)
