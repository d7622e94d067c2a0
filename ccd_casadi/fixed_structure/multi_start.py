"""A multi-start search: local searches by successive halving, and ends continued with one section
moved.

A local search climbs in τ = ln(ω_b/ω₀) over κ, the logarithms of a controller's parameters. Its
merit is τ less a penalty of the violated bounds, so that gains of merit are of ln ω_b.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ccd_casadi.fixed_structure.figures import assess, constraints
from ccd_casadi.fixed_structure.local_search import (
    Ascent,
    LocalSearchOptions,
    Optimality,
    Point,
    ascend,
    optimality,
)
from ccd_casadi.fixed_structure.loop_problem import LoopCurve, LoopProblem, Problem
from ccd_casadi.fixed_structure.structure import ParameterKind
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.process_pool import Pool, results
from ccd_casadi.support.terminal import Log
from ccd_casadi.support.text import number
from ccd_casadi.support.time_budget import ends_early


@dataclass(frozen=True)
class ReinsertionOptions:
    """Numbers of the search for a better place of one section."""

    cancels: float = 0.5  # ln of a zero over a pole: nearer ones cancel
    places: int = 24  # frequencies of the box that are tried
    dampings: tuple[float, ...] = (0.05, 0.2, 0.8)  # of biquads, where the structure allows them
    step: float = 0.3  # ln: how far a pole may move; a light one no further than its half width


def reinsert(
    problem: Problem, ends: Sequence[Point], options: ReinsertionOptions = ReinsertionOptions()
) -> Array:
    """(N, n) controllers like those at the ends, each with one section moved, where it cancels.

    At an end a zero near a pole does little, and a section whose zeros are its poles does nothing,
    wherever it is. So it is taken out and put where it promises most. With the multipliers μ of
    the bounds c(κ, τ) <= 0 that are active, to first order τ grows by -μᵀ(∂c/∂κ) Δκ: a pole that
    moves off its zero by Δκ, of the sign that helps, promises |μᵀ∂c/∂κ| |Δκ|.
    """
    found = [kappa for end in ends for kappa in _reinsert_at(problem, end, options)]
    return np.clip(np.reshape(found, (-1, len(problem.box[0]))), *problem.box)


def _reinsert_at(problem: Problem, end: Point, options: ReinsertionOptions) -> list[Array]:
    """Those of one end: with the zero and pole that are nearest, and with each biquad."""
    step, count = options.step, options.places
    names, kinds, kappa = problem.structure.names, problem.structure.kinds, end.kappa
    if ParameterKind.FREQUENCY not in kinds:
        return []
    # Of an end outside its bounds those that it misses most are active: the largest is moved to 0.
    peaks, over = end.assessment.peaks, end.assessment.violation
    assert peaks is not None
    shifted = replace(end.assessment, peaks=replace(peaks, value=peaks.value - over))
    known = optimality(problem, replace(end, assessment=shifted))
    low, high = problem.box[:, kinds.index(ParameterKind.FREQUENCY)]
    places = np.linspace(low, high, count)
    zeros = [i for i, name in enumerate(names) if name.endswith((" zero", "integrator"))]
    poles = [i for i, name in enumerate(names) if name.endswith((" pole", "roll-off real"))]
    pairs = [(abs(kappa[z] - kappa[p]), z, p) for z in zeros for p in poles]
    apart, z, p = min(pairs, default=(np.inf, 0, 0))
    found: list[Array] = []
    if apart < options.cancels:
        tried = np.tile(kappa, (count, 1))
        tried[:, z] = tried[:, p] = places
        if names[z] == "integrator":  # (s + ω_i)/s: the gain at low frequencies, k ω_i, stays
            tried[:, 0] += kappa[z] - places
        steps = np.full((count, 1), step)
        found.append(_most_promising(problem, end, known, tried, [p], steps))
    for i in range(1, problem.structure.biquads + 1):
        z = names.index(f"biquad {i} zeros")  # and their damping, the poles and theirs
        least = np.exp(problem.box[0, z + 1])
        dampings = np.log(np.unique(np.maximum(options.dampings, least)))
        tried = np.tile(kappa, (count * len(dampings), 1))
        tried[:, z] = tried[:, z + 2] = np.repeat(places, len(dampings))
        tried[:, z + 1] = tried[:, z + 3] = np.tile(dampings, count)
        steps = np.column_stack([np.minimum(np.exp(tried[:, z + 1]), step),
                                 np.full(len(tried), step)])  # fmt: skip
        found.append(_most_promising(problem, end, known, tried, [z + 2, z + 3], steps))
    return found


def _most_promising(
    problem: Problem, end: Point, known: Optimality, tried: Array, poles: list[int], steps: Array
) -> Array:
    """The one of `tried` (N, n) whose `poles`, moved by `steps` (N, poles), promise most."""
    mu = known.multipliers[: len(known.kinds)]
    slopes = [mu @ constraints(problem, kappa, end.tau, known.active).to_kappa[:, poles]
              for kappa in tried]  # fmt: skip
    return tried[np.argmax((np.abs(slopes) * steps).sum(axis=1))]


OF_BANDWIDTH = (LoopCurve.SHAPE, LoopCurve.LEVEL, LoopCurve.CROSSING)  # bounds that move with ω_b


@dataclass(frozen=True)
class MultiStartOptions:
    """Numbers of the multi-start search by successive halving; gains and distances in ln ω_b."""

    rounds: int = 27  # at most
    steps: int = 15  # of a round
    recent: int = 8  # the last steps of a round, which show whether it ended in a crawl
    halvings: tuple[int, ...] = (0, 2, 6)  # rounds after which the better half continues
    kept: int = 6  # searches that are never halved away
    behind: float = 0.1  # the best one, at most, once halving is over
    overtaking: float = 4.0  # times the gain of its last round: what a search may still catch up
    least_gain: float = 1e-4  # along a flat valley many reach one end; a smaller lead is none
    same: float = 2e-3  # bandwidths of one local optimum
    violation: float = 1e-4  # ln of a bound: what the end of a search may exceed it by


@dataclass(frozen=True)
class BandwidthOptimum:
    """A bandwidth that searches reached.

    Attributes
    ----------
    bandwidth : float
        rad/s.
    count : int
        Searches that ran to the end and reached it.
    kappa : tuple of float
        One controller with it.
    """

    bandwidth: float
    count: int
    kappa: tuple[float, ...] = ()


@dataclass(frozen=True)
class SearchRun(Ascent):
    """One search between two rounds; its `evaluations` are those of all rounds.

    Attributes
    ----------
    gained : float
        Merit in the last round; where that ended in a crawl, what a round gains at its rate.
    running : bool
        Whether it continues.
    count : int
        Searches that were merged into it, itself included.
    """

    gained: float = np.inf
    running: bool = True
    count: int = 1

    @property
    def merit(self) -> float:
        """The merit of its point."""
        return self.point.merit()


def search_from_starts(
    problem: LoopProblem,
    pool: Array,
    log: Log,
    workers: Pool | None = None,
    before: Sequence[SearchRun] = (),
    known: int = 0,
    last: bool = True,
    options: MultiStartOptions = MultiStartOptions(),
) -> list[SearchRun]:
    """Run searches from many starts; by and by the worse half ends.

    Parameters
    ----------
    problem : LoopProblem
    pool : array (N, n)
        Starts; the first `known` are controllers that searches have ended with.
    log : callable
        Of words, the progress.
    workers : Pool or None
    before : sequence of SearchRun
        Searches of before, which are in the field too and have to be overtaken.
    known : int
        Of `pool`.
    last : bool
        Whether no multi-start search follows; else one that runs alone and gains little is left
        to it.
    options : MultiStartOptions

    Returns
    -------
    list of SearchRun
        The best first.
    """
    field = list(before)
    field += [SearchRun(at_its_bandwidth(problem, kappa)) for kappa in pool[:known]]
    field += [SearchRun(start_at(problem, kappa)) for kappa in pool[known:]]
    scale = problem.plants.omega_0 / (2.0 * np.pi)
    for turn in range(options.rounds):
        running = [runner for runner in field if runner.running]
        alone = len(running) == 1 and turn > 0 and running[0].gained < options.same
        if not running or (alone and not last):
            break
        if turn > 0 and ends_early("controller search round"):
            break
        others = [runner for runner in field if not runner.running]
        field = others + _climb_all(problem, running, workers, options)
        field = _merge(sorted(field, key=lambda runner: -runner.merit))
        field = _stop_losers(field, turn, options)
        lead, going = field[0].point, sum(runner.running for runner in field)
        over = lead.assessment.violation
        exceeded = f"bounds exceeded by {100.0 * over:.1g} %"
        kept = exceeded if over > options.violation else "within every bound"
        best = f"{number(float(np.exp(lead.tau)) * scale, 4)} Hz, {kept}"
        count = f"round {turn + 1} of {options.rounds}"
        log(f"{best}; {going} of {len(running)} searches continue, {count}")
    return field


def start_at(
    problem: LoopProblem, kappa: Array, *, within: float = MultiStartOptions.violation
) -> Point:
    """A controller at the bandwidth that searches start from; lower if it keeps its bounds there.

    A climb that began above the bandwidth that a controller has would leave it for good; one below
    ω_low is none.
    """
    tau = problem.begin(kappa)
    first = Point(kappa, tau, assess(problem, kappa, tau))
    peaks = first.assessment.peaks
    if peaks is None or not (over := peaks.value > within).any() or (peaks.to_tau[over] <= 0).any():
        return first
    own = at_its_bandwidth(problem, kappa)
    inside = own.assessment.violation <= within and np.log(problem.low) <= own.tau < tau
    return own if inside else first


@dataclass(frozen=True)
class OwnBandwidthOptions:
    """Numbers of the search for the bandwidth that a controller has; τ is a logarithm."""

    steps: int = 16  # of Newton's method, at most
    least_slope: float = 1e-3  # ∂c/∂τ below which -3 dB is touched from below, and not crossed
    furthest: float = 1.0  # in τ: a step at most
    wider: float = 0.1  # in τ: a step where Newton's leads back to where all was met


def at_its_bandwidth(
    problem: LoopProblem,
    kappa: Array,
    tau: float | None = None,
    within: float = MultiStartOptions.violation,
    options: OwnBandwidthOptions = OwnBandwidthOptions(),
) -> Point:
    """Find the largest ω_b that the shape and -3 dB leave a controller by safeguarded Newton steps.

    Of the bounds c(τ) <= 0 that rise with τ the first root is the bandwidth; Newton's step leads to
    the nearest -c/(∂c/∂τ). A climb from a known controller begins there: from below it would first
    make another one of it, and end in another optimum. Where |S| falls again beyond a peak below
    -3 dB Newton's steps may lead away from the crossing, which stays between the ω_b that were met
    and missed: then these are halved.

    Parameters
    ----------
    problem, kappa : LoopProblem, array (n,)
        κ in the problem's units.
    tau : float, optional
        ln(ω_b/ω₀) to begin with; by default `problem.begin`.
    within : float
        ln of a bound, by which it may be exceeded.
    options : OwnBandwidthOptions

    Returns
    -------
    Point
    """
    tau, met, missed = problem.begin(kappa) if tau is None else tau, -np.inf, np.inf
    furthest = options.furthest
    for _ in range(options.steps):
        point = Point(kappa, tau, assess(problem, kappa, tau))
        peaks = point.assessment.peaks
        if peaks is None:
            break
        over = bool((peaks.value[np.isin(peaks.curve, OF_BANDWIDTH)] > within).any())
        rising = peaks.to_tau > options.least_slope
        room = float((-peaks.value[rising] / peaks.to_tau[rising]).min(initial=furthest))
        if abs(room) < within and not over:
            break
        met, missed = (met, tau) if over else (tau, missed)
        tau += float(np.clip(room, -furthest, furthest))
        if not met < tau < missed:  # halved, from within the longest step below what was missed
            below = max(met, missed - 2.0 * furthest)
            tau = 0.5 * (below + missed) if np.isfinite(missed) else met + options.wider
    return point


def count_arrivals(
    runners: Sequence[SearchRun], best: SearchRun, options: MultiStartOptions = MultiStartOptions()
) -> int:
    """Count the searches that reached the bandwidth of the best one, within its bounds."""
    return sum(
        runner.count for runner in runners
        if abs(runner.point.tau - best.point.tau) <= options.same
        and runner.point.assessment.violation <= options.violation
    )  # fmt: skip


def select_ends(
    runners: Sequence[SearchRun], options: MultiStartOptions = MultiStartOptions()
) -> list[SearchRun]:
    """Select the searches whose steps help no longer, and the best `kept`.

    Parameters
    ----------
    runners : sequence of SearchRun
        The best first.
    options : MultiStartOptions

    Returns
    -------
    list of SearchRun
        The best first.
    """
    return [runner for i, runner in enumerate(runners) if runner.done or i < options.kept]


def select_distinct(
    runners: Sequence[SearchRun], count: int, options: MultiStartOptions = MultiStartOptions()
) -> list[Point]:
    """The best `count` ends of unequal bandwidth, those outside the bounds last."""
    found: list[SearchRun] = []
    for runner in select_ends(runners, options):
        if all(abs(runner.point.tau - other.point.tau) > options.same for other in found):
            found.append(runner)
    return [runner.point for runner in found[:count]]


def local_optima(
    problem: LoopProblem, ends: Sequence[SearchRun],
    options: MultiStartOptions = MultiStartOptions(),
) -> tuple[BandwidthOptimum, ...]:  # fmt: skip
    """The distinct bandwidths within the bounds, the largest first."""
    P = problem.plants
    ran = [end for i, end in enumerate(ends) if end.done or i == 0]
    good = [end for end in ran if end.point.assessment.violation <= options.violation]
    found: list[BandwidthOptimum] = []
    for end in sorted(good, key=lambda end: -end.point.tau):
        value = float(np.exp(end.point.tau)) * P.omega_0
        if found and value >= found[-1].bandwidth * (1.0 - options.same):
            found[-1] = replace(found[-1], count=found[-1].count + end.count)
        else:
            kappa = problem.structure.in_units(end.point.kappa, P.omega_0, P.force)
            found.append(BandwidthOptimum(value, end.count, tuple(map(float, kappa))))
    return tuple(found)


def _climb_all(
    problem: LoopProblem, running: Sequence[SearchRun], workers: Pool | None,
    options: MultiStartOptions,
) -> list[SearchRun]:  # fmt: skip
    """All of them some steps further, in their order."""
    tasks = {i: (problem, r.point, r.radius, options) for i, r in enumerate(running)}
    ends = dict(results(workers, _climb, tasks))
    found = []
    for i, runner in enumerate(running):
        end, gained = ends[i]
        spent = runner.evaluations + end.evaluations
        found.append(SearchRun(end.point, end.radius, spent, end.done, gained, not end.done,
                            runner.count))  # fmt: skip
    return found


def _climb(
    problem: LoopProblem, point: Point, radius: float, options: MultiStartOptions
) -> tuple[Ascent, float]:
    """A round of a climb, and what it gained; at the rate of its last steps where these crawl.

    The gain of the whole round would show a crawl a round too late.
    """
    steps, last = options.steps, options.recent
    before = ascend(problem, point, iterations=steps - last, radius=radius)
    if before.done:
        return before, before.point.merit() - point.merit()
    end = ascend(problem, before.point, iterations=last, radius=before.radius)
    recent = steps / last * (end.point.merit() - before.point.merit())
    gained = recent if recent < options.least_gain else end.point.merit() - point.merit()
    return replace(end, evaluations=before.evaluations + end.evaluations), gained


def _merge(field: Sequence[SearchRun]) -> list[SearchRun]:
    """The field, best first, without searches that are where a better one is."""
    kept: list[SearchRun] = []
    merged = LocalSearchOptions.merged
    for runner in field:
        for i, other in enumerate(kept):
            near = abs(runner.point.tau - other.point.tau) <= merged
            if near and np.abs(runner.point.kappa - other.point.kappa).max() <= merged:
                spent = other.evaluations + runner.evaluations
                kept[i] = replace(other, count=other.count + runner.count, evaluations=spent)
                break
        else:
            kept.append(runner)
    return kept


def _stop_losers(
    field: Sequence[SearchRun], turn: int, options: MultiStartOptions
) -> list[SearchRun]:
    """The field, best first, with those stopped that lost, or will not meet the bounds.

    A search has lost if halving cuts it off, or if it is so far behind the best that it would catch
    up only at several times the gain of its last round. The best is spared, and until halving is
    over that one outside its bounds whose bandwidth is the largest, clearly above that of the best:
    its merit is low for its violation, which a climb may remove. A search is hopeless if its
    violation would take several times that gain.
    """
    running = [i for i, runner in enumerate(field) if runner.running]
    most = max(options.kept, len(running) // 2) if turn in options.halvings else len(running)
    lead, found = field[0].merit, list(field)
    outside = [i for i in running if field[i].point.assessment.violation > options.violation
               and field[i].point.tau > field[0].point.tau + options.behind]  # fmt: skip
    fastest = max(outside, key=lambda i: field[i].point.tau, default=0)
    over = turn >= options.halvings[-1]
    spared = (0, 0 if over else fastest)
    for place, i in enumerate(running):
        runner = field[i]
        behind = lead - runner.merit
        lost = place >= most or behind + options.least_gain > options.overtaking * runner.gained
        lost = lost or (over and behind > options.behind)
        missing = LocalSearchOptions.penalty * runner.point.assessment.violation
        hopeless = over and missing > options.overtaking * runner.gained
        if hopeless or (lost and i not in spared):
            found[i] = replace(runner, running=False)
    return found
