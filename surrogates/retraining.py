"""The loop of a retraining job: fit, predict the optimum, ask the truth where it helps most.

What to do next follows from the samples alone, so that a job that was killed, or that runs beside
another, goes on from what is known, and one that has nothing left to do does nothing.
"""

import math
import os
import sys
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter, sleep

import numpy as np

from surrogates.acquisition import NEAR, choose, distances, objective_and_violation
from surrogates.interface import Array
from surrogates.iteration import Iteration, converged, iterate
from surrogates.journal import Journal
from surrogates.pending_points import PendingPoints
from surrogates.sampling_plan import sobol
from surrogates.truth import Observations, Truth, TruthError
from surrogates.versions import Versions

JOURNAL = "retrain.jsonl"
PER_INPUT = 3  # samples an input that a first fit is worth
DOUBLINGS = 4  # of the first design, where the truth has no value at most points
PASSES = 4  # fits after a verification, which itself yields samples
CONVERGED = "converged"
WAIT = 0.2  # s between two looks at what other jobs are about to finish


@dataclass(frozen=True)
class Settings:
    """budget: evaluations that retraining may add to the run folder, over all its jobs.

    batch: points a round; explore: the share of them at the largest deviation.
    """

    budget: int = 500
    batch: int = 4
    explore: float = 0.25
    seed: int = 0


@dataclass(frozen=True)
class Outcome:
    """How a job ended; spent: evaluations since the first job on this run folder began."""

    status: str
    reason: str
    rounds: int
    spent: int
    version: str | None


@dataclass(frozen=True, eq=False)
class Plan:
    """A batch (q, d) to evaluate, none to wait for other jobs; or the reason to end."""

    iteration: Iteration | None
    batch: Array
    reason: str


def retrain(folder: Path, truth: Truth, settings: Settings, quiet: bool = True) -> Outcome:
    """Run a job to its end: converged, out of budget, or without a feasible design.

    Raises TruthError, TruthInterrupted and KeyboardInterrupt; all may be resumed.
    """
    journal, versions = Journal(folder / JOURNAL), Versions(folder)
    pending = PendingPoints(folder, len(truth.lower))
    begun = [entry["spent"] for entry in journal.entries() if entry.get("event") == "start"]
    base = begun[0] if begun else truth.spent
    journal.append(event="start", spent=truth.spent, pid=os.getpid(), **vars(settings))
    rounds = passes = 0
    while True:
        began, reservation = perf_counter(), None
        with pending.deciding():
            plan = decide(truth, pending.others(), versions, settings, base)
            if plan.reason:
                before = truth.spent
                status, version = _finish(truth, plan.iteration, versions)
                passes += 1
                if truth.spent > before and passes < PASSES and plan.reason == CONVERGED:
                    continue  # the verification found samples: fit those too
                outcome = Outcome(status, plan.reason, rounds, truth.spent - base, version)
                journal.append(event="end", **vars(outcome))
                return outcome
            if len(plan.batch):
                reservation = pending.reserve(plan.batch)
        if reservation is None:
            sleep(WAIT)  # the points that count are in flight elsewhere
            continue
        with reservation:
            found = truth.evaluate(plan.batch)
        rounds += 1
        _log(journal, rounds, truth, plan.iteration, found, perf_counter() - began, quiet)


def decide(truth: Truth, pending: Array, versions: Versions, settings: Settings, base: int) -> Plan:
    """What the samples, and the points (m, d) that other jobs have in flight, leave to be done.

    `base`: evaluations before the first job. Raises TruthError where the budget is too small
    for a first fit.
    """
    seen = truth.samples()
    observed, failed = thinned(truth, seen)
    cost = truth.spent / max(len(seen.X), 1) or 1.0
    left = settings.budget - (truth.spent - base) - len(pending) * cost
    room = min(settings.batch, max(math.ceil(left / cost), 0))
    exhausted = not room and not len(pending)
    missing = first_design(truth, seen, observed, settings.seed)
    if len(missing):
        if exhausted:
            raise TruthError(
                f"--budget {settings.budget} leaves {len(observed.X)} samples, too few for a "
                "first fit; give a larger one"
            )
        closed = np.vstack([failed, pending])
        return Plan(None, missing[distances(truth, missing, closed) > NEAR][:room], "")
    none = np.empty((0, len(truth.lower)))
    if len(observed.X) < len(truth.lower) + 2:
        return Plan(None, none, "too few points where the truth has a value")
    iteration = iterate(truth, observed, failed, versions, settings.seed)
    if converged(iteration):
        return Plan(iteration, none, CONVERGED)
    if exhausted:
        return Plan(iteration, none, "budget")
    batch = next_batch(iteration, pending, room, settings) if room else none
    stuck = not len(batch) and not len(pending)
    return Plan(iteration, batch, "nothing is left to ask" if stuck else "")


def _finish(
    truth: Truth, iteration: Iteration | None, versions: Versions
) -> tuple[str, str | None]:
    if iteration is None:
        return truth.finish(None, (), None), None
    name = iteration.version.version
    status = truth.finish(iteration.x, iteration.posterior.surrogates, name)
    versions.publish()
    return status, name


def thinned(truth: Truth, seen: Observations) -> tuple[Observations, Array]:
    """What to fit, in an order of its own, and the points (f, d) without a value.

    Of samples nearer than NEAR the first counts: more would only spoil the conditioning.
    """
    known = seen.rows(seen.known)
    kept: list[int] = []
    for row in range(len(known.X)):
        if distances(truth, known.X[row : row + 1], known.X[kept])[0] > NEAR:
            kept.append(row)
    rows = np.array(kept, dtype=int)
    order = np.lexsort(known.X[rows].T[::-1]) if kept else rows
    return known.rows(rows[order]), seen.X[~seen.known]


def first_design(truth: Truth, seen: Observations, observed: Observations, seed: int) -> Array:
    """Points (m, d) that a first fit still misses: of a Sobol set, doubled while most fail."""
    d = len(truth.lower)
    least = PER_INPUT * d
    for doubling in range(DOUBLINGS):
        if len(observed.X) >= least:
            break
        points = sobol(truth.lower, truth.upper, least << doubling, seed)
        missing = points[distances(truth, points, seen.X) > NEAR]
        if len(missing):
            return missing
    return np.empty((0, d))


def next_batch(iteration: Iteration, pending: Array, room: int, settings: Settings) -> Array:
    """The predicted optimum, what promises most, and the share to explore."""
    posterior = iteration.posterior
    for x in pending:
        posterior = posterior.with_prediction_at(x)
    first = None if iteration.optimum is None else iteration.optimum.x
    explore = min(round(settings.explore * room), room)
    seed = settings.seed + len(posterior.observed.X)
    return choose(posterior, first, room, explore, iteration.near, seed)


def _log(
    journal: Journal,
    number: int,
    truth: Truth,
    iteration: Iteration | None,
    found: Observations,
    seconds: float,
    quiet: bool,
) -> None:
    J = objective_and_violation(truth, found.X, found.Y)[0]
    entry = {"event": "round", "round": number, "spent": truth.spent, "batch": found.X, "true": J}
    words = f"round {number}: first design, {len(found.X)} points"
    if iteration is not None:
        version, optimum = iteration.version, iteration.optimum
        entry |= {
            "samples": version.samples,
            "version": version.version,
            "errors": version.errors,
            "predicted": None if optimum is None else optimum.objective,
            "error": iteration.error,
            "step": iteration.step,
            "improvement": iteration.gain,
        }
        predicted = "none" if optimum is None else f"{optimum.objective:.6g}"
        words = (
            f"round {number}: {version.samples} samples, predicted J {predicted}, "
            f"best true {iteration.true:.6g}, error {iteration.error:.1e}, "
            f"improvement {iteration.gain:.1e}"
        )
    journal.append(**entry, seconds=seconds)
    if not quiet:
        print(words, file=sys.stderr, flush=True)
