"""The calibrated case reproduces the published figures as well as its study says."""

from pathlib import Path

import numpy as np
import pytest
from oracles import published_figures as study

from ccd_casadi.cases.case import load_case
from ccd_casadi.cases.case_problem import problem_of
from ccd_casadi.inner_problem.problem import CoDesignProblem, true_inner

ROOT = Path(__file__).parents[2]
HZ = 2.0 * np.pi
# Ours at the published designs, (m1, m2) in kg: bandwidth in Hz, and J where one is published.
OURS = {
    (60.0, 60.0): (60.61, None),
    (67.56, 67.56): (55.14, -331.25),
    (58.33, 55.0): (67.20, -408.85),
    (55.0, 55.0): (71.56, -436.42),  # the true optimum; published -437.6 at (58.33, 55)
}


@pytest.fixture(scope="module")
def case() -> CoDesignProblem:
    return problem_of(load_case(ROOT / "runs" / "two_mass_paper.toml"))


@pytest.mark.parametrize("theta", OURS)
def test_the_shipped_case_has_the_reported_bandwidths(
    case: CoDesignProblem, theta: tuple[float, float]
) -> None:
    found = true_inner(case, theta)
    bandwidth, J = OURS[theta]
    assert found.bandwidth / HZ == pytest.approx(bandwidth, abs=0.02)
    assert "S_max" in found.active
    if J is not None:
        ours = case.w1 * sum(theta) + case.w2 * found.bandwidth
        assert ours == pytest.approx(J, abs=0.1)


def test_every_published_figure_is_within_the_reported_residual(case: CoDesignProblem) -> None:
    S_hi, T = case.inner.omega_S[1] / HZ, np.array(case.inner.omega_T) / HZ
    setting = study.Setting(case.inner.S_max, T[0], T[1], S_hi, case.inner.gamma_backoff)
    figures = study.figures(case, setting)
    assert len(figures) == 8
    residuals = {key: ours / published - 1.0 for key, (ours, published) in figures.items()}
    assert max(map(abs, residuals.values())) == pytest.approx(0.0678, abs=5e-4)
    assert residuals["A bandwidth"] == pytest.approx(0.0634, abs=5e-4)
    assert residuals["B bandwidth"] == pytest.approx(-0.0678, abs=5e-4)
    assert residuals["co-design J"] == pytest.approx(-0.0657, abs=5e-4)
    # With the co-design's omega_S in a range of its own all eight come within 0.7 % (0.4 % with the
    # suspension in the loop, on which this setting was found).
    own = study.Setting(2.596, 54.4, 1000.0, 825.0, 1.02, 1748.8)
    values = study.figures(case, own).values()
    assert max(abs(ours / published - 1.0) for ours, published in values) < 0.0075
