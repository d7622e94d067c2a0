"""Co-design with a fixed structure: a PID with roll-off climbs in a fraction of a second."""

import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from oracles.kinds import PID, quick

from ccd_casadi.codesign import stored_searches
from ccd_casadi.codesign.formulations import Direct, Lifted
from ccd_casadi.codesign.nested import Nested
from ccd_casadi.codesign.outer import pieces_from
from ccd_casadi.codesign.outer_structured import StructuredOuter
from ccd_casadi.codesign.run import solve
from ccd_casadi.fixed_structure.box_proof import Proof, ProofOutcome
from ccd_casadi.fixed_structure.certificate import certify
from ccd_casadi.fixed_structure.design import SectionsDesign
from ccd_casadi.fixed_structure.structure import Structure
from ccd_casadi.inner_problem import structured_bandwidth
from ccd_casadi.inner_problem.problem import CoDesignProblem, true_inner
from ccd_casadi.inner_problem.searched_problem import state_of, with_state
from ccd_casadi.inner_problem.structured_bandwidth import structured_value
from ccd_casadi.inner_problem.structured_plant_set import bounds_of, uncertain_plant
from ccd_casadi.inner_problem.structured_problem import (
    StructuredProblem,
    Uncertainty,
    with_structured,
)
from ccd_casadi.inner_problem.structured_robustness import (
    BoxCheckOptions,
    DesignOnBox,
    certify_corners,
)
from ccd_casadi.inner_problem.structured_search import (
    StructuredSearchOptions,
    prepare_search,
    with_range,
)
from ccd_casadi.lti.loop import Sampling
from ccd_casadi.sampling.sampler import Sampler
from ccd_casadi.sampling.store import SampleStore
from ccd_casadi.support.errors import UserError
from ccd_casadi.support.process_pool import Workers


@pytest.fixture(scope="module")
def anchored() -> CoDesignProblem:
    found, made, _ = prepare_search(quick())
    assert made.certified
    return found


@pytest.mark.parametrize("sampled", [pytest.param(False, marks=pytest.mark.slow), True])
def test_envelope_gradient_is_the_slope_of_the_true_function(
    anchored: CoDesignProblem, sampled: bool
) -> None:
    case = anchored
    if sampled:
        sections = replace(PID, sampling=Sampling(8000.0, 80.0))
        case = prepare_search(quick(sections))[0]
    theta, h = np.array([61.0, 58.0]), 1e-3
    value = structured_value(case, theta)
    assert value.feasible
    for i in range(2):
        ends = [structured_value(case, theta + sign * h * np.eye(2)[i]) for sign in (1.0, -1.0)]
        numeric = (ends[0].bandwidth - ends[1].bandwidth) / (2.0 * h)
        assert value.gradient[i] == pytest.approx(numeric, rel=1e-4)


def test_the_price_of_a_tolerance_is_what_another_solve_finds(anchored: CoDesignProblem) -> None:
    """Of a set solved again with each tolerance a little wider and narrower."""
    theta, h = anchored.start, 1e-3

    def wider(shift: float = 1.0, damping: float = 1.0, gain: float = 1.0) -> CoDesignProblem:
        own = Uncertainty(
            resonance_shift=0.03 * shift,
            damping=(1.0 - 0.4 * damping, 1.0 + 0.5 * damping),
            gain=0.05 * gain,
        )
        return with_state(with_structured(anchored, uncertainty=own), scenarios=())

    here = structured_value(wider(), theta)
    prices = DesignOnBox(wider(), theta, here.design).tolerance_prices()
    assert list(prices) == ["resonance_shift", "damping", "gain"]
    for name, key in zip(prices, ("shift", "damping", "gain"), strict=True):
        ends = [structured_value(wider(**{key: 1.0 + sign * h}), theta) for sign in (1.0, -1.0)]
        numeric = (ends[0].bandwidth - ends[1].bandwidth) / (2.0 * h)
        assert prices[name] == pytest.approx(numeric, rel=1e-2, abs=1e-4 * here.bandwidth)
    assert min(prices.values()) < -1e-2 * here.bandwidth
    alone = with_structured(anchored, uncertainty=Uncertainty())
    assert DesignOnBox(alone, theta, here.design).tolerance_prices() == {}


def test_a_theta_has_one_value_whoever_asks(anchored: CoDesignProblem, tmp_path: Path) -> None:
    """In any order, by one worker or two, from the store or computed."""
    thetas = np.array([[58.0, 58.0], [66.0, 69.0]])

    def required(order: list[int], workers: int, name: str) -> list[tuple]:
        with Workers(workers) as pool, SampleStore(tmp_path / name) as store:
            found = Sampler(anchored, store, pool).values(thetas[order])
        return [(s.theta, s.bandwidth, s.gradient, s.kappa) for s in found]

    first = required([0, 1], 1, "a.sqlite")
    assert all(np.isfinite(item[1]) for item in first)
    assert required([1, 0], 2, "b.sqlite") == first[::-1]
    assert required([0, 1], 1, "a.sqlite") == first


@pytest.mark.slow
@pytest.mark.parametrize("structure", [PID.structure, Structure(biquads=1)])
def test_three_formulations_agree_and_a_resumed_run_is_the_same(
    structure: Structure, tmp_path: Path
) -> None:
    store = tmp_path / "samples.sqlite"
    sections = replace(PID, structure=structure, uncertainty=Uncertainty(), starts=2)
    case = replace(quick(sections), lower=(58.0, 58.0), upper=(62.0, 62.0))
    nested = solve(case, Nested(plan="sobol", points=4), store=store)
    others = [solve(case, kind, store=store) for kind in (Lifted(points=4), Direct(starts=1))]
    for found in (nested, *others):
        result = found.result
        assert result["status"] == "verified", result["reason"]
        assert result["omega_S_hz"] is None
        assert result["kkt"]["stationarity"] < 1e-4
        survives = result["verdict"]["survives"]
        assert survives["state"] == "warned", "[robust] names no plant"
        assert "stable for resonances" in survives["words"]
        assert survives["stable_shift"][0] <= survives["S_max_shift"][0] <= 0.0
        assert survives["stable_damping"][0] < 1.0 < survives["stable_damping"][1]
        assert survives["unstable_controller_poles_hz"] == []
        assert result["verdict"]["deployable"]["delay_margin"] > 0.0
        assert result["objective"] == pytest.approx(nested.result["objective"], rel=1e-3)
    before = store.stat().st_mtime_ns
    again = solve(case, Nested(plan="sobol", points=4), store=store)
    assert store.stat().st_mtime_ns == before
    for key in ("theta", "objective", "bandwidth_hz", "syntheses", "controller"):
        assert again.result[key] == nested.result[key]


@pytest.mark.slow
def test_the_set_holds_on_the_box_that_it_stands_for(anchored: CoDesignProblem) -> None:
    """The judge on two hundred plants between and beside those that were designed for."""
    theta = anchored.start
    made = structured_value(anchored, theta).design
    on_box = DesignOnBox(anchored, theta, made)
    worst, missing = on_box.worst()
    assert not missing
    assert made.controller is not None
    judged, plants = on_box.on_lattice(worst)
    assert judged.passed
    assert plants > 200
    wild = replace(made.controller, C=1.2 * made.controller.C)
    assert not certify_corners(anchored, theta, wild).passed


def test_plants_that_refute_a_design_join_the_set(
    anchored: CoDesignProblem, tmp_path: Path
) -> None:
    """Of a design for the model alone, judged on the box: each plant exceeds a bound with it, the
    next search knows them, and its design keeps them."""
    theta, options = anchored.start, BoxCheckOptions(lattice=24, added=3)
    scenarios = state_of(anchored).scenarios
    alone = with_state(anchored, scenarios=scenarios[:1])
    made = structured_value(alone, theta).design
    on_box = DesignOnBox(alone, theta, made, options)
    worst = on_box.worst()[0]
    wide, _ = on_box.on_lattice(worst)
    found = on_box.counterexamples(wide, Proof(ProofOutcome.PROVEN, 0.0, ()), worst)
    assert made.certified
    assert not wide.passed
    assert 1 <= len(found) <= options.added
    assert not set(found) & set(scenarios[:1])
    drawn = (0, tuple(0.5 * end for end in found[0][1]))  # by the fresh draws of the yield
    room = DesignOnBox(alone, theta, made, replace(options, added=100))
    proven = Proof(ProofOutcome.PROVEN, 0.0, ())
    ways = ((), (drawn, found[0]))
    every, more = (room.counterexamples(wide, proven, worst, lost) for lost in ways)
    assert more == (*every, drawn)
    uncertain = uncertain_plant(alone, theta)
    for option, point in found:
        plants = uncertain.as_written([(option, np.array(point))])
        assert made.controller is not None
        assert not certify(plants, made.controller, bounds_of(alone), alone.sampling).passed
    verified = SimpleNamespace(counterexamples=found, problem=alone, design=made)
    with Workers(1) as pool, SampleStore(tmp_path / "a.sqlite") as store:
        outer = StructuredOuter(Sampler(alone, store, pool))
        more = outer.add_refuting_plants(verified)  # type: ignore[arg-type]
        assert more is not None
        assert more.repairs == outer.repairs + 1  # so that another lattice judges
        assert state_of(more.problem).scenarios == (*scenarios[:1], *found)
        again = structured_value(more.problem, theta).design
    assert again.certified
    assert again.bandwidth <= made.bandwidth
    assert outer.add_refuting_plants(SimpleNamespace(counterexamples=())) is None  # type: ignore[arg-type]


def test_the_range_of_frequencies_is_that_of_the_start() -> None:
    """Alike at every θ, or ω_b* would move with it where it binds."""
    case = with_range(quick())
    assert isinstance(case.controller, StructuredProblem)
    assert case.controller.frequencies is not None
    assert with_range(replace(case, start=(70.0, 70.0))) == replace(case, start=(70.0, 70.0))


def test_mixed_sensitivity_is_not_answered_for_sections() -> None:
    with pytest.raises(UserError, match="structured_value"):
        true_inner(quick(), (60.0, 60.0))


@pytest.mark.slow
def test_an_impossible_case_says_what_falls_short(tmp_path: Path) -> None:
    case = quick(replace(PID, starts=2))
    case = replace(case, inner=replace(case.inner, S_low=1e-5))
    found = solve(case, Direct(starts=1))
    assert found.result["status"] == "infeasible"
    assert found.result["reason"]


def test_a_search_that_ended_early_goes_on_until_there_is_a_gradient(
    anchored: CoDesignProblem, monkeypatch: pytest.MonkeyPatch
) -> None:
    honest, initial = structured_bandwidth.synthesise_sections, []

    def early(*arguments: Any, **more: Any) -> SectionsDesign:
        made = honest(*arguments, **more)
        initial.append(more["initial"])
        return replace(made, kkt_residual=2.5e-2) if len(initial) == 1 else made

    monkeypatch.setattr(structured_bandwidth, "synthesise_sections", early)
    value = structured_value(anchored, (61.0, 58.0))
    assert value.feasible
    assert np.isfinite(value.gradient).all()
    assert value.design.kkt_residual < 1e-3
    assert (len(initial), value.syntheses) == (2, 2)


def test_a_multi_start_search_is_of_its_own_bounds(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With another S_max in the same folder the anchors and words of the first were taken."""

    def raced(case: CoDesignProblem, *_: object) -> tuple[CoDesignProblem, SimpleNamespace, None]:
        design = SimpleNamespace(certified=False, words=f"none within {case.inner.S_max}")
        return with_state(case, warm_starts=((case.inner.S_max,),)), design, None

    monkeypatch.setattr(stored_searches, "prepare_search", raced)
    case = quick(PID)
    with SampleStore(tmp_path / "samples.sqlite") as store:
        for bound in (1.2, 2.0, 1.2):
            required = replace(case, inner=replace(case.inner, S_max=bound))
            of = Sampler(required, store, Workers(1))
            found, words = stored_searches.with_initial_search(of, 0)
            assert (state_of(found).warm_starts, words) == (
                ((bound,),), f"none within {bound}",
            )  # fmt: skip


def test_a_controller_that_a_search_at_its_theta_found_is_kept_near_by(
    anchored: CoDesignProblem, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where no anchor leads to one: a single search with starts, whatever θ the pieces ask for."""
    honest, searches = structured_bandwidth.ProblemAt.search, []

    def counted(here: Any, initial: Any, starts: Any = None, **rest: Any) -> Any:
        searches.append(starts)
        return honest(here, initial, starts, **rest)

    monkeypatch.setattr(structured_bandwidth.ProblemAt, "search", counted)
    with Workers(1) as pool, SampleStore(tmp_path / "s.sqlite") as store:
        alone = Sampler(with_state(anchored, warm_starts=()), store, pool)
        first = alone.values(np.array(anchored.start))[0]
        best = pieces_from(alone, first, 1e-3, 0.1)
    assert best.value >= first.value * (1.0 - 1e-6)
    assert sum(starts is not None for starts in searches) == 1
    assert len(searches) > 2


@pytest.mark.slow
def test_few_starts_that_miss_are_not_the_last_word() -> None:
    """No search says that it found nothing from fewer starts than the usual number."""
    impossible = with_structured(quick(), weighted_level=1e-3, starts=1)
    made = prepare_search(impossible)[1]
    assert not made.certified
    found = re.match(r"none found from (\d+) starts", made.words)
    assert found is not None
    assert int(found[1]) >= StructuredSearchOptions.least_starts
