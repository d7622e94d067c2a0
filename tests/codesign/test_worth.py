"""`ccd worth`: both designs are true, co-design is no worse, and a full solve gains the same."""

import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from ccd_casadi import HZ, Lifted, load_case, problem_of, solve
from ccd_casadi.extensions.worth import main
from ccd_casadi.extensions.worth import worth_estimate as worth
from ccd_casadi.extensions.worth.worth_estimate import outlook, search_error
from ccd_casadi.fixed_structure.multi_start import BandwidthOptimum
from ccd_casadi.inner_problem.objective import objective_of
from ccd_casadi.inner_problem.problem import box, plant_of, true_inner
from ccd_casadi.plants.plant import hardware_cost
from ccd_casadi.sampling.sampler import Sampler
from ccd_casadi.sampling.store import SampleStore
from ccd_casadi.support.process_pool import Workers
from surrogates import design

TWO_MASS = Path(__file__).parents[2] / "runs" / "two_mass.toml"


@pytest.mark.slow
def test_the_gain_is_that_of_a_full_solve(tmp_path, capsys) -> None:
    assert main([str(TWO_MASS), "--out", str(tmp_path), "--workers", "1"]) == 0
    found = json.loads((tmp_path / "worth.json").read_text())
    said = capsys.readouterr().out
    assert said.startswith(
        "answer        Co-design is worth it, but its design is not to be built as it is "
        "(survives warned): hardware cost -"
    )
    assert {found[name]["survives"]["state"] for name in ("sequential", "co_design")} == {"warned"}
    problem = problem_of(load_case(TWO_MASS))
    old, new = found["sequential"], found["co_design"]
    for each in (old, new):  # the bandwidth is that of the true inner problem
        inner = true_inner(problem, tuple(each["theta"].values()))
        assert inner.bandwidth / HZ == pytest.approx(each["bandwidth_hz"], rel=1e-6)
        assert each["hardware_cost"] == pytest.approx(sum(each["theta"].values()))
    assert found["resonance_met"]
    assert found["first_resonance_hz"] == pytest.approx(250.0, rel=1e-6)  # the case's rule
    solved = solve(problem, Lifted(points=24, box_points=4)).result
    for key, percent in (
        ("hardware_cost", "hardware_cost_percent"),
        ("bandwidth_hz", "bandwidth_percent"),
    ):
        full = 100.0 * (solved[key] / old[key] - 1.0)
        assert found[percent] == pytest.approx(full, abs=3.0)
        low, high = found[f"full_solve_{percent}"]
        assert low - 0.1 <= full <= high + 0.1  # as printed, rounded outwards
    assert found["settled"]
    assert 0.0 <= found["uncertainty_percent"] < 1.0


@pytest.mark.slow
def test_a_round_is_expected_to_gain_less_the_more_true_designs_there_are(tmp_path) -> None:
    """δ covers what the next rounds gain, and falls below what ends them."""
    problem, seed = problem_of(load_case(TWO_MASS)), 0
    with SampleStore(tmp_path / "samples.sqlite") as store:
        sampler = Sampler(problem, store, Workers(1))
        known = sampler.values(design("sobol", *box(problem), 16, seed))
        first = outlook(problem, known, 0.0, seed)
        gained, missed, last = 0.0, 0.0, first
        for _ in range(8):
            known += sampler.values(last.theta)
            missed = np.fmax(0.0, abs(known[-1].value - last.predicted))
            last = outlook(problem, known, missed, seed)
        gained = objective_of(problem, first.best) - objective_of(problem, last.best)
    assert gained > 0.0
    assert abs(problem.w2) * first.delta >= gained
    assert last.delta < 1e-2 * first.delta
    assert last.costs[0] <= hardware_cost(plant_of(problem), last.best.theta) <= last.costs[1]


@pytest.mark.parametrize(
    ("count", "with_plants", "expected"),
    [(1, None, 2.0), (3, None, 0.0), (3, 9.5, 0.5), (1, 9.5, 2.5), (3, np.nan, 10.0)],
)
def test_what_a_search_may_have_missed_is_stated(monkeypatch, count, with_plants, expected) -> None:
    """The next local optimum, where one search alone found the best, and worse plants."""
    ends = SimpleNamespace(local_optima=(BandwidthOptimum(10.0, count), BandwidthOptimum(8.0, 4)))
    searched = SimpleNamespace(design=ends)
    wider = SimpleNamespace(value_from=lambda *at: SimpleNamespace(value=with_plants))
    plants = () if with_plants is None else ((0, (0.03,)),)
    monkeypatch.setattr(worth, "multistart_at", lambda *at: searched)
    monkeypatch.setattr(worth, "value_with_design", lambda *at: searched)
    monkeypatch.setattr(worth.DesignOnBox, "worst", lambda *at: (None, plants))
    monkeypatch.setattr(worth, "with_scenarios", lambda *at: wider)
    best = SimpleNamespace(kappa=(1.0,), theta=(0.1,), value=10.0)
    assert search_error(SimpleNamespace(problem=None), best) == pytest.approx(expected)
    assert search_error(SimpleNamespace(problem=None), SimpleNamespace(kappa=())) == 0.0


def test_a_case_that_it_cannot_count_is_one_line(tmp_path, capsys) -> None:
    listed = TWO_MASS.read_text().replace(
        "lower = 55.0\nupper = 70.0\nstart = 67.56", "values = [55.0, 60.0]", 1
    )
    case = tmp_path / "case.toml"
    case.write_text(listed)
    assert main([str(case), "--out", str(tmp_path / "out")]) == 2
    assert "worth needs a range" in capsys.readouterr().err
