"""A multi-start search: local searches, by successive halving, to distinct local optima.

All climb some steps, the better half goes on, and so forth. A search stops early where its steps no
longer help, where it has come to a controller that a better one has already been at, and where it
gains so little that it cannot overtake. One is spared: that of the largest ω_b among those outside
their bounds, since a climb past a resonance gains little for long and may then end far above all
others. Each climb is a function of its start alone, so that any
number of processes finds the same.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ccd_casadi.fixed_structure.figures import assess
from ccd_casadi.fixed_structure.local_search import MERGED, PENALTY, Ascent, Point, ascend
from ccd_casadi.fixed_structure.loop_problem import LoopCurve, LoopProblem
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.process_pool import Pool, results
from ccd_casadi.support.progress import Tell
from ccd_casadi.support.units import number

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
