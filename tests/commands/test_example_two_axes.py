"""The beam of the examples: one axis tighter than the other, as docs and README tell it."""

import tomllib
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from ccd_casadi.cases.case import parse_case
from ccd_casadi.cases.case_problem import problem_of
from ccd_casadi.codesign.optimality import theta_kkt
from ccd_casadi.codesign.structured_entries import active_of, design_dict
from ccd_casadi.deployment import Timing
from ccd_casadi.deployment.pipeline import require_own_bounds
from ccd_casadi.fixed_structure.design import SectionsDesign
from ccd_casadi.fixed_structure.local_search import Envelope
from ccd_casadi.inner_problem.problem import CoDesignProblem
from ccd_casadi.inner_problem.structured_bandwidth import structured_value
from ccd_casadi.inner_problem.structured_search import prepare_search
from ccd_casadi.lti.loop import Sampling
from ccd_casadi.reporting.facts import channel_words
from ccd_casadi.sampling.inner_samples import InnerSample
from ccd_casadi.support.errors import UserError

ROOT = Path(__file__).parents[2]
CASE = ROOT / "examples" / "two_axes" / "case.toml"
README = CASE.with_name("README.md").read_text()


def case(tilt: dict[str, float] | None = None) -> dict[str, Any]:
    """The example's tables, with other bounds of the tilt."""
    data = tomllib.loads(CASE.read_text())
    if tilt is not None:
        data["controller"]["channel"]["tilt"] = {"outputs": [1, -1]} | tilt
    return data


@cache
def as_shipped() -> tuple[CoDesignProblem, SectionsDesign]:
    return prepare_search(problem_of(parse_case(case(), CASE)))[:2]


def test_the_figures_of_the_readme() -> None:
    problem, made = as_shipped()
    assert made.certified
    found = design_dict(problem, problem.start, made)
    own = found["channel_bounds"][0]
    figures = found["bandwidth_hz"], own["bandwidth_hz"]
    shown = f"{figures[0]:.2f} Hz", f"{figures[1]:.1f} Hz"
    assert found["sensitivity_peak"] <= 1.9
    assert shown[0] in README
    assert shown[1] in README
    assert own["S_max"] == 1.5
    assert "(S_max 1.5)" in channel_words(own)
    assert "(at least 1.25 ω_b)" in channel_words(own)
    assert "S_max of channel tilt" in active_of(made)


def test_where_two_channels_are_equally_fast_both_gradients_count() -> None:
    """ω_b*(h) is the least of two: an optimum at their kink is seen to be one."""
    problem = as_shipped()[0]

    def at(h: float) -> tuple[InnerSample, Envelope | None]:
        value = structured_value(problem, (h,))
        own = InnerSample((h,), value.bandwidth, value.gradient, np.nan, np.nan, (), "", 0.0, 1)
        return own, value.envelope

    def meeting(first: InnerSample, second: InnerSample) -> float:
        """Where the tangents of both sides cross."""
        (a,), (b,) = first.theta, second.theta
        (down,), (up,) = first.gradient, second.gradient
        return (first.bandwidth - second.bandwidth + up * b - down * a) / (up - down)

    (thin, _), (thick, _) = at(0.0185), at(0.0215)
    assert thin.gradient[0] > 0.0 > thick.gradient[0]
    while thick.theta[0] - thin.theta[0] > 2e-5:
        middle = at(0.5 * (thin.theta[0] + thick.theta[0]))[0]
        thin, thick = (middle, thick) if middle.gradient[0] > 0.0 else (thin, middle)
    close, near = (thin, thick), thin.theta[0]
    kink, envelope = at(meeting(*close))
    assert kink.bandwidth > max(one.bandwidth for one in (thin, thick, *close)) * (1.0 - 1e-9)
    assert theta_kkt(problem, kink, None, envelope).stationarity < 1e-5
    assert theta_kkt(problem, kink).stationarity > 0.1  # one side's gradient alone
    beside, other = at(near + 1e-4)
    assert theta_kkt(problem, beside, None, other).stationarity > 0.1
    dearer = replace(problem, w1=1e3 * problem.w1)  # no balance of the two makes up for that
    assert theta_kkt(dearer, kink, None, envelope).stationarity > 0.9


def test_what_is_judged_as_designed_is_deployed_as_designed() -> None:
    run: Any = SimpleNamespace(folder=CASE.parent, problem=problem_of(parse_case(case(), CASE)))
    designed = Sampling(8000.0, 100.0)
    require_own_bounds(run, designed, Timing())
    require_own_bounds(run, designed, Timing(rate_hz=8000.0, delay=designed.delay))
    for loop, timing in ((None, Timing()), (designed, Timing(rate_hz=4000.0)),
                         (designed, Timing(delay=2e-4))):  # fmt: skip
        with pytest.raises(UserError, match="bounds of their own"):
            require_own_bounds(run, loop, timing)
    plain = parse_case(case({}), CASE)
    require_own_bounds(SimpleNamespace(folder=CASE.parent, problem=problem_of(plain)), None,
                        Timing())  # fmt: skip
