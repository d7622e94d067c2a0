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
from ccd_casadi.inner_problem.structured_plant_set import structured_of
from ccd_casadi.inner_problem.structured_search import with_warm_start
from ccd_casadi.sampling.samples import InnerSample

WORTH = 1e-3  # relative: what another branch has to promise, and what a verdict counts as better
MORE = 2  # neighbours, beside one for each parameter
NEAR = 0.1  # of the box: so near the best θ a surrogate has to be of one branch
TRIES = 2  # climbs from neighbours, of a sample, that may be in vain

Theta = tuple[float, ...]


def from_neighbour(
    problem: CoDesignProblem, known: Iterable[InnerSample], theta: Theta
) -> CoDesignProblem:
    """The problem with the neighbour's controller that promises most at a new θ as a warm start."""
    near = _nearest(problem, _usable(known), theta)
    if not near:
        return problem

    def promise(one: InnerSample) -> float:
        return problem.figure.gain(_branch(one, theta, one.gradient), near[0].value)

    return with_warm_start(problem, max(near, key=promise).kappa)


def from_controller(problem: CoDesignProblem, kappa: Sequence[float]) -> CoDesignProblem:
    """The problem whose value is that of the climb from one controller, κ in SI."""
    structured = structured_of(problem).with_warm_start(tuple(map(float, kappa)), 1)
    return replace(problem, controller=replace(structured, starts=0))


def promising_starts(
    problem: CoDesignProblem, known: Iterable[InnerSample], tried: Mapping[Theta, Sequence[Theta]]
) -> dict[Theta, Theta]:
    """κ to climb from at each θ whose sample falls short of what a neighbour promises.

    Only where that counts: near the best θ, or where it would be a better one. `tried`: the κ that
    a θ was climbed from in vain.
    """
    samples = _usable(known)
    found: dict[Theta, tuple[float, Theta]] = {}
    best = min(samples, key=lambda one: objective_of(problem, one), default=None)
    for there in samples:
        assert best is not None
        theta, before = there.theta, tried.get(there.theta, ())
        for one in _nearest(problem, samples, theta) if len(before) < TRIES else []:
            value = _branch(one, theta, there.gradient)
            counts = bool(box(problem).away(best.theta, theta) <= NEAR)
            counts = counts or objective(problem, theta, value) < objective_of(problem, best)
            gain = problem.figure.gain(value, there.value) if value > 0.0 else 0.0
            if counts and one.kappa not in before and gain > found.get(theta, (WORTH, ()))[0]:
                found[theta] = (gain, one.kappa)
    return {theta: kappa for theta, (_, kappa) in found.items()}


def _usable(known: Iterable[InnerSample]) -> list[InnerSample]:
    """Those with a controller of fixed structure, and slopes."""
    return [one for one in known if one.kappa and np.isfinite(one.gradient).all()]


def _branch(one: InnerSample, theta: Theta, gradient: Theta) -> float:
    """The value that a sample's branch has at another θ, where its gradient is this one."""
    slope = 0.5 * np.add(one.gradient, gradient)
    return one.value + float(np.subtract(theta, one.theta) @ slope)


def _nearest(
    problem: CoDesignProblem, samples: Sequence[InnerSample], theta: Theta
) -> list[InnerSample]:
    """The nearest samples at other θ."""
    others = [one for one in samples if one.theta != theta]
    if not others:
        return []
    away = box(problem).away([one.theta for one in others], theta)
    return [others[i] for i in np.argsort(away, kind="stable")[: len(theta) + MORE]]
