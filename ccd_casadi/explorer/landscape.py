"""ω_b* over two parameters: the run's surrogate where it still answers, and every sample known."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ccd_casadi.inner_problem.problem import CoDesignProblem
from ccd_casadi.reporting.landscape import best_designs, predicted
from ccd_casadi.reporting.true_samples import read_truths
from ccd_casadi.support.arrays import Array
from surrogates import GaussianProcess, SurrogateFileError, load

GRID = 25  # points a side


@dataclass(frozen=True)
class Field:
    """ω_b*(θ) in Hz by the surrogate (GRID, GRID), rows along the second parameter; the samples.

    `samples` (k, 3): both parameters and the largest ω_b known there. `field` is empty where no
    surrogate answers, `words` says why.
    """

    x: tuple[float, float]
    y: tuple[float, float]
    field: Array
    samples: Array
    words: str


def run_surrogate(folder: Path) -> tuple[GaussianProcess, ...]:
    """The newest surrogate of a run folder; none where there is none, or it cannot be read."""
    try:
        found, _ = load(folder / "surrogate.json")
    except (OSError, SurrogateFileError):
        return ()
    return tuple(item for item in found if isinstance(item, GaussianProcess))


def field_of(
    problem: CoDesignProblem,
    theta: Sequence[float],
    made_for: CoDesignProblem | None,
    processes: tuple[GaussianProcess, ...],
    store: Path,
    axes: tuple[int, int],
) -> Field:
    """The landscape over the parameters `axes`, the others as at θ.

    `made_for`: the problem that the surrogates are of; of another one they say nothing.
    """
    i, j = axes
    lower, upper = np.array(problem.lower), np.array(problem.upper)
    x, y = ((float(lower[k]), float(upper[k])) for k in axes)
    field, words = np.empty((0, 0)), "no surrogate: the dots are the designs looked at"
    if processes and made_for is not None:
        same = made_for.identity() == problem.identity()
        if same and made_for.inner_identity() == problem.inner_identity():
            thetas = np.tile(np.array(theta), (GRID * GRID, 1))
            first, second = np.meshgrid(np.linspace(*x, GRID), np.linspace(*y, GRID))
            thetas[:, i], thetas[:, j] = first.ravel(), second.ravel()
            field = predicted(problem, processes, thetas, std=False)[0].reshape(GRID, GRID)
            words = f"ω_b*(θ) by the run's surrogate of {len(processes[0].X)} samples"
        else:
            words = "the run's surrogate is of another S_max, range or plant set: not shown"
    known = best_designs(problem, read_truths(store, problem))
    samples = np.array([(t[i], t[j], hz) for t, hz in known.items()]).reshape(-1, 3)
    return Field(x, y, field, samples, words)
