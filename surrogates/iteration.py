"""One iteration of retraining: the surrogates, their optimum, and whether that is the true one."""

from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime

import numpy as np

from surrogates.acquisition import NEAR, Posterior, maximiser, objective_and_violation
from surrogates.fitting import fit
from surrogates.gaussian_process import GaussianProcess, loo_errors
from surrogates.interface import Array
from surrogates.optimum import Optimum, predicted_optimum
from surrogates.sampling_plan import sobol
from surrogates.truth import Observations, Truth
from surrogates.versions import Version, Versions

SETTLED = 0.1  # share of the tolerance below which a change of J counts as none
STARTS = 16  # of IPOPT, besides the best sample
SAME = 1e-9  # of the box: samples that a version was fitted to


@dataclass(frozen=True, eq=False)
class Iteration:
    """The surrogates, their version and predicted optimum, and how far that is from the truth.

    x: the design to verify if nothing more is asked (None: there is none). step: from the
    predicted optimum to the nearest sample, share of the box. error: |ΔJ| / |J| and |Δg|, the
    larger, between truth and prediction at the sample by x, itself left out. gain: the
    largest expected improvement, in units of J.
    """

    posterior: Posterior
    version: Version
    optimum: Optimum | None
    x: Array | None
    true: float
    step: float
    error: float
    gain: float
    settled: bool

    @property
    def near(self) -> tuple[Array, ...]:
        """Where candidates are looked for besides the whole box."""
        predicted = None if self.optimum is None else self.optimum.x
        return tuple(x for x in (self.x, predicted) if x is not None)


def iterate(
    truth: Truth, observed: Observations, failed: Array, versions: Versions, seed: int
) -> Iteration:
    """Fit all that is observed (the newest version where it was fitted to that), and optimise."""
    newest = versions.newest()
    unit = (observed.X - truth.lower) / (truth.upper - truth.lower)
    if newest is not None and _fitted_to(newest[0], unit):
        surrogates = newest[0]
    else:
        newest, surrogates = None, fit_all(truth, observed, seed)
    posterior = Posterior(truth, surrogates, observed, failed)
    J, violation = posterior.values()
    best = posterior.incumbent()
    first = int(np.argmin(violation)) if best is None else best
    starts = np.vstack([observed.X[first], sobol(truth.lower, truth.upper, STARTS, seed)])
    optimum = predicted_optimum(truth, surrogates, starts, failed)
    step, settled, at, x = np.inf, False, best, None if best is None else observed.X[best]
    if optimum is not None:
        away = np.abs((observed.X - optimum.x) / (truth.upper - truth.lower)).max(axis=1)
        step = float(away.min())
        tolerated = SETTLED * truth.tolerance
        settled = best is not None and abs(optimum.objective / J[best] - 1.0) <= tolerated
        if step <= NEAR or best is None:
            at, x = int(np.argmin(away)), optimum.x
        settled = settled or step <= NEAR
    error = np.inf if at is None else _error_at(posterior, at)
    _, gain = maximiser(posterior, False, () if optimum is None else (optimum.x, starts[0]), seed)
    version = (
        newest[1]
        if newest
        else versions.add(
            surrogates,
            truth.describe,
            samples=len(observed.X),
            errors={
                name: asdict(process.loo)
                for name, process in zip(truth.outputs, surrogates, strict=True)
            },
            at_optimum=error if np.isfinite(error) else None,
            objective=None if optimum is None else optimum.objective,
            created=datetime.now(UTC).isoformat(timespec="seconds"),
        )
    )
    true = np.nan if at is None else float(J[at])
    return Iteration(posterior, version, optimum, x, true, step, error, gain, settled)


def converged(iteration: Iteration) -> bool:
    """Whether prediction and truth agree at an optimum that nothing promises to better."""
    tolerance = iteration.posterior.truth.tolerance
    least = SETTLED * tolerance * abs(iteration.true)
    return iteration.settled and iteration.error <= tolerance and iteration.gain <= least


def fit_all(truth: Truth, observed: Observations, seed: int) -> tuple[GaussianProcess, ...]:
    """One process to each output over the truth's box."""
    return tuple(
        fit(
            observed.X,
            observed.Y[:, i],
            lower=truth.lower,
            upper=truth.upper,
            dY=None if observed.dY is None else observed.dY[:, i],
            seed=seed,
            starts=2,
        )
        for i in range(len(truth.outputs))
    )


def _fitted_to(surrogates: tuple[GaussianProcess, ...], unit: Array) -> bool:
    X = surrogates[0].X
    return X.shape == unit.shape and bool(np.abs(X - unit).max() <= SAME)


def _error_at(posterior: Posterior, row: int) -> float:
    """The error of J (relative) and g at an observation, predicted without it."""
    observed = posterior.observed.rows(np.array([row]))
    residuals = [loo_errors(process)[0][row] for process in posterior.surrogates]
    left_out = replace(observed, Y=observed.Y - np.array(residuals))
    J, g = objective_and_violation(posterior.truth, observed.X, observed.Y)
    J_out, g_out = objective_and_violation(posterior.truth, observed.X, left_out.Y)
    off = float(abs(J_out[0] - J[0]) / max(abs(J[0]), 1e-300))
    return max(off, float(abs(g_out[0] - g[0])) if np.isfinite(g[0]) else 0.0)
