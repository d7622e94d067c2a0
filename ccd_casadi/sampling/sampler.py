"""Offline sampling of the truth on all cores, through the store: nothing is computed twice.

The rows and the result of a unit of work (`units`) are written in one transaction, so a kill loses
only units in flight. What a polish asks for one after the other (`truth`) and what is judged in the
end is stored whole (`kept`), with the controller, as it is made.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import TypeVar

import numpy as np

from ccd_casadi.inner_problem.objective import TrueQuantities, objective, violations
from ccd_casadi.inner_problem.problem import CoDesignProblem, plant_of
from ccd_casadi.sampling.inner_samples import (
    InnerSample,
    QuantitySample,
    SynthesisCounts,
    inner_sample,
    quantity_sample,
    sample_of,
    unsearched_quantities,
    unsearched_sample,
)
from ccd_casadi.sampling.store import Sample, SampleStore
from ccd_casadi.sampling.unit_kinds import inner_unit, units_of
from ccd_casadi.sampling.units import (
    best_key,
    design_unit,
    hashes_of,
    problem_hash,
    sample_key,
    solve_in_time,
)
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.process_pool import Pool, results
from ccd_casadi.support.terminal import Progress, remark
from ccd_casadi.support.text import HZ
from ccd_casadi.support.time_budget import not_searched, time_is_up
from ccd_casadi.synthesis.derivatives import Sensitivities

T = TypeVar("T")


@dataclass(frozen=True)
class TraceEntry:
    """One line of the record of a run.

    Attributes
    ----------
    syntheses : int
        True syntheses up to then.
    theta : tuple of float
        SI.
    bandwidth, objective : float
        ω_b in rad/s and J of a feasible design there; NaN if there is none.
    """

    syntheses: int
    theta: tuple[float, ...]
    bandwidth: float
    objective: float


class Sampler:
    """The true synthesis behind a store and a pool of workers, counting what a run spends.

    `syntheses` counts every distinct design that the run needed, whether it was computed now
    or found in the store: the figure does not depend on interruptions.

    Parameters
    ----------
    problem : CoDesignProblem
        What is synthesised.
    store : SampleStore
        Open; what it holds is not computed again.
    workers : Pool
        Processes.
    quiet : bool
        Whether to show no progress on stderr.

    Attributes
    ----------
    spent : SynthesisCounts
        By purpose.
    trace : list of TraceEntry
        In the order of the syntheses.
    solved : dict
        The best InnerSample at each θ.
    nearest : InnerSample or None
        Of the infeasible ones.
    improvements : int
        Times that a better controller was found where one had been known.
    bandwidth_at_start : float or None
        In rad/s, of a search at the start of θ that no sample holds.
    """

    chunk = 8  # single designs a unit at most
    reported_gain = 1e-4  # of J: a design that is better by more is reported

    def __init__(
        self, problem: CoDesignProblem, store: SampleStore, workers: Pool, *, quiet: bool = True
    ) -> None:
        self.problem = problem
        self.store = store
        self.workers = workers
        self.quiet = quiet
        self.hash, self.inner_hash = hashes_of(problem)
        store.put_problem(self.hash, problem.identity())
        self.spent = SynthesisCounts(workers)
        self.trace: list[TraceEntry] = []
        self.nearest: InnerSample | None = None
        self.solved: dict[tuple[float, ...], InnerSample] = {}
        self.whole = True  # not of a part of the box, whose best may be worse than another's
        self.improvements = 0
        self.bandwidth_at_start: float | None = None
        self._tried: dict[tuple[float, ...], list[tuple[float, ...]]] = {}  # κ, in vain

    def of(
        self, problem: CoDesignProblem, *, traced: bool = True, quiet: bool = False
    ) -> "Sampler":
        """One for another problem with the same store, workers and count; and trace, if `traced`.

        An easier problem's designs are worth nothing to this one: they are not traced.
        """
        other = Sampler(problem, self.store, self.workers, quiet=quiet or self.quiet)
        other.spent = self.spent
        other.whole = traced
        if traced:
            other.trace, other.bandwidth_at_start = self.trace, self.bandwidth_at_start
        return other

    @property
    def syntheses(self) -> int:
        """Distinct true syntheses asked for so far."""
        return self.spent.total

    def count_multistart(self, key: str) -> None:
        """Count a multi-start search once, as one synthesis."""
        with self.spent.on("races"):
            self.spent.once(f"race {key}", 1)

    def values(self, thetas: Array, label: str = "sampling") -> list[InnerSample]:
        """ω_b* at every row of `thetas`, in their order: the best that is known there.

        A kind may begin a new θ from what is known near by, and search samples again that fall
        short of their neighbours (`InnerUnits`). Where the time is up those that are left are
        `unsearched`.
        """
        points = [tuple(float(v) for v in theta) for theta in np.atleast_2d(thetas)]
        known = list(self.solved.values())
        new = [theta for theta in points if theta not in self.solved]
        begin = units_of(self.problem).begin
        self._learn({theta: begin(self.problem, known, theta) for theta in new}, label)
        return [self.solved.get(theta) or unsearched_sample(theta) for theta in points]

    def value_from(self, theta: Sequence[float], kappa: Sequence[float]) -> InnerSample:
        """The sample at θ, where a controller (κ in SI) was found for it: also from that one."""
        point = tuple(float(v) for v in theta)
        start = units_of(self.problem).begin_at(self.problem, kappa)
        self._learn({point: start}, "from a controller")
        return self.solved.get(point) or unsearched_sample(point)

    def latest(self, samples: Sequence[InnerSample]) -> list[InnerSample]:
        """Return the present samples at the θ of older ones."""
        return [self.solved.get(sample.theta, sample) for sample in samples]

    def _learn(self, problems: Mapping[tuple[float, ...], CoDesignProblem], label: str) -> None:
        """The inner problem at every θ; then climbs from their neighbours where samples fall short
        of them, until none does."""
        reported = len(self.trace)
        self._solve(problems, label)
        units = units_of(self.problem)
        while again := units.retries(self.problem, self.solved.values(), self._tried):
            if time_is_up():
                break
            before = {retry.theta: self.solved[retry.theta] for retry in again}
            self._solve({retry.theta: retry.problem for retry in again}, "from neighbours")
            for retry in again:
                if self.solved[retry.theta] is before[retry.theta]:
                    self._tried.setdefault(retry.theta, []).append(retry.kappa)
        self.report(reported)

    def _solve(self, problems: Mapping[tuple[float, ...], CoDesignProblem], label: str) -> None:
        """The inner problem at every θ, and the better one kept of it and what is known."""
        owners = {theta: hashes_of(problem)[1] for theta, problem in problems.items()}
        keys = {theta: sample_key(owners[theta], theta) for theta in problems}
        payloads = {key: self.store.get_result(key) for key in keys.values()}
        missing = {keys[theta]: theta for theta in problems if not payloads[keys[theta]]}
        with Progress(len(missing), label, quiet=self.quiet) as progress:
            tasks = [(problems[theta], self.hash, key, theta) for key, theta in missing.items()]
            alone = len(tasks) == 1  # then it may spread its own searches
            unit = partial(inner_unit, workers=self.workers) if alone else inner_unit
            # of a single θ something is known at any time: what ends a search builds on it
            of_key = {task[2]: (unit, task, len(tasks) == 1) for task in tasks}
            for key, (found, whole) in results(self.workers, solve_in_time, of_key):
                theta = missing[key]
                if found is None:
                    not_searched("theta")
                    continue
                rows, payload = found[1]
                payloads[key] = payload
                progress.advance()
                if not whole:  # it may be better with more time: who resumes searches it again
                    continue
                self.store.put_unit(rows, (key, owners[theta], theta, payload), self.hash)
                if theta not in self.solved:  # a run that resumes finds it by this key
                    own = sample_key(self.inner_hash, theta)
                    self.store.put_unit([], (own, self.inner_hash, theta, payload))
        for theta, key in keys.items():
            known = payloads[key]
            if known is None:
                continue
            try:
                sample = inner_sample(theta, known)
            except (KeyError, TypeError, ValueError) as error:
                raise self.store.damaged_error() from error
            before = self.solved.get(theta, sample)
            gain = self.problem.figure.gain(sample.value, before.value)  # NaN: one is infeasible
            if theta not in self.solved or gain > 0.0 or sample.feasible > before.feasible:
                if theta in self.solved:
                    self.improvements += 1
                    if not time_is_up():
                        best = (best_key(self.inner_hash, theta), owners[theta], theta, known)
                        self.store.put_unit([], best, anew=True)
                self.solved[theta] = sample
            if not sample.feasible and (
                self.nearest is None or sample.violation < self.nearest.violation
            ):
                self.nearest = sample
            self._spend(key, sample.syntheses, theta, sample.bandwidth, sample.value)

    def quantities(self, X: Array, label: str = "sampling") -> list[QuantitySample]:
        """Values and derivatives at every row of X = (θ, ln ω_S, ln ω_T), in their order."""
        points = [tuple(float(v) for v in x) for x in np.atleast_2d(X)]
        keys = [self._design_key(x) for x in points]
        slopes = (len(self.problem.names) + 2) * (2 + len(self.problem.inner.bounds))
        known = {key: s for key, s in self.store.get(keys).items() if s.gradients is not None}
        if any(len(sample.gradients or ()) != slopes for sample in known.values()):
            raise self.store.damaged_error()
        todo = list({k: x for k, x in zip(keys, points, strict=True) if k not in known}.items())
        size = min(
            self.chunk, max(1, -(-len(todo) // self.workers.count))
        )  # a few keep all at work
        if plant_of(self.problem).expensive:  # seconds each: none waits for seven others
            size = 1
        chunks = [todo[i : i + size] for i in range(0, len(todo), size)]
        with Progress(len(todo), label, quiet=self.quiet) as progress:
            parts = {i: (design_unit, (self.problem, chunk)) for i, chunk in enumerate(chunks)}
            for i, (made, _) in results(self.workers, solve_in_time, parts):
                if made is None:
                    not_searched("design", len(chunks[i]))
                    continue
                samples = made[0]
                self.store.put(samples, self.hash)
                known |= {sample.key: sample for sample in samples}
                progress.advance(len(samples))
        before = len(self.trace)
        inner, found = self.problem.inner, []
        for x, key in zip(points, keys, strict=True):
            if key in known:
                self._spend(key, 1, x[:-2], self._worth(known[key]))
                found.append(quantity_sample(x, known[key], inner))
            else:
                found.append(unsearched_quantities(x, inner))
        self.report(before)
        return found

    @cached_property
    def truth(self) -> TrueQuantities:
        """The true quantities at any x, for IPOPT and what polishes: made in this process."""
        return TrueQuantities(self.problem, self._record)

    def recall(self, what: str, point: Sequence[float], kind: type[T], make: Callable[[], T]) -> T:
        """Return the value of `make` at a point of this problem, made once for all runs on the
        store."""
        owner = problem_hash({what: self.inner_hash})
        return self.store.recall(sample_key(owner, point), owner, point, kind, make)

    def _record(self, x: Array, make: Callable[[], Sensitivities]) -> Sensitivities:
        """A design made outside the pool (IPOPT on the true function): a row too, and counted."""
        point = tuple(float(v) for v in x)
        design = self.recall("design", point, Sensitivities, make)
        key = self._design_key(point)
        sample = sample_of(key, point[:-2], design.figures, 0.0, design)
        self.store.put([sample], self.hash)
        before = len(self.trace)
        self._spend(key, 1, sample.theta, self._worth(sample))
        if self.spent.purpose != "polish":  # which reports its end
            self.report(before)
        return design

    def _spend(
        self,
        key: str,
        count: int,
        theta: tuple[float, ...],
        bandwidth: float,
        value: float | None = None,
    ) -> None:
        """Count a unit once, and keep what it was worth: NaN where it is not feasible.

        `value` is what J counts, where that is not the bandwidth.
        """
        if not self.spent.once(key, count):
            return
        J, value = np.nan, bandwidth if value is None else value
        if np.isfinite(value) and not violations(self.problem, theta):
            J = objective(self.problem, theta, value)
        self.trace.append(TraceEntry(self.syntheses, theta, float(bandwidth), float(J)))

    def report(self, before: int) -> None:
        """Report on stderr the best design, if it is one of those after the first `before`."""
        J = np.array([entry.objective for entry in self.trace])
        if self.quiet or np.isnan(J[before:]).all():
            return
        best = before + int(np.nanargmin(J[before:]))
        if np.isnan(J[:before]).all() or J[best] < np.nanmin(J[:before]) - self.reported_gain * abs(
            J[best]
        ):
            bandwidth = self.trace[best].bandwidth / HZ
            label = "best of this part"
            if self.whole:  # of a design that was found before a plant may exceed a bound
                label = "best so far" if J[best] < self.spent.reported else "best on all plants"
                self.spent.reported = min(self.spent.reported, float(J[best]))
            remark(f"{label}: J {J[best]:.6g}, {bandwidth:.4g} Hz", self.quiet)

    def _worth(self, sample: Sample) -> float:
        """The bandwidth of a design that meets the bounds, else NaN."""
        meets = sample.certified and self.problem.inner.excess(sample) <= 0.0
        return sample.bandwidth if meets else np.nan

    def _design_key(self, x: tuple[float, ...]) -> str:
        return sample_key(self.hash, x[:-2], *self.problem.inner.frequencies(x))
