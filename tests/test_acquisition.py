"""Where new truth is asked for: improvement, exploration, believed batches, the optimum."""

from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
import pytest

from ccd_casadi.codesign.acquisition import (
    AVOID,
    NEAR,
    Posterior,
    choose,
    distances,
    expected_improvement,
    maximiser,
    objective_and_violation,
    predicted_optimum,
    scaled_deviation,
)
from ccd_casadi.codesign.truth import Observations
from surrogates import fit, sobol
from surrogates.interface import Array

LOWER, UPPER = np.array([-1.0, 10.0]), np.array([3.0, 12.0])


class Valley:
    """min y_0 + 0.1 x_1 s.t. y_1 <= 0, with y_0 a bowl and y_1 a plane's sine."""

    outputs, tolerance, describe = ("bowl", "wave"), 1e-3, {}
    lower, upper = LOWER, UPPER
    x, y = ca.MX.sym("x", 2), ca.MX.sym("y", 2)
    objective = ca.Function("J", [x, y], [y[0] + 0.1 * x[1]])
    constraints = ca.Function("g", [x, y], [y[1]])

    def ask(self, X: Array) -> Observations:
        a, b = (X - LOWER).T / (UPPER - LOWER)[:, None]
        Y = np.column_stack(
            [(a - 0.7) ** 2 + (b - 0.4) ** 2 + a * b, np.sin(2.0 * a) - 0.9 + 0.2 * b]
        )
        da = np.column_stack([2.0 * (a - 0.7) + b, 2.0 * np.cos(2.0 * a)])
        db = np.column_stack([2.0 * (b - 0.4) + a, np.full(len(X), 0.2)])
        return Observations(X, Y, np.stack([da, db], axis=2) / (UPPER - LOWER))


def posterior(n: int = 10, gradients: bool = False, seed: int = 0) -> Posterior:
    truth: Any = Valley()
    seen = truth.ask(sobol(LOWER, UPPER, n, seed))
    if not gradients:
        seen = replace(seen, dY=None)
    surrogates = tuple(
        fit(
            seen.X,
            seen.Y[:, i],
            lower=LOWER,
            upper=UPPER,
            dY=None if seen.dY is None else seen.dY[:, i],
            starts=2,
        )
        for i in range(2)
    )
    return Posterior(truth, surrogates, seen, np.empty((0, 2)))


def test_expected_improvement_is_that_of_simulated_outcomes() -> None:
    found = posterior(5)
    X = sobol(LOWER, UPPER, 16, seed=5)
    best = 1.5
    rng = np.random.default_rng(0)
    pairs = [process.predict(X, return_std=True) for process in found.surrogates]
    drawn = [m + s * rng.standard_normal((30_000, len(X))) for m, s in pairs]
    gain = np.maximum(best - (drawn[0] + 0.1 * X[:, 1]), 0.0) * (drawn[1] <= 0.0)
    expected, error = gain.mean(axis=0), gain.std(axis=0) / np.sqrt(len(gain))
    assert expected.max() > 10.0 * error.max(), "there is something to compare"
    computed = expected_improvement(found, X, best)
    np.testing.assert_array_less(np.abs(computed - expected), 5.0 * error + 1e-6)


def test_constraints_without_deviation_are_met_or_not() -> None:
    found = posterior()
    truth: Any = Valley()
    x, y = truth.x, truth.y
    truth.constraints = ca.Function("g", [x, y], [x[0] - 1.0])
    found = replace(found, truth=truth)
    X = np.array([[0.9, 11.0], [1.1, 11.0]])
    inside, outside = expected_improvement(found, X, 50.0)
    assert inside > 0.0
    assert outside == 0.0
    truth.constraints = ca.Function("g", [x, y], [ca.MX(0, 1)])
    assert expected_improvement(replace(found, truth=truth), X, 50.0).min() > 0.0
    J, violation = objective_and_violation(truth, found.observed.X, found.observed.Y)
    np.testing.assert_allclose(J, found.observed.Y[:, 0] + 0.1 * found.observed.X[:, 1])
    assert (violation == -np.inf).all()


def test_the_incumbent_is_the_best_that_is_allowed() -> None:
    found = posterior(32)
    J, violation = found.values()
    at = found.incumbent()
    assert at is not None
    assert violation[at] <= 1e-4
    assert J[at] == J[violation <= 1e-4].min()
    assert J.min() < J[at], "the constraint forbids the best of all"


@pytest.mark.parametrize("gradients", [False, True])
def test_what_is_believed_is_known_and_moves_little(gradients: bool) -> None:
    found = posterior(gradients=gradients)
    x = np.array([0.3, 11.3])
    after = found.with_prediction_at(x)
    X = sobol(LOWER, UPPER, 32, seed=3)
    for old, new in zip(found.surrogates, after.surrogates, strict=True):
        mean, std = old.predict(X, return_std=True)
        change = np.abs(new.predict(X) - mean).max()
        # not nothing: the processes scale outputs by the samples, of which there is one more
        least = 1e-5 * np.ptp(found.observed.Y)
        assert change <= 0.3 * std.max() + least, "a process that is told its own mean"
    assert scaled_deviation(after, x[None])[0] < 1e-2 * scaled_deviation(found, x[None])[0] + 1e-6
    assert distances(found.truth, x[None], after.observed.X)[0] == 0.0


@pytest.mark.parametrize("gradients", [False, True])
def test_a_batch_is_of_new_points_apart_from_each_other(gradients: bool) -> None:
    found = posterior(gradients=gradients)
    first = np.array([1.0, 10.5])
    batch = choose(found, [first], 4, 1, seed=2)
    assert batch.shape == (4, 2)
    np.testing.assert_array_equal(batch[0], first)
    assert ((batch >= LOWER) & (batch <= UPPER)).all()
    for i, x in enumerate(batch):
        others = np.vstack([found.observed.X, batch[:i]])
        assert distances(found.truth, x[None], others)[0] > NEAR
    np.testing.assert_array_equal(batch, choose(found, [first], 4, 1, seed=2))


def test_what_is_known_or_failed_is_left_out() -> None:
    found = posterior()
    known = found.observed.X[3] + 0.5 * NEAR
    batch = choose(found, [known], 2, 0, seed=0)
    assert (distances(found.truth, batch, known[None]) > NEAR).all()
    x, merit = maximiser(found, False, [], 0)
    assert merit > 0.0
    failed = replace(found, failed=x[None])
    again, less = maximiser(failed, False, [], 0)
    assert distances(found.truth, again[None], x[None])[0] >= AVOID
    assert 0.0 < less < merit
    np.testing.assert_array_equal(found.chance_of_value(found.observed.X), 1.0)
    hopes = failed.chance_of_value(np.vstack([found.observed.X, x]))
    np.testing.assert_array_equal(hopes, [1.0] * len(found.observed.X) + [0.0])


def test_exploring_asks_where_least_is_known() -> None:
    found = posterior(8)
    x, merit = maximiser(found, True, [], 0)
    everywhere = scaled_deviation(found, sobol(LOWER, UPPER, 1024, seed=9))
    assert merit >= everywhere.max() * 0.98
    (alone,) = choose(found, [], 1, 1, seed=0)
    np.testing.assert_array_equal(alone, x)


def test_the_predicted_optimum_is_that_of_the_surrogates() -> None:
    found = posterior(30, gradients=True)
    truth = found.truth
    optimum = predicted_optimum(found, sobol(LOWER, UPPER, 8, 0))
    assert optimum is not None
    X = sobol(LOWER, UPPER, 4096, seed=1)
    J, violation = objective_and_violation(truth, X, Valley().ask(X).Y)
    best = J[violation <= 0.0].min()
    assert best - 0.02 <= optimum[1] <= best + 1e-3
    forbidden = replace(found, failed=optimum[0][None])
    away = predicted_optimum(forbidden, sobol(LOWER, UPPER, 8, 0))
    assert away is not None
    gap = np.linalg.norm((away[0] - optimum[0]) / (UPPER - LOWER))
    assert gap >= AVOID * (1.0 - 1e-6)
    assert away[1] >= optimum[1] - 1e-9


def test_no_optimum_where_nothing_is_allowed() -> None:
    truth: Any = Valley()
    truth.constraints = ca.Function("g", [truth.x, truth.y], [1.0 + 0.0 * truth.y[0]])
    found = replace(posterior(), truth=truth)
    assert predicted_optimum(found, sobol(LOWER, UPPER, 2, 0)) is None
