"""Fixed structures on plants of several channels: the whole loop's bounds and their derivatives."""

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from oracles.fixed_structure_channels import (
    BOUNDS,
    FAST,
    STRUCTURE,
    assert_derivatives,
    closed,
    everything,
    gaps,
    loop,
    plant,
    structure,
)
from oracles.helpers import sensitivity_gain

from ccd_casadi.fixed_structure.channel_structure import (
    ChannelStructure,
    Decoupling,
    find_decoupling,
    given_decoupling,
    in_channels,
    is_decoupled,
)
from ccd_casadi.fixed_structure.composite import composite_problem
from ccd_casadi.fixed_structure.figures import Brackets, assess, constraints, hessians, split
from ccd_casadi.fixed_structure.loop_problem import LoopCurve, LoopProblem
from ccd_casadi.fixed_structure.plant_set import plant_set
from ccd_casadi.lti.loop import Sampling
from ccd_casadi.support.errors import PlantError

ROOT = Path(__file__).resolve().parents[2]
SKEWED = given_decoupling(("a", "b", "c"), [[1, 0.2, 0], [0, 1, 0.1], [0.1, 0, 1]],
                          [[1, 0, 0.1], [0.1, 1, 0], [0, 0.1, 1]])  # fmt: skip


def finer(brackets: Brackets) -> np.ndarray:
    """Places inside of brackets, those where they start among them."""
    inside = np.geomspace(brackets.low, brackets.high, 12, axis=1)
    return np.sort(np.concatenate([inside, brackets.start[:, None]], axis=1), axis=1)


def whole(problem, sampling: Sampling | None, off: float = 0.3, theta=(1.0, 1.0)) -> LoopProblem:
    """The same problem with one plant as a whole, in the units of the stage at θ = (1, 1)."""
    plants = [plant(), plant(theta, off)]
    members = plant_set(plants, sampling, problem.structure.decoupling)
    return LoopProblem(members, problem.structure, BOUNDS, problem.box)


def test_the_channels_of_a_stage_are_found() -> None:
    found = find_decoupling(plant())
    assert found.orthogonal
    assert is_decoupled(plant(), found)
    assert is_decoupled(plant((1.3, 0.9)), found)
    assert not is_decoupled(plant(off=0.05), found)
    turned = in_channels(plant(off=0.3), find_decoupling(plant(off=0.3)))
    static = -turned.C @ np.linalg.solve(turned.A, turned.B)
    assert np.abs(static - np.diag(np.diag(static))).max() < 1e-9 * np.diag(static).min()
    with pytest.raises(PlantError, match="independent"):
        given_decoupling(("a", "b"), [[1, 1], [2, 2]], [[1, 0], [0, 1]])


@pytest.mark.parametrize("sampling", [None, FAST])
def test_where_plants_fall_apart_the_parts_are_the_whole(sampling: Sampling | None) -> None:
    problem, kappa = loop(0, (0.0,), sampling)
    together = whole(problem, sampling, off=0.0)
    parts = assess(problem, kappa, -1.5, depth=-0.4).peaks
    joint = assess(together, kappa, -1.5, depth=-0.4).peaks
    assert parts is not None
    assert joint is not None
    for i in range(len(parts.v)):
        one = parts.only(np.array([i]))
        rows = [
            constraints(together, kappa, -1.5, replace(one, plant=np.array([2 * k])))
            for k in range(3)
        ]
        row = min(rows, key=lambda row: abs(row.value[0] - one.value[0]))
        assert row.value[0] == pytest.approx(one.value[0], abs=1e-9)
        np.testing.assert_allclose(row.to_kappa, one.to_kappa, atol=1e-8)
        assert row.to_tau[0] == pytest.approx(one.to_tau[0], abs=1e-8)
    for curve in np.unique(joint.curve):
        tops = [found.value[found.curve == curve].max() for found in (parts, joint)]
        if tops[0] > -0.4:
            assert tops[1] == pytest.approx(tops[0], abs=1e-9)


@pytest.mark.parametrize(
    ("seed", "sampling", "given"),
    [(0, None, None), (1, FAST, None), (2, None, SKEWED), (3, FAST, SKEWED)],
)
def test_derivatives_of_singular_values(
    seed: int, sampling: Sampling | None, given: Decoupling | None
) -> None:
    """To κ, τ and θ against central differences of fourth order, where σ is a simple one."""
    problem, kappa = loop(seed, (0.0, 0.3), sampling)
    if given is not None:
        problem = composite_problem([plant(), plant(off=0.3)],
                                    ChannelStructure(given, problem.structure.structures),
                                    BOUNDS, sampling)  # fmt: skip
    seen = assert_derivatives(
        lambda theta: whole(problem, sampling, theta=theta), kappa, lambda row: row % 2 == 1
    )
    assert seen >= {LoopCurve.S_MAX, LoopCurve.S_LOW, LoopCurve.KS, LoopCurve.T, LoopCurve.CROSSING}


@pytest.mark.parametrize("sampling", [None, FAST])
def test_channels_that_share_parameters_are_the_same_loop_with_fewer(
    sampling: Sampling | None,
) -> None:
    """Bounds of the loop with them written out, and derivatives by the chain rule."""
    problem, kappa = loop(0, (0.0, 0.3), sampling)
    whole_structure = problem.structure
    tied = ChannelStructure(whole_structure.decoupling, whole_structure.structures, (0, 1, 1))
    plants = [plant(), plant(off=0.3)]
    shared = composite_problem(plants, tied, BOUNDS, sampling)
    kappa, count = kappa[: len(tied.names)], len(STRUCTURE.names)
    assert len(tied.names) == 2 * count
    np.testing.assert_array_equal(tied.places[2 * count :], tied.places[count : 2 * count])
    written_out = kappa[tied.places]
    one, other = assess(shared, kappa, -1.5).peaks, assess(problem, written_out, -1.5).peaks
    assert one is not None
    assert other is not None
    np.testing.assert_allclose(one.value, other.value, atol=1e-9)
    chain = (np.arange(2 * count) == tied.places[:, None]).astype(float)
    np.testing.assert_allclose(one.to_kappa, other.to_kappa @ chain, atol=1e-7)
    wide = np.block([[chain, np.zeros((3 * count, 1))], [np.zeros((1, 2 * count)), np.eye(1)]])
    exact = hessians(problem, written_out, -1.5, other)
    np.testing.assert_allclose(
        hessians(shared, kappa, -1.5, one), wide.T @ exact @ wide, rtol=1e-4, atol=1e-4
    )
    K, apart = tied.state_space(kappa), whole_structure.state_space(written_out)
    for a, b in zip((K.A, K.B, K.C, K.D), (apart.A, apart.B, apart.C, apart.D), strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("sampling", [None, FAST])
def test_the_hessian_of_the_whole_is_the_difference_of_gradients(sampling: Sampling | None) -> None:
    """In random directions; peaks move with κ. Where σ is a simple one, clear of the next."""
    problem, kappa = loop(1, (0.3,), sampling)
    tau = -1.5
    peaks = assess(problem, kappa, tau).peaks
    assert peaks is not None
    model = problem.parts[0].problem
    gap = gaps(model, kappa, tau, peaks)
    rng = np.random.default_rng(0)
    for _ in range(3):
        direction = rng.normal(0.0, 1.0, len(kappa))
        direction /= np.linalg.norm(direction)
        ends = [assess(problem, kappa + x * direction, tau).peaks for x in (1e-5, -1e-5)]
        seen = set()
        for j in np.flatnonzero(gap > 0.1):
            one = peaks.only(np.array([j]))
            exact = hessians(problem, kappa, tau, one)[0, :-1, :-1] @ direction
            slopes = []
            for end in ends:
                same = np.flatnonzero((end.curve == one.curve[0]) & (end.plant == one.plant[0]))
                k = same[np.argmin(np.abs(np.log(end.v[same] / one.v[0])))]
                slopes.append(end.to_kappa[k])
            numeric = (slopes[0] - slopes[1]) / 2e-5
            np.testing.assert_allclose(exact, numeric, atol=2e-4 * (1.0 + np.abs(numeric).max()))
            seen.add(int(one.curve[0]))
        assert len(seen) >= 5


@pytest.mark.parametrize("off", [(0.0,), (0.3,), (0.0, 0.3)])
def test_peaks_of_the_whole_are_those_of_dense_grids(off: tuple[float, ...]) -> None:
    problem, kappa = loop(2, off)
    peaks = assess(problem, kappa, -1.5).peaks
    assert peaks is not None
    owner = problem.plants_of(peaks)
    first = plant(off=off[0])
    si = problem.structure.in_units(kappa, first.omega_0, first.force)
    controller = problem.structure.state_space(si)
    omega = np.geomspace(1e-2, 1e4, 20001) * first.omega_0
    for i, x in enumerate(off):
        gain = sensitivity_gain(plant(off=x).plant_si(), controller, omega)
        own = peaks.value[(owner == i) & (peaks.curve == LoopCurve.S_MAX)].max()
        assert np.exp(own) * BOUNDS.S_max >= gain.max() * (1.0 - 1e-9)
        assert np.exp(own) * BOUNDS.S_max <= gain.max() * (1.0 + 1e-3)
    assert structure().order == 3 * STRUCTURE.order


def test_a_maximum_beside_a_crossing_of_singular_values_is_found() -> None:
    """The higher of two that lie so close that no point of the grid is above its neighbours."""

    def level(v: np.ndarray) -> np.ndarray:
        one, other = (top - 2e3 * (v - at) ** 2 for at, top in ((1.0, 0.0), (1.01, 0.05)))
        return np.sort(np.stack([one, other], axis=-1))[..., ::-1]

    # the grid's own largest sigma_1 is elsewhere; sigma_2 is largest where the two cross
    brackets = Brackets(np.full(2, LoopCurve.T), np.array([0, 1]), np.array([1.0, 1.004]),
                        np.array([0.99, 1.0]), np.array([1.004, 1.03]))  # fmt: skip
    inside = finer(brackets)
    found = split(brackets, np.arange(2), inside, level(inside), 1, 2)
    assert ((found.row == 0) & (found.low < 1.01) & (found.high > 1.01)).sum() == 1
    assert (found.row == 0).sum() == 2  # and the one that was known stays
    assert ((found.low <= found.start) & (found.start <= found.high)).all()
    assert (found.curve == LoopCurve.T).all()


def test_a_maximum_before_a_crossing_of_singular_values_is_closed_in_on(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Past the crossing the largest rises again: the ends of the grid's bracket have one slope.

    The search then took the point of the grid for the maximum, and on a rib stage with a payload
    passed S_max by 0.6 % unseen.
    """
    peaks = ((1.0, 0.0), (1.02, -0.01))

    def largest(v: np.ndarray) -> np.ndarray:
        return np.max([top - 2e2 * (v - at) ** 2 for at, top in peaks], axis=0)

    def slope(v: float) -> float:
        return float((largest(v * np.exp(1e-7)) - largest(v * np.exp(-1e-7))) / 2e-7)

    low, start, high = (np.array([v]) for v in (0.99, 0.9985, 1.0145))
    assert largest(start) > max(largest(low), largest(high))
    brackets = Brackets(np.full(1, LoopCurve.S_MAX), np.zeros(1, int), start, low, high)
    assert not closed(monkeypatch, slope, brackets)[1].any()
    inside = finer(brackets)
    found = split(brackets, np.arange(1), inside, largest(inside)[..., None], 1, 1)
    top, inside = closed(monkeypatch, slope, found)
    assert inside.all()
    assert (found.row == 0).all()
    assert top == pytest.approx(1.0, abs=1e-6)


INTERPRETED = """
import json, numpy as np
import oracles.interpreted
from oracles.fixed_structure_channels import everything
print(json.dumps([part.tolist() for part in everything()]))
"""


@pytest.mark.slow
def test_the_kernels_are_what_they_say_as_plain_python() -> None:
    """Interpreted they have the same constraints, slopes and curvature as compiled."""
    path = os.pathsep.join(str(ROOT / f) for f in (".", "tests"))
    out = subprocess.run([sys.executable, "-W", "ignore", "-c", INTERPRETED], check=True,
                         capture_output=True, env=os.environ | {"PYTHONPATH": path})  # fmt: skip
    for one, other in zip(everything(), json.loads(out.stdout), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-6, atol=1e-6 * np.abs(one).max())
