"""A small case of every kind of inner problem: of contract and golden values."""

from dataclasses import replace

from helpers import problem
from test_structured_codesign import PID, quick
from test_structured_error import least

from ccd_casadi.inner_problem.problem import CoDesignProblem
from ccd_casadi.inner_problem.structured_problem import Uncertainty


def kinds() -> dict[str, CoDesignProblem]:
    """Case study 1 around (60, 60) kg; sections with a PID from two starts."""
    small = {"lower": (58.0, 58.0), "upper": (62.0, 62.0), "start": (60.0, 60.0)}
    mixed = problem(**small)
    sections = quick(replace(PID, uncertainty=Uncertainty(), starts=2))
    return {
        "mixed": mixed,
        "disturbance": replace(mixed, weights=replace(mixed.weights, disturbance=2e8)),
        "sections": replace(sections, **small),
        "error": least(),
    }
