"""The plant that a robust controller is made on: all three tried, and ranges from narrower ones."""

from dataclasses import replace

import numpy as np
import pytest
from oracles.helpers import problem

from ccd_casadi.codesign.design_plants import widen
from ccd_casadi.codesign.optimality import TrueDesign
from ccd_casadi.codesign.outer_mixed import remedies, search_words
from ccd_casadi.inner_problem.controller_problem import RobustSet
from ccd_casadi.inner_problem.problem import best_choice, design_choices, true_design, true_inner
from ccd_casadi.inner_problem.sweep import missed_bounds, missed_by, shortfall
from ccd_casadi.sampling.sampler import Sampler
from ccd_casadi.sampling.store import SampleStore
from ccd_casadi.solve import design_plant_lines
from ccd_casadi.support.process_pool import Workers

OPEN = RobustSet(0.02, 3, (), None)
THETA = (57.0, 58.0)


def test_an_open_design_plant_is_three_problems_and_a_given_one_itself() -> None:
    case = problem(robust=OPEN)
    choices = design_choices(case)
    assert [c.robust.design_at for c in choices if c.robust] == ["low", "nominal", "high"]
    assert len({str(c.identity()) for c in (case, *choices)}) == 4
    for fixed in (problem(robust=None), choices[0]):
        assert design_choices(fixed) == (fixed,)
    damping_only = problem(robust=RobustSet(0.0, 1, (0.5,), None))
    assert [c.robust.design_shift for c in design_choices(damping_only) if c.robust] == [0.0]


def test_the_inner_problem_takes_the_best_of_the_three() -> None:
    case = problem(robust=OPEN)
    found = [true_inner(choice, THETA) for choice in design_choices(case)]
    choice, best = best_choice(case, THETA)
    assert best.bandwidth == max(np.nan_to_num(item.bandwidth) for item in found)
    assert best.syntheses == sum(item.syntheses for item in found)
    assert choice in design_choices(case)


def test_one_synthesis_needs_one_design_plant() -> None:
    with pytest.raises(ValueError, match="design_choices"):
        true_design(problem(robust=OPEN), THETA, 100.0, 100.0)


def test_a_range_is_reached_from_the_plant_alone(tmp_path) -> None:  # type: ignore[no-untyped-def]
    """The end keeps S_max on the whole set, which the nominal optimum does not."""
    case = design_choices(problem(robust=OPEN))[0]
    alone = true_inner(replace(case, robust=None), THETA).optimum
    assert alone is not None
    f = alone.figures
    x = np.array([*THETA, np.log(f.omega_S), np.log(f.omega_T)])
    with SampleStore(tmp_path / "s.sqlite") as store, Workers(1, 60.0) as pool:
        sampler = Sampler(case, store, pool)
        assert not TrueDesign(sampler.truth, x).acceptable
        reached, share = widen(sampler, x)
        assert 0.0 < share <= 1.0
        held = replace(case, robust=OPEN.scale(share) if case.robust else None)
        held = replace(held, robust=replace(held.robust, design_shift=-0.02 * share))
        assert TrueDesign(Sampler(held, store, pool).truth, reached).acceptable


@pytest.mark.parametrize("share", [2e-1, 1e-3, 1e-6, 1e-9, 1e-12, 5e-16])
def test_what_is_missed_never_reads_as_met(share: float) -> None:
    for bound in (2.0, 1.75, 0.03):
        words = missed_by(bound * (1.0 + share), bound)
        assert float(words.split()[0]) > bound


def test_a_failed_search_does_not_contradict_itself() -> None:
    """A peak just above S_max is not called the bound, and what is kept is said to be."""
    case = problem()
    row = true_design(case, THETA, 200.0, 200.0).figures
    near = replace(
        row, sensitivity_peak=case.inner.S_max * (1 + 1e-7), sensitivity_low=0.5 * case.inner.S_low
    )
    words = shortfall(case.inner, [near])
    assert "cannot" not in words
    assert f"S_low = {case.inner.S_low:g} is kept" in words
    shown = float(words.split("peak of S ")[1].split()[0])
    assert shown > case.inner.S_max
    assert missed_bounds(case.inner, near)[0].startswith("peak of S")
    assert missed_bounds(case.inner, replace(near, sensitivity_peak=1.2)) == []


def test_a_design_of_unknown_figures_is_not_the_nearest() -> None:
    inner = problem().inner
    row = true_design(problem(), THETA, 200.0, 200.0).figures
    beyond = replace(row, sensitivity_peak=1.1 * inner.S_max)
    unknown = replace(row, sensitivity_peak=np.nan)
    assert shortfall(inner, [unknown, beyond]) == shortfall(inner, [beyond, unknown])
    assert "nan" not in shortfall(inner, [unknown, beyond])


def test_the_words_say_what_was_tried_where_and_what_next() -> None:
    case = problem(robust=OPEN)
    words = search_words(case, 12)
    for part in ("none found", "H-infinity", "its lower end", "its upper end", "+-2 %", "12 theta"):
        assert part in words
    assert "one may exist all the same" in remedies(case, 0.5)
    assert "+-1 %" in remedies(case, 0.5)
    assert "[robust]" not in remedies(problem())


def test_the_terminal_says_which_plant_won_and_what_the_others_came_to() -> None:
    tried = {
        "low": {"status": "not_verified", "objective": 92.05},
        "nominal": {"status": "infeasible"},
        "high": {"status": "verified", "objective": 82.335},
    }
    (line,) = design_plant_lines({"design_at": "high", "tried": tried})
    plain = " ".join(line.split())
    assert plain == "design plant high (low: not verified, J 92.05; nominal: infeasible)"
    assert design_plant_lines({}) == []
