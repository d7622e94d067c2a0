"""The global check over the box: what it looks at, and where local solves start."""

import math
from collections.abc import Callable
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from oracles.helpers import problem

from ccd_casadi.codesign.outer import Outer, Place, PolishedDesign
from ccd_casadi.codesign.outer_problem import GlobalCheck
from ccd_casadi.codesign.outer_search import _starts, global_check
from ccd_casadi.inner_problem.objective import objective_of
from ccd_casadi.inner_problem.problem import CoDesignProblem
from ccd_casadi.sampling.inner_samples import InnerSample
from surrogates import design


def test_local_solves_start_from_more_than_what_beats_its_neighbours() -> None:
    case = problem()
    thetas = design("sobol", np.array(case.lower), np.array(case.upper), 16, 0)
    samples = [
        InnerSample(tuple(theta), 1.0, (0.0, 0.0), 1.0, 1.0, (), "", 0.0, 1)
        for theta in thetas
    ]  # fmt: skip
    values = ((thetas - np.array(case.lower)) ** 2).sum(axis=1)  # one basin, one lowest point
    lowest, others = _starts(case, samples, values, np.array(case.upper))
    starts = [*lowest, *others]
    assert [samples.index(start) for start in starts] == list(np.argsort(values))


def test_the_way_to_one_optimum_is_no_look_at_the_rest_of_the_box() -> None:
    """Where each point is dear the solved ones count, and what they leave open is looked at."""
    case = problem(w1=0.0)
    lower, upper = np.array(case.lower), np.array(case.upper)
    low, high = np.array([0.2, 0.2]), np.array([0.8, 0.8])  # of the box: two optima

    def sample(theta: np.ndarray) -> InnerSample:
        z = (theta - lower) / (upper - lower)
        away = [float(((z - at) ** 2).sum()) for at in (low, high)]
        value = 300.0 + 20.0 * math.exp(-9.0 * away[0]) + 40.0 * math.exp(-9.0 * away[1])
        return InnerSample(tuple(theta), value, (0.0, 0.0), 1.0, 1.0, (), "", 0.0, 1)

    def local_solve(start: InnerSample, _: object) -> Place:
        z = (np.array(start.theta) - lower) / (upper - lower)
        at = min((low, high), key=lambda end: float(np.abs(z - end).max()))
        end = sample(lower + at * (upper - lower))
        return Place(np.array(end.theta), objective_of(case, end), True)

    path = [sample(lower + share * low * (upper - lower)) for share in np.linspace(0.0, 1.0, 9)]
    global_check = examined(case, path, sample, local_solve)
    assert global_check.moved
    assert global_check.x == pytest.approx(lower + high * (upper - lower))
    assert global_check.points <= len(path) + 8


def examined(
    case: CoDesignProblem, path: list, sample: Callable, local_solve: Callable
) -> GlobalCheck:
    """A check from the end of a path, where each point is dear."""
    sampler = SimpleNamespace(
        solved={one.theta: one for one in path},
        values=lambda thetas, _: [sample(theta) for theta in thetas],
    )
    outer = SimpleNamespace(
        problem=case, sampler=sampler, global_check_is_cheap=False, kkt_level=1e-2,
        theta_of=lambda x: x, local_solve=local_solve, promising=lambda thetas, _: thetas,
    )  # fmt: skip
    here, kkt = path[-1], SimpleNamespace(stationarity=0.0)
    end = SimpleNamespace(x=np.array(here.theta), objective=objective_of(case, here), kkt=kkt)
    return global_check(cast(Outer, outer), cast(PolishedDesign, end), 8, 0)


@pytest.mark.parametrize("worse", [0.02, 0.06])
def test_an_end_of_a_range_that_is_little_worse_leads_on(worse: float) -> None:
    """Where each point is dear; not one that is much worse."""
    case = problem(w1=0.0)
    lower, upper = np.array(case.lower), np.array(case.upper)

    def sample(theta: np.ndarray) -> InnerSample:
        value = 300.0 * (1.0 - worse * float(np.abs((theta - lower) / (upper - lower)).max()))
        return InnerSample(tuple(theta), value, (0.0, 0.0), 1.0, 1.0, (), "", 0.0, 1)

    started: list[float] = []

    def local_solve(start: InnerSample, _: object) -> None:
        started.append(max(np.subtract(start.theta, lower) / (upper - lower)))

    examined(case, [sample(lower)], sample, local_solve)
    assert (1.0 in started) == (worse < 0.03)
