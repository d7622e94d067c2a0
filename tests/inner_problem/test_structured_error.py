"""The least RMS error as the inner problem's value: its gradient to θ, and a solve with it."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from oracles.case_documents import TWO_MASS
from oracles.helpers import HZ
from oracles.kinds import CABLES, SLOW, least

from ccd_casadi.budget.sources import ErrorBudget, ShapedSpectrum
from ccd_casadi.cases.case import CaseError, load_case
from ccd_casadi.cases.case_problem import problem_of
from ccd_casadi.codesign.formulations import Direct, Lifted
from ccd_casadi.codesign.nested import Nested
from ccd_casadi.codesign.run import solve
from ccd_casadi.codesign.stored_searches import with_initial_search
from ccd_casadi.inner_problem.objective import objective_of
from ccd_casadi.inner_problem.problem import CoDesignProblem
from ccd_casadi.inner_problem.searched_problem import state_of, with_state
from ccd_casadi.inner_problem.structured_bandwidth import require_bandwidth, structured_value
from ccd_casadi.inner_problem.structured_problem import StructuredProblem, with_structured
from ccd_casadi.lti.loop import Sampling
from ccd_casadi.sampling.inner_samples import InnerSample
from ccd_casadi.sampling.sampler import Sampler
from ccd_casadi.sampling.store import SampleStore
from ccd_casadi.support.errors import UserError
from ccd_casadi.support.process_pool import Workers
from surrogates.retrain import main as retrain


def anchored(case: CoDesignProblem, folder: Path) -> CoDesignProblem:
    with SampleStore(folder / "anchors.sqlite") as store:
        sampler = Sampler(case, store, Workers(1))
        found, words = with_initial_search(sampler, 0)
        assert not words
        assert with_initial_search(sampler, 0) == (found, "")
    return found


@pytest.mark.parametrize(
    "sampling", [None, pytest.param(Sampling(8000.0, 80.0), marks=pytest.mark.slow)]
)
def test_the_gradient_is_the_slope_of_the_least_error(
    sampling: Sampling | None, tmp_path: Path
) -> None:
    case = anchored(least(sampling), tmp_path)
    assert isinstance(case.controller, StructuredProblem)
    assert state_of(case).error_warm_starts
    theta, h = np.array([61.0, 59.0]), 0.05
    value = structured_value(case, theta)
    assert value.feasible
    assert value.bandwidth >= SLOW * (1.0 - 1e-5)
    way = np.array([0.8, 0.6])
    ends = [structured_value(case, theta + sign * h * way) for sign in (1.0, -1.0)]
    numeric = (ends[0].error - ends[1].error) / (2.0 * h)
    assert np.array(value.gradient) @ way == pytest.approx(numeric, rel=1e-4)
    # where the controllers of most bandwidth are not stable those of least error begin the search
    unstable = tuple(tuple(k + 40.0 for k in kappa) for kappa in state_of(case).warm_starts)
    lost = with_state(with_structured(case, starts=0), warm_starts=unstable)
    again = structured_value(lost, theta)
    assert again.error == pytest.approx(value.error, rel=1e-3)


@pytest.mark.slow
def test_a_solve_counts_the_error(tmp_path: Path) -> None:
    """All three at the same θ; J = w1 f + w2 e; the answer says so wherever it is shown."""
    case, store = least(), tmp_path / "samples.sqlite"
    kinds = (Direct(starts=1), Lifted(points=4), Nested(points=3))
    found = [solve(case, kind, store=store).result for kind in kinds]
    for result in found:
        assert result["status"] == "verified", result["reason"]
        assert result["minimise"] == "rms_error"
        assert result["surrogate_bandwidth_hz"] is None
        e, f = result["error_rms_of_set"], result["hardware_cost"]
        assert result["objective"] == pytest.approx(case.w1 * f + case.w2 * e, rel=1e-12)
        assert result["bandwidth_hz"] >= 8.0 * (1.0 - 1e-5)
        assert re.search(r"\d nm", result["verdict"]["optimal"]["words"])
        # the budget's own figure, on the one plant that there is
        assert result["budget"]["error_rms_largest"] == pytest.approx(e, rel=1e-6)
    for result in found[1:]:
        assert result["objective"] == pytest.approx(found[0]["objective"], rel=1e-4)
        # the surrogate is of the error: what it says of the design is what was found there
        assert result["surrogate_error_rms"] == pytest.approx(result["error_rms_of_set"], rel=1e-3)


def test_too_much_bandwidth_is_said(tmp_path: Path) -> None:
    case = least(bandwidth_least=500.0 * HZ)
    found = solve(case, Direct(starts=1), store=tmp_path / "samples.sqlite").result
    assert found["status"] == "infeasible"
    assert "bandwidth_least_hz requires 500 Hz" in found["reason"]


def test_j_counts_the_error_where_a_sample_has_one() -> None:
    case = least()
    sample = InnerSample((60.0, 61.0), 50.0, (0.0, 0.0), np.nan, np.nan, (), "", 0.0, 1)
    assert sample.value == 50.0
    assert objective_of(case, replace(sample, error=2e-7)) == pytest.approx(0.01 * 121.0 + 0.2)


def written(folder: Path, w2: str, inner: str = 'minimise = "rms_error"') -> Path:
    text = TWO_MASS.read_text().replace("w2 = -0.9950", f"w2 = {w2}")
    added = '[controller]\nstructure = "sections"\n[budget.force]\nunit = "N/rtHz"\nlevel = 0.01\n'
    path = folder / "case.toml"
    path.write_text(text.replace("[inner]", f"[inner]\n{inner}") + "\n" + added)
    return path


def test_the_sign_of_w2(tmp_path: Path) -> None:
    assert problem_of(load_case(written(tmp_path, "1e6"))).w2 == 1e6
    with pytest.raises(CaseError, match=r"objective\.w2: is 1.*J must reward bandwidth"):
        load_case(written(tmp_path, "1e6", ""))
    with pytest.raises(CaseError, match=r"objective\.w2: is 0.*J counts the RMS error"):
        load_case(written(tmp_path, "0.0"))
    # as before for `inner`; a solve would reward the error
    rewarding = problem_of(load_case(written(tmp_path, "-0.9950")))
    with pytest.raises(UserError, match="give a positive number"):
        solve(rewarding, Direct(starts=1))
    with pytest.raises(UserError, match="insight counts the bandwidth"):
        require_bandwidth(rewarding, "insight")


def test_the_budget_is_part_of_what_a_sample_is() -> None:
    case = least()
    sources = tuple(replace(s, spectrum=ShapedSpectrum(1e-9)) for s in CABLES.sources)
    quieter = replace(case, budget=ErrorBudget(sources))
    assert case.identity() != quieter.identity()
    plain = least(minimise="bandwidth")
    assert plain.identity() == replace(plain, budget=quieter.budget).identity()


@pytest.mark.slow
def test_retraining_counts_the_error(tmp_path: Path) -> None:
    """It was refused: J of a sample and of a surrogate is that of what the case minimises."""
    case = written(tmp_path, "1e6", 'minimise = "rms_error"\nbandwidth_least_hz = 12.0')
    narrow = case.read_text().replace("lower = 55.0", "lower = 58.0").replace("67.56", "60.0")
    narrow = narrow.replace("upper = 70.0", "upper = 62.0")
    case.write_text(narrow.replace('"sections"\n', '"sections"\nstarts = 2\n'))
    assert retrain([str(tmp_path), "--budget", "14", "--workers", "1", "--quiet"]) == 0
    found = json.loads((tmp_path / "result.json").read_text())
    cost, error = found["hardware_cost"], found["error_rms_of_set"]
    assert found["objective"] == pytest.approx(0.0995 * cost + 1e6 * error, rel=1e-9)
    assert found["minimise"] == "rms_error"
    assert found["verification_error"] <= 1e-3
