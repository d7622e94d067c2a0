"""A look at the whole box: is anything better than what a formulation found?

The true inner problem is solved at θ spread over the box (Sobol, seeded), those that the
formulation solved itself counted in. With surrogates over (θ, ω_S, ω_T) a θ is passed over where
even their optimistic values (if left-out samples say that they are to be trusted, and no local
maximum of S is near -3 dB),

    ω_b + k σ   over   ln‖S‖∞ - k σ <= ln S_max,  ln|S(jω_low)| - k σ <= ln S_low,   k = 4,

do not reach the J at hand. The `CHECKED` most promising of those are solved all the same, and all
of them where one is better than the surrogates' optimism allowed. What is better than its
neighbours, and after that the best of the rest, start local solves on the true problem
(`kinked.descend`), none of which goes on near a stationary point that is known; the best end wins.
A basin is often entered by points that are no better than their neighbours: with these alone one
random problem of six ended above its optimum. At last each parameter is brought to the ends of its
range, the others as at the optimum, and these start local solves too (but for what the surrogates
rule out): one of 60 random problems had a better optimum there that no spread θ led to. What this
excludes is a better optimum whose basin one of the starts lies in, and no more.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ccd_casadi.codesign.direct import acceptable, true_objective
from ccd_casadi.codesign.kinked import descend
from ccd_casadi.codesign.kkt import kkt_certificate
from ccd_casadi.codesign.outer_problem import lifted_bounds
from ccd_casadi.codesign.peak_constraints import HALF_POWER
from ccd_casadi.inner_problem.constraints import unmet
from ccd_casadi.inner_problem.objective import objective
from ccd_casadi.inner_problem.problem import CoDesignProblem, box, scaled_plant
from ccd_casadi.sampling.sampler import Sampler
from ccd_casadi.sampling.samples import BandwidthSample
from ccd_casadi.support.arrays import Array
from ccd_casadi.synthesis.derivatives import Sensitivities
from ccd_casadi.synthesis.peaks import local_peaks_with_gradients
from surrogates import GaussianProcess, design, quality_of

POINTS_A_START = 8  # points looked at for every local solve: each costs as much as an inner problem
BETTER = 1e-6  # relative: a J that is lower by less is the same optimum
SAME = 1e-3  # of the box: a point this close to the optimum starts nothing new
PERTURBED = 0.02  # of the box: starts around an optimum whose residual is too large
TRIES = 4
STATIONARY = 1e-4  # scaled residual of an end whose basin is not looked into again
OPTIMISM = 4.0  # deviations of the surrogates by which a θ must miss to be passed over
CHECKED = 4  # of those passed over that are solved nevertheless
COVERAGE = 0.8  # of left-out samples within their 95 % bands, for surrogates to rule anything out
NEAR_SHELF = 0.2  # ln: a local maximum of S this close to -3 dB may make ω_b jump
COARSE = 1.02  # what the best between the points of the mesh may be above the best on it
MESH = 13  # points a side over (ω_S, ω_T) for the optimistic values


@dataclass(frozen=True)
class BoxLook:
    """What was looked at: `points` θ, `solved` by true inner problems, `feasible` of these with a
    design; the others were passed over, their optimistic surrogates being worse.

    `better`: how many of them beat the J that the formulation came `before` with; `starts` local
    solves went from them; `after` is the best J at the end, at `x` (None: nothing was better).
    """

    points: int
    solved: int
    feasible: int
    better: int
    starts: int
    seed: int
    before: float
    after: float
    x: Array | None

    @property
    def moved(self) -> bool:
        """Whether something better was found."""
        return self.x is not None


def look_over_box(
    sampler: Sampler,
    x: Array,
    J: float,
    points: int,
    seed: int,
    processes: tuple[GaussianProcess, ...] = (),
) -> BoxLook:
    """Look at `points` θ over the box for a J lower than that of x = (θ, ln ω_S, ln ω_T).

    `processes`: surrogates of ω_b, ln‖S‖∞ and ln|S(jω_low)| over x, where there are any.
    """
    problem = sampler.problem
    quantities = sampler.truth
    if processes and _may_jump(problem, x, quantities.at(x)):
        processes = ()
    samples, passed_over = _spread(sampler, J, points, seed, processes) if points else ([], 0)
    feasible = [sample for sample in samples if sample.feasible and _allowed(problem, sample)]
    values = np.array([objective(problem, sample.theta, sample.value) for sample in feasible])
    margin = BETTER * abs(J) if np.isfinite(J) else 0.0
    best_x, best, begun = None, J, 0
    ended: list[tuple[Array, float]] = []

    def note(place: Array, value: float) -> None:
        kkt = kkt_certificate(problem, place, quantities.at(place))
        if kkt.stationarity <= STATIONARY:
            ended.append((place, value))

    def solve_from(starts: Sequence[BandwidthSample]) -> None:
        nonlocal best_x, best, begun
        begun += len(starts)
        if starts and np.isfinite(J) and not ended:
            note(x, J)
        for sample in starts:
            begin = np.array([*sample.theta, np.log(sample.omega_S), np.log(sample.omega_T)])
            end = descend(problem, quantities, begin, ended=ended)
            for place in (end, begin):
                found = quantities.at(place)
                if acceptable(problem, place, found):
                    value = true_objective(problem, place, found)
                    note(place, value)
                    if value < best - margin:
                        best_x, best = place, value
                    break

    solve_from(
        _starts(problem, feasible, values, np.asarray(x[:-2]))[: -(-points // POINTS_A_START)]
    )
    ends = _ends(problem, np.asarray((x if best_x is None else best_x)[:-2]))
    if len(ends) and len(processes) == 3 and _trustworthy(processes, seed):
        ends = ends[_optimistic_objective(problem, processes, ends) < best]
    if len(ends) and np.isfinite(best) and 2 * len(ends) <= points:
        found = sampler.bandwidths(ends, "looking at the ends of each parameter")
        able = [sample for sample in found if sample.feasible and _allowed(problem, sample)]
        solve_from(able)
    return BoxLook(
        points=len(samples) + passed_over,
        solved=len(samples),
        feasible=len(feasible),
        better=int((values < J - margin).sum()),
        starts=begun,
        seed=seed,
        before=J,
        after=best,
        x=best_x,
    )


def _ends(problem: CoDesignProblem, theta: Array) -> Array:
    """θ (k, n_θ) with one parameter at a time at an end of its range, but for where it is so."""
    lower, upper = box(problem)
    found = [
        np.where(np.arange(len(theta)) == i, end, theta)
        for i in range(len(theta))
        for end in (lower[i], upper[i])
        if abs(end - theta[i]) > SAME * (upper[i] - lower[i])
    ]
    allowed = [x for x in found if not unmet(problem, x)]
    return np.array(allowed).reshape(-1, len(theta))


def perturbed(sampler: Sampler, x: Array, seed: int) -> list[Array]:
    """Ends of local solves from a few starts around x: the last try where x is not stationary."""
    problem = sampler.problem
    quantities = sampler.truth
    lower, upper = box(problem)
    ends = []
    for step in np.random.default_rng(seed).normal(0.0, PERTURBED, (TRIES, lower.size)):
        theta = np.clip(x[:-2] + step * (upper - lower), lower, upper)
        sample = sampler.bandwidths(theta, "perturbed starts")[0]
        if sample.feasible:
            begin = np.array([*theta, np.log(sample.omega_S), np.log(sample.omega_T)])
            end = descend(problem, quantities, begin, settled=1e-13)
            if acceptable(problem, end, quantities.at(end)):
                ends.append(end)
    return ends


def _spread(
    sampler: Sampler, J: float, points: int, seed: int, processes: tuple[GaussianProcess, ...]
) -> tuple[list[BandwidthSample], int]:
    """The inner problems that the run has solved, and as many more as make up `points`.

    Second, how many of these were passed over for their surrogates.
    """
    lower, upper = box(sampler.problem)
    solved = list(sampler.solved.values())
    apart = _apart(np.array([s.theta for s in solved]).reshape(-1, lower.size), upper - lower)
    known = [sample for sample, keep in zip(solved, apart, strict=True) if keep]
    passed_over = 0
    if len(known) < points:
        spread = design("sobol", lower, upper, points, seed)[len(known) :]
        more = [theta for theta in spread if not unmet(sampler.problem, theta)]
        solve: list[Array] = list(more)
        if more and len(processes) > 1 and _trustworthy(processes, seed):
            hopes = _optimistic_objective(sampler.problem, processes, np.array(more))
            order = np.argsort(hopes)
            keep = [int(i) for k, i in enumerate(order) if k < CHECKED or hopes[i] < J]
            first = sampler.bandwidths(np.array([more[i] for i in keep]), "looking over the box")
            refuted = any(
                sample.feasible
                and objective(sampler.problem, sample.theta, sample.value) < hopes[i]
                for i, sample in zip(keep, first, strict=True)
            )
            known = [*known, *first]
            solve = [more[i] for i in range(len(more)) if i not in keep] if refuted else []
            passed_over = len(more) - len(keep) - len(solve)
        if solve:
            known = [*known, *sampler.bandwidths(np.array(solve), "looking over the box")]
    return known, passed_over


def _may_jump(problem: CoDesignProblem, x: Array, design: Sensitivities) -> bool:
    """Whether a local maximum of S at x is near -3 dB: there ω_b jumps, and surrogates do not."""
    peaks = local_peaks_with_gradients(
        scaled_plant(problem, tuple(x[:-2])),
        problem.weights.at(design.figures.omega_S, design.figures.omega_T),
        design,
        gamma_backoff=problem.inner.gamma_backoff,
        least=float(np.exp(HALF_POWER - NEAR_SHELF)),
    )
    return any(abs(p.ln_gain - HALF_POWER) <= NEAR_SHELF for p in peaks if p.member == 0)


def _trustworthy(processes: tuple[GaussianProcess, ...], seed: int) -> bool:
    """Whether the surrogates may rule anything out: smooth samples, predicted within their bands.

    Where ω_b jumps (a peak below it reaches -3 dB) a smooth surrogate is sure of what is not so.
    """
    middle = 0.5 * (processes[0].lower + processes[0].upper)
    found = [quality_of(process, middle, seed=seed) for process in processes]
    return all(q.smooth_enough and q.coverage >= COVERAGE for q in found)


def _optimistic_objective(
    problem: CoDesignProblem, processes: tuple[GaussianProcess, ...], thetas: Array
) -> Array:
    """The least J (n,) that the surrogates do not rule out at each θ (n, n_θ); see the module."""
    lower, upper = lifted_bounds(problem)
    axes = [np.linspace(lower[k], upper[k], MESH) for k in (-2, -1)]
    mesh = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 2)
    levels = problem.inner.levels
    out = np.empty(len(thetas))
    for i, theta in enumerate(thetas):
        X = np.hstack([np.tile(theta, (len(mesh), 1)), mesh])
        bandwidth, *bounded = (process.predict(X, return_std=True) for process in processes)
        allowed = np.all(
            [
                mean - OPTIMISM * std <= level
                for (mean, std), level in zip(bounded, levels, strict=True)
            ],
            axis=0,
        )
        hope = COARSE * (bandwidth[0] + OPTIMISM * bandwidth[1])
        best = float(hope[allowed].max()) if allowed.any() else -np.inf
        out[i] = objective(problem, theta, best)
    return out


def _apart(thetas: Array, width: Array) -> list[bool]:
    """Which of them are no near repetition of an earlier one: a cluster is one look."""
    kept: list[int] = []
    out = []
    for i, theta in enumerate(thetas):
        far = all(np.abs((theta - thetas[k]) / width).max() > 0.02 for k in kept)
        out.append(far)
        if far:
            kept.append(i)
    return out


def _starts(
    problem: CoDesignProblem, samples: Sequence[BandwidthSample], values: Array, theta: Array
) -> list[BandwidthSample]:
    """Samples with a lower J than their n_θ + 1 nearest neighbours, then the best; away from θ."""
    if not samples:
        return []
    lower, upper = box(problem)
    unit = (np.array([sample.theta for sample in samples]) - lower) / (upper - lower)
    here = (theta - lower) / (upper - lower)
    lowest: list[BandwidthSample] = []
    others: list[BandwidthSample] = []
    for i in np.argsort(values):
        away = np.abs(unit - unit[i]).max(axis=1)
        near = np.argsort(away)[1 : lower.size + 2]
        if np.abs(unit[i] - here).max() > SAME:
            (lowest if (values[near] >= values[i]).all() else others).append(samples[i])
    return lowest + others


def _allowed(problem: CoDesignProblem, sample: BandwidthSample) -> bool:
    return not unmet(problem, sample.theta)
