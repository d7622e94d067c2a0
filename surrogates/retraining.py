"""The loop of a retraining job: fit, predict the optimum, ask the truth where it helps most.

What to do next follows from the samples alone: a job that was killed goes on from what is known,
and one that has nothing left to do does nothing.
"""

import fcntl
import math
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from surrogates.acquisition import (
    NEAR,
    Posterior,
    choose,
    distances,
    maximiser,
    objective_and_violation,
    predicted_optimum,
)
from surrogates.fitting import fit_outputs
from surrogates.gaussian_process import loo_errors
from surrogates.interface import Array
from surrogates.sampling_plan import sobol
from surrogates.truth import Observations, Truth, TruthError
from surrogates.versions import Version, Versions

LOCK = "retrain.lock"  # held by the job; holds what was spent before the folder's first job
PER_INPUT = 3  # samples an input that a first fit is worth
DOUBLINGS = 4  # of the first design, where the truth has no value at most points
PASSES = 4  # fits after a verification, which itself yields samples
STARTS = 16  # of IPOPT, besides the best sample
SETTLED = 0.1  # share of the tolerance below which a change of J counts as none
SAME = 1e-9  # of the box: samples that a version was fitted to
CONVERGED = "converged"


@dataclass(frozen=True)
class Settings:
    """budget: evaluations that retraining may add to the run folder, over all its jobs.

    batch: points a round.
    """

    budget: int = 500
    batch: int = 4
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
class Iteration:
    """The surrogates, their version, and how far their optimum is from the truth.

    near: the predicted optimum if there is one, then the design to verify if nothing more is
    asked (x; None: there is none). error: |ΔJ| / |J| and |Δg|, the larger, between truth and
    prediction at the sample by x, itself left out.
    """

    posterior: Posterior
    version: Version
    near: list[Array]
    x: Array | None
    error: float
    converged: bool


@contextmanager
def only_job(folder: Path) -> Iterator[None]:
    """Hold a run folder; raises TruthError where another job has it. Ends with the process."""
    with (folder / LOCK).open("a") as stream:
        try:
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise TruthError(
                f"{folder}: another job is retraining it; wait for it, or retrain a copy (--out)"
            ) from None
        yield


def retrain(folder: Path, truth: Truth, settings: Settings, quiet: bool = True) -> Outcome:
    """Run a job to its end: converged, out of budget, or without a feasible design.

    For one job at a time: hold `only_job(folder)`. Raises TruthError, TruthInterrupted and
    KeyboardInterrupt; all may be resumed.
    """
    versions, base = Versions(folder), _spent_before(folder / LOCK, truth.spent)
    rounds = passes = 0
    while True:
        seen, before = truth.samples(), truth.spent
        observed, failed = thinned(truth, seen)
        cost = before / max(len(seen.X), 1) or 1.0
        room = math.ceil((settings.budget - (before - base)) / cost)
        room = min(settings.batch, max(room, 0))
        batch = first_design(truth, seen, observed, settings.seed)[:room]
        iteration, words = None, f"first design, {len(batch)} points"
        if not len(batch):
            few = len(observed.X) < len(truth.lower) + 2
            if few and not room:
                raise TruthError(
                    f"--budget {settings.budget} leaves {len(observed.X)} samples, too few for a "
                    "first fit; give a larger one"
                )
            reason = "too few points where the truth has a value"
            if not few:
                iteration = iterate(truth, observed, failed, versions, settings.seed)
                reason = CONVERGED if iteration.converged else "" if room else "budget"
                words = f"{len(observed.X)} samples, error {iteration.error:.1e}"
            if iteration is not None and not reason:
                seed = settings.seed + len(observed.X)
                batch = choose(iteration.posterior, iteration.near, room, seed)
                reason = "" if len(batch) else "nothing is left to ask"
            if reason:
                status, name = _finish(truth, iteration, versions)
                passes += 1
                if truth.spent > before and passes < PASSES and reason == CONVERGED:
                    continue  # the verification found samples: fit those too
                return Outcome(status, reason, rounds, truth.spent - base, name)
        truth.evaluate(batch)
        rounds += 1
        if not quiet:
            print(f"round {rounds}: {words}, {truth.spent - base} evaluations",
                  file=sys.stderr, flush=True)  # fmt: skip


def _spent_before(path: Path, spent: int) -> int:
    """What was spent before the first job on the folder, kept from then on."""
    if not (path.exists() and path.read_text().strip().isdecimal()):
        path.write_text(f"{spent}\n")  # in place: the lock is on this file
    return int(path.read_text())


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
    least = PER_INPUT * len(truth.lower)
    for doubling in range(DOUBLINGS if len(observed.X) < least else 0):
        points = sobol(truth.lower, truth.upper, least << doubling, seed)
        missing = points[distances(truth, points, seen.X) > NEAR]
        if len(missing):
            return missing
    return np.empty((0, len(truth.lower)))


def iterate(
    truth: Truth, observed: Observations, failed: Array, versions: Versions, seed: int
) -> Iteration:
    """Fit all that is observed (the newest version where it was fitted to that), and optimise.

    Converged: prediction and truth agree at an optimum that nothing promises to better.
    """
    lower, upper, tolerance = truth.lower, truth.upper, truth.tolerance
    unit = (observed.X - lower) / (upper - lower)
    newest = versions.newest()
    if newest is not None:
        X = newest[0][0].X
        newest = newest if X.shape == unit.shape and np.abs(X - unit).max() <= SAME else None
    surrogates = newest[0] if newest else fit_outputs(
        observed.X, observed.Y, observed.dY, lower=lower, upper=upper, seed=seed, starts=2
    )  # fmt: skip
    posterior = Posterior(truth, surrogates, observed, failed)
    J, violation = posterior.values()
    best = posterior.incumbent()
    first = observed.X[int(np.argmin(violation)) if best is None else best]
    optimum = predicted_optimum(posterior, np.vstack([first, sobol(lower, upper, STARTS, seed)]))
    settled, at, x = False, best, None if best is None else first
    if optimum is not None:
        away = np.abs((observed.X - optimum[0]) / (upper - lower)).max(axis=1)
        settled = bool(away.min() <= NEAR)
        if settled or best is None:
            at, x = int(np.argmin(away)), optimum[0]
        if best is not None:
            settled = settled or bool(abs(optimum[1] / J[best] - 1.0) <= SETTLED * tolerance)
    error = np.inf if at is None else _error_at(posterior, at)
    near = ([] if optimum is None else [optimum[0]]) + [first]
    gain = maximiser(posterior, near, seed)[1]
    least = -np.inf if at is None else SETTLED * tolerance * abs(J[at])
    version = newest[1] if newest else versions.add(
        surrogates,
        truth.describe,
        samples=len(observed.X),
        errors={n: asdict(p.loo) for n, p in zip(truth.outputs, surrogates, strict=True)},
        at_optimum=error if np.isfinite(error) else None,
        objective=None if optimum is None else optimum[1],
        created=datetime.now(UTC).isoformat(timespec="seconds"),
    )  # fmt: skip
    converged = bool(settled and error <= tolerance and gain <= least)
    return Iteration(posterior, version, near, x, error, converged)


def _error_at(posterior: Posterior, row: int) -> float:
    """The error of J (relative) and g at an observation, predicted without it."""
    seen = posterior.observed.rows(np.array([row]))
    residuals = [loo_errors(process)[0][row] for process in posterior.surrogates]
    left_out = replace(seen, Y=seen.Y - np.array(residuals))
    J, g = objective_and_violation(posterior.truth, seen.X, seen.Y)
    J_out, g_out = objective_and_violation(posterior.truth, seen.X, left_out.Y)
    off = float(abs(J_out[0] - J[0]) / max(abs(J[0]), 1e-300))
    return max(off, float(abs(g_out[0] - g[0])) if np.isfinite(g[0]) else 0.0)
