"""Free bodies are free: in the responses and slopes of a search, in proofs, and as judged apart."""

from dataclasses import replace
from itertools import pairwise

import casadi as ca
import numpy as np
import pytest
from oracles.fixed_structure_loops import WEIGHTS
from oracles.helpers import HZ

from ccd_casadi.fixed_structure.affine import Affine
from ccd_casadi.fixed_structure.bounds import Bounds
from ccd_casadi.fixed_structure.box_proof import prove
from ccd_casadi.fixed_structure.boxes import Boxes, Chart
from ccd_casadi.fixed_structure.certificate import certify
from ccd_casadi.fixed_structure.channel_design import synthesise_sections
from ccd_casadi.fixed_structure.channel_structure import Decoupling
from ccd_casadi.fixed_structure.enclosure import LoopFamily
from ccd_casadi.fixed_structure.plant_set import plant_set
from ccd_casadi.fixed_structure.structure import Structure
from ccd_casadi.fixed_structure.uncertainty import ModalSum, UncertainPlant, modal_sum
from ccd_casadi.kernels.modes import form_slopes
from ccd_casadi.lti.loop import Sampling, zoh
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.plants.as_written import as_written
from ccd_casadi.plants.modal import FREE, modal_plant, without_hidden_rigid_modes
from ccd_casadi.plants.plant import build_plant, mechanics
from ccd_casadi.plants.scaling import ScaledPlant, scale_plant
from ccd_casadi.support.arrays import Array

WAYS = [None, Sampling(1000.0), Sampling(1000.0, 300.0), Sampling(2000.0, 1700.0)]


def beam(theta):  # type: ignore[no-untyped-def]
    """Three masses, the last one apart by itself where it is not sprung, two forces and sensors."""
    a, b = theta["a"], theta["b"]
    K = ca.SX.zeros(3, 3)
    for i, j, k in ((0, 1, 3000.0 * a * a), (1, 2, 9000.0 * b)):
        e = ca.DM.zeros(3, 1)
        e[i], e[j] = 1.0, -1.0
        K = K + k * ca.mtimes(e, e.T)
    return {
        "mass": ca.diag(ca.vertcat(4.0 + a, 1.0, 2.0 * b)),
        "stiffness": K,
        "damping_ratio": 0.003,
        "input": ca.DM([[1.0, 0.0], [0.0, 0.3], [0.0, 1.0]]),
        "output": ca.vertcat(ca.horzcat(1.0, 0.0, 0.1 * a), ca.horzcat(0.0, 0.2 * a, 1.0)),
        "hardware_cost": a,
    }


PLANT = build_plant(beam, ["a", "b"], {})
AT = np.array([1.0, 1.3])


def scaled(theta: Array) -> ScaledPlant:
    modal = modal_plant(mechanics(PLANT, theta), FREE)
    return scale_plant(without_hidden_rigid_modes(modal), 1e5, bare=True)


def direct(theta: Array, omega: Array, sampling: Sampling | None) -> np.ndarray:
    """The answer of the plant as its function returned it."""
    G = as_written(mechanics(PLANT, theta))
    if sampling is None:
        return G.at(1j * omega)
    held = zoh(G, sampling.period, sampling.delay)
    return held.at(np.exp(1j * omega * sampling.period))


@pytest.mark.parametrize("sampling", WAYS)
def test_responses_and_slopes_are_those_of_the_plant_as_written(sampling) -> None:
    own = scaled(AT)
    plants = plant_set([own], sampling, Decoupling(("1", "2"), np.eye(2), np.eye(2)))
    assert (plants.poles == 0.0).any()
    v, which = np.geomspace(1e-2, 20.0, 60), np.zeros(60, int)
    omega = plants.frequency(v) * own.omega_0
    G, slope = plants.responses(which, v)
    truth = own.force * direct(AT, omega, sampling)
    size = np.abs(truth).max(axis=(1, 2))
    assert (np.abs(G - truth).max(axis=(1, 2)) / size).max() < 1e-9
    w = plants.systems[0]
    assert (np.abs(w.at(1j * v) - G).max(axis=(1, 2)) / size).max() < 1e-9
    h = 1e-5
    near = [plants.responses(which, v * np.exp(step))[0] for step in (h, -h)]
    error = np.abs((near[0] - near[1]) / (2.0 * h) - slope).max(axis=(1, 2))
    assert (error / (size + np.abs(slope).max(axis=(1, 2)))).max() < 1e-5
    rng = np.random.default_rng(0)
    x, y = (rng.normal(size=(60, 2)) + 1j * rng.normal(size=(60, 2)) for _ in range(2))
    found = form_slopes(plants.slopes, which, v, x, y, False)
    for k, step in enumerate(1e-4 * np.eye(2)):
        moved = direct(AT + step, omega, sampling) - direct(AT - step, omega, sampling)
        moved = own.force * moved / 2e-4
        form = np.einsum("np,npm,nm->n", x, moved, y).real
        most = np.einsum("np,npm,nm->n", np.abs(x), np.abs(moved), np.abs(y))
        assert (np.abs(form - found[:, k]) / most).max() < 1e-5  # 5e-7 was seen


@pytest.mark.parametrize("sampling", WAYS)
def test_free_bodies_are_enclosed_as_they_answer_also_at_rest(sampling) -> None:
    """Of forms on boxes of ω: what 1/s² is behind hold and delay, times y² at 0 Hz."""
    from ccd_casadi.fixed_structure.boxes import axis_of

    period = None if sampling is None else sampling.period * 100.0
    delay = 0.0 if sampling is None else sampling.delay * 100.0
    edges = np.array([0.0, 1e-3, 0.02, 0.021, 0.04, 0.0401])
    kind = Chart.LOW if sampling is None else Chart.SAMPLED
    boxes = Boxes(np.full(5, kind), edges[None, :-1], edges[None, 1:])
    axis = [axis_of(boxes, period, delay, at_rest=at_rest) for at_rest in (True, False)]
    body = StateSpace(
        np.array([[0.0, 1.0], [0.0, 0.0]]), np.array([[0.0], [1.0]]), np.array([[1.0, 0.0]]),
        np.zeros((1, 1)),
    )  # fmt: skip

    def within(form: Affine, i: int, t: float, value: complex) -> bool:
        off = abs(form.centre[i] + form.slope[0, i] * t - value)
        return bool(off <= form.rest[i] + 1e-12 * abs(value))

    for i, (low, high) in enumerate(pairwise(edges)):
        for t in np.linspace(-0.999, 1.0, 7):
            f = 0.5 * (low + high) + 0.5 * t * (high - low)
            omega = f if period is None else f / period
            y = 1j * f if period is None else 2j / period * np.sin(0.5 * f)
            times = y**2 if i == 0 else 1.0
            free = -1.0 / omega**2
            held = free
            if period is not None:
                held = zoh(body, period, delay).at(np.exp(1j * np.array([f])))[0, 0, 0]
            own = axis[i > 0]
            assert within(own.free_body, i, t, times * held)
            assert within(own.free_body_unheld, i, t, times * free)


STRUCTURE = Structure(biquads=0, lead=2)
BOUNDS = Bounds(S_max=2.0, S_low=0.03, omega_low=HZ, shape=1.1)
LATE = Sampling(10_000.0, 50.0)


def payload(damping: float) -> UncertainPlant:
    """4 kg driven, 1 kg on a spring: resonance at 8.9 Hz, a light antiresonance at 8 Hz."""
    k = 2526.62
    K = k * np.array([[1.0, -1.0], [-1.0, 1.0]])
    none = tuple(np.zeros((0, *shape)) for shape in ((2, 2), (2, 2), (2, 2), (2, 1), (1, 2)))
    first = np.array([[1.0], [0.0]])
    from ccd_casadi.plants.plant import Mechanics

    system = Mechanics(np.diag([4.0, 1.0]), 0.0 * K, K, first, first.T, damping, none)  # type: ignore[arg-type]
    return UncertainPlant((system,), 8.9e6, resonance_shift=0.03, damping=(0.8, 1.5))


def sensitivity(damping: float, shift: float, factor: float, K: StateSpace, hz: Array) -> Array:
    """|S| by partial fractions in NumPy alone: rigid body and one mode, exact hold and delay."""
    T, tau = LATE.period, LATE.delay
    w = 2.0 * np.pi * hz
    z, h = np.exp(1j * w * T), T - tau
    G = (h**2 / 2 + (T**2 - h**2) / 2 / z + T * (h + tau / z) / (z - 1)) / (z - 1) / 5.0
    w0, zeta = np.sqrt(2526.62 * 1.25) * (1.0 + shift), damping * factor
    p = w0 * (-zeta + 1j * np.sqrt(1.0 - zeta**2))
    for x, y in ((p, p.conjugate()), (p.conjugate(), p)):
        late, early = np.expm1(x * h) / x, np.exp(x * h) * np.expm1(x * tau) / x
        G = G + 0.05 / (x - y) * (late + early / z) / (z - np.exp(x * T))
    v = 2j / T * np.tan(0.5 * w * T)
    return np.abs(1.0 / (1.0 + G * K.at(v)[:, 0, 0]))


@pytest.mark.parametrize(
    "damping", [1e-3, *(pytest.param(each, marks=pytest.mark.slow) for each in (2e-4, 5e-3))]
)
def test_a_light_antiresonance_is_not_damped_by_a_suspension(damping) -> None:
    """The bandwidth that is found holds on the free body, also by code of its own: with a
    suspension of 0.1 Hz |S| was 3 times its bound at 6 Hz."""
    box = payload(damping)
    design = synthesise_sections(
        box.plants(box.corners()), STRUCTURE, BOUNDS, sampling=LATE, starts=6, seed=0
    )
    assert design.certified, design.words
    assert design.controller is not None
    wb = design.bandwidth
    hz = np.unique(np.concatenate([np.geomspace(0.3, 4900.0, 3000), np.linspace(7.0, 9.0, 1500)]))
    for shift, factor in ((0.0, 1.0), (-0.03, 0.8), (0.03, 0.8), (0.03, 1.5)):
        S = sensitivity(damping, shift, factor, design.controller, hz)
        bound = np.minimum(BOUNDS.S_max, BOUNDS.shape * 2.0 * np.pi * hz / wb / np.sqrt(2.0))
        assert (S / bound).max() < 1.0 + 1e-4
        written = as_written(box.options[0], shift=shift, damping=factor)
        judged = certify([written], design.controller, BOUNDS, LATE).plants[0]
        assert judged.stable
        assert judged.S_peak == pytest.approx(S.max(), rel=2e-3)


def test_a_proof_is_of_free_bodies_and_the_judge_is_below_it() -> None:
    box = payload(0.02)
    design = synthesise_sections(
        box.plants(box.corners()), STRUCTURE, replace(BOUNDS, S_max=1.95), sampling=LATE,
        starts=4, seed=1,
    )  # fmt: skip
    assert design.certified
    assert design.kappa is not None
    proof = prove(box, STRUCTURE, design.kappa, 0.98 * design.bandwidth, BOUNDS, LATE, slack=0.05)
    assert proof.stable, proof.words
    rng = np.random.default_rng(2)
    plants = box.as_written([*box.corners(), *box.drawn(rng, 20)])
    worst = certify(plants, design.controller, BOUNDS, LATE).worst
    assert max(worst["S_max"], worst["S_low"]) <= max(proof.levels.values()) * (1.0 + 1e-9)


def test_boxes_at_rest_hold_what_loops_have_beside_zero() -> None:
    """The enclosures on the box that touches 0 Hz hold what NumPy finds there."""
    box = payload(0.01)
    unit = 1e4
    plant = modal_sum(box, 0, unit)
    assert plant is not None
    assert plant.rigid.any()
    kappa = np.log([2e5, 1.0 * HZ, 20.0 * HZ, 300.0 * HZ, 200.0 * HZ, 400.0 * HZ, 900.0 * HZ, 0.7])
    structure = Structure(biquads=0, lead=2)
    parts = tuple(structure.split(structure.in_units(kappa, 1.0 / unit, 1.0)))
    bounds = replace(BOUNDS, weighted_level=10.0, weights=WEIGHTS, compliance_max=1e-3)
    family = LoopFamily(plant, box.names, parts, np.eye(1), np.eye(1), bounds, 30.0 * HZ, unit,
                        LATE.period * unit, LATE.delay * unit)  # fmt: skip
    low, high = box.box
    top = LATE.period * HZ  # 1 Hz
    boxes = Boxes(np.array([Chart.SAMPLED]), np.array([[0.0], *low[:, None]]),
                  np.array([[1e-3 * top], *high[:, None]]))  # fmt: skip
    with np.errstate(all="ignore"):
        found = family.enclose(boxes)
    assert found.bounded.all(), "the loop is bounded beside 0 Hz"
    K = structure.state_space(kappa)
    hz = 1e-3 * np.linspace(0.01, 1.0, 20)
    for option, point in box.corners():
        S = sensitivity(0.01, point[0], point[1], K, hz)
        assert option == 0
        names = dict(zip(found.names, found.highest[:, 0], strict=True))
        assert S.max() / bounds.S_max <= names["S_MAX"]
        shape = bounds.shape * 2.0 * np.pi * hz / family.bandwidth / np.sqrt(2.0)
        assert (S / shape).max() <= names["SHAPE"]


@pytest.mark.parametrize("top", [1e-3, 1e-4])
@pytest.mark.parametrize(("share", "damping"), [(0.03, 0.5), (0.1, 1.0), (0.03, 2.0)])
def test_two_actuators_on_one_output_are_enclosed_beside_rest(top, share, damping) -> None:
    """One moves the free body, the other a compliant mode, and their loops nearly cancel: 0.06 was
    enclosed where |S| is 1.4, without the size of N in what the second gain moves."""
    k, w = 20.0 * top**3, 0.85 * top
    strength = 1.0 / share / w**2  # the loops of both are alike at w
    first = (Structure(True, lead=0, biquads=0, roll_off=0), np.log([k, 1.0]))
    second = (Structure(False, lead=0, biquads=0, roll_off=2),
              np.log([2.0 * damping * share * k / w, w, damping]))  # fmt: skip
    plant = ModalSum(
        np.array([0.0, 1.0]), np.array([True, False]), np.zeros(2), 0.01,
        np.diag([1.0, strength**0.5]), np.array([[1.0], [strength**0.5]]), np.zeros(2, bool),
    )  # fmt: skip
    bounds = Bounds(S_max=2.0, S_low=0.5, omega_low=top)
    family = LoopFamily(plant, (), (first, second), np.ones((1, 2)), np.eye(2), bounds, 0.1, 1.0,
                        None, 0.0)  # fmt: skip
    edges = np.linspace(0.7 * top, top, 31)
    s = 1j * np.linspace(0.7 * top, top, 3001)
    K1, K2 = (structure.response(kappa, s) for structure, kappa in (first, second))
    S = np.abs(1.0 / (1.0 + K1 / s**2 + K2 * strength / (s**2 + 0.02 * s + 1.0)))
    for low, high in [(0.7 * top, top), *pairwise(edges)]:
        box = Boxes(np.array([Chart.LOW]), np.array([[low]]), np.array([[high]]))
        with np.errstate(all="ignore"):
            found = family.enclose(box)
        here = (s.imag >= low) & (s.imag <= high)
        assert bounds.S_max * found.highest[found.names.index("S_MAX"), 0] >= S[here].max()
