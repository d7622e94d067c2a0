"""Samples of the inner problem, and the record of the syntheses that they took."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from time import perf_counter, process_time
from typing import Any

import numpy as np

from ccd_casadi.inner_problem.objective import InnerValue
from ccd_casadi.inner_problem.sweep import InnerBounds
from ccd_casadi.sampling.store import COLUMNS, Sample
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.json_files import restore
from ccd_casadi.support.process_pool import Pool
from ccd_casadi.synthesis.derivatives import Sensitivities
from ccd_casadi.synthesis.synthesis import DesignFigures


class SynthesisCounts:
    """Counts of true syntheses, and times; `purpose` is what is being done.

    Parameters
    ----------
    workers : Pool, optional
        Whose processor time counts beside this process's.

    Attributes
    ----------
    reported : float
        The least J that was reported as the best so far.
    """

    def __init__(self, workers: Pool | None = None) -> None:
        self.purpose, self.reported = "samples", np.inf
        self._units: dict[str, tuple[str, int]] = {}
        self._workers, self._seconds = workers, dict[str, Array]()
        self._since = self._clocks()

    def _clocks(self) -> Array:
        beside = getattr(self._workers, "processor_seconds", 0.0)
        return np.array([perf_counter(), process_time() + beside])

    def seconds(self) -> dict[str, dict[str, float]]:
        """Return the seconds of the wall and of processors, workers' included, by purpose, up to
        now."""
        now = self._clocks()
        before = self._seconds.get(self.purpose, np.zeros(2))
        self._seconds[self.purpose] = before + now - self._since
        self._since = now
        return {name: dict(zip(("wall", "processor"), np.round(own, 3).tolist(), strict=True))
                for name, own in self._seconds.items()}  # fmt: skip

    @contextmanager
    def on(self, purpose: str) -> Iterator[None]:
        """Count the syntheses inside for this purpose."""
        self.seconds()
        before, self.purpose = self.purpose, purpose
        try:
            yield
        finally:
            self.seconds()
            self.purpose = before

    def once(self, unit: str, count: int) -> bool:
        """Count a unit of work; whether it is a new one."""
        new = unit not in self._units
        if new:
            self._units[unit] = (self.purpose, count)
        return new

    @property
    def total(self) -> int:
        """The number for all purposes."""
        return sum(count for _, count in self._units.values())

    @property
    def by_purpose(self) -> dict[str, int]:
        """The numbers by purpose, in the order in which they came up."""
        found: dict[str, int] = {}
        for purpose, count in self._units.values():
            found[purpose] = found.get(purpose, 0) + count
        return found


def spent_entry(spent: Mapping[str, int], moved: bool = False) -> dict[str, Any]:
    """Write the entry of result.json: all syntheses, by purpose, and those that led to the design.

    Parameters
    ----------
    spent : mapping
        Syntheses by purpose.
    moved : bool
        Whether the global check over the box changed the design: then it led to it too.

    Returns
    -------
    dict
        `syntheses`, `syntheses_to_optimum` and `spent`.

    Examples
    --------
    >>> spent_entry({"samples": 24, "box_look": 600})["syntheses_to_optimum"]
    24
    """
    total = sum(spent.values())
    beside = 0 if moved else spent.get("box_look", 0)
    return {"syntheses": total, "syntheses_to_optimum": total - beside, "spent": dict(spent)}


def with_all_spent(result: Mapping[str, Any], spent: Mapping[str, int]) -> dict[str, Any]:
    """A result of a run of several searches with the syntheses of all of them.

    Parameters
    ----------
    result : mapping
        result.json of the search that is kept.
    spent : mapping
        Syntheses of all, by purpose.

    Returns
    -------
    dict
        result.json of the run.
    """
    moved = bool(result.get("box_look", {}).get("moved"))  # the global check led to the design
    return {**result, **spent_entry(spent, moved)}


@dataclass(frozen=True)
class InnerSample(InnerValue):
    """The true value at θ, where it is reached, and what binds.

    Attributes
    ----------
    omega_S, omega_T : float
        rad/s; NaN with a fixed structure.
    active : tuple of str
        Bounds on the loop that bind.
    shortfall, violation : str, float
        Of an infeasible one: what falls short, and by how much (ln) at least.
    syntheses : int
        That it took.
    kappa : tuple of float
        κ of a fixed structure, SI.
    """

    omega_S: float
    omega_T: float
    active: tuple[str, ...]
    shortfall: str
    violation: float
    syntheses: int
    kappa: tuple[float, ...] = ()

    @property
    def searched(self) -> bool:
        """Whether the inner problem was solved there: the time was not up before."""
        return self.syntheses > 0

    @property
    def x(self) -> tuple[float, ...]:
        """The input of a surrogate of it: θ."""
        return self.theta

    @property
    def joint(self) -> Array:
        """(θ, ln ω_S, ln ω_T)."""
        return np.array([*self.theta, np.log(self.omega_S), np.log(self.omega_T)])


@dataclass(frozen=True)
class QuantitySample:
    """Values of one synthesis and their derivatives; NaN if it is not certified.

    Attributes
    ----------
    x : tuple of float
        (θ, ln ω_S, ln ω_T), SI.
    values : (k,) array
        ω_b in rad/s, ln of each bounded figure, γ_opt.
    gradients : (k, n_θ + 2) array
        Of the values to x.
    certified : bool
        Whether the design may be used.
    """

    x: tuple[float, ...]
    values: Array
    gradients: Array
    certified: bool


def sample_of(
    key: str,
    theta: tuple[float, ...],
    figures: DesignFigures,
    seconds: float,
    design: Sensitivities | None = None,
) -> Sample:
    """One synthesis as a row of the store.

    Parameters
    ----------
    key : str
        Of the row.
    theta : tuple of float
        SI.
    figures : DesignFigures
        SI.
    seconds : float
        That it took.
    design : Sensitivities
        With the derivatives, if these are kept.

    Returns
    -------
    Sample
        SI.
    """
    gradients = None
    if design is not None:
        whole = np.hstack([design.to_theta, design.to_break_frequencies])
        gradients = tuple(float(v) for v in whole.ravel())
    known = {
        name: getattr(source, name)
        for source in (figures.certificate, figures)
        for name in COLUMNS
        if hasattr(source, name)
    }
    own = {"outcome": figures.outcome.name.lower(), "reason": figures.outcome.value}
    return Sample(**known | own, key=key, theta=theta, seconds=seconds, gradients=gradients)


def inner_sample(theta: tuple[float, ...], payload: dict) -> InnerSample:
    """Read what was stored of a unit of work. Raises KeyError, TypeError or ValueError if
    damaged."""
    gradient = payload["gradient"] or [None] * len(theta)
    nothing = dict.fromkeys(("bandwidth", "omega_S", "omega_T"), np.nan) | {"violation": np.inf}
    given = nothing | {key: value for key, value in payload.items() if value is not None}
    given |= {"theta": theta, "gradient": [np.nan if v is None else v for v in gradient]}
    sample: InnerSample = restore(InnerSample, given)
    sizes = [1.0 if payload.get("error") is None else sample.error]
    if payload["bandwidth"] is not None:
        sizes += [sample.bandwidth]
        sizes += [] if "kappa" in payload else [sample.omega_S, sample.omega_T]
    if len(gradient) != len(theta) or not all(0.0 < size < np.inf for size in sizes):
        raise ValueError("a stored result holds what none is made of")
    return sample


def unsearched_sample(theta: tuple[float, ...]) -> InnerSample:
    """Make the sample of a θ that was not searched, since the time was up."""
    nothing = dict.fromkeys(("bandwidth", "gradient", "omega_S", "omega_T", "violation"))
    words = "the time budget ended before this theta was searched"
    own = {"active": [], "shortfall": words, "syntheses": 0}
    return inner_sample(theta, nothing | own)


def unsearched_quantities(x: tuple[float, ...], inner: InnerBounds) -> QuantitySample:
    """The same of a synthesis at x = (θ, ln ω_S, ln ω_T) that was not made."""
    count = 2 + len(inner.bounds)
    return QuantitySample(x, np.full(count, np.nan), np.full((count, len(x)), np.nan), False)


def quantity_sample(x: tuple[float, ...], sample: Sample, inner: InnerBounds) -> QuantitySample:
    """A row with derivatives as values at x.

    Parameters
    ----------
    x : tuple of float
        (θ, ln ω_S, ln ω_T), SI.
    sample : Sample
        With gradients.
    inner : InnerBounds
        Which figures are bounded.

    Returns
    -------
    QuantitySample
        See there.
    """
    assert sample.gradients is not None
    with np.errstate(invalid="ignore", divide="ignore"):
        bounded = np.log([getattr(sample, name) for name, _ in inner.bounds.values()])
        values = np.array([sample.bandwidth, *bounded, sample.gamma_opt])
    gradients = np.array(sample.gradients).reshape(len(values), len(x))
    return QuantitySample(x, values, gradients, sample.certified)
