"""Units of work: the inner problem at one θ, as a worker process computes it.

`InnerUnits` is all that the sampler knows of a kind of inner problem: how a sample is computed,
where its search begins beside known samples, and which samples are searched again. The table of
kinds stands in `unit_kinds`.

Hashed keys of problems and samples: what determines a synthesis, exact in every float.
"""

import hashlib
import json
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from numbers import Integral, Real
from time import perf_counter
from typing import TypeVar

import numpy as np

from ccd_casadi.inner_problem.kinds import bandwidth_gradient
from ccd_casadi.inner_problem.problem import CoDesignProblem, true_design, true_inner
from ccd_casadi.inner_problem.sweep import InnerBounds, InnerResult
from ccd_casadi.sampling.inner_samples import InnerSample, sample_of
from ccd_casadi.sampling.store import Sample
from ccd_casadi.support.process_pool import Pool
from ccd_casadi.support.time_budget import time_is_up


def problem_hash(problem: Mapping[str, object]) -> str:
    """SHA-256 of a mapping, exact in every float; the order of its keys does not count.

    Parameters
    ----------
    problem : mapping
        Of plain values: text, numbers, lists and mappings.

    Returns
    -------
    str
        Hexadecimal.

    Raises
    ------
    ValueError
        A number is NaN or infinite.
    TypeError
        A value is not plain.

    Examples
    --------
    >>> problem_hash({"a": 1, "b": 0.1}) == problem_hash({"b": 0.1, "a": 1.0})
    True
    """
    text = json.dumps(_canonical(problem), sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()


def hashes_of(problem: CoDesignProblem) -> tuple[str, str]:
    """Hashes of a problem.

    Parameters
    ----------
    problem : CoDesignProblem
        The problem.

    Returns
    -------
    designs, inner : str
        Of its single designs, and of its inner problems.
    """
    designs = problem_hash(problem.identity())
    return designs, problem_hash({"problem": designs, "inner": problem.inner_identity()})


def sample_key(
    problem: str, theta: Sequence[float], omega_S: float = 0.0, omega_T: float = 0.0
) -> str:
    """The key of one synthesis of a problem, or of what is known at a whole θ (both ω 0).

    Parameters
    ----------
    problem : str
        A hash.
    theta : sequence of float
        SI.
    omega_S, omega_T : float
        rad/s.

    Returns
    -------
    str
        Exact in every float.
    """
    return problem_hash({"problem": problem, "theta": list(theta), "omega": [omega_S, omega_T]})


def best_key(inner: str, theta: Sequence[float]) -> str:
    """The key of the best found at a θ from other controllers than the inner problem's own.

    Parameters
    ----------
    inner : str
        Hash of the inner problem.
    theta : sequence of float
        SI.

    Returns
    -------
    str
        Exact in every float.
    """
    return sample_key(problem_hash({"best": inner}), theta)


def _canonical(value: object) -> object:
    if isinstance(value, Mapping):
        if not all(isinstance(key, str) for key in value):
            raise TypeError("a name that is not text cannot be part of a key")
        return {key: _canonical(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_canonical(item) for item in value]
    if value is None or isinstance(value, bool):
        return value
    if isinstance(value, str):
        return f"'{value}"  # the mark keeps a text apart from the number that it spells
    if isinstance(value, Integral) and abs(int(value)) > 2**53:
        return str(int(value))  # no float is exact
    if isinstance(value, Integral | Real):
        number = float(value) + 0.0  # -0.0 becomes 0.0
        if not math.isfinite(number):
            raise ValueError(f"{number} cannot be part of a key; give finite numbers")
        return number.hex()
    raise TypeError(f"{type(value).__name__} cannot be part of a key")


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


def solve_in_time(
    unit: Callable[[Task], R], task: Task, at_any_time: bool = False
) -> tuple[R | None, bool]:
    """A unit of work, None where the time was up before unless it is due `at_any_time`, and whether
    it is whole: not ended by its time."""
    if time_is_up() and not at_any_time:
        return None, False
    return unit(task), not time_is_up()


class MixedUnits(InnerUnits):
    """The units of work of mixed sensitivity: every synthesis of a search of (ω_S, ω_T) is a
    row."""

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
    """Return what the store keeps of one θ's inner problem.

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
