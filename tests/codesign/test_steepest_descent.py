"""The descent of a fixed structure follows and accepts by what J counts."""

from dataclasses import replace
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from oracles.helpers import problem

from ccd_casadi.fixed_structure.design import SectionsDesign
from ccd_casadi.inner_problem.structured_bandwidth import StructuredValue
from ccd_casadi.inner_problem.structured_problem import StructuredProblem
from ccd_casadi.studies import steepest_descent as module
from ccd_casadi.studies.steepest_descent import steepest_descent


@pytest.mark.parametrize("of_error", [False, True])
def test_a_step_is_accepted_by_what_its_gradient_is_of(
    monkeypatch: pytest.MonkeyPatch, of_error: bool
) -> None:
    """A step that lowers the error lowers what the bandwidth falls by: by that none is accepted."""
    best = np.array([70.0, 70.0]) if of_error else np.array([55.0, 55.0])

    def value(_: object, theta: list[float]) -> StructuredValue:
        away = np.array(theta) - best
        size = 1.0 + float(away @ away)
        slope = tuple(2.0 * away * (1.0 if of_error else -1.0))
        known = {"bandwidth": 1000.0 - size} | ({"error": size} if of_error else {})
        design = cast(SectionsDesign, SimpleNamespace(certified=True))
        return StructuredValue(tuple(theta), gradient=slope, design=design, syntheses=1, **known)

    monkeypatch.setattr(module, "structured_value", value)
    case = problem(
        controller=StructuredProblem(minimise="rms_error") if of_error else StructuredProblem(),
        w1=0.0, w2=1.0 if of_error else -1.0,
    )  # fmt: skip
    found = steepest_descent(case, (62.0, 61.0), first_step=0.2)
    values = [item.objective for item in found.iterates]
    assert values == sorted(values, reverse=True)
    assert len(values) > 3
    np.testing.assert_allclose(found.iterates[-1].theta, best, atol=0.5)
    assert values[-1] == pytest.approx(1.0 if of_error else -999.0, abs=0.5)


def test_a_bound_on_the_compliance_is_measured_in_the_sweep() -> None:
    """The best of a sweep keeps it, and a bound that nothing misses changes nothing."""
    free = problem()
    free = replace(free, inner=replace(free.inner, sweep_points=(12, 12)))
    theta = np.array(free.start)
    answers = []
    for case in (free, replace(free, inner=replace(free.inner, compliance_max=1.0))):
        answer, _ = module.baseline_of(case).answer(theta, module.Gradient.TOTAL, None)
        assert answer is not None
        answers.append(answer)
    assert answers[1].bandwidth == pytest.approx(answers[0].bandwidth)
    assert answers[1].design.figures.compliance < 1.0
