"""The largest bandwidth of a fixed structure on a set of plants: starts, search, and the design
that is judged."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from time import perf_counter
from typing import cast

import numpy as np

from ccd_casadi.fixed_structure.bounds import Bounds
from ccd_casadi.fixed_structure.certificate import SetCertificate, certify
from ccd_casadi.fixed_structure.channel_structure import ChannelStructure
from ccd_casadi.fixed_structure.composite import box_of, composite_problem
from ccd_casadi.fixed_structure.figures import assess
from ccd_casadi.fixed_structure.local_search import Envelope, Point, ascend, envelope_of, optimality
from ccd_casadi.fixed_structure.loop_problem import LoopProblem, Problem
from ccd_casadi.fixed_structure.multi_start import (
    BandwidthOptimum,
    MultiStartOptions,
    SearchRun,
    count_arrivals,
    local_optima,
    reinsert,
    search_from_starts,
    select_distinct,
    select_ends,
)
from ccd_casadi.fixed_structure.plant_set import plant_set
from ccd_casadi.fixed_structure.starts import at_random, by_rules, redraw_section, stabilising
from ccd_casadi.fixed_structure.structure import ParameterKind, Structure
from ccd_casadi.lti.loop import Sampling
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.plants.scaling import ScaledPlant
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.process_pool import Pool, results
from ccd_casadi.support.terminal import Log, NotebookHtml, silent
from ccd_casadi.support.text import HZ, number
from ccd_casadi.support.time_budget import ends_early, time_is_up


@dataclass(frozen=True)
class DesignOptions:
    """Numbers of a design: where its searches start, how often, and what they leave of a bound.

    Attributes
    ----------
    margin : float
        ln: a design lies this far within its bounds.
    crossovers : tuple of float
        Of starts, over ω₀ = √(M_K/mass) about.
    pool : int
        Random starts that are tried for stability for each one that is kept.
    batch : int
        Controllers that one task assesses.
    reworks : int
        Searches at most from the best ends with one section moved or drawn anew.
    reworked : int
        Best ends that are reworked.
    repeats : int
        Times that the best of a search is to be found, from starts apart.
    least_starts : int
        Of a search that may add starts: two of four may end in a lesser one.
    peak_shares : tuple of float
        Of S_max - 1, tried for coupled channels.
    multi_start : MultiStartOptions
    """

    margin: float = 1e-6
    crossovers: tuple[float, float] = (0.03, 10.0)
    pool: int = 12
    batch: int = 16
    reworks: int = 2
    reworked: int = 3
    repeats: int = 2
    least_starts: int = 12
    peak_shares: tuple[float, ...] = (1.0, 0.6, 0.3)
    multi_start: MultiStartOptions = field(default_factory=MultiStartOptions)


class SectionsOutcome(StrEnum):
    """The outcome of a synthesis; only CERTIFIED designs are to be used."""

    CERTIFIED = "certified"
    NO_STABLE_START = "no start is stable on every plant of the set"
    BOUND_NOT_MET = "no controller was found that meets every bound"
    NOT_CERTIFIED = "the judge does not confirm what the search found"


@dataclass(frozen=True)
class SectionsDesign(NotebookHtml):
    """A controller of fixed structure, and how it was found; SI, frequencies in rad/s.

    Parameters
    ----------
    outcome, words : SectionsOutcome, str
        How it ended, and why.
    structure, kappa : Structure or ChannelStructure, array (p,)
        Sections of K; logarithms of their parameters in rad/s and N/m.
    frequencies : tuple of two floats
        Bounds of K's roots.
    controller : StateSpace or None
        K(s), e to force; of a sampled loop it is discretised by Tustin's rule without prewarping.
    bandwidth, certificate : float, Certificate or None
        ω_b that holds on every plant; what was judged.
    multipliers : dict
        By kind of bound: change of ln ω_b per ln of the bound.
    at_box, kkt_residual : tuple, float
        Parameters at their own bounds; how nearly the design is an optimum.
    short : dict
        Where no controller meets every bound: those that the nearest one misses, with the factor.
    local_optima, starts, evaluations, seed, seconds
        Of the search: where it ended, how often it started, loops, randomness, time.
    found : int or None
        How many of its own starts, apart from each other, led to its best; None: not counted.
    """

    outcome: SectionsOutcome
    words: str
    structure: Structure | ChannelStructure
    kappa: Array
    frequencies: tuple[float, float]
    controller: StateSpace | None
    bandwidth: float
    certificate: SetCertificate | None
    multipliers: dict[str, float]
    at_box: tuple[tuple[str, str, float], ...]
    kkt_residual: float
    short: dict[str, float]
    local_optima: tuple[BandwidthOptimum, ...]
    starts: int
    evaluations: int
    seed: int
    seconds: float
    found: int | None = None

    @property
    def certified(self) -> bool:
        """Whether the design may be used."""
        return self.outcome is SectionsOutcome.CERTIFIED


def in_problem_units(problem: LoopProblem, kappa: Array) -> Array:
    """Convert parameters of a controller to the units of a problem.

    Parameters
    ----------
    problem, kappa : LoopProblem, array (n,)
        κ: logarithms of parameters in rad/s and N/m.

    Returns
    -------
    array (n,)
        κ with frequencies over ω₀ and gains over the force per displacement of the problem.
    """
    P = problem.plants
    return problem.structure.in_units(np.asarray(kappa, float), 1.0 / P.omega_0, 1.0 / P.force)


def span_of(problem: LoopProblem) -> tuple[float, float]:
    """The bounds of frequencies of K's roots in rad/s."""
    index = problem.structure.kinds.index(ParameterKind.FREQUENCY) if len(problem.box[0]) > 1 else 0
    low, high = np.exp(problem.box[:, index]) * problem.plants.omega_0
    return float(low), float(high)


@dataclass(frozen=True)
class DesignSearch:
    """A search for controllers on plants, with the options of `synthesise_sections`, and when it
    `began` (s of `perf_counter`)."""

    problem: LoopProblem
    plants: Sequence[ScaledPlant]
    sampling: Sampling | None
    starts: int = 0
    most_starts: int = 0
    seed: int = 0
    initial: Sequence[Array] = ()
    only_initial: bool = False
    log: Log = silent
    workers: Pool | None = None
    began: float = field(default_factory=perf_counter)
    options: DesignOptions = DesignOptions()

    def inside(self, kappas: Sequence[Array]) -> list[Array]:
        """Controllers κ in SI in the units of the problem and in its box."""
        return [np.clip(in_problem_units(self.problem, one), *self.problem.box) for one in kappas]

    def judge(self, inside: Array) -> tuple[Array, StateSpace, SetCertificate]:
        """κ in SI of one in the problem's units, its controller, and its certificate."""
        structure, P = self.problem.structure, self.problem.plants
        kappa = structure.in_units(inside, P.omega_0, P.force)
        K = structure.state_space(kappa).balance()
        return kappa, K, certify(self.plants, K, self.problem.bounds, self.sampling,
                                 integrator=structure.integrates(self.problem.bounds.error),
                                 workers=self.workers)  # fmt: skip

    def make_design(
        self, point: Point, optima: tuple[BandwidthOptimum, ...], starts: int, evaluations: int
    ) -> SectionsDesign:
        """The design at an end: certified where the judge confirms what the search found."""
        problem = self.problem
        kappa, controller, judged = self.judge(point.kappa)
        found = optimality(problem, point)
        bandwidth = float(np.exp(point.tau)) * problem.plants.omega_0
        short: dict[str, float] = {}
        peaks = point.assessment.peaks
        assert peaks is not None
        for name, value in zip(problem.kinds_of(peaks), peaks.value, strict=True):
            if value > 2.0 * problem.margin:
                short[name] = max(short.get(name, 0.0), float(np.exp(value)))
        outcome, words = SectionsOutcome.CERTIFIED, judged.words
        if short:
            outcome = SectionsOutcome.BOUND_NOT_MET
            missed = ", ".join(
                problem.bounds.missed_words(name, ratio) for name, ratio in short.items()
            )
            words = f"none found from {starts} starts: the nearest controller misses {missed}"
        elif not judged.passed or abs(judged.bandwidth / bandwidth - 1.0) > 1e-3:
            outcome = SectionsOutcome.NOT_CERTIFIED
            words = f"judged {judged.bandwidth:.6g} rad/s, searched {bandwidth:.6g}: {judged.words}"
        if outcome is SectionsOutcome.CERTIFIED:
            bandwidth = min(bandwidth, judged.bandwidth)
        return SectionsDesign(
            outcome, words, problem.structure, kappa, span_of(problem), controller, bandwidth,
            judged, found.by_kind(), found.ends, found.residual, short, optima, starts, evaluations,
            self.seed, perf_counter() - self.began,
        )  # fmt: skip

    def make_failure(
        self, outcome: SectionsOutcome = SectionsOutcome.NO_STABLE_START, words: str = ""
    ) -> SectionsDesign:
        """A design without a controller."""
        problem = self.problem
        nothing = np.full(len(problem.box[0]), np.nan)
        return SectionsDesign(
            outcome, words or outcome.value, problem.structure, nothing, span_of(problem), None,
            np.nan, None, {}, (), np.nan, {}, (), 0, 0, self.seed, perf_counter() - self.began,
        )  # fmt: skip

    def conclude(self, runners: Sequence[SearchRun], starts: int, spent: int = 0) -> SectionsDesign:
        """The best end that the judge confirms, brought within its bounds; `spent`: loops that were
        assessed before."""
        problem, ends = self.problem, select_ends(runners, self.options.multi_start)
        evaluations = spent + sum(runner.evaluations for runner in runners)
        best: SectionsDesign | None = None
        optima = local_optima(problem, ends, self.options.multi_start)
        for point in (runner.point for runner in ends):
            if point.assessment.violation > problem.margin:
                again = ascend(problem, point, iterations=30, restoring=True, radius=0.02)
                evaluations += again.evaluations
                point = again.point
            last = ascend(problem, point, iterations=25, radius=1e-3, least_radius=1e-10,
                          least_gain=1e-14)  # fmt: skip
            evaluations += last.evaluations
            made = self.make_design(last.point, optima, starts, evaluations)
            if best is None or (made.certified and not best.certified):
                best = made
            if best.certified:
                break
        assert best is not None
        self.log(f"{best.outcome.value}: {number(best.bandwidth / HZ, 4)} Hz")
        return best


def problem_for(
    plants: Sequence[ScaledPlant],
    structure: Structure | ChannelStructure,
    bounds: Bounds,
    sampling: Sampling | None = None,
    frequencies: tuple[float, float] | None = None,
    *,
    margin: float = DesignOptions.margin,
) -> LoopProblem:
    """Make the problem of a controller on a set of plants, in the units of the first plant.

    Parameters
    ----------
    plants, structure, bounds : sequence of ScaledPlant, Structure or ChannelStructure, Bounds
    sampling : Sampling, optional
        None: a continuous loop.
    frequencies : tuple of two floats, optional
        Bounds of the frequencies of K's roots, rad/s; by default 1e-3 ω₀ and 30 times the fastest
        pole of any plant, sampled 2/T at most. The gain lies within a factor 1e6 of M_K.
    margin : float
        ln: how far inside every bound its searches aim.

    Returns
    -------
    LoopProblem
        A `CompositeProblem` for several channels, else a `Problem`.

    Raises
    ------
    PlantError
        As `plant_set` does.
    """
    if isinstance(structure, ChannelStructure):
        return composite_problem(plants, structure, bounds, sampling, frequencies, margin)
    family = plant_set(plants, sampling)
    box = box_of(structure, family.poles, family.omega_0, sampling, frequencies)
    return Problem(family, structure, bounds, box, margin)


def of_one_channel(search: DesignSearch) -> SectionsDesign:
    """The best of searches from its initial controllers and, unless these are all, from others by
    rules and at random, then from the best ends with one section of each put elsewhere or drawn
    anew; in batches of starts, up to `most_starts`, until the best was found twice."""
    problem, starts, workers = cast(Problem, search.problem), search.starts, search.workers
    options, rules = search.options, search.options.multi_start
    rng, names = np.random.default_rng(search.seed), problem.structure.names
    pool = stabilising(problem, np.reshape(search.inside(search.initial), (-1, len(names))))
    known = len(pool)
    if not search.only_initial:
        pool = np.concatenate([pool, _pool(problem, starts, rng, workers, options)])
    if not len(pool):
        return search.make_failure()
    last, started = search.only_initial, len(pool)
    first = search_from_starts(
        problem, pool, search.log, workers, known=known, last=last, options=rules
    )
    if last:
        return search.conclude(first, started)
    runners = _rework(search, problem, first, rng)
    # known ones may be alike
    found, batch = count_arrivals(first, runners[0], rules) - max(known - 1, 0), 0
    least = min(options.least_starts, search.most_starts)
    while started < least or (found < options.repeats and started + starts <= search.most_starts):
        if ends_early("controller start", starts):
            break
        batch += 1
        rng = np.random.default_rng((search.seed, batch))
        pool = _pool(problem, starts, rng, workers, options)
        started += len(pool)
        before, best = count_arrivals(runners, runners[0], rules), runners[0]
        field = search_from_starts(
            problem, pool, search.log, workers, runners, last=False, options=rules
        )
        if field[0].merit > best.merit + rules.same:
            runners = _rework(search, problem, field, rng)
            found = count_arrivals(field, runners[0], rules)
        else:
            runners, found = field, found + max(count_arrivals(field, field[0], rules) - before, 0)
    return replace(search.conclude(runners, started), found=found)


def _rework(
    search: DesignSearch, problem: Problem, runners: list[SearchRun], rng: np.random.Generator
) -> list[SearchRun]:
    """Searches from the best ends with one section of each put elsewhere or drawn anew, as often as
    that helps, beside those of before."""
    workers, tried, options = search.workers, list[Point](), search.options
    for _ in range(options.reworks):
        if time_is_up():
            break
        best = runners[0].merit
        ends = select_distinct(runners, options.reworked, options.multi_start)
        fresh = [end for end in ends if not any(end is other for other in tried)]
        tried += fresh
        count = max(search.starts // 2, 1)
        moved = stabilising(problem, reinsert(problem, fresh))[:count]
        more, like = count - len(moved), [end.kappa for end in ends]
        drawn = stabilising(problem, redraw_section(problem, like, options.pool // 2 * more, rng))
        pool = np.concatenate([moved, _nearest(problem, drawn, more, workers, options.batch)])
        runners = search_from_starts(problem, pool, search.log, workers, runners, known=len(moved),
                           options=options.multi_start)  # fmt: skip
        if runners[0].merit < best + options.multi_start.same:
            break
    return runners


def _pool(
    problem: Problem, starts: int, rng: np.random.Generator, workers: Pool | None,
    options: DesignOptions = DesignOptions(),
) -> Array:  # fmt: skip
    """Half by rules, half at random, of those that are stable; the nearest to the bounds of each,
    and the fastest by rule, which none at a modest bandwidth leads to.

    Where none is stable slower crossovers are tried.
    """
    low, high = options.crossovers
    for _ in range(3):
        rules = stabilising(problem, by_rules(problem, np.geomspace(low, high, 12)))
        draws = np.exp(rng.uniform(np.log(low), np.log(high), options.pool * starts))
        random = stabilising(problem, at_random(problem, draws, rng))
        if len(rules) + len(random):
            half = max(starts // 2, 1)
            fastest = rules[-1:] if half > 2 else rules[:0]
            rules = rules[: len(rules) - len(fastest)]
            near = _nearest(problem, rules, half - len(fastest), workers, options.batch)
            far = _nearest(problem, random, 4 * half, workers, options.batch)
            chosen = rng.permutation(len(far))[: max(starts - len(near) - len(fastest), half)]
            return np.concatenate([near, fastest, far[chosen]])
        low, high = 0.03 * low, low
    return np.zeros((0, len(problem.structure.names)))


def _nearest(problem: Problem, kappa: Array, count: int, workers: Pool | None, batch: int) -> Array:
    """The `count` controllers that miss the bounds least at a modest bandwidth."""
    parts = {i: (problem, kappa[i : i + batch]) for i in range(0, len(kappa), batch)}
    misses = dict(results(workers, _misses, parts))
    return kappa[np.argsort([miss for i in parts for miss in misses[i]])[:count]]


def _misses(problem: Problem, kappa: Array) -> list[float]:
    return [assess(problem, one, problem.first_tau).violation for one in kappa]


def bandwidth_envelope(
    plants: Sequence[ScaledPlant],
    bounds: Bounds,
    design: SectionsDesign,
    sampling: Sampling | None = None,
) -> Envelope | None:
    """Find the gradients of ω_b*(θ) at a design that is optimal on these plants.

    Parameters
    ----------
    plants : sequence of ScaledPlant
        With their derivatives dA, dB, dC to θ.
    bounds, design, sampling : Bounds, SectionsDesign, Sampling, optional

    Returns
    -------
    Envelope or None
        In rad/s; None where a loop is unstable or the point is not stationary.
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


def _at_the_bounds(problem: LoopProblem, kappa: Array, tau: float, *, off: float = 1e-3) -> Point:
    """The point with the largest ω_b of this κ; the judge's is lower by its own grid, by less than
    `off` (relative)."""
    assessment = assess(problem, kappa, tau)
    peaks = assessment.peaks
    if peaks is not None:
        rising = peaks.to_tau > 0.0
        room = float((-peaks.value[rising] / peaks.to_tau[rising]).min(initial=np.inf))
        if abs(room) < off:
            tau += room
            assessment = assess(problem, kappa, tau)
    return Point(kappa, tau, assessment)
