"""The loop of a retraining job: fit, predict the optimum, sample the truth where it helps most.

What to do next follows from the samples alone: a job that was killed goes on from what is known,
and one that has nothing left to do does nothing.
"""

import math
import sys
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from ccd_casadi.codesign.acquisition import (
    NEAR,
    Posterior,
    choose,
    distances,
    maximiser,
    objective_and_violation,
    predicted_optimum,
)
from ccd_casadi.codesign.truth import Observations, Truth
from ccd_casadi.codesign.versions import (
    keep_version,
    load_version,
    only_job,
    publish,
    version_names,
)
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import UserError
from surrogates import GaussianProcess, fit_outputs, sobol
from surrogates.gaussian_process import loo_errors

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
class Iteration:
    """A fit: near has the predicted optimum, if any, and the best sample; x is what to verify."""

    posterior: Posterior
    version: str
    near: list[Array]
    x: Array | None
    converged: bool
    words: str


def retrain(folder: Path, truth: Truth, settings: Settings, quiet: bool = True) -> Outcome:
    """Run a job to its end: converged, out of budget, or without a feasible design.

    Raises UserError, and what the truth raises; the same call resumes.
    """
    with only_job(folder, truth.spent) as base:
        rounds = passes = 0
        while True:
            before = truth.spent
            iteration, batch, reason = decide(folder, truth, settings, base)
            if not reason:
                truth.evaluate(batch)
                rounds += 1
                if not quiet:
                    first = f"first design, {len(batch)} points"
                    words = first if iteration is None else iteration.words
                    print(f"round {rounds}: {words}", file=sys.stderr, flush=True)
                continue
            if iteration is None:
                status, name = truth.finish(None, (), None), None
            else:
                name = iteration.version
                status = truth.finish(iteration.x, iteration.posterior.surrogates, name)
                publish(folder)
            passes += 1
            # a verification that found samples: those are fitted too
            if truth.spent == before or passes == PASSES or reason != CONVERGED:
                return Outcome(status, reason, rounds, truth.spent - base, name)


def decide(
    folder: Path, truth: Truth, settings: Settings, base: int
) -> tuple[Iteration | None, Array, str]:
    """What the samples leave to be done: a batch (q, d) to evaluate, or the reason to end.

    `base`: evaluations before the first job. Raises UserError where the budget is too small
    for a first fit.
    """
    seen = truth.samples()
    observed, failed = thinned(truth, seen)
    cost = truth.spent / max(len(seen.X), 1) or 1.0
    left = settings.budget - (truth.spent - base)
    room = min(settings.batch, max(math.ceil(left / cost), 0))
    missing = first_design(truth, seen, observed, settings.seed)
    if len(missing) and not room:
        raise UserError(
            f"--budget {settings.budget} leaves {len(observed.X)} samples, too few for a "
            "first fit; give a larger one"
        )
    if len(missing):
        return None, missing[:room], ""
    if len(observed.X) < len(truth.lower) + 2:
        return None, missing, "too few points where the truth has a value"
    iteration = iterate(folder, truth, observed, failed, settings.seed)
    if iteration.converged or not room:
        return iteration, missing, CONVERGED if iteration.converged else "budget"
    explore, seed = round(settings.explore * room), settings.seed + len(observed.X)
    batch = choose(iteration.posterior, iteration.near, room, explore, seed)
    return iteration, batch, "" if len(batch) else "nothing is left to sample"


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
    folder: Path, truth: Truth, observed: Observations, failed: Array, seed: int
) -> Iteration:
    """Fit all that is observed (the newest version where it was fitted to that), and optimise.

    Converged: prediction and truth agree at an optimum that nothing promises to better.
    """
    lower, upper, tolerance = truth.lower, truth.upper, truth.tolerance
    name, surrogates = _fitted(folder, truth, observed, seed)
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
    true, error = (np.nan, np.inf) if at is None else (float(J[at]), _error_at(posterior, at))
    near = [first] if optimum is None else [optimum[0], first]
    gain = maximiser(posterior, False, near, seed)[1]
    predicted = None if optimum is None else optimum[1]
    if name is None:
        name = keep_version(
            folder,
            surrogates,
            truth.describe,
            samples=len(observed.X),
            errors={n: asdict(p.loo) for n, p in zip(truth.outputs, surrogates, strict=True)},
            at_optimum=error if np.isfinite(error) else None,
            objective=predicted,
            created=datetime.now(UTC).isoformat(timespec="seconds"),
        )
    words = (
        f"{len(observed.X)} samples, predicted J "
        f"{'none' if predicted is None else f'{predicted:.6g}'}, "
        f"best true {true:.6g}, error {error:.1e}, improvement {gain:.1e}"
    )
    converged = settled and error <= tolerance and gain <= SETTLED * tolerance * abs(true)
    return Iteration(posterior, name, near, x, bool(converged), words)


def _fitted(
    folder: Path, truth: Truth, observed: Observations, seed: int
) -> tuple[str | None, tuple[GaussianProcess, ...]]:
    """The newest version where these samples are its own, else a new fit without a name."""
    lower, upper = truth.lower, truth.upper
    name = next(reversed(version_names(folder)), None)
    if name is not None:
        surrogates = load_version(folder, name)
        unit, X = (observed.X - lower) / (upper - lower), surrogates[0].X
        if X.shape == unit.shape and np.abs(X - unit).max() <= SAME:
            return name, surrogates
    return None, fit_outputs(
        observed.X, observed.Y, observed.dY, lower=lower, upper=upper, seed=seed, starts=2
    )


def _error_at(posterior: Posterior, row: int) -> float:
    """The larger of |ΔJ| / |J| and |Δg| between an observation and its prediction without it."""
    seen = posterior.observed.rows(np.array([row]))
    residuals = [loo_errors(process)[0][row] for process in posterior.surrogates]
    left_out = replace(seen, Y=seen.Y - np.array(residuals))
    J, g = objective_and_violation(posterior.truth, seen.X, seen.Y)
    J_out, g_out = objective_and_violation(posterior.truth, seen.X, left_out.Y)
    off = float(abs(J_out[0] - J[0]) / max(abs(J[0]), 1e-300))
    return max(off, float(abs(g_out[0] - g[0])) if np.isfinite(g[0]) else 0.0)
