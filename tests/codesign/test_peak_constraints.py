"""Local peaks of S as constraints: each stands among the rows once, and none costs a synthesis."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from oracles.helpers import HZ, few, problem

from ccd_casadi.codesign import optimality as kkt
from ccd_casadi.codesign.kinked import descend
from ccd_casadi.codesign.optimality import OTHER_PEAK, TrueDesign, other_peaks
from ccd_casadi.codesign.outer_mixed import MixedOuter
from ccd_casadi.codesign.outer_search import global_check
from ccd_casadi.inner_problem import objective
from ccd_casadi.inner_problem.controller_problem import RobustSet
from ccd_casadi.inner_problem.objective import TrueQuantities
from ccd_casadi.inner_problem.problem import CoDesignProblem, scaled_plant
from ccd_casadi.sampling.sampler import Sampler
from ccd_casadi.sampling.store import SampleStore
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.process_pool import Workers
from ccd_casadi.synthesis import derivatives
from ccd_casadi.synthesis.derivatives import LocalPeak, local_peaks_with_gradients

ROBUST = RobustSet(0.001, 3, (), 0.001)
POINTS = st.tuples(
    st.floats(55.0, 70.0), st.floats(55.0, 70.0), st.floats(200.0, 900.0), st.floats(30.0, 90.0)
)


def at(point: tuple[float, float, float, float]) -> Array:
    return np.array([*point[:2], *np.log(np.array(point[2:]) * HZ)])


@pytest.mark.parametrize("robust", [None, ROBUST])
@few(max_examples=15)
@given(point=POINTS)
def test_every_peak_stands_among_the_rows_once(
    robust: RobustSet | None, point: tuple[float, float, float, float]
) -> None:
    """However high they are, and whichever of some that are equal comes first."""
    case = problem(robust=robust)
    x = at(point)
    design = TrueQuantities(case).at(x)
    if not design.figures.certified:
        return
    assert design.made is not None
    norm = (design.made.worst, design.figures.sensitivity_peak_frequency)
    found = local_peaks_with_gradients(
        scaled_plant(case, tuple(x[:2])),
        case.weights.at(design.figures.omega_S, design.figures.omega_T),
        design,
        gamma_backoff=case.inner.gamma_backoff,
        least=0.9,
    )
    level = design.values[1]

    def places(items: tuple[LocalPeak, ...]) -> list[tuple[int, float]]:
        given = replace(case, inner=replace(case.inner, S_max=float(np.exp(level))))
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(kkt, "local_peaks_with_gradients", lambda *_, **__: items)
            rows = other_peaks(given, x, design, 0.5)
        return sorted((row.member, row.omega) for row in rows if row.name.startswith(OTHER_PEAK))

    equal = tuple(replace(peak, ln_gain=level) for peak in found)
    for order in (equal, equal[::-1]):
        rows = places(order)
        assert len(rows) == len(found) - 1
        assert len(set(rows)) == len(rows)
        own = [omega for member, omega in rows if member == norm[0]]
        assert all(abs(np.log(omega / norm[1])) > 1e-6 for omega in own)


@pytest.mark.parametrize("robust", [None, ROBUST])
def test_a_descent_synthesises_every_design_once(
    robust: RobustSet | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls = []
    real = derivatives.design

    def counted(*arguments: object) -> object:
        calls.append(1)
        return real(*arguments)

    for module in (derivatives, derivatives):
        monkeypatch.setattr(module, "design", counted, raising=False)
    case = problem(robust=robust)
    quantities = TrueQuantities(case)
    start = at((62.0, 64.0, 500.0, 45.0))
    end = descend(quantities, start)
    J = [TrueDesign(quantities, x).objective for x in (start, end)]
    assert J[1] < J[0]
    assert len(calls) == len(quantities.designs)


def test_a_verification_synthesises_every_design_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Polish, verification and the global check over the box ask the same truth."""
    required: list[tuple] = []
    real = objective.true_design

    def counted(problem: CoDesignProblem, *where: Any) -> object:
        required.append(where)
        return real(problem, *where)

    monkeypatch.setattr(objective, "true_design", counted)
    with SampleStore(tmp_path / "s.sqlite") as store:
        sampler = Sampler(problem(), store, Workers(1))
        outer = MixedOuter(sampler)
        end = outer.polish(at((62.0, 64.0, 500.0, 45.0)))
        global_check(outer, end, 4, 0)
        verified = outer.verify(end, 1)
    assert verified.feasible
    assert len(set(required)) == len(required)
