"""The largest bandwidth of a fixed structure on a set of plants: starts, race, certificate.

The best end of a race of local searches whose controller passes the judge (`certificate`) is the
design.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import StrEnum
from time import perf_counter
from typing import overload

import numpy as np

from ccd_casadi.fixed_structure.bounds import Bounds
from ccd_casadi.fixed_structure.certificate import Certificate, certify
from ccd_casadi.fixed_structure.channel_structure import ChannelStructure, controller_of
from ccd_casadi.fixed_structure.composite import composite_problem, kinds_of_rows
from ccd_casadi.fixed_structure.figures import assess
from ccd_casadi.fixed_structure.hold_and_delay import Sampling
from ccd_casadi.fixed_structure.loop import plant_set
from ccd_casadi.fixed_structure.loop_problem import LoopProblem, Problem
from ccd_casadi.fixed_structure.optimality import Envelope, log_bandwidth_envelope, optimality
from ccd_casadi.fixed_structure.race import (
    LocalOptimum,
    Runner,
    distinct,
    finished,
    local_optima,
    run_race,
)
from ccd_casadi.fixed_structure.starts import at_random, by_rules, fitted, kept, redrawn
from ccd_casadi.fixed_structure.structure import Kind, Structure
from ccd_casadi.fixed_structure.trust_region import Point, ascend
from ccd_casadi.plants.scaling import ScaledPlant, StateSpace
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.notebook import Shown
from ccd_casadi.support.process_pool import Pool

MARGIN = 1e-6  # in logarithms: what is designed lies so far within its bounds
CROSSOVERS = (0.03, 1.0)  # of starts, over ω₀: M_K is about mass times the square of ω_b hoped for
REDRAWS = 2  # races from the best ends, one section of each drawn anew
REDRAWN = 3  # ends
POOL = 12  # random starts tried for stability for each one that is raced
LOWER_AT_MOST = 1e-3  # relative: what the judge's ω_b may be below the search's
RESTORING = 400.0  # penalty when an end is to be brought within its bounds


class SectionsOutcome(StrEnum):
    """How a synthesis ended; only CERTIFIED designs are to be used."""

    CERTIFIED = "certified"
    NO_STABLE_START = "no start is stable on every plant of the set"
    BOUND_NOT_MET = "no controller was found that meets every bound"
    NOT_CERTIFIED = "the judge does not confirm what the search found"


@dataclass(frozen=True)
class SectionsDesign(Shown):
    """A controller of fixed structure; SI, frequencies in rad/s.

    `kappa` are the logarithms of its parameters in rad/s and N/m, `controller` the same as a state
    space (sampled loops: to be discretised by Tustin's rule without prewarping). `bandwidth` holds
    on every plant. `frequencies` bounded those of K's roots. `multipliers` by kind of bound: change
    of ln ω_b per ln of it. `short` names the bounds that the nearest controller misses, with the
    factor, where none meets all.
    """

    outcome: SectionsOutcome
    words: str
    structure: Structure | ChannelStructure
    kappa: Array
    frequencies: tuple[float, float]
    controller: StateSpace | None
    bandwidth: float
    certificate: Certificate | None
    multipliers: dict[str, float]
    at_box: tuple[tuple[str, str, float], ...]
    kkt_residual: float
    short: dict[str, float]
    local_optima: tuple[LocalOptimum, ...]
    starts: int
    evaluations: int
    seed: int
    seconds: float

    @property
    def certified(self) -> bool:
        """Whether the design may be used."""
        return self.outcome is SectionsOutcome.CERTIFIED


Progress = Callable[[str], None]


@overload
def problem_for(
    plants: Sequence[ScaledPlant],
    structure: Structure,
    bounds: Bounds,
    sampling: Sampling | None = None,
    frequencies: tuple[float, float] | None = None,
) -> Problem: ...


@overload
def problem_for(
    plants: Sequence[ScaledPlant],
    structure: Structure | ChannelStructure,
    bounds: Bounds,
    sampling: Sampling | None = None,
    frequencies: tuple[float, float] | None = None,
) -> LoopProblem: ...


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
    fastest = 30.0 * max(1.0, float(np.abs(family.poles).max()))
    if family.period is not None:
        fastest = min(fastest, 2.0 / family.period)
    slowest = min(1e-3, 0.01 * fastest)
    if frequencies is not None:
        slowest, fastest = (frequency / family.omega_0 for frequency in frequencies)
    return Problem(family, structure, bounds, structure.bounds((slowest, fastest), (1e-6, 1e6)),
                   MARGIN)  # fmt: skip


def synthesise_sections(
    plants: Sequence[ScaledPlant],
    structure: Structure,
    bounds: Bounds,
    *,
    sampling: Sampling | None = None,
    starts: int = 24,
    seed: int = 0,
    initial: Sequence[Array | StateSpace] = (),
    only_initial: bool = False,
    frequencies: tuple[float, float] | None = None,
    progress: Progress | None = None,
    workers: Pool | None = None,
) -> SectionsDesign:
    """max ω_b over the parameters of a structure, with every bound on every SISO plant.

    `initial`: parameters κ in SI, or controllers in SI that the structure is fitted to; they race
    beside `starts` others by rules and at random, or alone with `only_initial`. `frequencies` as in
    `problem_for`: give them where designs at several θ are compared. The searches of a race are
    spread over `workers`; their number changes nothing else. Raises PlantError for plants that
    cannot be in a set.
    """
    begun = perf_counter()
    problem = problem_for(plants, structure, bounds, sampling, frequencies)
    rng = np.random.default_rng(seed)
    pool = _initial(problem, initial, rng)
    if not only_initial:
        pool = np.concatenate([pool, _pool(problem, starts, rng)])
    tell = progress or (lambda words: None)
    spanned = span_of(problem)

    def failed(outcome: SectionsOutcome, words: str = "") -> SectionsDesign:
        nothing = np.full(len(structure.names), np.nan)
        return SectionsDesign(
            outcome, words or outcome.value, structure, nothing, spanned, None, np.nan, None, {},
            (), np.nan, {}, (), len(pool), 0, seed, perf_counter() - begun,
        )  # fmt: skip

    if not len(pool):
        return failed(SectionsOutcome.NO_STABLE_START)
    runners = run_race(problem, pool, tell, workers)
    for _ in range(0 if only_initial else REDRAWS):
        fresh = _redrawn(problem, runners, max(starts // 2, 1), rng)
        runners = run_race(problem, fresh, tell, workers, runners)
    evaluations = sum(runner.evaluations for runner in runners)
    ends = finished(runners)
    best: SectionsDesign | None = None
    optima = local_optima(problem, ends)
    for point in (runner.point for runner in ends):
        if point.assessment.violation > MARGIN:
            again = ascend(problem, point, iterations=30, penalty=RESTORING, radius=0.02)
            evaluations += again.evaluations
            point = again.point
        last = ascend(problem, point, iterations=25, radius=1e-3, least_radius=1e-10,
                      least_gain=1e-14)  # fmt: skip
        evaluations += last.evaluations
        point = last.point
        made = designed(problem, plants, sampling, point, optima, len(pool), evaluations, seed,
                         perf_counter() - begun)  # fmt: skip
        if best is None or (made.certified and not best.certified):
            best = made
        if best.certified:
            break
    assert best is not None
    tell(f"{best.outcome.value}: {best.bandwidth / (2.0 * np.pi):.2f} Hz")
    return best


def bandwidth_envelope(
    plants: Sequence[ScaledPlant],
    bounds: Bounds,
    design: SectionsDesign,
    sampling: Sampling | None = None,
) -> Envelope | None:
    """The gradients of ω_b*(θ) in rad/s at a design that is optimal on these plants.

    None where the point is not stationary to 1e-3. Plants carry dA, dB, dC.
    """
    problem = problem_for(plants, design.structure, bounds, sampling, design.frequencies)
    kappa = in_problem_units(problem, design.kappa)
    tau = float(np.log(design.bandwidth / problem.plants.omega_0))
    found = optimality(problem, _at_the_bounds(problem, kappa, tau))
    envelope = log_bandwidth_envelope(problem, kappa, found)
    return None if envelope is None else envelope.times(design.bandwidth)


def bandwidth_and_gradient(
    plants: Sequence[ScaledPlant],
    bounds: Bounds,
    design: SectionsDesign,
    sampling: Sampling | None = None,
) -> tuple[float, Array]:
    """ω_b* in rad/s and dω_b*/dθ at a design that is optimal on these plants (envelope theorem).

    Of one side where ω_b* has a kink; NaN where the point is not stationary to 1e-3.
    """
    envelope = bandwidth_envelope(plants, bounds, design, sampling)
    unknown = np.full(len(plants[0].dA), np.nan)
    return design.bandwidth, unknown if envelope is None else envelope.gradient


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


def in_problem_units(problem: LoopProblem, kappa: Array) -> Array:
    """SI parameters κ in the units of the problem."""
    P = problem.plants
    return problem.structure.in_units(np.asarray(kappa, float), 1.0 / P.omega_0, 1.0 / P.force)


def span_of(problem: LoopProblem) -> tuple[float, float]:
    """The bounds of frequencies of K's roots in rad/s."""
    index = problem.structure.kinds.index(Kind.FREQUENCY) if len(problem.box[0]) > 1 else 0
    low, high = np.exp(problem.box[:, index]) * problem.plants.omega_0
    return float(low), float(high)


def _initial(
    problem: Problem, initial: Sequence[Array | StateSpace], rng: np.random.Generator
) -> Array:
    found = [np.zeros((0, len(problem.structure.names)))]
    for item in initial:
        if isinstance(item, StateSpace):
            found.append(fitted(problem, item, rng))
        else:
            found.append(np.clip(in_problem_units(problem, item), *problem.box)[None])
    return kept(problem, np.concatenate(found))


def _pool(problem: Problem, starts: int, rng: np.random.Generator) -> Array:
    """Half by rules, half at random, of those that are stable; the nearest to the bounds of each.

    Where none is stable the search for one goes on with slower crossovers.
    """
    low, high = CROSSOVERS
    for _ in range(3):
        rules = kept(problem, by_rules(problem, np.geomspace(low, high, 12)))
        draws = np.exp(rng.uniform(np.log(low), np.log(high), POOL * starts))
        random = kept(problem, at_random(problem, draws, rng))
        if len(rules) + len(random):
            half = max(starts // 2, 1)
            near, far = _nearest(problem, rules, half), _nearest(problem, random, 4 * half)
            chosen = rng.permutation(len(far))[: max(starts - len(near), half)]
            return np.concatenate([near, far[chosen]])
        low, high = 0.03 * low, low
    return np.zeros((0, len(problem.structure.names)))


def _redrawn(
    problem: Problem, runners: Sequence[Runner], count: int, rng: np.random.Generator
) -> Array:
    """Those of the best ends with one section drawn anew that are stable and miss least."""
    fresh = redrawn(problem, distinct(runners, REDRAWN), POOL // 2 * count, rng)
    return _nearest(problem, kept(problem, fresh), count)


def _nearest(problem: Problem, kappa: Array, count: int) -> Array:
    """The `count` controllers that miss the bounds least at a modest bandwidth."""
    tau = float(np.log(0.1))
    misses = [assess(problem, one, tau).violation for one in kappa]
    return kappa[np.argsort(misses)[:count]]


def designed(
    problem: LoopProblem,
    plants: Sequence[ScaledPlant],
    sampling: Sampling | None,
    point: Point,
    optima: tuple[LocalOptimum, ...],
    starts: int,
    evaluations: int,
    seed: int,
    seconds: float,
) -> SectionsDesign:
    structure, bounds, P = problem.structure, problem.bounds, problem.plants
    kappa = structure.in_units(point.kappa, P.omega_0, P.force)
    controller = controller_of(structure, kappa)
    found = optimality(problem, point)
    bandwidth = float(np.exp(point.tau)) * P.omega_0
    judged = certify(plants, controller, bounds, sampling, integrator=structure.integrator)
    short: dict[str, float] = {}
    peaks = point.assessment.peaks
    assert peaks is not None
    for name, value in zip(kinds_of_rows(problem, peaks), peaks.value, strict=True):
        if value > 2.0 * MARGIN:
            short[name] = max(short.get(name, 0.0), float(np.exp(value)))
    outcome, words = SectionsOutcome.CERTIFIED, judged.words
    if short:
        outcome = SectionsOutcome.BOUND_NOT_MET
        missed = ", ".join(f"{name} by a factor {ratio:.6g}" for name, ratio in short.items())
        words = f"the nearest controller misses {missed}"
    elif not judged.passed or abs(judged.bandwidth / bandwidth - 1.0) > 1e-3:
        outcome = SectionsOutcome.NOT_CERTIFIED
        words = f"judged {judged.bandwidth:.6g} rad/s, searched {bandwidth:.6g}: {judged.words}"
    if outcome is SectionsOutcome.CERTIFIED:
        bandwidth = min(bandwidth, judged.bandwidth)
    return SectionsDesign(
        outcome, words, structure, kappa, span_of(problem), controller, bandwidth, judged,
        found.named(), found.ends, found.residual, short, optima, starts, evaluations, seed,
        seconds,
    )  # fmt: skip
