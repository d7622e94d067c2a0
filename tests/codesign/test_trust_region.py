"""The trust region on its own: known optima, kinks, infeasible starts, points without a value."""

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from oracles.helpers import few

from ccd_casadi.optim.quadratic_programmes import QuadraticOptions, damped_bfgs, symmetric_rank_one
from ccd_casadi.optim.step import Iterate, Rows, Step, TrustRegionModel, best_step
from ccd_casadi.optim.trust_region import Minimum, Radius, minimise
from ccd_casadi.support.arrays import Array

SEEDS = st.integers(0, 2**32 - 1)
WIDE = 10.0
Update = Callable[[Array, Array, Array], Array]


class Smooth(TrustRegionModel[Array]):
    """½ (x - a)ᵀ Q (x - a) within rows b + A x + ½ xᵀ R x <= 0, known where |x - hole| > size."""

    def __init__(
        self, Q: Array, a: Array, b: Array, A: Array, R: Array, *, learn: Update | None = None
    ) -> None:
        self.Q, self.a, self.b, self.A, self.R, self.rule = Q, a, b, A, R, learn
        self.low, self.high = np.full(len(a), -WIDE), np.full(len(a), WIDE)
        self.hole, self.size, self.missed = np.zeros(len(a)), 0.0, 0
        self.seen: list[Array] = []
        self.growing, self.corrected = learn is damped_bfgs, learn is not damped_bfgs

    def at(self, x: Array) -> Iterate[Array] | None:
        self.seen.append(x)
        if np.abs(x - self.hole).max() < self.size:
            self.missed += 1
            return None
        d, c = x - self.a, self.b + self.A @ x + 0.5 * self.R @ x @ x
        return Iterate(x, float(0.5 * d @ self.Q @ d), self.Q @ d, max(0.0, *c), c)

    def rows(self, here: Iterate[Array], radius: float) -> Rows:
        slopes = self.A + self.R @ here.x
        if self.rule is damped_bfgs:
            return Rows(here.data, slopes)
        return Rows(here.data, slopes, hessians=lambda i: self.R[i], curved=len(slopes))

    def learn(
        self, H: Array, here: Iterate[Array], there: Iterate[Array], step: Step, radius: float
    ) -> Array:
        if self.rule is None:
            return H
        change = there.gradient - here.gradient
        if self.rule is damped_bfgs:
            change = change + (self.R @ (there.x - here.x)).T @ step.multipliers
        return self.rule(H, there.x - here.x, change)

    def run(self, x: Array, penalty: float = 100.0) -> Minimum[Array]:
        start = self.at(x)
        assert start is not None
        H = np.eye(len(x)) if self.rule else self.Q
        return minimise(self, start, H, Radius(0.5, 1e-12, 4.0), steps=300, penalty=penalty,
                        least_gain=1e-13)  # fmt: skip


def convex_problem(
    rng: np.random.Generator, n: int, learn: Update | None, bending: float
) -> tuple[Smooth, Array]:
    """With the minimiser x*, at which some of the rows bind with multipliers from 0.5 to 2."""
    root = rng.normal(size=(n, n))
    Q, best = root @ root.T + 0.3 * np.eye(n), rng.uniform(-3.0, 3.0, n)
    m = int(rng.integers(1, n + 2))
    roots = rng.normal(size=(m, n, n))
    R = bending * roots @ roots.transpose(0, 2, 1)
    slopes = rng.normal(size=(m, n))
    mu = np.where(np.arange(m) < n, rng.uniform(0.5, 2.0, m), 0.0) * rng.integers(0, 2, m)
    slack = np.where(mu > 0.0, 0.0, rng.uniform(0.1, 1.0, m))
    A = slopes - R @ best
    b = -A @ best - 0.5 * R @ best @ best - slack
    return Smooth(Q, best + np.linalg.solve(Q, slopes.T @ mu), b, A, R, learn=learn), best


@pytest.mark.parametrize("learn", [None, symmetric_rank_one, damped_bfgs])
@few(max_examples=20)
@given(SEEDS, st.integers(1, 5), st.sampled_from([0.0, 0.3]))
def test_a_convex_problem_ends_at_its_minimiser(
    learn: Update | None, seed: int, n: int, bending: float
) -> None:
    """From a start that may be far outside the rows, whatever the curvature is learnt by."""
    rng = np.random.default_rng(seed)
    model, best = convex_problem(rng, n, learn, bending)
    end = model.run(rng.uniform(-9.0, 9.0, n))
    assert end.best.violation <= 1e-7
    np.testing.assert_allclose(end.best.x, best, atol=1e-4)
    assert end.evaluations == len(model.seen) - 1


@few(max_examples=20)
@given(SEEDS, st.integers(1, 4))
def test_a_largest_of_smooth_functions_ends_at_its_kink(seed: int, n: int) -> None:
    """min t, J_i(x) <= t, of n + 1 functions whose slopes surround 0 at x*, convex or not."""
    rng = np.random.default_rng(seed)
    slopes = np.vstack([np.eye(n), -np.ones(n)]) * rng.uniform(0.5, 2.0, (n + 1, 1))
    R = rng.uniform(-0.4, 0.4, (n + 1, n + 1, n + 1))
    R = R + R.transpose(0, 2, 1)
    R[:, n], R[:, :, n] = 0.0, 0.0
    best = np.append(rng.uniform(-1.0, 1.0, n), 0.7)
    A = np.column_stack([slopes, -np.ones(n + 1)]) - R @ best
    b = -A @ best - 0.5 * R @ best @ best

    class Largest(Smooth):
        def at(self, x: Array) -> Iterate[Array] | None:
            c = self.b + self.A @ x + 0.5 * self.R @ x @ x
            return Iterate(x, float(x[n]), np.eye(n + 1)[n], max(0.0, *c), c)

    model = Largest(np.zeros((n + 1, n + 1)), best, b, A, R)
    end = model.run(best + np.append(rng.uniform(-0.1, 0.1, n), 0.5))
    np.testing.assert_allclose(end.best.x, best, atol=1e-7)
    assert end.done
    assert end.evaluations <= 40  # as Newton's method does, where the kink is a vertex


@few(max_examples=20)
@given(SEEDS, st.integers(2, 4))
def test_a_region_without_values_is_passed(seed: int, n: int) -> None:
    """The straight way to the minimiser leads through a box where nothing is known."""
    rng = np.random.default_rng(seed)
    model, best = convex_problem(rng, n, None, 0.0)
    away = np.where(rng.random(n) < 0.5, -1.0, 1.0) * rng.uniform(4.0, 5.0, n)
    model.hole, model.size = best + 0.5 * away, 0.9
    start = model.hole + np.where(away > 0.0, 1.0, -1.0) * 1.2
    end = model.run(start)
    assert np.abs(end.best.x - model.hole).max() >= model.size
    begin = model.at(start)
    assert begin is not None
    before, after = (at.value + 100.0 * at.violation for at in (begin, end.best))
    assert after < before
    if model.missed == 0:
        np.testing.assert_allclose(end.best.x, best, atol=1e-4)


def test_a_step_into_nothing_is_shortened_until_it_has_a_value() -> None:
    """x = 0 is best, but all below 1 is unknown: the end is the edge of what is known."""
    model = Smooth(np.eye(1), np.zeros(1), -np.ones(1), np.zeros((1, 1)), np.zeros((1, 1, 1)))
    model.hole, model.size = np.array([-4.0]), 5.0
    end = model.run(np.array([3.0]))
    assert model.missed > 5
    assert 1.0 <= end.best.x[0] <= 1.0 + 1e-6


def test_rows_that_cannot_all_be_kept_are_passed_by_the_least() -> None:
    """x >= 1 and x <= -1: the least violation is 1, at 0."""
    A, R = np.array([[-1.0], [1.0]]), np.zeros((2, 1, 1))
    model = Smooth(np.eye(1), np.full(1, 3.0), np.ones(2), A, R)
    end = model.run(np.array([4.0]))
    assert end.best.violation == pytest.approx(1.0, abs=1e-6)


def step(size: float) -> Step:
    rows = Rows(np.zeros(0), np.zeros((0, 1)))
    return Step(np.array([size]), 1.0, 1.0, np.eye(1), np.zeros(0), rows, 1.0)


def test_the_radius_follows_the_gain() -> None:
    radius = Radius(0.1, 1e-6, 0.5)
    assert radius.after(0.9, step(0.1)).value > 0.1
    assert radius.after(0.9, step(0.01)).value == 0.1
    assert radius.after(-1.0, step(0.01)).value <= 0.01
    assert radius.after(-np.inf, step(0.1)).value < 0.1
    middling = radius.after(0.5, step(0.1))
    assert middling.value == 0.1
    assert middling.after(0.5, step(0.1)).after(0.5, step(0.1)).value == 0.5  # the largest


def test_rows_far_below_their_bounds_push_out_none_that_holds_the_step() -> None:
    """min ½ (x - 3)² within x <= 1, beside more steep rows than a programme begins with."""
    far = 2 * QuadraticOptions.first_rows
    A = np.concatenate([np.full((far, 1), 100.0), np.ones((1, 1))])
    b = np.append(np.full(far, -150.0), -1.0)
    model = Smooth(np.eye(1), np.full(1, 3.0), b, A, np.zeros((far + 1, 1, 1)))
    start = model.at(np.zeros(1))
    assert start is not None
    found = best_step(model, start, model.Q, 4.0, 100.0)
    assert found is not None
    assert found.change[0] == pytest.approx(1.0, abs=1e-6)


def test_rows_that_are_just_passed_push_out_none_that_is_passed_by_far() -> None:
    """From x = 0 with 1 - x <= 0 unmet, beside more flat rows that are hardly passed."""
    flat = 2 * QuadraticOptions.first_rows
    A = np.concatenate([np.full((flat, 1), 1e-3), -np.ones((1, 1))])
    b = np.append(np.full(flat, 1e-2), 1.0)
    model = Smooth(np.eye(1), np.full(1, -1.0), b, A, np.zeros((flat + 1, 1, 1)))
    start = model.at(np.zeros(1))
    assert start is not None
    found = best_step(model, start, model.Q, 4.0, 100.0)
    assert found is not None
    assert found.change[0] > 0.9
