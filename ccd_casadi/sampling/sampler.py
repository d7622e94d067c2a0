"""Offline sampling of the truth on all cores, through the store: nothing is computed twice.

A unit of work is one θ's inner problem, or a chunk of single designs at (θ, ω_S, ω_T). Its
rows and its result are written in one transaction, so a kill loses only units in flight.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from time import perf_counter

import numpy as np

from ccd_casadi.inner_problem.envelope import bandwidth_gradient
from ccd_casadi.inner_problem.problem import CoDesignProblem, plant_of, true_design, true_inner
from ccd_casadi.inner_problem.sections_bandwidth import sections_value
from ccd_casadi.inner_problem.sweep import InnerProblem, InnerResult
from ccd_casadi.plants.plant import constraint_values, hardware_cost
from ccd_casadi.sampling.store import Sample, SampleStore, problem_hash, sample_key
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.process_pool import Pool
from ccd_casadi.support.progress import Progress
from ccd_casadi.synthesis.derivatives import Sensitivities
from ccd_casadi.synthesis.synthesis import DesignFigures

CHUNK = 8  # single designs a unit at most


@dataclass(frozen=True)
class BandwidthSample:
    """ω_b*(θ) in rad/s and its gradient, where it is reached, and what binds; NaN if infeasible.

    An infeasible one says what falls short, and by how much (ln) at least: `violation`. With
    `error`, the least RMS error in m, the gradient is of that, and ω_b that of its controller.
    """

    theta: tuple[float, ...]
    bandwidth: float
    gradient: tuple[float, ...]
    omega_S: float
    omega_T: float
    active: tuple[str, ...]
    shortfall: str
    violation: float
    syntheses: int
    kappa: tuple[float, ...] = ()  # of a fixed structure, which has no ω_S and ω_T
    error: float | None = None

    @property
    def value(self) -> float:
        """What J counts: the error where the inner problem is of that, else ω_b*."""
        return self.bandwidth if self.error is None else self.error

    @property
    def feasible(self) -> bool:
        """Whether a certified design meets the constraints at θ."""
        return bool(np.isfinite(self.bandwidth))


@dataclass(frozen=True)
class QuantitySample:
    """Values and their derivatives (…, n_θ + 2) at x = (θ, ln ω_S, ln ω_T); NaN if uncertified.

    As `Sensitivities` has them: ω_b, ln of the bounded figures, γ_opt last.
    `peak_frequency` is where S is largest, rad/s; NaN where it is not known.
    """

    x: tuple[float, ...]
    values: Array
    gradients: Array
    certified: bool
    peak_frequency: float = float("nan")


@dataclass(frozen=True)
class TraceEntry:
    """After `syntheses` true syntheses: θ, its feasible bandwidth (rad/s) and J; NaN if none."""

    syntheses: int
    theta: tuple[float, ...]
    bandwidth: float
    objective: float


class Sampler:
    """The true synthesis behind a store and a pool of workers, counting what a run spends.

    `syntheses` counts every distinct design that the run asked for, whether it was computed now
    or found in the store: the figure does not depend on interruptions.
    """

    def __init__(
        self, problem: CoDesignProblem, store: SampleStore, workers: Pool, *, quiet: bool = True
    ) -> None:
        self.problem = problem
        self.store = store
        self.workers = workers
        self.quiet = quiet
        self.hash = problem_hash(problem.identity())
        self.inner_hash = problem_hash({"problem": self.hash, "inner": problem.inner_identity()})
        store.put_problem(self.hash, problem.identity())
        self._spent: dict[str, int] = {}
        self.trace: list[TraceEntry] = []
        self.nearest: BandwidthSample | None = None  # of the infeasible ones
        self.solved: dict[tuple[float, ...], BandwidthSample] = {}  # inner problems asked for

    def of(self, problem: CoDesignProblem, *, traced: bool = True) -> "Sampler":
        """One for another problem with the same store, workers and count; and trace, if `traced`.

        An easier problem's designs are worth nothing to this one: they are not traced.
        """
        other = Sampler(problem, self.store, self.workers, quiet=self.quiet)
        other._spent = self._spent
        if traced:
            other.trace = self.trace
        return other

    @property
    def syntheses(self) -> int:
        """Distinct true syntheses asked for so far."""
        return sum(self._spent.values())

    def bandwidths(self, thetas: Array, label: str = "sampling") -> list[BandwidthSample]:
        """ω_b* at every row of `thetas`, in their order."""
        points = [tuple(float(v) for v in theta) for theta in np.atleast_2d(thetas)]
        keys = [sample_key(self.inner_hash, theta, 0.0, 0.0) for theta in points]
        payloads = {key: self.store.get_result(key) for key in keys}
        missing = {key: theta for key, theta in zip(keys, points, strict=True) if not payloads[key]}
        with Progress(len(missing), label, quiet=self.quiet) as progress:
            tasks = [(self.problem, self.hash, key, theta) for key, theta in missing.items()]
            for samples, (key, theta, payload) in self.workers.map_unordered(inner_unit, tasks):
                unit = (key, self.inner_hash, theta, payload)
                self.store.put_unit(samples, unit, self.hash)
                payloads[key] = payload
                progress.advance()
        found = []
        for key, theta in zip(keys, points, strict=True):
            known = payloads[key]
            assert known is not None
            try:
                sample = _bandwidth_sample(theta, known)
            except (KeyError, TypeError, ValueError) as error:
                raise self.store.damaged() from error
            found.append(sample)
            self.solved[theta] = sample
            if not sample.feasible and (
                self.nearest is None or sample.violation < self.nearest.violation
            ):
                self.nearest = sample
            self._spend(key, sample.syntheses, theta, sample.value)
        return found

    def quantities(self, X: Array, label: str = "sampling") -> list[QuantitySample]:
        """Values and derivatives at every row of X = (θ, ln ω_S, ln ω_T), in their order."""
        points = [tuple(float(v) for v in x) for x in np.atleast_2d(X)]
        keys = [self._design_key(x) for x in points]
        count = len(self.problem.names)
        known = {key: s for key, s in self.store.get(keys).items() if s.gradients is not None}
        if any(
            len(sample.gradients or ()) != self._size * (count + 2) for sample in known.values()
        ):
            raise self.store.damaged()
        todo = list({k: x for k, x in zip(keys, points, strict=True) if k not in known}.items())
        size = min(CHUNK, max(1, -(-len(todo) // self.workers.count)))  # a few keep all at work
        chunks = [todo[i : i + size] for i in range(0, len(todo), size)]
        with Progress(len(todo), label, quiet=self.quiet) as progress:
            tasks = [(self.problem, chunk) for chunk in chunks]
            for samples, _ in self.workers.map_unordered(design_unit, tasks):
                self.store.put(samples, self.hash)
                known |= {sample.key: sample for sample in samples}
                progress.advance(len(samples))
        for x, key in zip(points, keys, strict=True):
            sample = known[key]
            self._spend(key, 1, x[:count], sample.bandwidth if self._meets(sample) else np.nan)
        inner = self.problem.inner
        return [quantity_sample(x, known[k], inner) for x, k in zip(points, keys, strict=True)]

    def design(self, x: Array) -> Sensitivities:
        """One true design at x, recorded."""
        point = np.asarray(x, float)
        made = true_design(self.problem, tuple(point[:-2]), *_frequencies(self.problem, point))
        self.record(point, made)
        return made

    def record(self, x: Array, design: Sensitivities) -> None:
        """Keep a design made outside the pool (IPOPT on the true function)."""
        point = tuple(float(v) for v in x)
        key = self._design_key(point)
        sample = sample_of(key, point[:-2], design.figures, 0.0, design)
        self.store.put([sample], self.hash)
        self._spend(key, 1, sample.theta, sample.bandwidth if self._meets(sample) else np.nan)

    def _spend(self, key: str, count: int, theta: tuple[float, ...], bandwidth: float) -> None:
        """Count a unit once, and keep what it was worth: NaN where it is not feasible."""
        if key in self._spent:
            return
        self._spent[key] = count
        objective = np.nan
        plant = plant_of(self.problem)
        if np.isfinite(bandwidth) and (constraint_values(plant, theta) <= 1e-9).all():
            cost = hardware_cost(plant, theta)
            objective = self.problem.w1 * cost + self.problem.w2 * bandwidth
        self.trace.append(TraceEntry(self.syntheses, theta, float(bandwidth), float(objective)))

    def _meets(self, sample: Sample) -> bool:
        return sample.certified and self.problem.inner.excess(sample) <= 0.0

    @property
    def _size(self) -> int:
        """Number of values of a design."""
        return 2 + len(self.problem.inner.bounds)

    def _design_key(self, x: tuple[float, ...]) -> str:
        return sample_key(self.hash, x[:-2], *_frequencies(self.problem, x))


def _frequencies(problem: CoDesignProblem, x: Sequence[float] | Array) -> tuple[float, float]:
    """ω_S, ω_T from their logarithms; exp(log(bound)) may miss the bound by a rounding error."""
    inner = problem.inner
    return (
        float(np.clip(np.exp(x[-2]), *inner.omega_S)),
        float(np.clip(np.exp(x[-1]), *inner.omega_T)),
    )


def inner_unit(
    task: tuple[CoDesignProblem, str, str, tuple[float, ...]],
) -> tuple[list[Sample], tuple[str, tuple[float, ...], dict]]:
    """Solve the inner problem at one θ; every synthesis becomes a row."""
    problem, problem_key, key, theta = task
    if problem.sections is not None:
        return sections_unit(problem, key, theta)
    began = perf_counter()
    result = true_inner(problem, theta)
    each = (perf_counter() - began) / max(result.syntheses, 1)
    rows, payload = unit_of(problem_key, theta, result, problem.inner, each)
    return rows, (key, theta, payload)


def unit_of(
    problem_key: str,
    theta: tuple[float, ...],
    result: InnerResult,
    inner: InnerProblem,
    each: float,
) -> tuple[list[Sample], dict]:
    """Rows and payload of one θ's inner problem; `each` synthesis took so many seconds."""
    rows = {}
    for figures in result.rows:
        row_key = sample_key(problem_key, theta, figures.omega_S, figures.omega_T)
        rows[row_key] = sample_of(row_key, theta, figures, each)
    optimum = result.optimum
    payload = {
        "bandwidth": None if optimum is None else optimum.figures.bandwidth,
        "gradient": None
        if optimum is None
        else [_number(v) for v in bandwidth_gradient(optimum, result.active, tuple(inner.bounds))],
        "omega_S": None if optimum is None else optimum.figures.omega_S,
        "omega_T": None if optimum is None else optimum.figures.omega_T,
        "active": list(result.active),
        "shortfall": result.shortfall,
        "violation": _number(result.violation),
        "syntheses": len(rows),
    }
    return list(rows.values()), payload


def sections_unit(
    problem: CoDesignProblem, key: str, theta: tuple[float, ...]
) -> tuple[list[Sample], tuple[str, tuple[float, ...], dict]]:
    """The best design of a fixed structure at one θ: one row, without weights' frequencies."""
    value = sections_value(problem, theta)
    design, judged = value.design, value.design.certificate
    worst = None if judged is None or not judged.worst else max(judged.worst.values())
    peaks = [] if judged is None else [plant for plant in judged.plants if plant.stable]
    highest = max(peaks, key=lambda plant: plant.S_peak, default=None)
    row = Sample(
        key=key,
        theta=theta,
        omega_S=0.0,
        omega_T=0.0,
        outcome=design.outcome.name.lower(),
        reason=design.words,
        gamma_opt=np.nan,
        gamma_lower_bound=np.nan,
        gamma=np.nan,
        bandwidth=value.bandwidth,
        sensitivity_peak=np.nan if highest is None else highest.S_peak,
        sensitivity_peak_frequency=np.nan if highest is None else highest.S_peak_frequency,
        sensitivity_low=max((plant.S_low for plant in peaks), default=np.nan),
        max_real_pole=np.nan,
        norm=np.nan if worst is None else worst,
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
    return [row], (key, theta, payload)


def design_unit(
    task: tuple[CoDesignProblem, list[tuple[str, tuple[float, ...]]]],
) -> tuple[list[Sample], None]:
    """Synthesise and differentiate a chunk of points (key, x)."""
    problem, points = task
    samples = []
    for key, x in points:
        began = perf_counter()
        design = true_design(problem, x[:-2], *_frequencies(problem, x))
        samples.append(sample_of(key, x[:-2], design.figures, perf_counter() - began, design))
    return samples, None


def sample_of(
    key: str,
    theta: tuple[float, ...],
    figures: DesignFigures,
    seconds: float,
    design: Sensitivities | None = None,
) -> Sample:
    """One synthesis as a row of the store, with derivatives where `design` has them."""
    gradients = None
    if design is not None:
        whole = np.hstack([design.to_theta, design.to_break_frequencies])
        gradients = tuple(float(v) for v in whole.ravel())
    certificate = figures.certificate
    return Sample(
        key=key,
        theta=theta,
        omega_S=figures.omega_S,
        omega_T=figures.omega_T,
        outcome=figures.outcome.name.lower(),
        reason=figures.outcome.value,
        gamma_opt=figures.gamma_opt,
        gamma_lower_bound=figures.gamma_lower_bound,
        gamma=figures.gamma,
        bandwidth=figures.bandwidth,
        sensitivity_peak=figures.sensitivity_peak,
        sensitivity_peak_frequency=figures.sensitivity_peak_frequency,
        sensitivity_low=figures.sensitivity_low,
        max_real_pole=certificate.max_real_pole,
        norm=certificate.norm,
        norm_bound=certificate.norm_bound,
        certified=figures.certified,
        seconds=seconds,
        gradients=gradients,
        compliance=figures.compliance,
    )


def _bandwidth_sample(theta: tuple[float, ...], payload: dict) -> BandwidthSample:
    """What was stored of a unit of work. Raises KeyError, TypeError or ValueError if damaged."""
    feasible = payload["bandwidth"] is not None
    nan = float("nan")
    gradient = payload["gradient"] or [None] * len(theta)
    active, shortfall = payload["active"], payload["shortfall"]
    kappa, error = payload.get("kappa"), payload.get("error")
    sized = ("bandwidth",) if kappa is not None else ("bandwidth", "omega_S", "omega_T")
    positive = [payload[key] for key in sized] if feasible else []
    violation, syntheses = payload["violation"], payload["syntheses"]
    if (
        len(gradient) != len(theta)
        or not all(v is None or type(v) is float for v in gradient)
        or not all(type(v) is float and 0.0 < v < np.inf for v in positive)
        or not (violation is None or type(violation) is float)
        or not all(isinstance(word, str) for word in [shortfall, *active])
        or type(syntheses) is not int
        or not all(type(v) is float for v in kappa or ())
        or not (error is None or (type(error) is float and error > 0.0))
    ):
        raise ValueError("a stored result holds what none is made of")
    return BandwidthSample(
        theta=theta,
        bandwidth=payload["bandwidth"] if feasible else nan,
        gradient=tuple(nan if v is None else v for v in gradient),
        omega_S=payload["omega_S"] if feasible and kappa is None else nan,
        omega_T=payload["omega_T"] if feasible and kappa is None else nan,
        active=tuple(active),
        shortfall=shortfall,
        violation=np.inf if violation is None else violation,
        syntheses=syntheses,
        kappa=tuple(kappa or ()),
        error=error,
    )


def quantity_sample(x: tuple[float, ...], sample: Sample, inner: InnerProblem) -> QuantitySample:
    """A row with derivatives as values at x, of the figures that `inner` bounds."""
    assert sample.gradients is not None
    with np.errstate(invalid="ignore", divide="ignore"):
        bounded = np.log([getattr(sample, name) for name, _ in inner.bounds.values()])
        values = np.array([sample.bandwidth, *bounded, sample.gamma_opt])
    gradients = np.array(sample.gradients).reshape(len(values), len(x))
    where = sample.sensitivity_peak_frequency
    return QuantitySample(x, values, gradients, sample.certified, where)


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
