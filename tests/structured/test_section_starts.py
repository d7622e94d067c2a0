"""Where the search of fixed structures starts, and what it draws anew."""

from dataclasses import replace

import numpy as np
import pytest
from oracles.fixed_structure_loops import BOUNDS, FAST, loop, plant
from oracles.helpers import HZ, scaled, two_mass

from ccd_casadi.fixed_structure.bounds import Bounds
from ccd_casadi.fixed_structure.certificate import certify
from ccd_casadi.fixed_structure.design import problem_for
from ccd_casadi.fixed_structure.figures import assess
from ccd_casadi.fixed_structure.local_search import Point, ascend
from ccd_casadi.fixed_structure.multi_start import (
    MultiStartOptions,
    at_its_bandwidth,
    reinsert,
    search_from_starts,
    select_distinct,
    start_at,
)
from ccd_casadi.fixed_structure.starts import at_random, by_rules, redraw_section, stabilising
from ccd_casadi.fixed_structure.structure import Structure
from ccd_casadi.plants.plant import Mechanics

SMALL = Structure(biquads=1, roll_off=2)
EASY = replace(BOUNDS, S_max=2.0, compliance_max=None)


def test_a_redrawn_controller_differs_from_its_end_in_one_section() -> None:
    structure = Structure(lead=1, biquads=2, roll_off=2)
    problem = problem_for([plant()], structure, EASY)
    rng = np.random.default_rng(3)
    ends = list(at_random(problem, np.array([0.1, 0.3]), rng))
    names = [" ".join(name.split()[:2]) for name in structure.names]
    sections = ({"biquad 1"}, {"biquad 2"}, {"lead 1", "roll-off 1"})
    fresh = redraw_section(problem, ends, 60, rng)
    moved = [
        {name for name, was, now in zip(names, ends[i % 2], kappa, strict=True) if was != now}
        for i, kappa in enumerate(fresh)
    ]
    assert all(any(change <= section for section in sections) for change in moved)
    assert {frozenset(change) for change in moved} == set(map(frozenset, sections))
    gain = problem_for([plant()], Structure(lead=0, biquads=0, roll_off=0), EASY)
    assert not len(redraw_section(gain, [np.zeros(2)], 5, rng))


def test_starts_lift_the_loop_at_an_anti_resonance() -> None:
    """A collocated plant's dip bounds |S|: without such starts a problem of two masses ended at
    164 Hz, where 214 Hz can be had."""
    K, B, none = 1e7 * np.array([[1.0, -1.0], [-1.0, 1.0]]), np.eye(2)[:, :1], np.zeros((0, 2, 2))
    slopes = (none, none, none, none[..., :1], none[:, :1])
    collocated = Mechanics(np.diag([11.0, 6.0]), 0.0 * K, K, B, B.T, 0.01, slopes)
    problem = problem_for([scaled(collocated, 1e6)], SMALL, EASY)
    v = problem.antiresonances[0]
    dip, below, above = np.abs(problem.first_response(v * np.array([1.0, 0.8, 1.25])))
    assert dip < min(below, above)
    rng = np.random.default_rng(0)
    for starts in (by_rules(problem, np.array([0.3])), at_random(problem, np.full(50, 0.3), rng)):
        size = np.log(np.abs(SMALL.response(starts.T, 1j * v * np.array([[1.0], [0.5], [2.0]]))))
        lifted = size[0] - 0.5 * (size[1] + size[2])  # ln; 1.6 by the rule, the rest 0.2 and less
        assert lifted.max() > 1.0


def test_what_is_redrawn_never_loses_what_was_found() -> None:
    """A search that is given the ends of another ends with the best of both."""
    problem = problem_for([plant()], Structure(biquads=0), EASY)
    rng = np.random.default_rng(1)
    pool = stabilising(problem, by_rules(problem, np.geomspace(0.05, 0.5, 4)))[:3]
    first = search_from_starts(problem, pool, lambda words: None)
    ends = [end.kappa for end in select_distinct(first, 2)]
    fresh = stabilising(problem, redraw_section(problem, ends, 24, rng))[:3]
    again = search_from_starts(problem, fresh, lambda words: None, before=first)
    assert again[0].merit >= first[0].merit
    assert not any(runner.running for runner in again)
    kept = select_distinct(again, 5)
    assert len(kept) == len({tuple(end.kappa) for end in kept})


def test_a_slow_controller_starts_at_its_own_bandwidth() -> None:
    """A climb from ω₀/10 left an anchor whose bandwidth is below that, and never came back."""
    bounds = Bounds(S_max=2.5, S_low=0.9, omega_low=0.2 * HZ, shape=1.5)
    problem = problem_for([two_mass(60.0, 60.0)], Structure(biquads=0), bounds)
    inside = 0
    for kappa in stabilising(problem, by_rules(problem, np.geomspace(0.01, 0.3, 8))):
        point = start_at(problem, kappa)
        assert np.log(problem.low) <= point.tau <= problem.begin(kappa)
        lowered = point.tau < problem.begin(kappa)
        assert not lowered or point.assessment.violation <= MultiStartOptions.violation
        inside += lowered
    assert inside


@pytest.mark.parametrize("seed", range(6))
def test_a_section_that_is_put_elsewhere_cancels_there(seed: int) -> None:
    """K is that of the end without the biquad; all of it where the pair has cancelled before."""
    problem, one = loop(seed, Structure(lead=1, biquads=1))
    structure = Structure(lead=2, biquads=1)
    names, at = structure.names, problem.box[0, 1] + 2.0 + seed
    kappa = np.insert(one, 4, [at, at])
    if seed % 2:  # the pair's zero is the integrator's
        kappa[[0, 1, 4]] = kappa[0] + kappa[1] - at, at, kappa[1]
    problem = problem_for([plant()], structure, BOUNDS)
    start = Point(kappa, -3.0, assess(problem, kappa, -3.0))
    s = 1j * np.geomspace(1e-3, 30.0, 60)
    moved, without = reinsert(problem, [start])
    whole = structure.response(kappa, s)
    np.testing.assert_allclose(structure.response(moved, s), whole, rtol=1e-9)
    assert (moved != kappa).sum() == 2 + seed % 2
    q = [names.index(f"biquad 1 {root}") for root in ("zeros", "poles")]
    own = [1.0 + 2.0 * np.exp(kappa[i + 1]) * x + x * x for i in q for x in [s / np.exp(kappa[i])]]
    np.testing.assert_allclose(structure.response(without, s), whole * own[1] / own[0], rtol=1e-9)


def test_a_gain_alone_has_nothing_to_put_elsewhere() -> None:
    problem, kappa = loop(0, Structure(False, lead=0, biquads=0, roll_off=0))
    start = Point(kappa, -3.0, assess(problem, kappa, -3.0))
    assert reinsert(problem, [start]).shape == (0, 1)


def test_an_optimum_in_which_a_pair_cancels_is_left() -> None:
    """Two leads are better than one; with the second where it is of no use one is an optimum too.

    So a search ended at 292 Hz where 307 Hz can be had, with an integrator's zero in a lead's pole.
    """
    problem = problem_for([plant()], Structure(lead=1, biquads=0), EASY)
    pool = stabilising(problem, by_rules(problem, np.geomspace(0.05, 0.5, 4)))
    (one, *_) = select_distinct(search_from_starts(problem, pool, lambda words: None), 1)
    more = problem_for([plant()], Structure(lead=2, biquads=0), EASY)
    kappa = np.insert(one.kappa, 4, np.full(2, more.box[0, 1]))
    end = at_its_bandwidth(more, kappa)
    assert end.tau == pytest.approx(one.tau, abs=MultiStartOptions.same)
    (moved,) = reinsert(more, [end])
    start = at_its_bandwidth(more, moved)
    assert start.tau == pytest.approx(one.tau, abs=MultiStartOptions.same)
    better = ascend(more, start, iterations=40).point
    assert better.assessment.violation <= MultiStartOptions.violation
    assert better.tau > one.tau + 5.0 * MultiStartOptions.same


@pytest.mark.parametrize(
    ("shape", "sampling"),
    [(1.5, FAST), *(pytest.param(*each, marks=pytest.mark.slow)
                    for each in ((None, None), (1.5, None), (None, FAST)))],
)  # fmt: skip
def test_the_bandwidth_of_a_controller_is_the_judges(shape: float | None, sampling) -> None:
    """Also where |S| falls again below -3 dB: there one of four was given another, up to 180
    times the judge's."""
    bounds = replace(BOUNDS, shape=shape, weighted_level=None, weights=None, compliance_max=None)
    plants, structure = [plant(-0.02), plant(0.02)], Structure(lead=2)
    problem, rng = problem_for(plants, structure, bounds, sampling), np.random.default_rng(3)
    unit = problem.plants
    drawn = at_random(problem, np.exp(rng.uniform(-4.0, 1.5, 600)), rng)
    for kappa in stabilising(problem, drawn)[:40]:
        K = structure.state_space(structure.in_units(kappa, unit.omega_0, unit.force))
        judged = certify(plants, K, bounds, sampling).bandwidth / unit.omega_0
        assert np.exp(at_its_bandwidth(problem, kappa).tau) == pytest.approx(judged, rel=1e-2)
