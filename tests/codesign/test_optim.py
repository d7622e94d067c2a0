"""Quadratic programmes: an answer is the optimum, and no answer is never taken for one."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from oracles.helpers import HZ, few, problem
from test_kinks import pieces

from ccd_casadi.codesign.kinked import descend
from ccd_casadi.codesign.optimality import LiftedKktOptions, TrueDesign
from ccd_casadi.inner_problem.objective import TrueQuantities
from ccd_casadi.optim import pieces as of_pieces
from ccd_casadi.optim import quadratic_programmes
from ccd_casadi.optim.quadratic_programmes import QuadraticOptions, solve_elastic, solve_quadratic
from ccd_casadi.support.arrays import Array

SEEDS = st.integers(0, 2**32 - 1)


def elastic(rng: np.random.Generator) -> tuple[Array, ...]:
    """A trust-region step with elastic rows, whose H is nearly singular: see `codesign.kinked`.

    The dual active-set method alone calls a success what misses the rows of every second one.
    """
    n, m, radius = int(rng.integers(2, 30)), int(rng.integers(1, 12)), 10.0 ** rng.uniform(-6, -0.5)
    root = rng.normal(size=(n, n))
    H = np.zeros((n + m, n + m))
    H[:n, :n] = radius * 10.0 ** rng.uniform(-2, 3) * (root @ root.T / n + 1e-9 * np.eye(n))
    H[n:, n:] = 1e-6 * np.eye(m)
    c = np.append(rng.normal(size=n) / 3.0, np.full(m, 10.0 * (1.0 + 10.0 ** rng.uniform(0, 3))))
    A = np.hstack([rng.normal(size=(m, n)), -np.eye(m)])
    upper = -rng.normal(size=m) * 10.0 ** rng.uniform(-9, -1) / radius
    z = rng.uniform(size=n) * (rng.uniform(size=n) > 0.3)
    low = np.append(np.maximum(-1.0, -z / radius), np.zeros(m))
    high = np.append(np.minimum(1.0, (1.0 - z) / radius), np.full(m, np.inf))
    return H, c, A, upper, low, high


@few(max_examples=60)
@given(seed=SEEDS)
def test_an_answer_keeps_its_rows_and_is_optimal(seed: int) -> None:
    """Its value is the dual's: no feasible point has a lower one (weak duality)."""
    H, c, A, upper, low, high = elastic(np.random.default_rng(seed))
    found = solve_quadratic(H, c, A, upper, low, high)
    assert found is not None
    x, mu = found.x, found.multipliers
    assert (A @ x - upper).max() <= QuadraticOptions.row_error
    assert max((low - x).max(), (x - high).max()) <= QuadraticOptions.bound_error
    slope = H @ x + c + A.T @ mu  # what the bounds carry
    ends = np.where(slope > 0.0, low, np.where(np.isfinite(high), high, x))
    dual = -0.5 * x @ H @ x - mu @ upper + slope @ ends
    primal = c @ x + 0.5 * x @ H @ x
    assert primal - dual <= 1e-5 * (np.abs(c) @ np.abs(x) + np.abs(mu) @ np.abs(upper) + 1.0)


@few(max_examples=20)
@given(seed=SEEDS)
def test_of_thousands_of_rows_none_is_left_out(seed: int) -> None:
    """The row that holds the step is the last one in the order: the answer keeps it as if all were
    in one programme, and it has the multiplier."""
    rng = np.random.default_rng(seed)
    n, m, radius = 8, 10 * QuadraticOptions.first_rows, 10.0 ** rng.uniform(-4, -1)
    slopes = rng.normal(size=(m, n))
    value = -radius * (1.0 + np.abs(slopes).sum(1))  # out of reach
    c, ends = rng.normal(size=n), (np.full(n, -radius), np.full(n, radius))
    slopes[-1], value[-1] = -c / np.abs(c).sum(), -0.1 * radius
    given = (np.zeros((n, n)), c, slopes, value, np.ones(m), *ends)
    found = solve_elastic(*given, 1e3 * np.abs(c).sum(), radius, 1.0)
    assert found is not None
    p, mu = found
    assert (value + slopes @ p).max() <= 2e-3 * radius
    assert mu[-1] == pytest.approx(np.abs(c).sum(), rel=1e-3)
    assert np.delete(mu, -1).max() <= 1e-6 * mu[-1]


@few(max_examples=20)
@given(seed=SEEDS)
def test_the_interior_point_ends_where_the_active_sets_do(seed: int) -> None:
    """Rows of any size: it is asked where they differ too much for DAQP."""
    rng = np.random.default_rng(seed)
    n, m, options = 5, 40, QuadraticOptions()
    root = rng.normal(size=(n, n))
    H, c, inside = root.T @ root + np.eye(n), 10.0 * rng.normal(size=n), rng.uniform(-0.5, 0.5, n)
    A, ends = rng.normal(size=(m, n)), (np.full(n, -1.0), np.full(n, 1.0))
    upper = A @ inside + rng.uniform(0.0, 0.5, m)
    by_sets = solve_quadratic(H, c, A, upper, *ends)
    sizes = 10.0 ** rng.uniform(-3.0, 6.0, m)
    by_interior = quadratic_programmes._interior(
        H, c, sizes[:, None] * A, sizes * upper, *ends, options
    )
    assert by_sets is not None
    assert by_interior is not None
    assert by_interior.x == pytest.approx(by_sets.x, abs=1e-6)
    assert sizes * by_interior.multipliers == pytest.approx(by_sets.multipliers, abs=1e-5)


@pytest.fixture
def failing(monkeypatch: pytest.MonkeyPatch):
    """Let the next programmes fail, by either solver."""

    def let(count: int) -> None:
        left = [count]
        dual, interior = quadratic_programmes.daqp.solve, quadratic_programmes._interior

        def solve(*programme: object, **options: object) -> tuple:
            x, value, flag, info = dual(*programme, **options)
            return x, value, -1 if left[0] else flag, info

        def other(*programme: object) -> object:
            refused = left[0] > 0
            left[0] -= refused
            return None if refused else interior(*programme)

        monkeypatch.setattr(quadratic_programmes.daqp, "solve", solve)
        monkeypatch.setattr(quadratic_programmes, "_interior", other)

    return let


@pytest.mark.parametrize("count", [1, 3])
def test_a_failed_programme_is_no_optimum_on_kinks(failing, count: int) -> None:
    case = problem()
    quantities = TrueQuantities(case)
    start = np.array([60.0, 66.0, *np.log([500.0 * HZ, 45.0 * HZ])])
    failing(count)
    end = descend(quantities, start, steps=40)
    assert TrueDesign(quantities, end).kkt.stationarity <= LiftedKktOptions().smooth


@pytest.mark.parametrize("count", [1, 3])
def test_a_failed_programme_is_no_optimum_in_a_bundle(failing, count: int) -> None:
    p = pieces(np.random.default_rng(0), 3, 3, bound=False, bending=0.3)
    met = [p.at(np.full(3, 0.35))]

    def at(z: np.ndarray) -> of_pieces.Local:
        met.append(p.at(z))
        return met[-1]

    failing(count)
    best = of_pieces.descend(at, met[0], lambda: met, p.constraints, steps=80, settled=1e-12)
    assert np.abs(best.z - p.minimiser).max() <= 1e-4
