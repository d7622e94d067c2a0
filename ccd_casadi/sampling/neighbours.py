"""What samples of a fixed structure tell those near by: where to begin, and what to expect there.

A climb ends in one of several local optima, and which one may change from θ to θ. Where θ_i and θ_j
have controllers of one branch of v(θ), to third order of what lies between them,

    v_j = v_i + ½ (∇v_i + ∇v_j)·(θ_j - θ_i).

So a sample that falls short of this is worth a climb from κ_i, and a new θ begins from what
promises most there too.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from ccd_casadi.inner_problem.objective import objective, objective_of
from ccd_casadi.inner_problem.problem import CoDesignProblem, box
from ccd_casadi.inner_problem.sections_plant_set import sections_of_problem
from ccd_casadi.inner_problem.sections_search import joined
from ccd_casadi.sampling.samples import BandwidthSample
from ccd_casadi.support.arrays import Array

WORTH = 1e-3  # relative: what another branch has to promise, and what a verdict counts as better
MORE = 2  # neighbours, beside one for each parameter
NEAR = 0.1  # of the box: so near the best θ a surrogate has to be of one branch
TRIES = 2  # climbs from neighbours, of a sample, that may be in vain

Theta = tuple[float, ...]


def begun(
    problem: CoDesignProblem, known: Iterable[BandwidthSample], theta: Theta
) -> CoDesignProblem:
    """The problem with the neighbour's controller that promises most at a new θ as an anchor."""
    samples, values = _usable(known), []
    near = _nearest(problem, samples, theta)
    for one in near:
        values.append(one.value + float(np.subtract(theta, one.theta) @ one.gradient))
    if not near:
        return problem
    best = np.argmax(values) if problem.figure.larger_is_better else np.argmin(values)
    return joined(problem, np.array(near[best].kappa), ())


def alone(problem: CoDesignProblem, kappa: Sequence[float]) -> CoDesignProblem:
    """The problem whose value is that of the climb from one controller, κ in SI."""
    sections = sections_of_problem(problem).with_anchor(tuple(map(float, kappa)), 1)
    return replace(problem, controller=replace(sections, starts=0))


def promised(
    problem: CoDesignProblem,
    known: Iterable[BandwidthSample],
    tried: Mapping[Theta, Sequence[Theta]],
) -> dict[Theta, Theta]:
    """κ to climb from at each θ whose sample falls short of what a neighbour promises.

    Only where that counts: near the best θ, or where it would be a better one. `tried`: the κ that
    a θ was climbed from in vain.
    """
    samples, figure, found = _usable(known), problem.figure, {}
    if not samples:
        return {}
    lower, upper = box(problem)
    best = min(samples, key=lambda sample: objective_of(problem, sample))
    least = objective_of(problem, best)
    for there in samples:
        before = tried.get(there.theta, ())
        if len(before) >= TRIES:
            continue
        hopes: list[tuple[float, Theta]] = []
        for one in _nearest(problem, samples, there.theta):
            slope = 0.5 * np.add(one.gradient, there.gradient)
            value = one.value + float(np.subtract(there.theta, one.theta) @ slope)
            away = np.abs(np.subtract(there.theta, best.theta) / (upper - lower)).max()
            counts = away <= NEAR or objective(problem, there.theta, value) < least
            if value > 0.0 and counts and one.kappa not in before:
                hopes.append((figure.gain(value, there.value), one.kappa))
        gain, kappa = max(hopes, default=(0.0, ()))
        if gain > WORTH:
            found[there.theta] = kappa
    return found


def better(problem: CoDesignProblem, one: BandwidthSample, than: BandwidthSample | None) -> bool:
    """Whether a sample is to replace the one that is known at its θ."""
    if than is None or not than.feasible:
        return than is None or one.feasible
    return one.feasible and problem.figure.gain(one.value, than.value) > 0.0


def _usable(known: Iterable[BandwidthSample]) -> list[BandwidthSample]:
    """Those with a controller of fixed structure, and slopes."""
    return [one for one in known if one.kappa and np.isfinite(one.gradient).all()]


def _nearest(
    problem: CoDesignProblem, samples: Sequence[BandwidthSample], theta: Theta
) -> list[BandwidthSample]:
    """The nearest samples at other θ."""
    others = [one for one in samples if one.theta != theta]
    if not others:
        return []
    lower, upper = box(problem)
    thetas: Array = np.array([one.theta for one in others])
    away = np.abs((thetas - theta) / (upper - lower)).max(axis=1)
    return [others[i] for i in np.argsort(away, kind="stable")[: len(theta) + MORE]]
