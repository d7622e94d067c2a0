"""No figure of a run's verdict denies another: whole small co-designs, whatever is drawn."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from oracles.contradictions import contradictions
from oracles.helpers import problem

from ccd_casadi.cases.case import load_case
from ccd_casadi.cases.case_problem import problem_of
from ccd_casadi.codesign.formulations import Direct, Lifted
from ccd_casadi.codesign.nested import Nested
from ccd_casadi.codesign.run import solve
from ccd_casadi.fixed_structure.structure import Structure
from ccd_casadi.inner_problem.controller_problem import RobustSet
from ccd_casadi.inner_problem.problem import CoDesignProblem
from ccd_casadi.inner_problem.structured_problem import StructuredProblem, Uncertainty
from ccd_casadi.lti.loop import Sampling


def boxed(case: CoDesignProblem, rng: np.random.Generator) -> CoDesignProblem:
    """In a small box of θ, with bounds of its own."""
    low = rng.uniform(55.0, 66.0, 2)
    high = low + rng.uniform(0.5, 4.0)
    inner = replace(case.inner, S_max=float(rng.uniform(1.5, 2.5)), S_low=0.2)
    start = tuple(map(float, 0.5 * (low + high)))
    lower, upper = tuple(map(float, low)), tuple(map(float, high))
    return replace(case, lower=lower, upper=upper, start=start, inner=inner)


@pytest.mark.slow
@pytest.mark.parametrize("formulation", ["nested", "lifted", "direct"])
def test_case_study_1_agrees_with_itself(solved: Callable[[str], Path], formulation: str) -> None:
    folder = solved(formulation)
    result = json.loads((folder / "result.json").read_text())
    assert contradictions(result, problem_of(load_case(folder / "case.toml"))) == []


@pytest.mark.parametrize("seed", [*(pytest.param(s, marks=pytest.mark.slow) for s in (0, 2)), 1])
def test_mixed_sensitivity_agrees_with_itself(seed: int) -> None:
    """Without a set, with one that is kept, and with one that may not be."""
    rng = np.random.default_rng(seed)
    robust = None
    if seed:
        shift = float(rng.uniform(0.001, 0.02))
        robust = RobustSet(shift, 3, ((), (0.7, 1.5))[seed % 2], -shift)
    case = boxed(problem(robust=robust), rng)
    way = (Lifted(points=20, box_points=2, max_refinements=3), Direct(starts=1, box_points=0))
    result = solve(case, way[seed % 2], seed=seed).result
    assert contradictions(json.loads(json.dumps(result)), case) == []


@pytest.mark.slow  # CI has the run of test_structured_commands
@pytest.mark.parametrize("seed", range(3))
def test_sections_agree_with_themselves(seed: int) -> None:
    rng = np.random.default_rng(seed)
    shift = float(rng.uniform(0.0, 0.05))
    uncertainty = (Uncertainty(), Uncertainty(shift), Uncertainty(shift, damping=(0.5, 2.0)))
    sections = StructuredProblem(
        structure=Structure(biquads=0),
        weighted_level=float(rng.uniform(8.0, 12.0)),
        sampling=Sampling(4000.0, float(rng.uniform(0.0, 200.0))) if seed % 2 else None,
        uncertainty=uncertainty[seed],
        starts=2,
    )
    case = boxed(problem(controller=sections), rng)
    upper = tuple(low + 0.05 for low in case.lower)
    case = replace(case, upper=upper, start=case.lower)
    result = solve(case, Nested(plan="sobol", points=3, max_refinements=1), seed=seed).result
    assert contradictions(json.loads(json.dumps(result)), case) == []


def test_a_contradiction_is_found(solved: Callable[[str], Path]) -> None:
    """Each of these figures, changed alone, denies another."""
    folder = solved("lifted")
    case = problem_of(load_case(folder / "case.toml"))
    text = (folder / "result.json").read_text()
    for path, value in (
        (("status",), "not_verified"),
        (("checks", "optimality"), False),
        (("verdict", "certified", "state"), "failed"),
        (("kkt", "stationarity"), 0.1),
        (("certificate", "norm"), 1e3),
        (("spent", "polish"), 7),
        (("verdict", "survives", "S_max_shift"), [-0.4, 0.4]),
        (("verdict", "survives", "modulus_margin"), 0.9),
    ):
        result = json.loads(text)
        inside = result
        for key in path[:-1]:
            inside = inside[key]
        assert inside.get(path[-1]) != value
        inside[path[-1]] = value
        assert contradictions(result, case), path
