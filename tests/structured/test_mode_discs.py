"""The proof for several channels and many modes: discs hold, and what fails is not proven."""

from dataclasses import replace

import numpy as np
import pytest
from oracles.fixed_structure_loops import BOUNDS, LATE, WEIGHTS
from oracles.helpers import HZ

from ccd_casadi.fixed_structure.affine import Affine
from ccd_casadi.fixed_structure.bounds import Bounds
from ccd_casadi.fixed_structure.box_proof import ProofOutcome, prove
from ccd_casadi.fixed_structure.boxes import Boxes, Chart
from ccd_casadi.fixed_structure.certificate import certify
from ccd_casadi.fixed_structure.certificate_responses import LoopResponses
from ccd_casadi.fixed_structure.channel_structure import ChannelStructure, given_decoupling
from ccd_casadi.fixed_structure.discs import RankOneDiscs, quotient
from ccd_casadi.fixed_structure.enclosure import LoopFamily
from ccd_casadi.fixed_structure.structure import Structure
from ccd_casadi.fixed_structure.uncertainty import UncertainPlant, modal_sum
from ccd_casadi.lti.loop import Sampling, tustin, zoh
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.lti.wiring import ForcedPlant
from ccd_casadi.plants.plant import Mechanics
from ccd_casadi.support.arrays import Array

# two carts of two masses, a weak spring and unlike places of drive and reading between them
STIFFNESS = 7e7 * np.array(
    [
        [1.0, -1.0, 0.0, 0.0],
        [-1.0, 1.0005, 0.0, -0.0005],
        [0.0, 0.0, 0.8, -0.8],
        [0.0, -0.0005, -0.8, 0.8005],
    ]
)
NONE = [np.zeros((0, *shape)) for shape in ((4, 4), (4, 4), (4, 4), (4, 2), (2, 4))]
DRIVE = np.array([[1.0, 0.0], [0.1, 0.0], [0.0, 1.0], [0.0, 0.1]])
READING = np.array([[1.0, 0.0, 0.1, 0.0], [0.0, 0.0, 1.0, 0.05]])
CARTS = Mechanics(
    55.0 * np.eye(4), np.zeros((4, 4)), STIFFNESS, DRIVE, READING, 0.01, tuple(NONE)
)  # fmt: skip
# both carts free, coupled by a little mass: of one free body the other direction is far softer
UNTIED = np.array([[1.0, -1.0, 0.0, 0.0], [-1.0, 1.0, 0.0, 0.0],
                   [0.0, 0.0, 0.8, -0.8], [0.0, 0.0, -0.8, 0.8]])  # fmt: skip
MASS = 55.0 * np.eye(4)
MASS[1, 3] = MASS[3, 1] = 0.05
BOTH_FREE = replace(CARTS, M=MASS, K=7e7 * UNTIED)
BOX = UncertainPlant(
    (CARTS,), WEIGHTS.M_K, mode_shift=0.02, damping=(0.5, 2.0), gain=0.02
)
ONE = Structure(biquads=1)
BOTH = ChannelStructure(
    given_decoupling(("a", "b"), np.eye(2).tolist(), np.eye(2).tolist()), (ONE, ONE)
)
KAPPA = np.tile(np.log(
    [1e5, 0.5 * HZ, 3.0 * HZ, 60.0 * HZ, 250.0 * HZ, 0.3, 250.0 * HZ, 0.8, 300.0 * HZ, 0.7]
), 2)  # fmt: skip
ANGLES = np.linspace(0.0, 2.0 * np.pi, 400)
BARE = Bounds(S_max=10.0, S_low=1.0, omega_low=0.5 * HZ)


def peak(points: list, sampling: Sampling | None, kappa: np.ndarray = KAPPA) -> float:
    """The judge's largest |S| of these plants; infinite where one is unstable."""
    found = certify(BOX.plants(points), BOTH.state_space(kappa), BARE, sampling).plants
    return max(one.S_peak if one.stable else np.inf for one in found)


def drawn(count: int) -> list:
    """Random points of the box, half of them with every parameter at an end."""
    rng = np.random.default_rng(3)
    share = rng.random((count, len(BOX.names)))
    share[::2] = np.round(share[::2])
    return [(0, point) for point in BOX.box[0] + share * (BOX.box[1] - BOX.box[0])]


@pytest.mark.parametrize("sampling", [None, LATE], ids=["continuous", "late"])
def test_what_random_plants_show_is_below_what_is_proven_and_close(sampling) -> None:
    seen = peak(drawn(40), sampling)
    proof = prove(BOX, BOTH, KAPPA, 1.0, replace(BARE, S_max=seen), sampling)
    assert len(proof.parameters) > 4
    assert proof.proven, proof.words
    assert 1.0 <= proof.levels["S_MAX"] <= 1.05


def test_a_bound_that_a_plant_exceeds_is_refuted_at_such_a_plant() -> None:
    bounds = replace(BARE, S_max=0.98 * peak(drawn(1), LATE))
    proof = prove(BOX, BOTH, KAPPA, 1.0, bounds, LATE, slack=1e-3)
    assert proof.outcome is ProofOutcome.REFUTED
    assert proof.exceeded[0] == "S_MAX"
    own = peak([(0, np.array(proof.point))], LATE)
    assert own >= proof.exceeded[1] * bounds.S_max * (1.0 - 1e-9)


def test_an_unstable_plant_of_the_box_is_never_proven() -> None:
    """With a gain at which the model is stable and a plant of the box is not: no bound helps."""
    for factor in np.geomspace(2.0, 100.0, 20):
        hot = KAPPA + np.log(factor) * (np.arange(len(KAPPA)) % len(ONE.names) == 0)
        stable = [np.isfinite(peak([one], LATE, hot)) for one in ((0, BOX.nominal), *drawn(10))]
        if not all(stable):
            break
    assert stable[0]
    proof = prove(BOX, BOTH, hot, 0.1, replace(BARE, S_max=1e3), LATE, most_boxes=8_000)
    assert not proof.stable


def random_boxes(
    sampling: Sampling | None, integrator: bool, count: int, rng: np.random.Generator
) -> tuple[LoopFamily, Boxes, Array, StateSpace]:
    """Loops, boxes of any size, their ends (2, 1 + n_p, N) in rad/s and SI, and the controller."""
    unit, own = 4000.0, replace(ONE, integrator=integrator)
    part = KAPPA[: len(ONE.names)] if integrator else np.delete(KAPPA[: len(ONE.names)], 1)
    structure = replace(BOTH, structures=(own, own))
    kappa = np.tile(part, 2)
    K = structure.state_space(kappa)
    plant = modal_sum(BOX, 0, unit)
    assert plant is not None
    parts = tuple(structure.split(structure.in_units(kappa, 1.0 / unit, 1.0)))
    period, delay = (sampling.period * unit, sampling.delay * unit) if sampling else (None, 0.0)
    bounds = replace(BOUNDS, shape=None)
    family = LoopFamily(plant, BOX.names, parts, np.eye(2), np.eye(2), bounds, 1.0, unit, period,
                        delay)  # fmt: skip
    middle = np.vstack([np.exp(rng.uniform(*np.log([1.0, 2500.0]), count)),
                        BOX.box[0][:, None] + rng.random((len(BOX.names), count))
                        * (BOX.box[1] - BOX.box[0])[:, None]])  # fmt: skip
    wide = np.concatenate([[1.0], BOX.box[1] - BOX.box[0]])[:, None]
    half = 0.5 * wide * 10.0 ** rng.uniform(-6.0, 0.0, (len(wide), count))
    half[0] = middle[0] * 10.0 ** rng.uniform(-6.0, -2.0, count)
    low, high = middle - half, middle + half
    low[1:] = np.maximum(low[1:], BOX.box[0][:, None])
    high[1:] = np.minimum(high[1:], BOX.box[1][:, None])
    scale = np.ones((len(low), 1))
    scale[0] = (period or 1.0) / unit
    chart = np.full(count, Chart.LOW if sampling is None else Chart.SAMPLED)
    return family, Boxes(chart, low * scale, high * scale), np.array([low, high]), K


@pytest.mark.parametrize("sampling", [None, LATE], ids=["continuous", "late"])
@pytest.mark.parametrize("integrator", [True, False])
def test_discs_hold_over_boxes_of_any_size(sampling, integrator) -> None:
    """|S| at random points of random boxes lies between what is said of the box."""
    rng, count = np.random.default_rng(5), 60
    family, boxes, (low, high), K = random_boxes(sampling, integrator, count, rng)
    bounds = family.bounds
    found = family.enclose(boxes)
    assert found.bounded.mean() > 0.5
    assert bounds.weighted_level is not None
    assert bounds.compliance_max is not None
    limits = {
        "S_MAX": ("S", bounds.S_max),
        "KS": ("weighted KS", bounds.weighted_level),
        "T": ("weighted T", bounds.weighted_level),
        "GS": ("GS", bounds.compliance_max),
    }
    for i in range(count):
        for _ in range(3):
            share = rng.random(len(low)) if rng.random() < 0.5 else rng.integers(0, 2, len(low))
            at = low[:, i] + share * (high[:, i] - low[:, i])
            free = BOX.plant(at[1:]).plant_si()
            G, own = free, K
            if sampling is not None:
                G, own = zoh(free, sampling.period, sampling.delay), tustin(K, sampling.period)
            assert isinstance(free, ForcedPlant)
            table = LoopResponses([free.mechanics], [G], own, sampling, bounds)
            table = table.at(np.array([0]), at[None, :1])
            for name, (figure, limit) in limits.items():
                k, value = found.names.index(name), table[figure][0, 0] / limit
                assert found.lowest[k, i] * (1.0 - 1e-9) <= value
                assert value <= found.highest[k, i] * (1.0 + 1e-9)
    wide = np.concatenate([[1.0], BOX.box[1] - BOX.box[0]])[:, None]
    small = (0.5 * (high - low) / wide).max(axis=0) < 1e-3
    for name in limits:
        k = found.names.index(name)
        spread = found.highest[k] / np.maximum(found.lowest[k], 1e-9)
        assert not small.any() or np.median(spread[small]) < 1.5


@pytest.mark.parametrize("sampling", [None, LATE], ids=["continuous", "late"])
@pytest.mark.parametrize("integrator", [True, False])
def test_every_numbered_inequality_holds_for_loops_in_the_discs(sampling, integrator) -> None:
    """(2) to (19) of `LoopFamily.enclose`, whatever enters them drawn to its limit; those of one
    quantity are nearly reached."""
    rng = np.random.default_rng(11)
    family, boxes, *_ = random_boxes(sampling, integrator, 60, rng)
    loop = family._loop_discs(boxes)
    kept = np.flatnonzero(loop.good)
    assert len(kept) > 30

    def size(M: np.ndarray) -> Array:
        return np.linalg.norm(M, 2, axis=(1, 2))

    def drawn_to(radius: Array, rows: int, columns: int) -> np.ndarray:
        M = rng.normal(size=(2, len(kept), rows, columns))
        M = M[0] + 1j * M[1]
        return M * (radius[kept] / size(M))[:, None, None]

    def on_edges(middle: np.ndarray, radius: Array) -> np.ndarray:
        turns = np.exp(2j * np.pi * rng.random(radius[kept].shape))
        return middle[kept] + radius[kept] * turns

    (p, m), K, eye = (loop.c.shape[1], loop.b.shape[1]), loop.K[kept], np.eye(loop.c.shape[1])
    figures = {"S": loop.S(), "T": loop.T(), "KS": loop.KS(), "GS": loop.GS()}
    closest: dict[str, Array] = {}
    for _ in range(30):
        g = on_edges(loop.m, loop.r)
        M_d = loop.y[kept, None, None] * eye + (loop.c.T * g[:, None]) @ (loop.b @ K)
        G = (loop.c.T * on_edges(loop.g, loop.e)[:, None]) @ loop.b
        delta_y = on_edges(0.0 * loop.y, loop.delta_y)[:, None, None]
        y = loop.y[kept, None, None] + delta_y
        M_1 = M_d + delta_y * eye + drawn_to(loop.delta_GK, p, p)
        W_d, W_1 = np.linalg.inv(M_d), np.linalg.inv(M_1)
        S_d, S_1 = loop.y[kept, None, None] * W_d, y * W_1
        T_1E = (eye - S_1) @ drawn_to(loop.epsilon, p, p)
        W_2 = np.linalg.inv(M_1 @ (eye + T_1E))
        K_2 = K + drawn_to(loop.epsilon, m, m) @ K + drawn_to(loop.grain, m, p)
        bounded = {
            "a": W_d, "a1": W_1, "t": eye - S_d, "u1": S_1 - S_d, "q": T_1E, "a2": W_2,
            "u2": y * W_2 - S_d,
        }  # fmt: skip
        lost = 1e-14 * size(M_1) * size(W_1) * (1.0 + size(S_1))  # in the differences of S here
        for name, M in bounded.items():
            bound = getattr(loop, name)[kept]
            assert (size(M) <= bound * (1.0 + 1e-9) + lost).all(), name
            closest[name] = np.maximum(closest.get(name, 0.0), size(M) / bound)
        assert (size(W_d - loop.W[kept]) <= (loop.a * loop.d)[kept] * (1.0 + 1e-9)).all()
        at = {"S": y * W_2, "T": eye - y * W_2, "KS": K_2 @ W_2, "GS": y * (W_2 @ G)}
        for name, M in at.items():
            upper, lower, *_ = (part[kept] for part in figures[name])
            assert (lower <= size(M) * (1.0 + 1e-9)).all(), name
            assert (size(M) <= upper * (1.0 + 1e-9)).all(), name
    for name in ("a", "a1", "t", "q", "a2"):
        assert np.median(closest[name]) > 0.95, name  # 0.992 at least


def test_a_disc_holds_a_quotient_even_where_its_denominator_may_be_nought() -> None:
    rng, count = np.random.default_rng(7), 400
    wild = rng.normal(size=(3, count)) + 1j * rng.normal(size=(3, count))
    D = Affine(
        0.02 + 0.01j * rng.normal(size=count),
        0.01 * (rng.normal(size=(3, count)) * 1j),
        np.zeros(count),
    )
    N = Affine(1.0 + 0.1j * np.ones(count), 0.05 * wild, np.zeros(count))
    centre, radius, _ = quotient(N, D)
    assert np.isfinite(radius).all()
    for _ in range(200):
        t = (
            np.sign(rng.normal(size=(3, count)))
            if rng.random() < 0.5
            else rng.uniform(-1, 1, (3, count))
        )
        value = (N.centre + (N.slope * t).sum(0)) / (D.centre + (D.slope * t).sum(0))
        assert (np.abs(value - centre) <= radius * (1.0 + 1e-9)).all()


@pytest.mark.parametrize("sampling", [None, LATE], ids=["continuous", "late"])
def test_two_actuators_on_one_sensor_are_proven_together(sampling) -> None:
    """One output, a channel for each actuator, an integrator in one of them."""
    slopes = (*CARTS.derivatives[:4], np.zeros((0, 1, 4)))
    one = replace(CARTS, C=READING[:1], derivatives=slopes)
    box = UncertainPlant((one,), WEIGHTS.M_K, resonance_shift=0.02, gain=0.02)
    fast = replace(ONE, integrator=False)
    both = ChannelStructure(given_decoupling(("a", "b"), [[1], [1]], [[1, 0], [0, 1]]), (ONE, fast))
    slow = KAPPA[: len(ONE.names)]
    kappa = np.concatenate([slow, np.delete(slow, 1)])
    kappa[len(ONE.names)] += np.log(0.1)
    rng = np.random.default_rng(4)
    points = [(0, box.box[0] + rng.random(2) * (box.box[1] - box.box[0])) for _ in range(20)]
    found = certify(box.plants(points), both.state_space(kappa), BARE, sampling).plants
    seen = max(one.S_peak for one in found)
    assert all(one.stable for one in found)
    proof = prove(box, both, kappa, 1.0, replace(BARE, S_max=seen), sampling)
    assert proof.proven, proof.words
    assert 1.0 <= proof.levels["S_MAX"] <= 1.05
    refuted = prove(box, both, kappa, 1.0, replace(BARE, S_max=0.9 * seen), sampling, slack=1e-3)
    assert refuted.outcome is ProofOutcome.REFUTED


def wild(rng: np.random.Generator, *shape: int) -> np.ndarray:
    return np.asarray(rng.normal(size=shape) + 1j * rng.normal(size=shape))


def moved(
    terms: RankOneDiscs, delta: np.ndarray, A: np.ndarray, B: np.ndarray, Z: np.ndarray
) -> np.ndarray:
    """e of f where every w_i is δ_i times what it sees: (1 + Σ δ_i c_i q_iᵀ)u = ..."""
    delta = terms.radius * delta
    driven = np.einsum("Ni,ip,Niq->Npq", delta, terms.columns, terms.rows)
    beside = np.einsum("Ni,ip,iq->Npq", delta, terms.columns, terms.inputs)
    return A - B @ np.linalg.solve(np.eye(driven.shape[1]) + driven, driven @ Z + beside)


@pytest.mark.parametrize("p", [1, 2, 3])
def test_the_largest_norm_holds_for_all_discs_and_of_one_is_reached(p) -> None:
    rng, count, n = np.random.default_rng(11), 30, 6
    A, B, Z = (wild(rng, count, *shape) for shape in ((3, 2), (3, p), (p, 2)))
    columns, rows, inputs = rng.normal(size=(n, p)), wild(rng, count, n, p), rng.normal(size=(n, 2))
    rows[:, n // 2 :], inputs[: n // 2] = 0.0, 0.0
    size = np.linalg.norm(columns, axis=1) * np.linalg.norm(rows, axis=2)
    radius = 0.6 * rng.dirichlet(np.ones(n), count) / np.where(size > 0.0, size, 1.0)
    terms = RankOneDiscs(columns, rows, radius, inputs)
    most = terms.largest(A, B, Z)
    assert np.isfinite(most).all()
    for _ in range(300):
        e = moved(terms, np.exp(2j * np.pi * rng.random((count, n))), A, B, Z)
        assert (np.linalg.norm(e, 2, axis=(1, 2)) <= most).all()
    # one disc alone, far from small: what is said is what a point of its edge shows
    one = RankOneDiscs(columns[:1], rows[:, :1], 0.9 / size[:, :1], inputs[:1])
    seen = np.max([np.linalg.norm(moved(one, turn, A, B, Z), 2, axis=(1, 2))
                   for turn in np.exp(1j * ANGLES)], axis=0)  # fmt: skip
    most = one.largest(A, B, Z)
    assert (seen <= most * (1.0 + 1e-12)).all()
    assert np.median(most / seen) < 1.1  # 1.04 of two and three


def test_where_a_disc_makes_the_loop_singular_no_norm_is_found() -> None:
    for n in (1, 2):
        eye, radii = np.tile(np.eye(n), (3, 1, 1)), np.array([[0.99], [1.0], [1.01]])
        found = RankOneDiscs(np.eye(n), -eye, np.tile(radii, n)).largest(eye, eye, eye)
        assert 100.0 * (1.0 - 1e-9) <= found[0] <= 115.0  # 112.8 of two, which are not one disc
        assert np.isinf(found[1:]).all()


def test_channels_that_are_apart_count_apart() -> None:
    A, one = np.diag([2.0, 1.0])[None] + 0j, np.eye(2)[None]
    terms = RankOneDiscs(np.eye(2), 0.0 * one, np.array([[0.3, 0.9]]), np.eye(2))
    assert terms.largest(A, one, one) == pytest.approx([2.3], rel=1e-2)


def test_every_figure_of_several_channels_is_proven_where_the_boxes_suffice() -> None:
    box = replace(BOX, options=(BOTH_FREE,), mode_shift=0.0, damping=(1.0, 1.0), gain=0.01)
    judged = certify(box.plants(box.corners()), BOTH.state_space(KAPPA), BOUNDS, LATE).worst
    assert BOUNDS.weighted_level is not None
    assert BOUNDS.compliance_max is not None
    bounds = replace(
        BARE,
        S_max=BOUNDS.S_max * judged["S_max"],
        weighted_level=BOUNDS.weighted_level * max(judged["KS"], judged["T"]),
        weights=WEIGHTS,
        compliance_max=BOUNDS.compliance_max * judged["GS"],
    )
    proof = prove(box, BOTH, KAPPA, 1.0, bounds, LATE)
    assert proof.proven
    assert {"S_MAX", "KS", "T", "GS"} <= set(proof.levels)
    few = prove(box, BOTH, KAPPA, 1.0, bounds, LATE, most_boxes=proof.boxes // 3)
    assert few.stable
    assert not few.proven
    assert max(few.levels.values()) > 1.05
    assert all(proof.levels[name] <= level for name, level in few.levels.items())
    tight = replace(bounds, compliance_max=0.9 * bounds.compliance_max)
    refuted = prove(box, BOTH, KAPPA, 1.0, tight, LATE, slack=1e-3)
    assert refuted.outcome is ProofOutcome.REFUTED
    assert refuted.exceeded[0] == "GS"
