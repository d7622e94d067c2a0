"""Samples of controllers of fixed structure: they share their controllers with neighbours.

On one branch of local optima v_j = v_i + ½ (∇v_i + ∇v_j)ᵀ (θ_j - θ_i), to third order. A sample
that falls short of what a neighbour's branch promises is searched again from that neighbour's
controller.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ccd_casadi.inner_problem.controller_problem import BANDWIDTH
from ccd_casadi.inner_problem.objective import objective, objective_of
from ccd_casadi.inner_problem.problem import CoDesignProblem, box
from ccd_casadi.inner_problem.searched_problem import with_warm_start
from ccd_casadi.inner_problem.structured_bandwidth import structured_value
from ccd_casadi.inner_problem.structured_problem import with_structured
from ccd_casadi.sampling.inner_samples import InnerSample
from ccd_casadi.sampling.store import Sample
from ccd_casadi.sampling.units import InnerUnits, Retry, Theta, Unit, json_number
from ccd_casadi.support.process_pool import LentWorkers, Pool


@dataclass(frozen=True)
class NeighbourOptions:
    """Numbers of warm starts from neighbours.

    Attributes
    ----------
    least_gain : float
        Relative: what another branch has to promise, and what a verdict counts as better.
    more : int
        Neighbours besides one for each parameter.
    near : float
        Of the box: so near the best θ a surrogate has to be of one branch.
    tries : int
        Searches of a sample from neighbours that may be in vain.
    """

    least_gain: float = 1e-3
    more: int = 2
    near: float = 0.1
    tries: int = 2


def from_neighbour(
    problem: CoDesignProblem,
    known: Iterable[InnerSample],
    theta: Theta,
    options: NeighbourOptions = NeighbourOptions(),
) -> CoDesignProblem:
    """The problem with the neighbour's controller that promises most at a new θ as a warm start."""
    near = _nearest(problem, _usable(known), theta, options.more)
    if not near:
        return problem

    def promise(one: InnerSample) -> float:
        return problem.figure.gain(_branch(one, theta, one.gradient), near[0].value)

    return with_warm_start(problem, max(near, key=promise).kappa)


def from_controller(problem: CoDesignProblem, kappa: Sequence[float]) -> CoDesignProblem:
    """The problem whose value is that of the search from one controller alone.

    Parameters
    ----------
    problem : CoDesignProblem
        With controllers of fixed structure.
    kappa : sequence of float
        κ of the controller, SI.

    Returns
    -------
    CoDesignProblem
        With it as the only warm start.
    """
    return with_structured(with_warm_start(problem, kappa, 1), starts=0)


def promising_starts(
    problem: CoDesignProblem,
    known: Iterable[InnerSample],
    tried: Mapping[Theta, Sequence[Theta]],
    options: NeighbourOptions = NeighbourOptions(),
) -> dict[Theta, Theta]:
    """κ to start from at each θ whose sample falls short of what a neighbour promises.

    Only where that counts: near the best θ, or where it would be a better one. `tried`: the κ that
    were in vain at a θ.
    """
    samples = _usable(known)
    found: dict[Theta, tuple[float, Theta]] = {}
    best = min(samples, key=lambda one: objective_of(problem, one), default=None)
    for there in samples:
        assert best is not None
        theta, before = there.theta, tried.get(there.theta, ())
        near = _nearest(problem, samples, theta, options.more)
        for one in near if len(before) < options.tries else []:
            value = _branch(one, theta, there.gradient)
            counts = bool(box(problem).away(best.theta, theta) <= options.near)
            counts = counts or objective(problem, theta, value) < objective_of(problem, best)
            gain = problem.figure.gain(value, there.value) if value > 0.0 else 0.0
            least = found.get(theta, (options.least_gain, ()))[0]
            if counts and one.kappa not in before and gain > least:
                found[theta] = (gain, one.kappa)
    return {theta: kappa for theta, (_, kappa) in found.items()}


def _usable(known: Iterable[InnerSample]) -> list[InnerSample]:
    """Select the samples with a controller of fixed structure, and slopes."""
    return [one for one in known if one.kappa and np.isfinite(one.gradient).all()]


def _branch(one: InnerSample, theta: Theta, gradient: Theta) -> float:
    """The value that a sample's branch has at another θ, where its gradient is this one."""
    slope = 0.5 * np.add(one.gradient, gradient)
    return one.value + float(np.subtract(theta, one.theta) @ slope)


def _nearest(
    problem: CoDesignProblem, samples: Sequence[InnerSample], theta: Theta, more: int
) -> list[InnerSample]:
    """The nearest samples at other θ."""
    others = [one for one in samples if one.theta != theta]
    if not others:
        return []
    away = box(problem).away([one.theta for one in others], theta)
    return [others[i] for i in np.argsort(away, kind="stable")[: len(theta) + more]]


class StructuredUnits(InnerUnits):
    """The units of work of a fixed structure: one row a search, without frequencies of weights."""

    def solve(
        self, problem: CoDesignProblem, problem_key: str, key: str, theta: Theta,
        workers: Pool | None = None,
    ) -> Unit:  # fmt: skip
        if workers is None and problem.figure is BANDWIDTH:  # descents of others depend on a pool
            workers = LentWorkers()
        value = structured_value(problem, theta, workers)
        design, judged = value.design, value.design.certificate
        peaks = [] if judged is None else [plant for plant in judged.plants if plant.stable]
        highest = max(
            ((plant.S_peak, plant.S_peak_frequency) for plant in peaks), default=(np.nan, np.nan)
        )
        row = Sample(
            key=key,
            theta=theta,
            omega_S=0.0,
            omega_T=0.0,
            outcome=design.outcome.name.lower(),
            reason=design.words,
            bandwidth=value.bandwidth,
            sensitivity_peak=highest[0],
            sensitivity_peak_frequency=highest[1],
            sensitivity_low=max((plant.S_low for plant in peaks), default=np.nan),
            norm=max({} if judged is None else judged.worst.values(), default=np.nan),
            norm_bound=1.0,
            certified=value.feasible,
            seconds=design.seconds,
        )
        payload = {
            "bandwidth": json_number(value.bandwidth),
            "gradient": [json_number(v) for v in value.gradient] if value.feasible else None,
            "kappa": [float(v) for v in design.kappa] if value.feasible else [],
            "error": json_number(value.error),
            "active": sorted(name for name, mu in design.multipliers.items() if mu > 0.0),
            "shortfall": "" if value.feasible else design.words,
            "violation": json_number(np.log(max(design.short.values()))) if design.short else None,
            "syntheses": value.syntheses,
        }
        return [row], payload

    def begin(
        self, problem: CoDesignProblem, known: Iterable[InnerSample], theta: Theta
    ) -> CoDesignProblem:
        return from_neighbour(problem, known, theta)

    def begin_at(self, problem: CoDesignProblem, kappa: Sequence[float]) -> CoDesignProblem:
        return from_controller(problem, kappa)

    def retries(
        self,
        problem: CoDesignProblem,
        known: Iterable[InnerSample],
        tried: Mapping[Theta, Sequence[Theta]],
    ) -> list[Retry]:
        starts = promising_starts(problem, known, tried).items()
        return [Retry(theta, kappa, from_controller(problem, kappa)) for theta, kappa in starts]
