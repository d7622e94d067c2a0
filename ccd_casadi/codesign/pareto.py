"""The front of hardware cost against bandwidth, and the derivatives of its optimum."""

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np

from ccd_casadi.cases.run_folder import FinishedRun
from ccd_casadi.codesign.outer import OuterSearch
from ccd_casadi.codesign.post_optimal import PostOptimal
from ccd_casadi.codesign.structured_entries import bound_words
from ccd_casadi.inner_problem.objective import objective_of, violations
from ccd_casadi.inner_problem.problem import box, plant_of
from ccd_casadi.plants.plant import hardware_cost
from ccd_casadi.sampling.inner_samples import InnerSample
from ccd_casadi.sampling.sampler import Sampler
from ccd_casadi.support.errors import UserError
from ccd_casadi.support.terminal import Progress
from ccd_casadi.support.text import HZ, versions
from surrogates import design


@dataclass(frozen=True)
class FrontOptions:
    """Numbers of the search for a front."""

    costs: int = 64  # θ whose hardware cost is computed, for its range
    constant: float = 1e-9  # relative: a hardware cost that moves less over the box is constant
    end_weight: float = (
        1e-3  # at the ends: share of the range of one that counts as all of the other
    )
    same: float = 1e-9  # relative: a design that is faster by less is as fast
    least_gain: float = 1e-3  # of the triangle between two neighbours


@dataclass(frozen=True, kw_only=True)
class FrontPoint(InnerSample):
    """A design that is the best for some weights; `worth`: v(θ), and -v where less is better.

    `verified`: the inner problem at θ has a certified design, and the solve ended at a stationary
    point of its J.
    """

    hardware_cost: float
    worth: float
    verified: bool


@dataclass(frozen=True)
class Front:
    """The front of hardware cost against what J counts of the controller.

    Attributes
    ----------
    points : tuple of FrontPoint
        In order of their cost.
    whole : bool
        Whether no weights lead to a design between two of them, as far as local solves find.
    syntheses : int
        Spent by the sampler up to then.
    """

    points: tuple[FrontPoint, ...]
    whole: bool
    syntheses: int


def pareto_front(
    outer_of: Callable[[Sampler], OuterSearch],
    sampler: Sampler,
    own: Sequence[float],
    *,
    points: int = 20,
    seed: int = 0,
    options: FrontOptions = FrontOptions(),
) -> Front:
    """Find the designs that are the best for some weights w1 and w2.

    Parameters
    ----------
    outer_of : function of Sampler
        The outer problem of a sampler.
    sampler : Sampler
        Of the problem; its weights do not count.
    own : (n_θ,) sequence
        θ of a good design, SI.
    points : int
        At most.
    seed : int
        Of the θ whose hardware cost gives its range.
    options : FrontOptions
        Numbers of the method.

    Returns
    -------
    Front
        Its convex part: what no weights lead to is not found.

    Raises
    ------
    UserError
        The hardware cost is constant, or `own` has no certified design.
    """
    problem, plant = sampler.problem, plant_of(sampler.problem)
    examined = np.vstack([own, design("sobol", *box(problem), options.costs, seed)])
    costs = np.array([hardware_cost(plant, theta) for theta in examined])
    f_range = np.ptp(costs)
    if not f_range > options.constant * np.abs(costs).max():
        raise UserError("hardware_cost is the same all over the box: there is nothing to trade")
    allowed = [i for i in np.argsort(costs) if not violations(problem, examined[i])]
    started = sampler.values(examined[[0, allowed[0], allowed[-1]]], "starts of the front")
    if not started[0].feasible:
        raise UserError(f"the run's design is not certified: {started[0].shortfall}")
    started = [sample for sample in started if sample.feasible]
    size, sign = started[0].value, 1.0 if problem.figure.larger_is_better else -1.0

    def solved(a: float, b: float, begin: Sequence[InnerSample]) -> FrontPoint | None:
        """The best design for these weights, of local solves from some designs; where each value
        is a search over the controller, from the best of them alone."""
        weighted = replace(problem, w1=a, w2=-sign * b)
        outer = outer_of(sampler.of(weighted, traced=False, quiet=True))
        if not outer.global_check_is_cheap:
            begin = [min(begin, key=lambda sample: objective_of(weighted, sample))]
        places = [outer.local_solve(sample, ()) for sample in begin]
        found = [place for place in places if place is not None]
        if not found:
            return None
        best = min(found, key=lambda place: place.objective)
        return _point(sampler, outer.theta_of(best.x), best.stationary)

    extreme, straight = options.end_weight, set[tuple[FrontPoint, FrontPoint]]()
    with Progress(points, "points of the front", quiet=sampler.quiet) as progress:
        ends = [solved(w / f_range, extreme / w / size, started) for w in (1.0, extreme)]
        kept = hull(
            [_point(sampler, own, True), *(end for end in ends if end is not None)], options.same
        )
        while True:
            progress.advance(len(kept) - progress.done)
            pairs = [pair for pair in pairwise(kept) if pair not in straight]
            if not pairs or len(kept) >= points:
                return Front(tuple(kept), not pairs, sampler.syntheses)
            steps = [
                (two.worth - one.worth, two.hardware_cost - one.hardware_cost) for one, two in pairs
            ]
            widest = int(np.argmax([np.hypot(up / size, along / f_range) for up, along in steps]))
            (light, fast), (a, b) = pairs[widest], steps[widest]
            new = solved(a, b, sampler.values(np.array([light.theta, fast.theta])))
            if new is None or _gain(light, new, a, b) <= options.least_gain:
                straight.add((light, fast))
            else:
                kept = hull([*kept, new], options.same)


def _gain(light: FrontPoint, new: FrontPoint, a: float, b: float) -> float:
    """Return how far a point lies beyond the line from `light` that has this slope, as a share of
    both."""
    lighter = (light.hardware_cost - new.hardware_cost) / b
    return lighter + (new.worth - light.worth) / a


def _point(sampler: Sampler, theta: Sequence[float] | np.ndarray, stationary: bool) -> FrontPoint:
    up = sampler.problem.figure.larger_is_better
    sample = sampler.values(np.asarray(theta, float), "verifying")[0]
    active = tuple(bound_words(sample.active)) if sample.kappa else sample.active
    return FrontPoint(
        **vars(sample) | {"active": active},
        hardware_cost=hardware_cost(plant_of(sampler.problem), sample.theta),
        worth=sample.value if up else -sample.value,
        verified=sample.feasible and stationary,
    )


def hull(points: Sequence[FrontPoint], same: float = FrontOptions().same) -> list[FrontPoint]:
    """Select the points that are the best of all for some weights, in order of cost."""
    kept: list[FrontPoint] = []
    for point in sorted(points, key=lambda point: (point.hardware_cost, -point.worth)):
        if not np.isfinite(point.worth):
            continue
        if kept and point.worth - kept[-1].worth <= same * abs(point.worth):
            continue
        while len(kept) > 1 and _slope(kept[-2], kept[-1]) <= _slope(kept[-1], point):
            kept.pop()
        kept.append(point)
    return kept


def _slope(light: FrontPoint, fast: FrontPoint) -> float:
    return (fast.worth - light.worth) / (fast.hardware_cost - light.hardware_cost)


def natural_hz(run: FinishedRun) -> tuple[float, ...]:
    """Natural frequencies of the flexible modes at the design.

    Parameters
    ----------
    run : FinishedRun
        A run with a design.

    Returns
    -------
    tuple of float
        Hz, ascending.
    """
    modal = run.modal()
    return tuple(float(w) / HZ for w in modal.natural[~modal.rigid & ~modal.driven_away])


def bandwidth_of(run: FinishedRun) -> float:
    """ω_b of a run's design: with sections that of every plant of the set.

    Parameters
    ----------
    run : FinishedRun
        A run with a design.

    Returns
    -------
    float
        rad/s.
    """
    return HZ * float(run.result["bandwidth_hz"])


def insight_dict(run: FinishedRun, front: Front, responses: PostOptimal) -> dict[str, Any]:
    """The content of insight.json: SI, and Hz where a key says so.

    Parameters
    ----------
    run : FinishedRun
        The run with the optimum.
    front, responses : Front, PostOptimal
        What was found of it.

    Returns
    -------
    dict
        JSON values.
    """
    names = run.problem.names
    points = [
        {
            "theta": dict(zip(names, point.theta, strict=True)),
            "hardware_cost": point.hardware_cost,
            run.problem.figure.entry: point.value,
            "bandwidth_hz": point.bandwidth / HZ,
            "omega_S_hz": point.omega_S / HZ,  # NaN with sections
            "omega_T_hz": point.omega_T / HZ,
            "active": list(point.active),
            "status": "verified" if point.verified else "not_verified",
        }
        for point in front.points
    ]
    natural = natural_hz(run)
    return {
        "front": {"points": points, "whole": front.whole, "syntheses": front.syntheses},
        "optimum": {
            "responses": {item.parameter: asdict(item) for item in responses.responses},
            "determined": responses.determined,
            "weakly_active": list(responses.weak),
            "stationarity": responses.kkt.stationarity,
        },
        "natural_hz": list(natural),
        "first_resonance_over_bandwidth": (
            min(natural) * HZ / bandwidth_of(run) if natural else None
        ),
        "versions": versions(),
    }
