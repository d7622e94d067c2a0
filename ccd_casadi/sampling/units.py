"""Units of work: what a worker computes at once, as rows of the store and a result.

One θ's inner problem, or a chunk of single designs at (θ, ω_S, ω_T).
"""

from collections.abc import Callable
from time import perf_counter

import numpy as np

from ccd_casadi.inner_problem.controller_problem import ControllerProblem, MixedSensitivityProblem
from ccd_casadi.inner_problem.kinds import bandwidth_gradient
from ccd_casadi.inner_problem.problem import CoDesignProblem, true_design, true_inner
from ccd_casadi.inner_problem.structured_bandwidth import structured_value
from ccd_casadi.inner_problem.structured_problem import StructuredProblem
from ccd_casadi.inner_problem.sweep import InnerBounds, InnerResult
from ccd_casadi.sampling.rows import Sample, sample_key
from ccd_casadi.sampling.samples import sample_of
from ccd_casadi.support.process_pool import Pool

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
    """Rows and payload of one θ's inner problem; `each` synthesis took so many seconds."""
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
    """The best design of a fixed structure at one θ: one row, without weights' frequencies."""
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
