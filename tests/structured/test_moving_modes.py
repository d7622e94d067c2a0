"""A plant that moves with its position: modes are enclosed on pieces, and bounds are proven."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from oracles.fixed_structure_loops import LATE, WEIGHTS
from oracles.helpers import HZ, SUSPENSION

from ccd_casadi.fixed_structure.affine import moving_modes, outputs, variable
from ccd_casadi.fixed_structure.bounds import Bounds
from ccd_casadi.fixed_structure.box_proof import ProofOutcome, prove
from ccd_casadi.fixed_structure.boxes import Boxes, Chart
from ccd_casadi.fixed_structure.certificate import certify
from ccd_casadi.fixed_structure.enclosure import LoopFamily
from ccd_casadi.fixed_structure.structure import Structure
from ccd_casadi.fixed_structure.uncertainty import UncertainPlant, modal_sum, unmoved_words
from ccd_casadi.fixed_structure.worst_plant import lattice
from ccd_casadi.lti.loop import tustin, zoh
from ccd_casadi.plants.modal import modal_plant
from ccd_casadi.plants.plant import Mechanics, build_plant, mechanics

STROKE = (-0.25, 0.3)
STRUCTURE = Structure(biquads=0)
KAPPA = np.log([2e5, 0.5 * HZ, 3.0 * HZ, 60.0 * HZ, 400.0 * HZ, 0.7])
BARE = Bounds(S_max=10.0, S_low=1.0, omega_low=0.5 * HZ)


def beam(theta, damping=0.01):
    """A rigid bar on two springs that hold its yaw, two bending shapes, a carriage of 4 kg at x."""
    x = theta["x"]
    shape = ca.vertcat(1.0, 2.0 * x, ca.cos(6.0 * x) - 0.5, ca.sin(5.0 * x) * ca.exp(0.3 * x))
    return {
        "mass": ca.diag(ca.DM([20.0, 5.0, 6.0, 4.0])) + 4.0 * shape @ shape.T,
        "stiffness": ca.diag(ca.vertcat(0.0, 1.2e7, 5e7 / (1.0 + x**2), 2e8 + 1e8 * x**4)),
        "damping_ratio": damping,
        "input": ca.DM([1.0, 0.1, 0.5, 0.2]),
        "output": shape.T,
        "hardware_cost": 1.0,
    }


PLANT = build_plant(beam, ["x"], {})
GRAPH = ca.Function("graph", [X := ca.SX.sym("x")], PLANT.evaluate.matrices.call([X])[:5])
BOX = UncertainPlant(
    (mechanics(PLANT, (0.1,)),), WEIGHTS.M_K, resonance_shift=0.02,
    ranges=(("x", STROKE[0], 0.1, STROKE[1]),),
    along=lambda option, x: mechanics(PLANT, x.tolist()), graph=lambda option: GRAPH,
)  # fmt: skip


def pieces(rng: np.random.Generator, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Ends (1, N) of pieces of the stroke, of widths from a fiftieth of it down to 1e-6."""
    half = 0.5 * (STROKE[1] - STROKE[0]) * 10.0 ** rng.uniform(-6.0, -1.7, count)
    middle = rng.uniform(STROKE[0] + half, STROKE[1] - half)
    return (middle - half)[None], (middle + half)[None]


def test_modes_are_within_their_enclosures() -> None:
    """1,000 plants; and what the enclosures add falls with the square of a piece's width."""
    rng, count = np.random.default_rng(1), 1000
    low, high = pieces(rng, count)
    found, known = moving_modes(GRAPH, 1, 1.0, low, high)
    assert known.all()
    t = np.where(rng.random(count) < 0.5, rng.uniform(-1, 1, count), rng.choice([-1, 1], count))
    at = 0.5 * (low + high) + 0.5 * (high - low) * t
    plants = [modal_plant(mechanics(PLANT, x), SUSPENSION) for x in at.T.tolist()]
    for i, forms in enumerate(found):
        omega = np.array([plant.natural[i] for plant in plants])
        strength = np.array([plant.B[i, 0] * plant.C[0, i] for plant in plants])
        for form, value in zip(forms[i == 0 :], (omega, strength)[i == 0 :], strict=True):
            assert (np.abs(value - form.centre - form.slope[0] * t) <= form.rest).all()
            width = (high - low)[0]
            assert (form.rest <= np.abs(form.centre).max() * (1e-11 + 2e3 * width**2)).all()


def test_where_modes_meet_nothing_is_enclosed() -> None:
    x = ca.SX.sym("x")
    given = [np.eye(2), np.zeros((2, 2)), ca.diag(ca.vertcat(1e6 * (1.0 + x), 1e6)),
             np.ones((2, 1)), np.ones((1, 2))]  # fmt: skip
    graph = ca.Function("crossing", [x], [ca.densify(ca.SX(one)) for one in given])
    low = np.array([[-0.001, 0.1]])
    assert moving_modes(graph, 0, 1.0, low, low + 0.002)[1].tolist() == [False, True]


def test_expressions_are_within_their_enclosures() -> None:
    x, y = ca.SX.sym("x"), ca.SX.sym("y")
    entries = [x / y, ca.sqrt(y) * ca.exp(-x), ca.sin(x * y) - ca.cos(x), x**3 / (2.0 + x), 1.0 - x]
    graph = ca.Function("graph", [ca.vertcat(x, y)], [ca.horzcat(*entries)])
    rng, count = np.random.default_rng(2), 200
    half = 10.0 ** rng.uniform(-8.0, -1.0, (2, count))
    middle = np.array([[0.3], [1.1]]) + 0.2 * rng.random((2, count))
    sides = zip(middle, half, strict=True)
    forms = outputs(graph, [variable(a - r, a + r, k, 2) for k, (a, r) in enumerate(sides)])[0]
    t = rng.choice([-1.0, -0.3, 1.0], (2, count))
    for n in range(count):
        value = np.array(graph(middle[:, n] + half[:, n] * t[:, n]))[0]
        off = value - forms.centre[n, 0] - t[:, n] @ forms.slope[:, n, 0]
        assert (np.abs(off) <= forms.rest[n, 0]).all()
        assert (forms.rest[n, 0] <= 1e-13 + 20.0 * half[:, n].sum() ** 2).all()
    kinked = ca.Function("kinked", [x], [ca.fabs(x)])
    assert np.isnan(outputs(kinked, [variable(np.zeros(1), np.ones(1), 0, 1)])[0].centre).all()


@pytest.mark.parametrize("sampling", [None, LATE], ids=["continuous", "late"])
def test_enclosures_hold_the_loop_at_every_position(sampling) -> None:
    """|S| at random positions, resonances and frequencies of random boxes."""
    rng, count, unit = np.random.default_rng(5), 200, 4000.0
    plant = modal_sum(BOX, 0, unit)
    assert plant is not None
    parts = ((STRUCTURE, STRUCTURE.in_units(KAPPA, 1.0 / unit, 1.0)),)
    period, delay = (sampling.period * unit, sampling.delay * unit) if sampling else (None, 0.0)
    one = np.eye(1)
    family = LoopFamily(plant, BOX.names, parts, one, one, BARE, 1.0, unit, period, delay)
    x = np.vstack(pieces(rng, count))
    omega = np.exp(rng.uniform(*np.log([3.0 * HZ, 400.0 * HZ]), count))
    shift = rng.uniform(-0.019, 0.019, count)
    wide = 10.0 ** rng.uniform(-6.0, -3.0, (2, count))
    low = np.vstack([omega * (1.0 - wide[0]), shift - wide[1], x[0]])
    high = np.vstack([omega * (1.0 + wide[0]), shift + wide[1], x[1]])
    scale = np.array([[(period or 1.0) / unit], [1.0], [1.0]])
    chart = np.full(count, Chart.LOW if sampling is None else Chart.SAMPLED)
    with np.errstate(all="ignore"):
        found = family.enclose(Boxes(chart, low * scale, high * scale))
    assert found.bounded.mean() > 0.8
    K = STRUCTURE.state_space(KAPPA)
    highest, lowest = (part[found.names.index("S_MAX")] for part in (found.highest, found.lowest))
    for n in range(count):
        w, *point = low[:, n] + rng.choice([0.0, 0.4, 1.0], 3) * (high - low)[:, n]
        G, own, at = BOX.plant(np.array(point)).plant_si(), K, np.array([w])
        if sampling is not None:
            G, own = zoh(G, sampling.period, sampling.delay), tustin(K, sampling.period)
            at = np.exp(1j * at * sampling.period)
            L = (G.C @ np.linalg.solve(at[0] * np.eye(len(G.A)) - G.A, G.B)) * (
                own.C @ np.linalg.solve(at[0] * np.eye(len(own.A)) - own.A, own.B) + own.D
            )
        else:
            L = G.response(at)[0] * own.response(at)[0]
        value = abs(1.0 / (1.0 + L[0, 0])) / BARE.S_max
        assert lowest[n] * (1.0 - 1e-9) <= value <= highest[n] * (1.0 + 1e-9)


def peak(points: list) -> float:
    found = certify(BOX.plants(points), STRUCTURE.state_space(KAPPA), BARE, LATE).plants
    return max(one.S_peak if one.stable else np.inf for one in found)


def test_a_bound_is_proven_for_the_whole_stroke_and_one_that_some_position_exceeds_refuted() -> (
    None
):
    ends = np.linspace(*STROKE, 25)
    seen = peak([(0, np.array([shift, x])) for x in ends for shift in (-0.02, 0.0, 0.02)])
    assert np.isfinite(seen)
    assert seen > 1.02 * peak([(0, BOX.nominal)])  # the middle says less
    proof = prove(BOX, STRUCTURE, KAPPA, 1.0, replace(BARE, S_max=1.01 * seen), LATE)
    assert proof.proven, proof.words
    refuted = prove(BOX, STRUCTURE, KAPPA, 1.0, replace(BARE, S_max=0.99 * seen), LATE)
    assert refuted.outcome is ProofOutcome.REFUTED
    own = peak([(0, np.array(refuted.point))])
    assert own >= refuted.exceeded[1] * 0.99 * seen * (1.0 - 1e-9)


def test_what_is_not_enclosed_is_named() -> None:
    """No expressions, an operation that is not enclosed, two sensors, a matrix of damping."""
    x, (M, D, K, b, c) = X, PLANT.evaluate.matrices.call([X])[:5]
    kinked = ca.Function("kinked", [x], [M, D, K, b, ca.fabs(x) * c])
    two = replace(BOX.options[0], C=np.vstack([BOX.options[0].C] * 2))
    matrix = replace(BOX.options[0], damping_ratio=None, D=1e-5 * BOX.options[0].K)
    for box in (
        replace(BOX, graph=lambda option: None),
        replace(BOX, graph=lambda option: kinked),
        replace(BOX, options=(matrix,)),
    ):
        proof = prove(box, STRUCTURE, KAPPA, 1.0, BARE, LATE)
        assert proof.outcome is ProofOutcome.VARIES
        assert proof.words.endswith(f"so its range was searched: {unmoved_words(box)}")
    assert prove(replace(BOX, options=(two,)), STRUCTURE, KAPPA, 1.0, BARE, LATE).outcome in (
        ProofOutcome.VARIES, ProofOutcome.NOT_SQUARE,
    )  # fmt: skip


@pytest.mark.parametrize("count", [3, 6, 7, 11, 15, 16])
def test_corners_of_many_parameters_are_few_and_each_pair_meets_at_all_its_ends(count: int) -> None:
    """Up to six parameters have every corner. The lines of a lattice stay as many as required."""
    ranges = tuple((f"x{i}", 1.0 + i, 2.0 + i, 3.0 + i) for i in range(count))
    none = tuple(np.zeros((0, *shape)) for shape in ((1, 1), (1, 1), (1, 1), (1, 1), (1, 1)))
    one = np.ones((1, 1))
    body = Mechanics(one, 0.01 * one, one, one, one, None, none)
    box = UncertainPlant((body,), 1e5, ranges=ranges)
    corners = np.array([point for _, point in box.corners()[1:]])
    low, high = box.box
    assert len(corners) == (2**count if count <= 6 else 2 << count.bit_length())
    assert ((corners == low) | (corners == high)).all()
    ends = corners == high
    for i in range(count):
        for j in range(i):
            met, times = np.unique(ends[:, [i, j]], axis=0, return_counts=True)
            assert len(met) == 4
            assert len(set(times.tolist())) == 1
    assert len(lattice(box, 10, 0, on_lines=2000)) <= 1 + len(corners) + 10 + max(2000, count * 61)
