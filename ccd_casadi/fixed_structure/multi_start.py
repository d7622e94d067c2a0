"""A multi-start search: local searches by successive halving, and ends continued with one section
moved."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ccd_casadi.fixed_structure.figures import assess, constraints
from ccd_casadi.fixed_structure.local_search import (
    MERGED,
    PENALTY,
    Ascent,
    Optimality,
    Point,
    ascend,
    optimality,
)
from ccd_casadi.fixed_structure.loop_problem import LoopCurve, LoopProblem, Problem
from ccd_casadi.fixed_structure.structure import Kind
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.process_pool import Pool, results
from ccd_casadi.support.terminal import Tell
from ccd_casadi.support.text import number

CANCELS = 0.5  # ln of a zero over a pole: nearer ones are taken out
PLACES = 24  # frequencies of the box that are tried
DAMPINGS = (0.05, 0.2, 0.8)  # of biquads, where the structure allows them
STEP = 0.3  # ln: how far a pole may move; a lightly damped one no further than its half width


def reinserted(problem: Problem, ends: Sequence[Point]) -> Array:
    """(N, n) controllers like those at the ends, each with one section that cancels."""
    found = [kappa for end in ends for kappa in _of_one(problem, end)]
    return np.clip(np.reshape(found, (-1, len(problem.box[0]))), *problem.box)


def _of_one(problem: Problem, end: Point) -> list[Array]:
    names, kinds, kappa = problem.structure.names, problem.structure.kinds, end.kappa
    if Kind.FREQUENCY not in kinds:
        return []
    # Of an end outside its bounds those count that it misses most.
    peaks, over = end.assessment.peaks, end.assessment.violation
    assert peaks is not None
    shifted = replace(end.assessment, peaks=replace(peaks, value=peaks.value - over))
    known = optimality(problem, replace(end, assessment=shifted))
    low, high = problem.box[:, kinds.index(Kind.FREQUENCY)]
    places = np.linspace(low, high, PLACES)
    zeros = [i for i, name in enumerate(names) if name.endswith((" zero", "integrator"))]
    poles = [i for i, name in enumerate(names) if name.endswith((" pole", "roll-off real"))]
    pairs = [(abs(kappa[z] - kappa[p]), z, p) for z in zeros for p in poles]
    found: list[Array] = []
    if pairs and min(pairs)[0] < CANCELS:
        _, z, p = min(pairs)
        tried = np.tile(kappa, (PLACES, 1))
        tried[:, z] = tried[:, p] = places
        if names[z] == "integrator":  # k ω_i stays
            tried[:, 0] += kappa[z] - places
        found.append(_best(problem, end, known, tried, [p], np.full((PLACES, 1), STEP)))
    for i in range(1, problem.structure.biquads + 1):
        z = names.index(f"biquad {i} zeros")
        least = np.exp(problem.box[0, z + 1])
        dampings = np.log(np.unique(np.maximum(DAMPINGS, least)))
        tried = np.tile(kappa, (PLACES * len(dampings), 1))
        tried[:, z] = tried[:, z + 2] = np.repeat(places, len(dampings))
        tried[:, z + 1] = tried[:, z + 3] = np.tile(dampings, PLACES)
        steps = np.column_stack([np.minimum(np.exp(tried[:, z + 1]), STEP),
                                 np.full(len(tried), STEP)])  # fmt: skip
        found.append(_best(problem, end, known, tried, [z + 2, z + 3], steps))
    return found


def _best(
    problem: Problem, end: Point, known: Optimality, tried: Array, poles: list[int], steps: Array
) -> Array:
    """The one of `tried` (N, n) whose `poles`, moved by `steps`, promise most."""
    mu = known.multipliers[: len(known.kinds)]
    slopes = [mu @ constraints(problem, kappa, end.tau, known.active).to_kappa[:, poles]
              for kappa in tried]  # fmt: skip
    return tried[np.argmax((np.abs(slopes) * steps).sum(axis=1))]


ROUNDS, STEPS = 27, 15  # at most, steps of each
RECENT = 8  # the last steps of a round, which show whether it ended in a crawl
HALVINGS = (0, 2, 6)  # rounds after which the better half goes on
LAST = 6  # that are never halved away
BEHIND = 0.1  # in ln ω_b: no further behind the best one once halving is over
OVERTAKING = 4.0  # times the gain of its last round: what a search behind may still catch up
WORTH = 1e-4  # in ln ω_b: along a flat valley many come to one end; to be ahead by less is nothing
SAME = 2e-3  # relative: bandwidths of one local optimum
NEWTON = 16  # steps at most to the bandwidth of a controller
TOUCHES = 1e-3  # slope to τ below which -3 dB is touched from below, and not crossed
OF_BANDWIDTH = (LoopCurve.SHAPE, LoopCurve.LEVEL, LoopCurve.CROSSING)
WITHIN = 1e-4  # ln: a violation that the end of a search may have


@dataclass(frozen=True)
class LocalOptimum:
    """A bandwidth (rad/s) that `count` of the searches that ran to the end reached, with one κ."""

    bandwidth: float
    count: int
    kappa: tuple[float, ...] = ()


@dataclass(frozen=True)
class Runner(Ascent):
    """One search: where it is, with the loops looked at in all, and what its last round gained,
    or where that ended in a crawl gains at this rate.

    `running`: it goes on. `count`: searches that it stands for.
    """

    gained: float = np.inf
    running: bool = True
    count: int = 1

    @property
    def merit(self) -> float:
        """That of its point."""
        return self.point.merit()


def run_race(
    problem: LoopProblem,
    pool: Array,
    tell: Tell,
    workers: Pool | None = None,
    before: Sequence[Runner] = (),
    known: int = 0,
    last: bool = True,
) -> list[Runner]:
    """All searches from the starts `pool` (N, n), the best first.

    The first `known` of these are controllers that searches have ended with. Those of searches
    `before` are in the field too and have to be overtaken. Where this race is not the `last` one,
    a search that goes on alone and gains little does so in the next.
    """
    field = list(before)
    field += [Runner(at_its_bandwidth(problem, kappa)) for kappa in pool[:known]]
    field += [Runner(started(problem, kappa)) for kappa in pool[known:]]
    scale = problem.plants.omega_0 / (2.0 * np.pi)
    for turn in range(ROUNDS):
        running = [runner for runner in field if runner.running]
        alone = len(running) == 1 and turn > 0 and running[0].gained < SAME
        if not running or (alone and not last):
            break
        others = [runner for runner in field if not runner.running]
        field = others + _climbed(problem, running, workers)
        field = _merged(sorted(field, key=lambda runner: -runner.merit))
        field = _going_on(field, turn)
        lead, going = field[0].point, sum(runner.running for runner in field)
        over = lead.assessment.violation
        kept = f"bounds exceeded by {100.0 * over:.1g} %" if over > WITHIN else "within every bound"
        best = f"{number(float(np.exp(lead.tau)) * scale, 4)} Hz, {kept}"
        tell(f"{best}; {going} of {len(running)} searches continue, round {turn + 1} of {ROUNDS}")
    return field


def started(problem: LoopProblem, kappa: Array) -> Point:
    """A controller at the bandwidth that searches start from; lower if it keeps its bounds there.

    A climb that began above the bandwidth that a controller has would leave it for good; one below
    ω_low is none.
    """
    tau = problem.begin(kappa)
    first = Point(kappa, tau, assess(problem, kappa, tau))
    peaks = first.assessment.peaks
    if peaks is None or not (over := peaks.value > WITHIN).any() or (peaks.to_tau[over] <= 0).any():
        return first
    own = at_its_bandwidth(problem, kappa)
    inside = own.assessment.violation <= WITHIN and np.log(problem.low) <= own.tau < tau
    return own if inside else first


def at_its_bandwidth(
    problem: LoopProblem, kappa: Array, tau: float | None = None, within: float = WITHIN
) -> Point:
    """A controller at the largest ω_b that the shape and -3 dB leave it, found from `tau` on.

    There a known one begins: from below a climb would first make another controller of it, and end
    in another optimum. Where |S| falls again beyond a peak below -3 dB Newton's steps may lead away
    from the crossing, which stays between the ω_b that were met and missed.
    """
    tau, met, missed = problem.begin(kappa) if tau is None else tau, -np.inf, np.inf
    for _ in range(NEWTON):
        point = Point(kappa, tau, assess(problem, kappa, tau))
        peaks = point.assessment.peaks
        if peaks is None:
            break
        over = bool((peaks.value[np.isin(peaks.curve, OF_BANDWIDTH)] > within).any())
        rising = peaks.to_tau > TOUCHES
        room = float((-peaks.value[rising] / peaks.to_tau[rising]).min(initial=1.0))
        if abs(room) < within and not over:
            break
        met, missed = (met, tau) if over else (tau, missed)
        tau += float(np.clip(room, -1.0, 1.0))
        if not met < tau < missed:
            tau = 0.5 * (max(met, missed - 2.0) + missed) if np.isfinite(missed) else met + 0.1
    return point


def arrivals(runners: Sequence[Runner], best: Runner) -> int:
    """How many searches came to the bandwidth of the best one, within its bounds."""
    return sum(
        runner.count for runner in runners
        if abs(runner.point.tau - best.point.tau) <= SAME
        and runner.point.assessment.violation <= WITHIN
    )  # fmt: skip


def finished(runners: Sequence[Runner]) -> list[Runner]:
    """Those whose steps no longer help, and the best; the best first."""
    return [runner for i, runner in enumerate(runners) if runner.done or i < LAST]


def distinct(runners: Sequence[Runner], count: int) -> list[Point]:
    """The best `count` ends of unequal bandwidth, those outside the bounds last."""
    found: list[Runner] = []
    for runner in finished(runners):
        if all(abs(runner.point.tau - other.point.tau) > SAME for other in found):
            found.append(runner)
    return [runner.point for runner in found[:count]]


def local_optima(problem: LoopProblem, ends: Sequence[Runner]) -> tuple[LocalOptimum, ...]:
    """The distinct bandwidths within the bounds, the largest first."""
    P = problem.plants
    good = [end for i, end in enumerate(ends)
            if (end.done or i == 0) and end.point.assessment.violation <= WITHIN]  # fmt: skip
    found: list[LocalOptimum] = []
    for end in sorted(good, key=lambda end: -end.point.tau):
        value = float(np.exp(end.point.tau)) * P.omega_0
        if found and value >= found[-1].bandwidth * (1.0 - SAME):
            found[-1] = replace(found[-1], count=found[-1].count + end.count)
        else:
            kappa = problem.structure.in_units(end.point.kappa, P.omega_0, P.force)
            found.append(LocalOptimum(value, end.count, tuple(map(float, kappa))))
    return tuple(found)


def _climbed(problem: LoopProblem, running: Sequence[Runner], workers: Pool | None) -> list[Runner]:
    """All of them some steps further, in their order."""
    tasks = {i: (problem, r.point, r.radius) for i, r in enumerate(running)}
    ends = dict(results(workers, _climb, tasks))
    found = []
    for i, runner in enumerate(running):
        end, gained = ends[i]
        spent = runner.evaluations + end.evaluations
        found.append(Runner(end.point, end.radius, spent, end.done, gained, not end.done,
                            runner.count))  # fmt: skip
    return found


def _climb(problem: LoopProblem, point: Point, radius: float) -> tuple[Ascent, float]:
    """A round of a climb, and what it gained; at the rate of its last steps where these crawl."""
    before = ascend(problem, point, iterations=STEPS - RECENT, radius=radius)
    if before.done:
        return before, before.point.merit() - point.merit()
    end = ascend(problem, before.point, iterations=RECENT, radius=before.radius)
    recent = STEPS / RECENT * (end.point.merit() - before.point.merit())
    gained = recent if recent < WORTH else end.point.merit() - point.merit()
    return replace(end, evaluations=before.evaluations + end.evaluations), gained


def _merged(field: Sequence[Runner]) -> list[Runner]:
    """The field, best first, without searches that are where a better one is."""
    kept: list[Runner] = []
    for runner in field:
        for i, other in enumerate(kept):
            near = abs(runner.point.tau - other.point.tau) <= MERGED
            if near and np.abs(runner.point.kappa - other.point.kappa).max() <= MERGED:
                spent = other.evaluations + runner.evaluations
                kept[i] = replace(other, count=other.count + runner.count, evaluations=spent)
                break
        else:
            kept.append(runner)
    return kept


def _going_on(field: Sequence[Runner], turn: int) -> list[Runner]:
    """The field, best first, with those stopped that lost, or will not meet the bounds."""
    running = [i for i, runner in enumerate(field) if runner.running]
    most = max(LAST, len(running) // 2) if turn in HALVINGS else len(running)
    lead, found = field[0].merit, list(field)
    outside = [i for i in running if field[i].point.assessment.violation > WITHIN
               and field[i].point.tau > field[0].point.tau + BEHIND]  # fmt: skip
    fastest = max(outside, key=lambda i: field[i].point.tau, default=0)
    spared = (0, fastest if turn < HALVINGS[-1] else 0)
    for place, i in enumerate(running):
        runner = field[i]
        behind = lead - runner.merit
        lost = place >= most or behind + WORTH > OVERTAKING * runner.gained
        lost = lost or (turn >= HALVINGS[-1] and behind > BEHIND)
        missing = PENALTY * runner.point.assessment.violation
        hopeless = turn >= HALVINGS[-1] and missing > OVERTAKING * runner.gained
        if hopeless or (lost and i not in spared):
            found[i] = replace(runner, running=False)
    return found
