"""The largest bandwidth of a fixed structure on a set of plants: starts, search, certificate.

The best end of a multi-start search whose controller passes the judge (`certificate`) is the
design; its bandwidth has gradients to the hardware by the envelope theorem.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import cast

import numpy as np

from ccd_casadi.fixed_structure.bounds import Bounds
from ccd_casadi.fixed_structure.channel_structure import ChannelStructure
from ccd_casadi.fixed_structure.composite import box_of, composite_problem
from ccd_casadi.fixed_structure.figures import assess
from ccd_casadi.fixed_structure.local_search import Point
from ccd_casadi.fixed_structure.loop import plant_set
from ccd_casadi.fixed_structure.loop_problem import FIRST, LoopProblem, Problem
from ccd_casadi.fixed_structure.optimality import Envelope, envelope_of, optimality
from ccd_casadi.fixed_structure.race import SAME, Runner, arrivals, distinct, run_race
from ccd_casadi.fixed_structure.reinsertion import reinserted
from ccd_casadi.fixed_structure.sections_design import (
    MARGIN,
    DesignSearch,
    SectionsDesign,
    in_problem_units,
)
from ccd_casadi.fixed_structure.starts import at_random, by_rules, redrawn, stabilising
from ccd_casadi.fixed_structure.structure import Structure
from ccd_casadi.lti.hold import Sampling
from ccd_casadi.plants.scaling import ScaledPlant
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.process_pool import Pool, results

LOWER_AT_MOST = 1e-3  # relative: what the judge's ω_b may be below the search's
CROSSOVERS = (0.03, 10.0)  # of starts, over ω₀: M_K is about mass times the square of ω_b hoped for
REDRAWS = 2  # searches at most from the best ends, one section of each elsewhere or drawn anew
REDRAWN = 3  # ends
TWICE = 2  # times that the best of a search was found, from starts apart
LEAST_STARTS = 12  # of a search that may go on: two of four may come to one of the lesser optima
AT_ONCE = 16  # controllers that a process looks at
POOL = 12  # random starts tried for stability for each one that is kept


def problem_for(
    plants: Sequence[ScaledPlant],
    structure: Structure | ChannelStructure,
    bounds: Bounds,
    sampling: Sampling | None = None,
    frequencies: tuple[float, float] | None = None,
) -> LoopProblem:
    """The problem in the units of the first plant, of one channel or of several.

    `frequencies` (rad/s) bound those of K's roots; by default 1e-3 ω₀ and 30 times the fastest
    pole of any plant, sampled 2/T at most. The gain lies within a factor 1e6 of M_K.
    """
    if isinstance(structure, ChannelStructure):
        return composite_problem(plants, structure, bounds, sampling, frequencies, MARGIN)
    family = plant_set(plants, sampling)
    box = box_of(structure, family.poles, family.omega_0, sampling, frequencies)
    return Problem(family, structure, bounds, box, MARGIN)


def of_one_channel(search: DesignSearch) -> SectionsDesign:
    """The best of searches from its initial controllers and, unless these are all, from others by
    rules and at random, then from the best ends with one section of each put elsewhere or drawn
    anew; in batches of starts, up to `most_starts`, until the best was found twice."""
    problem, starts, workers = cast(Problem, search.problem), search.starts, search.workers
    rng, names = np.random.default_rng(search.seed), problem.structure.names
    pool = stabilising(problem, np.reshape(search.inside(search.initial), (-1, len(names))))
    known = len(pool)
    if not search.only_initial:
        pool = np.concatenate([pool, _pool(problem, starts, rng, workers)])
    if not len(pool):
        return search.failed()
    last, begun = search.only_initial, len(pool)
    first = run_race(problem, pool, search.tell, workers, known=known, last=last)
    if last:
        return search.concluded(first, begun)
    runners = _reworked(search, problem, first, rng)
    found, batch = arrivals(first, runners[0]) - max(known - 1, 0), 0  # known ones may be alike
    least = min(LEAST_STARTS, search.most_starts)
    while begun < least or (found < TWICE and begun + starts <= search.most_starts):
        batch += 1
        rng = np.random.default_rng((search.seed, batch))
        pool = _pool(problem, starts, rng, workers)
        begun += len(pool)
        before, best = arrivals(runners, runners[0]), runners[0]
        field = run_race(problem, pool, search.tell, workers, runners, last=False)
        if field[0].merit > best.merit + SAME:
            runners = _reworked(search, problem, field, rng)
            found = arrivals(field, runners[0])
        else:
            runners, found = field, found + max(arrivals(field, field[0]) - before, 0)
    return replace(search.concluded(runners, begun), found=found)


def _reworked(
    search: DesignSearch, problem: Problem, runners: list[Runner], rng: np.random.Generator
) -> list[Runner]:
    """Searches from the best ends with one section of each put elsewhere or drawn anew, as often as
    that helps, beside those of before."""
    workers, tried = search.workers, list[Point]()
    for _ in range(REDRAWS):
        best, ends = runners[0].merit, distinct(runners, REDRAWN)
        fresh = [end for end in ends if not any(end is other for other in tried)]
        tried += fresh
        count = max(search.starts // 2, 1)
        moved = stabilising(problem, reinserted(problem, fresh))[:count]
        more, like = count - len(moved), [end.kappa for end in ends]
        drawn = stabilising(problem, redrawn(problem, like, POOL // 2 * more, rng))
        pool = np.concatenate([moved, _nearest(problem, drawn, more, workers)])
        runners = run_race(problem, pool, search.tell, workers, runners, known=len(moved))
        if runners[0].merit < best + SAME:
            break
    return runners


def _pool(problem: Problem, starts: int, rng: np.random.Generator, workers: Pool | None) -> Array:
    """Half by rules, half at random, of those that are stable; the nearest to the bounds of each,
    and the fastest by rule, which none at a modest bandwidth leads to.

    Where none is stable the search for one goes on with slower crossovers.
    """
    low, high = CROSSOVERS
    for _ in range(3):
        rules = stabilising(problem, by_rules(problem, np.geomspace(low, high, 12)))
        draws = np.exp(rng.uniform(np.log(low), np.log(high), POOL * starts))
        random = stabilising(problem, at_random(problem, draws, rng))
        if len(rules) + len(random):
            half = max(starts // 2, 1)
            fastest = rules[-1:] if half > 2 else rules[:0]
            rules = rules[: len(rules) - len(fastest)]
            near = _nearest(problem, rules, half - len(fastest), workers)
            far = _nearest(problem, random, 4 * half, workers)
            chosen = rng.permutation(len(far))[: max(starts - len(near) - len(fastest), half)]
            return np.concatenate([near, fastest, far[chosen]])
        low, high = 0.03 * low, low
    return np.zeros((0, len(problem.structure.names)))


def _nearest(problem: Problem, kappa: Array, count: int, workers: Pool | None) -> Array:
    """The `count` controllers that miss the bounds least at a modest bandwidth."""
    parts = {i: (problem, kappa[i : i + AT_ONCE]) for i in range(0, len(kappa), AT_ONCE)}
    misses = dict(results(workers, _misses, parts))
    return kappa[np.argsort([miss for i in parts for miss in misses[i]])[:count]]


def _misses(problem: Problem, kappa: Array) -> list[float]:
    return [assess(problem, one, FIRST).violation for one in kappa]


def bandwidth_envelope(
    plants: Sequence[ScaledPlant],
    bounds: Bounds,
    design: SectionsDesign,
    sampling: Sampling | None = None,
) -> Envelope | None:
    """The gradients of ω_b*(θ) in rad/s at a design that is optimal on these plants.

    None where a loop is unstable or the point is not stationary to 1e-3. Plants carry dA, dB, dC.
    """
    problem = problem_for(plants, design.structure, bounds, sampling, design.frequencies)
    kappa = in_problem_units(problem, design.kappa)
    tau = float(np.log(design.bandwidth / problem.plants.omega_0))
    point = _at_the_bounds(problem, kappa, tau)
    if not point.assessment.stable:
        return None
    found = optimality(problem, point)
    envelope = envelope_of(problem, kappa, found)
    return None if envelope is None else envelope.times(design.bandwidth)


def _at_the_bounds(problem: LoopProblem, kappa: Array, tau: float) -> Point:
    """The point with the largest ω_b of this κ; the judge's is lower, by its own grid."""
    assessment = assess(problem, kappa, tau)
    peaks = assessment.peaks
    if peaks is not None:
        rising = peaks.to_tau > 0.0
        room = float((-peaks.value[rising] / peaks.to_tau[rising]).min(initial=np.inf))
        if abs(room) < LOWER_AT_MOST:
            tau += room
            assessment = assess(problem, kappa, tau)
    return Point(kappa, tau, assessment)
