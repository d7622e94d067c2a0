"""Units of work: the inner problem at one θ, as a worker process computes it.

`InnerUnits` is all that the sampler knows of a kind of inner problem: how a sample is computed,
where its search begins beside known samples, and which samples are searched again. The table of
kinds stands in `unit_kinds`.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from time import perf_counter
from typing import TypeVar

import numpy as np

from ccd_casadi.inner_problem.kinds import bandwidth_gradient
from ccd_casadi.inner_problem.problem import CoDesignProblem, true_design, true_inner
from ccd_casadi.inner_problem.sweep import InnerBounds, InnerResult
from ccd_casadi.sampling.inner_samples import InnerSample, sample_of
from ccd_casadi.sampling.sample_keys import sample_key
from ccd_casadi.sampling.store import Sample
from ccd_casadi.support.process_pool import Pool
from ccd_casadi.support.time_budget import time_is_up

Theta = tuple[float, ...]
R = TypeVar("R")
Task = TypeVar("Task")


Unit = tuple[list[Sample], dict]  # rows of the store, and payload of the inner problem


@dataclass(frozen=True)
class Retry:
    """A sample to search again: its θ, and the problem with the start that promises more.

    Attributes
    ----------
    theta, kappa : tuple of float
        θ, and the controller of a neighbour from which the search starts; both SI.
    problem : CoDesignProblem
    """

    theta: Theta
    kappa: Theta
    problem: CoDesignProblem


class InnerUnits(ABC):
    """The samples of one kind of inner problem; by default each stands alone."""

    @abstractmethod
    def solve(
        self, problem: CoDesignProblem, problem_key: str, key: str, theta: Theta,
        workers: Pool | None = None,
    ) -> Unit:  # fmt: skip
        """Solve the inner problem at one θ.

        Parameters
        ----------
        problem, problem_key, key : CoDesignProblem, str, str
            The problem, its hash, and the key of the unit.
        theta : tuple of float
            SI.
        workers : Pool
            Processes that have nothing else to do.

        Returns
        -------
        rows, payload : list of Sample, dict
            A row for each design, and JSON values of the best.
        """

    def begin(
        self, problem: CoDesignProblem, known: Iterable[InnerSample], theta: Theta
    ) -> CoDesignProblem:
        """The problem with what known samples give a search at a new θ to start from."""
        return problem

    def begin_at(self, problem: CoDesignProblem, kappa: Sequence[float]) -> CoDesignProblem:
        """The problem whose search starts from one controller (κ in SI) alone, where it has one."""
        return problem

    def retries(
        self,
        problem: CoDesignProblem,
        known: Iterable[InnerSample],
        tried: Mapping[Theta, Sequence[Theta]],
    ) -> list[Retry]:
        """Samples to search again; `tried`: the κ that were in vain at a θ."""
        return []


def timed(
    unit: Callable[[Task], R], task: Task, at_any_time: bool = False
) -> tuple[R | None, bool]:
    """A unit of work, None where the time was up before unless it is due `at_any_time`, and whether
    it is whole: not ended by its time."""
    if time_is_up() and not at_any_time:
        return None, False
    return unit(task), not time_is_up()


class MixedUnits(InnerUnits):
    """Of mixed sensitivity: every synthesis of a search of (ω_S, ω_T) is a row."""

    def solve(
        self, problem: CoDesignProblem, problem_key: str, key: str, theta: Theta,
        workers: Pool | None = None,
    ) -> Unit:  # fmt: skip
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
        found["gradient"] = [json_number(v) for v in gradient]
    payload = {
        **found,
        "active": list(result.active),
        "shortfall": result.shortfall,
        "violation": json_number(result.violation),
        "syntheses": len(rows),
    }
    return list(rows.values()), payload


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


def json_number(value: float) -> float | None:
    """A number as the store keeps it: None where it is not finite."""
    return float(value) if np.isfinite(value) else None
