"""Lists of values with a fixed structure: one search seeds the next, and everything is counted."""

from dataclasses import replace
from pathlib import Path

import pytest
from oracles.kinds import PID, quick

from ccd_casadi.codesign import stored_searches, structured_lists
from ccd_casadi.codesign.catalogue import restricted
from ccd_casadi.codesign.formulations import Direct
from ccd_casadi.codesign.lifted import Lifted
from ccd_casadi.codesign.run import co_design
from ccd_casadi.codesign.structured_lists import ListedStructured
from ccd_casadi.codesign.verified import Solution
from ccd_casadi.inner_problem import structured_search
from ccd_casadi.inner_problem.problem import CoDesignProblem
from ccd_casadi.inner_problem.structured_problem import Uncertainty, structured_of
from ccd_casadi.sampling.sampler import Sampler
from ccd_casadi.sampling.store import SampleStore
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.process_pool import Workers

VALUES = (58.0, 59.5, 60.5, 61.0, 62.0)


def listed(**changes: object) -> CoDesignProblem:
    case = quick(replace(PID, uncertainty=Uncertainty(), starts=2))
    case = replace(case, lower=(58.0, 58.0), upper=(62.0, 62.0), start=(60.5, 60.0))
    return replace(case, listed=(("m1", VALUES),), **changes)  # type: ignore[arg-type]


# The lightest is the best; then with the ends and the best beside it each on its own.
@pytest.mark.slow
@pytest.mark.parametrize(
    ("w2", "beside"), [(-0.995, ()), (-0.1, (0, -1))]
)
def test_one_search_seeds_the_next_and_all_is_counted(
    w2: float, beside: tuple[int, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    races = []
    for module in (stored_searches, structured_search):
        honest = module.search_starts

        def counted(*arguments: object, honest: object = honest, **more: object) -> object:
            races.append(arguments)
            return honest(*arguments, **more)  # type: ignore[operator]

        monkeypatch.setattr(module, "search_starts", counted)
    case = listed(w2=w2)
    with Workers(1) as pool, SampleStore(tmp_path / "s.sqlite") as store:
        sampler = Sampler(case, store, pool)
        found = co_design(sampler, Lifted(points=4), 0)
        result, lists = found.result, found.result["listed"]
        assert result["status"] == "verified", result["reason"]
        # At the start and the end of the first search, and at the end of the one that is judged.
        assert lists["judged"] == 1
        assert len(races) <= 3
        assert lists["solved"] + lists["between"] <= lists["combinations"]
        thetas = sum(sampler.spent.by_purpose.values())
        assert result["syntheses"] == sampler.syntheses == thetas > len(races)
        assert len({entry.theta for entry in sampler.trace}) > 4
        for m1 in {result["fixed"]["m1"], *(VALUES[i] for i in beside)} if beside else ():
            alone = Sampler(restricted(case, {"m1": (m1,)}), store, pool)
            other = co_design(alone, Lifted(points=4), 0).result["objective"]
            assert result["objective"] <= other + 1e-4 * abs(other)


@pytest.mark.slow
def test_a_part_is_not_empty_because_no_step_from_nearby_ends_in_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Then a few starts are tried there."""
    honest = structured_lists._climbed

    def lost(sampler: Sampler, theta: Array) -> Solution:
        near_by = not structured_of(sampler.problem).starts
        return structured_lists._nothing("lost") if near_by else honest(sampler, theta)

    case = listed(w2=-0.995)
    with Workers(1) as pool, SampleStore(tmp_path / "s.sqlite") as store:
        search = ListedStructured(Direct(starts=1), 0, lambda _: pytest.fail("no judge here"))
        first = search.search(Sampler(restricted(case, {"m1": VALUES[:1]}), store, pool), None)
        monkeypatch.setattr(structured_lists, "_climbed", lost)
        other = Sampler(restricted(case, {"m1": VALUES[-1:]}), store, pool)
        found = search.search(other, first)
    assert found.result["status"] == "searched"
    assert found.problem is not None
    assert found.problem.source.held["m1"] == VALUES[-1]
