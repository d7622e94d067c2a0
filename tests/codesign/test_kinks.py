"""Co-designs whose optimum lies on a kink of J: found, certified there, refused elsewhere."""

from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any, cast

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from oracles.helpers import few, problem

from ccd_casadi.codesign.optimality import joint_residual, theta_kkt
from ccd_casadi.codesign.reasons import Reason
from ccd_casadi.codesign.verdict import State, optimal
from ccd_casadi.codesign.verified_structured import VerifiedStructured
from ccd_casadi.fixed_structure.local_search import Envelope
from ccd_casadi.fixed_structure.structure import Structure
from ccd_casadi.inner_problem.problem import CoDesignProblem
from ccd_casadi.inner_problem.structured_problem import StructuredProblem
from ccd_casadi.optim.kkt import KktCertificate
from ccd_casadi.optim.pieces import Local, descend
from ccd_casadi.sampling.inner_samples import InnerSample
from ccd_casadi.sampling.sampler import Sampler

J0 = -700.0
SEEDS = st.integers(0, 2**32 - 1)


@dataclass(frozen=True)
class Pieces:
    """The largest of J0 + g_iᵀ(z - z*) + ½(z - z*)ᵀQ_i(z - z*), and λ = A (z - z*) <= 0.

    Some Σ μ_i g_i + Aᵀν vanishes with μ, ν >= 0 and Σ μ_i = 1: z* is the minimiser of convex ones.
    """

    minimiser: np.ndarray
    slopes: np.ndarray
    curvature: np.ndarray
    A: np.ndarray

    def at(self, z: np.ndarray) -> Local:
        d = z - self.minimiser
        bending = self.curvature @ d
        value = J0 + self.slopes @ d + 0.5 * bending @ d
        i = int(np.argmax(value))
        return Local(z, float(value[i]), self.slopes[i] + bending[i])

    def constraints(self, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return self.A @ (z - self.minimiser), self.A

    def allowed(self, z: np.ndarray) -> np.ndarray:
        """The nearest point with λ <= 0, of one constraint."""
        if len(self.A) and self.A[0] @ (z - self.minimiser) > 0.0:
            a = self.A[0]
            return z - a * (a @ (z - self.minimiser) + 1e-9) / (a @ a)
        return z


def pieces(rng: np.random.Generator, n: int, count: int, bound: bool, bending: float) -> Pieces:
    g = rng.normal(size=(count, n))
    A = rng.normal(size=(int(bound), n))
    mu = rng.dirichlet(np.full(count, 3.0))
    g -= mu @ g + rng.uniform(0.5, 1.0, int(bound)) @ A
    roots = rng.normal(size=(count, n, n))
    Q = bending * rng.uniform(0.3, 3.0, (count, 1, 1)) * roots @ roots.transpose(0, 2, 1)
    return Pieces(rng.uniform(0.2, 0.8, n), g, Q, A)


@few(max_examples=40)
@given(SEEDS, st.integers(1, 4), st.integers(1, 4), st.booleans())
def test_pieces_lead_to_the_minimiser(seed: int, n: int, count: int, bound: bool) -> None:
    rng = np.random.default_rng(seed)
    of = pieces(rng, n, count, bound, 1.0)
    met = []

    def at(z: np.ndarray) -> Local:
        assert (of.constraints(z)[0] <= 0.0).all()
        met.append(of.at(z))
        return met[-1]

    start = at(of.allowed(np.clip(of.minimiser + rng.normal(size=n) * 3e-3, 0.0, 1.0)))
    end = descend(at, start, lambda: met, of.constraints, steps=30 * n, settled=1e-10)
    assert end.value - J0 <= 1e-7 * abs(J0)  # 6.7e-9 at most on 1500 draws
    assert end.value <= start.value


@few(max_examples=20)
@given(SEEDS, st.integers(1, 3))
def test_pieces_that_are_not_convex_lead_to_a_sharp_minimiser(seed: int, n: int) -> None:
    """n + 1 pieces whose slopes surround 0 by a margin: z* is a local minimiser whatever Q is."""
    rng = np.random.default_rng(seed)
    corners = np.vstack([np.eye(n), -np.ones(n)]) * rng.uniform(0.5, 2.0, (n + 1, 1))
    Q = rng.uniform(-2.0, 2.0, (n + 1, n, n))
    of = Pieces(np.full(n, 0.4), corners, Q + Q.transpose(0, 2, 1), np.zeros((0, n)))
    met = [of.at(of.minimiser + rng.uniform(-0.02, 0.02, n))]

    def at(z: np.ndarray) -> Local:
        met.append(of.at(z))
        return met[-1]

    end = descend(at, met[0], lambda: met, of.constraints, steps=30 * n, settled=1e-10)
    assert abs(end.value - J0) <= 1e-7 * abs(J0)  # 9.7e-9 at most on 1500 draws


@few(max_examples=20)
@given(SEEDS, st.floats(0.05, 0.3))
def test_a_step_too_far_along_a_smooth_piece_shows_its_curvature(seed: int, share: float) -> None:
    """The tangents at both ends of a bracket meet in its middle: that alone would only halve it."""
    rng = np.random.default_rng(seed)
    bend, cubic = rng.uniform(5.0, 50.0), rng.uniform(-3.0, 3.0)
    met: list[Local] = []

    def at(z: np.ndarray) -> Local:
        d = float(z[0] - 0.5)
        value = 8.0 + 0.5 * bend * d**2 + cubic * d**3
        met.append(Local(z, value, np.array([bend * d + 3.0 * cubic * d**2])))
        return met[-1]

    def free(z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return np.zeros(0), np.zeros((0, 1))

    start = at(np.array([0.5 + share * 1e-2]))  # a first step leads 1e-2 down, which is too far
    end = descend(at, start, lambda: met, free, steps=30, settled=1e-12)
    assert end.value - 8.0 <= 1e-11
    assert len(met) <= 5  # 6 to 16 by halves


def test_a_descent_ends_in_the_basin_of_an_optimum_that_is_known() -> None:
    met: list[Local] = []

    def at(z: np.ndarray) -> Local:
        d = z - 0.2
        met.append(Local(z, 5.0 + float(d @ d + 3.0 * d @ d**2), 2.0 * d + 9.0 * d**2))
        return met[-1]

    def free(z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return np.zeros(0), np.zeros((0, 1))

    def ended(*optima: tuple[np.ndarray, float]) -> float:
        met.clear()
        start = at(np.array([0.5]))
        return descend(
            at, start, lambda: met, free, steps=30, settled=1e-12, first=0.1, ended=optima
        ).value

    assert ended() == pytest.approx(5.0, abs=1e-9)
    alone = len(met)
    assert ended((np.array([0.2]), 5.0)) <= 5.0 + 1e-4
    assert len(met) < alone
    # A worse one does not hold it: this is not its basin.
    assert ended((np.array([0.2]), 5.5)) == pytest.approx(5.0, abs=1e-9)


def test_what_is_known_better_by_now_does_not_hold_a_descent() -> None:
    """The start belongs to a poor branch, which is known to be poor as soon as another is met."""
    met = {0.55: Local(np.array([0.55]), 7.0, np.array([-10.0]))}

    def smooth(z: float) -> Local:
        return Local(np.array([z]), 5.0 + (z - 0.2) ** 2, np.array([2.0 * (z - 0.2)]))

    def at(z: np.ndarray) -> Local:
        met[float(z[0])] = smooth(float(z[0]))
        met[0.55] = smooth(0.55)
        return met[float(z[0])]

    def free(z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return np.zeros(0), np.zeros((0, 1))

    end = descend(
        at, met[0.55], lambda: list(met.values()), free, steps=12, settled=1e-9, first=0.1
    )
    assert end.z == pytest.approx([0.2], abs=1e-3)


def envelope_of(slopes: np.ndarray, slack: float = 0.0) -> Envelope:
    """That of v = -J at a point where all these pieces of J are equal, or all but the first are off
    it by so much: max τ, τ <= v_i(θ)."""
    count = len(slopes)
    first = np.eye(count)[0]
    names = ("S_MAX",) * count
    return Envelope(
        names, np.zeros(slopes.shape[1]), -slopes, np.ones((count, 1)), np.ones(1), first,
        slack * (1.0 - first),
    )  # fmt: skip


def test_a_piece_that_does_not_quite_bind_counts_by_what_is_left() -> None:
    """J = max(z, -z - s) is 0 at z = 0, and -s/2 at its minimiser: half of s is to be had there."""
    slopes, none = np.array([[1.0], [-1.0]]), np.zeros((0, 1))
    for slack in (1e-4, 1e-2):
        found = joint_residual(envelope_of(slopes, slack), np.zeros(1), slopes, none, 1.0)[0]
        assert found == pytest.approx(0.5 * slack, rel=0.05)


def residual(slopes: np.ndarray, A: np.ndarray) -> float:
    size = float(np.abs(slopes).max())
    none = np.zeros(slopes.shape[1])
    return joint_residual(envelope_of(slopes), none, slopes, A, size)[0]


@few(max_examples=50)
@given(SEEDS, st.integers(1, 5), st.integers(2, 6), st.booleans())
def test_the_residual_vanishes_where_no_direction_descends(
    seed: int, n: int, count: int, bound: bool
) -> None:
    of = pieces(np.random.default_rng(seed), n, count, bound, 0.0)
    assert residual(of.slopes, of.A) < 1e-9
    away = np.random.default_rng(seed).normal(size=(200, n))
    inside = away[(away @ of.A.T <= 0.0).all(axis=1)]
    assert ((inside @ of.slopes.T).max(axis=1) >= -1e-12).all()


def nearest_of_hull(slopes: np.ndarray) -> np.ndarray:
    """The point of the hull of rows that is nearest to zero: the least of all faces' own."""
    best = slopes[0]
    for size in range(1, len(slopes) + 1):
        for face in map(list, combinations(range(len(slopes)), size)):
            edges = slopes[face[1:]] - slopes[face[0]]
            along = np.linalg.lstsq(edges.T, -slopes[face[0]], rcond=None)[0]
            if min([1.0 - along.sum(), *along]) >= -1e-12:
                best = min(best, slopes[face[0]] + along @ edges, key=np.linalg.norm)
    return np.asarray(best)


@few(max_examples=50)
@example(220436, 1, 2, 1.0)  # one slope is zero, and SLSQP stays at the middle
@given(SEEDS, st.integers(1, 5), st.integers(2, 5), st.floats(0.02, 1.0))
def test_elsewhere_on_a_kink_it_is_the_distance_of_the_hull_from_zero(
    seed: int, n: int, count: int, shift: float
) -> None:
    rng = np.random.default_rng(seed)
    slopes = pieces(rng, n, count, False, 0.0).slopes
    slopes = slopes + shift * np.eye(n)[0] * np.abs(slopes).max()
    g = nearest_of_hull(slopes)
    found = residual(slopes, np.zeros((0, n)))
    # the controller's conditions weigh 10, so Σ μ = 1 holds to ‖g‖²/100 in units of the slopes
    unit = np.abs(slopes).max()
    off = float(g @ g) / unit**2 / 100.0
    assert found == pytest.approx(float(np.abs(g).max() / unit), rel=0.0, abs=off + 1e-9)
    if found > 1e-3:  # and then J falls along -g, by every piece
        assert (slopes @ g).min() > 0.0


@dataclass
class Told:
    """J = the largest of pieces over θ, through ω_b* = -J, as a sampler tells it."""

    case: CoDesignProblem
    of: Pieces
    worth: float = 0.0  # of another controller, which is better for θ above the minimiser

    def at(self, theta: np.ndarray) -> InnerSample:
        lower, width = np.array(self.case.lower), np.subtract(self.case.upper, self.case.lower)
        z = (np.asarray(theta) - lower) / width
        found = self.of.at(z)
        value = found.value - self.worth * max(0.0, float(z[0] - self.of.minimiser[0]))
        gradient = tuple(-found.gradient / width)
        return InnerSample(
            tuple(map(float, theta)), -value, gradient, np.nan, np.nan, (), "", 0.0, 1
        )

    def values(self, thetas: np.ndarray, label: str) -> list[InnerSample]:
        return [self.at(theta) for theta in np.atleast_2d(thetas)]


def certificate(reported: Told, z: np.ndarray, slopes: np.ndarray) -> KktCertificate:
    """At z, where all pieces with these slopes are equal."""
    lower = np.array(reported.case.lower)
    width = np.subtract(reported.case.upper, lower)
    envelope = replace(envelope_of(slopes), to_theta=-slopes / width)
    sample = replace(reported.at(lower + width * z), gradient=tuple(-slopes[0] / width))
    return theta_kkt(reported.case, sample, cast(Sampler, reported), envelope)


def case() -> CoDesignProblem:
    sections = StructuredProblem(structure=Structure(biquads=0))
    return replace(problem(controller=sections), w1=0.0, w2=-1.0)


def line(kkt: KktCertificate) -> Any:
    """The verdict's."""
    return optimal(
        kkt, level=VerifiedStructured.kkt_level, gap=0.0, tolerance=1e-3,
        better=Reason.WEIGHTS_BETTER(), searched=((Reason.GAP_UNKNOWN(),), {}),
    )  # fmt: skip


def test_a_kink_is_an_optimum_where_both_sides_rise() -> None:
    """Of two pieces in two parameters: along the kink by curvature, across it by slopes."""
    of = Pieces(
        np.array([0.4, 0.6]), np.array([[30.0, 15.0], [-20.0, -10.0]]),
        np.array([np.eye(2), np.eye(2)]), np.zeros((0, 2)),
    )  # fmt: skip
    found = certificate(Told(case(), of), of.minimiser, of.slopes)
    assert found.stationarity < 1e-9
    assert found.kink is not None
    assert found.kink.one_gradient == pytest.approx(1.0)
    across, along = found.kink.slopes
    # per share of the box along (2, 1)/√5, over the largest slope, 30
    assert sorted(across) == pytest.approx(
        [np.sqrt(500.0) / 30.0, np.sqrt(1125.0) / 30.0], rel=1e-3
    )
    assert along == pytest.approx((0.0, 0.0), abs=1e-3)
    said = line(found)
    assert said.state is State.PASSED
    assert "locally optimal to first order at a kink" in said.words
    assert "on both sides of 2 directions" in said.words


def test_a_point_on_a_kink_that_falls_along_it_is_refused() -> None:
    """The pieces are equal all along (1, -2); there J falls by half of its gradient."""
    of = Pieces(
        np.array([0.4, 0.6]), np.array([[30.0, 15.0], [-20.0, -10.0]]),
        30.0 * np.array([np.eye(2), np.eye(2)]), np.zeros((0, 2)),
    )  # fmt: skip
    off = np.array([1.0, -2.0]) * 0.2
    z = of.minimiser + off
    found = certificate(Told(case(), of), z, of.slopes + 30.0 * off)
    assert found.stationarity > 0.1
    said = line(found)
    assert said.state is State.FAILED
    assert "not optimal" in said.words


def test_another_controller_that_is_better_beside_it_refuses_a_kink() -> None:
    """The design's own derivatives know nothing of it; true values do."""
    of = Pieces(
        np.array([0.4, 0.6]), np.array([[30.0, 0.0], [-20.0, 0.0]]),
        np.array([np.eye(2), np.eye(2)]), np.zeros((0, 2)),
    )  # fmt: skip
    reported = Told(case(), of)
    assert line(certificate(reported, of.minimiser, of.slopes)).state is State.PASSED
    reported.worth = 45.0
    found = certificate(reported, of.minimiser, of.slopes)
    assert found.stationarity < 1e-9
    assert found.kink is not None
    assert found.kink.least_slope == pytest.approx(-0.5, rel=1e-2)
    said = line(found)
    assert said.state is State.FAILED
    assert "falls on a side" in said.words


def test_where_one_gradient_is_enough_there_is_no_kink() -> None:
    """Two equal rows have many multipliers, and one gradient."""
    of = Pieces(np.array([0.4, 0.6]), np.zeros((1, 2)), np.array([np.eye(2)]), np.zeros((0, 2)))
    slopes = np.array([[5.0, 3.0], [5.0, 3.0]])
    reported = Told(case(), of)
    found = certificate(reported, of.minimiser, slopes)
    assert found.kink is None
    assert found.stationarity == pytest.approx(1.0)
    smooth = certificate(reported, of.minimiser, np.zeros((2, 2)))
    assert smooth.kink is None
    assert smooth.stationarity <= VerifiedStructured.kkt_level
