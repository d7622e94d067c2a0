"""Units of work: the inner problem at one θ, as a worker process computes it, and where neighbours
let it begin."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from time import perf_counter
from typing import TypeVar

import numpy as np

from ccd_casadi.inner_problem.controller_problem import ControllerProblem, MixedSensitivityProblem
from ccd_casadi.inner_problem.kinds import bandwidth_gradient
from ccd_casadi.inner_problem.objective import objective, objective_of
from ccd_casadi.inner_problem.problem import CoDesignProblem, box, true_design, true_inner
from ccd_casadi.inner_problem.structured_bandwidth import structured_value
from ccd_casadi.inner_problem.structured_plant_set import structured_of
from ccd_casadi.inner_problem.structured_problem import StructuredProblem
from ccd_casadi.inner_problem.structured_search import with_warm_start
from ccd_casadi.inner_problem.sweep import InnerBounds, InnerResult
from ccd_casadi.sampling.inner_samples import InnerSample, sample_of
from ccd_casadi.sampling.sample_keys import sample_key
from ccd_casadi.sampling.store import Sample
from ccd_casadi.support.process_pool import Pool
from ccd_casadi.support.time_budget import time_is_up


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


Theta = tuple[float, ...]
R = TypeVar("R")
Task = TypeVar("Task")


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
    structured = structured_of(problem).with_warm_start(tuple(map(float, kappa)), 1)
    return replace(problem, controller=replace(structured, starts=0))


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
    """Those with a controller of fixed structure, and slopes."""
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


NOTHING = (np.nan, np.nan)
Unit = tuple[list[Sample], dict]  # rows of the store, and payload of the inner problem


def inner_unit(
    task: tuple[CoDesignProblem, str, str, tuple[float, ...]], workers: Pool | None = None
) -> tuple[str, Unit]:
    """Solve the inner problem at one θ; every synthesis becomes a row. First the unit's key.

    `workers`: those that have nothing else to do.
    """
    problem, problem_key, key, theta = task
    return key, UNITS[type(problem.controller)](problem, problem_key, key, theta, workers)


def timed(
    unit: Callable[[Task], R], task: Task, at_any_time: bool = False
) -> tuple[R | None, bool]:
    """A unit of work, None where the time was up before unless it is due `at_any_time`, and whether
    it is whole: not ended by its time."""
    if time_is_up() and not at_any_time:
        return None, False
    return unit(task), not time_is_up()


def mixed_unit(
    problem: CoDesignProblem, problem_key: str, key: str, theta: tuple[float, ...],
    workers: Pool | None = None,
) -> Unit:  # fmt: skip
    """The search of (ω_S, ω_T) at one θ."""
    began = perf_counter()
    result = true_inner(problem, theta)
    each = (perf_counter() - began) / max(result.syntheses, 1)
    return unit_of(problem_key, theta, result, problem.inner, each)


def unit_of(
    problem_key: str, theta: tuple[float, ...], result: InnerResult, inner: InnerBounds, each: float
) -> Unit:
    """What the store keeps of one θ's inner problem.

    Parameters
    ----------
    problem_key : str
        Hash of the problem.
    theta : tuple of float
        SI.
    result : InnerResult
        Of mixed sensitivity.
    inner : InnerBounds
        Of the loop.
    each : float
        Time of a synthesis, s.

    Returns
    -------
    rows, payload : list of Sample, dict
        One row a synthesis, and JSON values of the best.
    """
    rows = {}
    for figures in result.rows:
        row_key = sample_key(problem_key, theta, figures.omega_S, figures.omega_T)
        rows[row_key] = sample_of(row_key, theta, figures, each)
    found = dict.fromkeys(("bandwidth", "omega_S", "omega_T", "gradient"))
    if (optimum := result.optimum) is not None:
        found = {name: getattr(optimum.figures, name, None) for name in found}
        gradient = bandwidth_gradient(optimum, result.active, tuple(inner.bounds))
        found["gradient"] = [_number(v) for v in gradient]
    payload = {
        **found,
        "active": list(result.active),
        "shortfall": result.shortfall,
        "violation": _number(result.violation),
        "syntheses": len(rows),
    }
    return list(rows.values()), payload


def structured_unit(
    problem: CoDesignProblem, problem_key: str, key: str, theta: tuple[float, ...],
    workers: Pool | None = None,
) -> Unit:  # fmt: skip
    """The best design of a fixed structure at one θ: one row, without weights' frequencies.

    Parameters
    ----------
    problem, problem_key, key : CoDesignProblem, str, str
        The problem, its hash, and the key of the row.
    theta : tuple of float
        SI.
    workers : Pool
        Processes that have nothing else to do.

    Returns
    -------
    rows, payload : list of Sample, dict
        As of `unit_of`.
    """
    value = structured_value(problem, theta, workers)
    design, judged = value.design, value.design.certificate
    peaks = [] if judged is None else [plant for plant in judged.plants if plant.stable]
    highest = max(((plant.S_peak, plant.S_peak_frequency) for plant in peaks), default=NOTHING)
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
        "bandwidth": _number(value.bandwidth),
        "gradient": [_number(v) for v in value.gradient] if value.feasible else None,
        "kappa": [float(v) for v in design.kappa] if value.feasible else [],
        "error": _number(value.error),
        "active": sorted(name for name, mu in design.multipliers.items() if mu > 0.0),
        "shortfall": "" if value.feasible else design.words,
        "violation": _number(np.log(max(design.short.values()))) if design.short else None,
        "syntheses": value.syntheses,
    }
    return [row], payload


# One entry for each class of `CoDesignProblem.controller`; another kind adds its own.
UNITS: dict[type[ControllerProblem], Callable[..., Unit]] = {
    MixedSensitivityProblem: mixed_unit,
    StructuredProblem: structured_unit,
}


def design_unit(
    task: tuple[CoDesignProblem, list[tuple[str, tuple[float, ...]]]],
) -> tuple[list[Sample], None]:
    """Synthesise and differentiate a chunk of points (key, x)."""
    problem, points = task
    samples = []
    for key, x in points:
        began = perf_counter()
        design = true_design(problem, x[:-2], *problem.inner.frequencies(x))
        samples.append(sample_of(key, x[:-2], design.figures, perf_counter() - began, design))
    return samples, None


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
