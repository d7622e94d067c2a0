"""The surrogates as estimators: scikit-learn's own checks, a search, and the way to CasADi."""

import numpy as np
import pytest
from sklearn.model_selection import GridSearchCV
from sklearn.utils.estimator_checks import check_estimator

from surrogates import SurrogateRegressor, to_casadi


@pytest.mark.filterwarnings("ignore")  # what the checks provoke
@pytest.mark.slow
def test_it_passes_the_checks_of_scikit_learn() -> None:
    results = check_estimator(SurrogateRegressor(), on_fail=None, on_skip=None)
    failed = [(r["check_name"], r["exception"]) for r in results if r["status"] == "failed"]
    assert not failed
    assert sum(r["status"] == "passed" for r in results) > 30


def test_a_search_over_kernels_ends_at_a_surrogate_for_casadi() -> None:
    rng = np.random.default_rng(0)
    X = rng.uniform(0.0, [1.0, 2.0], (24, 2))
    y = np.exp(-X[:, 0]) * np.sin(X[:, 1])
    search = GridSearchCV(
        SurrogateRegressor(noise=0.0, starts=1), {"kernel": ["matern52", "rbf"]}, cv=3
    ).fit(X, y)
    assert search.best_score_ > 0.99
    best = search.best_estimator_
    mean, deviation = best.predict([[0.5, 1.0]], return_std=True)
    assert float(to_casadi(best.surrogate_, std=False)([0.5, 1.0])) == pytest.approx(mean[0])
    assert deviation[0] > 0.0


def test_an_input_that_never_varies_is_no_obstacle() -> None:
    X = np.column_stack([np.linspace(0.0, 1.0, 8), np.full(8, 3.0)])
    model = SurrogateRegressor(noise=0.0).fit(X, X[:, 0] ** 2)
    assert model.predict([[0.5, 3.0]])[0] == pytest.approx(0.25, abs=1e-2)
